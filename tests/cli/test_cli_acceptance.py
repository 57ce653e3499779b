"""Exit statuses that a script can rely on: demands that hold, demands that fail, input that cannot be used."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from hypothesis import given
from hypothesis import strategies as st

from harness import api, diagnosis
from harness.comparison import compare_reports
from harness.errors import InputError
from harness.fleet.row import FleetRow
from harness.fleet.running import FleetResult
from harness.scoring.acceptance import Demand, Demands, write_junit

FOLDER = Path(__file__).resolve().parents[2]


def report(verdict: str = "effects_found", rms: float = 1e-3, share: float = 0.999) -> dict[str, Any]:
    scores = {"theta": {"rms": rms, "nrmse": 0.01, "unit": "rad"}}
    errors = {"simulation_error": {"validation": scores}}
    return {
        "format": "sysid-harness/close-loop/2", "dataset": "run", "model": "pendulum", "verdict": verdict,
        "adequacy": "explained", "explained_share": share, "errors": {"before": errors, "after": errors},
        "effects": [], "warnings": [], "summary": verdict,
        "parameters": {"after": {"J": {"value": 0.25, "low": 0.24, "high": 0.26, "unit": "kg m^2"}}},
    }  # fmt: skip


@given(
    rms=st.floats(1e-9, 1e3),
    limit=st.floats(1e-9, 1e3),
    unit=st.sampled_from([("rad", 1.0), ("mrad", 1e-3), ("deg", np.pi / 180)]),
)
def test_an_error_is_held_against_its_limit_in_any_unit(rms: float, limit: float, unit: tuple[str, float]) -> None:
    (check,) = Demands(max_error={"theta": f"{limit!r}{unit[0]}"}).of_report("run", report(rms=rms))
    if abs(rms - limit * unit[1]) > 1e-9 * rms:
        assert check.passed == (rms < limit * unit[1])


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ([], 0),
        (["--fail-on", "unexplained,model-does-not-fit"], 0),
        (["--fail-on", "effects_found"], 1),
        (["--fail-on", "nothing missing, effects found"], 1),  # as the report words it
        (["--max-error", "theta=2mrad", "--max-share", "0.01"], 0),
        (["--max-error", "theta=0.5 mrad"], 1),
        (["--max-share", "1e-4"], 1),
        (["--max-error", "theta=2"], 2),
        (["--max-error", "theta=2N"], 2),
        (["--max-error", "phi=2rad"], 2),
        (["--max-error", "theta=-2rad"], 2),
        (["--fail-on", "everything"], 2),
        (["--max-share", "7"], 2),
    ],
)
def test_the_exit_status_tells_what_was_asked(
    asked: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sysid: Callable[..., Any]
) -> None:
    monkeypatch.setattr(api, "close_loop", lambda *_, **__: diagnosis.Report(report(), None))
    junit = tmp_path / "junit.xml"
    arguments = ["run.csv", "--model", "pendulum", "--out", tmp_path, "--junit", junit, *asked]
    out, error = sysid("close-loop", *arguments, status=status)
    assert bool(error.strip()) == (status > 0)
    if status < 2:
        assert "effects_found" in out
        assert len(ElementTree.parse(junit).findall(".//failure")) == status


@pytest.mark.parametrize(
    ("statuses", "asked", "status"),
    [
        (["refused", "refused"], [], 2),
        (["refused", "ok"], [], 0),
        (["refused", "ok"], ["--fail-on", "unexplained"], 1),
        (["ok", "ok"], ["--max-error", "theta=2mrad"], 0),
        (["ok", "ok"], ["--fail-on", "effects_found"], 1),
    ],
)
def test_a_fleet_holds_only_if_every_record_does(
    statuses: list[str], asked: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    sysid: Callable[..., Any],
) -> None:  # fmt: skip
    rows = tuple(
        FleetRow(job=str(k), record=f"r{k}", file="", status=s, reason="" if s == "ok" else "no column")
        for k, s in enumerate(statuses)
    )
    for row in rows:
        folder = tmp_path / "reports" / row.record
        folder.mkdir(parents=True)
        (folder / "report.json").write_text(json.dumps(report()), encoding="utf-8")
    monkeypatch.setattr(api, "close_fleet", lambda *_, **__: FleetResult(tmp_path, rows, len(rows)))
    source = tmp_path / "fleet.csv"
    source.write_text("file\na.csv\n", encoding="utf-8")
    out, error = sysid("close-loop", source, "--out", tmp_path, *asked, status=status)
    assert f"of {len(rows)} records" in out
    assert ("no column" in error) == ("refused" in statuses and status > 0)


def test_models_are_held_against_limits_too(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=300)
    y = np.convolve(u, [0.0, 0.5, 0.2])[:300] + 0.1 * rng.normal(size=300)
    log, model = tmp_path / "log.csv", tmp_path / "m.json"
    log.write_text(
        "u [V],y [m]\n" + "\n".join(f"{a!r},{b!r}" for a, b in zip(u.tolist(), y.tolist(), strict=True)),
        encoding="utf-8",
    )
    words = ["--sample-time", "0.1"]
    fit = ["identify", log, "--input", "u", "--output", "y", *words, "-O", "order=2", "-o", model, "--force"]
    sysid(*fit, "--max-error", "y=20cm")
    out = sysid(*fit, "--max-error", "y=5cm", "--json", status=1).out
    assert json.loads(out)["model"]["kind"] == "linear"
    sysid("compare", model, log, *words, "--max-error", "y=5cm", status=1)
    sysid("compare", model, log, *words, "--max-error", "y=20cm")


@pytest.mark.parametrize(
    ("rms", "said"), [(1e-3, "1 mrad"), (None, "diverges"), (float("inf"), "diverges"), (float("nan"), "diverges")]
)
def test_an_error_that_is_no_number_is_said_to_diverge(rms: float | None, said: str) -> None:
    (check,) = Demands(max_error={"theta": "2mrad"}).of_errors("run", {"theta": (rms, "rad")})
    assert check.passed == (said != "diverges")
    assert f"error {said}, at most 2mrad" in check.text


def test_junit_tells_failures_from_what_could_not_be_judged(tmp_path: Path) -> None:
    path = tmp_path / "junit.xml"
    write_junit(
        path,
        "close-loop",
        [
            *(Demand("a", name, True) for name in "xyz"),
            Demand("b", "x", False, "2 > 1 \x00"),
            Demand("c", "y", False, "no <file>", broken=True),
        ],
    )
    (suite,) = ElementTree.parse(path).getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("5", "1", "1")
    error = suite.find(".//error")
    assert error is not None
    assert error.get("message") == "no <file>"


def test_two_reports_are_told_apart(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    one, two = tmp_path / "a.json", tmp_path / "b.json"
    one.write_text(json.dumps(report()), encoding="utf-8")
    other = report(rms=2e-3) | {"model": "cart-pole"}
    other["parameters"] = {"after": {"J": {"value": 0.30, "low": 0.29, "high": 0.31, "unit": "kg m^2"}}}
    two.write_text(json.dumps(other), encoding="utf-8")
    assert str(compare_reports(one, one)) == "the answers are the same"
    found = {row["what"]: row for row in compare_reports(one, two).rows()}
    assert set(found) == {"model", "parameter J", "simulation error of theta"}
    assert found["simulation error of theta"]["second"] == "0.002 rad"
    assert found["parameter J"]["meaning"] == "the intervals do not meet"
    assert "what went in differs: model" in sysid("compare", one, two).out
    said = sysid("compare", one, two, "-o", tmp_path / "page.html", status=2).err
    assert "--out" in said, "no option is left out without a word"
    with pytest.raises(InputError, match="not a report"):
        compare_reports(one, tmp_path)


def test_what_is_said_of_either_file_alike_is_no_difference(tmp_path: Path) -> None:
    for name, rms, lines in (("run", 1e-3, "1 to 2"), ("run2", 2e-3, "1 to 2"), ("run3", 1e-3, "1 to 4")):
        said = [f"{name}.csv: decimal commas are read as decimal points", f"{name}.csv: lines {lines} stand above"]
        recorded = {"theta": {"unit": "rad", "recorded": "mrad"}}
        content = report(rms=rms) | {"dataset": name, "warnings": said, "recorded": recorded}
        (tmp_path / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")
    one, two, three = (tmp_path / f"{name}.json" for name in ("run", "run2", "run3"))
    found = {row["what"]: row for row in compare_reports(one, two).rows()}
    assert set(found) == {"data set", "simulation error of theta"}
    assert found["simulation error of theta"]["second"] == "2 mrad"
    assert [row["what"] for row in compare_reports(one, three).rows()].count("warning") == 2


def test_a_second_report_that_is_not_there_is_called_so(tmp_path: Path, sysid: Callable[..., Any]) -> None:
    (tmp_path / "one.json").write_text(json.dumps(report()), encoding="utf-8")
    assert "not a report" in sysid("compare", tmp_path / "one.json", tmp_path / "two.json", status=2).err


def test_the_examples_for_ci_are_commands_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sysid: Callable[..., Any]
) -> None:
    hook = yaml.safe_load((FOLDER / "examples/ci/pre-commit-config.yaml").read_text(encoding="utf-8"))
    flow = yaml.safe_load((FOLDER / "examples/ci/github-actions.yml").read_text(encoding="utf-8"))
    steps = [step["run"] for step in flow["jobs"]["models"]["steps"] if "run" in step]
    commands = [hook["repos"][0]["hooks"][0]["entry"], *(text for text in steps if text.startswith("sysid"))]
    assert len(commands) == 2
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build").mkdir()
    monkeypatch.setattr(api, "close_loop", lambda *_, **__: diagnosis.Report(report(), None))
    for command in commands:
        sysid(*shlex.split(command)[1:])
    for name in ("pre-commit-config.yaml", "github-actions.yml"):
        assert (FOLDER / "examples/ci" / name).read_text(encoding="utf-8") in (FOLDER / "docs/ci.md").read_text(
            encoding="utf-8"
        )
