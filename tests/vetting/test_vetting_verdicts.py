"""What each check says of what came of it: passed, failed, or nothing to pass."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.signals import Channel, PlantSpec, Trajectory
from harness.vetting import inside
from harness.vetting.described import _experiment
from harness.vetting.findings import Finding, Vetting
from harness.vetting.reference import _channel, _Drive, _held, _step, _stepped
from harness.vetting.runs import CHANGES, CHECKS, FEWEST, LEAK, RETURNS, FmuSubject, excited
from harness.vetting.tubes import Tube

N, DT = 50, 0.1
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), DT)
Y = np.sin(0.3 * np.arange(N))[:, None]
RECORD = Trajectory(DT * np.arange(N), np.zeros((N, 1)), Y, SPEC)
CONTENT = {"kinds": {"co-simulation": {"variable step": True}}, "fmi": "2.0", "event_indicators": 0, "problems": ()}


class Told(FmuSubject):
    """An FMU of which every run and every look inside is made up."""

    answers: Mapping[str, Any] = {}
    y = Y
    warnings: tuple[str, ...] = ()
    ends = np.inf

    def inside(self, work: Any, *arguments: Any, **more: Any) -> Any:
        answer = self.answers[work.__name__]
        if isinstance(answer, Exception):
            raise answer
        return answer

    @contextmanager
    def plant(self, **more: Any) -> Any:
        def rollout(u: np.ndarray) -> np.ndarray:
            if len(u) + 1 > self.ends:
                raise PlantError("it ends", status="terminated")
            return self.y[1 : len(u) + 1]

        yield SimpleNamespace(reset=lambda **_: self.y[0], rollout=rollout, spec=SPEC, warnings=self.warnings)


def found(
    check: str, abilities: Mapping[str, Any] | None = None, y: np.ndarray = Y, scale: float = 1.0, **more: Any
) -> Finding:
    """Return what a check says of outputs in any unit."""
    content = {**CONTENT, **{name: more.pop(name) for name in CONTENT if name in more}}
    if abilities is not None:
        content["kinds"] = {"co-simulation": abilities}
    own = type("Own", (Told,), {"answers": more, "y": scale * y})
    return CHECKS[check](own(Path("x.fmu"), content, {}, 1.0), replace(RECORD, y=scale * Y))[0]


@pytest.mark.parametrize(("off", "same"), [(0.0, True), (1e-9, False)])
def test_what_must_be_the_same_is_so_to_the_bit(off: float, same: bool) -> None:
    assert found("determinism", y=Y + off).passed is same
    assert found("determinism", y=Y + off).figure == pytest.approx(off, rel=1e-6)
    assert found("two at once", {"variable step": True}, apart=off).passed is same
    both = {"serialise state": True, "get and set state": True}
    one = found("serialised state", both, serialised=(80, off))
    assert (one.passed, one.came.startswith("80 bytes, the ")) == (same, True)


@pytest.mark.parametrize("lacks", ["serialise state", "get and set state"])
def test_what_an_fmu_does_not_offer_it_neither_passes_nor_fails(lacks: str) -> None:
    both = {"serialise state": True, "get and set state": True, lacks: False}
    assert found("serialised state", both).passed is None
    assert found("two at once", {}).passed is None
    assert found("two at once", {"variable step": True}, fmi="1.0").passed is None
    assert found("two at once", {"variable step": True, "once per process": True}).passed is None
    assert found("leaks", {"once per process": True}).passed is None
    assert found("events", {}, event_indicators=3).came == "3 event indicators, no event mode"
    assert found("derivatives", {}).passed is None


def test_a_state_that_cannot_be_written_fails_with_its_reason() -> None:
    both = {"serialise state": True, "get and set state": True}
    one = found("serialised state", both, serialised=InputError("state", expected="", got="an error", remedy=""))
    assert (one.passed, one.came) == (False, "an error")


@pytest.mark.parametrize(("off", "passed"), [(0.9, True), (1.1, False)])
def test_what_may_differ_a_little_is_held_against_the_size_of_the_outputs(off: float, passed: bool) -> None:
    size = float(np.ptp(Y))
    for scale in (1.0, 1e-4):
        assert found("events", {"event mode": True}, y=Y + off * 1e-3 * size, scale=scale).passed is passed
    slopes = {"directional derivatives": True}
    assert found("derivatives", slopes, slopes=(off * RETURNS, True)).passed is passed
    assert found("derivatives", slopes, slopes=(off * RETURNS, False)).passed is None, "no output follows"
    one = found("leaks", {}, instances={"memory": off * LEAK, "files": 0.0, "threads": 0.0, "known": 1.0})
    assert one.passed is passed
    for what in ("files", "threads"):
        told = {"memory": 0.0, "files": 0.0, "threads": 0.0, "known": 1.0, what: 0.1 * off}
        assert found("leaks", {}, instances=told).passed is passed
    unknown = {"memory": 0.0, "files": 0.0, "threads": 0.0, "known": 0.0}
    assert found("leaks", {}, instances=unknown).passed is None


@pytest.mark.parametrize(
    ("declared", "told", "moved", "passed"),
    [
        (["y"], True, ["y"], True),
        ([], True, [], True),
        ([], True, ["y"], False),
        ([], False, ["y"], None),
        (["y"], True, [], None),
    ],
)
def test_what_changes_at_once_is_held_against_what_is_declared(
    declared: list[str], told: bool, moved: list[str], passed: bool | None
) -> None:
    assert found("dependencies", direct=(declared, told, moved)).passed is passed


def test_derivatives_by_states_are_a_check_of_model_exchange() -> None:
    kinds = {"co-simulation": {}, "model exchange": {"directional derivatives": True}}
    for fmi, off, passed in (("2.0", 0.5 * RETURNS, True), ("2.0", 2 * RETURNS, False), ("2.0", None, None)):
        own = type("Own", (Told,), {"answers": {"state_slopes": off}})
        two = CHECKS["derivatives"](own(Path("x.fmu"), {**CONTENT, "kinds": kinds, "fmi": fmi}, {}, 1.0), RECORD)
        assert [(one.name, one.passed) for one in two] == [("derivatives", None), ("state derivatives", passed)]
    old = Told(Path("x.fmu"), {**CONTENT, "kinds": kinds, "fmi": "1.0"}, {}, 1.0)
    assert [one.name for one in CHECKS["derivatives"](old, RECORD)] == ["derivatives"]


@pytest.mark.parametrize(("share", "passed"), [(0.9, True), (1.1, False)])
def test_half_the_step_may_change_a_share_of_the_range(share: float, passed: bool) -> None:
    class Halved(Told):
        @contextmanager
        def plant(self, **more: Any) -> Any:
            times = round(DT / more["sample_time"])
            error = share * CHANGES * float(np.ptp(Y)) * (2.0 / times - 2.0)  # of first order: as large as the step
            y = (
                np.repeat(Y, times, axis=0)[: (N - 1) * times + 1]
                + error * np.linspace(0, 1, (N - 1) * times + 1)[:, None]
            )
            yield SimpleNamespace(reset=lambda **_: y[0], rollout=lambda u: y[1 : len(u) + 1], spec=SPEC)

    (one,) = CHECKS["step halving"](Halved(Path("x.fmu"), CONTENT, {}, 1.0), RECORD)
    assert one.passed is passed
    assert one.figure == pytest.approx(share * CHANGES, rel=0.05)
    assert one.came.endswith("order 1.0")
    fixed = found("step halving", {"fixed internal step": True})
    assert fixed.passed is None


def test_an_fmu_that_ends_a_run_is_tried_up_to_there() -> None:
    for samples, ends, names, length in ((40, 25.0, ["ends", "runs"], 20), (40, 5.0, ["ends"], None)):
        own = type("Own", (Told,), {"ends": ends})
        findings, record = excited(own(Path("x.fmu"), CONTENT, {}, 1.0, samples))
        assert [one.name for one in findings] == names
        assert (None if record is None else len(record)) == length
    assert FEWEST == 10
    still = type("Own", (Told,), {"y": 0.0 * Y, "warnings": ("odd", "odd", "known")})
    findings, _ = excited(still(Path("x.fmu"), {**CONTENT, "problems": ("known",)}, {}, 1.0, 40))
    assert [(one.name, one.passed) for one in findings] == [("runs", True), ("moves", None), ("warnings", None)]
    assert findings[-1].came == "odd"


def test_what_instances_leave_is_told_by_the_increments(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread, a file and 40 KiB each: the first ones, and an arena that grows once, are no leak."""
    made, left_open = iter(range(1000)), list[Any]()
    state = {"memory": 0.0, "threads": 1.0}

    @contextmanager
    def instance(options: Mapping[str, Any]) -> Any:
        state["memory"] += 40.0 + 5000.0 * (next(made) == 1)
        state["threads"] += 1
        left_open.append(open(os.devnull))
        yield SimpleNamespace(spec=SPEC, rollout=lambda u: None)

    monkeypatch.setattr(inside, "_made", instance)
    monkeypatch.setattr(inside, "_begun", lambda plant: None)
    monkeypatch.setattr(inside, "_resident", lambda: state["memory"])
    monkeypatch.setattr(inside, "_threads", lambda: state["threads"])
    left = inside.instances({}, 20, progress=lambda **_: None)
    for one in left_open:
        one.close()
    assert left["memory"] == pytest.approx(40.0)
    assert (left["threads"], left["files"], left["known"]) == (1.0, 1.0, 1.0)


