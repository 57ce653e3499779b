"""Cells of tables as people write them: numbers, nothing, times, and a row of units below the header."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence

import numpy as np

from harness.data.tables.headers import split_header
from harness.signals import FloatArray
from harness.units import is_unit

__all__ = ["EMPTY", "clock", "is_number", "seconds_of", "units_below"]

EMPTY = {"", "na", "n/a", "nan", "null", "none", "-nan", "#n/a"}
"""What stands where nothing was recorded, in small letters."""

_STAMP = re.compile(r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d\d:\d\d:\d\d)(?:[.,](\d{1,12}))?(Z|[+-]\d\d(?::?\d\d)?)?")


def is_number(text: str) -> bool:
    """Return True if a cell holds a number (the word nan in a header is a title, not a number).

    Examples
    --------
    >>> is_number("1e3"), is_number("nan"), is_number("theta")
    (True, False, False)
    """
    try:
        float(text)
    except ValueError:
        return False
    return not text.strip().lower().lstrip("+-").startswith(("nan", "inf"))


def units_below(titles: Sequence[str], cells: Sequence[str]) -> list[str] | None:
    """Return the titles with the units of the row below them; None if that row is no row of units.

    Examples
    --------
    >>> units_below(["t", "u", "theta"], ["s", "[Nm]", "°"]), units_below(["t", "u"], ["0.0", "1.0"])
    (['t [s]', 'u [Nm]', 'theta [°]'], None)
    """
    bare = [cell.strip().strip("[]()").strip() for cell in cells]
    if len(bare) != len(titles) or not any(bare) or any(is_number(cell) and cell != "1" for cell in bare):
        return None
    if not any(cell and cell != "1" for cell in bare) or not all(is_unit(cell) for cell in bare if cell):
        return None
    return [
        f"{title} [{cell}]" if cell and split_header(title)[1] is None else title
        for title, cell in zip(titles, bare, strict=True)
    ]


def clock(cells: Sequence[str]) -> FloatArray | None:
    """Return times of ISO 8601 as seconds from the first; None if a cell is none.

    Times of a day may go without the date. Fractions keep all their digits.

    Examples
    --------
    >>> clock(["2024-05-01T23:59:59.5Z", "2024-05-02T00:00:00.25Z"]).tolist(), clock(["12:00:01,5"]).tolist()
    ([0.0, 0.75], [0.0])
    >>> clock(["0.1"]) is None
    True
    """
    found = [_STAMP.fullmatch(cell.strip()) for cell in cells]
    if not found or not all(found):
        return None
    whole, parts, zones = [], [], set()
    for match in found:
        assert match is not None
        day, time, digits, zone = match.groups()
        zones.add((day is None, zone is None))
        try:
            at = datetime.datetime.fromisoformat(f"{day or '1970-01-01'}T{time}{zone or ''}")
        except ValueError:
            return None
        whole.append(at)
        parts.append(float(f"0.{digits}") if digits else 0.0)
    if len(zones) > 1:  # with and without a zone: nobody can say how far apart they are
        return None
    seconds = np.array([(at - whole[0]).total_seconds() for at in whole])
    return np.asarray(seconds + (np.array(parts) - parts[0]))


def seconds_of(stamps: np.ndarray) -> FloatArray:
    """Return time stamps or spans of numpy as seconds: stamps from the first, spans as they are; missing ones are NaN.

    Examples
    --------
    >>> seconds_of(np.array(["2024-01-01T00:00:00", "2024-01-01T00:00:00.5"], dtype="datetime64[ns]")).tolist()
    [0.0, 0.5]
    """
    if stamps.dtype.kind == "M" and len(stamps):
        stamps = stamps - stamps[0]
    return np.where(np.isnat(stamps), np.nan, stamps / np.timedelta64(1, "ns") * 1e-9)
