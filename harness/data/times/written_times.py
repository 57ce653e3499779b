"""Dates and times as programs and languages write them, brought into the forms that stamps are read in."""

from __future__ import annotations

import datetime
import re
import zoneinfo
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

MONTHS = {
    word: number
    for number, words in enumerate(
        (
            "jan january januar jänner janvier janv enero ene gennaio gen januari января янв",
            "feb february februar février févr fév febrero febbraio februari февраля фев",
            "mar march märz mär mrz mars marzo maart mrt марта мар",
            "apr april avril avr abril abr aprile апреля апр",
            "may mai mayo maggio mag mei maj мая май",
            "jun june juni juin junio giugno giu июня июн",
            "jul july juli juillet juil julio luglio lug июля июл",
            "aug august août aou agosto ago augustus augusti августа авг",
            "sep sept september septembre septiembre settembre set сентября сен",
            "oct october oktober okt octobre octubre ottobre ott октября окт",
            "nov november novembre noviembre novembro ноября ноя",
            "dec december dezember dez décembre déc diciembre dic dicembre декабря дек",
        ),
        start=1,
    )
    for word in words.split()
}
"""The number of a month by its name in some languages, in small letters and without a point."""

_MORNING = ("上午", "午前", "오전")
_AFTERNOON = ("下午", "午後", "오후")
_TIME = r"\d{1,2}:[0-5]\d"
_WORD = r"[^\W\d_]+"
_DAY_NAME = re.compile(rf"{_WORD}\.?,?\s+(?=.*\d{{4}})")
_NAMED = re.compile(rf"(?P<day>\d{{1,2}})\.?(?P<sign>[-/. ]) ?(?P<month>{_WORD})\.?[-/., ]\s*(?P<year>\d{{4}})(?!\d)")
_NAME_FIRST = re.compile(rf"(?P<month>{_WORD})\.?\s+(?P<day>\d{{1,2}})(?:st|nd|rd|th)?,?\s+(?P<year>\d{{4}})(?![\d:])")
_YEAR_LAST = re.compile(
    rf"(?P<month>{_WORD})\s+(?P<day>\d{{1,2}})\s+(?P<time>{_TIME}:\d\d(?:[.,]\d+)?)"
    r"(?P<zone> [A-Z]{3,5}(?:[+-]\d\d:\d\d)?)?\s+(?P<year>\d{4})"
)
_UNPADDED = re.compile(r"(?P<year>\d{4})(?P<sign>[-/.])(?P<month>\d{1,2})(?P=sign)(?P<day>\d{1,2})(?!\d)")
_FOURTH = re.compile(rf"(?P<whole>{_TIME}:[0-5]\d)[:;](?P<part>\d{{3}}|\d{{6}}|\d{{9}})(?!\d)")
_TWICE = re.compile(r"(?<=:\d\d\.\d{3}),(?=\d{3}\b)")  # What Zephyr writes between milli- and microseconds.
_HOUR_MINUTE = re.compile(
    rf"(?P<date>.*\d(?:[T ]|, ?))(?P<time>{_TIME})(?P<rest>\s*(?:[AaPp]\.?[Mm]\.?)?\s*(?:Z|[+-]\d\d(?::?\d\d)?)?)"
)
_YEARLESS = re.compile(
    rf"(?:(?P<month>{_WORD})\.?\s+(?P<day>\d{{1,2}}),?|(?P<first>\d{{1,2}})(?P<sign>[./-])(?P<second>\d{{1,2}})\.?)"
    rf"\s+(?P<time>{_TIME}:\d\d(?:[.,]\d+)?)"
)
PLAIN_YEAR = 2001
"""Stands where a log names none, as system logs do. It has no 29 February: one is refused, not counted a day short."""
_PLACE = re.compile(r"(?P<ahead>Z|[+-]\d\d:?\d\d)\[[A-Za-z_+\-/\d]+\]$")
_WEEK = re.compile(r"(?<!\d)(?P<year>\d{4})(?P<sign>-?)W(?P<week>\d\d)(?P=sign)(?P<day>[1-7])(?=[T ]|$)")
_DAY_OF_YEAR = re.compile(
    r"(?<!\d)(?P<year>\d{4})(?:(?P<sign>[-:])(?P<day>\d{3})(?:(?=[T ])|(?<=:\d{3}):)|(?P<bare>\d{3})(?=T\d{6}))"
)
_SMALL = re.compile(r"\d{4}-?\d\d-?\d\dt\d.*")
_HALF = re.compile(r"(?<=\d)\s*([apAP])\.\s?([mM])\.")
_SPAN = re.compile(
    r"(?P<sign>-?)(?P<days>\d+) ?d(?:ays?)?,? \+?(?P<hours>\d{1,2}):(?P<minutes>[0-5]\d):(?P<seconds>[0-5]\d(?:\.\d+)?)"
)
_MINUTES = re.compile(r"(?P<minutes>\d{1,3}):(?P<seconds>[0-5]\d[.,]\d+)", re.ASCII)


