"""Small faults of benchmarks that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

import numpy as np
import pytest

from harness.benchmark.records import noise_floor
from harness.benchmark.statistics import _holm, enough_pairs, standings
from harness.signals import Channel, PlantSpec, Trajectory


@pytest.mark.parametrize("others", [1, 3])
def test_a_tie_needs_as_many_pairs_as_a_difference(others: int) -> None:
    enough = enough_pairs(others)
    for pairs, state in ((enough, "tied"), (enough - 1, "undecided")):
        good = np.linspace(1.0, 2.0, pairs)
        near = good * np.where(np.arange(pairs) % 2, 1.001, 0.9995)
        scores = {"good": good.tolist(), **{f"n{k}": near.tolist() for k in range(others)}}
        found = standings(scores)
        leader = next(name for name, one in found.items() if one.state == "best")
        assert {one.state for name, one in found.items() if name != leader} == {state}


def test_adjusted_levels_end_at_one_and_never_fall() -> None:
    assert _holm({"a": 0.9, "b": 0.6, "c": 0.01}) == {"c": pytest.approx(0.03), "b": 1.0, "a": 1.0}
    assert _holm({"a": 0.02, "b": 0.03}) == {"a": pytest.approx(0.04), "b": pytest.approx(0.04)}


def test_the_noise_of_records_is_pooled_over_their_samples() -> None:
    spec = PlantSpec((), (Channel("y"), Channel("still")), 1.0)
    rng = np.random.default_rng(0)
    pairs, total, count = [], 0.0, 0
    for n, noise in ((40, 0.1), (160, 0.3)):
        clean = np.c_[rng.normal(size=n), np.zeros(n)]
        y = clean + noise * np.c_[rng.normal(size=n), np.zeros(n)]
        pairs.append((Trajectory(np.arange(float(n)), np.zeros((n, 0)), y, spec), dict(enumerate(clean))))
        total += n * np.mean((y - clean)[:, 0] ** 2) / np.var(y[:, 0])
        count += n
    assert noise_floor(pairs) == pytest.approx(np.sqrt(total / count))
