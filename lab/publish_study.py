"""Publish the rows of a judged study in `docs/studies`, and put what stood there beside those of earlier versions.

    sysid-lab all --seeds judged --cells 5 --out FOLDER
    python lab/publish_study.py FOLDER [NAME]

Writes the tables, the picture and the leaderboard of the new rows. The rows that they replace go to
`docs/studies/history.csv.xz`, under a name (the base of their seeds, where none is given), and into the table of all
that was judged so far, `docs/studies/history.md`. Rows of the same base are a study that was carried on: they are
replaced and leave no trace there.
"""

from __future__ import annotations

import csv
import io
import lzma
import sys
from collections.abc import Callable
from itertools import groupby
from pathlib import Path

from sysid_lab.leaderboard import answers_of_rows, score, write_answers
from sysid_lab.outcome import Answer
from sysid_lab.package import TRUTH_COLUMNS, record_name
from sysid_lab.pages.headline import GOOD, alone
from sysid_lab.pages.picture import confusion_picture
from sysid_lab.pages.tables import summary
from sysid_lab.plan import plan
from sysid_lab.row import COLUMNS
from sysid_lab.store import read_rows

Row = dict[str, str]
STUDIES = Path(__file__).parents[1] / "docs/studies"
CELLS = 5  # Repetitions that a judged study plans.
HEADER = """# Studies of earlier versions

Each line is one version of the closed loop on records that nobody had seen before (`history.csv.xz` has their rows:
`pandas.read_csv` reads it). Every version was judged on seeds of its own, and the next one was tuned on what it had got
wrong there, so lines differ by their records too. Rules of what counts as right grew with the dictionary, studies that
were stopped early are small, and CPU is that of the machine at hand. The present version is in [study.md](study.md).

Right or tied (*right*: the accepted set is the truth, effect and place; *tied*: the truth is among what the report says
cannot be told from it), of one effect of nominal size and of a quarter of it, undisturbed and under an unknown torque
of 2 % (`a/b + c/d`); one effect with no rival tied; two effects; *names* and *flags* where nothing is missing and the
nominal structure is right; confident names for laws outside the dictionary; diagnoses above 30 s of CPU, and the
largest.

| seeds from | rows | nominal | quarter | no rival tied | two effects | nothing missing: names, flags, records \
| outside: named | CPU > 30 s | largest |
|---|---|---|---|---|---|---|---|---|---|
"""


def read_history() -> dict[str, list[Row]]:
    """Return the rows of every earlier study by its name."""
    text = lzma.decompress((STUDIES / "history.csv.xz").read_bytes()).decode("utf-8")
    reader = csv.DictReader(io.StringIO(text))
    return {name: list(rows) for name, rows in groupby(reader, key=lambda row: row["version"])}


