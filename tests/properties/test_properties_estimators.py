"""Properties that every estimator of a class must have, on systems drawn at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from harness.scoring import equation_error, predict, regret, simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from harness.testing import finite_processes, linear_systems, simulate_finite, simulate_linear
from identifiers.finite.mdp import MdpCounting, OnlineCounting
from identifiers.koopman.koopman import Edmdc
from identifiers.linear.dmd import Dmdc
from identifiers.linear.ho_kalman import realize
from identifiers.linear.least_squares import Arx, LinearModel, StateLeastSquares
from identifiers.online.rls import RecursiveLeastSquares
from identifiers.sparse.stlsq import Stlsq

RNG = np.random.default_rng(0)
SEEDS = st.integers(0, 2**32 - 1)


def close(a: FloatArray, b: FloatArray, tolerance: float = 1e-8) -> bool:
    """Return True if two arrays agree relative to their size."""
    return bool(np.abs(np.asarray(a) - b).max(initial=0.0) <= tolerance * max(1.0, float(np.abs(b).max(initial=0.0))))


def rescaled(record: Trajectory, inputs: FloatArray, outputs: FloatArray) -> Trajectory:
    return Trajectory(record.t, record.u * inputs, record.y * outputs, record.spec)


def response(model: LinearModel, count: int) -> FloatArray:
    found, x = [], model.b_matrix
    for _ in range(count):
        found.append(model.c_matrix @ x)
        x = model.a_matrix @ x
    return np.array(found)


@given(linear_systems(measured_state=True), SEEDS)
def test_exact_states_give_the_exact_system(system, seed):
    records = [simulate_linear(system, 60, rng=np.random.default_rng([seed, i])) for i in range(2)]
    for identifier in (StateLeastSquares(least_excitation=0.0), Dmdc()):
        model = identifier.fit(records, rng=RNG)
        assert close(model.a_matrix, system.A, 1e-7)
        assert close(model.b_matrix, system.B, 1e-7)


@given(linear_systems(measured_state=True), SEEDS)
def test_order_of_records_and_repetition_do_not_matter(system, seed):
    records = [simulate_linear(system, 40 + 7 * i, rng=np.random.default_rng([seed, i]), noise=0.05) for i in range(3)]
    for identifier in (StateLeastSquares(least_excitation=0.0), Arx(order=2), Dmdc(offset=True)):
        one, other, twice = (identifier.fit(r, rng=RNG) for r in (records, records[::-1], records * 2))
        assert close(one.a_matrix, other.a_matrix)
        assert close(one.a_matrix, twice.a_matrix)


@given(linear_systems(measured_state=True), SEEDS, st.floats(-4, 4), st.floats(-4, 4))
def test_other_units_give_the_same_model_in_other_units(system, seed, a, b):
    record = simulate_linear(system, 80, rng=np.random.default_rng(seed), noise=0.02)
    inputs, outputs = np.full(system.spec.nu, 10.0**a), 10.0 ** np.linspace(0, b, system.spec.ny)
    for identifier in (StateLeastSquares(least_excitation=0.0), Arx(order=1)):
        plain = identifier.fit([record], rng=RNG)
        scaled = identifier.fit([rescaled(record, inputs, outputs)], rng=RNG)
        n = system.spec.ny
        assert close(scaled.a_matrix[:n, :n] * outputs / outputs[:, None], plain.a_matrix[:n, :n], 1e-6)
        assert close(scaled.b_matrix[:n] * inputs / outputs[:, None], plain.b_matrix[:n], 1e-6)


@given(linear_systems(measured_state=True, max_states=3), SEEDS)
def test_a_change_of_coordinates_is_a_similarity(system, seed):
    rng = np.random.default_rng(seed)
    n = system.A.shape[0]
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))
    record = simulate_linear(system, 80, rng=rng)
    noisy = replace(record, y=record.y + 0.01 * rng.normal(size=record.y.shape))
    turned = replace(noisy, y=noisy.y @ turn.T)
    identifier = StateLeastSquares(least_excitation=0.0)
    plain, other = identifier.fit([noisy], rng=RNG), identifier.fit([turned], rng=RNG)
    assert close(other.a_matrix, turn @ plain.a_matrix @ np.linalg.inv(turn), 1e-7)
    assert close(other.b_matrix, turn @ plain.b_matrix, 1e-7)


@given(linear_systems(max_states=3), SEEDS)
def test_a_realization_repeats_the_response_it_was_made_of(system, seed):
    x, G = system.B, []
    for _ in range(24):
        G.append(system.C @ x)
        x = system.A @ x
    markov = np.array(G)
    a, b, c, values = realize(markov)
    assume(values[0] > 1e-6)
    made, x = [], b
    for _ in range(24):
        made.append(c @ x)
        x = a @ x
    assert a.shape[0] <= system.A.shape[0]
    assert close(np.array(made), markov, 1e-5)


@given(linear_systems(), SEEDS)
def test_a_model_survives_its_description(system, seed):
    record = simulate_linear(system, 60, rng=np.random.default_rng(seed), noise=0.05)
    for identifier in (Arx(order=2), Dmdc(delays=2), Edmdc()):
        model = identifier.fit([record], rng=RNG)
        again = type(model).from_dict(model.to_dict())
        for horizon in (1, 3):
            assert np.array_equal(predict(again, record, horizon), predict(model, record, horizon), equal_nan=True)


@given(linear_systems(), SEEDS)
def test_the_true_system_has_no_error(system, seed):
    nx, nu, ny = system.A.shape[0], system.spec.nu, system.spec.ny
    record = simulate_linear(system, 50, rng=np.random.default_rng(seed))
    zeros = (np.zeros((ny, nu)), np.zeros((nx, ny)), np.zeros(nx), np.zeros(ny))
    model = LinearModel(system.spec, system.A, system.B, system.C, *zeros)
    for score in (simulation_error(model, record), equation_error(model, record)):
        assert (score.rms <= 1e-6 * (1 + np.abs(record.y).max())).all()


@given(linear_systems(), SEEDS, st.integers(1, 5))
def test_no_prediction_depends_on_what_it_predicts(system, seed, horizon):
    record = simulate_linear(system, 90, rng=np.random.default_rng(seed), noise=0.1)
    model = Arx(order=1).fit([record], rng=RNG)
    changed = np.array(record.y)
    changed[70:] += 100.0
    before = predict(model, record, horizon)[: 70 + horizon]
    after = predict(model, replace(record, y=changed), horizon)[: 70 + horizon]
    assert np.array_equal(before, after, equal_nan=True)


@given(linear_systems(max_states=2, max_inputs=1), SEEDS)
def test_recursive_least_squares_ends_where_the_batch_does(system, seed):
    record = simulate_linear(system, 60, rng=np.random.default_rng(seed), noise=0.1)
    online = RecursiveLeastSquares(order=1, prior=1e-8)
    state = online.start(online.init(system.spec, rng=RNG), record.y[0])
    for k in range(59):
        state = online.update(state, record.u[k], record.y[k + 1])
    assert close(state.coefficients, np.array(online.hindsight([record]).details["coefficients"]), 1e-9)
    assert regret(online, [record], rng=RNG).total > -1e-6 * np.sum(record.y**2)


@given(finite_processes(), SEEDS)
def test_counts_are_probabilities_that_add_over_records(process, seed):
    data = [simulate_finite(process, 80, rng=np.random.default_rng([seed, i])) for i in range(2)]
    whole, first, second = (MdpCounting().fit(r, rng=RNG) for r in (data, data[:1], data[1:]))
    assert close(whole.transition.sum(axis=2), np.ones(whole.visits.shape), 1e-12)
    assert np.array_equal(whole.visits, first.visits + second.visits)
    assert whole.visits.sum() == 158
    assert regret(OnlineCounting(), data, rng=RNG).total >= 0.0


@given(st.integers(0, 1000), st.floats(-3, 3))
def test_sparse_terms_do_not_depend_on_units(seed, exponent):
    rng = np.random.default_rng(seed)
    unit = 10.0**exponent
    x = [np.array([0.5, 0.1])]
    for _ in range(150):
        q, w = x[-1]
        x.append(np.array([0.9 * q + 0.3 * w, -0.4 * q + 0.7 * w + 0.2 * rng.normal()]))
    y = np.array(x)
    spec = PlantSpec((), (Channel("q"), Channel("w")), 1.0)
    found = [
        Stlsq(time="discrete", degree=2).fit(
            [Trajectory(np.arange(151.0), np.zeros((151, 0)), y * scale, spec)], rng=RNG
        )
        for scale in (1.0, unit)
    ]
    assert found[0].support == found[1].support
    assert found[0].support[0] == ("q", "w")
