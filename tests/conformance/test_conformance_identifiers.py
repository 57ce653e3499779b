"""The checks of identifiers: each way to cheat fails the check named for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import faults
import numpy as np
import pytest
from sound import Sound, SoundModel, SoundOnline

from harness.conformance import CheckResult, check_online_identifier, identifier_checks, run_checks
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.told import told


class TakesTheControllerForThePlant(Sound):
    judges = False


@dataclass(frozen=True)
class NotedModel(SoundModel):
    notes: Mapping[str, Any] = field(default_factory=dict)


class Decorated(TakesTheControllerForThePlant):
    """The remedy that the checks name."""

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        return super().fit(trajectories, rng=rng)

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NotedModel(spec, G)


class MutatesData(Sound):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        for t in trajectories:
            t.y.flags.writeable = True
            t.y[:] -= t.y.mean(axis=0)
        return trajectories


class WritesOnReadOnly(Sound):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        for t in trajectories:
            t.y[:] -= 1.0
        return trajectories


class GlobalRandom(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(spec, G * (1.0 + 1e-9 * float(np.random.normal())))  # noqa: NPY002


class Unseeded(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(spec, G * (1.0 + 1e-6 * float(np.random.default_rng().normal())))


class Remembers(Sound):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        memory = self.__dict__.setdefault("memory", [])
        memory += [t for t in trajectories if not memory or t.spec == memory[0].spec]
        return list(memory)


class PeeksAtTruth(Sound):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        return [t if t.x is None else replace(t, y=np.array(t.x[:, : t.spec.ny])) for t in trajectories]


class Unpicklable(Sound):
    def __init__(self) -> None:
        object.__setattr__(self, "hook", lambda: None)


class RaisesNakedly(Sound):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        if sum(map(len, trajectories)) < 20:
            raise IndexError("index 3 is out of bounds")
        return trajectories


class AcceptsAnything(Sound):
    def fit(self, trajectories, *, rng):  # type: ignore[no-untyped-def]
        first = list(trajectories)[:1]
        if not first:
            return SoundModel(PlantSpec((), (self.nothing(),), 1.0), np.zeros((2, 1)))
        return super().fit(first, rng=rng)

    @staticmethod
    def nothing() -> Any:
        from harness.signals import Channel

        return Channel("nothing")


class LeakyModel(SoundModel):
    """Remembers the record that it was shown, and answers with its next output."""

    def initial_state(self, data: Trajectory) -> FloatArray:
        if len(data) > 3:
            object.__setattr__(self, "future", data.y)
        return np.append(data.y[0], 0.0)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        future = self.__dict__.get("future")
        k = x[..., -1].astype(int)
        return np.array(x[..., :-1]) if future is None else future[np.minimum(k, len(future) - 1)]

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.concatenate([super().step(x[..., :-1], u), x[..., -1:] + 1], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.concatenate([np.broadcast_to(y, x[..., :-1].shape), x[..., -1:]], axis=-1)


class LeaksTheFuture(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return LeakyModel(spec, G)


class NoBatchModel(SoundModel):
    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.concatenate([x.ravel(), u.ravel(), [1.0]])[: self.G.shape[0]] @ self.G


class NoBatch(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NoBatchModel(spec, G)


class ImpureModel(SoundModel):
    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        count = self.__dict__.get("count", 0)
        object.__setattr__(self, "count", count + 1)
        return super().step(x, u) + 1e-12 * count


class Impure(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return ImpureModel(spec, G)


class NotJsonModel(SoundModel):
    def to_dict(self) -> dict[str, Any]:
        return {"kind": "test-model", "G": self.G}


class NotJson(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NotJsonModel(spec, G)


class OtherSampleTime(Sound):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(replace(spec, sample_time=2 * spec.sample_time), G)


class Mutable:
    """Options that anybody can change."""

    def __init__(self, ridge: float = 0.0) -> None:
        self.ridge = ridge

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        return Sound().fit(trajectories, rng=rng)


def failed(results: list[CheckResult]) -> dict[str, str]:
    return {result.name: result.reason for result in results if not result.passed}


@pytest.mark.parametrize(
    ("cheat", "check", "words"),
    [
        (MutatesData, "no_mutation", "changed its data"),
        (WritesOnReadOnly, "no_mutation", "tries to change its data"),
        (GlobalRandom, "no_mutation", "global random state"),
        (Unseeded, "deterministic", "differ"),
        (Remembers, "refit_equals_fresh_fit", "left a trace"),
        (Remembers, "no_mutation", "changes the identifier itself"),
        (PeeksAtTruth, "truth_never_read", "true states"),
        (faults.CrossesSeams, "no_seam_crossed", "seam"),
        (Unpicklable, "pickles", "pickle"),
        (RaisesNakedly, "bad_data_refused", "IndexError"),
        (AcceptsAnything, "bad_data_refused", "accepted"),
        (LeaksTheFuture, "model_no_look_ahead", "not yet seen"),
        (NoBatch, "model_batch_axes", "batch"),
        (Impure, "model_pure_steps", "second time"),
        (NotJson, "model_stored_and_read", "JSON"),
        (OtherSampleTime, "model_other_data_refused", "sample time"),
        (Mutable, "interface", "frozen"),
        (TakesTheControllerForThePlant, "feedback_told", "nothing else moved u"),
        (TakesTheControllerForThePlant, "stillness_told", "the decorator @told"),
    ],
)
def test_each_cheat_fails_the_check_named_for_it(cheat: Callable[[], Any], check: str, words: str) -> None:
    only = [one for one in identifier_checks(examples=3) if one.name == check]
    (result,) = run_checks(only, cheat)
    assert not result.passed
    assert words in result.reason, result.reason
    assert "\n" not in result.reason


def test_the_remedy_that_a_check_names_is_one() -> None:
    only = [one for one in identifier_checks(examples=3) if one.name in ("feedback_told", "stillness_told")]
    assert failed(run_checks(only, Decorated)) == {}


# ---- online -------------------------------------------------------------------------------------------------------


class UpdatesInPlace(SoundOnline):
    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        new = super().update(state, u, y)
        state[1][:] = new[1]
        return new


class KeepsStreams(SoundOnline):
    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        seen = self.__dict__.setdefault("seen", {})
        seen[u.tobytes()] = np.array(y)
        return super().update(state, u, y)

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        return np.asarray(self.__dict__.get("seen", {}).get(u.tobytes(), super().predict(state, u)))


class CarriesOver(SoundOnline):
    def start(self, state: Any, y: FloatArray) -> Any:
        return (0.5 * (state[0] + y), state[1], state[2])


class ShortHindsight(SoundOnline):
    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        return Hindsight(np.zeros(3), True)


@pytest.mark.parametrize(
    ("cheat", "check"),
    [
        (UpdatesInPlace, "online_no_mutation"),
        (KeepsStreams, "online_no_look_ahead"),
        (KeepsStreams, "online_deterministic"),
        (CarriesOver, "online_no_seam_crossed"),
        (ShortHindsight, "online_hindsight"),
        (Sound, "online_interface"),
    ],
)
def test_each_online_cheat_fails_the_check_named_for_it(cheat: Callable[[], Any], check: str) -> None:
    assert check in failed(check_online_identifier(cheat, examples=3))


def test_a_plug_in_that_hangs_ends_within_its_limit(tmp_path, sysid):
    """It took 320 s, whatever limit was given."""
    file = tmp_path / "slow.py"
    file.write_text("import time\n\n\nclass H:\n    def __init__(self):\n        time.sleep(60)\n")
    assert "no sign of life for 1 s" in sysid("check", f"{file}:H", "--limit", "1", status=2).err
