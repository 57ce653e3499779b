"""The page of a fleet: which effect is where, how its size moves with date and machine, what is new, what failed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

from harness.benchmark.page.plots import INK, LINES, STYLE, svg_text
from harness.benchmark.page.report import filled
from harness.benchmark.summary import figure
from harness.fleet.changes import chance, changes, odd_machines
from harness.fleet.row import FleetRow, FoundEffect
from harness.fleet.trends import Series, new_effects, series_of, trends
from harness.units import behind

TEMPLATE = Path(__file__).with_name("fleet.html.j2")
PANELS = 40  # Effects that are drawn; the table has all.
CUT = 0.5  # An interval is drawn as far beyond the sizes as this share of their range.
LONG = 200  # Records beyond which their table is folded: a reader wants the machines first.
DIGITS = 9  # Significant digits of a size, at most: as many as are needed to tell the ends of its interval apart.


def fleet_page(rows: Sequence[FleetRow], *, planned: int, model: str, reports: str) -> str:
    """Return the page as text; it loads nothing, and links to the reports of the records."""
    series = series_of(rows)
    return filled(
        TEMPLATE,
        rows=rows,
        planned=planned,
        model=model,
        verdicts=Counter(row.verdict.replace("_", " ") if row.ok else row.status for row in rows).most_common(),
        new=new_effects(rows),
        trends=trends(series),
        changes=changes(rows),
        odd=odd_machines(rows),
        sizes=size_plot(series),
        machines=_machines(rows),
        folded=len(rows) > LONG,
        dated=any(row.date for row in rows),
        failed=[row for row in rows if not row.ok],
        figure=figure,
        chance=chance,
        size=written,
        link=lambda row: f"{reports}/{quote(row.record)}/report.html",
    )


def written(effect: FoundEffect) -> str:
    """Return an effect's size with its interval."""
    unit = behind(effect.unit)
    if effect.low is None or effect.high is None:
        return f"{effect.parameter} {figure(effect.size)}{unit}"
    # a gain of 1.00001 with an interval as narrow needs more digits than three to be told from 1
    digits = next((n for n in range(3, DIGITS) if figure(effect.low, n) != figure(effect.high, n)), DIGITS)
    size, low, high = (figure(value, digits) for value in (effect.size, effect.low, effect.high))
    return f"{effect.parameter} {size} [{low}, {high}]{unit}"


def size_plot(series: Sequence[Series]) -> str:
    """Return size against date with 95 % intervals: a panel an effect, a colour a machine.

    Records without a date stand in the order of their names.
    """
    import matplotlib
    from matplotlib.figure import Figure

    dates: Any = import_module("matplotlib.dates")
    shown = list(series)[:PANELS]
    if not shown:
        return ""
    machines = sorted({row.machine for own in shown for row, _ in own.rows})
    dates_of = [datetime.fromisoformat(row.date) for own in shown for row, _ in own.rows if row.date]
    margin = 0.03 * (max(dates_of) - min(dates_of)) if len(set(dates_of)) > 1 else timedelta(days=1)
    with matplotlib.rc_context(STYLE):
        rows = math.ceil(len(shown) / 2)
        drawing = Figure(figsize=(10.4, 2.7 * rows), layout="constrained")
        grid = drawing.subplots(rows, 2, squeeze=False).ravel()
        for axis, own in zip(grid, shown, strict=False):
            if _draw_sizes(axis, own, machines):
                axis.set_xlim(min(dates_of) - margin, max(dates_of) + margin)  # the same for all, so that they compare
                locator: Any = dates.AutoDateLocator()
                axis.xaxis.set_major_locator(locator)
                axis.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
            else:
                axis.set_xlabel("records, in order", fontsize=8)
        for axis in grid[len(shown) :]:
            axis.set_axis_off()
        return svg_text(drawing)


def _draw_sizes(axis: Any, own: Series, machines: Sequence[str]) -> bool:
    """Draw one effect's sizes with their intervals, a colour a machine; return whether they stand against dates."""
    dated = all(row.date is not None for row, _ in own.rows)
    for number, machine in enumerate(machines):
        points = [
            (datetime.fromisoformat(row.date) if dated and row.date else k, effect)
            for k, (row, effect) in enumerate(own.rows)
            if row.machine == machine and effect.size is not None
        ]
        if not points:
            continue
        colour = LINES[number % len(LINES)]
        ends = [(when, one.low, one.high) for when, one in points if one.low is not None]
        if ends:
            axis.vlines(*zip(*ends, strict=True), color=colour, linewidth=1.0, alpha=0.6)
        whens, sizes = [when for when, _ in points], [effect.size for _, effect in points]
        axis.plot(whens, sizes, "o", color=colour, markersize=3.5, label=machine or None)
    axis.set_ylim(*size_limits([effect for _, effect in own.rows]))
    axis.set_title(own.effect, loc="left", fontsize=9.5, fontweight="bold", color=INK)
    axis.set_ylabel(f"{own.parameter} [{own.unit}]", fontsize=8)
    if any(machines):
        axis.legend(frameon=False, fontsize=8)
    return dated


def size_limits(effects: Sequence[FoundEffect]) -> tuple[float, float]:
    """Return the ends of an axis that shows all sizes, and intervals as far as they tell sizes apart.

    One record that says next to nothing must not press all others into a line: an interval is cut at :data:`CUT` times
    the range of the sizes, or of the median interval where that is wider.
    """
    sizes = [one.size for one in effects if one.size is not None]
    if not sizes:
        return 0.0, 1.0
    known = [(one.low, one.high) for one in effects if one.low is not None and one.high is not None]
    least, most = min(sizes), max(sizes)
    typical = sorted(high - low for low, high in known)[len(known) // 2] if known else 0.0
    room = CUT * max(most - least, typical)
    low = max(min([least, *(low for low, _ in known)]), least - room)
    high = min(max([most, *(high for _, high in known)]), most + room)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _machines(rows: Sequence[FleetRow]) -> list[tuple[str, int, list[tuple[str, int]]]]:
    """Return machine, its records, and each answer with the number of records that have it."""
    found: dict[str, list[FleetRow]] = {}
    for row in rows:
        found.setdefault(row.machine, []).append(row)
    return [(machine, len(own), Counter(map(_answer, own)).most_common()) for machine, own in sorted(found.items())]


def _answer(row: FleetRow) -> str:
    """Return what was found in a record, in a few words."""
    if not row.ok:
        return row.status
    return " + ".join(effect.name for effect in row.effects) or row.verdict.replace("_", " ")
