"""Outputs that hold noise alone decide nothing: no order, no direction, no pole."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.arx import Arx
from identifiers.linear.dmd import Dmdc
from identifiers.linear.ho_kalman import HoKalman
from identifiers.linear.least_squares import StateLeastSquares
from identifiers.linear.n4sid import Subspace

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


@pytest.mark.parametrize(
    "identifier",
    [
        Arx(),
        Dmdc(rank=2),
        Dmdc(rank="auto", total="auto"),
        StateLeastSquares(),
        Subspace(),
        HoKalman(markov=60),
    ],
    ids=["arx", "dmdc", "total-dmd", "least-squares", "n4sid", "ho-kalman"],
)
@settings(max_examples=3, deadline=None)
@given(
    idle=st.integers(1, 10),
    noise=st.sampled_from([1e-4, 1e-3, 1e-2]),
    loudness=st.sampled_from([1e-3, 1.0, 1e4]),
    seed=st.integers(0, 999),
)
def test_outputs_of_noise_alone_leave_the_answer_within_what_noise_leaves_open(identifier, idle, noise, loudness, seed):
    rng = np.random.default_rng(0)
    alone, beside = (
        identifier.fit([record(count, noise, loudness, seed)], rng=rng).impulse_response(40)[:, :2, 0]
        for count in (0, idle)
    )
    true = np.zeros((40, 2))
    state = B
    for k in range(1, 40):
        true[k], state = state, A @ state
    error, size = np.linalg.norm(alone - true), np.linalg.norm(true)
    # ten idle regressors of 600 rows: each takes a share of 1 / 600 of the noise's square into the answer
    assert np.linalg.norm(beside - alone) < 2.0 * error + 2.0 * noise * size