def write_history(history: dict[str, list[Row]]) -> None:
    """Write the rows of all studies, and their table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ["version", *COLUMNS], restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for name, rows in history.items():
        writer.writerows({**row, "version": name} for row in rows)
    (STUDIES / "history.csv.xz").write_bytes(lzma.compress(text.getvalue().encode("utf-8"), preset=9))
    (STUDIES / "history.md").write_text(table(history), encoding="utf-8")


def table(history: dict[str, list[Row]]) -> str:
    """Return the table of all studies, the newest first."""
    return HEADER + "".join(_line(name, rows) for name, rows in sorted(history.items(), key=_newest, reverse=True))


def _newest(entry: tuple[str, list[Row]]) -> tuple[int, str]:
    """Return what studies are sorted by: the first number of their name."""
    return int(entry[0].split()[0]), entry[0]


def _line(name: str, rows: list[Row]) -> str:
    """Return one line of the table."""
    done = [row for row in rows if row["status"] == "ok"]
    one = [row for row in done if row["study"] == "confusion" and row["truth"]]
    none = [row for row in done if row["study"] == "none" and not row["structure"]]
    outside = [row for row in done if row["study"] == "outside"]
    spent = [float(row["cpu_s"]) for row in done if row["cpu_s"] and row["study"] != "cost"]
    cells = [
        name,
        str(len(rows)),
        _shaken(_is(*GOOD), [row for row in one if row["level"] == "nominal"]),
        _shaken(_is(*GOOD), [row for row in one if row["level"] == "quarter"]),
        _shaken(alone, one),
        _shaken(_is(*GOOD), [row for row in done if row["study"] == "two"]),
        f"{_count(_is('wrong'), none)}, {_count(_is('flagged'), none)}, {len(none)}" if none else "",
        f"{_count(_is('wrong'), outside)}/{len(outside)}" if outside else "",
        f"{sum(seconds > 30 for seconds in spent)}/{len(spent)}" if spent else "",
        f"{max(spent):.0f} s" if spent else "",
    ]
    return f"| {' | '.join(cells)} |\n"


def _shaken(test: Callable[[Row], bool], rows: list[Row]) -> str:
    """Return how many rows a test holds for, undisturbed and disturbed."""
    parts = []
    for shaken in (False, True):
        here = [row for row in rows if (float(row["disturbance"]) > 0) == shaken]
        parts.append(f"{_count(test, here)}/{len(here)}")
    return " + ".join(parts) if rows else ""


def _count(test: Callable[[Row], bool], rows: list[Row]) -> int:
    """Return how many rows a test holds for."""
    return sum(map(test, rows))


def _is(*words: str) -> Callable[[Row], bool]:
    """Return whether an answer counts as one of these."""
    return lambda row: row["outcome"] in words


def publish(folder: Path) -> None:
    """Write the rows of a study, their tables and their picture."""
    rows = read_rows(folder / "rows.csv")
    (base,) = {int(row["base"]) for row in rows.values()}
    keys = {task.key for task in plan("all", base=base, cells=CELLS)}
    (STUDIES / "rows.csv").write_text((folder / "rows.csv").read_text(encoding="utf-8"), encoding="utf-8")
    text = summary(rows.values(), seeds="judged", planned=len(keys), keys=keys)
    (STUDIES / "study.md").write_text(text, encoding="utf-8")
    confusion_picture(list(rows.values()), STUDIES / "confusion.png")


def lead() -> None:
    """Write the leaderboard of the published rows: the truth without sizes, our answers, those of saying nothing."""
    folder = STUDIES / "leaderboard"
    rows = read_rows(STUDIES / "rows.csv").values()
    known = [row for row in rows if row["status"] == "ok" and row["study"] != "cost"]
    truth = folder / "truth.csv"
    with truth.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, TRUTH_COLUMNS, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, "record": record_name(row["key"])} for row in known)
    answers = {
        "sysid-harness": answers_of_rows(STUDIES / "rows.csv"),
        "always-nothing-missing": {record_name(row["key"]): Answer("nothing_missing", ()) for row in known},
    }
    files = [folder / "answers" / f"{tool}.csv" for tool in answers]
    for file_of_tool, given in zip(files, answers.values(), strict=True):
        write_answers(file_of_tool, given)
    (folder / "leaderboard.md").write_text(score(truth, files)[1], encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Put what `docs/studies` shows into the history, and a new study in its place."""
    if not arguments:
        sys.exit((__doc__ or "").strip())
    old, new = (list(read_rows(folder / "rows.csv").values()) for folder in (STUDIES, Path(arguments[0])))
    if old[0]["base"] != new[0]["base"]:
        history = read_history()
        history[arguments[1] if arguments[1:] else old[0]["base"]] = old
        write_history(history)
        print(f"{len(old)} rows go to history.md, which has {len(history)} studies")
    publish(Path(arguments[0]))
    lead()
    print(f"{len(new)} rows are published")


if __name__ == "__main__":
    main(sys.argv[1:])
