"""Thirty deliberate faults, written down before the checks that find them.

Each is a plausible slip of somebody who writes a plug-in: the code runs, and figures come out. ``FAULTS`` lists
them with the kind of part they are in. The sound estimator that most of them spoil is :class:`sound.Sound`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from sound import Lag, Noise, Sound, SoundModel, SoundOnline

from harness.protocols import Experiment, Hindsight
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec, Trajectory

Records = Sequence[Trajectory]


# ---- identifiers and their models ---------------------------------------------------------------------------------


class PredictsZero(Sound):
    """The model answers 0, whatever it learned."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(spec, 0.0 * G)


class IgnoresInput(Sound):
    """The inputs have no effect in the model."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        spoilt = G.copy()
        spoilt[spec.ny : spec.ny + spec.nu] = 0.0
        return SoundModel(spec, spoilt)


class NegatesInput(Sound):
    """The inputs have the opposite effect: B with the wrong sign."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        spoilt = G.copy()
        spoilt[spec.ny : spec.ny + spec.nu] *= -1.0
        return SoundModel(spec, spoilt)


class FirstInputOnly(Sound):
    """All inputs but the first are left out."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        spoilt = G.copy()
        spoilt[spec.ny + 1 : spec.ny + spec.nu] = 0.0
        return SoundModel(spec, spoilt)


class SeedsNumpy(Sound):
    """numpy's global generator is seeded 'for reproducibility'."""

    def seen(self, trajectories: Records) -> Records:
        np.random.seed(0)  # noqa: NPY002
        return trajectories


class DrawsFromRandom(Sound):
    """Python's global generator is drawn from (to no effect on the model)."""

    def seen(self, trajectories: Records) -> Records:
        random.random()
        return trajectories


class SilencesNumpy(Sound):
    """Floating-point warnings are switched off for the whole process."""

    def seen(self, trajectories: Records) -> Records:
        np.seterr(all="ignore")
        return trajectories


class _FromZero(SoundModel):
    def initial_state(self, data: Trajectory) -> FloatArray:
        return np.zeros(self.spec.ny)


class IgnoresInitialState(Sound):
    """Every simulation starts from 0."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return _FromZero(spec, G)


class SwapsOutputs(Sound):
    """The columns of the prediction are in reverse order."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(spec, G[:, ::-1].copy())


class InputOneSampleLate(Sound):
    """The fit pairs each output with the input of its own instant, the model with the one before."""

    def seen(self, trajectories: Records) -> Records:
        return [Trajectory(t.t[:-1], t.u[1:], t.y[:-1], t.spec) if len(t) > 1 else t for t in trajectories]


class FirstRecordOnly(Sound):
    """Only the first record is learned from."""

    def seen(self, trajectories: Records) -> Records:
        return list(trajectories)[:1]


class CrossesSeams(Sound):
    """The records are glued together before they are differenced."""

    def seen(self, trajectories: Records) -> Records:
        spec = trajectories[0].spec
        u, y = np.vstack([t.u for t in trajectories]), np.vstack([t.y for t in trajectories])
        return [Trajectory(np.arange(len(y)) * spec.sample_time, u, y, spec)]


class CachesBySpec(Sound):
    """A model once fitted for these channels is handed out again for other data."""

    cache: ClassVar[dict[PlantSpec, Any]] = {}

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return self.cache.setdefault(spec, SoundModel(spec, G))


class SharesItsBuffer(Sound):
    """Coefficients live in one buffer: a later fit changes the models of earlier ones."""

    buffers: ClassVar[dict[tuple[int, ...], FloatArray]] = {}

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        buffer = self.buffers.setdefault(G.shape, np.zeros(G.shape))
        buffer[:] = G
        return SoundModel(spec, buffer)


class EmptiesTheList(Sound):
    """The caller's list of records is empty afterwards."""

    def fit(self, trajectories: Any, *, rng: np.random.Generator) -> Any:
        records = list(trajectories)
        while isinstance(trajectories, list) and trajectories:
            trajectories.pop()
        return super().fit(records, rng=rng)


class NeedsAList(Sound):
    """Records in a tuple are a TypeError."""

    def fit(self, trajectories: Any, *, rng: np.random.Generator) -> Any:
        return super().fit(trajectories.copy(), rng=rng)


class TakesOtherChannels(Sound):
    """Records of two plants are pooled as long as their shapes agree."""

    def same_plant(self, trajectories: Records) -> bool:
        first = trajectories[0].spec
        return all(
            (t.spec.nu, t.spec.ny, t.spec.sample_time) == (first.nu, first.ny, first.sample_time) for t in trajectories
        )


class _OddFreeRun(SoundModel):
    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        rows = []
        for k in range(u.shape[1]):
            rows.append(self.output(x, u[:, k]))
            x = self.step(x, u[:, max(k - 1, 0)])  # the input of one sample before
        return np.stack(rows, axis=1)


class FreeRunOfItsOwn(Sound):
    """The fast free run is not what the steps give."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return _OddFreeRun(spec, G)


class _NeverScored(SoundModel):
    burn_in = 10**6


class NeverScored(Sound):
    """A burn-in longer than any record: no sample is ever scored."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return _NeverScored(spec, G)


