"""Values, bisimulation, its metric and information states, against closed forms and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from harness.errors import InputError
from harness.registry import create
from harness.testing import FiniteProcess, simulate_finite
from identifiers.finite.bisimulation import bisimulation, bisimulation_metric, information_gap, quotient
from identifiers.finite.decision import (
    action_sufficient,
    optimal_values,
    policy_values,
    value_error_bound,
)
from identifiers.finite.mdp import MdpCounting
from plants.finite.mdp import FiniteMdp


def drawn(states: int, actions: int, seed: int):
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.ones(states), size=(states, actions)), rng.integers(0, 3, size=(states, actions)) / 2.0


def blown_up(P, r, copies: int, seed: int):
    """Split every state into copies that share its probabilities at random: bisimilar by construction."""
    rng = np.random.default_rng(seed)
    small = len(r)
    labels = rng.permutation(np.repeat(np.arange(small), copies))
    large = np.zeros((len(labels), r.shape[1], len(labels)))
    for s, label in enumerate(labels):
        for a in range(r.shape[1]):
            for b in range(small):
                large[s, a, labels == b] = P[label, a, b] * rng.dirichlet(np.ones(copies))
    return large, r[labels], labels


def same_partition(one, two) -> bool:
    return len(set(zip(one, two, strict=True))) == len(set(one)) == len(set(two))


def test_forty_states_are_eight():
    P, r = drawn(8, 3, 0)
    large, reward, truth = blown_up(P, r, 5, 1)
    labels = bisimulation(large, reward)
    assert labels.max() == 7
    assert same_partition(labels, truth)
    small, earned = quotient(large, reward, labels)
    values, _ = optimal_values(small, earned, 0.95)
    assert np.abs(optimal_values(large, reward, 0.95)[0] - values[labels]).max() < 1e-12


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 5), st.integers(1, 3), st.integers(1, 4), st.integers(0, 10_000))
def test_copies_are_found_and_nothing_else_is_merged(small, actions, copies, seed):
    P, _ = drawn(small, actions, seed)
    r = np.arange(small * actions, dtype=float).reshape(small, actions)
    large, reward, truth = blown_up(P, r, copies, seed + 1)
    labels = bisimulation(large, reward)
    assert same_partition(labels, truth)
    order = np.random.default_rng(seed).permutation(len(labels))
    moved = bisimulation(large[np.ix_(order, range(actions), order)], reward[order])
    assert same_partition(moved, labels[order])


def test_states_that_differ_only_in_the_far_future_are_told_apart():
    n = 30  # a chain whose end alone pays
    P = np.zeros((n, 1, n))
    P[np.arange(n - 1), 0, np.arange(1, n)] = 1.0
    P[-1, 0, -1] = 1.0
    reward = np.zeros((n, 1))
    reward[-1] = 1.0
    assert bisimulation(P, reward).max() == n - 1


def test_sparse_and_dense_agree():
    from scipy.sparse import csr_array

    P, r = drawn(6, 2, 3)
    large, reward, _ = blown_up(P, r, 3, 4)
    sparse = [csr_array(large[:, a]) for a in range(2)]
    assert np.array_equal(bisimulation(sparse, reward), bisimulation(large, reward))


def test_the_metric_is_one_and_bounds_values():
    P, r = drawn(6, 2, 7)
    d = bisimulation_metric(P, r, 0.8)
    assert np.array_equal(d, d.T)
    assert np.all(np.diag(d) == 0)
    assert (d[:, None, :] <= d[:, :, None] + d[None, :, :] + 1e-6).all(), "triangle"
    values, _ = optimal_values(P, r, 0.8)
    assert (np.abs(values[:, None] - values[None, :]) <= d + 1e-6).all()
    # it is the fixed point: one application, each transport solved for itself
    for s, t in ((0, 1), (2, 5)):
        best = []
        for a in range(2):
            rows = np.vstack([np.kron(np.eye(6), np.ones(6)), np.kron(np.ones(6), np.eye(6))])
            cost = linprog(d.ravel(), A_eq=rows, b_eq=np.concatenate([P[s, a], P[t, a]])).fun
            best.append(abs(r[s, a] - r[t, a]) + 0.8 * cost)
        assert max(best) == pytest.approx(d[s, t], abs=1e-5)


def test_the_metric_is_zero_between_copies_and_by_hand_on_two_loops():
    P, _ = drawn(3, 2, 11)
    large, reward, truth = blown_up(P, np.arange(6.0).reshape(3, 2), 3, 12)
    d = bisimulation_metric(large, reward, 0.7)
    assert ((d < 1e-9) == (truth[:, None] == truth[None, :])).all()
    loops = np.eye(2)[:, None, :]  # each stays where it is: d = |r - r'| / (1 - discount)
    assert bisimulation_metric(loops, np.array([[0.0], [0.3]]), 0.9)[0, 1] == pytest.approx(3.0, abs=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 8), st.integers(0, 10_000))
def test_information_states_keep_their_bound(states, seed):
    P, r = drawn(states, 2, seed)
    labels = np.random.default_rng(seed).integers(0, 2, size=states)
    labels[:2] = (0, 1)
    gap = information_gap(P, r, labels, 0.8)
    assert gap.realised <= gap.bound + 1e-9
    assert gap.loss <= 2 * gap.bound + 1e-9
    exact = information_gap(P, r, np.arange(states), 0.8)
    assert exact.bound < 1e-12
    assert exact.realised < 1e-9


def test_two_corridors_need_less_to_act_than_to_be_valued():
    even, slippery = create("plants", "corridors-mdp", length=5), create("plants", "corridors-mdp", length=5, slip=0.3)

    def classes(plant) -> tuple[int, int]:
        P, r = plant.true_transition, plant.true_reward
        found = bisimulation(P, r), action_sufficient(P, r, 0.9)
        return tuple(int(one.max()) + 1 for one in found)

    assert classes(even) == (6, 2), "without slip the corridors are the same but for the label"
    assert classes(slippery) == (11, 2), "with slip every cell has its own value, and still one action"


def test_policy_values_against_a_simulation():
    plant: FiniteMdp = create("plants", "corridors-mdp", length=2, slip=0.2)
    P, r = plant.true_transition, plant.true_reward
    uniform = np.full(r.shape, 0.5)
    values = policy_values(P, r, uniform, 0.8)
    rng = np.random.default_rng(0)
    total, runs = 0.0, 4000
    for _ in range(runs):
        s = 0
        for k in range(40):
            a = int(rng.integers(2))
            total += 0.8**k * r[s, a]
            s = int(rng.choice(len(P), p=P[s, a]))
    assert total / runs == pytest.approx(values[0], abs=0.03)


def test_values_of_a_counted_process_keep_their_bound_and_sets_cover():
    P = np.random.default_rng(0).dirichlet(np.ones(4), size=(4, 2)) * 0.9 + 0.1 / 4
    reward = np.random.default_rng(1).random((4, 2))
    spec = FiniteMdp(P).spec
    policy = np.full((4, 2), 0.5)
    true = policy_values(P, reward, policy, 0.9)
    covered, within = [], []
    for seed in range(40):
        data = simulate_finite(FiniteProcess(P, spec), 800, rng=np.random.default_rng(seed))
        model = MdpCounting().fit([data], rng=np.random.default_rng(0))
        covered.append((np.abs(model.transition - P).sum(axis=2) <= model.bound).mean())
        values = policy_values(model.transition, reward, policy, 0.9)
        within.append(np.abs(values - true).max() <= value_error_bound(model.bound, values, 0.9))
    assert np.mean(covered) >= 0.95
    assert np.mean(within) >= 0.95


def test_tables_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="reward"):
        optimal_values(np.full((2, 1, 2), 0.5), np.zeros((2, 2)), 0.9)
    with pytest.raises(InputError, match="discount"):
        optimal_values(np.full((2, 1, 2), 0.5), np.zeros((2, 1)), 1.0)
    with pytest.raises(InputError, match="reward"):
        bisimulation(np.full((2, 1, 2), 0.5), np.zeros((3, 1)))
