"""What a model is worth for control: coordinates and units do not matter, wrong models cost, learning costs sqrt(T)."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.models.lqr import lqr_cost_ratio, stabilisable
from harness.registry import create
from harness.scoring.control import LinearPlantModel, control_regret, control_score, linearise
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


def test_every_error_costs_and_the_cost_is_that_of_a_simulation():
    rng = np.random.default_rng(1)
    for size in (0.01, 0.05):
        wrong = LinearPlantModel(A + size * rng.normal(size=(3, 3)), B, C, np.zeros((2, 1)))
        found = control_score(wrong, PLANT)
        assert found.ratio > 1.0 + 1e-7
    q, r, sensor = np.eye(2), np.eye(1), 0.01 * np.eye(2)
    own, worse = (control_score(m, PLANT, q=q, r=r, sensor=sensor) for m in (PLANT, wrong))
    assert worse.ratio > own.ratio
    from harness.models.lqr import kalman_gain, lqr_gain

    costs = []
    for model in (PLANT, wrong):
        gain = lqr_gain(model.a_matrix, B, C.T @ q @ C, r)
        watch = kalman_gain(model.a_matrix, C, B @ B.T, sensor)
        loop = np.block(
            [[A, -B @ gain], [watch @ C, model.a_matrix - B @ gain - watch @ C]]
        )  # of the plant and its guess
        draw = np.random.default_rng(2)
        pushes = np.hstack([draw.normal(size=(60_000, 1)) @ B.T, 0.1 * draw.normal(size=(60_000, 2)) @ watch.T])
        states = np.zeros((60_001, 6))
        for k, push in enumerate(pushes):
            states[k + 1] = loop @ states[k] + push
        costs.append(np.sum((states[:, :3] @ C.T) ** 2) + np.sum((states[:, 3:] @ gain.T) ** 2))
    assert costs[1] / costs[0] == pytest.approx(worse.ratio, rel=0.05)


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


def test_a_plant_is_linearised_where_it_stands():
    with create("plants", "pendulum-ode", sample_time=0.02) as plant:
        found = linearise(plant)
        assert control_score(found, found).ratio == pytest.approx(1.0)
        again = linearise(plant, size=1e-5)
    assert np.abs(found.a_matrix - again.a_matrix).max() < 1e-6
    rates = np.log(np.linalg.eigvals(found.a_matrix)) / 0.02
    # theta'' = -(g / l) theta - (b / m l^2) theta' about hanging: a lightly damped swing
    assert np.abs(rates.imag).min() > 1.0
    assert -1.0 < rates.real.max() < 0.0


def test_stabilisability_is_that_of_popov_belevitch_and_hautus():
    assert stabilisable(np.diag([0.9, 0.5]), np.zeros((2, 1)))
    assert not stabilisable(np.diag([1.0, 0.5]), np.array([[0.0], [1.0]]))
    assert stabilisable(np.diag([1.0, 0.5]), np.array([[1e-6], [1.0]]))


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


def test_an_output_that_no_input_moves_changes_nothing():
    rng = np.random.default_rng(0)
    wide = LinearPlantModel(A, B, np.vstack([C, np.zeros((2, len(A)))]), np.zeros((len(C) + 2, B.shape[1])))
    model = LinearPlantModel(A + 0.01 * rng.normal(size=A.shape), B, C, np.zeros((len(C), B.shape[1])))
    noise = 1e-3 * rng.normal(size=(2, len(A)))
    seen = LinearPlantModel(model.a_matrix, B, np.vstack([C, noise]), wide.d_matrix)
    assert control_score(seen, wide).ratio == pytest.approx(control_score(model, PLANT).ratio, rel=1e-9)
