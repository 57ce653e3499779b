"""The published studies: their tables are those of their rows."""

from __future__ import annotations

import runpy
from pathlib import Path

from sysid_lab.leaderboard import answers_of_rows, read_answers, read_truth, score
from sysid_lab.pages.tables import summary
from sysid_lab.plan import plan
from sysid_lab.store import read_rows

ROOT = Path(__file__).resolve().parents[2]
STUDIES = ROOT / "docs" / "studies"
PUBLISHER = runpy.run_path(str(ROOT / "lab" / "publish_study.py"))


def test_the_table_of_the_study_is_that_of_its_rows() -> None:
    rows = read_rows(STUDIES / "rows.csv")
    (base,) = {int(row["base"]) for row in rows.values()}
    keys = {task.key for task in plan("all", base=base, cells=PUBLISHER["CELLS"])}
    assert set(rows) <= keys
    assert (STUDIES / "study.md").read_text(encoding="utf-8") == summary(
        rows.values(), seeds="judged", planned=len(keys), keys=keys
    )


def test_the_table_of_earlier_studies_is_that_of_their_rows() -> None:
    history = PUBLISHER["read_history"]()
    published = {row["base"] for row in read_rows(STUDIES / "rows.csv").values()}
    assert not published & {row["base"] for rows in history.values() for row in rows}
    assert (STUDIES / "history.md").read_text(encoding="utf-8") == PUBLISHER["table"](history)


def test_the_leaderboard_is_that_of_the_study() -> None:
    folder = STUDIES / "leaderboard"
    ours = folder / "answers" / "sysid-harness.csv"
    assert read_answers(ours) == answers_of_rows(STUDIES / "rows.csv")
    assert set(read_truth(folder / "truth.csv")) == set(read_answers(ours))
    table = score(folder / "truth.csv", sorted((folder / "answers").glob("*.csv")))[1]
    assert (folder / "leaderboard.md").read_text(encoding="utf-8") == table
