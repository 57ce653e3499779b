"""What the page shows of a log: its channels, and as many points of their lines as a screen has pixels."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.data.tables.table import Table

KEPT = 3
"""Logs that stay in memory."""
POINTS = 4000
"""Most columns of pixels that a plot has."""


def extremes(values: FloatArray, columns: int) -> npt.NDArray[np.intp]:
    """Return rows that draw a line of a million samples as one of all samples: extremes of each column of pixels.

    Parameters
    ----------
    values : array (N,)
        NaN where there is no number.
    columns : int
        Pixels across.

    Returns
    -------
    array of int
        Rows in order: first, smallest, largest and last of each stretch; all of them where there are few. A stretch
        with a hole keeps a row of it, so that the line breaks there.

    Examples
    --------
    >>> y = np.zeros(1000); y[517] = 9.0; y[800:830] = np.nan
    >>> rows = extremes(y, 20)
    >>> bool(517 in rows), bool(np.isnan(y[rows]).any()), len(rows) <= 100
    (True, True, True)
    """
    n = len(values)
    if n <= 4 * columns:
        return np.arange(n)
    edges = np.linspace(0, n, columns + 1).astype(np.intp)
    length = int(np.diff(edges).max())
    # a stretch shorter than the longest repeats its last row
    rows = np.minimum(edges[:-1, None] + np.arange(length), edges[1:, None] - 1)
    block = values[rows]
    hole = np.isnan(block)
    first = np.arange(columns)
    low = rows[first, np.argmin(np.where(hole, np.inf, block), axis=1)]
    high = rows[first, np.argmax(np.where(hole, -np.inf, block), axis=1)]
    holes = rows[first, np.argmax(hole, axis=1)][hole.any(axis=1)]
    return np.unique(np.concatenate((edges[:-1], low, high, edges[1:] - 1, holes)))


@dataclass
class _Log:
    """A log in memory: its table, and what was read of it."""

    table: Table
    content: dict[str, Any] | None = None
    columns: dict[str, FloatArray] = field(default_factory=dict)
    clocks: dict[tuple[str, str], FloatArray] = field(default_factory=dict)


class Logs:
    """The logs of a session, read once; safe to ask from several threads."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[Path, int, int], _Log] = OrderedDict()
        self._lock = Lock()

    def prepare(self) -> None:
        """Load what reads logs and their units."""
        from harness.data.tables.table import Table  # noqa: F401
        from harness.units import is_unit

        with self._lock:
            is_unit("m")

    def describe(self, path: Path) -> dict[str, Any]:
        """Return what ``sysid list FILE`` knows of a log, and the name of each column without its unit.

        Raises
        ------
        InputError
            If it cannot be read.
        """
        from harness.data.recipe.contents import contents_of

        with self._lock:
            log = self._open(path)
            if log.content is None:
                found = contents_of(path, tables={path: log.table})
                log.content = {**found.to_dict(), "facts": found.facts(), "titles": list(log.table.titles)}
            return log.content

    def lines(
        self,
        path: Path,
        titles: list[str],
        *,
        clock: str = "",
        unit: str = "",
        step: float | None = None,
        span: tuple[float, float] | None = None,
        pixels: int = 800,
    ) -> list[dict[str, Any]]:
        """Return a line for each column, thinned to what can be seen.

        Parameters
        ----------
        path : Path
        titles : list of str
            Columns.
        clock : str
            Time column; empty where there is none: then the rows count, or ``step`` [s].
        unit : str
            Of the clock, where its title states none.
        span : (float, float), optional
            Part of the time axis that is shown.
        pixels : int
            Columns of pixels.

        Returns
        -------
        list of dict
            ``title``, ``t``, ``y`` (None where there is no number), ``rows`` (samples in the span), ``shown``.

        Raises
        ------
        InputError
            If a column is not there or holds no numbers.
        """
        with self._lock:
            log = self._open(path)
            return [self._line(log, title, clock, unit, step, span, min(max(pixels, 50), POINTS)) for title in titles]

    def _line(
        self,
        log: _Log,
        title: str,
        clock: str,
        unit: str,
        step: float | None,
        span: tuple[float, float] | None,
        pixels: int,
    ) -> dict[str, Any]:
        if title not in log.columns:
            log.columns[title] = log.table.read(title)[0]
        y = log.columns[title]
        t = self._clock(log, title, clock, unit, step, len(y))
        if len(t) != len(y):
            raise InputError(
                f"the time column {clock!r}",
                expected=f"{len(y)} rows, as {title!r} has",
                got=str(len(t)),
                remedy="choose another time column",
            )
        if span is not None:
            later, sooner = np.flatnonzero(t >= span[0]), np.flatnonzero(t <= span[1])
            low, high = int(later[0]) if later.size else len(y), int(sooner[-1]) + 1 if sooner.size else 0
            low, high = max(low - 1, 0), min(high + 1, len(y))  # the line goes on beyond the edge
            t, y = t[low:high], y[low:high]
        rows = extremes(y, pixels)
        return {"title": title, "t": _plain(t[rows]), "y": _plain(y[rows]), "rows": len(y), "shown": len(rows)}

    def _clock(self, log: _Log, title: str, clock: str, unit: str, step: float | None, n: int) -> FloatArray:
        """Return the time of a column's rows [s]; the rows where nothing says their time."""
        own = log.table.clocks([title])
        if own is not None:
            return own[0][0]
        if not clock:
            return np.arange(n, dtype=np.float64) * (step or 1.0)
        if (clock, unit) not in log.clocks:
            log.clocks[clock, unit] = log.table.read_time(clock, unit or None)[0]
        return log.clocks[clock, unit]

    def _open(self, path: Path) -> _Log:
        """Return a log, read again if the file is another than before."""
        from harness.data.tables.table import Table

        now = path.stat()
        key = (path, now.st_mtime_ns, now.st_size)
        if key not in self._kept:
            self._kept[key] = _Log(Table(path))
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]


def _plain(values: FloatArray) -> list[float | None]:
    """Return numbers as JSON can hold them, with as many digits as a pixel needs."""
    return [float(f"{value:.9g}") if np.isfinite(value) else None for value in values.tolist()]
