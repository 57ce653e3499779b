"""Intervals of linear fits hold the truth as often as they say, in any unit, and are withheld where they would not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from harness.models.estimate import Estimate, estimate_of
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.testing import LinearSystem, linear_systems
from identifiers.linear.arx import Arx
from identifiers.linear.least_squares import StateLeastSquares
from identifiers.linear.prediction_error import PredictionError

A = np.array([[0.9, 0.3], [-0.2, 0.85]])
B = np.array([[0.0], [1.0]])
SPEC = PlantSpec((Channel("u", "N"),), (Channel("q", "m"), Channel("v", "m/s")), 0.1)
SYSTEM = LinearSystem(A, B, np.eye(2), SPEC)


def disturbed(system: LinearSystem, seed: int, process: float, sensor: float = 0.0, n: int = 150) -> list[Trajectory]:
    """Return two records of a system with a disturbance at every step, and noise on the sensors."""
    rng, nx = np.random.default_rng(seed), len(system.A)
    found = []
    for length in (n, n + 60):
        u, x = rng.normal(size=(length, system.spec.nu)), np.zeros((length, nx))
        for k in range(length - 1):
            x[k + 1] = system.A @ x[k] + system.B @ u[k] + process * rng.normal(size=nx)
        y = x + sensor * rng.normal(size=x.shape)
        found.append(Trajectory(np.arange(length) * system.spec.sample_time, u, y, system.spec))
    return found


def estimated(identifier: StateLeastSquares | Arx, records: list[Trajectory]) -> Estimate:
    estimate = estimate_of(identifier.fit(records, rng=np.random.default_rng(0)))
    assert estimate is not None
    return estimate


def truth(system: LinearSystem) -> FloatArray:
    return np.hstack([system.A, system.B]).ravel()


@given(linear_systems(measured_state=True, max_states=3), st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_no_coefficient_is_far_outside_its_interval_on_any_system(system, seed):
    estimate = estimated(StateLeastSquares(least_excitation=0.0), disturbed(system, seed, 0.3))
    if estimate.intervals is None:  # white residuals look correlated once in a thousand
        assert "correlated" in estimate.method
        return
    deviation = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(estimate.values - truth(system)) < 6 * deviation)
    assert estimate.intervals.mean(axis=1) == pytest.approx(estimate.values)


@pytest.mark.parametrize(
    ("identifier", "process", "sensor"),
    [
        (StateLeastSquares(), 0.2, 0.0),
        (Arx(order=1, offset=False), 0.2, 0.0),
        pytest.param(StateLeastSquares(method="iv", least_excitation=0.0), 0.0, 0.3, marks=pytest.mark.slow),
        pytest.param(StateLeastSquares(method="tls", least_excitation=0.0), 0.0, 0.3, marks=pytest.mark.slow),
    ],
    ids=["ls", "arx", "iv", "tls"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(identifier, process, sensor):
    count, held, given_ = 120, np.zeros(6), 0
    for seed in range(count):
        intervals = estimated(identifier, disturbed(SYSTEM, seed, process, sensor)).intervals
        if intervals is None:
            continue
        given_ += 1
        held += (intervals[:, 0] <= truth(SYSTEM)) & (truth(SYSTEM) <= intervals[:, 1])
    assert given_ >= 0.98 * count
    # a coverage of 90 % would pass for each of six coefficients once in a thousand
    assert held.min() >= binom.ppf(0.001, given_, 0.93)
    assert held.mean() <= 0.995 * given_


@pytest.mark.parametrize("kind", ["oe", pytest.param("armax", marks=pytest.mark.slow)])
def test_intervals_of_prediction_error_models_hold_the_truth_in_the_units_of_the_channels(kind):
    truth_of = {
        "oe": {"y: b1 of u": 100.0, "y: b2 of u": 50.0, "y: f1": -1.5, "y: f2": 0.7, "y: level": 7.0},
        "armax": {"y: a1": -1.5, "y: a2": 0.7, "y: b1 of u": 100.0, "y: b2 of u": 50.0, "y: level": 7.0},
    }[kind]
    spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
    count, given_, held = 60, 0, np.zeros(len(truth_of))
    for seed in range(count):
        rng = np.random.default_rng(seed)
        u, x, noise = rng.normal(size=400), np.zeros(400), 0.3 * rng.normal(size=400)
        for k in range(2, 400):
            x[k] = 1.5 * x[k - 1] - 0.7 * x[k - 2] + u[k - 1] + 0.5 * u[k - 2] + (kind == "armax") * noise[k]
        y = 7.0 + 100.0 * (x + (kind == "oe") * noise)
        data = Trajectory(np.arange(400) * 0.1, u[:, None], y[:, None], spec)
        estimate = estimate_of(PredictionError(structure=kind, order=2).fit([data], rng=rng))
        assert estimate is not None
        assert dict(zip(estimate.names, estimate.units, strict=True))["y: b1 of u"] == "m/V"
        if estimate.intervals is None:
            continue
        given_ += 1
        pairs = [(estimate.interval(name), value) for name, value in truth_of.items()]
        held += [pair is not None and pair[0] <= value <= pair[1] for pair, value in pairs]
    assert given_ >= 0.95 * count
    assert held.min() >= binom.ppf(0.001, given_, 0.93)


def test_output_error_under_coloured_noise_claims_no_interval():
    rng = np.random.default_rng(0)
    u, y, v = rng.normal(size=800), np.zeros(800), np.zeros(800)
    for k in range(1, 800):
        y[k] = 0.8 * y[k - 1] + u[k - 1]
        v[k] = 0.9 * v[k - 1] + 0.2 * rng.normal()
    data = Trajectory(
        np.arange(800) * 0.1, u[:, None], (y + v)[:, None], PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    )
    estimate = estimate_of(PredictionError(order=1).fit([data], rng=rng))
    assert estimate is not None
    assert estimate.intervals is None
    assert "correlated in time" in estimate.method


def test_least_squares_on_noisy_sensors_claims_no_interval_and_instruments_do():
    data = disturbed(SYSTEM, 0, 0.02, 0.5)
    biased = estimated(StateLeastSquares(least_excitation=0.0), data)
    assert biased.intervals is None
    assert "correlated in time" in biased.method
    assert "iv" in biased.method
    assert estimated(StateLeastSquares(method="iv", least_excitation=0.0), data).intervals is not None


def test_units_of_a_channel_are_those_of_its_coefficients():
    data = disturbed(SYSTEM, 1, 0.2)
    plain = estimated(StateLeastSquares(), data)
    assert plain.names == ("q on q", "q on v", "q on u", "v on q", "v on v", "v on u")
    assert plain.units == ("1", "s", "m/N", "1/s", "1", "m/(s N)")
    larger = [replace(one, y=one.y * np.array([1e3, 1.0])) for one in data]
    other = estimated(StateLeastSquares(), larger)
    scale = np.array([1.0, 1e3, 1e3, 1e-3, 1.0, 1.0])
    assert other.values == pytest.approx(plain.values * scale, rel=1e-8)
    assert other.intervals == pytest.approx(plain.intervals * scale[:, None], rel=1e-6)


def test_exact_data_and_stabilised_models_claim_no_interval():
    assert "rounding" in estimated(StateLeastSquares(), disturbed(SYSTEM, 2, 0.0)).method
    unstable = LinearSystem(1.15 * A, B, np.eye(2), SPEC)
    model = StateLeastSquares(stable=True, least_excitation=0.0).fit(
        disturbed(unstable, 3, 0.2, n=40), rng=np.random.default_rng(0)
    )
    assert model.notes["stabilized"]
    assert estimate_of(model) is None
