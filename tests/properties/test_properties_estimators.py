"""Properties that every estimator of a class must have, on systems drawn at random."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from harness.scoring import equation_error, regret, simulation_error
from harness.signals import FloatArray
from harness.testing import finite_processes, linear_systems, simulate_finite, simulate_linear
from identifiers.finite.mdp import MdpCounting, OnlineCounting
from identifiers.linear.dmd import Dmdc
from identifiers.linear.ho_kalman import realize
from identifiers.linear.least_squares import Arx, LinearModel, StateLeastSquares
from identifiers.online.rls import RecursiveLeastSquares

RNG = np.random.default_rng(0)
SEEDS = st.integers(0, 2**32 - 1)


def close(a: FloatArray, b: FloatArray, tolerance: float = 1e-8) -> bool:
    """Return True if two arrays agree relative to their size."""
    return bool(np.abs(np.asarray(a) - b).max(initial=0.0) <= tolerance * max(1.0, float(np.abs(b).max(initial=0.0))))


@given(linear_systems(measured_state=True), SEEDS)
def test_order_of_records_and_repetition_do_not_matter(system, seed):
    records = [simulate_linear(system, 40 + 7 * i, rng=np.random.default_rng([seed, i]), noise=0.05) for i in range(3)]
    for identifier in (StateLeastSquares(least_excitation=0.0), Arx(order=2), Dmdc(offset=True)):
        one, other, twice = (identifier.fit(r, rng=RNG) for r in (records, records[::-1], records * 2))
        assert close(one.a_matrix, other.a_matrix)
        assert close(one.a_matrix, twice.a_matrix)


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
def test_the_true_system_has_no_error(system, seed):
    nx, nu, ny = system.A.shape[0], system.spec.nu, system.spec.ny
    record = simulate_linear(system, 50, rng=np.random.default_rng(seed))
    zeros = (np.zeros((ny, nu)), np.zeros((nx, ny)), np.zeros(nx), np.zeros(ny))
    model = LinearModel(system.spec, system.A, system.B, system.C, *zeros)
    for score in (simulation_error(model, record), equation_error(model, record)):
        assert (score.rms <= 1e-6 * (1 + np.abs(record.y).max())).all()


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
