"""Small faults of scoring that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.models.distributions import NormalMixture
from harness.scoring.acceptance import Demands
from harness.scoring.bound import LinearTruth, least_errors, linear_truth
from harness.scoring.predictive import _marginal
from harness.signals import Channel, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def record(rng: np.random.Generator, n: int = 400) -> Trajectory:
    u, x = rng.normal(size=(n, 1)), np.zeros((n, 1))
    for k in range(n - 1):
        x[k + 1] = 0.8 * x[k] + u[k]
    return Trajectory(np.arange(float(n)), u, x + 0.1 * rng.normal(size=(n, 1)), SPEC, x)


def test_whoever_learns_from_data_errs_more_than_whoever_knows_in_free_run_and_ahead() -> None:
    one = np.eye(1)
    truth = LinearTruth(0.8 * one, one, one, 0 * one, 0 * one, 0.01 * one, 1, 0 * one)
    data = record(np.random.default_rng(0))
    found = least_errors(truth, [data[:60]], [data[60:]])
    assert found is not None
    assert 1.0 < found.simulation / found.known_simulation < 1.1
    assert 1.0 < found.equation / found.known_equation < 1.1


def test_no_bound_without_true_states_or_with_outputs_that_are_no_numbers() -> None:
    data = record(np.random.default_rng(0), 20)
    assert linear_truth(None, [Trajectory(data.t, data.u, data.y, SPEC)], [None]) is None
    spec = PlantSpec((Channel("u"),), (Channel("y", kind="category", maximum=1.0, minimum=0.0),), 1.0)
    words = Trajectory(data.t, data.u, np.round(np.abs(data.y) > 1).astype(float), spec, data.x)
    assert linear_truth(None, [words], [None]) is None


@pytest.mark.parametrize(("share", "fits"), [(0.0, True), (0.05, True), (1.0, True), (-0.01, False), (1.01, False)])
def test_a_share_is_a_number_from_nought_to_one(share: float, fits: bool) -> None:
    if fits:
        assert Demands(max_share=share).anything
    else:
        with pytest.raises(InputError, match="from 0 to 1"):
            Demands(max_share=share)


def test_an_error_or_a_share_at_its_limit_passes() -> None:
    asked = Demands(max_error={"T": "2 degC", "y": "3 cm"}, max_share=0.25)
    for more, passed in ((0.0, True), (1e-3, False)):
        errors = {"T": (2.0 + more, "K"), "y": (0.03 + more, "m")}
        assert [one.passed for one in asked.of_errors("run", errors)] == [passed, passed]
        (*_, share) = Demands(max_share=0.25).of_report("run", {"explained_share": 0.75 - more})
        assert share.passed == passed
    (unknown,) = Demands(max_share=1.0).of_report("run", {})
    assert not unknown.passed


def test_the_distribution_that_forgets_the_order_has_each_outputs_own_spread() -> None:
    spec = PlantSpec((), (Channel("a"), Channel("b")), 1.0)
    y = np.random.default_rng(0).normal(size=(500, 2)) * [1.0, 20.0] + [3.0, -2.0]
    found = _marginal(spec, y)
    assert isinstance(found, NormalMixture)
    assert found.mean == pytest.approx(np.broadcast_to(y.mean(axis=0), y.shape))
    assert found.std == pytest.approx(np.broadcast_to(y.std(axis=0), y.shape))
