"""Polynomial state-space models: their derivatives exact, their systems found again, what they cannot do told."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.scoring import simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.learned.polynomial_pass import PolynomialTables, exponents
from identifiers.learned.polynomial_state_space import PolynomialStateSpace
from identifiers.learned.recurrent_model import RecurrentEnsemble

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)


def oscillator(samples: int, seed: int, noise: float = 0.0, hard: float = 0.05, through: float = 0.0) -> Trajectory:
    """Return a record of a system of the class: two states, a cubic spring, a product of state and input."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, samples)
    x, y = np.zeros(2), np.zeros(samples)
    for k in range(samples):
        y[k] = 3.0 + 2.0 * x[0] + 0.1 * x[0] * x[1] + through * u[k]
        push = u[k] + 0.2 * x[0] * u[k] - 0.5 * x[0] - hard * x[0] ** 3
        x = np.array([x[0] + 0.4 * x[1], 0.8 * x[1] + 0.4 * push])
    y = y + noise * y.std() * rng.normal(size=samples)
    spec = PlantSpec(SPEC.inputs, SPEC.outputs, SPEC.sample_time, feedthrough=through != 0.0)
    return Trajectory(np.arange(samples) * 0.1, u[:, None], y[:, None], spec)


@settings(max_examples=20)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(0, 2), st.integers(1, 2), st.integers(1, 3),
    st.integers(1, 3), st.booleans(), st.booleans(),
)  # fmt: skip
def test_derivatives_are_those_of_differences_compiled_or_not(
    seed: int, nx: int, nu: int, ny: int, degree: int, outside: int, direct: bool, crossed: bool
) -> None:
    rng = np.random.default_rng(seed)
    layout = PolynomialTables(nx, nu, ny, degree, outside, direct, crossed)
    theta, start, u = 0.05 * rng.normal(size=layout.count), 0.5 * rng.normal(size=nx), rng.normal(size=(12, nu))
    y, table = layout.run(theta, start, u, sensitivities=True)
    plain, plain_table = layout.run(theta, start, u, sensitivities=True, native=False)
    assert table is not None
    assert plain_table is not None
    np.testing.assert_array_equal(np.isnan(table).any(axis=(1, 2)), np.isnan(y).any(axis=1))
    states = layout.states(theta, start, u)
    near = np.abs(np.nan_to_num(states, nan=np.inf)).max(axis=1) < 5.0  # where it leaves, differences say little
    assert near[0]
    np.testing.assert_allclose(y[near], plain[near], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(table[near], plain_table[near], rtol=1e-9, atol=1e-10)

    def run(at: FloatArray) -> FloatArray:
        return layout.run(at[: layout.count], at[layout.count :], u, sensitivities=False)[0]

    at = np.concatenate([theta, start])
    for k in rng.choice(at.size, min(at.size, 12), replace=False):
        by = 1e-6 * np.eye(at.size)[k]
        difference = (run(at + by) - run(at - by))[near] / 2e-6
        np.testing.assert_allclose(table[near, :, k], difference, rtol=1e-4, atol=1e-6)
    x = start
    for k in np.flatnonzero(near):
        np.testing.assert_allclose(layout.output(theta, x, u[k]), y[k], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(states[k], x, rtol=1e-10, atol=1e-12)
        x = layout.step(theta, x, u[k])


@given(st.integers(1, 4), st.integers(0, 4), st.integers(0, 4))
def test_monomials_are_counted_each_once_and_lower_degrees_come_first(variables: int, degree: int, bent: int) -> None:
    bent = min(bent, variables)
    rows = [tuple(row) for row in exponents(variables, degree, bent).tolist()]
    assert len(set(rows)) == len(rows)
    assert [sum(row) for row in rows] == sorted(sum(row) for row in rows)
    assert all(sum(row) <= degree and (sum(row) < 2 or not any(row[bent:])) for row in rows)
    if bent == variables:
        from math import comb

        assert len(rows) == comb(variables + degree, degree)


@settings(max_examples=2)
@given(st.integers(0, 1000), st.floats(0.02, 0.1))
def test_a_system_of_the_class_is_found_again_to_the_noise(seed: int, hard: float) -> None:
    learn, test = oscillator(1500, seed, noise=0.01, hard=hard), oscillator(800, seed + 1, hard=hard)
    model = PolynomialStateSpace(order=2, degree=3).fit([learn], rng=np.random.default_rng(0))
    noise = 0.01 * learn.y.std()
    assert simulation_error(model, test).rms[0] < 0.5 * noise
    assert model.members[0].fit_error * model.members[0].y_std[0] == pytest.approx(noise, rel=0.15)


def test_order_and_degree_are_chosen_on_what_is_held_out() -> None:
    learn, test = oscillator(1500, 0, noise=0.003), oscillator(800, 1)
    model = PolynomialStateSpace().fit([learn], rng=np.random.default_rng(0))
    assert (model.notes["order"], model.notes["degree"]) == (2, 3)
    assert simulation_error(model, test).nrmse[0] < 0.005


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("lags", [[0, 0.5, 0.3], [0, 0.5, 0.3, 0.1]])
def test_where_nothing_bends_a_linear_model_is_enough(lags: list[float], noise: float) -> None:
    rng = np.random.default_rng(0)
    u = rng.uniform(-1.0, 1.0, 1500)
    y = np.convolve(u, lags)[:1500] + noise * rng.normal(size=1500)
    line = Trajectory(np.arange(1500) * 0.1, u[:, None], y[:, None], SPEC)
    assert PolynomialStateSpace(order=2).fit([line], rng=np.random.default_rng(0)).notes["degree"] == 1


def test_several_records_have_starts_of_their_own_and_a_direct_term_is_found() -> None:
    whole = oscillator(1600, 0, noise=0.003, through=0.7)
    parts, test = [whole[100:700], whole[750:1600]], oscillator(800, 1, through=0.7)
    model = PolynomialStateSpace(order=2, degree=3).fit(parts, rng=np.random.default_rng(0))
    assert simulation_error(model, test).nrmse[0] < 0.01


def test_too_many_coefficients_stop_early_instead_of_learning_all_samples() -> None:
    few, test = oscillator(260, 0, noise=0.05), oscillator(800, 1)
    model = PolynomialStateSpace(order=3, degree=3, ridge=1e-6).fit([few], rng=np.random.default_rng(0))
    assert model.notes["held-out rms"][0] > 1.2 * model.members[0].fit_error
    assert simulation_error(model, test[:200]).nrmse[0] < 0.5


def test_the_model_comes_back_from_its_file_and_a_run_beyond_all_bounds_ends_in_nan() -> None:
    learn = oscillator(600, 0)
    model = PolynomialStateSpace(order=2, degree=3, iterations=30).fit([learn], rng=np.random.default_rng(0))
    again = RecurrentEnsemble.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(simulation_error(again, learn).rms, simulation_error(model, learn).rms)
    x = model.initial_state(learn)
    run = model.free_run(x[None], np.full((1, 200, 1), 1e6))
    assert np.isnan(run[0, -1, 0])
    assert np.isnan(model.step(x, np.array([1e9]))).any()


def test_what_it_cannot_take_is_refused() -> None:
    with pytest.raises(InputError, match="degree"):
        PolynomialStateSpace(degree=0).fit([oscillator(200, 0)], rng=np.random.default_rng(0))
    with pytest.raises(FitError, match="too short"):
        PolynomialStateSpace(order=2).fit([oscillator(20, 0)], rng=np.random.default_rng(0))
