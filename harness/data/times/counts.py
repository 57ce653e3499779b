"""Clocks that are written as whole numbers: counters that begin anew, and dates and times without any sign."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from harness.signals import FloatArray

BITS = (16, 24, 32)  # Widths of the counters of microcontrollers and field buses.
NARROW = (8, 10, 12, 14, 20, 31)
"""Further widths: 0 after 255 passes for a second record of 256 rows, so these must go on elsewhere than at 0."""
HALF_DAY = 43200.0  # Seconds after which a clock of twelve hours begins anew where nothing says AM or PM.
FINER = (1e-3, 1e-6)  # What a program divides the count of 32 bits by to have it in milliseconds or seconds.
WITHIN = 0.5  # Part of a step within which the step over the end of a counter is as long as the others.

DIGITS = (1.9e7, 2.1e20)
"""Between these lie numbers such as 20241231, 202412312359 and 20241231235959, with digits of a fraction behind them.
A counter that runs does not stay among the days, hours and minutes that there are."""
_DAY = r"(?P<day>(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01]))"
_PART = r"(?:[.,]?(?P<part>\d{3}|\d{6})|[.,](?P<rest>\d+))"
_TIME = rf"(?P<hour>[01]\d|2[0-3])(?:(?P<minute>[0-5]\d)(?:(?P<second>[0-5]\d){_PART}?)?)?"
_DIGITS = re.compile(rf"{_DAY}(?:{_TIME})?", re.ASCII)


def unwrapped(counts: FloatArray, *, of_day: bool = False) -> tuple[FloatArray, float, int]:
    """Return the stamps of a counter that began anew where it was full, as if it had gone on; its period and how often.

    What falls by the period of a counter, but for the usual step, is one: a second record would begin where the first
    began.

    - ``counts`` (N,): in the unit of the counter
    - ``of_day``: True for times of day in seconds, whose clock may have twelve hours

    - returns ``counts`` (N,): as they came where any fall has another reason
    - returns ``period``: 0 where nothing was done
    - returns ``times``

    Examples
    --------
    >>> stamps, period, times = unwrapped(np.array([65500.0, 65520.0, 4.0, 24.0]))
    >>> stamps.tolist(), period, times
    ([65500.0, 65520.0, 65540.0, 65560.0], 65536.0, 1)
    >>> unwrapped(np.array([0.0, 10.0, 20.0, 0.0, 10.0]))[2]
    0
    >>> unwrapped(np.array([0.0, 0.5, -43199.0]), of_day=True)[0].tolist(), unwrapped(np.array([245.0, 255.0, 9.0]))[1]
    ([0.0, 0.5, 1.0], 256.0)
    """
    steps = np.diff(counts)
    falls = np.flatnonzero(steps < 0)
    if not falls.size or not np.isfinite(counts).all() or not (steps > 0).any():
        return counts, 0.0, 0
    typical = float(np.median(steps[steps > 0]))
    whole = bool((counts == np.round(counts)).all())
    periods = [2.0**bits for bits in BITS if whole or bits == max(BITS)]
    periods += [2.0 ** max(BITS) * part for part in FINER if not whole]
    landed = counts[falls + 1]
    carried = len(set(landed)) > 1 or landed[0] not in (0, counts[0])
    periods += [2.0**bits for bits in NARROW if whole and carried]
    periods = [HALF_DAY] if of_day else periods
    for period in periods:
        over = np.abs(steps[falls] + period - typical)
        anew = (counts[falls + 1] == counts[0]).any() or np.ptp(counts) >= period
        if (over <= WITHIN * typical).all() and not anew:
            return counts + period * np.concatenate(([0], np.cumsum(steps < 0))), period, int(falls.size)
    return counts, 0.0, 0


def dated(cells: Sequence[str]) -> list[str] | None:
    """Return stamps such as ``20241231235959.5``, ``202412312359`` or ``20241231`` as ISO 8601; None if one is none.

    Examples
    --------
    >>> dated(["20241231235959.5", "20250101000000"]), dated(["20241231235959500"]), dated(["1709640000000"])
    (['20241231T235959.5', '20250101T000000'], ['20241231T235959.500'], None)
    >>> dated(["202412312359", "202501010000"]), dated(["2024123123", "2025010100"])
    (['20241231T235900', '20250101T000000'], ['20241231T230000', '20250101T000000'])
    """
    found = [_DIGITS.fullmatch(cell.strip()) for cell in cells]
    if not found or None in found:
        return None
    parts = [one["part"] or one["rest"] for one in found if one is not None]
    return [
        f"{one['day']}T{one['hour'] or '00'}{one['minute'] or '00'}{one['second'] or '00'}"
        + (f".{part}" if part else "")
        for one, part in zip(found, parts, strict=True)
        if one is not None
    ]
