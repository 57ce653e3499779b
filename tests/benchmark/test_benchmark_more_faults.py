"""Small faults of benchmarks that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import pytest

from harness.benchmark.parts import Cell, ScoreSettings, SuitePart, Task
from harness.benchmark.records import make_records, noise_floor
from harness.benchmark.row import Row
from harness.benchmark.statistics import _holm, enough_pairs, standings
from harness.benchmark.work import CellBatch
from harness.scoring import least_errors, linear_truth
from harness.signals import Channel, PlantSpec, Trajectory
from plants.equations.linear import LinearPlant

SPRING: dict[str, Any] = {"A": [[0.9, 0.2], [-0.3, 0.8]], "B": [[0.1], [0.5]], "C": [[1.0, 0.0]], "sample_time": 0.1}


class Desk:
    """What a worker hands its rows to."""

    def __init__(self) -> None:
        self.rows: dict[str, Row] = {}

    @contextmanager
    def shared(self) -> Iterator[None]:
        yield

    @contextmanager
    def job(self, job: str) -> Iterator[None]:
        yield

    def put(self, job: str, content: bytes) -> None:
        self.rows[job] = msgspec.json.decode(content, type=Row)


def worked(*names: str, options: dict[str, Any] | None = None, **score: Any) -> tuple[Task, dict[str, Row]]:
    """Return a task of a linear plant whose output is measured with noise, and the rows of its identifiers."""
    plant, scenario = SuitePart("linear", options or SPRING), SuitePart("prbs", {"samples": 120, "noise": 0.2})
    made = Task(plant, scenario, 3, ScoreSettings(**score), 60.0, tuple(Cell(name, SuitePart(name)) for name in names))
    desk: Any = Desk()
    CellBatch(made, trace=True).work(desk)
    return made, desk.rows


def test_what_a_worker_writes_of_a_place_and_its_identifiers() -> None:
    made, rows = worked("true-model", "rls", "nobody", runs=2, held_out=3, curve=6)
    records = make_records(made)
    assert [len(one) for one in (*records.runs, *records.held_out)] == [120] * 5
    first, *others = (one.y for one in (*records.runs, *records.held_out))
    assert not any(np.allclose(first, other) for other in others)
    with LinearPlant(**SPRING) as plant:
        noise = [one.y - one.x @ plant.C.T for one in records.held_out if one.x is not None]
        truth = linear_truth(plant, [*records.runs, *records.held_out], [None] * 5)
    floor = np.sqrt(np.mean([np.mean(own**2) / one.y.var() for own, one in zip(noise, records.held_out, strict=True)]))
    assert truth is not None
    least = least_errors(truth, records.runs, records.held_out)
    assert least is not None
    for row in rows.values():
        assert row.noise_floor == pytest.approx(floor)
        assert (row.least_simulation_error, row.least_equation_error) == pytest.approx(
            (least.simulation, least.equation)
        )
        assert (row.samples, row.held_out_samples, row.seed) == (240, 360, 3)
        assert row.data_seconds > 0
        assert 10 < (row.memory_mib or 0) < 100_000
    true, online, nobody = rows.values()
    assert (true.status, online.status, nobody.status) == ("ok", "ok", "refused")
    assert true.simulation_error == pytest.approx(floor, rel=0.1)
    assert "unknown identifier" in nobody.reason
    assert (true.regret, nobody.regret) == (None, None)
    assert online.regret is not None
    assert online.average_regret == pytest.approx(online.regret / 238)
    assert online.curve_steps[-1] == 238
    assert len(online.curve_steps) <= 6
    assert (true.control_status, true.horizon) == ("", None)


def test_a_bound_of_free_runs_is_none_of_windows() -> None:
    _, rows = worked("hold", horizon=1.0)
    row = rows["hold"]
    assert (row.horizon, row.least_simulation_error) == (1.0, None)
    assert row.least_equation_error is not None


def test_a_plant_that_cannot_be_made_is_the_row_of_every_identifier() -> None:
    _, rows = worked("hold", "arx", options={"mass": 1})
    for name, row in rows.items():
        assert (row.identifier, row.status, row.samples) == (name, "refused", None)
        assert row.reason.startswith("no data: ")
        assert "mass" in row.reason


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
