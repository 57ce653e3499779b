"""The checks of plants and scenarios: honest ones pass, each fault fails the check named for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sound

from harness.conformance import check_plant, check_scenario
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec


class Lag(sound.Lag):
    """The sound plant with every ability; the faults below change one thing each."""

    abilities: frozenset[Any] = frozenset({"snapshots", "batch", "truth"})

    def get_state(self) -> Any:
        return self.x, self.noise.bit_generator.state

    def set_state(self, state: Any) -> None:
        self.x = state[0]
        self.noise.bit_generator.state = state[1]

    def rollout(self, inputs: FloatArray) -> FloatArray:
        return np.array([self.step(u) for u in inputs])


class WrongShape(Lag):
    def step(self, u: FloatArray) -> FloatArray:
        return super().step(u)[:, None]


class Overwrites(Lag):
    def step(self, u: FloatArray) -> FloatArray:
        buffer: FloatArray = self.__dict__.setdefault("buffer", np.zeros(1))
        buffer[:] = super().step(u)
        return buffer


class Drifts(Lag):
    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        noise = self.noise
        y = super().reset(rng=rng, x0=x0)
        self.noise = noise
        return y


class TakesNan(Lag):
    def step(self, u: FloatArray) -> FloatArray:
        return super().step(np.nan_to_num(u, posinf=0.0))


class TakesAnyState(Lag):
    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        return super().reset(rng=rng)


class ForgetsNoise(Lag):
    def set_state(self, state: Any) -> None:
        self.x = state[0]


class OffBatch(Lag):
    def rollout(self, inputs: FloatArray) -> FloatArray:
        return super().rollout(inputs) + 1e-9


class PromisesFeedthrough(Lag):
    abilities = frozenset({"feedthrough"})


class TruthSteps(Lag):
    def truth(self) -> FloatArray:
        self.x += 1e-3
        return np.array([self.x])


class ChangesInput(Lag):
    def step(self, u: FloatArray) -> FloatArray:
        y = super().step(u)
        u *= 0.5
        return y


class CloseOnce(Lag):
    def close(self) -> None:
        if self.__dict__.setdefault("closed", False):
            raise RuntimeError("already closed")
        self.closed = True


class OddUnit(Lag):
    spec = replace(Lag.spec, outputs=(Channel("x", "gnats"),))


def failed(results: list[Any]) -> dict[str, str]:
    return {result.name: result.reason for result in results if not result.passed}


def test_an_honest_plant_passes() -> None:
    assert failed(check_plant(Lag)) == {}


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (WrongShape, "step_shapes"),
        (Overwrites, "step_shapes"),
        (Drifts, "reset_repeats"),
        (TakesNan, "bad_input_refused"),
        (TakesAnyState, "unknown_x0_refused"),
        (ForgetsNoise, "snapshot_equals_replay"),
        (OffBatch, "batch_equals_stepping"),
        (PromisesFeedthrough, "abilities"),
        (TruthSteps, "truth"),
        (ChangesInput, "arguments_left_alone"),
        (CloseOnce, "closes_twice"),
        (OddUnit, "interface"),
        (lambda: object(), "interface"),
    ],
)
def test_each_fault_fails_the_check_named_for_it(fault: Callable[[], Any], check: str) -> None:
    assert check in failed(check_plant(fault))


def test_a_declared_tolerance_is_allowed_and_no_more() -> None:
    class Coarse(Lag):
        snapshot_tolerance = 1e-6

        def set_state(self, state: Any) -> None:
            super().set_state(state)
            self.x += self.error

        error = 1e-8

    class TooCoarse(Coarse):
        error = 1e-3

    assert failed(check_plant(Coarse)) == {}
    assert "snapshot_equals_replay" in failed(check_plant(TooCoarse))


Noise = sound.Noise
"""The sound scenario; the faults below change one thing each."""


class InOrder(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        rng = self.__dict__.setdefault("rng", np.random.default_rng(0))
        return replace(super().prepare(spec, streams=streams, role=role), excitation=rng.uniform(size=(100, spec.nu)))


class OneRole(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        return super().prepare(spec, streams=Streams("one", "one", 0), role="estimation/0")


class Narrow(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        return replace(super().prepare(spec, streams=streams, role=role), excitation=np.zeros((100, spec.nu + 1)))


class TooLarge(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        experiment = super().prepare(spec, streams=streams, role=role)
        return replace(experiment, excitation=100 * experiment.excitation)


class InPlace(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        def measure(k: int, y: FloatArray) -> FloatArray:
            y += 0.01
            return y

        return replace(super().prepare(spec, streams=streams, role=role), measure=measure)


class Remembering(Noise):
    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        memory = type(self).__dict__.get("memory") or []
        type(self).memory = memory

        def controller(t: float, y: FloatArray) -> FloatArray:
            memory.append(t)
            return np.full(spec.nu, float(len(memory)))

        return replace(super().prepare(spec, streams=streams, role=role), controller=controller)

    memory: list[float] = []  # noqa: RUF012 - the fault is that runs share it


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (InOrder, "deterministic"),
        (OneRole, "roles_differ"),
        (Narrow, "fits_the_plant"),
        (TooLarge, "limits_kept"),
        (InPlace, "measures"),
        (Remembering, "controls"),
        (lambda: object(), "interface"),
    ],
)
def test_each_scenario_fault_fails_the_check_named_for_it(fault: Callable[[], Any], check: str) -> None:
    assert check in failed(check_scenario(fault))
