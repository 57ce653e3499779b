"""Bounds for finite samples: they hold, what stands beside them is what is measured, and both say when they cannot."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.models.spread import gains, steps
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.linear.bounds.finite_sample import FiniteSample
from identifiers.linear.bounds.regressions import ellipsoids, small_ball
from identifiers.linear.bounds.responses import LagsKnown, realisation_bound, responses
from identifiers.linear.ho_kalman import realize
from identifiers.linear.markov import normal_equations

A, B = np.array([[0.8, 0.2], [-0.2, 0.7]]), np.array([[0.0], [1.0]])
STATES = PlantSpec((Channel("u"),), (Channel("q"), Channel("v")), 1.0)
ONE = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def states(samples, seed, gain=0.0):
    rng = np.random.default_rng(seed)
    u, x = np.zeros((samples, 1)), np.zeros((samples, 2))
    for k in range(samples):
        u[k] = rng.normal() + gain * x[k, 1]
        if k + 1 < samples:
            x[k + 1] = A @ x[k] + B @ u[k] + 0.5 * rng.normal(size=2)
    return Trajectory(np.arange(float(samples)), u, x, STATES)


def outputs(samples, seed, smooth=0.0):
    rng = np.random.default_rng(seed)
    u, y, x = rng.normal(size=(samples, 1)), np.zeros((samples, 1)), np.zeros(2)
    for k in range(1, samples):
        u[k] = smooth * u[k - 1] + np.sqrt(1 - smooth**2) * u[k]
    for k in range(samples):
        y[k] = x[0]
        x = A @ x + B @ u[k]
    return Trajectory(np.arange(float(samples)), u, y + 0.3 * rng.normal(size=y.shape), ONE)


def rows_of(record):
    phi = np.hstack([record.y[:-1], record.u[:-1], np.ones((len(record) - 1, 1))])
    return phi, record.y[1:]


TRUTH = np.vstack([A.T, B.T, np.zeros((1, 2))])


@pytest.mark.parametrize("gain", [0.0, -0.4])
def test_ellipsoids_hold_also_under_feedback_and_are_no_narrower_than_intervals(gain):
    held, measured = [], []
    for seed in range(100):
        found = ellipsoids(*rows_of(states(300, seed, gain)), 0.95)
        wrong = np.abs(found.coefficients - TRUTH)
        held.append(np.all(wrong <= found.half))
        measured.append(np.mean(wrong <= found.measured))
        assert np.all(found.half > found.measured)
        assert np.all(found.half < 6 * found.measured)
    assert np.mean(held) > 0.95
    assert 0.925 < np.mean(measured) < 0.975


def test_too_few_rows_bear_no_ellipsoid():
    phi, y = rows_of(states(12, 0))
    assert ellipsoids(phi, y, 0.95) is None


@pytest.mark.parametrize("smooth", [0.0, 0.8])
def test_bounds_on_responses_hold_for_white_and_for_smooth_inputs(smooth):
    truth = np.array([np.zeros((1, 1)), *(np.eye(2)[:1] @ np.linalg.matrix_power(A, i) @ B for i in range(24))])
    waves = np.exp(-1j * np.outer(np.linspace(0, np.pi, 200), np.arange(25)))
    held, measured = [], []
    for seed in range(14):
        found = responses([outputs(600, seed, smooth)], 25, 0.95, np.random.default_rng(0))
        wrong = found.markov - truth
        gain = np.abs(np.einsum("fl,lyu->f", waves, wrong)).max()
        block = np.linalg.norm(wrong)
        held.append((gain <= found.gain, block <= found.block))
        measured.append((gain <= found.measured_gain, block <= found.measured_block))
        assert found.gain > found.measured_gain
        assert found.block > found.measured_block
    assert np.mean(held) > 0.99
    assert np.all(np.mean(measured, axis=0) > 0.7)  # 19 neighbours tell a largest gain roughly


@pytest.mark.parametrize("unit", [1e3, 1e-6])
def test_an_input_in_another_unit_tells_as_much(unit):
    u = np.random.default_rng(4).normal(size=(1500, 2))
    spec = PlantSpec((Channel("a"), Channel("b")), (Channel("y"),), 1.0)
    units, found = np.array([1.0, unit]), []
    for size in (np.ones(2), units):
        record = Trajectory(np.arange(1500.0), u / size, np.zeros((1500, 1)), spec)
        known = LagsKnown.of(normal_equations([record], 20, offset=True), 20, 2)
        assert known is not None
        found.append(known)
    assert np.allclose(found[1].inverse / units / units[:, None, None], found[0].inverse, rtol=1e-6, atol=1e-12)


def test_the_bound_on_a_realisation_holds_where_it_speaks():
    markov = steps((A, B, np.eye(2)[:1], np.zeros((1, 1))), 21, "impulse")
    a, b, c, _ = realize(markov[1:], order=2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        error = rng.normal(size=markov.shape)
        error *= 1e-3 / np.linalg.norm(error)
        bound, share = realisation_bound(markov + error, 2, 1e-3)
        assert share < 1
        other, into, out, _ = realize((markov + error)[1:], order=2)
        left, _, right = np.linalg.svd(np.vstack([c, b.T]).T @ np.vstack([out, into.T]))
        assert np.linalg.norm((left @ right) @ other @ (left @ right).T - a) <= bound
    assert np.isinf(realisation_bound(markov, 2, 1.0)[0])


def test_small_balls_speak_late_and_fall_with_the_root_of_the_samples():
    few, many = (small_ball(A, B, np.eye(1), 0.25 * np.eye(2), n, 0.95) for n in (200_000, 800_000))
    assert few.needed < 200_000
    assert many.bound <= 0.51 * few.bound
    assert small_ball(A, B, np.eye(1), 0.25 * np.eye(2), 500, 0.95).needed > 500
    assert np.isinf(small_ball(1.1 * np.eye(2), B, np.eye(1), np.eye(2), 500, 0.95).needed)


def bounds(record, identifier, **options):
    return FiniteSample(identifier, options).of(Dataset("d", (Run(record),)), rng=np.random.default_rng(0))


def test_every_identifier_has_its_rows_and_the_looseness_is_said():
    found = bounds(states(2000, 0), "least-squares")
    names = [row["of"] for row in found.rows]
    assert names[:3] == ["q on q", "q on v", "q on u"]
    assert "small balls" in [row["theorem"] for row in found.rows]
    ratios = [row["ratio"] for row in found.rows if row["ratio"] != ""]
    assert f"{min(ratios):.3g} to {max(ratios):.3g} times what was measured" in found.words[0]
    theorems = {row["theorem"] for row in bounds(outputs(1500, 0), "n4sid", order=2).rows}
    assert theorems == {"self-normalised", "these inputs", "Ho-Kalman"}


def test_the_interval_beside_a_coefficient_is_that_of_the_fit():
    record = states(2000, 3)
    from harness.models.estimate import estimate_of
    from harness.registry import create

    estimate = estimate_of(create("identifiers", "least-squares").fit([record], rng=np.random.default_rng(0)))
    for row in bounds(record, "least-squares").rows[:6]:
        low, high = estimate.interval(row["of"])
        assert row["measured"] == pytest.approx((high - low) / 2, rel=0.12)  # of nine tenths of the rows


def test_loops_and_correlated_residuals_are_said():
    closed = bounds(states(1500, 0, gain=-0.4), "least-squares")
    assert any("none is given" in text for text in closed.words)
    assert not any(row["theorem"] == "these inputs" for row in closed.rows)
    noisy = bounds(outputs(1500, 0), "arx", order=2)
    assert any("neither bound nor interval" in text for text in noisy.words)


def test_identify_puts_bounds_beside_the_fit_and_refuses_what_is_not_linear(tmp_path):
    record = outputs(1500, 0)
    table = {"t [s]": record.t, "u": record.u[:, 0], "y": record.y[:, 0]}
    plain = api.identify(table, identifier="n4sid", options={"order": 2}, input=["u"], output=["y"])
    found = api.identify(table, identifier="n4sid", options={"order": 2}, input=["u"], output=["y"], bounds=True)
    assert plain.bounds is None
    assert "bounds" not in plain.to_dict()
    assert found.to_dict()["bounds"]["rows"][0]["bound"] > 0
    with pytest.raises(InputError, match="a linear model"):
        api.identify(table, identifier="narx", input=["u"], output=["y"], bounds=True)


def test_a_gain_bound_is_on_the_response_itself():
    found = responses([outputs(1500, 1)], 25, 0.95, np.random.default_rng(0))
    frequency = np.linspace(0, 0.5, 50)
    truth = gains((A, B, np.eye(2)[:1], np.zeros((1, 1))), frequency, 1.0)[:, 0, 0]
    waves = np.exp(-2j * np.pi * np.outer(frequency, np.arange(25)))
    assert np.abs(np.einsum("fl,lyu->f", waves, found.markov) - truth).max() < found.gain