def plain_time(cell: str) -> str:
    """Return a date with a time as a day of a month, with points or slashes; what is none comes back as it is.

    Names of months and days, signs of East Asia, AM and PM before the time, days and months without a zero before
    them, hours and minutes without seconds behind a date, fractions behind a colon or semicolon, names of a place
    behind an offset, and dates without a year.

    Examples
    --------
    >>> plain_time("31-Mar-2024 00:30:00.5"), plain_time("2024/3/1 0:30"), plain_time("2024年3月1日 上午 9:30:05")
    ('31.3.2024 00:30:00.5', '2024/03/01 0:30:00', '2024-03-01 9:30:05 AM')
    >>> plain_time("Sun Mar 31 00:30:00 2024"), plain_time("12:00:01;250"), plain_time("12:00:01.250,004")
    ('31.3.2024 00:30:00', '12:00:01.250', '12:00:01.250004')
    >>> plain_time("2024-W18-3T10:00:05"), plain_time("2024-122T10:00:05Z"), plain_time("2024:122:10:00:05")
    ('2024-05-01T10:00:05', '2024-05-01T10:00:05Z', '2024-05-01 10:00:05')
    >>> plain_time("May  1 08:30:00"), plain_time("01.05. 08:30:00"), plain_time("05-01 08:30:00.125")
    ('1.5.2001 08:30:00', '01.05.2001 08:30:00', '05-01-2001 08:30:00.125')
    """
    text = cell.strip()
    if not text.isascii():
        text = re.sub(r"(\d{4})\s*[年년]\s*(\d{1,2})\s*[月월]\s*(\d{1,2})\s*[日일]", r"\1-\2-\3", text)
        for words, half in ((_MORNING, "AM"), (_AFTERNOON, "PM")):
            for word in words:
                if word in text:
                    text = f"{' '.join(text.replace(word, ' ').split())} {half}"
    text = _PLACE.sub(r"\g<ahead>", text.removesuffix(" Uhr"))
    text = _HALF.sub(r" \1\2", text.upper() if _SMALL.fullmatch(text) else text)
    if (found := _YEARLESS.fullmatch(text)) is not None:
        text = _with_year(found)
    text = _DAY_OF_YEAR.sub(_of_year, _WEEK.sub(_of_week, text, count=1), count=1)
    if re.search(_WORD, text):
        text = _with_month(text.replace(" at ", " "))
    text = _UNPADDED.sub(lambda one: f"{one['year']}{one['sign']}{one['month']:0>2}{one['sign']}{one['day']:0>2}", text)
    text = _FOURTH.sub(r"\g<whole>.\g<part>", _TWICE.sub("", text))
    found = _HOUR_MINUTE.fullmatch(text)
    return text if found is None else f"{found['date']}{found['time']}:00{found['rest']}"


