"""The smoother of filterpy as a source of derivatives: better than differences, no worse than its noise allows."""

from __future__ import annotations

import numpy as np
import pytest

from harness.physics.models import pendulum
from harness.signals import PlantSpec, Trajectory
from identifiers.mechanics.lumped import lumped_torque
from identifiers.mechanics.motion import rts


def test_rate_and_acceleration_beat_differences_by_far() -> None:
    dt, sigma = 0.01, 2e-3
    t = np.arange(1500) * dt
    truth = np.sin(2.0 * t) + 0.3 * np.cos(5.0 * t)
    rate = 2.0 * np.cos(2.0 * t) - 1.5 * np.sin(5.0 * t)
    noisy = truth + sigma * np.random.default_rng(3).normal(size=t.size)
    value, first, second = rts(noisy, dt)
    inner = slice(50, -50)
    assert np.std((value - truth)[inner]) < 0.5 * sigma
    assert np.std((first - rate)[inner]) < 0.2 * np.std((np.gradient(noisy, dt) - rate)[inner])
    assert np.std((second + 4.0 * np.sin(2.0 * t) + 7.5 * np.cos(5.0 * t))[inner]) < 0.8


@pytest.mark.parametrize("seed", [0, 1])
def test_lumped_parameters_from_noisy_positions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    system = pendulum().system()
    u = np.repeat(rng.normal(size=(120, 1)), 15, axis=0)
    y = system.simulator(0.01, backend="casadi").rollout([0.2, 0.05, 1.0], [0.3, 0.0], u)
    noisy = y + 1e-3 * rng.normal(size=y.shape)
    data = Trajectory(np.arange(len(u)) * 0.01, u, noisy, PlantSpec(system.inputs, system.outputs, 0.01))
    found = lumped_torque(model="pendulum", smoothing="kalman").fit([data], rng=rng).parameters
    assert found["J"] == pytest.approx(0.2, rel=0.05)
    assert found["mgl"] == pytest.approx(1.0, rel=0.05)
