"""Closed-loop scenarios stabilise the engines that they were made for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.errors import InputError, PlantError
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, PlantSpec, Trajectory

pytest.importorskip("pybullet", reason="pybullet has wheels for CPython 3.10 and 3.11 only")


def record(
    plant: str, scenario: str, *, role: str = "estimation/0", seed: int = 0, options: Any = None, **choices: Any
) -> Trajectory:
    made = registry.create("scenarios", scenario, **choices)
    with registry.create("plants", plant, **(options or {})) as engine:
        return run(engine, made, streams=Streams(plant, scenario, seed), role=role)


@pytest.mark.parametrize("plant", ["cart-pole-pymunk", "cart-pole-ode"])
def test_the_pole_stays_up_and_is_excited(plant: str) -> None:
    data = record(plant, "cart-pole-lqr", duration=10.0, noise=5e-4)
    x, theta = data.y.T
    tilt = np.mod(theta, 2 * np.pi) - np.pi
    assert np.abs(tilt).max() < 0.5
    assert tilt[200:].std() > 0.005
    assert np.abs(x).max() < 2.0
    assert np.linalg.matrix_rank(np.cov(np.column_stack([x, tilt, data.u[:, 0]]).T)) == 3


def test_runs_differ_and_repeat() -> None:
    one = record("cart-pole-pymunk", "cart-pole-lqr", duration=2.0)
    again = record("cart-pole-pymunk", "cart-pole-lqr", duration=2.0)
    other = record("cart-pole-pymunk", "cart-pole-lqr", duration=2.0, role="validation/0")
    np.testing.assert_array_equal(one.y, again.y)
    assert not np.array_equal(one.u, other.u)


def test_a_pole_that_falls_ends_the_run_with_a_status() -> None:
    with pytest.raises(PlantError, match="the pole fell") as caught:
        record("cart-pole-pymunk", "cart-pole-lqr", duration=5.0, mp=5.0, l=3.0, tilt=0.3)
    assert caught.value.status == "terminated"


def reference_error(scenario: str, **choices: Any) -> tuple[float, Trajectory]:
    """Return the rms distance of the joints from the reference after it faded in."""
    data = record("iiwa-bullet", scenario, duration=4.0, **choices)
    made = registry.create("scenarios", scenario, duration=4.0, **choices)
    rng = Streams("iiwa-bullet", scenario, 0)("estimation/0/excitation")
    moves = made._reference(len(data), data.spec, list(range(7)), rng=rng)
    late = len(data) // 4
    return float(np.sqrt(np.mean((data.y[late:, :7] - data.y[0, :7] - moves[0, late:]) ** 2))), data


@pytest.mark.parametrize(("scenario", "bound"), [("arm-computed-torque", 0.06), ("arm-pd", 0.12)])
def test_the_arm_follows_its_reference(scenario: str, bound: float) -> None:
    error, data = reference_error(scenario)
    assert error < bound
    assert data.y[:, :7].std(axis=0).min() > 0.01
    limits = np.array([channel.maximum for channel in data.spec.inputs])
    assert (np.abs(data.u) <= limits).all()


def test_rates_are_estimated_where_they_are_not_measured() -> None:
    data = record("iiwa-bullet", "arm-computed-torque", duration=4.0)
    positions = record("iiwa-bullet", "arm-computed-torque", duration=4.0, options={"outputs": ["q"]})
    assert positions.spec.ny == 7
    assert np.abs(positions.y - data.y[:, :7]).max() < 0.1


def test_pd_with_given_gains_needs_no_model() -> None:
    data = record("arm-bullet", "arm-pd", duration=3.0, kp=20.0, kd=2.0, gravity_compensation=False)
    assert 0.01 < data.y.std() < 1.0
    with pytest.raises(InputError, match="give urdf"):
        record("arm-bullet", "arm-pd", duration=1.0)


def test_a_given_inverse_dynamics_is_used() -> None:
    calls = []

    def model(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        calls.append(q)
        return 0.1 * a

    record("arm-bullet", "arm-computed-torque", duration=0.2, inverse_dynamics=model)
    assert len(calls) == 50


@pytest.mark.parametrize("scenario", ["arm-pd", "arm-computed-torque", "cart-pole-lqr"])
def test_plants_that_do_not_fit_are_refused(scenario: str) -> None:
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.01)
    with pytest.raises(InputError, match="does not fit the plant"):
        registry.create("scenarios", scenario).prepare(spec, streams=Streams("p", "s", 0), role="test/0")


def test_a_reference_beyond_the_joint_range_is_refused() -> None:
    spec = PlantSpec((Channel("u", "N m"),), (Channel("q", "rad", -0.1, 0.1),), 0.01)
    made = registry.create("scenarios", "arm-pd", kp=1.0, kd=1.0, gravity_compensation=False, samples=500)
    controller = made.prepare(spec, streams=Streams("p", "s", 0), role="test/0").controller
    with pytest.raises(InputError, match="reference of joint 'q'"):
        controller(0.0, np.zeros(1))
