"""Polynomial NARX: the true terms are found, units and the order of terms decide nothing, divergence is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.models.estimate import estimate_of
from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.common.lag_state import Standardisation
from identifiers.common.library import Library
from identifiers.common.normal import NormalEquations
from identifiers.sparse.narx import Narx
from identifiers.sparse.narx_model import NarxModel, argument_names
from identifiers.sparse.orthogonal import frols, helpful, lost_share
from identifiers.sparse.pruning import ScaledWindows

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
TERMS = {"1", "y[k]", "u[k-1]", "y[k-1]^2", "u[k]^2"}


def record(seed, n=600, process=0.02, sensor=0.0, gains=(0.5, 0.5, 0.8, -0.05, 1.0)):
    """Return a record of ``y[k+1] = c + a y[k] + b u[k-1] + d y[k-1]^2 + e u[k]^2`` under white inputs."""
    rng = np.random.default_rng(seed)
    level, own, late, bent, square = gains
    u, y = rng.uniform(-1, 1, n), np.zeros(n)
    for k in range(1, n - 1):
        y[k + 1] = level + own * y[k] + late * u[k - 1] + bent * y[k - 1] ** 2 + square * u[k] ** 2
        y[k + 1] += process * rng.normal()
    y = y + sensor * y.std() * rng.normal(size=n)
    return Trajectory(np.arange(n) * 0.1, u[:, None], y[:, None], SPEC)


def fitted(data, **options):
    return Narx(**options).fit([data], rng=np.random.default_rng(0))


@settings(max_examples=10, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(0.2, 0.6),
    st.floats(0.3, 1.0),
    st.floats(0.5, 1.5),
)
def test_true_terms_and_their_values_are_found(seed, own, late, square):
    gains = (0.5, own, late, -0.05, square)
    # two lags: with three and no noise, the equation of the sample before put into this one is as true
    model = fitted(record(seed, process=0.0, gains=gains), lags=2)
    assert set(model.terms[0]) == TERMS
    found = dict(zip(model.names, model.natural[0], strict=True))
    wanted = dict(zip(("1", "y[k]", "u[k-1]", "y[k-1]^2", "u[k]^2"), gains, strict=True))
    assert all(found[name] == pytest.approx(value, abs=1e-8) for name, value in wanted.items())


def test_pruning_takes_away_what_forward_selection_took_too_early():
    seeds = range(12)
    plain, judged = ([fitted(record(s), prune=p).terms[0] for s in seeds] for p in (False, True))
    assert sum(set(terms) == TERMS for terms in judged) >= 10  # 28 of 30 (benchmarks/narx_recovery.py)
    assert sum(set(terms) == TERMS for terms in plain) <= 3


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.integers(-6, 6), st.integers(-6, 6))
def test_units_change_nothing(seed, inputs, outputs):
    data = record(seed, n=300)
    scaled = Trajectory(data.t, data.u * 10.0**inputs, data.y * 10.0**outputs, data.spec)
    one, other = fitted(data), fitted(scaled)
    assert one.terms == other.terms
    assert np.allclose(one.coefficients, other.coefficients, rtol=1e-6, atol=1e-9)
    assert np.allclose(simulation_error(one, data).nrmse, simulation_error(other, scaled).nrmse, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_candidates_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(12, 80))
    target = rng.normal(size=(1, 12)) * (rng.random(12) < 0.4) @ phi + 0.1 * rng.normal(size=(1, 80))
    turn = rng.permutation(12)
    one = frols(NormalEquations.of([(phi, target)], 12, 1), 0, 6)
    other = frols(NormalEquations.of([(phi[turn], target)], 12, 1), 0, 6)
    assert one.order == tuple(int(turn[j]) for j in other.order)
    assert np.allclose(one.ratios, other.ratios, atol=1e-10)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_ratios_are_what_least_squares_explains(seed, count):
    rng = np.random.default_rng(seed)
    phi, target = rng.normal(size=(8, 60)), rng.normal(size=(1, 60))
    equations = NormalEquations.of([(phi, target)], 8, 1)
    path = frols(equations, 0, count)
    own = phi[list(path.order)].T
    left = target[0] - own @ np.linalg.lstsq(own, target[0], rcond=None)[0]
    assert path.lost(count) == pytest.approx(left @ left / (target[0] @ target[0]), abs=1e-10)
    assert lost_share(equations, 0, list(path.order)) == pytest.approx(path.lost(count), abs=1e-10)
    assert helpful(equations, 0, list(path.order[:-1]), 1) == [path.order[-1]]


@pytest.mark.slow
def test_deviations_of_terms_hold_the_truth():
    truth = {"1": 0.5, "y[k]": 0.5, "u[k-1]": 0.8, "y[k-1]^2": -0.05, "u[k]^2": 1.0}
    held, asked = 0, 0
    for seed in range(40):
        estimate = estimate_of(fitted(record(seed, n=400), lags=2, degree=2))
        assert estimate is not None
        if estimate.intervals is None:
            continue
        for name, value in truth.items():
            if f"y on {name}" in estimate.names:
                low, high = estimate.interval(f"y on {name}")
                held, asked = held + (low <= value <= high), asked + 1
    assert asked > 150
    assert 0.91 < held / asked < 0.985


def test_noise_on_the_sensor_leaves_no_interval_and_its_moving_average_takes_the_bias():
    rng = np.random.default_rng(1)
    u, x = 0.5 * rng.normal(size=2000), np.zeros(2000)
    for k in range(1, 1999):
        x[k + 1] = 0.75 * x[k - 1] + 0.25 * u[k - 1] - 0.2 * x[k - 1] * u[k - 1]
    data = Trajectory(np.arange(2000) * 0.1, u[:, None], (x + 0.05 * rng.normal(size=2000))[:, None], SPEC)
    plain, whole = fitted(data), fitted(data, noise=2)
    assert estimate_of(plain).intervals is None
    biased, right = (dict(zip(m.names, m.natural[0], strict=True))["y[k-1]"] for m in (plain, whole))
    assert abs(biased - 0.75) > 0.03
    assert right == pytest.approx(0.75, abs=0.015)


def test_a_signal_far_from_zero_is_counted_from_its_level():
    data = record(3)
    far = Trajectory(data.t, data.u + 300.0, data.y - 5000.0, data.spec)
    model = fitted(far)
    assert simulation_error(model, far).nrmse[0] < 0.05
    assert model.equations[0].startswith("y[k+1] + 499")
    assert "(u[k] - 299.9" in model.equations[0] or "(u[k] - 300.0" in model.equations[0]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_chaotic_map_is_found_though_no_free_run_follows_it(noise):
    rng, x = np.random.default_rng(0), np.full((600, 2), 0.1)
    for k in range(599):
        x[k + 1] = 1.0 - 1.4 * x[k, 0] ** 2 + x[k, 1], 0.3 * x[k, 0]
    spec = PlantSpec((), (Channel("a"), Channel("b")), 1.0)
    data = Trajectory(np.arange(600.0), np.zeros((600, 0)), x + noise * rng.normal(size=x.shape), spec)
    model = fitted(data, lags=1)
    assert set(model.terms[0]) >= {"1", "a[k]^2", "b[k]"}
    assert set(model.terms[1]) >= {"a[k]"}
    natural = dict(zip(model.names, model.natural[0], strict=True))
    assert natural["a[k]^2"] == pytest.approx(-1.4, abs=0.05)


def test_a_free_run_that_leaves_the_data_is_infinitely_wrong_and_ends_in_nan():
    data = record(0)[5:]
    library = Library(argument_names(SPEC, 1), 2)
    windows = ScaledWindows.of([data], 1)
    growing = np.zeros((2, 1, len(library)))
    growing[0, 0, 1], growing[1, 0, 1] = 3.0, 0.5
    errors = windows.errors(library, range(len(library)), growing)
    assert np.isinf(errors[0, 0])
    assert np.isfinite(errors[1, 0])
    one = Standardisation(np.zeros(2), np.ones(2), np.zeros(1), np.ones(1))
    model = NarxModel(SPEC, 1, one, library, growing[0], np.ones(1))
    x = model.initial_state(data)
    run, steps = model.free_run(x[None], data.u[None]), super(NarxModel, model).free_run(x[None], data.u[None])
    assert np.isnan(run[0, -1, 0])
    assert np.array_equal(run, steps, equal_nan=True)


def test_options_without_sense_are_refused_in_a_line():
    with pytest.raises(InputError, match="lags: option of narx") as said:
        fitted(record(0), lags=0)
    assert "\n" not in str(said.value)


def test_too_many_terms_and_angles_are_refused_with_a_remedy():
    data = record(0)
    with pytest.raises(FitError, match="too many terms"):
        fitted(data, lags=10, degree=4)
    angle = PlantSpec((Channel("u"),), (Channel("q", "rad", period=2 * np.pi),), 0.1)
    with pytest.raises(FitError, match="angles"):
        fitted(Trajectory(data.t, data.u, data.y, angle))


def test_a_stored_model_says_the_same():
    model = fitted(record(5))
    again = NarxModel.from_dict(model.to_dict())
    data = record(6)
    x = model.initial_state(data)
    assert np.array_equal(model.free_run(x[None], data.u[None]), again.free_run(x[None], data.u[None]))
    assert again.equations == model.equations
