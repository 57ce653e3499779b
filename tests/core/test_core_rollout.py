"""The one stepping loop: what is recorded, when, and what it refuses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.protocols import Ability, Experiment
from harness.rng import Streams, stream
from harness.rollout import perform, run
from harness.signals import Channel, FloatArray, PlantSpec


class Integrator:
    """y[k+1] = y[k] + u[k]; with feedthrough y[k] + 10 u[k] is what is seen."""

    def __init__(self, *, feedthrough: bool = False, batch: bool = False, truth: bool = False) -> None:
        self.spec = PlantSpec(
            (Channel("u"),), (Channel("y"),), 0.5, states=(Channel("y"),) if truth else (), feedthrough=feedthrough
        )
        wanted: list[tuple[Ability, bool]] = [("feedthrough", feedthrough), ("batch", batch), ("truth", truth)]
        self.abilities: frozenset[Ability] = frozenset(name for name, has in wanted if has)
        self.value = 0.0
        self.steps = 0

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        self.value = (x0 or {}).get("y", 0.0)
        return np.array([self.value])

    def step(self, u: FloatArray) -> FloatArray:
        self.steps += 1
        self.value += float(u[0])
        return np.array([self.value])

    def output(self, u: FloatArray) -> FloatArray:
        return np.array([self.value + 10 * float(u[0])])

    def rollout(self, inputs: FloatArray) -> FloatArray:
        return self.value + np.cumsum(inputs, axis=0)

    def truth(self) -> FloatArray:
        return np.array([self.value])

    def close(self) -> None:
        self.value = np.nan

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


RNG = np.random.default_rng(0)
U = np.array([[1.0], [2.0], [3.0], [4.0]])


def test_the_log_is_t_u_and_the_output_before_u_acts() -> None:
    log = perform(Integrator(), Experiment(U, x0={"y": 5.0}), rng=RNG)
    assert log.t.tolist() == [0.0, 0.5, 1.0, 1.5]
    assert log.u[:, 0].tolist() == [1, 2, 3, 4]
    assert log.y[:, 0].tolist() == [5, 6, 8, 11]


def test_batch_equals_stepping_and_does_not_step() -> None:
    plant = Integrator(batch=True)
    disturbance = np.full_like(U, 0.25)
    fast = perform(plant, Experiment(U, disturbance=disturbance), rng=RNG)
    slow = perform(Integrator(), Experiment(U, disturbance=disturbance), rng=RNG)
    assert plant.steps == 0
    assert np.array_equal(fast.y, slow.y)
    assert np.array_equal(fast.u, U), "a disturbance is never recorded"


class WithTruth(Integrator):
    """Brings the truth with a batch; the truth is 100 more than the output, so that no one can mix them up."""

    def __init__(self) -> None:
        super().__init__(batch=True, truth=True)
        self.abilities |= {"batch-truth"}

    def truth(self) -> FloatArray:
        return np.array([self.value + 100.0])

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        y = self.rollout(inputs)
        return y, y + 100.0


@pytest.mark.parametrize("n", [1, 4])
def test_a_batch_with_the_truth_equals_stepping_and_does_not_step(n: int) -> None:
    plant, slow = WithTruth(), WithTruth()
    slow.abilities -= {"batch-truth"}
    fast_log, slow_log = (perform(one, Experiment(U[:n], x0={"y": 5.0}), rng=RNG) for one in (plant, slow))
    assert (plant.steps, slow.steps) == (0, n - 1)
    assert fast_log.x is not None
    assert slow_log.x is not None
    assert np.array_equal(fast_log.y, slow_log.y)
    assert np.array_equal(fast_log.x, slow_log.x)
    assert fast_log.x[0, 0] == 105.0


def test_a_batch_without_the_truth_is_not_used_where_the_truth_is_recorded() -> None:
    plant = Integrator(batch=True, truth=True)
    log = perform(plant, Experiment(U), rng=RNG)
    assert plant.steps == 3
    assert log.x is not None


def test_feedthrough_is_recorded_after_u_is_applied() -> None:
    log = perform(Integrator(feedthrough=True), Experiment(U), rng=RNG)
    assert log.y[:, 0].tolist() == [10, 21, 33, 46]


def test_the_controller_sees_only_the_measured_output() -> None:
    seen: list[float] = []

    def control(t: float, y: FloatArray) -> FloatArray:
        seen.append(float(y[0]))
        return -y

    log = perform(
        Integrator(truth=True),
        Experiment(np.zeros((4, 1)), controller=control, measure=lambda k, y: y + 100 + k, x0={"y": 1.0}),
        rng=RNG,
    )
    assert seen == log.y[:, 0].tolist()
    assert seen[0] == 101
    assert log.x is not None
    assert log.x[0, 0] == 1.0
    assert np.array_equal(log.u, -log.y)


@pytest.mark.parametrize("batch", [False, True])
def test_divergence_is_an_error_with_its_time(batch: bool) -> None:
    with pytest.raises(PlantError, match=r"not finite at t = 1 s") as caught:
        perform(Integrator(batch=batch), Experiment(np.array([[1.0], [np.inf], [0.0]])), rng=RNG)
    assert caught.value.status == "diverged"


@pytest.mark.parametrize("shape", [(4,), (4, 2), (0, 1)])
def test_a_scenario_of_the_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"shape \(N, 1\)"):
        perform(Integrator(), Experiment(np.zeros(shape)), rng=RNG)


def test_streams_depend_on_every_key_and_on_no_order() -> None:
    def first(*keys: str | int) -> float:
        return float(stream(*keys).random())

    values = {first("a", "b", 1), first("a", "b", 2), first("b", "a", 1), first("ab", 1), first("a", "b", "1")}
    assert len(values) == 5
    streams = Streams("p", "s", 3)
    noise = streams("noise").random(3)
    streams("other").random(1000)
    assert np.array_equal(noise, streams("noise").random(3))


def test_run_gives_each_role_its_own_stream() -> None:
    class Noise:
        def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
            return Experiment(streams(f"{role}/excitation").normal(size=(10, spec.nu)))

    def once(seed: int, role: str) -> FloatArray:
        return run(Integrator(), Noise(), streams=Streams("i", "n", seed), role=role).u

    assert np.array_equal(once(0, "estimation/0"), once(0, "estimation/0"))
    assert not np.array_equal(once(0, "estimation/0"), once(0, "validation/0"))
    assert not np.array_equal(once(0, "estimation/0"), once(1, "estimation/0"))
