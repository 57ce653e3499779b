"""Recursive least squares and online counting: equal to the batch, and their regret grows as theory says."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import regret
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear import Arx
from identifiers.online import RecursiveLeastSquares

RNG = np.random.default_rng(0)
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def stream(samples: int, seed: int, sigma: float = 0.1) -> Trajectory:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(samples, 1)), np.zeros((samples, 1))
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + u[k] + sigma * rng.normal()
    return Trajectory(np.arange(samples) * 1.0, u, y, SPEC)


def learned(online: RecursiveLeastSquares, *records: Trajectory):
    state = online.init(records[0].spec, rng=RNG)
    for one in records:
        state = online.start(state, one.y[0])
        for k in range(len(one) - 1):
            state = online.update(state, one.u[k], one.y[k + 1])
    return state


def test_recursive_equals_batch_to_rounding():
    records = [stream(150, 1), stream(90, 2)]
    online = RecursiveLeastSquares(order=3, prior=1e-12)
    theta = learned(online, *records).coefficients.T
    batch = Arx(order=3).fit(records, rng=RNG)
    assert theta[0, :3] == pytest.approx(batch.a_matrix[0, :3], abs=1e-11)
    assert theta[0, 3] == pytest.approx(batch.b_matrix[0, 0], abs=1e-11)
    assert theta[0, 6] == pytest.approx(batch.state_offset[0], abs=1e-11)
    assert np.array(online.hindsight(records).details["coefficients"])[:, 0] == pytest.approx(theta[0], abs=1e-11)


def test_no_fixed_predictor_beats_the_hindsight():
    record = stream(300, 4)
    online = RecursiveLeastSquares(order=1, offset=False, prior=1e-9)
    best = online.hindsight([record]).losses.sum()
    for theta in np.array([0.7, 1.0]) + 0.05 * np.random.default_rng(0).normal(size=(20, 2)):
        losses = (record.y[1:, 0] - theta[0] * record.y[:-1, 0] - theta[1] * record.u[:-1, 0]) ** 2
        assert losses.sum() >= best


def test_the_old_state_stays_valid():
    online = RecursiveLeastSquares(order=1)
    old = learned(online, stream(20, 0))
    before = old.coefficients.copy()
    online.update(old, np.array([5.0]), np.array([99.0]))
    assert np.array_equal(old.coefficients, before)


def test_forgetting_follows_a_plant_that_changes():
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(600, 1)), np.zeros((600, 1))
    for k in range(599):
        y[k + 1] = (0.8 if k < 300 else -0.4) * y[k] + u[k]
    record = Trajectory(np.arange(600.0), u, y, SPEC)
    found = [learned(RecursiveLeastSquares(order=1, forgetting=f), record).coefficients[0, 0] for f in (1.0, 0.95)]
    assert found[1] == pytest.approx(-0.4, abs=1e-3)
    assert abs(found[0] + 0.4) > 0.1


def test_a_seam_is_not_a_transition():
    record = stream(100, 5, sigma=0.0)
    online = RecursiveLeastSquares(order=2, offset=False, prior=1e-12)
    theta = learned(online, record[:40], record[60:]).coefficients
    y, u = record.y, record.u
    assert y[2:] == pytest.approx(np.hstack([y[1:-1], y[:-2], u[1:-1], u[:-2]]) @ theta, abs=1e-8)


@pytest.mark.parametrize("options", [{"order": 0}, {"forgetting": 0.0}, {"forgetting": 1.5}, {"prior": 0.0}])
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(FitError, match="options"):
        RecursiveLeastSquares(**options).init(SPEC, rng=RNG)


def test_records_shorter_than_the_order_are_refused_in_words():
    online = RecursiveLeastSquares(order=5)
    with pytest.raises(FitError, match="too short"):
        regret(online, [stream(4, 0)], rng=RNG)
