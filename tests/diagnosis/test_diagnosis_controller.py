"""Records that show a controller: said at the head, certain for a model that takes all of itself from the records."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.records.controller_check import check_controller
from harness.physics.models import linear, oscillator
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory


def regulated(seed, *, filtered=0.0, dither=0.0, names=("u", "y"), n=800):
    rng = np.random.default_rng(seed)
    u, y, command, load, x = np.zeros((n, 1)), np.zeros((n, 1)), 0.0, 0.0, 0.0
    for k in range(n):
        y[k] = x + 0.01 * rng.normal()
        command = filtered * command - (1 - filtered) * 2.0 * y[k, 0]
        u[k] = command + dither * rng.normal()
        load = 0.95 * load + 0.3 * rng.normal()
        x = 0.9 * x + 0.1 * (u[k, 0] + load)
    spec = PlantSpec((Channel(names[0], "N"),), (Channel(names[1], "m"),), 1.0)
    return Trajectory(np.arange(float(n)), u, y, spec)


def dataset(**options):
    return Dataset("loop", (Run(regulated(1, **options)), Run(regulated(2, **options), use="validation")))


@pytest.mark.parametrize("filtered", [0.0, 0.6])
def test_a_black_box_is_told_for_certain_that_the_data_show_the_controller(filtered):
    doubts = check_controller(dataset(filtered=filtered), linear(1).system())
    assert [doubt.certain for doubt in doubts] == [True]
    assert doubts[0].words.startswith("these data show the controller: u = ")
    assert "add an excitation" in doubts[0].words


def test_physics_is_warned_and_an_excited_loop_is_not():
    assert [doubt.certain for doubt in check_controller(dataset(), oscillator().system())] == [False]
    assert check_controller(dataset(dither=1.0), linear(1).system()) == []
