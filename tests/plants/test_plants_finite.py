"""Finite MDP: distributions, draws, snapshots, refusals."""

from __future__ import annotations

import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from harness.errors import InputError
from harness.rng import stream
from plants.finite.mdp import FiniteMdp, grid_mdp

RNG = np.random.default_rng


def test_the_frequencies_are_the_probabilities() -> None:
    plant = grid_mdp()
    rng = RNG(1)
    actions = rng.integers(0, 4, size=(60_000, 1)).astype(float)
    y0 = plant.reset(rng=rng)
    states = np.concatenate([y0, plant.rollout(actions)[:, 0]]).astype(int)
    counts = np.zeros_like(plant.true_transition)
    np.add.at(counts, (states[:-1], actions[:, 0].astype(int), states[1:]), 1)
    visits = counts.sum(axis=2)
    assert visits.min() > 500, "the grid is ergodic"
    error = np.abs(counts / visits[:, :, None] - plant.true_transition).sum(axis=2)
    # Weissman et al. 2003: P(L1 error > sqrt(2 ln((2^S - 2) / delta) / n)) <= delta, over all 44 pairs.
    bound = np.sqrt(2 * np.log((2**11 - 2) * 44 / 1e-3) / visits)
    assert (error < bound).all()


@given(st.integers(1, 6), st.integers(1, 3), st.integers(0, 2**31))
def test_only_possible_states_are_reached(n_states: int, n_actions: int, seed: int) -> None:
    rng = RNG(seed)
    table = rng.random((n_states, n_actions, n_states)) * (rng.random((n_states, n_actions, n_states)) < 0.4)
    table[..., 0] += table.sum(axis=2) == 0
    table /= table.sum(axis=2, keepdims=True)
    plant = FiniteMdp(table)
    state = int(plant.reset(rng=rng)[0])
    for _ in range(30):
        action = int(rng.integers(n_actions))
        after = int(plant.step(np.array([float(action)]))[0])
        assert table[state, action, after] > 0
        state = after


def test_the_draws_belong_to_the_generator_given_at_reset() -> None:
    plant, other = grid_mdp(), grid_mdp()
    actions = RNG(3).integers(0, 4, size=(100, 1)).astype(float)
    records = []
    for one in (plant, other, plant):
        one.reset(rng=stream("grid", 5))
        records.append(one.rollout(actions))
    assert np.array_equal(records[0], records[1])
    assert np.array_equal(records[0], records[2])
    start = plant.reset(rng=stream("grid", 5), x0={"state": 3.0})
    assert start.tolist() == [3.0]


def test_slip_and_walls() -> None:
    plant = grid_mdp(rows=2, columns=2, walls=(), slip=0.2, restart=0.0)
    up, right = 0, 1
    assert plant.true_transition[2, up].tolist() == pytest.approx([0.8, 0, 0.1, 0.1])
    assert plant.true_transition[0, right].tolist() == pytest.approx([0.1, 0.8, 0.1, 0])


@pytest.mark.parametrize(
    ("transition", "initial", "word"),
    [
        (np.ones((2, 2)), None, r"\(S, A, S\)"),
        (np.full((2, 1, 2), 0.6), None, "sum of 1"),
        (np.array([[[1.5, -0.5]], [[0.5, 0.5]]]), None, ">= 0"),
        (np.full((2, 1, 2), np.nan), None, ">= 0"),
        (np.full((2, 1, 2), 0.5), [1.0, 0.0, 0.0], r"\(2,\)"),
        (np.full((2, 1, 2), 0.5), [0.3, 0.3], "sum of 1"),
    ],
)
def test_wrong_probabilities_are_refused(transition: object, initial: object, word: str) -> None:
    with pytest.raises(InputError, match=word):
        FiniteMdp(transition, initial)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [0.5, 4.0, -1.0, np.nan])
def test_actions_that_are_none_are_refused(bad: float) -> None:
    plant = grid_mdp()
    plant.reset(rng=RNG(0))
    with pytest.raises(InputError):
        plant.step(np.array([bad]))
    with pytest.raises(InputError):
        plant.reset(rng=RNG(0), x0={"state": 11.0})


@given(arrays.arrays(float, (3, 1, 3), elements=st.floats(-1, 2)))
def test_a_table_is_taken_only_if_it_is_a_distribution(table: np.ndarray) -> None:
    valid = (table >= 0).all() and np.abs(table.sum(axis=2) - 1).max() <= 1e-9
    if valid:
        FiniteMdp(table)
    else:
        with pytest.raises(InputError):
            FiniteMdp(table)
