"""How results look in a notebook: small tables and drawings, without any other package."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise

import numpy as np
import numpy.typing as npt

STYLE = (
    "body{font:15px/1.45 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "td,th{padding:.2em .7em;text-align:left}img{max-width:100%;background:#fff}div,p{overflow-x:auto}"
    "@media(max-width:600px){body{margin:1em auto}h1{font-size:22px}td,th{padding:.2em .35em;font-size:13px}"
    "img{max-width:none;width:620px}}"
    "@media screen and (prefers-color-scheme:dark){body{background:#12181f;color:#e4e9ef}a{color:#58a6e0}}"
    "@media print{body{max-width:none;margin:0}tr,img{break-inside:avoid}}"
)
"""Style of a page of one table and some pictures: wide, narrow, dark and printed."""

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


def drawing(values: npt.NDArray[np.float64], label: str, marked: npt.NDArray[np.intp] | None = None) -> str:
    """Return a line as SVG: extremes of every stretch, so that nothing short is lost.

    - ``values`` (N,)
    - ``label``: shown above the line, with the range
    - ``marked`` array of int: samples that are marked on the line
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
    dots = ""
    for row in () if marked is None else marked[:: -(-len(marked) // POINTS)]:
        at = HEIGHT - 4 - (values[row] - low) / ((high - low) or 1.0) * (HEIGHT - 24)
        dots += f'<circle cx="{WIDTH * row / max(n - 1, 1):.1f}" cy="{at:.1f}" r="2.5" fill="#cc3311"/>'
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" style="max-width:{WIDTH}px" role="img" aria-label="{said}">'
        f'<text x="0" y="13" font-size="12" fill="currentColor">{said}</text>'
        f'<polyline points="{points}" fill="none" stroke="#4477aa" stroke-width="1"/>{dots}</svg>'
    )


def page(title: str, *parts: str) -> str:
    """Return parts under a title."""
    return f"<div><p><b>{escape(title)}</b></p>{''.join(f'<div>{part}</div>' for part in parts)}</div>"
