"""Noise has the level and the colour that was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.signals import Channel, PlantSpec
from scenarios.noise import coloured_noise, per_channel, process_disturbance, sensor

SPEC = PlantSpec((Channel("u", "N"), Channel("w", "N")), (Channel("q", "m"), Channel("theta", "rad")), 0.01)


def test_coloured_noise_is_stationary_from_the_first_sample() -> None:
    pole = np.exp(-2 * np.pi * 2.0 * 0.01)
    draws = np.array([coloured_noise(20, 0.01, 2.0, rng=np.random.default_rng(i)) for i in range(8000)])
    assert draws.std(axis=0) == pytest.approx(np.ones(20), abs=0.05)
    assert np.mean(draws[:, 0] * draws[:, 5]) == pytest.approx(pole**5, abs=0.05)


def test_process_noise_relative_and_absolute() -> None:
    excitation = np.column_stack([np.sin(np.arange(20_000)), 3 + np.zeros(20_000)])
    made = process_disturbance(SPEC, excitation, rms={"w": 0.5}, ratio={"u": 0.1}, rng=np.random.default_rng(0))
    assert made is not None
    assert made.std(axis=0) == pytest.approx([0.1 * excitation[:, 0].std(), 0.5], rel=0.03)
    assert process_disturbance(SPEC, excitation, rng=np.random.default_rng(0)) is None
    with pytest.raises(InputError, match="at rest"):
        process_disturbance(SPEC, excitation, ratio=0.1, rng=np.random.default_rng(0))


def test_sensor_adds_noise_then_rounds_and_repeats() -> None:
    made = sensor(SPEC, 5000, noise={"q": 0.1}, quantisation={"theta": 0.25}, rng=np.random.default_rng(0))
    assert made is not None
    y = np.array([1.0, 0.6])
    measured = np.array([made(k, y) for k in range(5000)])
    assert measured[:, 0].std() == pytest.approx(0.1, rel=0.05)
    assert set(measured[:, 1]) == {0.5}
    np.testing.assert_array_equal(made(7, y), made(7, y))


@pytest.mark.parametrize("value", [{"nobody": 1.0}, {"q": -1.0}, {"q": "loud"}, {"q": True}])
def test_bad_levels_are_refused(value: dict[str, float]) -> None:
    with pytest.raises(InputError, match="noise"):
        sensor(SPEC, 10, noise=value, rng=np.random.default_rng(0))


def test_a_category_takes_no_noise() -> None:
    spec = PlantSpec((), (Channel("cell", minimum=0, maximum=3, kind="category"),), 1.0)
    with pytest.raises(InputError, match="category"):
        sensor(spec, 10, noise=0.1, rng=np.random.default_rng(0))


def test_per_channel_number_for_all() -> None:
    assert per_channel(2, SPEC.inputs, "amplitude").tolist() == [2.0, 2.0]
