"""Fits to loops: what is biased or hidden says so by one judge, and open loops are left alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.judgement import feedback_of
from harness.models.spread import gains
from harness.registry import create
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.loops import doubt_of_loop

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
FULL = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 0.1)
A, B = np.array([[0.95, 0.2], [-0.1, 0.8]]), np.array([0.0, 1.0])
RNG = np.random.default_rng(0)
SAID = ("Under feedback", "that the controller does not set explains", "inputs respond to the outputs")


def record(
    seed: int, *, gain: float = 0.4, dither: float = 1.0, load: float = 0.1, whole: bool = True, n: int = 1000
) -> Trajectory:
    """A plant of two states under ``u = dither - gain (q + v)``, pushed by white noise."""
    rng = np.random.default_rng(seed)
    x, u, y = np.zeros(2), np.zeros((n, 1)), np.zeros((n, 2))
    for k in range(n):
        y[k] = x + 1e-3 * rng.normal(size=2)
        u[k] = dither * rng.normal() - gain * y[k].sum()
        x = A @ x + B * u[k] + load * rng.normal(size=2)
    return Trajectory(0.1 * np.arange(n), u, y if whole else y[:, :1], FULL if whole else SPEC)


def warning_of(name: str, data: Trajectory, **options: Any) -> str:
    model: Any = create("identifiers", name, **options).fit([data], rng=np.random.default_rng(0))
    return str(model.notes.get("warning", ""))


def said(text: str) -> bool:
    return any(part in text for part in SAID)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("least-squares", {}),
        ("arx", {"order": 1}),
        ("dmdc", {}),
        ("edmdc", {}),
        ("piecewise-affine", {"starts": 1, "modes": 1}),
        ("narx", {"lags": 1}),
    ],
)
def test_a_model_too_small_for_the_plant_says_that_the_loop_biases_it(name, options):
    assert "correlated in time" in warning_of(name, record(1, gain=0.3, load=0.5, whole=False), **options)


def test_total_least_squares_that_takes_the_controller_for_the_plant_says_so():
    assert said(warning_of("least-squares", record(2, load=1.0), method="tls"))


@pytest.mark.parametrize(("name", "options"), [("least-squares", {}), ("arx", {"order": 1}), ("dmdc", {})])
def test_a_loop_that_hardly_moves_from_outside_is_said_to_hide_the_plant(name, options):
    data = record(1, dither=0.3, load=1.0)
    assert "hardly shows beside the load" in warning_of(name, data, **options)
    assert not warning_of(name, data, least_excitation=0.0, **options)


@pytest.mark.parametrize(("name", "options"), [("piecewise-affine", {"starts": 1}), ("stlsq", {"time": "discrete"})])
def test_models_without_a_spread_say_that_the_load_hides_the_plant(name, options):
    assert "hardly shows beside the load" in warning_of(name, record(2, dither=0.3, load=1.0), **options)


@pytest.mark.parametrize(("name", "options"), [("n4sid", {"order": 2}), ("arx", {"order": 2}), ("narx", {"lags": 2})])
def test_an_output_that_answers_within_the_sample_is_said_to_look_like_a_controller(name, options):
    rng = np.random.default_rng(5)
    x, u, y = np.zeros(2), rng.normal(size=(1000, 1)), np.zeros((1000, 1))
    for k in range(1000):
        y[k] = x.sum() + 2.0 * u[k] + rng.normal()
        x = A @ x + 0.2 * B * u[k]
    undeclared, declared = (replace(SPEC, feedthrough=one) for one in (False, True))
    data = Trajectory(0.1 * np.arange(1000), u, y, undeclared)
    assert "feedthrough = true" in warning_of(name, data, **options)
    if name == "n4sid":
        assert not warning_of(name, replace(data, spec=declared), direct=True, **options)


def held_at_rest(seed: int, load: float = 0.03) -> Trajectory:
    """A nearly integrating plant under a strong controller: what it does slowly does not show."""
    rng, n = np.random.default_rng(seed), 1000
    x, u, y = 0.0, np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y[k] = x
        u[k] = 0.3 * rng.normal() - 4.0 * x
        x = 0.98 * x + 0.1 * u[k, 0] + load * rng.normal()
    return Trajectory(0.1 * np.arange(n), u, y, SPEC)


def test_a_plant_whose_first_answers_are_known_needs_no_warning_though_its_gain_at_rest_is_not():
    model: Any = create("identifiers", "least-squares").fit([held_at_rest(0)], rng=np.random.default_rng(0))
    assert "warning" not in model.notes
    assert model.b_matrix[0, 0] == pytest.approx(0.1, rel=0.2)
    rest = np.array([1e-3])
    away = [abs(gains(one, rest, 1.0) - gains(model.matrices, rest, 1.0)).item() for one in model.spread.models]
    assert np.sqrt(model.spread.factor * np.sum(np.square(away))) > 0.5 * abs(gains(model.matrices, rest, 1.0)).item()


def test_narx_that_needs_few_terms_is_judged_by_these_and_not_by_all_that_it_could_take():
    data = held_at_rest(2, load=0.15)
    model: Any = create("identifiers", "narx", lags=3).fit([data], rng=np.random.default_rng(0))
    assert model.terms == (("y[k]", "u[k]"),)
    assert model.natural[0, model.names.index("u[k]")] == pytest.approx(0.1, rel=0.1)
    assert "warning" not in model.notes
    assert "hardly shows beside the load" in warning_of("arx", data, order=3)


def test_narx_that_leaves_an_input_out_for_the_load_hides_it_says_so():
    model: Any = create("identifiers", "narx", lags=3).fit([held_at_rest(1, load=0.2)], rng=np.random.default_rng(0))
    assert model.terms == (("y[k]",),)
    assert "hardly shows beside the load" in model.notes["warning"]


@pytest.mark.parametrize("seed", [0, 6, 7])
def test_arx_takes_no_early_answer_for_a_delay_where_outputs_foretell_inputs(seed):
    model: Any = create("identifiers", "arx").fit([record(seed, gain=0.3, load=0.5, whole=False)], rng=RNG)
    assert model.notes["delay"] == 1


def test_functions_that_only_hold_noise_are_no_part_of_an_output():
    model: Any = create("identifiers", "edmdc").fit([record(1)], rng=RNG)
    assert model.notes["linear"] == ["q", "v"]
    assert not model.a_matrix[:2, 3:].any()  # beyond the outputs and the constant
    assert not model.spread.a[:, :2, 3:].any()
    assert model.spread.a[:, :2, :3].std(axis=0).min() > 0


def test_functions_that_an_output_follows_stay_in_it():
    rng, y = np.random.default_rng(3), np.zeros((800, 1))
    u = rng.normal(size=y.shape)
    for k in range(799):
        y[k + 1] = 0.7 * y[k] - 0.05 * y[k] ** 2 + 0.3 * u[k] + 0.02 * rng.normal()
    model: Any = create("identifiers", "edmdc").fit([Trajectory(0.1 * np.arange(800), u, y, SPEC)], rng=RNG)
    assert "linear" not in model.notes
    assert model.a_matrix[0, 2]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_a_loop_that_is_moved_and_a_model_that_holds_the_plant_need_no_warning(seed):
    data = record(seed, gain=0.3, load=0.5, n=600)
    assert feedback_of([data]).found
    model: Any = create("identifiers", "least-squares").fit([data], rng=np.random.default_rng(0))
    text = str(model.notes.get("warning", ""))
    assert not said(text) or float(text.split("probability ")[1].split()[0]) > 1e-5  # chance, one in a thousand


def open_inputs(kind: str, n: int, rng: np.random.Generator) -> FloatArray:
    k = np.arange(n)
    if kind == "sweep":
        return np.asarray(np.sin(2 * np.pi * (0.002 * k + 0.1 * k**2 / n)))
    if kind == "steps":
        return np.asarray(np.repeat(rng.normal(size=n // 50 + 1), 50)[:n])
    if kind == "lines":
        return np.asarray(np.sin(0.2 * k) + np.sin(0.7 * k) + np.sin(1.5 * k))
    return rng.normal(size=n)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["white", "steps", "sweep", "lines"]), st.booleans())
def test_no_open_loop_is_taken_for_a_loop(seed, kind, whole):
    rng, n = np.random.default_rng(seed), 600
    u, x, y = open_inputs(kind, n, rng), np.zeros(2), np.zeros((n, 2))
    for k in range(n):
        y[k] = x + 0.02 * rng.normal(size=2)
        x = A @ x + B * u[k] + 0.05 * rng.normal(size=2)
    data = Trajectory(0.1 * np.arange(n), u[:, None], y if whole else y[:, :1], FULL if whole else SPEC)
    for name, options in (("arx", {"order": 1}), ("dmdc", {"delays": 2})):
        assert not said(warning_of(name, data, **options, least_excitation=1e-9))


def test_errors_that_the_dither_explains_are_found_and_others_are_not():
    data = record(5, load=1.0)
    model: Any = create("identifiers", "least-squares").fit([data], rng=np.random.default_rng(0))
    feedback = feedback_of([data])
    assert not doubt_of_loop(model, [data], feedback)
    wrong: Any = create("identifiers", "least-squares", least_excitation=0.0).fit(
        [Trajectory(data.t, 0.5 * data.u, data.y, data.spec)], rng=np.random.default_rng(0)
    )
    assert said(doubt_of_loop(wrong, [data], feedback))


def held(n: int = 1000) -> Trajectory:
    """A resonance of gain 1 under a PI law, its set-point stepped every 60 samples, under a load of its input."""
    rng, x, u, y = np.random.default_rng(5), np.zeros(2), np.zeros((n, 1)), np.zeros((n, 1))
    a, b, c = np.array([[0.619, 0.403], [-0.403, 0.619]]), np.array([-4.009, -1.019]), np.array([-0.191, -0.051])
    load, total, point = 0.0, 0.0, 0.0
    for k in range(n):
        y[k] = c @ x + 0.01 * rng.normal()
        point = rng.normal() if k % 60 == 0 else point
        total += 0.057 * (point - y[k, 0])
        u[k] = 0.911 * (point - y[k, 0]) + total
        x = a @ x + b * (u[k, 0] + load)
        load = 0.97 * load + 0.3 * rng.normal()
    return Trajectory(0.1 * np.arange(n), u, y, SPEC)


def test_errors_that_answer_the_set_point_by_less_than_a_third_are_said():
    model: Any = create("identifiers", "prediction-error", structure="bj", order=1).fit([held()], rng=RNG)
    assert "that the controller does not set explains" in str(model.notes.get("warning", ""))
