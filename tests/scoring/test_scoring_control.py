"""What a model is worth for control: coordinates and units do not matter, wrong models cost, learning costs sqrt(T)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from harness.errors import InputError
from harness.models.lqr import lqr_cost_ratio, stabilisable
from harness.scoring.control import LinearPlantModel, control_regret, control_score
from identifiers.linear.least_squares import StateLeastSquares

A = np.array([[1.02, 0.1, 0.0], [0.0, 0.95, 0.2], [0.1, 0.0, 0.8]])
B = np.array([[0.0], [0.3], [1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
PLANT = LinearPlantModel(A, B, C, np.zeros((2, 1)))


def test_the_true_model_in_any_coordinates_costs_what_is_least():
    rng = np.random.default_rng(0)
    turn = rng.normal(size=(3, 3))
    same = LinearPlantModel(turn @ A @ np.linalg.inv(turn), turn @ B, C @ np.linalg.inv(turn), np.zeros((2, 1)))
    found = control_score(same, PLANT)
    assert found.status == "ok"
    assert found.ratio == pytest.approx(1.0, abs=1e-8)
    assert (found.order, found.controllable, found.observable) == (3, 3, 3)
    assert found.stabilisable
    assert found.detectable


def test_every_error_costs():
    rng = np.random.default_rng(1)
    for size in (0.01, 0.05):
        wrong = LinearPlantModel(A + size * rng.normal(size=(3, 3)), B, C, np.zeros((2, 1)))
        assert control_score(wrong, PLANT).ratio > 1.0 + 1e-7


def test_designs_that_fail_are_told_apart():
    negated = LinearPlantModel(A, -B, C, np.zeros((2, 1)))
    assert control_score(negated, PLANT).status == "unstable"
    dead = LinearPlantModel(A, 0 * B, C, np.zeros((2, 1)))
    found = control_score(dead, PLANT)
    assert (found.status, found.stabilisable, found.controllable) == ("no design", False, 0)
    assert found.ratio == np.inf
    blind = LinearPlantModel(A, B, 0 * C, np.zeros((2, 1)))
    assert not control_score(blind, PLANT).detectable
    with pytest.raises(InputError, match="no regulator"):
        control_score(PLANT, dead)
    with pytest.raises(InputError, match="2 outputs"):
        control_score(LinearPlantModel(A, B, C[:1], np.zeros((1, 1))), PLANT)


def test_units_of_the_channels_leave_the_score():
    rng = np.random.default_rng(3)
    wrong = A + 0.02 * rng.normal(size=(3, 3))
    scores = []
    for out in (np.eye(2), np.diag([1e3, 1e-2])):
        plant, model = (LinearPlantModel(a, B, out @ C, np.zeros((2, 1))) for a in (A, wrong))
        scores.append(control_score(model, plant).ratio)
    assert scores[1] == pytest.approx(scores[0], rel=1e-6)


def test_stabilisability_is_that_of_popov_belevitch_and_hautus():
    assert stabilisable(np.diag([0.9, 0.5]), np.zeros((2, 1)))
    assert not stabilisable(np.diag([1.0, 0.5]), np.array([[0.0], [1.0]]))
    assert stabilisable(np.diag([1.0, 0.5]), np.array([[1e-6], [1.0]]))


@pytest.mark.slow
def test_learning_while_controlling_costs_about_the_root_of_time():
    a, b = np.array([[1.01, 0.1], [0.0, 0.98]]), np.array([[0.0], [0.1]])
    k0 = np.array([[1.0, 2.0]])
    totals = {1000: [], 16000: []}
    for seed in range(4):
        for steps in totals:
            run = control_regret(
                StateLeastSquares(least_excitation=0.0),
                (a, b),
                steps=steps,
                rng=np.random.default_rng(seed),
                first_gain=k0,
            )
            totals[steps].append(run.total)
            assert len(run.designs) >= 4
    short, long = np.mean(totals[1000]), np.mean(totals[16000])
    assert 0 < short < long
    assert long / short < 10.0, "linear growth would be 16"
    wrong = lqr_cost_ratio((a, b), (a, b))
    assert wrong.ratio == pytest.approx(1.0)


def held(model, plant, q, r, sensor):
    """Return what the regulator of a model costs on a plant: its textbook gains, and both stepped to their spread."""
    a, b, c, d = (getattr(model, f"{name}_matrix") for name in "abcd")
    p = linalg.solve_discrete_are(a, b, c.T @ q @ c, r + d.T @ q @ d, s=c.T @ q @ d)
    gain = np.linalg.solve(r + d.T @ q @ d + b.T @ p @ b, b.T @ p @ a + d.T @ q @ c)
    p = linalg.solve_discrete_are(a.T, c.T, b @ b.T, sensor)
    watch = a @ p @ c.T @ np.linalg.inv(c @ p @ c.T + sensor)

    def step(both, pushed, noise):
        x, guess = both[: len(plant.a_matrix)], both[len(plant.a_matrix) :]
        u = -gain @ guess
        y = plant.c_matrix @ x + plant.d_matrix @ u
        surprise = y + noise - c @ guess - d @ u
        later = plant.a_matrix @ x + plant.b_matrix @ (u + pushed), a @ guess + b @ u + watch @ surprise
        return np.concatenate(later), np.concatenate([y, u])

    n, nu, ny = len(plant.a_matrix) + len(a), len(r), len(q)
    still, none, silent = np.zeros(n), np.zeros(nu), np.zeros(ny)
    loop = np.array([step(one, none, silent)[0] for one in np.eye(n)]).T
    told = np.array([step(one, none, silent)[1] for one in np.eye(n)]).T
    pushes = np.array([step(still, one, silent)[0] for one in np.eye(nu)]).T
    noises = np.array([step(still, none, one)[0] for one in np.eye(ny)]).T
    driven, spread = pushes @ pushes.T + noises @ sensor @ noises.T, np.zeros((n, n))
    for _ in range(2000):
        spread = loop @ spread @ loop.T + driven
    return float(np.trace(linalg.block_diag(q, r) @ told @ spread @ told.T))


@pytest.mark.parametrize("through", [0.0, 0.7])
def test_the_cost_is_that_of_the_loop_stepped_with_feedthrough_or_none(through):
    rng = np.random.default_rng(4)
    b = np.hstack([B, [[0.4], [0.0], [-0.2]]])
    plant = LinearPlantModel(A, b, C, through * rng.normal(size=(2, 2)))
    wrong = LinearPlantModel(A + 0.03 * rng.normal(size=(3, 3)), 1.2 * b, C, plant.d_matrix + through * 0.2)
    q, r, sensor = np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([0.5, 1.5]), np.array([[0.1, 0.02], [0.02, 0.3]])
    found = control_score(wrong, plant, q=q, r=r, sensor=sensor).ratio
    assert found == pytest.approx(held(wrong, plant, q, r, sensor) / held(plant, plant, q, r, sensor), rel=1e-6)


def test_an_output_that_no_input_moves_changes_nothing():
    rng = np.random.default_rng(0)
    wide = LinearPlantModel(A, B, np.vstack([C, np.zeros((2, len(A)))]), np.zeros((len(C) + 2, B.shape[1])))
    model = LinearPlantModel(A + 0.01 * rng.normal(size=A.shape), B, C, np.zeros((len(C), B.shape[1])))
    noise = 1e-3 * rng.normal(size=(2, len(A)))
    seen = LinearPlantModel(model.a_matrix, B, np.vstack([C, noise]), wide.d_matrix)
    assert control_score(seen, wide).ratio == pytest.approx(control_score(model, PLANT).ratio, rel=1e-9)
