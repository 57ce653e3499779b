"""Fits say what their records do not determine: readings that are none, few moves, drifts; and nothing of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.judgement import feedback_of
from harness.registry import create
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.common.judge.own_record import doubt_of_own_record

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


CALM = ("narx", "volterra", "prandtl-ishlinskii", "arx", "n4sid", "ho-kalman", "impulse-response")


@pytest.mark.parametrize("name", CALM)
def test_nothing_is_said_of_a_staircase(name):
    assert warning(name, record(staircase())) == ""


def test_a_forest_that_leaves_a_sixth_of_what_the_input_does_is_said():
    """It errs by a third under a fresh staircase; the test asks whether it is more than a tenth."""
    assert "if it were 10 %" in warning("random-forest", record(staircase()))


@pytest.mark.parametrize("name", ["arx", "n4sid"])
def test_readings_that_are_none_are_noted_where_they_did_no_harm(name):
    y = record(staircase())
    few = y.y.copy()
    few[400:460] = few[400]
    notes = create("identifiers", name).fit([replace(y, y=few)], rng=np.random.default_rng(0)).notes
    assert "warning" not in notes
    assert "y stands still" in notes["odd_readings"]


def test_of_right_models_one_in_a_thousand_is_warned_of():
    """A model off by just what is right (a gain of 0.9): the error is tested, not that there is one."""
    model = create("identifiers", "arx", order=2).fit([record(staircase())], rng=np.random.default_rng(0))
    said = {}
    for gain in (0.9, 0.8):
        off = replace(model, c_matrix=model.c_matrix * gain, output_offset=model.output_offset * gain)
        said[gain] = 0
        for seed in range(20):
            data = record(staircase(seed), seed)
            whole = [np.ones(data.y.shape, dtype=bool)]
            said[gain] += bool(doubt_of_own_record(off, [data], feedback_of([data]), whole))
    assert said[0.9] <= 1
    assert said[0.8] == 20


def test_a_drift_that_no_input_makes_is_said():
    data = record(staircase(), added=4 * np.linspace(0, 1, N))
    assert "a free run over the model's own estimation records" in warning("random-forest", data)


@pytest.mark.parametrize("name", ["arx", "n4sid", "prediction-error"])
def test_inputs_that_move_nothing_are_said(name):
    """A record that wanders beside an input that it never saw got a model and not a word; one in twenty may."""
    said = 0
    for seed in range(8):
        rng, y = np.random.default_rng(seed), np.zeros(N)
        for k in range(1, N):
            y[k] = 0.9 * y[k - 1] + rng.standard_normal()
        said += "nothing shows that the inputs move y" in warning(name, replace(record(staircase(100)), y=y[:, None]))
    assert said >= 6


@pytest.mark.parametrize("dead", [0, 30])
def test_a_faint_answer_is_no_silence(dead):
    """An input that makes a third of the variance, or an output that answers later than the test looks."""
    noise = np.random.default_rng(5).standard_normal((N, 1))
    data = record(staircase())
    answer = np.roll(data.y, dead, axis=0)
    faint = replace(data, y=answer + (1.4 if dead == 0 else 0.2) * answer.std() * noise)
    assert "nothing tells" not in warning("prediction-error", faint)


def test_a_curve_of_two_levels_is_a_guess():
    rng = np.random.default_rng(1)
    binary = np.repeat(rng.choice([0.0, 1.0], size=N // 5), 5)
    assert "takes two levels" in warning("random-forest", record(binary))
    assert warning("arx", record(binary)) == ""


def test_steps_of_one_length_are_no_feedback():
    found = [feedback_of([record(staircase(seed), seed)]) for seed in range(20)]
    assert not any(one.found for one in found)
    assert min(one.moves for one in found) > 50
