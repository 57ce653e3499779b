"""A model along a motion: exact where the plant is linear and varies, honest about one motion and about feedback."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from harness.errors import FitError
from harness.scoring import equation_error, predict, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import simulate_linear, tempered_systems
from identifiers.linear.time_varying import AlongTrajectory, AlongTrajectoryModel

RNG = np.random.default_rng(0)
N = 50
SPEC = PlantSpec((Channel("u", "N"),), (Channel("q", "m"), Channel("v", "m/s")), 0.1)


def matrices(k):
    a = np.array([[0.9, 0.1], [-0.2 * np.sin(0.1 * k), 0.8]])
    return a, np.array([[0.0], [1.0 + 0.5 * np.cos(0.1 * k)]]), np.array([0.1 * np.sin(0.3 * k), 0.0])


def repetition(seed, *, noise=0.0, gain=None, start=1.0, t0=0.0, n=N):
    rng = np.random.default_rng(seed)
    u, x = rng.normal(size=(n, 1)), np.zeros((n, 2))
    x[0] = start * rng.normal(size=2)
    for k in range(n - 1):
        a, b, c = matrices(k)
        u[k] = u[k] if gain is None else gain @ x[k]
        x[k + 1] = a @ x[k] + b @ u[k] + c
    u[-1] = u[-1] if gain is None else gain @ x[-1]
    return Trajectory(t0 + np.arange(n) * 0.1, u, x + noise * rng.normal(size=x.shape), SPEC)


def test_what_varies_is_found_exactly_and_predicts_new_inputs():
    model = AlongTrajectory(width=0).fit([repetition(seed) for seed in range(6)], rng=RNG)
    for k in (0, 13, N - 2):
        a, b, c = matrices(k)
        assert model.coefficients[k].T == pytest.approx(np.hstack([a, b, c[:, None]]), abs=1e-9)
    assert simulation_error(model, repetition(99)).nrmse.max() < 1e-9
    late = repetition(98)[20:]
    assert simulation_error(model, late).nrmse.max() < 1e-9, "the time of a record says where on the motion it begins"


def test_the_width_is_found_by_what_was_left_out():
    few = AlongTrajectory().fit([repetition(seed, noise=0.05) for seed in range(6)], rng=RNG)
    assert few.notes["width"] in (2, 4, 8, 16)
    true = np.array([np.hstack(matrices(k)[:2]) for k in range(N - 1)])
    errors = {}
    for width in (0, few.notes["width"]):
        model = AlongTrajectory(width=width).fit([repetition(seed, noise=0.05) for seed in range(6)], rng=RNG)
        errors[width] = np.sqrt(np.mean((model.coefficients[:, :3].transpose(0, 2, 1) - true) ** 2))
    assert errors[few.notes["width"]] < 0.5 * errors[0]


@given(tempered_systems(measured_state=True, tempers=("stable", "lightly damped", "stiff", "slow", "unstable")))
@settings(max_examples=10)
def test_what_does_not_vary_is_found_too(system):
    records = [simulate_linear(system, 40, rng=np.random.default_rng(seed)) for seed in range(8)]
    model = AlongTrajectory().fit(records, rng=RNG)
    held = simulate_linear(system, 40, rng=np.random.default_rng(99))
    assert equation_error(model, held).nrmse.max() < 1e-5


def test_positions_alone_need_two_lags():
    plain = [repetition(seed, start=0.0) for seed in range(8)]
    spec = PlantSpec(SPEC.inputs, SPEC.outputs[:1], 0.1)
    seen = [Trajectory(one.t, one.u, one.y[:, :1], spec) for one in plain]
    held = seen.pop()
    error = {n: equation_error(AlongTrajectory(order=n, width=0).fit(seen, rng=RNG), held).nrmse[0] for n in (1, 2)}
    assert error[2] < 1e-6 < error[1]
    model = AlongTrajectory(order=2, width=0).fit(seen, rng=RNG)
    along = model.along(N)
    u, size = np.zeros((N, 1)), 1e-3
    base = predicted(model, u)
    u[20] = size
    assert (predicted(model, u) - base)[:, 0] == pytest.approx(along.lifted()[:, 20] * size, abs=1e-12)


def predicted(model, u):
    x, rows = np.zeros(2 * 1 + 1 + 1), []
    for value in u:
        rows.append(model.output(x, value))
        x = model.step(x, value)
    return np.array(rows)


def test_one_by_one_and_many_at_once_step_alike_and_a_description_restores_the_model():
    model = AlongTrajectory().fit([repetition(seed, noise=0.01) for seed in range(5)], rng=RNG)
    x = np.array([[1.0, -1.0, 3.0], [0.5, 0.2, 40.0], [0.0, 1.0, 500.0]])
    u = np.array([[1.0], [-1.0], [0.5]])
    many = model.step(x, u)
    for row in range(3):
        assert np.array_equal(model.step(x[row], u[row]), many[row])
    again = AlongTrajectoryModel.from_dict(model.to_dict())
    held = repetition(77)
    assert np.array_equal(predict(again, held, 3), predict(model, held, 3), equal_nan=True)


def test_pure_feedback_equal_repetitions_and_different_beginnings_are_refused():
    law = np.array([[-0.3, -0.5]])
    with pytest.raises(FitError, match="do not determine"):
        AlongTrajectory().fit([repetition(seed, gain=law, noise=1e-6) for seed in range(6)], rng=RNG)
    same = repetition(0)
    with pytest.raises(FitError, match="do not differ"):
        AlongTrajectory().fit([same, replace(same, t=same.t), same], rng=RNG)
    with pytest.raises(FitError, match="begin at different times"):
        AlongTrajectory().fit([repetition(0), repetition(1, t0=5.0)], rng=RNG)


@pytest.mark.parametrize("options", [{"order": 0}, {"width": -1}])
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(FitError, match="along-trajectory: options"):
        AlongTrajectory(**options).fit([repetition(0)], rng=RNG)
