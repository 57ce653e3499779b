"""A report in a notebook: the answer, its figures, errors before and after, and the pictures, in one piece of HTML."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from harness.diagnosis.report.html import error_rows
from harness.diagnosis.report.words import as_recorded, digits, shown
from harness.display import page, table
from harness.plots import embedded

PICTURES = {
    "overlay": "validation data and simulation",
    "levels": "residual of every joint",
    "residual": "what the model leaves",
}
"""Pictures that are shown, in this order, and what they show."""
MOST_WARNINGS = 6
LARGEST = 400_000
"""Bytes of a picture that a notebook stores: of a report whose panels are many a link to the page is enough."""


def notebook(data: Mapping[str, Any], figures: Mapping[str, str], where: str = "") -> str:
    """Return the answer of a report as HTML that needs no file and whose every text is escaped.

    - ``data``: the content of ``report.json``
    - ``figures``: SVG texts by name; ``overlay`` (of an arm ``levels``) and ``residual`` are shown
    - ``where``: the whole page, if there is one
    """
    parts = [
        _effects(data),
        _errors(data),
        *(_picture(figures, *pair) for pair in PICTURES.items()),
        _rest(data, where),
    ]
    verdict = str(data["verdict"]).replace("_", " ")
    return page(f"{verdict}: {data['summary']}", *(part for part in parts if part))


def _effects(data: Mapping[str, Any]) -> str:
    """Return the table of what was found, with values, intervals and units."""
    rows = []
    for effect in data["effects"]:
        name = f"{str(effect['name']).replace('_', ' ')} at {effect['at']}"
        for key, entry in effect["parameters"].items():
            entry = as_recorded(entry, effect["at"], data)
            figures = shown(entry)
            rows.append((name, key, figures["value"], figures["interval"], entry["unit"], entry.get("meaning", "")))
            name = ""
        if name:
            rows.append((name, "", "", "", "", effect.get("summary", "")))
    return (
        table(["what the model lacks", "parameter", "value", "95 % interval", "unit", "meaning"], rows) if rows else ""
    )


def _errors(data: Mapping[str, Any]) -> str:
    """Return the table of errors before and after, on the data that judge."""
    arm = [joint for joint in data.get("joints") or () if isinstance(joint, Mapping) and joint.get("before")]
    if arm:
        use = "test" if "test" in arm[0]["before"] else "validation"
        rows = [
            (joint["joint"], _number(joint["before"].get(use)), _number(joint["after"].get(use)), joint["unit"])
            for joint in arm
        ]
        return table([f"joint, {use}", "residual before", "after", "unit"], rows)
    found = [
        (
            row["use"],
            ", ".join(filter(None, (row["kind"], row["horizon"]))),
            row["output"],
            _number(row["before"]),
            _number(row["after"]),
            row["unit"],
        )
        for row in error_rows(dict(data))
        if row["use"] != "estimation"
    ]
    return table(["data", "error", "output", "before", "after", "unit"], found) if found else ""


def _number(value: float | None) -> str:
    """Return a figure in four digits."""
    return "" if value is None else digits(value)


def _picture(figures: Mapping[str, str], name: str, words: str) -> str:
    """Return a picture; nothing where there is none, or it is too large for a notebook."""
    text = figures.get(name, "")
    if not text or len(text) > LARGEST:
        return ""
    return embedded(text, words)


def _rest(data: Mapping[str, Any], where: str) -> str:
    """Return the warnings, and where the whole page lies."""
    said = [str(text) for text in data.get("warnings", ())]
    more = [f"{len(said) - MOST_WARNINGS} more"] if len(said) > MOST_WARNINGS else []
    lines = [*said[:MOST_WARNINGS], *more]
    listed = table(["warnings"], [(line,) for line in lines]) if lines else ""
    return listed + (f"<p>the whole report: {escape(where)}</p>" if where else "")
