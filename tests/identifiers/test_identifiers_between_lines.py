"""What a model says between the lines of its input, of inputs that follow from each other, and of loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harness import registry
from harness.errors import FitError, HarnessError
from harness.models.determined import bands_of, determined_bands
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
PAIR = PlantSpec((Channel("a"), Channel("b")), (Channel("y"),), 1.0)


def fitted(identifier: str, data: Trajectory, **options: Any) -> Any:
    return registry.create("identifiers", identifier, **options).fit([data], rng=np.random.default_rng(0))


def modes(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of two modes, one of them a resonance."""
    rng = np.random.default_rng(seed)
    radius, turn = rng.uniform(0.5, 0.95), rng.uniform(0.1, 2.0)
    a = np.diag([0.0, 0.0, rng.uniform(0.5, 0.95)])
    a[:2, :2] = radius * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return a, rng.normal(size=3), rng.normal(size=3)


def answered(u: FloatArray, seed: int, noise: float) -> Trajectory:
    (a, b, c), x, y = modes(seed), np.zeros(3), np.zeros(len(u))
    for k, now in enumerate(u):
        y[k] = c @ x
        x = a @ x + b * now
    y += noise * y.std() * np.random.default_rng([seed, 1]).normal(size=len(u))
    return Trajectory(np.arange(float(len(u))), u[:, None], y[:, None], SPEC)


def off(model: Any, seed: int) -> float:
    """Return the largest error of the response inside the bands, relative to the truth."""
    worst, (a, b, c) = 0.0, modes(seed)
    for low, high in bands_of(model)["y per u"]:  # type: ignore[index]
        frequency = np.linspace(max(low, 1e-4), high, 30)
        truth = np.array([c @ np.linalg.solve(np.exp(2j * np.pi * f) * np.eye(3) - a, b) for f in frequency])
        found = np.asarray(model.frequency_response(frequency))[:, 0, 0]
        worst = max(worst, float((np.abs(found - truth) / np.abs(truth)).max()))
    return worst


def lines(count: int, seed: int, n: int = 800) -> FloatArray:
    rng, k = np.random.default_rng([seed, count]), np.arange(n)[:, None]
    frequency = np.exp(rng.uniform(np.log(0.005), np.log(0.4), count))
    return np.sin(2 * np.pi * frequency * k + rng.uniform(0, 6.28, count)).sum(axis=1)


def test_a_few_lines_vouch_for_nothing_that_an_order_makes_up_between_them():
    wrong, fits = 0, 0
    for seed in range(12):
        data = answered(lines(1 + seed % 5, seed), seed, (0.0, 0.01, 0.05)[seed % 3])
        for name, options in (("arx", {}), ("arx", {"order": 4}), ("dmdc", {"delays": 2})):
            try:
                model = fitted(name, data, **options)
            except HarnessError:
                continue
            fits, wrong = fits + 1, wrong + (off(model, seed) > 0.5)
    assert fits > 15
    assert wrong <= 1


@pytest.mark.parametrize("kind", ["noise", "sweep", "steps"])
def test_inputs_without_gaps_have_no_gaps(kind):
    rng, k = np.random.default_rng(0), np.arange(2000)
    inputs = {
        "noise": rng.normal(size=2000),
        "sweep": np.sin(2 * np.pi * (0.002 * k + 0.2 * k**2 / 4000)),
        "steps": np.repeat(rng.normal(size=400), 5),
    }
    bands = bands_of(fitted("arx", answered(inputs[kind], 0, 0.01)))["y per u"]
    assert len(bands) == 1
    assert bands[0][1] - bands[0][0] > (0.15 if kind == "sweep" else 0.45)


def test_thirty_lines_determine_what_lies_between_them():
    data = answered(np.sin(2 * np.pi * np.linspace(0.005, 0.45, 30) * np.arange(2000)[:, None]).sum(axis=1), 1, 1e-3)
    assert sum(high - low for low, high in bands_of(fitted("arx", data))["y per u"]) > 0.4


def pair(second: str, n: int = 1000) -> Trajectory:
    rng = np.random.default_rng(3)
    a = np.repeat(rng.normal(size=n // 8), 8)
    late = {"late": np.r_[0.0, 0.0, a[:-2]], "summed": np.r_[0.0, 0.5 * (a[1:] + a[:-1])]}
    u, y = np.column_stack([a, late.get(second, rng.normal(size=n))]), np.zeros((n, 1))
    for k in range(n - 1):
        y[k + 1] = 0.8 * y[k] + u[k] @ [1.0, 0.5]
    return Trajectory(np.arange(float(n)), u, y, PAIR)


@pytest.mark.parametrize("second", ["late", "summed"])
@pytest.mark.parametrize("identifier", ["transfer-function", "impulse-response", "prediction-error", "narx"])
def test_an_input_that_follows_from_samples_of_another_is_refused(identifier, second):
    with pytest.raises(FitError, match=r"follows from samples of|depend|do not determine"):
        fitted(identifier, pair(second))


def test_a_late_copy_determines_no_input_by_itself():
    noise = 0.05 * np.random.default_rng(4).normal(size=(1000, 1))
    model = (np.array([[0.8]]), np.array([[1.0, 0.5]]), np.eye(1), np.zeros((1, 2)))
    near, apart = (
        determined_bands(model, [Trajectory(data.t, data.u, data.y + noise, PAIR)])
        for data in (pair("late"), pair("alone"))
    )
    for name in ("y per a", "y per b"):
        assert sum(high - low for low, high in apart[name]) > 0.45
        assert sum(high - low for low, high in near[name]) < 0.35


@pytest.mark.parametrize("count", [1, 2])
def test_an_impulse_response_of_few_lines_without_noise_says_where_it_is_determined(count):
    model = fitted("impulse-response", answered(lines(count, 7), 7, 0.0))
    assert sum(high - low for low, high in bands_of(model)["y per u"]) < 0.2


@pytest.mark.parametrize("identifier", ["wiener-hammerstein", "narx", "stlsq"])
def test_a_model_of_one_line_says_so(identifier):
    data = answered(np.sin(0.3 * np.arange(800)), 2, 0.01)
    try:
        model = fitted(identifier, data)
    except FitError:
        return
    assert "excite 2 lags" in model.notes["warning"]


def loop(dither: float, n: int = 2000) -> Trajectory:
    rng, x, u, y = np.random.default_rng(5), 0.0, np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y[k] = x + 1e-3 * rng.normal()
        u[k] = -3.0 * y[k] + dither * rng.normal()
        x = 0.9 * x + 0.2 * u[k, 0] + 0.1 * rng.normal()
    return Trajectory(np.arange(float(n)), u, y, SPEC)


def test_a_loop_that_is_moved_from_outside_determines_what_its_inputs_do():
    truth = tuple(np.full((1, 1), value) for value in (0.9, 0.2, 1.0, 0.0))
    wrong = tuple(np.full((1, 1), value) for value in (0.9, -0.2, 1.0, 0.0))
    moved = loop(1.0)
    assert sum(high - low for low, high in determined_bands(truth, [moved])["y per u"]) > 0.2
    assert determined_bands(wrong, [moved])["y per u"] == []
