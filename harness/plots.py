"""Plots of what a person looks at: records and scores (matplotlib is loaded when one is asked for)."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import printable

__all__ = ["inlined", "plain_texts", "plot_record"]

Table = tuple[npt.NDArray[np.float64], Sequence[str]]


def inlined(figure: Any, label: str) -> str:
    """Return a matplotlib figure as an HTML picture that needs no file; ``label`` says what it shows."""
    buffer = io.BytesIO()
    plain_texts(figure).savefig(buffer, format="svg")
    content = base64.b64encode(buffer.getvalue()).decode()
    return f'<p><img alt="{escape(label)}" src="data:image/svg+xml;base64,{content}"></p>'


def plot_record(t: npt.NDArray[np.float64], inputs: Table, outputs: Table, axes: Any = None) -> Any:
    """Draw inputs as they are held and outputs as they are sampled, each with its unit.

    Parameters
    ----------
    t : array (N,)
        [s].
    inputs, outputs : (array (N, n), sequence of n str)
        Values and labels.
    axes : sequence of matplotlib axes, optional
        One for each channel; made if not given.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib.figure import Figure

    count = len(inputs[1]) + len(outputs[1])
    if axes is None:
        figure = Figure(figsize=(8, 1.6 * count + 0.6), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for axis, values, label in zip(axes, inputs[0].T, inputs[1], strict=False):
        axis.step(t, values, where="post", color="#888888", linewidth=0.8)
        axis.set_ylabel(label)
    for axis, values, label in zip(axes[len(inputs[1]) :], outputs[0].T, outputs[1], strict=False):
        axis.plot(t, values, color="#4477aa", linewidth=0.8)
        axis.set_ylabel(label)
    axes[count - 1].set_xlabel("time [s]")
    return plain_texts(axes[0].figure)


def plain_texts(figure: Any) -> Any:
    """Return a figure whose texts are shown as they are: a name of others is no formula and no order to a reader.

    Ticks of numbers keep matplotlib's own formulas (powers of ten).
    """
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    numbers: set[int] = set()
    for axis in (one for axes in figure.axes for one in (axes.xaxis, axes.yaxis)):
        shown = axis.get_major_formatter()
        if isinstance(shown, FixedFormatter | FuncFormatter):
            axis.set_major_formatter(FuncFormatter(lambda value, place, own=shown: printable(str(own(value, place)))))
        else:
            numbers.update(map(id, axis.get_ticklabels()))
        numbers.update(map(id, axis.get_ticklabels(minor=True)))
    for text in figure.findobj(Text):
        if id(text) not in numbers:
            text.set_parse_math(False)
            text.set_text(printable(text.get_text()))
    return figure
