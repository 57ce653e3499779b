"""The study for other tools: records that tell nothing, answers that are judged as our own are."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sysid_lab.leaderboard import answers_of_rows, read_answers, read_truth, score, write_answers
from sysid_lab.outcome import Answer, judge_answer
from sysid_lab.package import SECRET_FROM, generate, record_name
from sysid_lab.plan import BASES, plan
from sysid_lab.records import make_records
from sysid_lab.store import read_rows

from harness.command import main
from harness.data import load_dataset
from harness.errors import InputError

ROWS = Path(__file__).parents[2] / "docs" / "studies" / "rows.csv"
SAMPLES = 400
LAB = "sysid_lab.cli"
ASKED = {"records": 6, "plants": ["pendulum"], "cells": 1, "alarms": 1}


def make(folder: Path, **options: object) -> Path:
    """Generate a few short records; return the file of the truth."""
    asked = {**ASKED, "samples": SAMPLES, "workers": 1, **options}
    return generate(folder / "for-tools", truth=folder / "truth", **asked).truth  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the records asked for, made once and only read."""
    return make(tmp_path_factory.mktemp("made")).parents[1]


def test_the_records_are_those_of_the_study_and_tell_nothing(made: Path) -> None:
    known = read_truth(made / "truth" / "truth.csv")
    tasks = [
        task
        for task in plan("all", base=BASES["judged"], plants=["pendulum"], cells=1, alarms=1)
        if task.study != "cost"
    ]
    assert set(known) == {record_name(task.key) for task in tasks[:6]}
    hidden = {effect.partition("@")[0] for row in known.values() for effect in row["truth"].split(" + ") if effect}
    assert hidden
    for path in (made / "for-tools" / "records").rglob("*"):
        text = str(path) + (path.read_text(encoding="utf-8") if path.is_file() else "")
        assert not any(word in text for word in (*hidden, "confusion", "quarter", "nominal size", "truth"))
    task = next(task for task in tasks if task.effects)
    loaded = load_dataset(made / "for-tools" / "records" / record_name(task.key) / "dataset.toml")
    again = make_records(task, samples=SAMPLES)
    assert [run.use for run in loaded.dataset] == [run.use for run in again.dataset]
    for ours, theirs in zip(again.dataset, loaded.dataset, strict=True):
        np.testing.assert_array_equal(ours.trajectory.y, theirs.trajectory.y)
        np.testing.assert_array_equal(ours.trajectory.u, theirs.trajectory.u)


@pytest.mark.slow
def test_a_secret_number_makes_other_records_and_the_truth_stays_outside(tmp_path: Path) -> None:
    mine, again, other = (
        read_truth(make(tmp_path / name, secret=secret, records=2))
        for name, secret in (("a", 987_654), ("b", 987_654), ("c", 987_655))
    )
    assert mine == again
    assert {row["sizes"] for row in mine.values()}.isdisjoint(row["sizes"] for row in other.values())
    with pytest.raises(InputError, match="secret"):
        make(tmp_path, secret=SECRET_FROM - 1)
    with pytest.raises(InputError, match="truth"):
        generate(tmp_path / "x", truth=tmp_path / "x" / "truth")


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder but the log, which has the time."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".log"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.slow
def test_killed_and_resumed_the_records_are_the_same(made: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from sysid_lab.package import generate\n"
        f"generate(sys.argv[1], truth=sys.argv[2], samples={SAMPLES}, workers=1, **{ASKED!r})"
    )
    killed = tmp_path / "killed"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(killed / "for-tools"), str(killed / "truth")], start_new_session=True
    )
    deadline = time.monotonic() + 120
    while len(list(killed.glob("truth/shards/*.json"))) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.poll() is None, "over before it could be killed"
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (killed / "truth" / "truth.csv").exists()
    with pytest.raises(InputError, match="--resume"):
        make(killed)
    with pytest.raises(InputError, match="other records"):
        make(killed, samples=SAMPLES + 1, resume=True)
    seen: list[int] = []
    make(killed, resume=True, progress=lambda done, total, what: seen.append(done))
    assert seen[0] >= 2, "what was there is kept"
    assert contents(killed) == contents(made)


@pytest.mark.slow
def test_a_record_that_breaks_is_said_by_name_and_costs_no_other(tmp_path: Path) -> None:
    planned = plan("all", base=BASES["judged"], plants=["pendulum"], cells=1, alarms=1)
    tasks = [task for task in planned if task.study != "cost"]
    in_the_way = tmp_path / "records" / "records" / record_name(tasks[1].key)
    in_the_way.parent.mkdir(parents=True)
    in_the_way.write_text("a file where the record's folder would be")
    asked = {**ASKED, "records": 3, "samples": SAMPLES, "workers": 1}
    package = generate(tmp_path / "records", truth=tmp_path / "truth", **asked)  # type: ignore[arg-type]
    assert (package.made, [key for key, _ in package.failed]) == (2, [tasks[1].key])
    assert "2 of 3 records" in str(package)
    assert "FileExistsError" in package.failed[0][1]
    assert tasks[1].key in (tmp_path / "truth" / "generate.log").read_text()
    in_the_way.unlink()
    again = generate(tmp_path / "records", truth=tmp_path / "truth", resume=True, **asked)  # type: ignore[arg-type]
    assert (again.made, again.failed) == (3, ())


