"""Two reports of the closed loop side by side: what differs in the answers, and what went in differently."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.errors import UNREADABLE, InputError, as_written
from harness.units import behind, told

FORMAT = "sysid-harness/close-loop/"
SAME = 1e-3  # Relative difference of two figures below which nobody looks: the fits of two machines differ by less.


@dataclass(frozen=True)
class Difference:
    """One thing that differs."""

    side: str  # {"input", "answer"}: What went in (data, model, dictionary, thresholds, version), or what came out
    what: str
    # As the reports say it
    first: str
    second: str
    meaning: str = ""  # Whether the difference is within the intervals, where there are some


@dataclass(frozen=True)
class ReportComparison:
    """What :func:`compare_reports` returns."""

    names: tuple[str, str]
    differences: tuple[Difference, ...]

    def rows(self) -> list[dict[str, str]]:
        """Return one row for each difference, what went in first."""
        ordered = sorted(self.differences, key=lambda one: one.side != "input")
        return [
            {"side": one.side, "what": one.what, "first": one.first, "second": one.second, "meaning": one.meaning}
            for one in ordered
        ]

    def __str__(self) -> str:
        inputs = list(dict.fromkeys(one.what for one in self.differences if one.side == "input"))
        answers = [one for one in self.differences if one.side == "answer"]
        if not answers:
            return "the answers are the same" + (f", though these differ: {', '.join(inputs)}" if inputs else "")
        why = (
            f"what went in differs: {', '.join(inputs)}"
            if inputs
            else "nothing that the reports tell went in otherwise"
        )
        return f"{len(answers)} answers differ; {why}"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        rows = [tuple(row.values()) for row in self.rows()]
        return page(str(self), table(["", "what", *self.names, "meaning"], rows))


def is_report(path: str | Path) -> bool:
    """Return True for a report of the closed loop: ``report.json``, or the folder that holds it."""
    path = Path(path)
    if path.is_dir():
        return (path / "report.json").is_file()
    if path.suffix != ".json" or not path.is_file():
        return False
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except UNREADABLE:
        return False
    return isinstance(content, dict) and str(content.get("format", "")).startswith(FORMAT)


def compare_reports(first: str | Path, second: str | Path) -> ReportComparison:
    """Say what differs between two reports of the closed loop, and what may be why.

    Parameters
    ----------
    first, second : path
        ``report.json``, or the folder of a closed loop.

    Raises
    ------
    InputError
        If one is no report.
    """
    one, two = _read(first), _read(second)
    wanted = "report.json of sysid close-loop"
    for path, content in ((first, one), (second, two)):  # beside itself: the one that is damaged is named
        with as_written(path, wanted):
            _inputs(content, content)
            _answers(content, content)
    with as_written(second, wanted):
        found = [*_inputs(one, two), *_answers(one, two)]
    return ReportComparison((str(first), str(second)), tuple(found))


def _read(path: str | Path) -> dict[str, Any]:
    """Return the content of a report."""
    file = Path(path) / "report.json" if Path(path).is_dir() else Path(path)
    if not is_report(file):
        raise InputError(
            "not a report",
            expected="report.json of sysid close-loop, or its folder",
            got="no file" if not file.is_file() else "another file",
            remedy="give what sysid close-loop wrote",
            file=file,
        )
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def _inputs(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[Difference]:
    """Return what went in differently, as far as the reports tell."""
    found = [
        Difference("input", title, str(one.get(key)), str(two.get(key)))
        for key, title in (("dataset", "data set"), ("model", "model"), ("format", "format"), ("version", "version"))
        if one.get(key) != two.get(key)
    ]
    tried = [{f"{c['name']}@{c['at']}" for c in data.get("candidates", ())} for data in (one, two)]
    if tried[0] != tried[1]:
        only = [", ".join(sorted(tried[k] - tried[1 - k])) or "-" for k in (0, 1)]
        found.append(Difference("input", "effects that were looked at", only[0], only[1], "only here"))
    numbers = [_thresholds(data.get("policy", {})) for data in (one, two)]
    for name in sorted(set(numbers[0]) | set(numbers[1])):
        values = [side.get(name) for side in numbers]
        if values[0] != values[1]:
            found.append(Difference("input", f"threshold {name}", str(values[0]), str(values[1])))
    said = [
        {re.sub(rf"\b{re.escape(str(data.get('dataset')))}(?=\.\w)", "FILE", text) for text in data.get("warnings", ())}
        for data in (one, two)
    ]  # what is said of either file alike is no difference
    for k in (0, 1):
        for text in sorted(said[k] - said[1 - k]):
            found.append(Difference("input", "warning", text if k == 0 else "-", text if k == 1 else "-"))
    return found


def _thresholds(policy: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers that decide, by group and name."""
    return {
        f"{group}.{name}": entry.get("value") if isinstance(entry, Mapping) else entry
        for group, entries in policy.items()
        if isinstance(entries, Mapping)
        for name, entry in entries.items()
    }


