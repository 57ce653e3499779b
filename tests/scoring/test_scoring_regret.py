"""Regret of hand-made online learners equals the sum one computes by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from harness.errors import FitError
from harness.protocols import Hindsight
from harness.scoring import regret
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

SPEC = PlantSpec((), (Channel("y"),), 1.0)


def record(*y: float, spec: PlantSpec = SPEC) -> Trajectory:
    return Trajectory(np.arange(float(len(y))), np.zeros((len(y), 0)), np.array(y)[:, None], spec)


@dataclass(frozen=True)
class RunningMean:
    """Predicts the mean of the outputs after the first; the best constant in hindsight is the mean of them all."""

    wrong_length: bool = False

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> tuple[float, int, int]:
        return 0.0, 0, 0

    def start(self, state: Any, y: FloatArray) -> Any:
        return state[0], state[1], state[2] + 1

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        return np.array([state[0] / max(state[1], 1)])

    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        return state[0] + float(y[0]), state[1] + 1, state[2]

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        y = np.concatenate([one.y[1:, 0] for one in trajectories])
        losses = (y - y.mean()) ** 2
        return Hindsight(losses[:-1] if self.wrong_length else losses, exact=True)


def test_regret_by_hand_over_two_records():
    found = regret(RunningMean(), [record(9.0, 2.0, 4.0), record(7.0, 6.0)], rng=np.random.default_rng(0), scaled=False)
    # predictions 0, 2, 3 of 2, 4, 6 (the first output of a record is never predicted); best constant 4
    assert found.losses.tolist() == [4.0, 4.0, 9.0]
    assert found.hindsight.tolist() == [4.0, 0.0, 4.0]
    assert found.cumulative.tolist() == [0.0, 4.0, 9.0]
    assert (found.total, found.average, found.exact) == (9.0, 3.0, True)


def test_losses_are_in_units_of_the_output_s_variance():
    stream = [record(9.0, 2.0, 4.0), record(7.0, 6.0)]
    found = regret(RunningMean(), stream, rng=np.random.default_rng(0))
    variance = float(np.var([9.0, 2.0, 4.0, 7.0, 6.0]))
    assert found.losses * variance == pytest.approx([4.0, 4.0, 9.0])
    assert found.total * variance == pytest.approx(9.0)
    # R[n] against the best constant of the first n samples: 2; 2 and 4; 2, 4 and 6
    assert found.steps.tolist() == [1.0, 2.0, 3.0]
    assert found.curve * variance == pytest.approx([4.0, 8.0 - 2.0, 17.0 - 8.0])


def test_records_of_one_sample_hold_nothing_to_predict():
    found = regret(RunningMean(), [record(1.0), record(1.0, 2.0)], rng=np.random.default_rng(0), scaled=False)
    assert found.losses.tolist() == [4.0]
    for stream in ([], [record(1.0)]):
        with pytest.raises(FitError, match="empty stream"):
            regret(RunningMean(), stream, rng=np.random.default_rng(0), scaled=False)


def test_hindsight_of_other_samples_is_refused():
    with pytest.raises(FitError, match="one loss for each predicted sample"):
        regret(RunningMean(wrong_length=True), [record(1.0, 2.0, 3.0)], rng=np.random.default_rng(0), scaled=False)


def test_an_angle_is_lost_by_the_short_way_round():
    spec = PlantSpec((), (Channel("theta", "rad", period=2 * np.pi),), 1.0)

    class Hold(RunningMean):
        def start(self, state: Any, y: FloatArray) -> Any:
            return float(y[0]), 1, 0

    found = regret(Hold(), [record(3.1, -3.1, spec=spec)], rng=np.random.default_rng(0), scaled=False)
    assert found.losses[0] == pytest.approx((2 * np.pi - 6.2) ** 2)


def test_the_learner_is_told_of_every_seam_with_the_first_output_behind_it():
    class Follows(RunningMean):
        def start(self, state: Any, y: FloatArray) -> Any:
            return (*state, ("start", float(y[0])))

        def predict(self, state: Any, u: FloatArray) -> FloatArray:
            return np.array([state[-1][1]])

        def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
            seen.append(state[-1])
            return (*state, ("update", float(y[0])))

        def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
            return Hindsight(np.zeros(sum(len(one) - 1 for one in trajectories)), exact=False)

    seen: list[tuple[str, float]] = []
    stream = [record(1.0, 2.0, 4.0), record(50.0, 51.0)]
    found = regret(Follows(), stream, rng=np.random.default_rng(0), scaled=False)
    assert found.losses.tolist() == [1.0, 4.0, 1.0]  # a seam that is not told would cost (51 - 4)^2
    assert seen == [("start", 1.0), ("update", 2.0), ("start", 50.0)]


def test_a_wrong_category_costs_one():
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=5),), 1.0)
    found = regret(RunningMean(), [record(0.0, 5.0, 5.0, spec=spec)], rng=np.random.default_rng(0), scaled=False)
    assert found.losses.tolist() == [1.0, 0.0]
