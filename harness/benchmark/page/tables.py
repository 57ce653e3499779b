"""The table of a benchmark for a terminal, as wide as the terminal is.

It is laid out in the first of these forms that fits: all columns; plant, scenario and the best possible above their
rows, not beside them; without the columns of :data:`LEAVING`; without quartiles; one block for each row.
"""

from __future__ import annotations

import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from harness.benchmark.result import BenchResult
from harness.benchmark.summary import CONTROL, Quartiles, Summary, figure, optional_scores, pairs_in_words

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.table import Table
    from rich.text import Text

LEAVING = ("model for control", "control regret")
"""Columns that leave a table that is too wide, together; the quartiles of the others leave after them."""
UNBOUNDED = sys.maxsize  # Columns in which every table fits.
SHORT = 9  # Letters of a title that stays on one line where columns are narrow.
REASON = 200  # Characters of a reason that are printed.


def rich_table(result: BenchResult) -> RenderableType:
    """Return the table for a terminal of any width, and below it a line for each kind of failure with its reason.

    The least simulation error of each plant and scenario stands out, with those that tie with it
    (:func:`harness.benchmark.statistics.standings`; from five replicates on). No figure is ever cut: what a narrow
    terminal has no room for is left out and named below the table, and below some 70 columns each row becomes a block.
    """
    return _Fitted(result)


class _Fitted:
    """A benchmark's table that takes the width it is printed at."""

    def __init__(self, result: BenchResult) -> None:
        self.result = result
        self.lines = result.summary()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        from rich.text import Text

        more = optional_scores(self.lines)
        columns = [_EQUATION, _SIMULATION, _Column("x best"), _Column("regret", "regret")]
        if any(line.control for line in self.lines):
            columns += [_Column(title, name) for title, name in zip(CONTROL, _OF_CONTROL, strict=True)]
        optional = [_Column(title, name) for name, title in more.items()]
        found = _fitted(self.lines, columns, console, options)
        heading = Text(f"{self.result.suite}: ", style="bold")
        spread = "median over seeds" if found and QUARTILES in found[1] else "median [quartiles] over seeds"
        heading.append(
            f"{spread}; errors are NRMSE on held-out data; best: the least possible, sensor noise or, marked CR, the "
            "Cramer-Rao bound; x best: 1 is as good as can be",
            style="not bold",
        )
        yield heading
        if found is None:
            yield from _blocks(self.lines, [*columns, *optional])
        else:
            yield from found[0]
            if found[1]:
                where = self.result.folder or "DIR"
                yield Text(
                    f"left out for want of width: {', '.join(found[1])} "
                    f"('sysid table {where} --format csv' has everything)",
                    style="dim",
                )
            if optional:
                predicted = [line for line in self.lines if any(one.text(line) for one in optional)]
                second = _fitted(predicted, optional, console, options)
                yield from _blocks(predicted, optional) if second is None else second[0]
        for text in [*_reasons(self.lines), pairs_in_words(self.lines)]:
            yield Text(text, style="dim")
        yield Text(f"{self.result.ok} ok of {len(self.result.rows)} run, {self.result.planned} planned")


QUARTILES = "quartiles"
_OF_CONTROL = ("control_score", "predictive_cost", "control_regret", "control")


@dataclass(frozen=True)
class _Column:
    """A score with its title; the attribute of a summary that it is (none: the error over the best)."""

    title: str
    attribute: str = ""

    def text(self, line: Summary, *, quartiles: bool = True) -> str:
        """Return the text of a line's cell."""
        if not self.attribute:
            return figure(line.over_best.median) if line.over_best else ""
        value = getattr(line, self.attribute)
        if isinstance(value, str):
            return value
        return _shown(value) if quartiles or value is None else figure(value.median)

    def style(self, line: Summary) -> str:
        """Return the style of a line's cell: that of the leading where it leads, else none."""
        return LEADING if self is _SIMULATION and line.leading else ""


_EQUATION, _SIMULATION = _Column("equation error", "equation_error"), _Column("simulation error", "simulation_error")
LEADING = "bold green"


def _fitted(
    lines: Sequence[Summary], columns: Sequence[_Column], console: Console, options: ConsoleOptions
) -> tuple[list[RenderableType], list[str]] | None:
    """Return the first form that fits, with what it leaves out; None if no table does."""
    from rich.measure import Measurement

    wide = options.update(width=UNBOUNDED)
    kept = [one for one in columns if one.title not in LEAVING]
    left = [one.title for one in columns if one.title in LEAVING]
    forms: list[tuple[list[RenderableType], list[str]]] = [([_whole(lines, columns)], [])]
    forms.append((_headed(lines, columns, quartiles=True), []))
    forms.append((_headed(lines, kept, quartiles=True), left))
    forms.append((_headed(lines, kept, quartiles=False), [*left, QUARTILES]))
    for parts, missing in forms:
        tables = [part for part in parts if hasattr(part, "columns")]
        if all(Measurement.get(console, wide, part).maximum <= options.max_width for part in tables):
            return parts, missing
    return None


