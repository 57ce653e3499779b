"""Dates and times of day in the cells of a table, as seconds from the first."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Sequence

import numpy as np

from harness.data.times.written_times import ahead_of_utc, minutes_of, plain_time, span_of
from harness.errors import InputError
from harness.signals import FloatArray

_DAY = (
    r"(?:(?P<year>\d{4})(?P<sign>[-/.]?)(?P<month>\d\d)(?P=sign)(?P<day>\d\d)"
    r"|(?P<first>\d{1,2})(?P<between>[./-])(?P<second>\d{1,2})(?P=between)(?P<last>\d{4}|\d\d))"
)
_TIME = (
    r"(?:(?P<hour>\d{1,3}):(?P<minute>[0-5]\d):(?P<whole>[0-5]\d)|(?P<compact>\d{6}))"
    r"(?:[.,](?P<fraction>\d{1,12}))?(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?"
)
_ZONE = r"(?P<zone>Z|UTC|GMT|(?:UTC|GMT)?[+-]\d\d(?::?\d\d)?|[A-Z]{3,5}|\[?[A-Z][A-Za-z]+(?:/[\w+\-]+)+\]?)"
_STAMP = re.compile(rf"(?:{_DAY}(?P<joint>[T ]| +|[,;] *))?{_TIME}\s*{_ZONE}?", re.ASCII)
_DATE = re.compile(rf"{_DAY}(?:[T ]00:00:00(?:\.0+)?)?", re.ASCII)
_TWO_PARTS = re.compile(r"\d{1,2}:[0-5]\d", re.ASCII)
SECONDS = 86400  # Of a day.
HOUR = 3600  # Seconds of an hour: of a day and of an hour a clock may show the rest alone, and begin anew.


def _row(row: int) -> str:
    return f"row {row}"


def clock(
    cells: Sequence[str], notes: list[str] | None = None, where: Callable[[int], str] = _row
) -> FloatArray | None:
    """Return dates and times as seconds from the first; None if they are none.

    Dates are those of ISO 8601 (also with ``/`` or without signs), ``31.12.2024``, ``31-Dec-2024``, and with slashes
    or a year of two digits in the order that all rows allow. Times of day may go without the date; where they fall by
    more than half a day, the next day begins, as does the next hour of minutes and seconds. Dates alone are days; they
    may count weeks or days of the year. Zones go by their offset, abbreviation or place (``Europe/Berlin``).
    Fractions keep all their digits; hours up to 12 may carry AM and PM. Spans of pandas are seconds.

    Raises InputError if most cells are times and one is none, or they can be read in two ways that differ.

    - ``notes``: gets a sentence where days were counted
    - ``where``: gives the place of a row for messages

    Examples
    --------
    >>> clock(["2024-05-01T23:59:59.5Z", "2024-05-02T00:00:00.25Z"]).tolist(), clock(["12:00:01,5"]).tolist()
    ([0.0, 0.75], [0.0])
    >>> clock(["23:59:59.5", "0:00:00.5"]).tolist(), clock(["31.01.2024 11:00:00", "01.02.2024 11:00:00"]).tolist()
    ([0.0, 1.0], [0.0, 86400.0])
    >>> clock(["0.1"]) is None
    True
    """
    found = [_STAMP.fullmatch(cell.strip()) or _STAMP.fullmatch(plain_time(cell)) for cell in cells]
    stamps = [one for one in found if one is not None]
    if not stamps:
        return _other_clock(cells, notes, where)
    if 2 * len(stamps) < len(found):
        return None
    if any((one["compact"] is not None) != (one["joint"] == "T" and one["sign"] == "") for one in stamps):
        return None  # 202405 is a number
    if len(stamps) < len(found):
        row = next(row for row, one in enumerate(found) if one is None)
        raise _refused(f"a time in every row, as in {cells[found.index(stamps[0])]!r}", cells[row], where(row))
    if len({(one["joint"] is None, one["zone"] is None) for one in stamps}) > 1:
        return None  # with and without a zone: nobody can say how far apart they are
    within = [_of_day(one) for one in stamps]
    if None in within:
        return None
    parts = np.array([float(f"0.{one['fraction']}") if one["fraction"] else 0.0 for one in stamps])
    whole = np.array(within, dtype=np.int64)
    if stamps[0]["joint"] is not None:
        days = _days(stamps, where) if whole.max() < SECONDS else None
        if days is None:
            return None
        whole = whole + SECONDS * days
    elif whole.max() < SECONDS:
        whole = _rolled(
            whole, SECONDS, "midnight is passed", "a time of day that falls by half a day is the next day's", notes
        )
    ahead = ahead_of_utc([one["zone"] for one in stamps], whole, dated=stamps[0]["joint"] is not None)
    if ahead is None:
        return None
    whole = whole - ahead
    return np.asarray((whole - whole[0]) + (parts - parts[0]))


def _other_clock(cells: Sequence[str], notes: list[str] | None, where: Callable[[int], str]) -> FloatArray | None:
    """Return spans, minutes with seconds, or dates alone as seconds; None if the cells are none of these.

    Raises InputError if all cells are of two parts such as 12:30, or dates that two orders read differently.
    """
    first = cells[0].strip() if len(cells) else ""
    for read in (span_of, minutes_of) if first else ():
        values = [value for cell in cells if (value := read(cell)) is not None]
        if len(values) == len(cells):
            times = np.array(values)
            if read is minutes_of and times.max() < HOUR:
                said = "minutes that fall by half an hour are those of the next one"
                times = _rolled(times, HOUR, "a full hour is passed", said, notes)
            return np.asarray(times if read is span_of else times - times[0])
    if _TWO_PARTS.fullmatch(first) and all(_TWO_PARTS.fullmatch(cell.strip()) for cell in cells):
        expected = "times with one reading: 12:30 is hours and minutes, or minutes and seconds"
        raise _refused(expected, cells[0], where(0), "write 12:30:00 or 00:12:30")
    if is_date(plain_time(first)) and len(cells) > 1 and all(is_date(plain_time(cell)) for cell in cells):
        dates = [found for cell in cells if (found := _DATE.fullmatch(plain_time(cell))) is not None]
        days = _days(dates, where)
        return None if days is None else np.asarray((days - days[0]) * float(SECONDS))
    return None


def _rolled(times: np.ndarray, period: int, event: str, said: str, notes: list[str] | None) -> np.ndarray:
    """Return times of a clock that begins anew after a period [s]: no clock is set back by half of it."""
    rolled = np.cumsum(np.diff(times, prepend=times[0]) < -(period // 2))
    if rolled[-1] and notes is not None:
        text = f"{event} ({rolled[-1]}x): {said}"
        notes += [] if text in notes else [text]  # a column may be read more than once
    return np.asarray(times + period * rolled)


def is_time_of_day(cell: str) -> bool:
    """Return True for a time without a date, be it hours and minutes alone.

    Examples
    --------
    >>> is_time_of_day("12:00:00.5"), is_time_of_day("12:00"), is_time_of_day("2024-01-01 12:00:00")
    (True, True, False)
    """
    text = plain_time(cell)
    found = _STAMP.fullmatch(text)
    return _TWO_PARTS.fullmatch(text) is not None or (
        found is not None and found["joint"] is None and found["compact"] is None
    )


def is_time(cell: str) -> bool:
    """Return True for a time with or without a date that its signs show, or a span of days with a time.

    Examples
    --------
    >>> is_time("31.12.2024 12:00:00,5"), is_time("12:00:00.5"), is_time("20241231T120000"), is_time("0,5")
    (True, True, False, False)
    """
    return ":" in cell and (_STAMP.fullmatch(plain_time(cell)) is not None or span_of(cell) is not None)


def is_date(cell: str) -> bool:
    """Return True for a date without a time (or at midnight, as workbooks hold dates).

    Examples
    --------
    >>> is_date("31.12.2024"), is_date("2024-12-31 00:00:00"), is_date("12:00:00"), is_date("20241231")
    (True, True, False, False)
    """
    found = _DATE.fullmatch(cell.strip())
    return found is not None and found["sign"] != ""


def with_dates(times: Sequence[str], dates: Sequence[str], where: Callable[[int], str] = _row) -> FloatArray | None:
    """Return times of day with the dates of another column as seconds from the first; None if they are none.

    Examples
    --------
    >>> with_dates(["23:59:59", "00:00:01"], ["2024-01-31", "2024-02-01"]).tolist()
    [0.0, 2.0]
    """
    if not all(map(is_date, dates)) or not all(map(is_time_of_day, times)):
        return None
    days = [re.split("[T ]", day.strip())[0] for day in dates]
    return clock([f"{day} {plain_time(time)}" for day, time in zip(days, times, strict=True)], where=where)


def with_part(times: FloatArray, part: FloatArray, *, turns: bool = False) -> FloatArray | None:
    """Return stamps that stand still with what another column counts between them; None if it does not fit them.

    - ``times`` (N,): stamps [s], such as whole seconds
    - ``part`` (N,): part of the step of these [s], which begins anew with each; or the time from any instant, at the
      same pace
    - ``turns``: True where rows of several signals take turns, which may share a stamp

    Examples
    --------
    >>> with_part(np.array([0.0, 0.0, 1.0]), np.array([0.25, 0.75, 0.25])).tolist()
    [0.0, 0.5, 1.0]
    >>> with_part(np.array([0.0, 0.0, 1.0]), np.array([7.5, 8.0, 8.5])).tolist()
    [0.0, 0.5, 1.0]
    >>> with_part(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0])) is None
    True
    """
    if len(part) != len(times) or not np.isfinite(part).all():
        return None
    steps = np.diff(times)
    step = max(1.0, float(steps[steps > 0].min(initial=np.inf))) if (steps > 0).any() else 1.0
    for whole in (times + part, part):
        within = (whole is part or (0 <= part).all()) and (np.abs(whole - whole[0] - times + times[0]) < step).all()
        steps = np.diff(whole)
        if within and ((steps > 0).all() or (turns and (steps >= 0).all())):
            return np.asarray(whole - whole[0])
    return None


def _of_day(stamp: re.Match[str]) -> int | None:
    """Return the seconds of a time since midnight; None where there is no such time."""
    if stamp["compact"] is not None:
        hour, minute, whole = (int(stamp["compact"][at : at + 2]) for at in (0, 2, 4))
        if minute > 59 or whole > 59:
            return None
    else:
        hour, minute, whole = int(stamp["hour"]), int(stamp["minute"]), int(stamp["whole"])
    if stamp["half"] is not None:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (stamp["half"] in "Pp")
    return hour * 3600 + minute * 60 + whole


def _days(stamps: Sequence[re.Match[str]], where: Callable[[int], str]) -> np.ndarray | None:
    """Return the days of dates, counted from any; None where one is no date.

    Raises InputError if days and months can change places, and the dates are other ones then.
    """
    first = stamps[0]
    if first["year"] is not None:
        orders: tuple[tuple[str, str, str], ...] = (("year", "month", "day"),)
    else:
        orders = (("last", "second", "first"),)
        if first["between"] != ".":  # a date with points has its day first, one with slashes may have its month
            orders = (*orders, ("last", "first", "second"))
        if len(first["last"]) == 2:  # a year of two digits may stand before or behind
            orders = (*orders, ("first", "second", "last"))
    readings: list[np.ndarray] = []
    for order in orders:
        known: dict[tuple[str, ...], int] = {}
        try:
            for one in stamps:
                day = one.group(*order)
                if None not in day and day not in known:
                    year = f"20{day[0]}" if len(day[0]) == 2 else day[0]
                    known[day] = datetime.date(int(year), int(day[1]), int(day[2])).toordinal()
            readings.append(np.array([known[one.group(*order)] for one in stamps], dtype=np.int64))
        except (ValueError, KeyError):  # no such date, or another form of it
            continue
    if not readings:
        return None
    for other in readings[1:]:
        apart = np.flatnonzero(np.diff(readings[0]) != np.diff(other))
        if apart.size:
            row = int(apart[0]) + 1
            raise _refused("dates with one reading (2024-12-31)", stamps[row].string, where(row))
    return readings[0]


def _refused(expected: str, got: str, place: str, remedy: str = "") -> InputError:
    return InputError(
        "a time that cannot be read",
        expected=expected,
        got=repr(got),
        remedy=remedy or "correct or empty the cell, or export times of ISO 8601",
        place=place,
    )
