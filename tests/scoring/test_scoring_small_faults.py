"""Small faults of scores that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError
from harness.protocols import Hindsight
from harness.scoring import ControlRegret, linear_truth, linearise, regret
from harness.scoring.regret import _first
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from plants.equations.linear import LinearPlant

MATRICES = {"A": [[0.7, 0.4], [-0.4, 0.7]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]]}


def driven(plant: LinearPlant, size: float = 1.0, start: float = 0.5) -> Trajectory:
    """Return a record of white input, by the plant's equations."""
    u = size * np.random.default_rng(0).standard_normal((400, 1))
    x = np.zeros((400, 2))
    x[0] = start * size
    for k in range(399):
        x[k + 1] = plant.A @ x[k] + plant.B @ u[k]
    return Trajectory(np.arange(400) * 0.1, u, x @ plant.C.T + u @ plant.D.T, plant.spec, x)


@pytest.mark.parametrize("through", [0.0, 2.0])
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_a_linear_plant_without_noise_is_found_whatever_its_size_with_feedthrough_or_none(
    through: float, size: float
) -> None:
    plant = LinearPlant(**MATRICES, D=[[through]], sample_time=0.1)
    truth = linear_truth(plant, [driven(plant, size)], [None])
    assert truth is not None
    np.testing.assert_allclose(truth.a, MATRICES["A"], atol=1e-6)
    np.testing.assert_allclose(truth.d, [[through]], atol=1e-6)
    assert not truth.q.any()
    assert not truth.r.any()


def test_states_that_never_move_tell_no_truth() -> None:
    plant = LinearPlant(**MATRICES, D=[[0.0]], sample_time=0.1)
    assert linear_truth(plant, [driven(plant, 0.0)], [None]) is None


@pytest.mark.parametrize(
    ("abilities", "states"), [(frozenset(), (Channel("x"),)), (frozenset({"truth"}), ()), (frozenset(), ())]
)
def test_only_a_plant_that_tells_named_states_is_linearised(abilities: frozenset[str], states: Any) -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1, states)
    with pytest.raises(InputError, match="expected the ability 'truth'"):
        linearise(SimpleNamespace(spec=spec, abilities=abilities))


def test_control_regret_adds_up_what_is_beyond_the_best() -> None:
    found = ControlRegret(np.array([3.0, 2.0, 4.0]), np.array([1.0, 2.0, 1.0]), 1.0, (0,))
    assert found.cumulative.tolist() == [2.0, 2.0, 5.0]
    assert found.total == 5.0


@dataclass(frozen=True)
class Last:
    """Predicts the last output and the input that leads to the next."""

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
        return np.zeros(1)

    def start(self, state: FloatArray, y: FloatArray) -> FloatArray:
        return y

    def predict(self, state: FloatArray, u: FloatArray) -> FloatArray:
        return state + u

    def update(self, state: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return y

    def hindsight(self, trajectories: Any) -> Hindsight:
        return Hindsight(np.zeros(sum(len(one) - 1 for one in trajectories)), exact=True)


class Swift(Last):
    """The same in one go."""

    def track(self, state: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.concatenate([state[None], y[:-1]]) + u, y[-1]


def test_what_tracks_a_record_in_one_go_scores_as_it_does_sample_by_sample() -> None:
    spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    stream = [Trajectory(np.arange(5.0), rng.normal(size=(5, 1)), rng.normal(size=(5, 1)), spec) for _ in range(2)]
    one, other = (regret(learner, stream, rng=rng) for learner in (Last(), Swift()))
    np.testing.assert_array_equal(one.losses, other.losses)
    expected = [(r.y[k + 1, 0] - r.y[k, 0] - r.u[k, 0]) ** 2 for r in stream for k in range(4)]
    np.testing.assert_allclose(regret(Swift(), stream, rng=rng, scaled=False).losses, expected)


def test_the_first_samples_of_a_stream_end_where_a_record_does() -> None:
    spec = PlantSpec((), (Channel("y"),), 1.0)
    stream = [Trajectory(np.arange(float(n)), np.zeros((n, 0)), np.zeros((n, 1)), spec) for n in (5, 4)]
    sizes = {n: [len(one) for one in _first(stream, n)] for n in (1, 3, 4, 5, 7)}
    assert sizes == {1: [2], 3: [4], 4: [5], 5: [5, 2], 7: [5, 4]}
