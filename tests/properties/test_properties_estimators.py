"""Properties that every estimator of a kind has, on systems drawn by hypothesis."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from harness.errors import FitError
from harness.scoring import equation_error, predict, simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import LinearSystem, finite_processes, linear_systems, simulate_finite, simulate_linear
from identifiers.dmd import Dmdc, Edmdc
from identifiers.linear import Arx, LinearModel, StateLeastSquares
from identifiers.markov import markov_parameters
from identifiers.mdp import MdpCounting
from identifiers.online import RecursiveLeastSquares
from identifiers.sparse import Stlsq
from identifiers.subspace import realize

RNG = np.random.default_rng(0)
SEEDS = st.integers(0, 2**20)
STATE = {
    "least-squares": lambda: StateLeastSquares(least_excitation=0.0),
    "instruments": lambda: StateLeastSquares(method="iv"),
    "total least squares": lambda: StateLeastSquares(method="tls", least_excitation=0.0),
    "least absolute": lambda: StateLeastSquares(method="l1"),
    "dmdc": Dmdc,
    "edmdc": lambda: Edmdc(degree=1),
    "stlsq": lambda: Stlsq(degree=1, time="discrete", threshold=1e-9),
}
INEXACT = {"stlsq": 1e-6, "instruments": 1e-5, "edmdc": 1e-6}


def records(system: LinearSystem, seed: int, n: int = 80, noise: float = 0.0) -> list[Trajectory]:
    rng = np.random.default_rng(seed)
    return [simulate_linear(system, n, rng=rng, noise=noise).measured() for _ in range(2)]


def one_step(model: Any, data: Trajectory) -> np.ndarray:
    return predict(model, data, 1)[1:]


def close(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-7) -> bool:
    return bool(np.abs(a - b).max() <= tolerance * (1.0 + np.abs(b).max()))


@pytest.mark.parametrize("name", STATE)
@given(system=linear_systems(measured_state=True), seed=SEEDS)
def test_exact_data_are_recovered(name: str, system: LinearSystem, seed: int) -> None:
    runs = records(system, seed)
    model = STATE[name]().fit(runs, rng=RNG)
    assert close(one_step(model, runs[0]), runs[0].y[1:], INEXACT.get(name, 1e-7))


@pytest.mark.parametrize("name", STATE)
@given(system=linear_systems(measured_state=True), seed=SEEDS)
def test_the_order_of_the_records_makes_no_difference(name: str, system: LinearSystem, seed: int) -> None:
    runs = records(system, seed, noise=0.05)
    forth, back = (STATE[name]().fit(order, rng=RNG) for order in (runs, runs[::-1]))
    assert close(one_step(forth, runs[0]), one_step(back, runs[0]), 1e-5)


@pytest.mark.parametrize("name", ["least-squares", "total least squares", "dmdc", "edmdc", "least absolute"])
@given(system=linear_systems(measured_state=True), seed=SEEDS)
def test_a_record_given_twice_counts_twice_and_changes_nothing(name: str, system: LinearSystem, seed: int) -> None:
    runs = records(system, seed, noise=0.05)
    once, twice = (STATE[name]().fit(given, rng=RNG) for given in (runs[:1], [runs[0], runs[0]]))
    assert close(one_step(once, runs[1]), one_step(twice, runs[1]), 1e-5)


@pytest.mark.parametrize("name", ["least-squares", "instruments", "total least squares", "dmdc"])
@given(
    system=linear_systems(measured_state=True),
    seed=SEEDS,
    u_unit=st.sampled_from([1e-3, 1.0, 1e4]),
    y_unit=st.sampled_from([1e-4, 1.0, 1e3]),
)
def test_units_make_no_difference(name: str, system: LinearSystem, seed: int, u_unit: float, y_unit: float) -> None:
    runs = records(system, seed, noise=0.02)
    scaled = [Trajectory(r.t, u_unit * r.u, y_unit * r.y, r.spec) for r in runs]
    plain, other = STATE[name]().fit(runs, rng=RNG), STATE[name]().fit(scaled, rng=RNG)
    assert close(y_unit * one_step(plain, runs[1]), one_step(other, scaled[1]), 1e-5 * min(y_unit, 1.0) + 1e-12)


@pytest.mark.parametrize("name", ["least-squares", "instruments", "dmdc"])
@given(system=linear_systems(max_states=3, measured_state=True), seed=SEEDS)
def test_other_coordinates_give_the_same_model_in_them(name: str, system: LinearSystem, seed: int) -> None:
    runs = records(system, seed, noise=0.02)
    n = runs[0].spec.ny
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0] @ np.diag(np.linspace(1.0, 3.0, n))
    moved = [Trajectory(r.t, r.u, r.y @ turn.T, r.spec) for r in runs]
    plain, other = STATE[name]().fit(runs, rng=RNG), STATE[name]().fit(moved, rng=RNG)
    assert close(one_step(plain, runs[1]) @ turn.T, one_step(other, moved[1]), 1e-5)


@given(system=linear_systems(measured_state=True), seed=SEEDS)
def test_a_seam_is_no_equation(system: LinearSystem, seed: int) -> None:
    """Two records are the sum of their equations; joined into one there is one equation too many, and it is wrong."""
    a, b = records(system, seed)
    b = Trajectory(b.t, b.u, b.y + 50.0 * (1.0 + np.abs(b.y).max()), b.spec)
    manual = np.linalg.lstsq(
        np.concatenate([np.hstack([r.y[:-1], r.u[:-1]]) for r in (a, b)]),
        np.concatenate([r.y[1:] for r in (a, b)]),
        rcond=None,
    )[0]
    model = StateLeastSquares(least_excitation=0.0).fit([a, b], rng=RNG)
    ny = a.spec.ny
    assert close(np.hstack([model.a_matrix, model.b_matrix]), manual.T, 1e-6)
    joined = Trajectory(
        np.arange(len(a) + len(b)) * a.spec.sample_time, np.vstack([a.u, b.u]), np.vstack([a.y, b.y]), a.spec
    )
    crossed = StateLeastSquares(least_excitation=0.0).fit([joined], rng=RNG)
    assert np.abs(crossed.a_matrix - manual[:ny].T).max() > 1e-9


@given(system=linear_systems(max_states=3, max_inputs=2, max_outputs=2), seed=SEEDS)
def test_arx_of_enough_lags_is_exact(system: LinearSystem, seed: int) -> None:
    runs = records(system, seed, n=120)
    order = system.A.shape[0]
    try:
        model = Arx(order=order, offset=False).fit(runs, rng=RNG)
    except FitError as error:
        assume("do not determine" not in str(error))
        raise
    skip = order + 1
    assert close(predict(model, runs[0], 1)[skip:], runs[0].y[skip:], 1e-5)


@given(system=linear_systems(max_states=3), seed=SEEDS)
def test_ho_kalman_returns_the_markov_parameters_whatever_the_coordinates(system: LinearSystem, seed: int) -> None:
    n = system.A.shape[0]
    turn = np.random.default_rng(seed).normal(size=(n, n)) + 2 * np.eye(n)
    assume(np.linalg.cond(turn) < 100)
    inverse = np.linalg.inv(turn)

    def markov(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(30)])

    given_one = markov(system.A, system.B, system.C)
    given_two = markov(turn @ system.A @ inverse, turn @ system.B, system.C @ inverse)
    for wanted in (given_one, given_two):
        a, b, c, values = realize(wanted, order=n)
        assume(values[n - 1] > 1e-7 * values[0])
        assert close(markov(a, b, c), given_one, 1e-6)


@given(system=linear_systems(max_states=2, max_inputs=1, max_outputs=2), seed=SEEDS)
def test_markov_parameters_scale_with_the_input(system: LinearSystem, seed: int) -> None:
    runs = records(system, seed, n=150, noise=0.05)
    plain = markov_parameters(runs, 12)[0]
    scaled = markov_parameters([Trajectory(r.t, 10.0 * r.u, r.y, r.spec) for r in runs], 12)[0]
    assert close(10.0 * scaled, plain, 1e-7)


@given(system=linear_systems(max_states=3, max_outputs=3), seed=SEEDS)
def test_a_linear_models_free_run_finds_its_own_initial_state(system: LinearSystem, seed: int) -> None:
    nx, nu, ny = system.A.shape[0], system.B.shape[1], system.C.shape[0]
    model = LinearModel(
        system.spec,
        system.A,
        system.B,
        system.C,
        np.zeros((ny, nu)),
        np.zeros((nx, ny)),
        np.zeros(nx),
        np.zeros(ny),
    )
    data = records(system, seed)[0]
    assert simulation_error(model, data).rms.max() < 1e-6 * (1.0 + np.abs(data.y).max())


@given(system=linear_systems(measured_state=True, max_states=3), seed=SEEDS, order=st.integers(1, 3))
def test_recursive_least_squares_is_batch_least_squares(system: LinearSystem, seed: int, order: int) -> None:
    runs = records(system, seed, n=60, noise=0.1)
    online = RecursiveLeastSquares(order=order, prior=1e-3)
    state = online.init(system.spec, rng=RNG)
    for run in runs:
        state = online.start(state, run.y[0])
        for k in range(len(run) - 1):
            state = online.update(state, run.u[k], run.y[k + 1])
    batch = np.array(online.hindsight(runs).details["coefficients"])
    assert np.abs(state.coefficients - batch).max() <= 1e-9 * (1.0 + np.abs(batch).max())


@given(one=finite_processes(), seed=SEEDS)
def test_counted_rows_are_distributions_and_relabelling_relabels(one: Any, seed: int) -> None:
    data = simulate_finite(one, 300, rng=np.random.default_rng(seed))
    model = MdpCounting().fit([data], rng=RNG)
    assert np.allclose(model.transition.sum(axis=2), 1.0)
    assert (model.transition >= 0).all()
    states = one.P.shape[0]
    names = np.random.default_rng(seed).permutation(states)
    renamed = Trajectory(data.t, data.u, names[data.y.astype(int)].astype(float), data.spec)
    other = MdpCounting().fit([renamed], rng=RNG)
    assert np.allclose(other.transition[names][:, :, names], model.transition)


@given(
    y=st.lists(st.floats(-1e3, 1e3, allow_nan=False), min_size=6, max_size=30),
    name=st.sampled_from(sorted(STATE)),
)
def test_any_numbers_are_fitted_or_refused_in_words(y: list[float], name: str) -> None:
    n = len(y)
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    u = np.random.default_rng(0).normal(size=(n, 1))
    data = Trajectory(np.arange(n) * 0.1, u, np.array(y)[:, None], spec)
    try:
        model = STATE[name]().fit([data], rng=RNG)
    except FitError as error:
        assert "expected" in str(error)
        assert "remedy" in str(error)
        return
    score = equation_error(model, data)
    assert score.rms.shape == (1,)
