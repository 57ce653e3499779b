"""Readings that are missing: what stands in their place decides nothing, and the others are enough."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.errors import FitError
from harness.models.spread import gains
from harness.registry import create
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
STATES = PlantSpec((Channel("u", "V"),), (Channel("x", "m"), Channel("v", "m")), 0.1)
FITS: list[tuple[str, dict[str, Any]]] = [
    ("arx", {"order": 2}),
    ("arx", {}),
    ("least-squares", {}),
    ("dmdc", {}),
    ("dmdc", {"rank": 2}),
    ("edmdc", {"degree": 1}),
    ("n4sid", {"order": 2}),
    ("ho-kalman", {"order": 2, "markov": 25}),
    ("ho-kalman", {"order": 2, "markov": 60}),
    ("ho-kalman", {"order": 2, "markov": 25, "observer": 4}),
    ("prediction-error", {"order": 2}),
    ("prediction-error", {"order": 2, "structure": "armax"}),
    ("prediction-error", {"order": 2, "structure": "bj"}),
]
OF_STATES = ("least-squares", "dmdc", "edmdc")


def _times(n: int) -> FloatArray:
    return np.asarray(np.arange(n) * 0.1, dtype=np.float64)


def record(seed: int, states: bool, n: int = 600) -> Trajectory:
    """Return a record of poles .75 +- .37i with a little noise: of one output, or with both states measured."""
    rng = np.random.default_rng(seed)
    u = np.sum([np.sin(2 * np.pi * f * np.arange(n) / 300 + f**2) for f in range(1, 150)], axis=0)[:, None] / 9
    if not states:
        y = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u[:, 0]) + 0.05 * rng.normal(size=n)
        return Trajectory(_times(n), u, y[:, None], SPEC)
    x = np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = [x[k, 1], -0.7 * x[k, 0] + 1.5 * x[k, 1] + u[k, 0]] + 0.02 * rng.normal(size=2)
    return Trajectory(_times(n), u, x, STATES)


def holed(whole: Trajectory, share: float, seed: int, garbage: float) -> Trajectory:
    """Return the record with readings missing at random and in one long gap, numbers of no meaning in their place."""
    rng = np.random.default_rng(seed)
    gone = rng.random(whole.y.shape) < share
    gone[200:230] = True
    return replace(whole, y=np.where(gone, garbage * rng.normal(size=gone.shape), whole.y), missing=gone)


@pytest.mark.parametrize(("name", "options"), FITS, ids=lambda part: str(part))
@settings(max_examples=1, deadline=None)
@given(share=st.sampled_from([0.01, 0.04]), seed=st.integers(0, 99))
def test_a_fit_learns_from_what_was_read_alone(name: str, options: dict[str, Any], share: float, seed: int) -> None:
    whole = record(seed, name in OF_STATES)
    models: list[Any] = [
        create("identifiers", name, **options).fit([holed(whole, share, seed, garbage)], rng=np.random.default_rng(0))
        for garbage in (0.0, 100.0)
    ]
    for one, other in zip(models[0].matrices, models[1].matrices, strict=True):
        assert np.array_equal(one, other)
    assert models[0].notes["missing"]["readings"] > 30
    frequency = np.array([0.1, 0.4, 1.0])
    truth: Any = create("identifiers", name, **options).fit([whole], rng=np.random.default_rng(0))
    wanted = gains(truth.matrices, frequency, 0.1)
    assert gains(models[0].matrices, frequency, 0.1) == pytest.approx(wanted, rel=0.15, abs=0.15 * np.abs(wanted).min())


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_a_controller_is_still_seen_through_holes(share: float) -> None:
    rng, n = np.random.default_rng(1), 1200
    u, y = np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n - 1):
        u[k] = -0.4 * y[k]
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k] + 0.3 * rng.normal()
    data = Trajectory(_times(n), u, y + 0.01 * rng.normal(size=y.shape), SPEC)
    data = replace(data, missing=rng.random(y.shape) < share)
    for name in ("arx", "n4sid", "ho-kalman", "prediction-error"):
        with pytest.raises(FitError):
            create("identifiers", name).fit([data], rng=np.random.default_rng(0))


def test_what_is_hardly_ever_read_is_refused_in_words() -> None:
    data = replace(record(0, False), missing=np.arange(600)[:, None] % 3 > 0)
    with pytest.raises(FitError, match="without a missing reading"):
        create("identifiers", "arx", order=2).fit([data], rng=np.random.default_rng(0))
    model: Any = create("identifiers", "prediction-error", order=2).fit([data], rng=np.random.default_rng(0))
    assert model.eigenvalues == pytest.approx([0.75 + 0.3708j, 0.75 - 0.3708j], abs=0.02)
