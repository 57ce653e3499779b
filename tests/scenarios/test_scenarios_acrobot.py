"""The Acrobot under joint offsets: gains, steady errors and loss of stability as in the textbook."""

from __future__ import annotations

import numpy as np
import pytest

from harness import registry
from harness.errors import InputError, PlantError
from harness.rng import Streams
from harness.rollout import run
from scenarios.acrobot import AcrobotLqr

OUTPUTS = [["theta1", 0], ["theta2", 0], ["theta1", 1], ["theta2", 1]]


def held(offset: float, duration: float = 20.0, lean: float = 0.0):
    """Return the true states (N, 4) under an offset of both joints."""
    scenario = AcrobotLqr(offset=(offset, offset), duration=duration, lean=lean, tilt=0.0)
    with registry.create("plants", "ode", model="acrobot", sample_time=0.005, outputs=OUTPUTS) as plant:
        record = run(plant, scenario, streams=Streams("acrobot", "offset", 0), role="estimation/0")
    return record.y - np.array([np.pi, 0.0, 0.0, 0.0])


def test_linear_gains_from_offset_to_posture():
    """Row 7."""
    assert AcrobotLqr().steady_gains() == pytest.approx([23.0, -57.5], abs=0.05)


def test_steady_error_at_a_hundredth():
    """Row 7: (0.211, -0.530) rad."""
    assert held(0.01)[-1] == pytest.approx([0.211, -0.530, 0.0, 0.0], abs=1e-3)
    assert held(0.0, 2.0)[-1] == pytest.approx(np.zeros(4), abs=1e-9)
    assert held(0.001)[-1][:2] == pytest.approx(0.001 * AcrobotLqr().steady_gains(), rel=0.01)


def test_from_three_hundredths_on_the_posture_is_lost():
    late = np.abs(held(0.025, 25.0)[-1000:, 2:]).max()
    assert late < 0.05
    assert np.abs(held(0.035, 25.0)[-1000:, 2:]).max() > 0.5


def test_from_the_same_start_it_is_caught_below_three_hundredths_and_falls_there():
    """Row 7: falls from 0.03."""
    assert np.abs(held(0.025, 15.0, 0.09)[-500:, 2:]).max() < 0.05
    with pytest.raises(PlantError, match="fell after"):
        held(0.03, 15.0, 0.09)
    with pytest.raises(PlantError, match="fell after"):
        held(0.045, 15.0)


def test_bullets_acrobot_stays_up_without_measured_rates():
    """Somebody else's engine; the chapter's offset moves it as far."""
    scenario = AcrobotLqr(offset=(0.005, 0.005), duration=15.0)
    with registry.create("plants", "acrobot-bullet", sample_time=0.004) as plant:
        record = run(plant, scenario, streams=Streams("acrobot", "offset", 0), role="estimation/0")
    late = record.y[-500:].mean(axis=0)
    posture = [np.angle(np.exp(1j * (late[0] - np.pi))), late[1]]
    assert np.abs(posture)[0] < 0.3
    assert len(record) == 3750


def test_other_plants_are_refused():
    with registry.create("plants", "pendulum-ode") as plant, pytest.raises(InputError, match="use an Acrobot"):
        AcrobotLqr().prepare(plant.spec, streams=Streams("a", "b", 0), role="estimation/0")
