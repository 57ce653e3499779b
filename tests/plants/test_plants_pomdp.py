"""POMDP: the observation's distribution, the hidden state, snapshots, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.protocols import Experiment
from harness.rng import stream
from harness.rollout import perform
from plants.finite.mdp import grid_mdp
from plants.finite.pomdp import FinitePomdp, grid_pomdp


def test_observations_follow_their_distribution_and_the_truth_is_the_chain() -> None:
    plant = grid_pomdp(error=0.3)
    actions = np.random.default_rng(1).integers(0, 4, size=(20_000, 1)).astype(float)
    log = perform(plant, Experiment(actions), rng=stream("pomdp", 0))
    assert log.x is not None
    hidden, seen = log.x[:, 0].astype(int), log.y[:, 0].astype(int)
    counts = np.zeros((11, 11))
    np.add.at(counts, (hidden, seen), 1)
    rates = counts / counts.sum(axis=1, keepdims=True)
    assert np.abs(rates - plant.observation).max() < 0.05
    assert (plant.true_transition[hidden[:-1], actions[:-1, 0].astype(int), hidden[1:]] > 0).all()


def test_without_error_it_is_the_mdp_seen() -> None:
    log = perform(grid_pomdp(error=0.0), Experiment(np.zeros((200, 1))), rng=stream("pomdp", 1))
    assert log.x is not None
    assert np.array_equal(log.x, log.y)


@pytest.mark.parametrize(
    ("table", "word"),
    [(np.ones((11, 2)), "sum of 1"), (np.full((3, 2), 0.5), r"\(11, O\)"), (-np.ones((11, 1)), ">= 0")],
)
def test_wrong_observations_are_refused(table: np.ndarray, word: str) -> None:
    with pytest.raises(InputError, match=word):
        FinitePomdp(grid_mdp().transition, table)
