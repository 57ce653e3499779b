"""Panels of a figure have room for what stands around them, whatever the numbers on their axes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from harness.diagnosis.report.figures import drawing, legend


@pytest.mark.parametrize("height", [2.9, 5.8])
@pytest.mark.parametrize(
    ("scale", "level"),
    [(1.0, 0.0), (3e-7, 0.0), (0.004, -0.002), (123456.0, 0.0), (2e9, 0.0), (0.02, 1000.0), (0.0, 0.0)],
)
def test_nothing_is_cut_off_and_panels_do_not_overlap(scale: float, level: float, height: float) -> None:
    t = np.linspace(0.0, 20.0, 200)
    with drawing("test", 10.5, height, "A test.") as (figure, svg):
        rows = round(height / 2.9)
        axes = figure.subplots(rows, 3, squeeze=False, width_ratios=(1.6, 1.0, 1.0))
        axes[0, 2].remove()
        for axis in figure.axes:
            axis.plot(t, level - scale * np.sin(t), label="before")
            axis.set(title="measured", xlabel="time [s]", ylabel="error [rad]")
        legend(figure)
    assert len(svg) == 1
    whole = figure.bbox
    boxes = [box for axis in figure.axes if (box := axis.get_tightbbox()) is not None]
    boxes += [key.get_window_extent() for key in figure.legends]
    assert len(boxes) == 3 * rows
    for box in boxes:
        assert min(box.x0, box.y0, whole.x1 - box.x1, whole.y1 - box.y1) >= -1.0, box
    for one, other in combinations(boxes, 2):
        across = min(one.x1, other.x1) - max(one.x0, other.x0)
        along = min(one.y1, other.y1) - max(one.y0, other.y0)
        assert min(across, along) <= 1.0, (one, other)
    for axis in figure.axes:
        assert axis.get_window_extent().width > 0.15 * whole.width
