"""Each check of an FMU notices the fault that it is there for, and only that."""

from __future__ import annotations

import json
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from harness.cli.app import app
from harness.cosim.free_run import CoupledRun
from harness.errors import InputError
from harness.fmi import build
from harness.parts.files import describe_fmu
from harness.signals import Channel, PlantSpec, Trajectory
from harness.vetting import vet
from harness.vetting.described import described
from harness.vetting.findings import Finding
from harness.vetting.runs import CHECKS, FEWEST, FmuSubject, excited
from harness.vetting.vet import samples_of
from plants.mockups import mockup

SOUND, EULER, LEAKS, SHARES, THROUGH, PRINTS, RANDOM, WRITES = range(8)
TERMINATES = 8
"""A mode of the hostile FMU."""


@pytest.fixture(scope="session")
def faulty(odd_fmu: Callable[..., Path]) -> Path:
    return odd_fmu("faulty")


@pytest.fixture(scope="session")
def hostile(odd_fmu: Callable[..., Path]) -> Path:
    return odd_fmu("hostile")


@pytest.fixture(scope="session")
def tried(faulty: Path) -> Callable[[int, str], list[Finding]]:
    content = describe_fmu(faulty)
    records: dict[int, tuple[FmuSubject, Trajectory]] = {}

    def run(mode: int, check: str) -> list[Finding]:
        if mode not in records:
            options = {"path": str(faulty), "sample_time": 0.02, "parameters": {"mode": mode}}
            subject = FmuSubject(faulty, content, options, 10.0)
            findings, record = excited(subject)
            assert record is not None
            assert findings[0].passed
            records[mode] = subject, record
        return CHECKS[check](*records[mode])

    return run


def test_the_order_of_a_step_is_measured(tried: Callable[[int, str], list[Finding]]) -> None:
    (euler,) = tried(EULER, "step halving")
    assert "order 1.0" in euler.came
    assert euler.figure is not None
    assert 0.01 < euler.figure < 0.2  # h / T = 0.1: half the step changes some per cent
    assert euler.passed is False
    (exact,) = tried(SOUND, "step halving")
    assert exact.passed


@pytest.mark.slow
def test_what_instances_leave_and_what_they_share(tried: Callable[[int, str], list[Finding]]) -> None:
    (leaks,) = tried(LEAKS, "leaks")
    assert leaks.passed is False
    assert leaks.figure == pytest.approx(400, rel=0.3)  # KiB
    (shares,) = tried(SHARES, "two at once")
    assert shares.passed is False
    (alone,) = tried(SOUND, "two at once")
    assert alone.passed


@pytest.mark.slow
def test_what_changes_at_once_must_be_declared(tried: Callable[[int, str], list[Finding]]) -> None:
    (through,) = tried(THROUGH, "dependencies")
    assert through.passed is False
    assert through.came.startswith("z change")
    (sound,) = tried(SOUND, "dependencies")
    assert sound.passed


@pytest.mark.slow
def test_two_processes_must_agree(tried: Callable[[int, str], list[Finding]]) -> None:
    (off,) = tried(RANDOM, "determinism")
    assert off.passed is False
    (same,) = tried(SOUND, "determinism")
    assert same.passed


def test_what_it_prints_is_told_and_kept_from_the_terminal(
    tried: Callable[[int, str], list[Finding]], capfd: pytest.CaptureFixture[str]
) -> None:
    timing, output = tried(PRINTS, "timing")
    assert "times real time" in timing.came
    assert output.figure is not None
    assert output.figure > 200 * len("a step of 0.02 s\n")
    assert "a step of" not in "".join(capfd.readouterr())


def test_what_it_leaves_in_the_working_folder_is_told(tried: Callable[[int, str], list[Finding]]) -> None:
    _, output = tried(WRITES, "timing")
    assert (output.passed, output.came) == (None, "files: left.log")
    timing, output = tried(SOUND, "timing")
    assert (output.passed, output.came) == (True, "nothing")
    assert timing.came.endswith("0 threads of its own")