def test_a_vetting_passes_where_nothing_failed() -> None:
    ok, bad, fact = (
        Finding(name, passed, "tried", "came") for name, passed in (("a", True), ("b", False), ("c", None))
    )
    for findings, passed, words in (
        ((ok, fact, ok), True, "2 passed, 0 failed, 1 to know"),
        ((ok, bad, fact), False, "1 passed, 1 failed, 1 to know"),
    ):
        vetting = Vetting(Path("x.fmu"), "x", findings)
        assert (vetting.passed, vetting.summary) == (passed, words)
        assert [check.passed for check in vetting.checks()] == [one.passed is not False for one in findings]


def test_a_run_has_the_step_that_is_asked_for_or_that_of_a_regular_reference() -> None:
    regular, odd = np.arange(10) * 0.25, np.array([0.0, 0.1, 0.3, 0.3, 1.0])
    notes: list[str] = []
    assert _step({"step": 0.5}, regular, 9.0, 0.1, notes) == 0.5
    assert notes == []
    assert _step({}, regular, 2.25, 0.1, notes) == pytest.approx(0.25)
    assert _step({}, odd, 1.0, 0.1, notes) == 0.1
    assert _step({}, odd, 1.0, None, notes) == pytest.approx(1.0 / 500)
    assert len(notes) == 3


