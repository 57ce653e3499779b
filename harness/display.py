"""How results look in a notebook: small tables and drawings, without any other package."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise

import numpy as np
import numpy.typing as npt

__all__ = ["drawing", "page", "table"]

WIDTH, HEIGHT = 520, 70
"""Size of a drawing [px]."""
POINTS = 260
"""Points of a drawn line: two of each column of pixels would not be seen."""


def table(titles: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as HTML; every text is escaped.

    Examples
    --------
    >>> table(["a"], [["<b>"]])
    '<table><thead><tr><th>a</th></tr></thead><tbody><tr><td>&lt;b&gt;</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def drawing(values: npt.NDArray[np.float64], label: str) -> str:
    """Return a line as SVG: extremes of every stretch, so that nothing short is lost.

    Parameters
    ----------
    values : array (N,)
    label : str
        Shown above the line, with the range.
    """
    n = len(values)
    edges = np.linspace(0, n, min(n, POINTS // 2) + 1).astype(int)
    pieces = [values[a:b] for a, b in pairwise(edges) if b > a]
    line = np.array([extreme for piece in pieces for extreme in (piece.min(), piece.max())])
    low, high = float(line.min()), float(line.max())
    x = np.linspace(0.0, WIDTH, len(line))
    y = HEIGHT - 4 - (line - low) / ((high - low) or 1.0) * (HEIGHT - 24)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    said = escape(f"{label}: {low:.4g} to {high:.4g}")
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" style="max-width:{WIDTH}px" role="img" aria-label="{said}">'
        f'<text x="0" y="13" font-size="12" fill="currentColor">{said}</text>'
        f'<polyline points="{points}" fill="none" stroke="#4477aa" stroke-width="1"/></svg>'
    )


def page(title: str, *parts: str) -> str:
    """Return parts under a title."""
    return f"<div><p><b>{escape(title)}</b></p>{''.join(f'<div>{part}</div>' for part in parts)}</div>"
