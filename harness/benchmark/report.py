"""The page of a benchmark: one self-contained HTML file with the table, the plots, the failures and the versions."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.benchmark.row import Row
from harness.benchmark.tables import Summary, best_of, figure

if TYPE_CHECKING:
    from harness.benchmark.running import BenchResult

__all__ = ["render_html"]

TEMPLATE = Path(__file__).with_name("report.html.j2")
INK, MUTED, GRID, ACCENT, WARN = "#1f2933", "#7b8794", "#e4e7eb", "#0b6e99", "#b4540a"
LINES = ("#0b6e99", "#b4540a", "#3f7d20", "#7a3e9d", "#a61e4d", "#52606d")
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


def render_html(result: BenchResult) -> str:
    """Return the page as text; it loads nothing from outside.

    Parameters
    ----------
    result : BenchResult
        What to show.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    lines = result.summary()
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        result=result,
        places=_places(lines),
        best=best_of(lines),
        figure=figure,
        errors=_error_plot(lines, result.rows),
        regrets=_regret_plot(result.rows),
        failures=_failures(lines),
        settings=_settings(result.rows),
        statuses=_statuses(result),
    )


def _places(lines: Sequence[Summary]) -> list[tuple[str, str, list[Summary]]]:
    """Return the summaries grouped by plant and scenario."""
    grouped: dict[tuple[str, str], list[Summary]] = {}
    for line in lines:
        grouped.setdefault((line.plant, line.scenario), []).append(line)
    return [(plant, scenario, own) for (plant, scenario), own in grouped.items()]


def _failures(lines: Sequence[Summary]) -> list[tuple[Summary, str, str, int]]:
    """Return every kind of failure with its reason and count."""
    return [(line, status, reason, count) for line in lines for status, reason, count in line.problems]


def _statuses(result: BenchResult) -> list[tuple[str, int]]:
    """Return how many rows have each status, and how many were not run."""
    counts: dict[str, int] = {}
    for row in result.rows:
        counts[row.status] = counts.get(row.status, 0) + 1
    missing = result.planned - len(result.rows)
    return sorted(counts.items(), key=lambda item: (item[0] != "ok", -item[1])) + (
        [("not run", missing)] if missing else []
    )