@pytest.mark.parametrize(
    ("begin", "end", "covers"),
    [(0.0, 1.0, True), (0.1, 0.9, True), (0.25, 1.0, False), (0.0, 0.75, False), (1.2, 1.5, False)],
)
def test_a_run_covers_its_reference_but_for_a_step_at_either_end(begin: float, end: float, covers: bool) -> None:
    reference = np.array([0.0, 1.0]), np.array([0.0, 2.0])
    t = np.arange(round(begin / 0.1), round(end / 0.1) + 1) * 0.1
    t = t + (begin - t[0])
    one = _channel("y", Tube(0.1), reference, t, 2.0 * t)
    assert one.first == (None if covers else max(len(one.t) - 1, 0))
    assert ("the run covers" in one.text) is not covers


def test_an_input_is_held_from_its_own_instant_on_and_a_continuous_one_is_as_half_way() -> None:
    drive = _Drive(np.array([0.0, 0.2, 0.4]), {"u": np.array([1.0, 2.0, 4.0])}, True)
    at = 0.1 * np.arange(5)
    smooth, held = {"variability": "continuous", "type": "Real"}, {"variability": "discrete", "type": "Real"}
    assert _held(drive, "u", at, 0.1, smooth) == pytest.approx([1.25, 1.75, 2.5, 3.5, 4.0])
    for row in (held, {"variability": "continuous", "type": "Int32"}):
        assert _held(drive, "u", at, 0.1, row).tolist() == [1.0, 1.0, 2.0, 2.0, 4.0]
    assert _held(replace(drive, between=False), "u", at, 0.1, smooth).tolist() == [1.0, 1.0, 2.0, 2.0, 4.0]


@pytest.mark.parametrize("through", [False, True])
@pytest.mark.parametrize("ends", [9, 2])
def test_a_run_is_told_as_far_as_it_comes_and_why_it_ends(through: bool, ends: int) -> None:
    """A sum of its inputs; with feedthrough a reading shows the input of its own instant too."""

    class Sum:
        spec = SimpleNamespace(feedthrough=through)

        def reset(self, **_: Any) -> np.ndarray:
            self.x, self.steps = 0.0, 0
            return np.array([0.0])

        def step(self, u: np.ndarray) -> np.ndarray:
            self.steps += 1
            if self.steps > ends:
                raise PlantError("it ends")
            self.x += float(u[0])
            return np.array([self.x])

        def output(self, u: np.ndarray) -> np.ndarray:
            return np.array([self.x + 100.0 * u[0]])

        def rollout(self, u: np.ndarray) -> np.ndarray:
            return np.array([self.step(one) for one in u])

    u = np.array([[1.0], [2.0], [3.0], [4.0]])
    seen, why = _stepped(Sum(), u)
    whole = [100.0, 201.0, 303.0, 406.0] if through else [0.0, 1.0, 3.0, 6.0]
    assert seen[:, 0].tolist() == whole[: ends + 1]
    assert why == ("it ends" if ends == 2 else "")


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        ({}, None),
        ({"stopTime": 2.0}, True),
        ({"startTime": 2.0, "stopTime": 2.0}, False),
        ({"startTime": 1.0, "stopTime": 2.0, "stepSize": 1.0}, True),
        ({"startTime": 1.0, "stopTime": 2.0, "stepSize": 1.1}, False),
        ({"stepSize": 0.1}, True),
        ({"stepSize": 0.0}, False),
        ({"stepSize": np.inf}, False),
    ],
)
def test_a_default_experiment_ends_after_it_begins_and_has_a_step_within(given: dict[str, float], passed: bool) -> None:
    empty = dict.fromkeys(("startTime", "stopTime", "stepSize", "tolerance"))
    assert _experiment({"experiment": {**empty, **given}}).passed is passed


def test_the_time_of_a_sample_is_told_over_real_time() -> None:
    told = {
        "make": 0.2,
        "initialise": 0.01,
        "sample": 1e-3,
        "threads": 2.0,
        "said": 0.0,
        "written": (),
        "sample_time": 0.1,
    }
    came = found("timing", speed=told).came
    assert came == (
        "200 ms to load and instantiate, 10.0 ms to initialise, 1000.0 us a sample: 100 times real time; "
        "2 threads of its own"
    )
