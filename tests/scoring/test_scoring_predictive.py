"""Distributions and their scores: against closed forms, honest and dishonest forecasters, and known regret bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.errors import InputError
from harness.models.distributions import Categories, NormalMixture, normal
from harness.scoring.predictive import log_regret, probability_score, reliability
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import FiniteProcess, simulate_finite
from identifiers.finite.mdp import MdpCounting, MdpModel, OnlineCounting
from identifiers.online.baselines import HoldModel
from identifiers.online.rls import RecursiveLeastSquares

Y = (Channel("y", "m"),)


def process(states: int = 4, actions: int = 2) -> FiniteProcess:
    table = np.random.default_rng(5).dirichlet(np.ones(states), size=(states, actions))
    state = Channel("s", kind="category", minimum=0, maximum=states - 1)
    action = Channel("a", kind="category", minimum=0, maximum=actions - 1)
    return FiniteProcess(table, PlantSpec((action,), (state,), 1.0))


def test_normal_log_score_and_coverage_are_those_of_scipy():
    y = np.linspace(-3, 4, 50)[:, None]
    said = normal(np.full((50, 1), 0.7), np.full((50, 1), 1.3), Y)
    assert said.log_score(y) == pytest.approx(stats.norm(0.7, 1.3).logpdf(y), abs=1e-12)
    low, high = said.interval(0.9)
    assert (low[0, 0], high[0, 0]) == pytest.approx(stats.norm(0.7, 1.3).interval(0.9), abs=1e-9)
    assert np.array_equal(said.covered(y, 0.9) == 1.0, (y >= low) & (y <= high))


def test_a_mixture_is_scored_as_a_mixture():
    said = NormalMixture(np.array([[[-2.0], [2.0]]]), np.array([[[0.5], [1.0]]]), Y)
    y = np.array([[1.5]])
    expected = np.log(0.5 * stats.norm(-2, 0.5).pdf(1.5) + 0.5 * stats.norm(2, 1).pdf(1.5))
    assert said.log_score(y)[0, 0] == pytest.approx(expected)
    low, high = said.interval(0.8)
    inside = sum(0.5 * (stats.norm(m, s).cdf(high) - stats.norm(m, s).cdf(low)) for m, s in ((-2, 0.5), (2, 1.0)))
    assert inside.item() == pytest.approx(0.8, abs=1e-9)
    assert said.std[0, 0] == pytest.approx(np.sqrt(0.5 * (0.25 + 1.0) + 4.0))


def test_angles_are_wrapped():
    angle = (Channel("theta", "rad", period=2 * np.pi),)
    said = normal(np.array([[np.pi - 0.01]]), np.array([[0.1]]), angle)
    assert said.log_score(np.array([[-np.pi + 0.01]]))[0, 0] == pytest.approx(stats.norm(0, 0.1).logpdf(0.02))


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 7), st.floats(0.05, 0.95), st.integers(0, 10_000))
def test_the_randomised_set_holds_exactly_its_level(k, level, seed):
    p = np.random.default_rng(seed).dirichlet(np.ones(k))
    said = Categories((np.broadcast_to(p, (k, k)),))
    held = said.covered(np.arange(k, dtype=float)[:, None], level)[:, 0]
    assert p @ held == pytest.approx(level, abs=1e-9)


def test_the_true_model_is_calibrated_and_beats_every_distortion():
    true = process()
    data = simulate_finite(true, 6000, rng=np.random.default_rng(1))
    ones = np.ones(true.P.shape[:2])
    honest = probability_score(MdpModel(true.spec, true.P, ones), data)
    sharp = true.P**2 / (true.P**2).sum(axis=2, keepdims=True)
    for wrong in (sharp, 0.5 * true.P + 0.5 / 4):
        assert probability_score(MdpModel(true.spec, wrong, ones), data).log_score[0] < honest.log_score[0]
    assert honest.coverage[:, 0] == pytest.approx(honest.levels, abs=0.015)
    assert probability_score(MdpModel(true.spec, sharp, ones), data).coverage[2, 0] < 0.87
    assert honest.skill[0] > 0.05
    good, bad = (reliability(MdpModel(true.spec, p, ones), data) for p in (true.P, sharp))
    assert good.calibration_error < 0.02 < 0.05 < bad.calibration_error
    assert good.count.sum() == 4 * (len(data) - 1)


def test_the_expected_log_score_is_minus_the_entropy_rate():
    true = process()
    data = simulate_finite(true, 10_000, rng=np.random.default_rng(2))
    mixed = true.P.mean(axis=1)
    values, vectors = np.linalg.eig(mixed.T)
    pi = np.real(vectors[:, np.argmax(values.real)])
    pi /= pi.sum()
    rate = -np.einsum("s,sat,sat->", pi / 2, true.P, np.log(true.P))
    found = probability_score(MdpModel(true.spec, true.P, np.ones((4, 2))), data).log_score[0]
    assert found == pytest.approx(-rate, abs=0.03)


def test_what_was_called_impossible_costs_everything_and_is_counted():
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=1),), 1.0)
    y = np.array([[0.0, 0, 0, 1, 0, 0]]).T
    data = Trajectory(np.arange(6.0), np.zeros((6, 0)), y, spec)
    model = MdpModel(spec, np.array([[[1.0, 0.0]], [[0.5, 0.5]]]), np.ones((2, 1)))
    found = probability_score(model, data)
    assert found.log_score[0] == -np.inf
    assert found.impossible == 1
    assert "-inf" in str(found)


def test_regret_in_log_loss_of_counting_keeps_the_known_bound():
    true = process(3, 2)
    for n in (300, 3000):
        data = simulate_finite(true, n, rng=np.random.default_rng(n))
        found = log_regret(OnlineCounting(), [data], rng=np.random.default_rng(0))
        visits = MdpCounting().fit([data], rng=np.random.default_rng(0)).visits
        bound = np.sum(np.log(np.maximum(visits, 1)) * (3 - 1) / 2 + np.log(3))  # Cesa-Bianchi, Lugosi 2006, sec. 9.7
        assert 0 < found.total <= bound
        assert found.exact
        assert (found.steps.size, found.curve.size, found.scale.tolist()) == (0, 0, [1.0])


class Says(HoldModel):
    """Foretells the last outputs with deviations of 1 and 3, and wants two samples first."""

    burn_in = 2

    def predictive(self, x, u):
        return normal(x, np.array([1.0, 3.0]), self.spec.outputs)


def test_scores_of_two_real_outputs_are_counted_apart_behind_the_burn_in():
    spec = PlantSpec((), (Channel("a"), Channel("b")), 1.0)
    y = np.random.default_rng(0).normal(size=(40, 2)) * [1.0, 4.0]
    found = probability_score(Says(spec), Trajectory(np.arange(40.0), np.zeros((40, 0)), y, spec), levels=(0.5, 0.9))
    later, miss = y[2:], y[2:] - y[1:-1]
    said = stats.norm(0.0, [1.0, 3.0]).logpdf(miss).mean(axis=0)
    own = stats.norm(later.mean(axis=0), later.std(axis=0)).logpdf(later).mean(axis=0)
    assert found.log_score == pytest.approx(said)
    assert found.skill == pytest.approx(said - own)
    for level, share in zip((0.5, 0.9), found.coverage, strict=True):
        width = stats.norm.ppf(0.5 + level / 2) * np.array([1.0, 3.0])
        assert share == pytest.approx((np.abs(miss) <= width).mean(axis=0))
    assert (found.horizon, found.burn_in, found.samples, found.impossible) == (1, 2, 38, 0)


def test_models_without_distributions_are_refused_in_words():
    spec = PlantSpec((), Y, 1.0)
    data = Trajectory(np.arange(9.0), np.zeros((9, 0)), np.arange(9.0)[:, None], spec)
    with pytest.raises(InputError, match="predicts no distributions"):
        probability_score(HoldModel(spec), data)
    with pytest.raises(InputError, match="predicts no distributions"):
        log_regret(RecursiveLeastSquares(), [data], rng=np.random.default_rng(0))


@pytest.mark.parametrize("table", [[0.5, 0.6], [-0.1, 1.1]])
def test_probabilities_that_are_none_are_refused(table):
    with pytest.raises(InputError, match="sum 1"):
        Categories((np.array(table),))
