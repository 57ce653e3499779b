"""Reach of the data: nothing is added inside, more and more beyond, and what a plant does there lies in the bands."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.predictive import probability_score
from identifiers.common.reach import Reach
from identifiers.learned.recurrent import NeuralOutputError


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.integers(0, 10_000))
def test_inside_nothing_is_added_and_outside_more_with_distance(dimensions, seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(400, dimensions))
    reach = Reach.of(rows, np.sin(2 * rows[:, :1]), rng=np.random.default_rng(0))
    way = rng.normal(size=dimensions)
    way /= np.linalg.norm(way)
    away = reach.beyond(np.array([0.0, 10.0, 20.0, 40.0])[:, None] * way)
    assert away[0] == 0.0
    assert (np.diff(away) > 0).all()
    assert away[3] - away[2] == pytest.approx(20.0, rel=0.3)
    assert np.mean(reach.beyond(rng.normal(size=(400, dimensions))) > 0) < 0.1
    assert np.isnan(reach.beyond(np.full((1, dimensions), np.nan))).all()


@settings(max_examples=15, deadline=None)
@given(st.floats(0.1, 10.0), st.integers(0, 10_000))
def test_growth_has_the_unit_of_the_targets_and_is_zero_for_what_an_affine_function_says(size, seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(300, 2))
    bent = np.sin(2 * rows[:, :1]) + 0.1 * rows[:, 1:]
    one, other = (Reach.of(rows, scale * bent, rng=np.random.default_rng(1)) for scale in (1.0, size))
    assert other.growth == pytest.approx(size * one.growth, rel=1e-6)
    assert one.growth[0] > 0.05
    straight = Reach.of(rows, rows @ np.array([[1.0], [2.0]]), rng=np.random.default_rng(1))
    assert straight.growth[0] < 0.05 * one.growth[0] + 1e-2


def test_it_comes_back_from_its_file():
    rows = np.random.default_rng(0).normal(size=(100, 3))
    reach = Reach.of(rows, rows[:, :2] ** 2, rng=np.random.default_rng(0))
    read = Reach.from_dict(json.loads(json.dumps(reach.to_dict())))
    at = 5 * np.random.default_rng(1).normal(size=(7, 3))
    assert np.array_equal(read.std(at), reach.std(at))


def test_bands_of_an_ensemble_hold_in_the_data_and_at_twice_the_input():
    plant = create("plants", "pendulum-ode", sample_time=0.1)

    def swing(amplitude: float, role: str):
        options = dict(samples=400, amplitude=amplitude, band=[0.05, 2.0], noise=0.005)
        streams = Streams("pendulum-ode", "multisine", 0)
        return run(plant, create("scenarios", "multisine", **options), streams=streams, role=role).measured()

    options = dict(order=2, starts=8, members=4, iterations=60, ridge=0.1)
    model = NeuralOutputError(**options).fit([swing(0.4, "e/0")], rng=np.random.default_rng(0))
    calm, wild = (probability_score(model, swing(a, "v/0")).coverage[2, 0] for a in (0.4, 0.8))
    assert 0.85 <= calm <= 0.97
    assert wild >= 0.85, "0.46 where bands know only what held-out data showed"