def _answers(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[Difference]:
    """Return the answers that differ: verdict, effects, ties, parameters, errors, convergence."""
    found = [
        Difference("answer", key, str(one.get(key)), str(two.get(key)))
        for key in ("verdict", "adequacy")
        if one.get(key) != two.get(key)
    ]
    found += [*_effects(one, two), *_parameters(one, two), *_errors(one, two)]
    if one.get("converged") != two.get("converged"):
        found.append(Difference("answer", "fits converged", str(one.get("converged")), str(two.get("converged"))))
    return found


def _effects(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[Difference]:
    """Return the difference in the effects that were found, and whether the data tell them apart."""
    effects = [[f"{e['name']}@{e['at']}" for e in data.get("effects", ())] for data in (one, two)]
    if sorted(effects[0]) == sorted(effects[1]):
        return []
    tied = [{f"{t['name']}@{t['at']}" for tie in data.get("tie_sets", ()) for t in tie} for data in (one, two)]
    named = all(name in tied[1] for name in effects[0]) or all(name in tied[0] for name in effects[1])
    meaning = "one report ties both names: the data cannot tell them apart" if named else ""
    shown = [" + ".join(names) or "none" for names in effects]
    return [Difference("answer", "effects", shown[0], shown[1], meaning)]


def _parameters(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[Difference]:
    """Return the parameters that differ, and whether their intervals meet."""
    found = []
    sides = [data.get("parameters", {}).get("after", {}) for data in (one, two)]
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        pair = [side.get(name) for side in sides]
        if pair[0] is None or pair[1] is None:
            shown = ["-" if own is None else _parameter(own) for own in pair]
            found.append(Difference("answer", f"parameter {name}", *shown))
        elif not _same(pair[0]["value"], pair[1]["value"]):
            first, second = (_parameter(own) for own in pair)
            found.append(Difference("answer", f"parameter {name}", first, second, _overlap(pair[0], pair[1])))
    return found


def _errors(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[Difference]:
    """Return the outputs whose validated error differs."""
    found = []
    sides = [
        data.get("errors", {}).get("after", {}).get("simulation_error", {}).get("validation", {}) for data in (one, two)
    ]
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        scores = [side.get(name, {}) for side in sides]
        if not _same(scores[0].get("rms"), scores[1].get("rms")):
            own = [data.get("recorded", {}).get(name, {}).get("recorded") for data in (one, two)]
            shown = [_error(score, unit) for score, unit in zip(scores, own, strict=True)]
            found.append(Difference("answer", f"simulation error of {name}", *shown))
    return found


def _error(score: Mapping[str, Any], recorded: str | None) -> str:
    """Return an error in the unit in which the output was recorded."""
    if score.get("rms") is None:
        return "-"
    size, unit = told(float(score["rms"]), score["unit"], recorded or score["unit"])
    return f"{size:.4g}{behind(unit)}"


def _same(first: float | None, second: float | None) -> bool:
    """Return True for figures that nobody would tell apart."""
    if first is None or second is None:
        return first is second
    return abs(first - second) <= SAME * max(abs(first), abs(second))


def _parameter(own: Mapping[str, Any]) -> str:
    """Return a value with its interval."""
    interval = "" if own.get("low") is None else f" [{own['low']:.4g}, {own['high']:.4g}]"
    value = "-" if own.get("value") is None else f"{own['value']:.6g}"
    return f"{value}{interval}{behind(own.get('unit') or '1')}"


def _overlap(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """Return whether two intervals have a value in common."""
    if any(own.get(end) is None for own in (first, second) for end in ("low", "high")):
        return "an interval is missing"
    apart = max(first["low"], second["low"]) > min(first["high"], second["high"])
    return "the intervals do not meet" if apart else "the intervals meet"