def test_what_a_library_lacks_and_needs_is_told(
    faulty: Path, tmp_path: Path, tried: Callable[[int, str], list[Finding]]
) -> None:
    (sound,) = tried(SOUND, "binary")
    assert sound.passed
    assert sound.came.startswith("complete; loads nothing more")
    command = build.compiler()
    assert command is not None
    (tmp_path / "bare.c").write_text("int fmi2GetVersion(void) { return 0; }\n")
    subprocess.run([*command, "-shared", "-o", str(tmp_path / "bare.so"), str(tmp_path / "bare.c")], check=True)
    bare = tmp_path / "bare.fmu"
    with zipfile.ZipFile(faulty) as old, zipfile.ZipFile(bare, "w") as new:
        for entry in old.infolist():
            library = entry.filename.endswith(".so")
            new.writestr(entry.filename, (tmp_path / "bare.so").read_bytes() if library else old.read(entry))
    subject = FmuSubject(bare, describe_fmu(bare), {"path": str(bare), "sample_time": 0.02}, 10.0)
    spec = PlantSpec((), (Channel("y"),), 0.02)
    (found,) = CHECKS["binary"](subject, Trajectory(np.zeros(1), np.zeros((1, 0)), np.zeros((1, 1)), spec))
    assert found.passed is False
    assert "fmi2DoStep" in found.came
    assert "fmi2GetVersion" not in found.came
    assert "fmi2GetDerivatives" not in found.came  # of model exchange, which it does not offer


def test_what_ends_a_simulation_is_tried_up_to_there(hostile: Path) -> None:
    content = describe_fmu(hostile)
    options = {"path": str(hostile), "sample_time": 0.01, "parameters": {"mode": TERMINATES, "when": 0.6}}
    ends, runs, *_ = (found := excited(FmuSubject(hostile, content, options, 10.0)))[0]
    assert (ends.name, ends.passed) == ("ends", None)
    assert "t = 0.6 s" in ends.came
    assert (runs.name, runs.passed, runs.tried) == ("runs", True, "50 samples under changing inputs")
    assert found[1] is not None
    assert len(found[1]) == 50


def test_no_run_goes_beyond_the_own_experiment(tmp_path: Path) -> None:
    path = changed(mockup("pendulum"), tmp_path / "short.fmu", ('stopTime="10"', 'stopTime="0.3"'))
    content = describe_fmu(path)
    assert samples_of(content, 0.01) == 30
    assert samples_of(content, 0.1) == FEWEST
    assert samples_of(describe_fmu(mockup("pendulum")), 0.01) == 200


def test_derivatives_by_states_are_held_against_differences(odd_fmu: Callable[..., Path]) -> None:
    ball = odd_fmu("ball")
    content = describe_fmu(ball)
    subject = FmuSubject(ball, content, {"path": str(ball), "sample_time": 0.02}, 10.0)
    _, record = excited(replace(subject, samples=10))
    assert record is not None
    found = {one.name: one for one in CHECKS["derivatives"](subject, record)}["state derivatives"]
    assert found.passed
    assert found.figure is not None
    assert found.figure < 1e-6


@pytest.mark.parametrize(
    ("late", "factor", "events", "passed"),
    [(0, 1.0, 0, True), (1, 1.0, 0, True), (0, 0.95, 0, False), (0, 0.95, 3, None)],
)
def test_two_interfaces_agree_but_for_an_instant(late: int, factor: float, events: int, passed: bool | None) -> None:
    spec = PlantSpec((), (Channel("y"),), 0.1)
    y = np.where(np.arange(50) < 20, 0.0, 4.0)[:, None]

    class Other:
        def __init__(self) -> None:
            self.spec = spec

        def __enter__(self) -> Other:
            return self

        def __exit__(self, *_: object) -> None: ...

        def reset(self, **_: Any) -> np.ndarray:
            return factor * y[0]

        def rollout(self, u: np.ndarray) -> np.ndarray:
            return factor * np.roll(y, late, axis=0)[1 : len(u) + 1]

    class Both(FmuSubject):
        def plant(self, **more: Any) -> Any:
            assert more == {"kind": "me"}
            return Other()

    content = {"kinds": {"co-simulation": {}, "model exchange": {}}, "event_indicators": events}
    record = Trajectory(0.1 * np.arange(50), np.zeros((50, 0)), y, spec)
    (found,) = CHECKS["both interfaces"](Both(Path("x.fmu"), content, {}, 1.0), record)
    assert found.passed is passed
    assert found.figure == pytest.approx(1.0 - factor, abs=1e-12)


