"""The overlay of a cell: its first held-out record, measured and simulated, and the residual below; one SVG each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.benchmark.page.plots import ACCENT, GRID, INK, MUTED, STYLE, WARN
from harness.benchmark.row import Row
from harness.benchmark.summary import figure
from harness.data.whole_files import whole_file
from harness.plots import plain_texts

OUTPUTS = 4  # Outputs that are drawn; the table ``traces`` has all.
AWAY = 4.0
"""A free run that leaves the measured range by so many times its width is cut off there, or the record would be a
line."""


def draw_overlays(rows: Sequence[Row], folder: Path) -> dict[str, str]:
    """Draw what has not been drawn yet; return the path of each job's picture relative to the page.

    A picture is named by its job, and a job by all that decides its result: one that is there is the right one.
    """
    traced = [row for row in rows if row.trace_t]
    missing = [row for row in traced if not (folder / f"{row.job}.svg").exists()]
    if missing:
        folder.mkdir(exist_ok=True)
        _draw(missing, folder)
    return {row.job: f"{folder.name}/{row.job}.svg" for row in traced}


def _draw(rows: Sequence[Row], folder: Path) -> None:
    """Draw rows; those with as many outputs share a figure, because laying out axes is what takes the time."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE | {"svg.fonttype": "none"}):
        for count in sorted({min(len(row.trace_measured), OUTPUTS) for row in rows}):
            drawing = Figure(figsize=(10.4, 0.6 + 2.9 * count))
            drawing.subplots_adjust(left=0.09, right=0.985, top=1 - 0.42 / (0.6 + 2.9 * count), bottom=0.12 / count)
            grid = drawing.subplots(2 * count, 1, squeeze=False, sharex=True, height_ratios=[2, 1] * count)
            axes = list(grid[:, 0])
            for row in rows:
                if min(len(row.trace_measured), OUTPUTS) == count:
                    _fill(drawing, axes, row)
                    with whole_file(folder / f"{row.job}.svg") as scratch:
                        plain_texts(drawing).savefig(scratch, format="svg", metadata={"Date": None, "Creator": None})


def _fill(drawing: Any, axes: Sequence[Any], row: Row) -> None:
    """Draw one row into the axes."""
    t = np.array(row.trace_t)
    error = f", simulation error {figure(row.simulation_error)}" if row.simulation_error is not None else ""
    how = "whole record" if row.horizon is None else f"windows of {row.horizon:g} s"
    head = f"{row.plant}  ·  {row.scenario}  ·  {row.identifier}"
    drawing.suptitle(f"{head}  ·  seed {row.seed}{error}; {how}", x=0.09, ha="left", fontsize=10, color=INK)
    for k in range(len(axes) // 2):
        above, below = axes[2 * k], axes[2 * k + 1]
        for axis in (above, below):
            axis.clear()
            axis.grid(color=GRID, linewidth=0.7)
        measured = np.array(row.trace_measured[k])
        residual = np.array([np.nan if value is None else value for value in row.trace_residual[k]])
        above.plot(t, measured, color=MUTED, linewidth=1.6, label="measured")
        above.plot(t, measured - residual, color=ACCENT, linewidth=0.9, label="simulated")
        below.plot(t, residual, color=WARN, linewidth=0.8)
        low, high = float(measured.min()), float(measured.max())
        width = (high - low) or 1.0
        for axis, first, last in ((above, low, high), (below, -width, width)):
            bottom, top = axis.get_ylim()
            axis.set_ylim(max(bottom, first - AWAY * width), min(top, last + AWAY * width))
        above.set_ylabel(f"{row.outputs[k]} [{row.units[k]}]", fontsize=8)
        below.set_ylabel("residual", fontsize=8)
        above.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0)
    axes[-1].set_xlabel("t [s]", fontsize=8)
