"""Small faults of scores that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.errors import FitError
from harness.models.distributions import Categories
from harness.scoring import linearise, predict
from harness.scoring.bound import LinearTruth, _root_covariance
from harness.scoring.control import control_regret, pulse_sizes
from harness.scoring.predictive import forecast, probability_score, reliability
from harness.scoring.regret import Regret, regret
from harness.scoring.regulation import StateFeedback, regulation_costs
from harness.scoring.rounds import interleaved
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.finite.mdp import MdpModel
from identifiers.online.rls import RecursiveLeastSquares
from plants.equations.linear import LinearPlant

A, B = np.array([[0.7, 0.4], [-0.4, 0.7]]), np.array([[0.0, 0.3], [1.0, -0.2]])
EYE = np.eye(1)
TWO = (Channel("a"), Channel("b"))
HOLD = PlantSpec((), (Channel("y"),), 1.0)
C, D = np.array([[1.0, 0.5], [0.0, 2.0]]), np.array([[0.25, 0.0], [0.0, -1.5]])


def test_a_linear_plant_is_linearised_to_itself_in_states_and_outputs() -> None:
    with LinearPlant(A=A, B=B, C=C, D=D, sample_time=0.1) as plant:
        found = linearise(plant)
    for own, wanted in zip((found.a_matrix, found.b_matrix, found.c_matrix, found.d_matrix), (A, B, C, D), strict=True):
        np.testing.assert_allclose(own, wanted, atol=1e-8)


def test_the_size_of_a_pulse_counts_what_answers_at_once_and_what_comes_later() -> None:
    with LinearPlant(A=A, B=B, C=C, D=D, sample_time=0.1) as plant:
        found = pulse_sizes(linearise(plant))
    markov = [D, C @ B, C @ A @ B, C @ A @ A @ B]
    assert found == pytest.approx(np.sqrt(sum((one**2).sum(axis=1) for one in markov)), rel=1e-6)


def test_a_cost_counts_what_is_away_and_what_is_pushed() -> None:
    plant = LinearPlant(A=[[0.5]], B=[[1.0]])
    controller = StateFeedback(plant.spec, np.array([[0.2]]), np.array([1.0]), np.array([0.5]))
    q, r = np.array([[2.0]]), np.array([[3.0]])
    found = regulation_costs(
        plant, controller, [{"x1": 4.0}], steps=3, q=q, r=r, target=np.array([1.0]), hold=np.array([0.5])
    )
    cost, x = 0.0, 4.0
    for _ in range(3):
        u = float(controller.act(np.array([x]))[0])
        assert u != 0.5
        cost += 2.0 * (x - 1.0) ** 2 + 3.0 * (u - 0.5) ** 2
        x = 0.5 * x + u
    assert found == pytest.approx([cost])


def test_an_output_of_a_million_is_gone() -> None:
    for growth, gone in ((0.99e6, False), (1.01e6, True)):
        plant = LinearPlant(A=[[growth]], B=[[1.0]])
        still = StateFeedback(plant.spec, np.zeros((1, 1)), np.zeros(1), np.zeros(1))
        (found,) = regulation_costs(
            plant, still, [{"x1": 1.0}], steps=1, q=EYE, r=EYE, target=np.zeros(1), hold=np.zeros(1)
        )
        assert np.isinf(found) == gone


def test_directions_that_only_change_the_coordinates_tell_nothing_however_large() -> None:
    nx, nu, ny = 2, 1, 3
    truth = LinearTruth(
        0.5 * np.eye(nx), np.ones((nx, nu)), np.ones((ny, nx)), np.zeros((ny, nu)), np.eye(nx), np.eye(ny), nx,
        np.eye(nx),
    )  # fmt: skip
    information = np.random.default_rng(0).normal(size=(50, nx * (nx + nu + ny)))
    root = _root_covariance(truth, information)
    assert root.shape == (nx * (nx + nu + ny), nx * (nu + ny))
    assert root.T @ information.T @ information @ root == pytest.approx(np.eye(nx * (nu + ny)))


class Cubic:
    """``x+ = x^3 + u^3``: a central difference of a step s errs by s^2."""

    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0, (Channel("x"),))
    abilities = frozenset({"truth"})

    def reset(self, *, rng: np.random.Generator, x0: dict[str, float]) -> FloatArray:
        self.x = np.array([x0["x"]])
        return self.x

    def step(self, u: FloatArray) -> FloatArray:
        self.x = self.x**3 + u**3
        return self.x

    def truth(self) -> FloatArray:
        return self.x


def test_who_says_nothing_of_step_noise_or_horizon_gets_what_is_documented() -> None:
    """Another default is another figure under a name that was published."""
    found = linearise(Cubic(), x0={"x": 1.0}, u0=np.ones(1))
    assert [found.a_matrix[0, 0] - 3.0, found.b_matrix[0, 0] - 3.0] == pytest.approx([1e-8] * 2, rel=1e-2)

    class Fits:
        def fit(self, records: Any, *, rng: np.random.Generator) -> Any:
            return SimpleNamespace(a_matrix=A, b_matrix=B, c_matrix=np.eye(2))

    def learned(**more: Any) -> Any:
        return control_regret(Fits(), (A, B), steps=120, rng=np.random.default_rng(0), **more)

    assert learned().costs.tolist() == learned(noise=0.1, first=50, excitation=1.0).costs.tolist()
    assert learned().designs == (50, 100)
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=1),), 1.0)
    data = Trajectory(
        np.arange(90.0), np.zeros((90, 0)), np.random.default_rng(0).integers(0, 2, (90, 1)).astype(float), spec
    )
    model = MdpModel(spec, np.array([[[0.93, 0.07]], [[0.36, 0.64]]]), np.ones((2, 1)))
    table = np.array([[0.93, 0.07], [0.36, 0.64]])
    said = forecast(model, data)
    assert isinstance(said, Categories)
    assert said.tables[0] == pytest.approx(table[data.y[:-1, 0].astype(int)])
    assert np.array_equal(predict(model, data), predict(model, data, 1), equal_nan=True)
    score = probability_score(model, data)
    assert (score.horizon, score.samples, score.levels.tolist()) == (1, 89, [0.5, 0.8, 0.9, 0.95])
    assert reliability(model, data).count.tolist() == reliability(model, data, horizon=1, bins=10).count.tolist()
    stream = [Trajectory(data.t, data.u, np.random.default_rng(1).normal(size=(90, 1)), HOLD)]
    curves = [regret(RecursiveLeastSquares(), stream, rng=np.random.default_rng(0), **more).steps
              for more in ({}, {"points": 24})]  # fmt: skip
    assert curves[0].tolist() == curves[1].tolist()
    record = Trajectory(np.arange(9.0), np.ones((9, 2)), np.ones((9, 2)), PlantSpec(TWO, TWO, 1.0))
    assert len(interleaved(Fits(), lambda *_: record, (A, B), np.zeros((2, 2)), rng=np.random.default_rng(0))) == 5


def test_a_slope_needs_three_points_after_the_burn_in() -> None:
    steps = np.array([1.0, 2.0, 4.0, 8.0])
    found = Regret(np.ones(8), np.zeros(8), exact=True, steps=steps, curve=5.0 + 3.0 * np.log(steps))
    assert found.slope(2) == pytest.approx(3.0)
    with pytest.raises(FitError, match="at least 3 points"):
        found.slope(3)