def _with_year(found: re.Match[str]) -> str:
    """Return a date without a year as one of a plain year; as it stands where its word is no month."""
    if found["month"] is None:
        sign = found["sign"]
        return f"{found['first']}{sign}{found['second']}{sign}{PLAIN_YEAR} {found['time']}"
    month = MONTHS.get(found["month"].lower())
    return found[0] if month is None else f"{found['day']}.{month}.{PLAIN_YEAR} {found['time']}"


def _of_week(found: re.Match[str]) -> str:
    """Return the day of a week as one of a month (ISO 8601, week dates)."""
    try:
        day = datetime.date.fromisocalendar(int(found["year"]), int(found["week"]), int(found["day"]))
    except ValueError:
        return found[0]
    return day.strftime("%Y-%m-%d" if found["sign"] else "%Y%m%d")


def _of_year(found: re.Match[str]) -> str:
    """Return the day of a year as one of a month (ISO 8601, ordinal dates; with colons as space agencies write it)."""
    number = int(found["day"] or found["bare"])
    day = datetime.date(int(found["year"]), 1, 1) + datetime.timedelta(number - 1) if int(found["year"]) else None
    if day is None or number < 1 or day.year != int(found["year"]):
        return found[0]
    if found["sign"] == ":":
        return f"{day:%Y-%m-%d} "
    return day.strftime("%Y-%m-%d" if found["sign"] else "%Y%m%d")


def _with_month(text: str) -> str:
    """Return a text with a month's name as one with its number: ``31.3.2024 ...``."""
    for tried in (text, _DAY_NAME.sub("", text, count=1)):
        for pattern in (_YEAR_LAST, _NAME_FIRST, _NAMED):
            found = pattern.match(tried)
            month = None if found is None else MONTHS.get(found["month"].lower())
            if found is not None and month is not None:
                rest = f" {found['time']}{found['zone'] or ''}" if pattern is _YEAR_LAST else ""
                behind = tried[found.end() :]
                joint = " " + behind.lstrip(" ,") if behind.strip(" ,") else ""
                return f"{found['day']}.{month}.{found['year']}{rest}{joint}"
    return text


def span_of(cell: str) -> float | None:
    """Return a span as pandas and cyclers of batteries write it in seconds; None for anything else.

    Examples
    --------
    >>> span_of("1 days 00:00:00.500000"), span_of("0d 00:00:01.50"), span_of("00:00:01")
    (86400.5, 1.5, None)
    """
    found = _SPAN.fullmatch(cell.strip())
    if found is None:
        return None
    within = int(found["hours"]) * 3600 + int(found["minutes"]) * 60 + float(found["seconds"])
    return (-1 if found["sign"] else 1) * 86400 * int(found["days"]) + within


def minutes_of(cell: str) -> float | None:
    """Return minutes and seconds with a fraction, as Excel shows times, in seconds; None for anything else.

    Examples
    --------
    >>> minutes_of("01:30.5"), minutes_of("01:30")
    (90.5, None)
    """
    found = _MINUTES.fullmatch(cell.strip())
    return None if found is None else int(found["minutes"]) * 60 + float(found["seconds"].replace(",", "."))


_FAMILIES = (
    "CET CEST", "MEZ MESZ", "EET EEST", "WET WEST", "GMT BST", "MSK MSD", "EST EDT", "CST CDT", "MST MDT", "PST PDT",
    "AKST AKDT", "HST HDT", "AST ADT", "NST NDT", "AEST AEDT", "ACST ACDT", "NZST NZDT",
    "AWST", "IST", "JST", "KST", "HKT", "SGT", "PHT", "WIB", "ICT", "PKT", "GST", "SAST", "EAT", "WAT", "CAT", "BRT",
    "ART", "CLT", "COT", "PET", "UTC", "Z",
)  # fmt: skip
"""Abbreviations of zones, standard and summer time: whatever zone a word means, its summer time is an hour ahead."""
_WORDS = {word: (family, 3600 * k) for family in _FAMILIES for k, word in enumerate(family.split())}
_AHEAD = re.compile(r"(?:UTC|GMT)?(?P<sign>[+-])(?P<hours>\d\d):?(?P<minutes>\d\d)?")
QUARTER = 900  # Seconds: clocks are set forward and back at a quarter of an hour, wherever they are.


