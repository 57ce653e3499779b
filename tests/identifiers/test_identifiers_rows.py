"""Figures of the textbook's systems that no other file asks for, each by its own row of the list."""

from __future__ import annotations

import numpy as np
import pytest

from harness import registry
from harness.models.estimate import estimate_of
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.ho_kalman import HoKalman
from identifiers.mechanics.lumped import lumped_torque


@pytest.fixture(scope="module")
def swing() -> Trajectory:
    """Return angles of a pendulum under a smooth torque, 0.1 mrad of noise."""
    scenario = registry.create("scenarios", "multisine", duration=8.0, amplitude=1.0, band=[0.05, 3.0], noise=1e-4)
    with registry.create("plants", "pendulum-ode") as plant:
        return run(plant, scenario, streams=Streams("pendulum", "multisine", seed=0), role="estimation/0").measured()


@pytest.mark.parametrize("smoothing", ["local", "spline", pytest.param("kalman", marks=pytest.mark.slow)])
def test_filtering_first_by_all_of_the_record_is_worth_much(swing, smoothing):
    """Row 2: state first, dynamics after, by local cubics, splines, or a Kalman filter with its backward pass."""
    truth, errors = {"J": 0.1, "b": 0.05, "mgl": 1.0}, {}
    for way in ("forward", smoothing):
        model = lumped_torque("pendulum", smoothing=way).fit([swing], rng=np.random.default_rng(0))
        errors[way] = max(abs(model.parameters[name] / value - 1) for name, value in truth.items())
    assert errors[smoothing] < 0.04, errors
    assert errors["forward"] > 20 * errors[smoothing], errors


@pytest.mark.slow
def test_the_iiwa_has_62_of_91_parameters_with_rotors_and_friction():
    """Row 12: 43 of 70 bodies', and inertia, damping and dry friction of seven joints."""
    pytest.importorskip("pybullet_data", reason="comes with pybullet (CPython 3.10 and 3.11 only)")
    from harness.physics.arms.arm import load_arm
    from identifiers.mechanics.arms.inertial import Inertial
    from scenarios.design import FourierReference

    arm, rng, t = load_arm("iiwa"), np.random.default_rng(0), 0.01 * np.arange(2000)
    reference = FourierReference(20.0, np.zeros(7), 0.3 * rng.normal(size=(7, 5)), 0.3 * rng.normal(size=(7, 5)))
    q, v, a = reference.at(t)
    torque = arm.torques(q, v, a) + 0.5 * v + 0.2 * np.sign(v) + 0.1 * a
    data = Trajectory(t, torque, np.hstack([q, v]), PlantSpec(arm.inputs, arm.states, 0.01))
    rank = estimate_of(Inertial(method="least-squares", motor_inertia=True).fit([data], rng=rng)).rank
    assert (rank.rank, rank.columns) == (62, 91)


def test_the_memory_of_an_observer_is_chosen_by_the_outputs_that_move():
    """Row 26, lag by validation: eight outputs of noise alone, whose errors no memory lowers, do not hide the other."""
    rng = np.random.default_rng(0)
    a, b = np.array([[0.995, 0.1], [-0.1, 0.995]]), np.array([[0.0], [0.1]])
    records = []
    for _ in range(9):
        u, x = rng.normal(size=(80, 1)), np.zeros((80, 2))
        for k in range(79):
            x[k + 1] = a @ x[k] + b @ u[k]
        y = 1e-3 * rng.normal(size=(80, 9))
        y[:, 0] += x[:, 0]
        spec = PlantSpec((Channel("u", "N"),), tuple(Channel(f"y{i}", "m") for i in range(9)), 0.1)
        records.append(Trajectory(0.1 * np.arange(80), u, y, spec))
    model = HoKalman(markov=30, order=2, observer="auto").fit(records, rng=rng)
    true = np.array([(np.linalg.matrix_power(a, k) @ b)[0, 0] for k in range(60)])
    found = model.impulse_response(61)[1:, 0, 0]
    assert model.notes["observer"] != "direct", "thirty samples do not hold the response"
    assert np.linalg.norm(found - true) < 0.02 * np.linalg.norm(true)