class _Forgetful(SoundModel):
    def to_dict(self) -> dict[str, Any]:
        content = super().to_dict()
        content["G"] = np.round(self.G, 3).tolist()
        return content


class RoundsInJson(Sound):
    """The stored model has three digits of the fitted one."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return _Forgetful(spec, G)


class _Remembering(SoundModel):
    def initial_state(self, data: Trajectory) -> FloatArray:
        object.__setattr__(self, "shown", data.y)
        return np.array(data.y[0])

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        honest = super().step(x, u)
        shown = self.__dict__["shown"]
        nearest = shown[np.argmin(np.abs(shown[None] - honest.reshape(-1, 1, self.spec.ny)).sum(axis=-1), axis=-1)]
        return np.asarray(nearest.reshape(honest.shape))


class RoundsToTheFuture(Sound):
    """Predictions snap to the nearest output of the record that they are scored on."""

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return _Remembering(spec, G)


class NanFromARecordAtRest(Sound):
    """A record in which nothing moves gives a model of NaN instead of a refusal."""

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        if not trajectories or any(np.ptp(t.y, axis=0).any() or np.ptp(t.u, axis=0).any() for t in trajectories):
            return super().fit(trajectories, rng=rng)
        spec = trajectories[0].spec
        return SoundModel(spec, np.full((spec.ny + spec.nu + 1, spec.ny), np.nan))


# ---- online identifiers -------------------------------------------------------------------------------------------


class OnlinePredictsZero(SoundOnline):
    """The online prediction is always 0."""

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        return np.zeros_like(super().predict(state, u))


class OnlineHindsightTooWeak(SoundOnline):
    """What is called the best predictor in hindsight predicts 0, so that regret looks negative."""

    def hindsight(self, trajectories: Records) -> Hindsight:
        return Hindsight(np.concatenate([(t.y[1:] ** 2).sum(axis=1) for t in trajectories]), True)


class OnlineForgetsAtSeams(SoundOnline):
    """Each record begins with everything forgotten."""

    def start(self, state: Any, y: FloatArray) -> Any:
        spec_sized = (np.zeros_like(state[0]), np.zeros_like(state[1]), 0.0 * state[2])
        return super().start(spec_sized, y)


# ---- plants -------------------------------------------------------------------------------------------------------


class PlantIgnoresX0(Lag):
    """The name of the initial state is checked, its value forgotten."""

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        super().reset(rng=rng, x0=x0)
        return super().reset(rng=rng)


class PlantIgnoresInput(Lag):
    """The input is checked and then not applied."""

    def step(self, u: FloatArray) -> FloatArray:
        checked = super().step(u)
        self.x -= 0.1 * float(u[0])
        return checked - 0.1 * u


class PlantsShareTheirState(Lag):
    """The state belongs to the class, so that a second plant moves the first."""

    common: ClassVar[list[float]] = [0.0]

    @property
    def x(self) -> float:  # type: ignore[override]
        return self.common[0]

    @x.setter
    def x(self, value: float) -> None:
        self.common[0] = value


class PlantSeedsNumpy(Lag):
    """Process noise comes from numpy's global generator, seeded at each reset."""

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        np.random.seed(0)  # noqa: NPY002
        return super().reset(rng=rng, x0=x0)


# ---- scenarios ----------------------------------------------------------------------------------------------------


class SameNoiseForAllRoles(Noise):
    """Estimation and validation have the same sensor noise."""

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        noise = np.random.default_rng(0).normal(size=(100, spec.ny))
        return replace(
            super().prepare(spec, streams=streams, role=role), measure=lambda k, y: np.asarray(y + 0.01 * noise[k])
        )


@dataclass(frozen=True)
class Fault:
    """One fault: what kind of part it is in, and a factory of it."""

    kind: str
    make: Callable[[], Any]

    def __str__(self) -> str:
        return getattr(self.make, "__name__", "?")


_IDENTIFIERS = (
    PredictsZero, IgnoresInput, NegatesInput, FirstInputOnly, SeedsNumpy, DrawsFromRandom, SilencesNumpy,
    IgnoresInitialState,
    SwapsOutputs, InputOneSampleLate, FirstRecordOnly, CrossesSeams, CachesBySpec, SharesItsBuffer, EmptiesTheList,
    NeedsAList, TakesOtherChannels, FreeRunOfItsOwn, NeverScored, RoundsInJson, RoundsToTheFuture, NanFromARecordAtRest,
)  # fmt: skip

FAULTS = (
    *(Fault("identifiers", one) for one in _IDENTIFIERS),
    *(Fault("online", one) for one in (OnlinePredictsZero, OnlineHindsightTooWeak, OnlineForgetsAtSeams)),
    *(Fault("plants", one) for one in (PlantIgnoresX0, PlantIgnoresInput, PlantsShareTheirState, PlantSeedsNumpy)),
    Fault("scenarios", SameNoiseForAllRoles),
)
