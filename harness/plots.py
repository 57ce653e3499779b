"""Plots of what a person looks at: records and scores (matplotlib is loaded when one is asked for)."""

from __future__ import annotations

import base64
import functools
import io
import re
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import printable

_PATH = re.compile(r'(?<= d=")[^"]*')
_LONG = re.compile(r"-?\d+\.\d{3,}(?![\de])")
Table = tuple[npt.NDArray[np.float64], Sequence[str]]


def inlined(figure: Any, label: str) -> str:
    """Return a matplotlib figure as an HTML picture that needs no file; ``label`` says what it shows."""
    buffer = io.StringIO()
    plain_texts(figure).savefig(buffer, format="svg")
    return f"<p>{embedded(buffer.getvalue(), label)}</p>"


def embedded(svg: str, label: str) -> str:
    """Return an SVG text as an HTML picture that needs no file, on white paper, and meets no style of its page.

    Paths keep two decimals, a hundredth of a point: the text is a third shorter.

    Examples
    --------
    >>> embedded("<svg/>", "a < b")[:62]
    '<img alt="a &lt; b" style="max-width:100%;background:#fff" src'
    """
    text = _PATH.sub(
        lambda path: _LONG.sub(lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), path[0]), svg
    )
    if 'xmlns="http://www.w3.org/2000/svg"' not in text:
        text = text.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    content = base64.b64encode(text.encode()).decode()
    picture = f'<img alt="{escape(label)}" style="max-width:100%;background:#fff"'
    return f'{picture} src="data:image/svg+xml;base64,{content}">'


@functools.cache
def _sheets() -> Any:
    """Return the class of figures that show themselves; matplotlib is loaded when the first is made."""
    from matplotlib.figure import Figure

    class Sheet(Figure):
        def _repr_html_(self) -> str:
            return inlined(self, "figure")

    return Sheet


def sheet(**options: Any) -> Any:
    """Return an empty figure of matplotlib that a notebook draws (an inline SVG), without pyplot and its global state.

    Examples
    --------
    >>> sheet(figsize=(2, 1))._repr_html_()[:17]
    '<p><img alt="figu'
    """
    return _sheets()(**options)


def plot_record(t: npt.NDArray[np.float64], inputs: Table, outputs: Table, axes: Any = None) -> Any:
    """Draw inputs as they are held and outputs as they are sampled, each with its unit.

    - ``t`` (N,): [s]
    - ``inputs, outputs`` (array (N, n), sequence of n str): values and labels
    - ``axes``: one for each channel; made if not given
    """
    count = len(inputs[1]) + len(outputs[1])
    if axes is None:
        figure = sheet(figsize=(8, 1.6 * count + 0.6), layout="constrained")
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