def ahead_of_utc(
    zones: Sequence[str | None], local: npt.NDArray[np.int64], *, dated: bool
) -> npt.NDArray[np.int64] | None:
    """Return by how many seconds the zones of stamps are ahead of UTC, but for one number that all have in common.

    A zone is an offset (``+02:00``), a place of the IANA database (``Europe/Berlin``), whose summer time counts, or an
    abbreviation: of these, all must be those of one zone. Which zone ``IST`` means then does not matter.

    - ``zones``: by stamp
    - ``local`` array of int (N,): local times [s], counted from the day 0 of Python's proleptic calendar where they
      have dates
    - ``dated``: True where they have
    - returns array of int (N,); None where the zones do not say it: abbreviations of two zones, a place
      without dates, or an hour that came twice and of which nobody can say which one is meant

    Examples
    --------
    >>> ahead_of_utc(["CET", "CEST"], np.zeros(2, dtype=np.int64), dated=False).tolist()
    [0, 3600]
    >>> ahead_of_utc(["GMT", "IST"], np.zeros(2, dtype=np.int64), dated=False) is None
    True
    >>> day = 86400 * datetime.date(2024, 3, 31).toordinal()
    >>> ahead_of_utc(["Europe/Berlin"] * 2, day + np.array([7199, 10800]), dated=True).tolist()
    [3600, 7200]
    """
    names = {zone or "" for zone in zones}
    found = {name: _AHEAD.fullmatch(name) for name in names}
    plain = {
        name: 0
        if one is None
        else (-1 if one["sign"] == "-" else 1) * (3600 * int(one["hours"]) + 60 * int(one["minutes"] or 0))
        for name, one in found.items()
        if one is not None or name in ("", "Z", "UTC", "GMT")
    }
    if len(plain) == len(names):
        return np.array([plain[zone or ""] for zone in zones], dtype=np.int64)
    if names <= set(_WORDS) and len({_WORDS[name][0] for name in names}) == 1:
        return np.array([_WORDS[zone or ""][1] for zone in zones], dtype=np.int64)
    place = names.pop().strip("[]")
    if names or not dated or "/" not in place:
        return None
    try:
        return _of_place(zoneinfo.ZoneInfo(place), local)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        return None  # no such place, or a machine without the database


def _of_place(zone: zoneinfo.ZoneInfo, local: npt.NDArray[np.int64]) -> npt.NDArray[np.int64] | None:
    """Return the offsets [s] of local times of a place; of an hour that comes twice, that by which time runs on."""
    quarters, places = np.unique(local // QUARTER, return_inverse=True)
    begins = [
        datetime.datetime.fromordinal(int(one * QUARTER // 86400))
        + datetime.timedelta(seconds=int(one * QUARTER % 86400))
        for one in quarters
    ]
    first, second = (
        np.array(
            [
                int((one.replace(tzinfo=zone, fold=fold).utcoffset() or datetime.timedelta()).total_seconds())
                for one in begins
            ]
        )[places]
        for fold in (0, 1)
    )
    twice = first > second  # where clocks are set forward instead, no local time is in the hour that is left out
    if not twice.any():
        return np.asarray(first, dtype=np.int64)
    falls = np.flatnonzero(np.diff(local) < 0) + 1
    if falls.size > 1 or (falls.size and not twice[falls[0]]):
        return None
    inside = np.flatnonzero(twice)
    before, after = bool(inside[0] > 0), bool(inside[-1] < len(local) - 1)
    if not falls.size and before and after:
        return None  # one of the two hours is missing
    begin = int(falls[0]) if falls.size else 0 if after else len(local)
    return np.asarray(np.where(np.arange(len(local)) >= begin, second, first), dtype=np.int64)