def _empty() -> Table:
    """Return a table without columns, in the style of both forms."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(box=SIMPLE_HEAD, header_style="bold", collapse_padding=True, pad_edge=False)


def _whole(lines: Sequence[Summary], columns: Sequence[_Column]) -> Table:
    """Return the table with plant and scenario, one below the other, beside their rows."""
    from rich.text import Text

    made = _empty()
    for title in ("plant, scenario", "identifier"):
        made.add_column(title, no_wrap=True)
    made.add_column("ok", justify="right", no_wrap=True)
    shows_best = _SIMULATION in columns
    titles = [one.title for one in columns]
    if shows_best:
        titles.insert(titles.index(_SIMULATION.title) + 1, "best")
    for title in titles:
        made.add_column(title, no_wrap=True)
    for place, found in groupby(lines, key=_place):
        own = list(found)
        if made.row_count:
            made.add_section()
        for number, line in enumerate(own):
            cells = _cells(line, columns, quartiles=True)
            if shows_best:
                cells.insert(titles.index("best"), Text("" if number else _best(line)))
            beside = (Text(place[0], style="bold"), Text(f"  {place[1]}"), Text(""))[min(number, 2)]
            made.add_row(beside, *_name(line), *cells)
        if len(own) == 1:
            made.add_row(Text(f"  {place[1]}"))
    return made


def _headed(lines: Sequence[Summary], columns: Sequence[_Column], *, quartiles: bool) -> list[RenderableType]:
    """Return a small table for each plant and scenario below a line that names them, their columns aligned."""
    from rich.cells import cell_len
    from rich.text import Text

    titles = ["identifier", "ok", *map(_folded, (one.title for one in columns))]
    rows = [[*_name(line), *_cells(line, columns, quartiles=quartiles)] for line in lines]
    widths = [
        max(cell_len(word) for cell in (title, *(row[place].plain for row in rows)) for word in cell.split("\n"))
        for place, title in enumerate(titles)
    ]
    shown: list[RenderableType] = []
    at = iter(rows)
    for _, found in groupby(lines, key=_place):
        own = list(found)
        made = _empty()
        made.show_header, made.show_edge = not shown, False
        for title, width in zip(titles, widths, strict=True):
            made.add_column(title, no_wrap=True, min_width=width, justify="right" if title == "ok" else "left")
        for _ in own:
            made.add_row(*next(at))
        shown += [Text(""), _heading(own[0], with_best=_SIMULATION in columns), made]
    return [*shown, Text("")]


def _blocks(lines: Sequence[Summary], columns: Sequence[_Column]) -> list[RenderableType]:
    """Return each row as a block: its identifier, then a score on each line."""
    from rich.padding import Padding
    from rich.text import Text

    shown: list[RenderableType] = []
    for _, found in groupby(lines, key=_place):
        own = list(found)
        shown += [Text(""), _heading(own[0], with_best=_SIMULATION in columns)]
        for line in own:
            name, ok = _name(line)
            status = Text("" if line.ok else f" {_status(line)}", style="yellow")
            shown.append(Text.assemble(name, " ", ok, status))
            for one in columns:
                if text := one.text(line):
                    shown.append(Padding.indent(Text(f"{one.title}: {text}", style=one.style(line)), 2))
    return [*shown, Text("")]


def _folded(title: str) -> str:
    """Return a long title on two lines."""
    return "\n".join(title.rsplit(" ", 1)) if len(title) > SHORT else title


def _place(line: Summary) -> tuple[str, str]:
    """Return the plant and the scenario of a line."""
    return line.plant, line.scenario


def _name(line: Summary) -> tuple[Text, Text]:
    """Return the identifier of a line, and how many of its rows are ok."""
    from rich.text import Text

    ok = Text(f"{line.ok}/{line.run}", style="" if line.ok == line.run else "yellow")
    return Text(line.identifier, style=LEADING if line.leading else ""), ok


def _heading(line: Summary, *, with_best: bool) -> Text:
    """Return the line above the rows of a plant and a scenario."""
    from rich.text import Text

    made = Text.assemble(Text(line.plant, style="bold"), f", {line.scenario}")
    return made.append(f", best {_best(line)}") if with_best and _best(line) else made


def _cells(line: Summary, columns: Sequence[_Column], *, quartiles: bool) -> list[Text]:
    """Return the scores of a line; a line without a row that is ok has its status in place of the first."""
    from rich.text import Text

    cells = [Text(one.text(line, quartiles=quartiles), style=one.style(line)) for one in columns]
    return cells if line.ok else [Text(_status(line), style="yellow"), *cells[1:]]


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
        shown = textwrap.shorten(reason, REASON, placeholder=" ...")  # between words, so that no number is cut
        texts.append(f"{sum(n for _, _, n in found)} {status}: {identifier} on {where}: {shown}")
    return texts