def _settings(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return horizon, burn-in, initial state and record lengths of each plant and scenario."""
    seen: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        entry = seen.setdefault(
            (row.plant, row.scenario),
            {
                "plant": row.plant,
                "scenario": row.scenario,
                "outputs": ", ".join(f"{n} [{u}]" for n, u in zip(row.outputs, row.units, strict=True)),
                "samples": row.samples,
                "held_out": row.held_out_samples,
                "horizons": set(),
                "burn_ins": set(),
                "initial": set(),
            },
        )
        if not entry["outputs"] and row.outputs:
            entry["outputs"] = ", ".join(f"{n} [{u}]" for n, u in zip(row.outputs, row.units, strict=True))
            entry["samples"], entry["held_out"] = row.samples, row.held_out_samples
        if row.initial_state:
            entry["horizons"].add("whole record" if row.horizon is None else f"{row.horizon:g} s")
            entry["burn_ins"].add(row.burn_in)
            entry["initial"].add(row.initial_state)
    for entry in seen.values():
        for name in ("horizons", "burn_ins", "initial"):
            entry[name] = ", ".join(map(str, sorted(entry[name], key=lambda v: (str(type(v)), v)))) or "-"
    return list(seen.values())


def _error_plot(lines: Sequence[Summary], rows: Sequence[Row]) -> str:
    """Return the simulation errors: one panel a plant and scenario, one line an identifier, one dot a seed."""
    panels = [
        (plant, scenario, [line for line in own if line.simulation_error is not None])
        for plant, scenario, own in _places(lines)
    ]
    panels = [panel for panel in panels if panel[2]]
    if not panels:
        return ""
    heights = [max(len(panel[2]) for panel in panels[i : i + 2]) for i in range(0, len(panels), 2)]
    medians = [max(line.simulation_error.median, 1e-12) for p in panels for line in p[2] if line.simulation_error]
    # beyond ten times the error of the mean a figure says no more: drawn as an arrow at the edge
    limits = (0.4 * min(medians), min(2.5 * max([1.0, *medians]), 25.0))
    with _figure(len(panels), heights, 0.235) as (drawing, axes):
        best = best_of(lines)
        for axis, (plant, scenario, own) in zip(axes, panels, strict=False):
            for height, line in enumerate(reversed(own)):
                dots = [
                    row.simulation_error
                    for row in rows
                    if (row.plant, row.scenario, row.identifier) == (plant, scenario, line.identifier)
                    and row.status == "ok"
                    and row.simulation_error is not None
                ]
                colour = ACCENT if line in best else MUTED
                for marker, shown in (
                    ("o", [d for d in dots if d <= limits[1]]),
                    (">", [d for d in dots if d > limits[1]]),
                ):
                    places = np.clip(shown, limits[0], 0.93 * limits[1])
                    axis.plot(places, [height] * len(shown), marker, color=colour, alpha=0.55, markersize=4.5, mew=0)
                if line.simulation_error is not None and line.simulation_error.median <= limits[1]:
                    axis.plot(line.simulation_error.median, height, "|", color=INK, markersize=12, mew=1.8)
            axis.set_yticks(range(len(own)), [line.identifier for line in reversed(own)])
            axis.set_ylim(-0.6, len(own) - 0.4)
            axis.set_xscale("log")
            axis.set_xlim(*limits)  # the same for all panels, so that they compare
            axis.axvline(1.0, color=WARN, linewidth=0.8, linestyle=(0, (3, 3)))
            axis.grid(axis="x", color=GRID, linewidth=0.7)
            axis.set_axisbelow(True)
            axis.set_title(f"{plant}  ·  {scenario}", loc="left", fontsize=9.5, fontweight="bold")
            axis.set_xlabel("simulation error (NRMSE)", fontsize=8)
        return _svg(drawing)


def _regret_plot(rows: Sequence[Row]) -> str:
    """Return the cumulative regrets over the stream: one panel a plant and scenario, one line a seed."""
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
            axis.set_xscale("log")
            axis.grid(color=GRID, linewidth=0.7)
            axis.set_title(f"{plant}  ·  {scenario}", loc="left", fontsize=9.5, fontweight="bold")
            axis.set_xlabel("samples seen", fontsize=8)
            axis.set_ylabel("cumulative regret", fontsize=8)
            axis.legend(frameon=False, fontsize=8)
        return _svg(drawing)


class _figure:
    """A grid of panels two to a row, drawn without pyplot (no global state) and with fixed ids in the SVG."""

    def __init__(self, panels: int, heights: Sequence[int], inch: float) -> None:
        self.panels, self.heights, self.inch = panels, list(heights), inch

    def __enter__(self) -> tuple[Any, list[Any]]:
        import matplotlib
        from matplotlib.figure import Figure

        self.context = matplotlib.rc_context(STYLE)
        self.context.__enter__()
        rows = len(self.heights)
        drawing = Figure(figsize=(10.4, sum(h * self.inch + 0.85 for h in self.heights)), layout="constrained")
        engine: Any = drawing.get_layout_engine()
        engine.set(h_pad=0.1, w_pad=0.08)
        grid = drawing.subplots(rows, 2, squeeze=False, gridspec_kw={"height_ratios": self.heights})
        axes = list(grid.ravel())
        for axis in axes[self.panels :]:
            axis.set_axis_off()
        return drawing, axes[: self.panels]

    def __exit__(self, *exc: object) -> None:
        self.context.__exit__(None, None, None)


def _svg(drawing: Any) -> str:
    """Return a drawing as SVG to be put into a page."""
    stream = io.StringIO()
    drawing.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = stream.getvalue()
    return text[text.index("<svg") :]
