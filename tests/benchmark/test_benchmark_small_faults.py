"""Small faults of benchmarks that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from harness.benchmark.control import _regret
from harness.benchmark.row import Row
from harness.benchmark.summary import summarise
from harness.scoring.control import LinearPlantModel
from harness.signals import FloatArray
from identifiers.linear.least_squares import StateLeastSquares


def lines(scores: dict[str, list[float]]) -> dict[str, bool]:
    """Return which identifier leads."""
    rows = [
        Row(job=f"{name}{seed}", plant="p", scenario="s", identifier=name, seed=seed, status="ok", reason="",
            simulation_error=score, noise_floor=0.01)
        for name, values in scores.items() for seed, score in enumerate(values)
    ]  # fmt: skip
    return {line.identifier: line.leading for line in summarise(rows)}


def test_the_true_model_leads_nobody() -> None:
    seeds = np.random.default_rng(0).uniform(0.9, 1.1, 8)
    scores = {"arx": list(seeds), "dmdc": list(9.0 * seeds**2)}
    alone = lines(scores)
    assert alone == {"arx": True, "dmdc": False}
    assert lines({"true-model": list(0.01 * seeds**3), **scores}) == {"true-model": False, **alone}


def plant(a: list[list[float]]) -> LinearPlantModel:
    """Return a plant whose states are measured."""
    return LinearPlantModel(np.array(a), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))


def cost(truth: LinearPlantModel, model: object, size: FloatArray | None = None) -> float | None:
    """Return the regret of learning to control a plant, its states and inputs of one size unless given."""
    return _regret(StateLeastSquares(), model, truth, np.ones(3) if size is None else size, np.random.default_rng(0))


@pytest.mark.parametrize("a", [[[0.9, 0.1], [0.0, 0.8]], [[1.1, 0.1], [0.0, 0.8]]])
def test_whoever_learns_pays_the_same_in_any_unit_whether_the_plant_is_stable_or_not(a: list[list[float]]) -> None:
    truth = plant(a)
    paid = cost(truth, truth)
    assert paid is not None
    assert paid > 0.0
    # the unit of a state is none of the learner's business
    size, change = np.array([10.0, 0.1, 5.0]), np.array([10.0, 0.1])
    scaled = LinearPlantModel(
        truth.a_matrix * change[:, None] / change, truth.b_matrix * change[:, None] / 5.0, np.eye(2), np.zeros((2, 1))
    )
    assert cost(scaled, scaled, size) == pytest.approx(paid, rel=1e-6)


def test_where_states_are_not_measured_there_is_no_regret() -> None:
    truth = plant([[0.9, 0.1], [0.0, 0.8]])
    seen = LinearPlantModel(truth.a_matrix, truth.b_matrix, np.eye(2)[:1], np.zeros((1, 1)))
    assert cost(truth, seen) is None
    smaller = SimpleNamespace(
        a_matrix=np.eye(1), b_matrix=np.ones((1, 1)), c_matrix=np.eye(1), d_matrix=np.zeros((1, 1))
    )
    assert cost(truth, smaller) is None
