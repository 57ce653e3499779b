"""Fits say what their records do not determine: readings that are none, few moves, drifts; and nothing of others."""

from __future__ import annotations

import numpy as np
import pytest

from harness.judgement import feedback_of
from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
N = 1000
BLACK_BOXES = ("narx", "volterra", "random-forest", "prandtl-ishlinskii")


def record(u, seed=0, added=0.0):
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.5 * u[k - 1]
    y += 1e-3 * y.std() * np.random.default_rng(seed).normal(size=len(u))
    y = y + added * y.std()
    return Trajectory(np.arange(len(u)) * 1.0, u[:, None], y[:, None], SPEC)


def staircase(seed=0):
    return np.repeat(np.random.default_rng(seed).normal(size=N // 8), 8)


def warning(name, data):
    return create("identifiers", name).fit([data], rng=np.random.default_rng(0)).notes.get("warning", "")


@pytest.mark.parametrize("name", BLACK_BOXES)
def test_one_step_tells_a_model_without_an_order_nothing_of_other_inputs(name):
    assert "use a richer input" in warning(name, record((np.arange(N) > 300) * 1.0))


@pytest.mark.parametrize("name", [*BLACK_BOXES, "arx", "ho-kalman"])
def test_a_word_for_nothing_is_no_reading(name):
    once = np.where(np.arange(N) == 500, 1e4, 0.0)
    assert "readings that are none: run 0: y reads" in warning(name, record(staircase(), added=once))


@pytest.mark.parametrize("name", [*BLACK_BOXES, "arx", "n4sid", "ho-kalman", "impulse-response"])
def test_nothing_is_said_of_a_staircase(name):
    assert warning(name, record(staircase())) == ""


def test_a_drift_that_no_input_makes_is_said():
    data = record(staircase(), added=4 * np.linspace(0, 1, N))
    assert "a free run over the records that the model was fitted to" in warning("random-forest", data)


def test_a_curve_of_two_levels_is_a_guess():
    rng = np.random.default_rng(1)
    binary = np.repeat(rng.choice([0.0, 1.0], size=N // 5), 5)
    assert "takes two levels" in warning("random-forest", record(binary))
    assert warning("arx", record(binary)) == ""


def test_steps_of_one_length_are_no_feedback():
    found = [feedback_of([record(staircase(seed), seed)]) for seed in range(20)]
    assert not any(one.found for one in found)
    assert min(one.moves for one in found) > 50
