"""Tables of a benchmark: medians and quartiles of each plant x scenario x identifier, for a terminal or a query."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.benchmark.row import Row
from harness.benchmark.statistics import Ranking, no_worse, ranking

if TYPE_CHECKING:
    from rich.console import Group, RenderableType

    from harness.benchmark.running import BenchResult

__all__ = ["Quartiles", "Summary", "figure", "places_of", "rankings", "rich_table", "summarise"]

SCORES = ("equation_error", "simulation_error", "regret", "noise_floor", "fit_seconds", "memory_mib")
BASELINES = ("true-model",)
"""Identifiers that know the truth: they show what is possible and do not compete."""


@dataclass(frozen=True)
class Quartiles:
    """Median and quartiles of a score over seeds."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{figure(self.median)} [{figure(self.low)}, {figure(self.high)}]"


@dataclass(frozen=True)
class Summary:
    """One line of the table: all seeds of one plant, scenario and identifier."""

    plant: str
    scenario: str
    identifier: str
    ok: int
    run: int
    equation_error: Quartiles | None
    simulation_error: Quartiles | None
    regret: Quartiles | None
    noise_floor: Quartiles | None
    fit_seconds: Quartiles | None
    memory_mib: Quartiles | None
    leading: bool
    """The least simulation error of its plant and scenario, or one that the paired bootstrap cannot tell from it."""
    problems: tuple[tuple[str, str, int], ...]
    """(status, reason, count) of the rows that are not ok, the most frequent first."""


def figure(value: float | None, digits: int = 3) -> str:
    """Return a score with a few significant digits, as short as can be.

    Examples
    --------
    >>> figure(0.012345), figure(0.00012345), figure(12345.0), figure(1.0), figure(None)
    ('0.0123', '1.23e-4', '1.23e4', '1', '-')
    """
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.{digits}g}"
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


def summarise(rows: Sequence[Row], cells: Sequence[tuple[str, str, str]] = ()) -> list[Summary]:
    """Return one summary for each plant x scenario x identifier, in the order of ``cells``, then of the rows.

    Medians are over the rows with status ``ok``; the noise floor is that of all rows.
    """
    grouped: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for cell in cells:
        grouped[cell] = []
    for row in rows:
        grouped[row.plant, row.scenario, row.identifier].append(row)
    result = []
    leaders = _leaders(grouped)
    for (plant, scenario, identifier), own in grouped.items():
        good = [row for row in own if row.status == "ok"]
        scores = {name: _quartiles([getattr(row, name) for row in good]) for name in SCORES}
        scores["noise_floor"] = _quartiles([row.noise_floor for row in own])
        leading = (plant, scenario, identifier) in leaders
        counts = Counter((row.status, row.reason) for row in own if row.status != "ok")
        problems = tuple((status, reason, n) for (status, reason), n in counts.most_common())
        result.append(
            Summary(plant, scenario, identifier, len(good), len(own), **scores, leading=leading, problems=problems)
        )
    return result


def _leaders(grouped: Mapping[tuple[str, str, str], Sequence[Row]]) -> set[tuple[str, str, str]]:
    """Return the lines that lead their plant and scenario, over the seeds that all of its identifiers have."""
    places: dict[tuple[str, str], dict[str, Sequence[Row]]] = defaultdict(dict)
    for (plant, scenario, identifier), rows in grouped.items():
        if identifier not in BASELINES and any(row.simulation_error is not None for row in rows):
            places[plant, scenario][identifier] = rows
    found = set()
    for (plant, scenario), own in places.items():
        found |= {(plant, scenario, name) for name in no_worse(_paired(own))}
    return found


def _paired(own: Mapping[str, Sequence[Row]]) -> dict[str, list[float | None]]:
    """Return the simulation errors by identifier over the seeds that all have run; None where a cell is not ok."""
    by_seed = {
        name: {row.seed: row.simulation_error if row.status == "ok" else None for row in rows}
        for name, rows in own.items()
    }
    seeds = sorted(set.intersection(*(set(scores) for scores in by_seed.values())))
    return {name: [scores[seed] for seed in seeds] for name, scores in by_seed.items()}


def places_of(lines: Sequence[Summary]) -> list[tuple[str, str, list[Summary]]]:
    """Return the summaries grouped by plant and scenario."""
    grouped: dict[tuple[str, str], list[Summary]] = {}
    for line in lines:
        grouped.setdefault((line.plant, line.scenario), []).append(line)
    return [(plant, scenario, own) for (plant, scenario), own in grouped.items()]


def rankings(rows: Sequence[Row]) -> list[Ranking]:
    """Return a ranking for each set of identifiers that meet in the same plants and scenarios.

    Blocks are plant x scenario x seed. Identifiers without a simulation error anywhere (online ones) do not take part,
    nor does the true model.
    """
    places: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.identifier not in BASELINES:
            places[row.plant, row.scenario][row.identifier].append(row)
    families: dict[frozenset[str], list[tuple[str, str]]] = defaultdict(list)
    for place, own in places.items():
        taking = frozenset(n for n, found in own.items() if any(row.simulation_error is not None for row in found))
        families[taking].append(place)
    result = []
    for names, where in families.items():
        blocks: list[dict[str, float | None]] = []
        for place in where:
            table = _paired({name: places[place][name] for name in names}) if names else {}
            blocks += [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
        made = ranking(blocks, [f"{plant} x {scenario}" for plant, scenario in where])
        if made is not None:
            result.append(made)
    return result


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
    for name in ("equation error", "simulation error", "floor", "regret"):
        made.add_column(name, no_wrap=True, min_width=7 if name == "floor" else None)
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
            figure(line.noise_floor.median, 2) if line.noise_floor and not row_of_place else "",
            _shown(line.regret),
        )
        if not row_of_place and _alone(line, lines):
            made.add_row(Text(f"  {line.scenario}"))
    heading = Text(f"{result.suite}: ", style="bold")
    heading.append(
        "median [quartiles] over seeds; errors are NRMSE on held-out data; floor: sensor noise, the least possible",
        style="not bold",
    )
    parts: list[RenderableType] = [heading, made]
    parts += [Text(text, style="dim") for text in _reasons(lines)]
    parts.append(Text(f"{result.ok} ok of {len(result.rows)} run, {result.planned} planned"))
    return Group(*parts)


def _quartiles(values: Sequence[float | None]) -> Quartiles | None:
    """Return median and quartiles of the values that exist, or None."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return None
    low, median, high = np.quantile(numbers, [0.25, 0.5, 0.75])
    return Quartiles(float(median), float(low), float(high))


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
