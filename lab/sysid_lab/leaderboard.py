"""Answers of tools to the records of a study, judged against the truth: who is right how often, side by side."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.errors import InputError, unread
from sysid_lab.outcome import STAND_IN, Answer, Outcome, judge_answer
from sysid_lab.package import TRUTH_COLUMNS, record_name
from sysid_lab.pages.statistics import clopper_pearson
from sysid_lab.store import read_rows

NEEDED, OPTIONAL = ("record", "verdict", "effects"), ("ties", "unseen", "stand_in")
VERDICTS = ("effects_found", "nothing_missing", "unexplained", "model_does_not_fit")
NOT_ANSWERED = "not answered"
WORDS = ("right", "tied", "wrong", "flagged", "missed", NOT_ANSWERED)
TITLES = {
    "nominal": "one effect, nominal size",
    "quarter": "one effect, quarter size",
    "two": "two effects",
    "outside": "a law outside the dictionary",
    "none": "nothing missing",
}


@dataclass(frozen=True)
class Score:
    """What a tool scored.

    Parameters
    ----------
    name : str
        Of the answer file.
    outcomes : dict
        Record to what its answer counts as.
    classes : dict
        Record to its class, a key of the titles of the table.
    """

    name: str
    outcomes: dict[str, Outcome]
    classes: dict[str, str]

    def count(self, words: Sequence[str], only: str | None = None) -> tuple[int, int]:
        """Return how many records of a class (of all) count as one of these words, and of how many."""
        own = [outcome.word for record, outcome in self.outcomes.items() if only in (None, self.classes[record])]
        return sum(word in words for word in own), len(own)


def score(truth: str | Path, answers: Sequence[str | Path]) -> tuple[list[Score], str]:
    """Judge answer files; return their scores, the best first, and the table as Markdown.

    Parameters
    ----------
    truth : path
        ``truth.csv``.
    answers : sequence of path
        Answer files; the table calls each by its name without ending.

    Raises
    ------
    InputError
        If a file is no such table, names a record that there is not, or one twice.
    """
    known = read_truth(truth)
    classes = {record: _class(row) for record, row in known.items()}
    scores = []
    for path in answers:
        given = read_answers(path)
        strangers = [record for record in given if record not in known]
        if strangers:
            raise InputError(
                "answer to a record that there is not",
                expected=f"records of {truth}",
                got=strangers[0],
                remedy="answer the records of this package",
                file=path,
            )
        outcomes = {
            record: judge_answer(
                _split(row["truth"]), given[record], row["plant"], row["engine"], row.get("structure", "")
            )
            if record in given
            else Outcome(NOT_ANSWERED)
            for record, row in known.items()
        }
        scores.append(Score(Path(path).stem, outcomes, classes))
    scores.sort(key=lambda own: -own.count(("right", "tied"))[0])
    return scores, _table(scores)


def read_truth(path: str | Path) -> dict[str, dict[str, str]]:
    """Return the rows of ``truth.csv`` by record; those of earlier versions do not say how a structure is wrong."""
    needed = [name for name in TRUTH_COLUMNS if name != "structure"]
    return {row["record"]: row for row in rows_of(path, needed, ("structure",))}


def read_answers(path: str | Path) -> dict[str, Answer]:
    """Return the answers of a file by record.

    Raises
    ------
    InputError
        If a column is missing or unknown, a record comes twice, or a verdict contradicts its effects.
    """
    found: dict[str, Answer] = {}
    for row in rows_of(path, NEEDED, OPTIONAL):
        record, verdict, effects = row["record"], row["verdict"], _split(row["effects"])
        wrong = ""
        if record in found:
            wrong = "the record once"
        elif verdict not in VERDICTS:
            wrong = " | ".join(VERDICTS)
        elif bool(effects) != (verdict == "effects_found"):
            wrong = "effects where the verdict is effects_found, and only there"
        elif any(name.count("@") != 1 for name in effects):
            wrong = "EFFECT@PLACE, several joined by ' + '"
        elif row.get("stand_in", "") not in ("", "yes", "no"):
            wrong = "stand_in yes, no or empty"
        if wrong:
            raise InputError(
                f"answer to {record}", expected=wrong, got=f"{verdict!r}, {row['effects']!r}", remedy="correct it",
                file=path,
            )  # fmt: skip
        ties = tuple(
            tuple(frozenset(_split(member, " & ")) for member in _split(tie, " / "))
            for tie in (row.get("ties") or "").split("; ")
        )
        found[record] = Answer(
            verdict,
            tuple(effects),
            ties[: len(effects)] if any(ties) else (),
            frozenset(_split(row.get("unseen", ""))),
            row.get("stand_in") == "yes",
        )
    return found


def write_answers(path: str | Path, answers: Mapping[str, Answer]) -> None:
    """Write an answer file."""
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*NEEDED, *OPTIONAL))
        for record, answer in answers.items():
            ties = "; ".join(
                " / ".join(sorted(" & ".join(sorted(member)) for member in tie)) for tie in answer.ties
            )  # fmt: skip
            stand_in = "yes" if answer.stand_in else ""
            effects, unseen = " + ".join(answer.accepted), " + ".join(sorted(answer.unseen))
            writer.writerow((record, answer.verdict, effects, ties if any(answer.ties) else "", unseen, stand_in))


def answers_of_fleet(folder: str | Path) -> dict[str, Answer]:
    """Return what the closed loop answered to the records of a package, from the folder of its run over them.

    A record that broke is not answered.
    """
    from harness.fleet import fleet_table

    result = fleet_table(folder)
    answers = {}
    for row in result.rows:
        if not row.ok:
            continue
        report = json.loads((result.folder / "reports" / row.record / "report.json").read_text(encoding="utf-8"))
        parts = {f"{effect['name']}@{effect['at']}" for effect in report["effects"] if effect.get("may_be_part_of")}
        named = [effect for effect in row.effects if effect.name not in parts]  # a part of something unknown is no name
        accepted = tuple(effect.name for effect in named)
        ties = tuple((frozenset({effect.name}), *(frozenset(_members(tie)) for tie in effect.ties)) for effect in named)
        hidden = frozenset(f"{effect['name']}@{effect['at']}" for effect in report.get("not_visible", ()))
        imitates = bool(row.stand_in) or bool(report.get("misfit"))
        answers[Path(row.record).name] = Answer(
            row.verdict, accepted, ties, hidden if not accepted else frozenset(), imitates
        )
    return answers


def answers_of_rows(path: str | Path) -> dict[str, Answer]:
    """Return the answers behind the rows of a study (``rows.csv``) that has run on the records of its plan.

    What a row says to be invisible is what was hidden: rows do not keep the others of that list.
    """
    answers = {}
    for row in read_rows(Path(path)).values():
        if row["status"] != "ok" or row["study"] == "cost":
            continue
        accepted = tuple(_split(row["accepted"])) if row["verdict"] == "effects_found" else ()
        # rows keep only ties of two members or more, in the order of the effects
        listed = [[frozenset(_split(m, " & ")) for m in tie.split(" / ")] for tie in row["ties"].split("; ") if tie]
        ties = tuple(
            tuple(listed.pop(0)) if listed and frozenset({name}) in listed[0] else (frozenset({name}),)
            for name in accepted
        )
        unseen = frozenset(_split(row["truth"])) if row["how"] == "said to be invisible" else frozenset()
        stand_in = bool(row["stand_in"]) or row["how"] == STAND_IN
        answers[record_name(row["key"])] = Answer(row["verdict"], accepted, ties, unseen, stand_in)
    return answers


def _members(tie: str) -> list[str]:
    """Return the effects of a tie that the report writes as ``A + B@x, y``."""
    names, _, places = tie.partition("@")
    return [f"{name}@{at}" for name, at in zip(names.split(" + "), places.split(", "), strict=True)]


def _split(text: str, between: str = " + ") -> list[str]:
    return [part.strip() for part in text.split(between) if part.strip()]


def rows_of(path: str | Path, needed: Sequence[str], optional: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file with these columns."""
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            names, rows = list(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "table", expected="a CSV file", got=unread(path, error), remedy="check the path", file=path
        ) from error
    missing = [name for name in needed if name not in names]
    unknown = [name for name in names if name not in (*needed, *optional)]
    if missing or unknown:
        raise InputError(
            "columns",
            expected=", ".join((*needed, *(f"{name} (optional)" for name in optional))),
            got=f"no {missing[0]}" if missing else f"{unknown[0]!r}",
            remedy="correct the first line",
            file=path,
        )
    return [{name: (row[name] or "").strip() for name in names} for row in rows]


