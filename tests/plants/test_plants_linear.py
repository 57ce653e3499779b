"""Linear plants from matrices: noise of the declared covariance, feedthrough, refusals, the golden record."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from plants.equations.linear import LinearPlant

RNG = np.random.default_rng
A = [[0.9, 0.2], [-0.1, 0.7]]
B = [[0.0], [1.0]]
C = [[1.0, 0.5]]


def noisy(**options):
    return LinearPlant(**{"A": A, "B": B, "C": C, "Q": [[0.04, 0.01], [0.01, 0.09]], "R": [[0.25]], **options})


def test_noise_has_the_declared_covariance():
    n = 40_000
    with noisy() as plant:
        plant.reset(rng=RNG(1))
        y, x = plant.rollout_truth(np.zeros((n, 1)))
    w = x[1:] - x[:-1] @ np.array(A).T
    v = y[:, 0] - x @ np.array(C)[0]
    assert np.cov(w.T) == pytest.approx(np.array([[0.04, 0.01], [0.01, 0.09]]), abs=4 * 0.09 * np.sqrt(2 / n))
    assert np.var(v) == pytest.approx(0.25, rel=4 * np.sqrt(2 / n))


def test_feedthrough_answers_at_once_and_is_declared():
    with LinearPlant(A=A, B=B, C=C, D=[[2.0]]) as plant:
        assert plant.spec.feedthrough
        assert "feedthrough" in plant.abilities
        plant.reset(rng=RNG(0), x0={"x1": 1.0})
        assert plant.output(np.array([3.0])).tolist() == [7.0]
        assert plant.truth().tolist() == [1.0, 0.0]
    assert not LinearPlant(A=A, B=B, C=C, D=[[0.0]]).spec.feedthrough


@pytest.mark.parametrize(
    "options",
    [
        {"A": [[1.0, 2.0]]},
        {"B": [[1.0]]},
        {"C": [[1.0]]},
        {"D": [[1.0, 2.0]]},
        {"Q": [[1.0, 2.0], [2.0, 1.0]]},
        {"Q": [[1.0, 0.5], [0.0, 1.0]]},
        {"R": [[np.nan]]},
        {"states": ["a"]},
        {"initial": {"x3": 1.0}},
        {"sample_time": 0.0},
    ],
)
def test_matrices_that_do_not_fit_are_refused(options):
    with pytest.raises(InputError):
        noisy(**options)


def test_an_unstable_system_diverges_by_name():
    with LinearPlant(A=[[1e200]], B=[[1.0]]) as plant:
        plant.reset(rng=RNG(0), x0={"x1": 1.0})
        plant.step(np.zeros(1))
        with pytest.raises(PlantError) as caught:
            plant.step(np.zeros(1))
        assert caught.value.status == "diverged"
        plant.reset(rng=RNG(0), x0={"x1": 1.0})
        assert not np.isfinite(plant.rollout(np.zeros((3, 1)))[-1, 0])
