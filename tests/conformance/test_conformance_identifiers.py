"""The checks of identifiers: an honest one passes them all, and each way to cheat fails the check named for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from harness.command import main
from harness.conformance import CheckResult, check_identifier, check_online_identifier, identifier_checks
from harness.errors import FitError
from harness.judgement import refuse_law
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.told import told


@dataclass(frozen=True)
class Model:
    """y[k+1] = G [y[k], u[k], 1]; the state is the newest output."""

    spec: PlantSpec
    G: FloatArray

    burn_in = 1

    def initial_state(self, data: Trajectory) -> FloatArray:
        return data.y[0].copy()

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.array(x)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        ones = np.ones((*x.shape[:-1], 1))
        return np.asarray(np.concatenate([x, u, ones], axis=-1) @ self.G)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(y)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "test-model", "G": self.G.tolist()}


@dataclass(frozen=True)
class Honest:
    """Least squares from one output to the next; the cheats below change one thing each."""

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        if not trajectories or any(t.spec != trajectories[0].spec for t in trajectories):
            raise FitError("records", expected="of one plant", got="others", remedy="separate them")
        self.judge(trajectories)
        trajectories = self.seen(trajectories)
        past = np.vstack([np.hstack([t.y[:-1], t.u[:-1], np.ones((len(t) - 1, 1))]) for t in trajectories])
        following = np.vstack([t.y[1:] for t in trajectories])
        if len(past) < past.shape[1] + 2:
            raise FitError("too short", expected="more", got=str(len(past)), remedy="record longer")
        G = np.linalg.lstsq(past, following, rcond=1e-10)[0]
        return self.model(replace(trajectories[0].spec, states=()), G * self.luck(rng))

    def judge(self, trajectories: Sequence[Trajectory]) -> None:
        refuse_law(trajectories, "honest")

    def seen(self, trajectories: Sequence[Trajectory]) -> Sequence[Trajectory]:
        return trajectories

    def luck(self, rng: np.random.Generator) -> float:
        return 1.0

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return Model(spec, G)


class TakesTheControllerForThePlant(Honest):
    def judge(self, trajectories: Sequence[Trajectory]) -> None:
        pass


@dataclass(frozen=True)
class NotedModel(Model):
    notes: Mapping[str, Any] = field(default_factory=dict)


class Decorated(TakesTheControllerForThePlant):
    """The remedy that the checks name."""

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        return super().fit(trajectories, rng=rng)

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NotedModel(spec, G)


class MutatesData(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        for t in trajectories:
            t.y.flags.writeable = True
            t.y[:] -= t.y.mean(axis=0)
        return trajectories


class WritesOnReadOnly(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        for t in trajectories:
            t.y[:] -= 1.0
        return trajectories


class GlobalRandom(Honest):
    def luck(self, rng: np.random.Generator) -> float:
        return 1.0 + 1e-9 * float(np.random.normal())  # noqa: NPY002


class Unseeded(Honest):
    def luck(self, rng: np.random.Generator) -> float:
        return 1.0 + 1e-6 * float(np.random.default_rng().normal())


class Remembers(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        memory = self.__dict__.setdefault("memory", [])
        memory += [t for t in trajectories if not memory or t.spec == memory[0].spec]
        return list(memory)


class PeeksAtTruth(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        return [t if t.x is None else replace(t, y=np.array(t.x[:, : t.spec.ny])) for t in trajectories]


class CrossesSeam(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        spec = trajectories[0].spec
        u, y = np.vstack([t.u for t in trajectories]), np.vstack([t.y for t in trajectories])
        return [Trajectory(np.arange(len(y)) * spec.sample_time, u, y, spec)]


class Unpicklable(Honest):
    def __init__(self) -> None:
        object.__setattr__(self, "hook", lambda: None)


class RaisesNakedly(Honest):
    def seen(self, trajectories):  # type: ignore[no-untyped-def]
        if sum(map(len, trajectories)) < 20:
            raise IndexError("index 3 is out of bounds")
        return trajectories


class AcceptsAnything(Honest):
    def fit(self, trajectories, *, rng):  # type: ignore[no-untyped-def]
        first = list(trajectories)[:1]
        if not first:
            return Model(PlantSpec((), (self.nothing(),), 1.0), np.zeros((2, 1)))
        return super().fit(first, rng=rng)

    @staticmethod
    def nothing() -> Any:
        from harness.signals import Channel

        return Channel("nothing")


class LeakyModel(Model):
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


class LeaksTheFuture(Honest):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return LeakyModel(spec, G)


class NoBatchModel(Model):
    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.concatenate([x.ravel(), u.ravel(), [1.0]])[: self.G.shape[0]] @ self.G


class NoBatch(Honest):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NoBatchModel(spec, G)


class ImpureModel(Model):
    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        count = self.__dict__.get("count", 0)
        object.__setattr__(self, "count", count + 1)
        return super().step(x, u) + 1e-12 * count


class Impure(Honest):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return ImpureModel(spec, G)


class NotJsonModel(Model):
    def to_dict(self) -> dict[str, Any]:
        return {"kind": "test-model", "G": self.G}


class NotJson(Honest):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return NotJsonModel(spec, G)


class OtherSampleTime(Honest):
    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return Model(replace(spec, sample_time=2 * spec.sample_time), G)


class Mutable:
    """Options that anybody can change."""

    def __init__(self, ridge: float = 0.0) -> None:
        self.ridge = ridge

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        return Honest().fit(trajectories, rng=rng)


def failed(results: list[CheckResult]) -> dict[str, str]:
    return {result.name: result.reason for result in results if not result.passed}


def test_an_honest_identifier_passes() -> None:
    results = check_identifier(Honest, examples=3)
    assert failed(results) == {}
    assert [r.name for r in results] == [c.name for c in identifier_checks()]


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
        (CrossesSeam, "no_seam_crossed", "seam"),
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
    from harness.conformance import run_checks

    (result,) = run_checks(only, cheat)
    assert not result.passed
    assert words in result.reason, result.reason
    assert "\n" not in result.reason


def test_the_remedy_that_a_check_names_is_one() -> None:
    from harness.conformance import run_checks

    only = [one for one in identifier_checks(examples=3) if one.name in ("feedback_told", "stillness_told")]
    assert failed(run_checks(only, Decorated)) == {}


def test_the_checks_are_parametrizable_and_raise() -> None:
    by_name = {check.name: check for check in identifier_checks(examples=2)}
    by_name["truth_never_read"](Honest)
    with pytest.raises(AssertionError, match="true states"):
        by_name["truth_never_read"](PeeksAtTruth)


def test_expected_failures_are_strict() -> None:
    results = {r.name: r for r in check_identifier(Mutable, examples=1, expected_failures={"interface": "on purpose"})}
    assert results["interface"].passed
    assert "fails as declared (on purpose)" in results["interface"].reason
    results = {
        r.name: r for r in check_identifier(Honest, examples=1, expected_failures={"interface": "x", "typo": "y"})
    }
    assert not results["interface"].passed
    assert "remove that" in results["interface"].reason
    assert not results["typo"].passed


# ---- online -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Averages:
    """Predicts the last output plus the mean step so far."""

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> Any:
        return (np.zeros(spec.ny), np.zeros(spec.ny), 0)

    def start(self, state: Any, y: FloatArray) -> Any:
        return (np.array(y), state[1], state[2])

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        return np.asarray(state[0] + state[1] / max(state[2], 1))

    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        return (np.array(y), state[1] + y - state[0], state[2] + 1)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        return Hindsight(np.concatenate([(np.diff(t.y, axis=0) ** 2).sum(axis=1) for t in trajectories]), False)


class UpdatesInPlace(Averages):
    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        state[1][:] += y - state[0]
        return (np.array(y), state[1], state[2] + 1)


class KeepsStreams(Averages):
    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        seen = self.__dict__.setdefault("seen", {})
        seen[u.tobytes()] = np.array(y)
        return super().update(state, u, y)

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        return np.asarray(self.__dict__.get("seen", {}).get(u.tobytes(), super().predict(state, u)))


class CarriesOver(Averages):
    def start(self, state: Any, y: FloatArray) -> Any:
        return (0.5 * (state[0] + y), state[1], state[2])


class ShortHindsight(Averages):
    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        return Hindsight(np.zeros(3), True)


def test_an_honest_online_identifier_passes() -> None:
    assert failed(check_online_identifier(Averages, examples=3)) == {}


@pytest.mark.parametrize(
    ("cheat", "check"),
    [
        (UpdatesInPlace, "online_no_mutation"),
        (KeepsStreams, "online_no_look_ahead"),
        (KeepsStreams, "online_deterministic"),
        (CarriesOver, "online_no_seam_crossed"),
        (ShortHindsight, "online_hindsight"),
        (Honest, "online_interface"),
    ],
)
def test_each_online_cheat_fails_the_check_named_for_it(cheat: Callable[[], Any], check: str) -> None:
    assert check in failed(check_online_identifier(cheat, examples=3))


def test_a_plug_in_that_hangs_ends_within_its_limit(tmp_path, capsys):
    """It took 320 s, whatever limit was given."""
    file = tmp_path / "slow.py"
    file.write_text("import time\n\n\nclass H:\n    def __init__(self):\n        time.sleep(60)\n")
    with pytest.raises(SystemExit) as end:
        main(["check", f"{file}:H", "--limit", "1"])
    assert end.value.code == 2
    assert "no sign of life for 1 s" in capsys.readouterr().err