def _class(row: Mapping[str, str]) -> str:
    """Return the class of a record."""
    if not row["truth"]:
        return "none"
    return row["level"] if row["study"] == "confusion" else row["study"]


def _table(scores: Sequence[Score]) -> str:
    """Return the leaderboard, then the outcomes of each tool by class."""
    total = len(scores[0].outcomes) if scores else 0
    lines = [
        f"# Leaderboard over {total} records",
        "",
        "Right: the named set is the truth, effect and place; tied: the truth is in the tie set, or the same on this "
        "plant; wrong: another set; flagged: said that something is missing, and named no cause; missed: said that "
        "nothing is missing. Of a law outside the dictionary, flagged is the good answer; where nothing is missing, "
        "any named effect is a false alarm (wrong). Intervals are 95 % (Clopper-Pearson).",
        "",
        "| tool | right or tied | right | flagged outside the dictionary | false alarms | not answered |",
        "|---|---|---|---|---|---|",
    ]
    for own in scores:
        inside = [name for name in TITLES if name not in ("outside", "none")]
        good, right, of = (sum(own.count(words, name)[k] for name in inside) for words, k in
                           ((("right", "tied"), 0), (("right",), 0), (("right",), 1)))  # fmt: skip
        cells = [_share(good, of), _share(right, of), _share(*own.count(("flagged",), "outside"))]
        cells += [_share(*own.count(("wrong",), "none")), str(own.count((NOT_ANSWERED,))[0])]
        lines.append(f"| {own.name} | {' | '.join(cells)} |")
    for own in scores:
        lines += ["", f"## {own.name}", "", f"| class | records | {' | '.join(WORDS)} |"]
        lines.append("|---" * (len(WORDS) + 2) + "|")
        for name, title in TITLES.items():
            of = own.count(WORDS, name)[1]
            if of:
                lines.append(f"| {title} | {of} | {' | '.join(str(own.count((w,), name)[0]) for w in WORDS)} |")
    return "\n".join(lines) + "\n"


def _share(found: int, of: int) -> str:
    """Return a share with its interval."""
    if not of:
        return "-"
    low, high = clopper_pearson(found, of)
    return f"{found} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"
