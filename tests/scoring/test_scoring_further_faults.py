"""Small faults of scores that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import linearise
from harness.scoring.control import pulse_sizes
from harness.scoring.regret import Regret
from harness.scoring.regulation import StateFeedback, regulation_costs
from plants.equations.linear import LinearPlant

A, B = np.array([[0.7, 0.4], [-0.4, 0.7]]), np.array([[0.0, 0.3], [1.0, -0.2]])
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


def test_a_slope_needs_three_points_after_the_burn_in() -> None:
    steps = np.array([1.0, 2.0, 4.0, 8.0])
    found = Regret(np.ones(8), np.zeros(8), exact=True, steps=steps, curve=5.0 + 3.0 * np.log(steps))
    assert found.slope(2) == pytest.approx(3.0)
    with pytest.raises(FitError, match="at least 3 points"):
        found.slope(3)