@pytest.mark.slow
def test_parameters_and_the_own_experiment(tried: Callable[[int, str], list[Finding]]) -> None:
    (parameters,) = tried(SOUND, "parameters")
    assert parameters.passed
    assert parameters.tried.startswith("1 real")
    (own,) = tried(SOUND, "own experiment")
    assert own.passed
    assert "51 samples to t = 1 s" in own.came


@pytest.mark.parametrize(("moved", "passed"), [(0.0, True), (0.004, None), (0.05, False)])
def test_a_tolerance_fails_where_it_decides_the_result(
    monkeypatch: pytest.MonkeyPatch, moved: float, passed: bool | None
) -> None:
    spec = PlantSpec((), (Channel("y"),), 0.1)
    record = Trajectory(0.1 * np.arange(3), np.zeros((3, 0)), np.zeros((3, 1)), spec)
    notes = (f"the FMU's own tolerance moves y by {100 * moved:g} %",) if moved else ()
    monkeypatch.setattr(
        "harness.registry.load", lambda *_: lambda *_, **__: CoupledRun(record, notes, None, moved=moved)
    )
    experiment = {"stopTime": 0.2 if moved else None}
    subject = FmuSubject(Path("x.fmu"), {"experiment": experiment}, {}, 1.0)
    (found,) = CHECKS["own experiment"](subject, record)
    assert found.passed is passed
    assert ("it has no default experiment" in found.tried) == (not moved)


def changed(source: Path, target: Path, *pairs: tuple[str, str]) -> Path:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = content.decode()
                for before, after in pairs:
                    assert before in text
                    text = text.replace(before, after)
                content = text.encode()
            new.writestr(entry, content)
    return target


@pytest.mark.parametrize(
    ("check", "before", "after", "words"),
    [
        ("start values", 'start="0.05"', 'start="-0.05"', "J = -0.05 outside [0, inf]"),
        ("units", '<BaseUnit kg="1" m="2" s="-2" />', '<BaseUnit kg="1" m="1" s="-2" />', "u: unit 'N m'"),
        ("default experiment", 'stopTime="10"', 'stopTime="-1"', "stopTime -1"),
        ("model description", 'unit="rad/s" start="0"', 'unit="rad/s"', "omega"),
    ],
)
def test_what_is_wrong_in_the_description(tmp_path: Path, check: str, before: str, after: str, words: str) -> None:
    sound = {one.name: one for one in described(mockup("pendulum"), describe_fmu(mockup("pendulum")))}
    assert sound[check].passed
    path = changed(mockup("pendulum"), tmp_path / "wrong.fmu", (before, after))
    found = {one.name: one for one in described(path, describe_fmu(path))}
    assert found[check].passed is False
    assert words in found[check].came
    others = {name: one.passed for name, one in found.items() if name != check}
    assert others == {name: one.passed for name, one in sound.items() if name != check}


@pytest.mark.parametrize(("mode", "words"), [(1, "SIGSEGV"), (4, "within 1 s"), (16, "SIGSEGV")])
def test_a_crash_or_a_hang_is_one_line_within_its_limit(hostile: Path, mode: int, words: str) -> None:
    found = vet(hostile, options={"parameters": {"mode": mode}}, limit=1.0)
    assert not found.passed
    failed = [one for one in found.findings if one.passed is False]
    assert [one.name for one in failed] == ["runs"]
    assert words in failed[0].came
    assert found.findings[-1] is failed[0]  # nothing is tried after that
    assert "co-simulation, 0.0" in next(one.came for one in found.findings if one.name == "setting")


