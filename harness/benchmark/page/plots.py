"""The drawings of a benchmark's page, as SVG to be put into it: errors, ranks, curves along an axis, regret."""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.benchmark.row import Row
from harness.benchmark.statistics import Ranking
from harness.benchmark.summary import Summary, best_possible, places_of
from harness.plots import plain_texts

INK, MUTED, GRID, ACCENT, WARN = "#1f2933", "#7b8794", "#e4e7eb", "#0b6e99", "#b4540a"
LINES = ("#0b6e99", "#b4540a", "#3f7d20", "#7a3e9d", "#a61e4d", "#52606d")
DOTS = 100  # Seeds that are drawn as dots on one line; more are one blot, and a page nobody can open.
FAR = 25.0
"""Beyond so many times the spread of the data an error says no more than that the model is of no use: the edge."""
PANELS = 60  # Panels of a page, for the same reason; the table has all.
STYLE: Any = {
    "svg.hashsalt": "sysid-harness",
    "svg.fonttype": "path",
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def error_plot(lines: Sequence[Summary], rows: Sequence[Row]) -> str:
    """Return the simulation errors: one panel a plant and scenario, one line an identifier, one dot a seed."""
    panels = [
        (plant, scenario, [line for line in own if line.simulation_error is not None])
        for plant, scenario, own in places_of(lines)
    ]
    panels = [panel for panel in panels if panel[2]][:PANELS]
    if not panels:
        return ""
    heights = [max(len(panel[2]) for panel in panels[i : i + 2]) for i in range(0, len(panels), 2)]
    medians = [max(line.simulation_error.median, 1e-12) for p in panels for line in p[2] if line.simulation_error]
    floors = [line.best_possible.median for line in lines if line.best_possible]
    limits = (max(0.4 * min([*medians, *floors]), 1e-6), min(2.5 * max([1.0, *medians]), FAR))
    longest = max(len(line.identifier) for panel in panels for line in panel[2])
    with _figure(len(panels), heights, 0.235, label=longest) as (drawing, axes):
        dots_of: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        for row in rows:
            if row.status == "ok" and row.simulation_error is not None:
                dots_of[row.plant, row.scenario, row.identifier].append(row.simulation_error)
        for axis, (plant, scenario, own) in zip(axes, panels, strict=False):
            _error_panel(axis, own, [dots_of[plant, scenario, line.identifier] for line in own], limits)
            axis.set_title(f"{plant}  ·  {scenario}", loc="left", fontsize=9.5, fontweight="bold")
            axis.set_xlabel("simulation error (NRMSE)", fontsize=8)
        return svg_text(drawing)


def _error_panel(
    axis: Any, own: Sequence[Summary], dots_of: Sequence[Sequence[float]], limits: tuple[float, float]
) -> None:
    """Draw one panel of errors, the first line on top; what is beyond the edge is an arrow at it."""
    for height, (line, dots) in enumerate(zip(reversed(own), reversed(dots_of), strict=True)):
        few = dots[:: max(1, len(dots) // DOTS)]
        colour = ACCENT if line.leading else MUTED
        for marker, shown in (("o", [d for d in few if d <= limits[1]]), (">", [d for d in few if d > limits[1]])):
            places = np.clip(shown, limits[0], 0.93 * limits[1])
            axis.plot(places, [height] * len(shown), marker, color=colour, alpha=0.55, markersize=4.5, mew=0)
        if line.simulation_error is not None and line.simulation_error.median <= limits[1]:
            axis.plot(line.simulation_error.median, height, "|", color=INK, markersize=12, mew=1.8)
    axis.set_yticks(range(len(own)), [line.identifier for line in reversed(own)])
    axis.set_ylim(-0.6, len(own) - 0.4)
    axis.set_xscale("log")
    axis.set_xlim(*limits)  # the same for all panels, so that they compare
    _decades(axis, limits)
    floors = [line.best_possible.median for line in own if line.best_possible]
    if floors:
        axis.axvspan(limits[0], floors[0], color=GRID, alpha=0.6, linewidth=0)
    axis.axvline(1.0, color=WARN, linewidth=0.8, linestyle=(0, (3, 3)))
    axis.grid(axis="x", color=GRID, linewidth=0.7)
    axis.set_axisbelow(True)


def regret_plot(rows: Sequence[Row]) -> str:
    """Return the cumulative regrets over the stream: one panel a plant and scenario, one line a seed.

    What theory says of it is dashed: its rise where theory gives a factor, its shape alone where it does not.
    """
    panels: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.curve_steps:
            panels.setdefault((row.plant, row.scenario), []).append(row)
    if not panels:
        return ""
    with _figure(len(panels), [8] * math.ceil(len(panels) / 2), 0.24) as (drawing, axes):
        for axis, ((plant, scenario), own) in zip(axes, panels.items(), strict=False):
            names = list(dict.fromkeys(row.identifier for row in own))
            for row in own:
                number = names.index(row.identifier)
                first = next(other for other in own if other.identifier == row.identifier) is row
                axis.plot(
                    row.curve_steps,
                    row.curve_regret,
                    color=LINES[number % len(LINES)],
                    linewidth=1.3,
                    alpha=0.8,
                    label=row.identifier if first else None,
                )
                if first and any(value is not None for value in row.curve_theory):
                    law = {"log": "ln n", "root": "the root of n", "linear": "n", "bounded": "bounded"}[row.regret_law]
                    known = "" if row.regret_over_theory is not None else ", its shape"
                    theory = [np.nan if value is None else value for value in row.curve_theory]
                    axis.plot(
                        row.curve_steps,
                        theory,
                        color=LINES[number % len(LINES)],
                        linewidth=1.0,
                        linestyle=(0, (4, 2)),
                        label=f"theory: {law}{known}",
                    )
            axis.set_xscale("log")
            axis.grid(color=GRID, linewidth=0.7)
            axis.set_title(f"{plant}  ·  {scenario}", loc="left", fontsize=9.5, fontweight="bold")
            axis.set_xlabel("samples seen", fontsize=8)
            axis.set_ylabel("cumulative regret", fontsize=8)
            axis.legend(frameon=False, fontsize=8)
        return svg_text(drawing)


def rank_plot(made: Ranking) -> str:
    """Return the average ranks on one line; bars join what the critical difference does not tell apart."""
    import matplotlib
    from matplotlib.figure import Figure

    bars = made.groups()
    with matplotlib.rc_context(STYLE):
        height = 0.9 + 0.16 * len(bars) + 0.2 * ((len(made.names) + 1) // 2)
        drawing = Figure(figsize=(10.4, height), layout="constrained")
        axis: Any = drawing.subplots()
        k = len(made.names)
        axis.plot([1, k], [0, 0], color=INK, linewidth=1.0)
        for tick in range(1, k + 1):
            axis.plot([tick, tick], [0, 0.25], color=INK, linewidth=1.0)
            axis.text(tick, 0.4, str(tick), ha="center", va="bottom", fontsize=8)
        low = -0.6 * len(bars) - 0.5
        for number, (first, last) in enumerate(bars):
            y = -0.45 - 0.6 * number
            axis.plot([made.ranks[first] - 0.03, made.ranks[last] + 0.03], [y, y], color=ACCENT, linewidth=3.0)
        half = (k + 1) // 2
        for i, (name, rank) in enumerate(zip(made.names, made.ranks, strict=True)):
            left = i < half
            y = low - 0.8 * (i + 1 if left else k - i)
            end = 0.7 if left else k + 0.3
            axis.plot([rank, rank, end], [0, y, y], color=MUTED, linewidth=0.8)
            axis.text(
                end, y, f"{name}  {rank:.2f} " if left else f" {rank:.2f}  {name}", fontsize=8.5, va="center",
                ha="right" if left else "left",
            )  # fmt: skip
        axis.plot([1, 1 + made.critical], [1.5, 1.5], color=WARN, linewidth=2.0)
        axis.text(1 + made.critical, 1.5, f"  critical difference {made.critical:.2f}", va="center", fontsize=8)
        margin = 0.12 * k + 1.2
        axis.set_xlim(1 - margin, k + margin)
        axis.set_ylim(low - 0.8 * half - 0.6, 2.0)
        axis.set_axis_off()
        return svg_text(drawing)


def axis_plot(rows: Sequence[Row]) -> str:
    """Return error against the values of an axis: one panel a plant, scenario and axis, one line an identifier."""
    panels: dict[tuple[str, str, str], dict[str, dict[float, list[float]]]] = {}
    floors: dict[tuple[str, str, str], dict[float, list[float]]] = {}
    for row in rows:
        for name, value in zip(row.axes, row.axis_values, strict=True):
            others = [f"{n} {v:g}" for n, v in zip(row.axes, row.axis_values, strict=True) if n != name]
            key = (row.plant.partition(" [")[0], ", ".join([row.scenario.partition(" [")[0], *others]), name)
            if (best := best_possible(row)) is not None:
                floors.setdefault(key, {}).setdefault(value, []).append(best)
            if row.status == "ok" and row.simulation_error is not None:
                series = panels.setdefault(key, {}).setdefault(row.identifier.partition(" [")[0], {})
                series.setdefault(value, []).append(row.simulation_error)
    if not panels:
        return ""
    with _figure(len(panels), [9] * math.ceil(len(panels) / 2), 0.24) as (drawing, axes):
        for axis, (key, lines) in zip(axes, panels.items(), strict=False):
            for number, (name, found) in enumerate(lines.items()):
                at = sorted(found)
                low, median, high = (np.array([np.quantile(found[v], q) for v in at]) for q in (0.25, 0.5, 0.75))
                colour = LINES[number % len(LINES)]
                axis.plot(at, median, "o-", color=colour, markersize=3.5, linewidth=1.3, label=name)
                axis.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
            floor = floors.get(key, {})
            if floor:
                at = sorted(floor)
                axis.plot(at, [np.median(floor[v]) for v in at], "--", color=WARN, linewidth=1.0, label="best possible")
            points = [v for found in lines.values() for v in found]
            axis.set_yscale("log")
            axis.set_ylim(top=min(axis.get_ylim()[1], FAR))
            if min(points) > 0:
                axis.set_xscale("log")
            axis.grid(color=GRID, linewidth=0.7)
            axis.set_title(f"{key[0]}  ·  {key[1]}", loc="left", fontsize=9.5, fontweight="bold")
            axis.set_xlabel(key[2], fontsize=8)
            axis.set_ylabel("simulation error (NRMSE)", fontsize=8)
            axis.legend(frameon=False, fontsize=8)
        return svg_text(drawing)


def _decades(axis: Any, limits: tuple[float, float]) -> None:
    """Label the powers of ten in plain text: typeset ones, and ticks between them, take most of the time of a page."""
    first, last = math.ceil(math.log10(limits[0])), math.floor(math.log10(limits[1]))
    axis.set_xticks([10.0**k for k in range(first, last + 1)], [f"{10.0**k:g}" for k in range(first, last + 1)])
    axis.minorticks_off()


class _figure:
    """A grid of panels two to a row, drawn without pyplot (no global state) and with fixed ids in the SVG.

    Margins follow from the longest label: asking matplotlib for the size of every text draws the page twice.
    """

    def __init__(self, panels: int, heights: Sequence[int], inch: float, *, label: int = 6) -> None:
        self.panels, self.heights, self.inch, self.label = panels, list(heights), inch, label

    def __enter__(self) -> tuple[Any, list[Any]]:
        import matplotlib
        from matplotlib.figure import Figure

        self.context = matplotlib.rc_context(STYLE)
        self.context.__enter__()
        rows = len(self.heights)
        width, side, above, between, below = 10.4, 0.35 + 0.07 * self.label, 0.35, 0.85, 0.5  # inches
        own = [self.inch * height for height in self.heights]
        height = sum(own) + above + (rows - 1) * between + below
        panel = (width - 2 * side - 0.3) / 2
        drawing = Figure(figsize=(width, height))
        grid = drawing.subplots(
            rows,
            2,
            squeeze=False,
            gridspec_kw={
                "height_ratios": self.heights,
                "left": side / width,
                "right": 1 - 0.1 / width,
                "top": 1 - above / height,
                "bottom": below / height,
                "wspace": (side + 0.2) / panel,
                "hspace": between * rows / sum(own),
            },
        )
        axes = list(grid.ravel())
        for axis in axes[self.panels :]:
            axis.set_axis_off()
        return drawing, axes[: self.panels]

    def __exit__(self, *exc: object) -> None:
        self.context.__exit__(None, None, None)


def svg_text(drawing: Any) -> str:
    """Return a drawing as SVG to be put into a page."""
    stream = io.StringIO()
    plain_texts(drawing).savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = stream.getvalue()
    return text[text.index("<svg") :]
