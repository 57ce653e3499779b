"""Hidden Markov models: likelihoods against a brute force, recovery against an observer of the hidden states."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import FitError, InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.predictive import probability_score
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.finite import hmm_pass
from identifiers.finite.hmm import HiddenMarkov, HmmModel, _from_moments
from identifiers.finite.mdp import MdpCounting
from identifiers.finite.smaller import compress_beliefs
from plants.finite.pomdp import FinitePomdp

RNG = np.random.default_rng(0)
T = np.array(
    [[[0.9, 0.07, 0.03], [0.2, 0.7, 0.1]], [[0.1, 0.8, 0.1], [0.05, 0.15, 0.8]], [[0.1, 0.1, 0.8], [0.7, 0.2, 0.1]]]
)
SEEN = np.array([[0.85, 0.1, 0.05, 0.0], [0.05, 0.8, 0.1, 0.05], [0.0, 0.05, 0.15, 0.8]])


def record(samples: int, seed: int = 0, transition=T, emission=SEEN, role: str = "estimation/0") -> Trajectory:
    scenario = create("scenarios", "random-policy", samples=samples)
    return run(FinitePomdp(transition, emission), scenario, streams=Streams("pomdp", "random", seed), role=role)


def drawn(states: int, actions: int, observations: int, seed: int):
    rng = np.random.default_rng(seed)
    return (
        rng.dirichlet(np.ones(states)),
        rng.dirichlet(np.ones(states), size=(states, actions)),
        rng.dirichlet(np.ones(observations), size=states),
    )


def raw(one: Trajectory) -> hmm_pass.Record:
    return one.y[:, 0].astype(np.intc), one.u[:, 0].astype(np.intc)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(1, 2), st.integers(2, 3), st.integers(0, 10_000))
def test_likelihood_and_counts_equal_the_sum_over_all_paths(states, actions, observations, seed):
    initial, P, E = drawn(states, actions, observations, seed)
    rng = np.random.default_rng(seed + 1)
    seen, action = rng.integers(observations, size=5).astype(np.intc), rng.integers(actions, size=5).astype(np.intc)
    total, pairs, emitted = 0.0, np.zeros(P.shape), np.zeros(E.shape)
    for path in itertools.product(range(states), repeat=5):
        chance = initial[path[0]] * E[path[0], seen[0]]
        for k in range(4):
            chance *= P[path[k], action[k], path[k + 1]] * E[path[k + 1], seen[k + 1]]
        total += chance
        for k in range(5):
            emitted[path[k], seen[k]] += chance
            if k < 4:
                pairs[path[k], action[k], path[k + 1]] += chance
    for native in (True, False):
        found = hmm_pass.expected_counts([(seen, action)], initial, P, E, native=native)
        assert found.log_likelihood == pytest.approx(np.log(total))
        assert found.transition == pytest.approx(pairs / total)
        assert found.emission == pytest.approx(emitted / total)


def test_compiled_and_numpy_recursions_agree():
    if hmm_pass.native_library() is None:
        pytest.skip("no C compiler: install gcc")
    records, tables = [raw(record(700)), raw(record(50, 1))], drawn(3, 2, 4, 1)
    fast, slow = (hmm_pass.expected_counts(records, *tables, native=native) for native in (True, False))
    assert fast.log_likelihood == pytest.approx(slow.log_likelihood, rel=1e-12)
    assert fast.transition == pytest.approx(slow.transition, rel=1e-9)
    assert fast.first == pytest.approx(slow.first, rel=1e-9)


def test_the_filter_of_the_model_is_that_of_the_recursions():
    data = record(40)
    model = HmmModel(data.spec, np.full(3, 1 / 3), T, SEEN)
    x, beliefs = model.initial_state(data), []
    for k in range(len(data)):
        x = model.correct(x, data.u[k], data.y[k])
        beliefs.append(x)
        x = model.step(x, data.u[k])
    assert np.array(beliefs) == pytest.approx(model.beliefs(data), abs=1e-12)
    score = probability_score(model, data)
    first = np.log(model.initial @ SEEN[:, int(data.y[0, 0])])
    assert score.log_score[0] * score.samples + first == pytest.approx(model.log_likelihood([data]))


def test_four_thousand_samples_are_worth_nearly_those_of_an_observer_of_the_states():
    """The observer counts the hidden states themselves: no estimator can do better."""
    ours, theirs = [], []
    for seed in range(3):
        data = record(4000, seed)
        model = HiddenMarkov(states=3, starts=4).fit([data], rng=np.random.default_rng(seed)).matched(SEEN)
        hidden = data.x[:, 0].astype(int)
        counts = np.zeros((3, 2, 3))
        np.add.at(counts, (hidden[:-1], data.u[:-1, 0].astype(int), hidden[1:]), 1.0)
        ours.append(np.abs(model.transition - T).mean())
        theirs.append(np.abs(counts / counts.sum(axis=2, keepdims=True) - T).mean())
        assert np.abs(model.emission - SEEN).mean() < 0.015
    assert np.mean(ours) < 2.5 * np.mean(theirs)
    assert np.mean(ours) < 0.03


def test_likelihood_never_falls_and_ends_above_the_truth():
    data = record(1500)
    for prior in (0.0, 0.5):
        trace = np.array(HiddenMarkov(states=3, starts=3, prior=prior).fit([data], rng=RNG).notes["log_likelihood"])
        assert (np.diff(trace) >= -1e-9 * np.abs(trace[0])).all()
    best = HiddenMarkov(states=3, starts=3).fit([data], rng=RNG)
    truth = HmmModel(data.spec, np.full(3, 1 / 3), T, SEEN)
    assert best.notes["log_likelihood"][-1] > truth.log_likelihood([data])


def test_the_order_is_found_and_stands_in_the_notes():
    model = HiddenMarkov(starts=3).fit([record(3000)], rng=RNG)
    assert model.notes["states"] == 3
    assert [order for order, _ in model.notes["criterion"]] == [1, 2, 3, 4]


def test_moments_converge_and_need_no_start():
    data = record(60_000)
    model = HiddenMarkov(states=3, method="spectral").fit([data], rng=RNG).matched(SEEN)
    assert np.abs(model.transition - T).mean() < 0.05
    assert np.abs(model.emission - SEEN).mean() < 0.03
    again = HiddenMarkov(states=3, method="spectral").fit([data], rng=np.random.default_rng(99)).matched(SEEN)
    assert np.array_equal(again.transition, model.transition)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(3, 5), st.integers(0, 10_000))
def test_exact_moments_give_the_exact_model(states, actions, observations, seed):
    _, P, E = drawn(states, actions, observations, seed)
    mixed = P.mean(axis=1)
    values, vectors = np.linalg.eig(mixed.T)
    pi = np.real(vectors[:, np.argmax(values.real)])
    pi /= pi.sum()
    triple = np.einsum("s,sa,st,tb,tu,uc->abc", pi, E, mixed, E, mixed, E)
    pairs = np.einsum("s,sa,skt,tb->kab", pi, E, P, E)
    if np.linalg.svd(triple.sum(axis=1))[1][states - 1] < 1e-4:
        return  # nearly without memory: no moments can tell the states
    initial, transition, emission = _from_moments(triple, pairs, states)
    found = HmmModel(record(5).spec, initial, transition, emission).matched(E)
    assert found.transition == pytest.approx(P, abs=1e-5)
    assert found.emission == pytest.approx(E, abs=1e-5)


def test_memory_is_worth_something_on_the_grid():
    plant = create("plants", "grid-pomdp", rows=2, columns=3, walls=[], error=0.3)
    scenario = create("scenarios", "random-policy", samples=8000)
    data, held = (
        run(plant, scenario, streams=Streams("g", "s", 0), role=f"{r}/0") for r in ("estimation", "validation")
    )
    hidden = HiddenMarkov(states=6, starts=3, prior=0.1).fit([data], rng=RNG)
    counted = MdpCounting(prior=0.5).fit([data], rng=RNG)
    hmm, mdp = probability_score(hidden, held), probability_score(counted, held)
    assert hmm.log_score[0] > mdp.log_score[0] + 0.05
    assert hmm.coverage[2, 0] == pytest.approx(0.9, abs=0.02)


def test_relabelling_permutes_and_changes_no_prediction():
    data = record(300)
    model = HiddenMarkov(states=3, starts=2).fit([data], rng=RNG)
    other = model.relabelled([2, 0, 1])
    assert other.transition[0, 1, 1] == model.transition[2, 1, 0]
    assert other.log_likelihood([data]) == pytest.approx(model.log_likelihood([data]))


@settings(max_examples=10, deadline=None)
@given(st.integers(1, 4), st.integers(0, 10_000))
def test_every_fit_gives_probabilities(states, seed):
    data = record(120, seed % 7)
    model = HiddenMarkov(states=states, starts=2, iterations=30).fit([data], rng=np.random.default_rng(seed))
    for table in (model.initial, model.transition, model.emission):
        assert table.min() >= 0
        assert table.sum(axis=-1) == pytest.approx(np.ones(table.shape[:-1]))


def test_refusals():
    data = record(50)
    with pytest.raises(FitError, match="at most 4"):
        HiddenMarkov(states=5, method="spectral").fit([data], rng=RNG)
    with pytest.raises(InputError, match="method"):
        HiddenMarkov(method="guess").fit([data], rng=RNG)  # type: ignore[arg-type]
    spec = PlantSpec((), (Channel("y"),), 1.0)
    with pytest.raises(FitError, match="finite process"):
        HiddenMarkov().fit([Trajectory(np.arange(9.0), np.zeros((9, 0)), np.zeros((9, 1)), spec)], rng=RNG)


def test_beliefs_near_a_line_are_compressed_and_stay_distributions():
    model = HmmModel(record(5).spec, np.full(3, 1 / 3), T, SEEN)
    visited = model.beliefs(record(400))
    errors = [compress_beliefs(visited, size, rng=np.random.default_rng(0)) for size in (1, 2, 3)]
    divergences = [one.divergence for one in errors]
    assert divergences[0] > divergences[1] > divergences[2]
    assert divergences[2] < 0.01, "as many typical beliefs as states"
    for one in errors:
        assert one.beliefs.sum(axis=1) == pytest.approx(np.ones(400))
        assert one.beliefs.min() >= 0
    rng = np.random.default_rng(1)
    ends, share = rng.dirichlet(np.ones(6), size=2), rng.random((50, 1))
    line = share * ends[0] + (1 - share) * ends[1]
    assert compress_beliefs(line, 2, rng=rng).divergence < 1e-4, "exact data, exact answer"


@pytest.mark.parametrize("samples", [200, 2000])
def test_standard_errors_hold_the_truth_and_follow_relabelling(samples):
    """95 % intervals of both tables: 90 to 100 % of 10 records' probabilities, as they lean on each other."""
    inside, warned = [], 0
    for seed in range(10):
        told = [record(samples, seed)]
        model = HiddenMarkov(states=3, starts=2).fit(told, rng=np.random.default_rng(0)).matched(SEEN)
        warned += "warning" in model.notes
        inside += [
            *(np.abs(model.transition - T) <= 1.96 * model.transition_error).ravel(),
            *(np.abs(model.emission - SEEN) <= 1.96 * model.emission_error).ravel(),
        ]
    assert 0.90 < np.mean(inside) <= 1.0
    assert warned <= 1 if samples == 2000 else warned == 10
    turned = model.relabelled([2, 0, 1])
    assert turned.transition_error[0, 1, 2] == model.transition_error[2, 1, 1]
    assert turned.emission_error.tolist() == model.emission_error[[2, 0, 1]].tolist()
    assert HmmModel.from_dict(model.to_dict()).transition_error.tolist() == model.transition_error.tolist()


def test_observations_that_never_occurred_are_said():
    one = record(400).measured()
    wider = replace(one.spec.outputs[0], maximum=one.spec.outputs[0].maximum + 3)
    model = HiddenMarkov(states=2).fit([replace(one, spec=replace(one.spec, outputs=(wider,)))], rng=RNG)
    assert any("3 of" in said and "never occurred" in said for said in model.findings)


def test_a_record_too_short_for_its_states_is_said():
    model = HiddenMarkov(states=3, starts=2).fit([record(60)], rng=np.random.default_rng(0))
    assert "the records are too short for 3 hidden states" in model.notes["warning"]
    assert "standard errors: at most" in model.findings[-1]
    ladder = create("analyses", "belief-compression", states=3)
    found = ladder.of(Dataset("short", (Run(record(60).measured()),)), rng=np.random.default_rng(0))
    assert "too short for 3 hidden states" in found.words[1]
