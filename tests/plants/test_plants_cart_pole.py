"""pymunk cart-pole: the equations of motion as the step falls, energy, hidden constraints, snapshots."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.protocols import Experiment
from harness.rollout import perform
from harness.signals import FloatArray
from plants.pymunk.cart_pole import PymunkCartPole

RNG = np.random.default_rng


def push(n: int, dt: float) -> FloatArray:
    """Return a smooth force, held for each sample."""
    t = np.arange(n) * dt
    return (2.0 * np.sin(3.0 * t) + 1.0 * np.sin(5.3 * t))[:, None]


def equations(
    plant: PymunkCartPole, hidden: Callable[[FloatArray], tuple[float, float]]
) -> Callable[[float, FloatArray, float], FloatArray]:
    """Return d/dt of (x, theta, x', theta') with hidden forces on the cart and on the pole."""
    mc, mp, l, bx, bt = plant.true_parameters.values()  # noqa: E741

    def rate(_: float, z: FloatArray, u: float) -> FloatArray:
        sine, cosine = np.sin(z[1]), np.cos(z[1])
        force, torque = hidden(z)
        mass = np.array([[mc + mp, mp * l * cosine], [mp * l * cosine, mp * l**2]])
        right = [
            u - bx * z[2] + mp * l * z[3] ** 2 * sine + force,
            -bt * z[3] - mp * 9.81 * l * sine + torque,
        ]
        return np.concatenate([z[2:], np.linalg.solve(mass, right)])

    return rate


def reference(
    plant: PymunkCartPole,
    inputs: FloatArray,
    theta: float,
    hidden: Callable[[FloatArray], tuple[float, float]] = lambda z: (0.0, 0.0),
) -> FloatArray:
    """Return x and theta (N, 2) by an accurate solver."""
    from scipy.integrate import solve_ivp

    rate = equations(plant, hidden)
    z = np.array([0.0, theta, 0.0, 0.0])
    out = [z[:2]]
    for (u,) in inputs[:-1]:
        done = solve_ivp(partial(rate, u=u), (0, plant.spec.sample_time), z, rtol=1e-9, atol=1e-11, method="LSODA")
        z = done.y[:, -1]
        out.append(z[:2])
    return np.array(out)


CASES: dict[str, tuple[dict[str, float], Callable[[FloatArray], tuple[float, float]]]] = {
    "undamped": ({"bx": 0.0, "btheta": 0.0}, lambda z: (0.0, 0.0)),
    "damped": ({}, lambda z: (0.0, 0.0)),
    "spring on the cart": ({"spring_x": 3.0}, lambda z: (-3.0 * z[0], 0.0)),
    "spring on the pole": ({"spring_theta": 0.3}, lambda z: (0.0, -0.3 * z[1])),
    "dry cart": ({"friction_x": 0.4}, lambda z: (-0.4 * np.tanh(z[2] / 1e-3), 0.0)),
    "dry pin": ({"friction_theta": 0.05}, lambda z: (0.0, -0.05 * np.tanh(z[3] / 1e-3))),
    "light cart": ({"mc": 0.1, "mp": 0.5}, lambda z: (0.0, 0.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_the_error_falls_with_the_first_power_of_the_step(case: str) -> None:
    options, hidden = CASES[case]
    scale = 0.2 if case == "light cart" else 1.0
    inputs = scale * push(150, 0.02)
    errors = []
    for substeps in (10, 20, 40):
        with PymunkCartPole(sample_time=0.02, substeps=substeps, **options) as plant:
            log = perform(plant, Experiment(inputs, x0={"theta": 0.8}), rng=RNG(0))
            if not errors:
                truth = reference(plant, inputs, 0.8, hidden)
        errors.append(np.abs(log.y - truth).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 6e-3, errors
    assert orders.min() > 0.8, (errors, orders)


def test_an_undamped_plant_keeps_energy_and_momentum() -> None:
    drift = []
    for substeps in (5, 10, 20):
        with PymunkCartPole(bx=0.0, btheta=0.0, substeps=substeps) as plant:
            log = perform(plant, Experiment(np.zeros((300, 1)), x0={"theta": 2.0}), rng=RNG(0))
            mc, mp, l, _, _ = plant.true_parameters.values()  # noqa: E741
        assert log.x is not None
        _, theta, v, w = log.x.T
        kinetic = (mc + mp) * v**2 / 2 + mp * l * np.cos(theta) * v * w + mp * l**2 * w**2 / 2
        energy = kinetic - mp * 9.81 * l * np.cos(theta)
        drift.append(np.abs(energy - energy[0]).max())
        momentum = (mc + mp) * v + mp * l * np.cos(theta) * w
        assert np.abs(momentum).max() < 0.05 / substeps
    assert drift[0] > 1.7 * drift[1] > 2.9 * drift[2], drift
    assert drift[2] < 0.02, drift


def test_stops_hold_and_slack_plays() -> None:
    hard = 5.0 * np.ones((300, 1))
    with PymunkCartPole(stop_x=0.2) as plant:
        plant.reset(rng=RNG(0))
        assert plant.rollout(hard)[:, 0].max() < 0.21
    with PymunkCartPole(stop_theta=0.3) as plant:
        plant.reset(rng=RNG(0))
        assert np.abs(plant.rollout(push(300, 0.01) * 3)[:, 1]).max() < 0.32
    with PymunkCartPole(slack=0.02) as plant:
        assert [state.name for state in plant.spec.states][4:] == ["slip", "slip_rate"]
        log = perform(plant, Experiment(push(400, 0.01)), rng=RNG(0))
        assert log.x is not None
        slip = log.x[:, 4]
        assert slip.max() == pytest.approx(0.01, abs=2e-3)
        assert slip.min() == pytest.approx(-0.01, abs=2e-3)


def test_whole_turns_count() -> None:
    with PymunkCartPole(bx=0.0, btheta=0.0) as plant:
        plant.reset(rng=RNG(0), x0={"theta_rate": 15.0})
        assert plant.rollout(np.zeros((200, 1)))[-1, 1] > 2 * np.pi


@pytest.mark.parametrize(
    "options",
    [{"mc": 0.0}, {"mp": -1.0}, {"bx": -0.1}, {"substeps": 0}, {"slack": -1.0}, {"sample_time": 0.0}, {"l": np.nan}],
)
def test_options_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        PymunkCartPole(**options)


def test_a_closed_plant_says_so() -> None:
    plant = PymunkCartPole()
    plant.close()
    plant.close()
    with pytest.raises(PlantError, match="closed"):
        plant.step(np.zeros(1))
