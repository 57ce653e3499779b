"""The table of a benchmark for a terminal."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from harness.benchmark.result import BenchResult
from harness.benchmark.summary import CONTROL, Quartiles, Summary, figure, optional_scores

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.table import Table

__all__ = ["rich_table"]


def rich_table(result: BenchResult) -> Group:
    """Return the table for a terminal, and below it a line for each kind of failure with its reason.

    The least simulation error of each plant and scenario stands out, with those that the paired bootstrap over seeds
    cannot tell from it (from five seeds on).
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    lines = result.summary()
    made = Table(box=SIMPLE_HEAD, header_style="bold", padding=(0, 1), collapse_padding=True, pad_edge=False)
    for name, part in (("plant, scenario", "plant"), ("identifier", "identifier")):
        made.add_column(name, no_wrap=True, min_width=max((len(getattr(line, part)) for line in lines), default=0))
    made.add_column("ok", justify="right", no_wrap=True, min_width=5)
    control = any(line.control for line in lines)
    for name in ("equation error", "simulation error", "best", "x best", "regret", *CONTROL * control):
        widest = max((len(_best(line)) for line in lines), default=0) if name == "best" else None
        made.add_column(name, no_wrap=True, min_width=widest)
    place, row_of_place = ("", ""), 0
    for line in lines:
        row_of_place = row_of_place + 1 if place == (line.plant, line.scenario) else 0
        place = (line.plant, line.scenario)
        if not row_of_place and made.row_count:
            made.add_section()
        title = (Text(line.plant, style="bold"), Text(f"  {line.scenario}"), Text(""))[min(row_of_place, 2)]
        style = "bold green" if line.leading else ""
        made.add_row(
            title,
            Text(line.identifier, style=style),
            Text(f"{line.ok}/{line.run}", style="" if line.ok == line.run else "yellow"),
            _shown(line.equation_error) if line.ok else Text(_status(line), style="yellow"),
            Text(_shown(line.simulation_error), style=style),
            _best(line) if not row_of_place else "",
            figure(line.over_best.median) if line.over_best else "",
            _shown(line.regret),
            *((_shown(line.control_score), _shown(line.control_regret), line.control) if control else ()),
        )
        if not row_of_place and _alone(line, lines):
            made.add_row(Text(f"  {line.scenario}"))
    heading = Text(f"{result.suite}: ", style="bold")
    heading.append(
        "median [quartiles] over seeds; errors are NRMSE on held-out data; best: the least possible, sensor noise or, "
        "marked CR, the Cramer-Rao bound; x best: 1 is as good as can be",
        style="not bold",
    )
    parts: list[RenderableType] = [heading, made]
    if more := optional_scores(lines):
        parts.append(_optional_table(lines, more))
    parts += [Text(text, style="dim") for text in _reasons(lines)]
    parts.append(Text(f"{result.ok} ok of {len(result.rows)} run, {result.planned} planned"))
    return Group(*parts)


def _optional_table(lines: Sequence[Summary], more: Mapping[str, str]) -> Table:
    """Return a second, narrow table of the scores that not every model has: beside the first they would squeeze it."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, header_style="bold", padding=(0, 1), collapse_padding=True, pad_edge=False)
    for title in ("plant", "scenario", "identifier", *more.values()):
        made.add_column(title, no_wrap=True)
    for line in lines:
        if any(getattr(line, name) for name in more):
            made.add_row(line.plant, line.scenario, line.identifier, *(_shown(getattr(line, name)) for name in more))
    return made


def _best(line: Summary) -> str:
    """Return the best possible, with its kind."""
    if line.best_possible is None:
        return ""
    return figure(line.best_possible.median, 3) + " CR" * (line.bound == "Cramer-Rao")


def _shown(score: Quartiles | None) -> str:
    """Return a score for a narrow column; quartiles only where they differ."""
    if score is None:
        return ""
    low, high = (figure(value, 2).removeprefix("0") or "0" for value in (score.low, score.high))
    return figure(score.median) if low == high else f"{figure(score.median)} [{low} {high}]"


def _status(line: Summary) -> str:
    """Return the most frequent status of a line without a row that is ok."""
    return line.problems[0][0] if line.problems else "not run"


def _alone(line: Summary, lines: Sequence[Summary]) -> bool:
    """Return True if no other line has this plant and scenario."""
    return sum((other.plant, other.scenario) == (line.plant, line.scenario) for other in lines) == 1


def _reasons(lines: Sequence[Summary]) -> list[str]:
    """Return one line for each identifier and status: how many rows, where, and the most frequent reason."""
    grouped: dict[tuple[str, str], list[tuple[Summary, str, int]]] = defaultdict(list)
    for line in lines:
        for status, reason, count in line.problems:
            grouped[line.identifier, status].append((line, reason, count))
    texts = []
    for (identifier, status), found in grouped.items():
        places = list(dict.fromkeys(f"{line.plant} x {line.scenario}" for line, _, _ in found))
        where = places[0] + (f" and {len(places) - 1} more" if len(places) > 1 else "")
        reason = max(found, key=lambda item: item[2])[1]
        shown = reason if len(reason) <= 200 else reason[:197] + "..."
        texts.append(f"{sum(n for _, _, n in found)} {status}: {identifier} on {where}: {shown}")
    return texts
