"""Outputs that hold noise alone decide nothing: no order, no direction, no pole."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import registry
from harness.protocols import Model
from harness.scoring import simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

A = np.array([[0.8, 0.3], [-0.3, 0.8]])
B = np.array([0.5, 1.0])


def record(idle: int, noise: float, loudness: float, seed: int) -> Trajectory:
    """Return two states of an oscillator with sensor noise, a share of their size, and outputs of noise alone."""
    rng = np.random.default_rng(seed)
    n = 600
    u, x = rng.normal(size=n), np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = A @ x[k] + B * u[k]
    seen = x + noise * x.std(axis=0) * rng.normal(size=x.shape)
    y = np.hstack([seen, loudness * rng.normal(size=(n, idle))])
    spec = PlantSpec((Channel("u"),), tuple(Channel(f"y{i}") for i in range(2 + idle)), 0.1)
    return Trajectory(np.arange(n) * 0.1, u[:, None], y, spec)


def wrong(model: Model, loudness: float) -> FloatArray:
    """Return what is wrong in how two outputs answer an impulse, or in a free run of another record, over its size."""
    if not hasattr(model, "impulse_response"):
        return simulation_error(model, record(model.spec.ny - 2, 0.0, loudness, 1000)).nrmse[:2]
    true, state = np.zeros((40, 2)), B
    for k in range(1, 40):
        true[k], state = state, A @ state
    return (np.asarray(model.impulse_response(40))[:, :2, 0] - true) / np.linalg.norm(true)


FITS: dict[str, tuple[str, dict[str, Any]]] = {
    "arx": ("arx", {}),
    "dmdc": ("dmdc", {"rank": 2}),
    "total-dmd": ("dmdc", {"rank": "auto", "total": "auto"}),
    "dmdc-delays": ("dmdc", {"delays": 2}),
    "least-squares": ("least-squares", {}),
    "iv": ("least-squares", {"method": "iv"}),
    "tls": ("least-squares", {"method": "tls"}),
    "n4sid": ("n4sid", {}),
    "parsim": ("n4sid", {"method": "parsim"}),
    "pbsid": ("n4sid", {"method": "pbsid"}),
    "ho-kalman": ("ho-kalman", {"markov": 60}),
    "okid": ("ho-kalman", {"markov": 60, "observer": 10}),
    "prediction-error": ("prediction-error", {"structure": "state-space", "order": 2}),
    "armax": ("prediction-error", {"structure": "armax", "order": 2}),
    "oe": ("prediction-error", {"structure": "oe", "order": 2}),
    "impulse-response": ("impulse-response", {"length": 50, "kernel": "tc"}),
    "transfer-function": ("transfer-function", {"order": 2, "delay": 0.0}),
    "stlsq": ("stlsq", {"time": "discrete", "degree": 1}),
    "edmdc": ("edmdc", {}),
    "piecewise-affine": ("piecewise-affine", {"modes": 1}),
    "along-trajectory": ("along-trajectory", {}),
}
"""Every identifier of linear models, and those that are linear here."""


@pytest.mark.parametrize("fit", FITS)
@settings(max_examples=2, deadline=None)
@given(
    idle=st.integers(1, 10),
    noise=st.sampled_from([1e-4, 1e-3, 1e-2]),
    loudness=st.sampled_from([1e-3, 1.0, 1e4]),
    seed=st.integers(0, 999),
)
def test_outputs_of_noise_alone_leave_the_answer_within_what_noise_leaves_open(fit, idle, noise, loudness, seed):
    name, options = FITS[fit]
    alone, beside = (
        registry.create("identifiers", name, **options).fit(
            [record(count, noise, loudness, seed)], rng=np.random.default_rng(0)
        )
        for count in (0, idle)
    )
    found = wrong(alone, loudness)
    # ten idle regressors of 600 rows: each takes a share of 1 / 600 of the noise's square into the answer
    assert np.linalg.norm(wrong(beside, loudness) - found) < 2.0 * np.linalg.norm(found) + 2.0 * noise
