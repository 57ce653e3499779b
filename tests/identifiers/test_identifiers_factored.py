"""Factored processes: what depends on what is found, and few samples say more than a joint table could."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring import predict
from harness.scoring.predictive import probability_score
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.finite.factored import FactoredCounting
from identifiers.finite.mdp import MdpCounting

RNG = np.random.default_rng(0)


def records(samples: int, machines: int = 5):
    plant = create("plants", "machines-mdp", machines=machines)
    scenario = create("scenarios", "random-policy", samples=samples)
    streams = Streams("machines-mdp", "random-policy", seed=0)
    return plant, run(plant, scenario, streams=streams), run(plant, scenario, streams=streams, role="validation/0")


def test_the_ring_is_found_and_its_probabilities():
    plant, data, _ = records(6000)
    model = FactoredCounting().fit([data], rng=RNG)
    for i in range(5):
        assert set(model.parents[f"m{i}"]) == {f"m{i}", f"m{(i - 1) % 5}", "reboot"}
    state = np.array([1.0, 0.0, 1.0, 1.0, 0.0])
    chance = model.step(model.correct(np.zeros(10), np.zeros(1), state), np.array([5.0]))[1::2]
    assert chance == pytest.approx(plant.chances(state, 5), abs=0.1)


def test_factors_learn_from_fewer_samples_than_the_joint_table():
    _, data, held_out = records(1500)
    factored = probability_score(FactoredCounting(prior=0.5).fit([data], rng=RNG), held_out)

    def joined(one: Trajectory) -> Trajectory:
        spec = PlantSpec(one.spec.inputs, (Channel("s", kind="category", minimum=0, maximum=31),), 1.0)
        return Trajectory(one.t, one.u, (one.y @ 2.0 ** np.arange(5))[:, None], spec)

    joint = probability_score(MdpCounting(prior=0.5).fit([joined(data)], rng=RNG), joined(held_out))
    assert factored.log_score.sum() > joint.log_score.sum() + 0.5
    assert factored.coverage[2] == pytest.approx(np.full(5, 0.9), abs=0.04)


def test_given_parents_are_used_and_unknown_names_refused():
    _, data, _ = records(300, machines=2)
    model = FactoredCounting(parents={"m0": ["reboot"]}).fit([data], rng=RNG)
    assert model.parents == {"m0": ("reboot",), "m1": ()}
    with pytest.raises(FitError, match="option parents"):
        FactoredCounting(parents={"m0": ["m7"]}).fit([data], rng=RNG)


def test_two_steps_ahead_against_the_enumerated_process():
    plant, data, _ = records(4000, machines=2)
    model = FactoredCounting().fit([data], rng=RNG)
    pairs = [np.array(p, dtype=float) for p in ((0, 0), (0, 1), (1, 0), (1, 1))]

    def joint(state, action) -> np.ndarray:
        up = plant.chances(state, action)
        return np.array([np.prod(np.where(p == 1, up, 1 - up)) for p in pairs])

    start, actions = np.array([1.0, 0.0]), (2, 2)
    exact = sum(w * joint(p, actions[1]) for w, p in zip(joint(start, actions[0]), pairs, strict=True))
    x = model.correct(np.zeros(4), np.zeros(1), start)
    for action in actions:
        x = model.step(x, np.array([float(action)]))
    assert x[1] == pytest.approx(exact[2] + exact[3], abs=0.05)
    assert x.reshape(2, 2).sum(axis=1) == pytest.approx(np.ones(2))
    assert predict(model, data, 2)[2:].shape == (3998, 2)
