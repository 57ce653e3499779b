"""The spread of linear models: what they say, and how far it would have been otherwise on other stretches."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import registry
from harness.models.estimate import estimate_of
from harness.models.spread import deviation_of, gains, pole_covariance, response_covariance, step_deviation, steps
from harness.parts.stored import read_model
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.arx import Arx
from identifiers.linear.n4sid import Subspace

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def driven(seed, samples=600, pole=0.8, size=0.3, units=(1.0, 1.0)):
    """A first-order plant with noise in its equation, in other units if asked."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=samples), np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = pole * y[k] + u[k] + size * rng.normal()
    return Trajectory(np.arange(samples) * 0.1, units[0] * u[:, None], units[1] * y[:, None], SPEC)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(-0.9, 0.9), st.floats(0.05, 2.0))
def test_a_neighbour_is_the_fit_without_its_stretch(seed, pole, size):
    data = driven(seed, 300, pole, size)
    model = Arx(order=1, offset=False, least_excitation=0.0).fit([data], rng=np.random.default_rng(0))
    rows = 299 // 20
    again = Arx(order=1, offset=False, least_excitation=0.0).fit([data[rows:]], rng=np.random.default_rng(0))
    assert model.spread.count == 20
    assert np.allclose(model.spread.a[0], again.a_matrix, atol=1e-9)
    assert np.allclose(model.spread.b[0], again.b_matrix, atol=1e-9)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_units_do_not_change_the_spread(seed, per_input, per_output):
    plain, moved = (
        Subspace(order=1, method="cva").fit([driven(seed, units=units)], rng=np.random.default_rng(0))
        for units in ((1.0, 1.0), (per_input, per_output))
    )
    ratio = per_output / per_input
    assert np.allclose(step_deviation(moved, 20), ratio * step_deviation(plain, 20), rtol=1e-4)
    assert np.allclose(pole_covariance(moved)[1], pole_covariance(plain)[1], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize(
    ("identifier", "options"),
    [
        ("arx", {"order": 1}),
        ("arx", {"order": 3, "delay": 2, "ridge": 1e-6}),
        ("least-squares", {}),
        ("least-squares", {"method": "iv"}),
        ("dmdc", {"delays": 2}),
        ("dmdc", {"rank": 1}),
        ("edmdc", {"degree": 1}),
        ("n4sid", {"order": 1}),
        ("ho-kalman", {"order": 1, "markov": 40}),
        ("ho-kalman", {"order": 1, "markov": 40, "regularised": False}),
        ("ho-kalman", {"order": 1, "markov": 40, "observer": 4}),
        ("prediction-error", {"order": 1, "structure": "armax"}),
    ],
)
def test_the_spread_is_that_of_other_records(identifier, options):
    draws = range(8)
    made = registry.create("identifiers", identifier, **options)
    models = [made.fit([driven(seed)], rng=np.random.default_rng(0)) for seed in draws]
    f = np.array([0.05, 0.5, 2.0])
    said = np.sqrt(np.mean([np.trace(response_covariance(m, f), axis1=-2, axis2=-1) for m in models], axis=0))
    found = np.array([gains(m.matrices, f, 0.1) for m in models])
    seen = np.sqrt(np.mean(np.abs(found - found.mean(axis=0)) ** 2, axis=0) * len(models) / (len(models) - 1))
    assert np.all(said < 3.0 * seen)  # eight draws tell a deviation to a third
    assert np.all(said > seen / 3.0)


@pytest.mark.parametrize("identifier", ["arx", "n4sid", "edmdc"])
def test_a_stored_model_says_the_same(identifier, tmp_path):
    import json

    model = registry.create("identifiers", identifier).fit([driven(0)], rng=np.random.default_rng(0))
    file = tmp_path / "model.json"
    file.write_text(json.dumps(model.to_dict()))
    again = read_model(file)
    assert np.allclose(step_deviation(again, 30), step_deviation(model, 30), rtol=1e-12)
    assert (again.spread.method, again.spread.freedom) == (model.spread.method, 19.0)
    assert file.stat().st_size < 200_000


def test_poles_and_static_gains_of_a_subspace_model_have_intervals():
    found = estimate_of(Subspace(order=1).fit([driven(3)], rng=np.random.default_rng(0)))
    for name, truth in (("pole 1, modulus", 0.8), ("y per u, static", 5.0)):
        low, high = found.interval(name)
        assert low < truth < high < low + 0.5 * truth


def test_least_squares_on_noisy_outputs_says_that_the_spread_is_not_all():
    rng = np.random.default_rng(99)
    data = driven(0, 2000, size=0.0)
    noisy = Trajectory(data.t, data.u, data.y + rng.normal(size=data.y.shape), SPEC)
    model = Arx(order=1, least_excitation=0.0).fit([noisy], rng=rng)
    assert "as a whole" in model.spread.warning
    assert Arx(order=1).fit([driven(0)], rng=rng).spread.warning == ""


def test_anything_that_follows_from_a_model_has_a_deviation():
    model = Arx(order=1).fit([driven(1)], rng=np.random.default_rng(0))
    final = deviation_of(model, lambda matrices: steps(matrices, 200)[-1])
    assert 0.1 < float(final[0, 0]) < 0.3  # of a static gain of 5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arx", "dmdc rank", "dmdc ridge", "edmdc", "n4sid cva", "ho-kalman observer", "oe"])
def test_intervals_hold_the_truth_as_often_as_they_say(name, monkeypatch):
    file = Path(__file__).parents[2] / "benchmarks" / "coverage_of_responses.py"
    spec = importlib.util.spec_from_file_location("coverage_of_responses", file)
    coverage = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "coverage_of_responses", coverage)
    spec.loader.exec_module(coverage)
    for line in coverage.rows(60, [name]):
        shares = [float(word) for word in line.replace(",", " ").split() if "." in word and word[0].isdigit()]
        assert len(shares) == 4
        assert 88.0 < np.mean(shares) <= 100.0, line
