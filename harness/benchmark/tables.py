"""The table of a benchmark for a terminal."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.benchmark.result import BenchResult
from harness.benchmark.summary import CONTROL, OPTIONAL, Quartiles, Summary, figure, optional_scores

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, Group, RenderableType
    from rich.table import Table
    from rich.text import Text

__all__ = ["rich_table"]


def rich_table(result: BenchResult) -> Group:
    """Return the table for a terminal, and below it a line for each kind of failure with its reason.

    The least simulation error of each plant and scenario stands out, with those that the paired bootstrap over seeds
    cannot tell from it (from five seeds on). On a narrow terminal quartiles go first, then the columns beside the two
    errors, then plant and scenario become headings, and last the simulation error stands alone; no number is cut.
    """
    from rich.console import Group
    from rich.text import Text

    lines = result.summary()
    heading = Text(f"{result.suite}: ", style="bold")
    heading.append(
        "median [quartiles] over seeds; errors are NRMSE on held-out data; best: the least possible, sensor noise or, "
        "marked CR, the Cramer-Rao bound; x best: 1 is as good as can be",
        style="not bold",
    )
    control = any(line.control for line in lines)
    whole = ("equation error", "simulation error", "best", "x best", "regret", *CONTROL * control)
    few = ("equation error", "simulation error", "x best")
    parts: list[RenderableType] = [
        heading,
        _Narrowing(
            (
                lambda: [_wide(lines, whole, quartiles=True)],
                lambda: [_wide(lines, whole)],
                lambda: [_wide(lines, few)],
                lambda: _under_headings(lines, few),
                lambda: _under_headings(lines, ("simulation error",)),
            )
        ),
    ]
    if more := optional_scores(lines):
        others = [line for line in lines if any(getattr(line, name) for name in more)]
        titles = tuple(more.values())
        parts.append(
            _Narrowing(
                (
                    lambda: [_wide(others, titles, quartiles=True)],
                    lambda: [_wide(others, titles)],
                    lambda: _under_headings(others, titles),
                    *(lambda one=one: _under_headings(others, (one,)) for one in titles),
                )
            )
        )
    parts += [Text(text, style="dim") for text in _reasons(lines)]
    parts.append(Text(f"{result.ok} ok of {len(result.rows)} run, {result.planned} planned"))
    return Group(*parts)


@dataclass(frozen=True)
class _Narrowing:
    """Tables in several layouts, widest first: the first that the terminal holds is shown, and said if others exist."""

    layouts: tuple[Callable[[], list[RenderableType]], ...]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        from rich.measure import Measurement
        from rich.table import Table
        from rich.text import Text

        free = options.update_width(10_000)

        def holds(made: Sequence[RenderableType]) -> bool:
            needed = max(Measurement.get(console, free, one).maximum for one in made if isinstance(one, Table))
            return needed <= options.max_width

        *wider, last = self.layouts
        shown = next((made for layout in wider if holds(made := layout())), None)
        yield from last() if shown is None else shown
        if shown is None or not holds(wider[0]()):
            yield Text("narrow terminal: shortened; sysid table DIR --format csv has all\n", style="dim")


def _empty() -> Table:
    """Return a table without rows."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(box=SIMPLE_HEAD, header_style="bold", padding=(0, 1), collapse_padding=True, pad_edge=False)


def _wide(lines: Sequence[Summary], titles: Sequence[str], *, quartiles: bool = False) -> Table:
    """Return one table; plant and scenario stand in its first column."""
    from rich.text import Text

    made = _empty()
    for name in ("plant, scenario", "identifier", "ok", *titles):
        made.add_column(name, no_wrap=True, justify="right" if name == "ok" else "left")
    place, row_of_place = ("", ""), 0
    for line in lines:
        row_of_place = row_of_place + 1 if place == (line.plant, line.scenario) else 0
        place = (line.plant, line.scenario)
        if not row_of_place and made.row_count:
            made.add_section()
        title = (Text(line.plant, style="bold"), Text(f"  {line.scenario}"), Text(""))[min(row_of_place, 2)]
        made.add_row(title, *_cells(line, titles, quartiles=quartiles, first=not row_of_place))
        if not row_of_place and _alone(line, lines):
            made.add_row(Text(f"  {line.scenario}"))
    return made


def _under_headings(lines: Sequence[Summary], titles: Sequence[str]) -> list[RenderableType]:
    """Return a heading and a table for each plant and scenario, all of the same widths."""
    from rich.text import Text

    places: dict[tuple[str, str], list[Summary]] = defaultdict(list)
    for line in lines:
        places[line.plant, line.scenario].append(line)
    names = max((len(line.identifier) for line in lines), default=0)
    made: list[RenderableType] = []
    for (plant, scenario), own in places.items():
        part = _empty()
        part.add_column("identifier", no_wrap=True, min_width=names)
        part.add_column("ok", no_wrap=True, justify="right", min_width=5)
        for title in titles:
            part.add_column(title, min_width=max(map(len, title.split())))
        for line in own:
            part.add_row(*_cells(line, titles, quartiles=False, first=True))
        made += [Text(f"{plant}, {scenario}", style="bold"), part]
    return made


def _cells(line: Summary, titles: Sequence[str], *, quartiles: bool, first: bool) -> list[Text]:
    """Return identifier, how many rows are ok, and the scores of a line by the titles of their columns."""
    from rich.text import Text

    def score(found: Quartiles | None) -> str:
        return _shown(found) if quartiles or found is None else figure(found.median)

    style = "bold green" if line.leading else ""
    text = {
        "simulation error": score(line.simulation_error),
        "best": _best(line) if first else "",
        "x best": figure(line.over_best.median) if line.over_best else "",
        "regret": score(line.regret),
        **dict(zip(CONTROL, (score(line.control_score), score(line.control_regret), line.control or ""), strict=True)),
        **{title: score(getattr(line, name)) for name, title in OPTIONAL.items()},
    }
    cells = [Text(line.identifier, style=style)]
    cells.append(Text(f"{line.ok}/{line.run}", style="" if line.ok == line.run else "yellow"))
    for title in titles:
        if not line.ok and title in ("equation error", *(("simulation error",) * ("equation error" not in titles))):
            cells.append(Text(_status(line), style="yellow"))
        elif title == "equation error":
            cells.append(Text(score(line.equation_error)))
        else:
            cells.append(Text(text[title], style=style if title == "simulation error" else ""))
    return cells


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
