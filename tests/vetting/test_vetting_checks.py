"""Each check of an FMU notices the fault that it is there for, and only that."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from harness.cli.app import app
from harness.errors import InputError
from harness.fmi import build
from harness.parts.files import describe_fmu
from harness.signals import Trajectory
from harness.vetting import vet
from harness.vetting.described import described
from harness.vetting.findings import Finding
from harness.vetting.runs import CHECKS, Subject, excited
from plants.mockups import mockup

SOUND, EULER, LEAKS, SHARES, THROUGH, PRINTS, RANDOM = range(7)


@pytest.fixture(scope="session")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if build.compiler() is None:
        pytest.skip("no C compiler: install gcc")
    target = tmp_path_factory.mktemp("vetting") / "faulty.fmu"
    build.build_fmu(Path(__file__).parent / "fmus" / "faulty", 2, target)
    return target


@pytest.fixture(scope="session")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if build.compiler() is None:
        pytest.skip("no C compiler: install gcc")
    target = tmp_path_factory.mktemp("vetting") / "hostile.fmu"
    build.build_fmu(Path(__file__).parents[1] / "plants" / "fmus" / "hostile", 2, target)
    return target


@pytest.fixture(scope="session")
def tried(faulty: Path) -> Callable[[int, str], list[Finding]]:
    content = describe_fmu(faulty)
    records: dict[int, tuple[Subject, Trajectory]] = {}

    def run(mode: int, check: str) -> list[Finding]:
        if mode not in records:
            options = {"path": str(faulty), "sample_time": 0.02, "parameters": {"mode": mode}}
            subject = Subject(faulty, content, options, 10.0)
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


@pytest.mark.slow
def test_parameters_and_the_own_experiment(tried: Callable[[int, str], list[Finding]]) -> None:
    (parameters,) = tried(SOUND, "parameters")
    assert parameters.passed
    assert parameters.tried.startswith("1 real")
    (own,) = tried(SOUND, "own experiment")
    assert own.passed
    assert "51 samples to t = 1 s" in own.came


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
