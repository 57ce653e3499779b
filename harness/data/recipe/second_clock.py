"""A second column of times beside the one that counts: where both tell the time, they run at one pace."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from harness.data.tables.headers import says_time
from harness.data.tables.table import Table
from harness.errors import InputError
from harness.signals import FloatArray

ROWS = 2000
"""Rows in which two clocks are compared: what runs at another pace shows it there, and reading texts takes time."""
APART = 0.02
"""Part by which the spans of two clocks may differ: cheap quartz and a program's own sleep stay within a few per
mille."""
COARSE = 2.0  # Steps of the coarser clock by which its span may be off: one at either end.


def refuse_other_pace(
    table: Table, column: str | int, time: FloatArray, *, stated: bool, used: Collection[str | int | None]
) -> None:
    """Refuse a time column that nobody chose where another one, or dates beside it, run at another pace.

    SCADA systems write ``Time_ms`` that counts millionths of a day, and exports carry clocks that were left behind by
    a change of rate: the title alone would be wrong without a word.

    Raises InputError with both spans.

    - ``column``: the column that was taken for the clock
    - ``time`` (N,): its stamps [s]
    - ``stated``: True if its unit was stated: else a column without a unit is compared as seconds too
    - ``used``: titles that are signals
    """
    own = table.find(column)
    for title in table.titles:
        if title in ("", own) or title in used or not says_time(title):
            continue
        other = table.second_clock(title, len(time), ROWS, seconds=not stated)
        if other is None:
            continue
        first = time[: len(other)]
        steps = [np.diff(clock) for clock in (first, other)]
        if any(not np.isfinite(step).all() or (step < 0).any() or not (step > 0).any() for step in steps):
            continue  # a clock that stands, runs back or has holes tells no pace
        spans = [float(step.sum()) for step in steps]
        coarse = COARSE * max(float(np.median(step[step > 0])) for step in steps)
        if abs(spans[0] - spans[1]) > coarse + APART * max(spans):
            raise InputError(
                f"two clocks that disagree: {own!r} and {title!r}",
                expected="one pace",
                got=f"{spans[0]:.6g} s and {spans[1]:.6g} s from the first row to row {len(other)}",
                remedy="say which is right and what it counts ([time] column and unit in a dataset.toml; "
                f"sysid: --column time={title!r}, --unit time=...), or remove the other",
                place="time",
            )