def test_the_command_writes_all_its_forms(hostile: Path, tmp_path: Path) -> None:
    page, junit = tmp_path / "page.html", tmp_path / "found.xml"
    asked = ["check", str(hostile), "-O", "parameters={mode=1}", "-o", str(page), "--junit", str(junit)]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 1
    assert "FAIL runs" in done.output
    assert "SIGSEGV" in page.read_text(encoding="utf-8")
    suite = ElementTree.parse(junit).getroot()
    assert suite.get("failures") == "1"
    assert int(suite.get("tests", "0")) > 5
    done = CliRunner().invoke(app, ["check", str(hostile), "-O", "parameters={mode=1}", "--json"])
    content = json.loads(done.output[done.output.index("{") : done.output.rindex("}") + 1])
    assert content["passed"] is False
    assert {"name", "passed", "tried", "came", "figure"} == set(content["findings"][0])


def test_what_is_no_fmu(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such FMU"):
        vet(tmp_path / "none.fmu")
    (tmp_path / "text.fmu").write_text("no archive")
    found = vet(tmp_path / "text.fmu")
    assert [one.passed for one in found.findings] == [False]
    with pytest.raises(InputError, match="sample_tim"):
        vet(mockup("pendulum"), options={"sample_tim": 0.1})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "mass_spring", "drive", "two_tanks", "quantiser"])
@pytest.mark.parametrize("version", [2, 3])
def test_our_own_fmus_pass(name: str, version: int) -> None:
    found = vet(mockup(name, version))
    assert found.passed, str(found)
    assert found.record is not None
    assert np.isfinite(found.record.y).all()
    assert "<svg" in found.html() or "data:image/svg" in found.html()


def test_complaints_of_one_kind_are_one_with_their_lines() -> None:
    content = describe_fmu(mockup("pendulum"))
    content["problems"] = [*(f"ERROR (line {k}, column 0): not allowed" for k in (3, 9)), "something else"]
    found = {one.name: one for one in described(mockup("pendulum"), content)}["model description"]
    assert (found.passed, found.came) == (False, "not allowed (lines 3, 9); something else")
    assert "any number of instances in a process, runs by itself" in vet_line(content, "co-simulation")
    content["kinds"]["co-simulation"]["needs its tool"] = True
    assert vet_line(content, "co-simulation").endswith("any number of instances in a process, needs its tool")


def vet_line(content: Any, name: str) -> str:
    return {one.name: one for one in described(mockup("pendulum"), content)}[name].came


def test_every_number_of_an_array_is_held_against_its_limits() -> None:
    content = describe_fmu(mockup("pendulum"))
    row = next(one for one in content["variables"] if one["name"] == "J")
    row |= {"shape": [3], "start": "0.1 -0.2 0.3"}
    assert vet_line(content, "start values") == "J = -0.2 outside [0, inf]"


def test_scheduled_execution_is_no_fault_of_the_description(tmp_path: Path) -> None:
    path = changed(mockup("pendulum", 3), tmp_path / "se.fmu", ("<CoSimulation", "<ScheduledExecution"))
    assert [one.name for one in vet(path).findings] == ["interface"]


def test_findings_as_text_and_page() -> None:
    from harness.vetting import Vetting

    rows: Any = (
        Finding("a<b", False, "x\ty", "z" + chr(27)),
        Finding("c", None, "d", "e"),
        Finding("f", True, "g", "h"),
    )
    found = Vetting(Path("x.fmu"), "<title>", rows)
    assert "&lt;title&gt;" in found.html()
    assert "<b" not in found.html().replace("<body", "").replace("<b>", "")
    assert chr(27) not in str(found)
    assert str(found).endswith("1 passed, 1 failed, 1 to know")
    assert [check.passed for check in found.checks()] == [False, True, True]