@pytest.mark.slow
def test_from_records_to_leaderboard_on_the_command_line(tmp_path: Path) -> None:
    """The closed loop answers records like any other tool, through the fleet, and is judged."""
    records, truth, run = tmp_path / "records", tmp_path / "truth", tmp_path / "run"
    options = ["--records", "2", "--plants", "pendulum", "--cells", "1", "--alarms", "1", "--workers", "1"]

    def call(*arguments: Any) -> None:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments[1:]], cli=arguments[0])
        assert not left.value.code

    call(LAB, "generate", "--out", records, "--truth", truth, "--secret", 7_340_021, *options)
    call("harness.cli.app", "close-loop", records / "records.csv", "--out", run, "--workers", 1)
    call(LAB, "answer", run, "-o", tmp_path / "ours.csv")
    call(LAB, "score", truth / "truth.csv", tmp_path / "ours.csv", "-o", tmp_path / "board.md")
    known, answers = read_truth(truth / "truth.csv"), read_answers(tmp_path / "ours.csv")
    assert set(answers) == set(known)
    (own,), _ = score(truth / "truth.csv", [tmp_path / "ours.csv"])
    assert own.count(("not answered",)) == (0, 2)
    hidden = {effect for row in known.values() for effect in row["truth"].split(" + ") if effect}
    assert own.count(("right", "tied"))[0] >= 1, (hidden, answers)
    assert "| ours |" in (tmp_path / "board.md").read_text(encoding="utf-8")


def test_our_own_rows_are_judged_as_they_were(tmp_path: Path) -> None:
    answers = answers_of_rows(ROWS)
    path = tmp_path / "ours.csv"
    write_answers(path, answers)
    assert read_answers(path) == answers
    rows = [row for row in read_rows(ROWS).values() if row["status"] == "ok" and row["study"] != "cost"]
    assert len(rows) == len(answers) > 50
    for row in rows:
        truth = [name for name in row["truth"].split(" + ") if name]
        answer = answers[record_name(row["key"])]
        judged = judge_answer(truth, answer, row["plant"], row["engine"], row["structure"])
        assert judged.word == row["outcome"], row["key"]


def test_tools_stand_side_by_side(made: Path, tmp_path: Path) -> None:
    truth = made / "truth" / "truth.csv"
    known = read_truth(truth)
    right, blind, alarmist = {}, {}, {}
    for record, row in known.items():
        effects = tuple(name for name in row["truth"].split(" + ") if name)
        inside = row["study"] != "outside"
        verdict = ("effects_found" if inside else "unexplained") if effects else "nothing_missing"
        right[record] = Answer(verdict, effects if inside else ())
        blind[record] = Answer("nothing_missing", ())
        alarmist[record] = Answer("effects_found", ("backlash@theta", "leak@theta"))
    del alarmist[next(iter(alarmist))]
    for name, answers in (("blind", blind), ("right", right), ("alarmist", alarmist)):
        write_answers(tmp_path / f"{name}.csv", answers)
    files = [tmp_path / f"{name}.csv" for name in ("blind", "right", "alarmist")]
    scores, text = score(truth, files)
    by_name = {own.name: own for own in scores}
    assert scores[0].name == "right"
    hidden = sum(bool(row["truth"]) for row in known.values())
    assert hidden < len(known)  # a record with nothing missing is among them
    assert by_name["right"].count(("right", "flagged")) == (len(known), len(known))
    assert by_name["blind"].count(("missed",)) == (hidden, len(known))
    assert by_name["blind"].count(("wrong",))[0] == 0
    assert by_name["alarmist"].count(("wrong",)) == (len(known) - 1, len(known))
    assert by_name["alarmist"].count(("not answered",))[0] == 1
    assert "| right |" in text
    with pytest.raises(SystemExit) as left:
        main(["score", str(truth), *map(str, files), "-o", str(tmp_path / "board.md")], cli=LAB)
    assert not left.value.code
    assert (tmp_path / "board.md").read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("r-1,perhaps,", "effects_found"),
        ("r-1,effects_found,", "only there"),
        ("r-1,nothing_missing,coulomb_friction@theta", "only there"),
        ("r-1,effects_found,coulomb_friction", "EFFECT@PLACE"),
        ("r-1,nothing_missing,\nr-1,nothing_missing,", "once"),
    ],
)
def test_answers_that_say_nothing_clear_are_refused(tmp_path: Path, line: str, says: str) -> None:
    path = tmp_path / "answers.csv"
    path.write_text(f"record,verdict,effects\n{line}\n")
    with pytest.raises(InputError, match=says):
        read_answers(path)


def test_wrong_columns_and_strangers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "answers.csv"
    path.write_text("record,verdict\nr-1,nothing_missing\n")
    with pytest.raises(InputError, match="no effects"):
        read_answers(path)
    truth = make(tmp_path, records=1)
    path.write_text("record,verdict,effects\nr-1,nothing_missing,\n")
    with pytest.raises(InputError, match="r-1"):
        score(truth, [path])
    with truth.open(newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 1


def test_the_committed_leaderboard_is_what_the_scorer_makes() -> None:
    folder = ROWS.parent / "leaderboard"
    scores, text = score(folder / "truth.csv", sorted((folder / "answers").glob("*.csv")))
    assert text == (folder / "leaderboard.md").read_text(encoding="utf-8")
    assert scores[0].name == "sysid-harness"
