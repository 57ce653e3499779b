"""Dates and times as programs and languages write them, brought into the forms that stamps are read in."""

from __future__ import annotations

import re

__all__ = ["minutes_of", "plain_time", "span_of"]


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
    rf"(?P<month>{_WORD})\s+(?P<day>\d{{1,2}})\s+(?P<time>{_TIME}:\d\d(?:[.,]\d+)?)\s+(?P<year>\d{{4}})"
)
_UNPADDED = re.compile(r"(?P<year>\d{4})(?P<sign>[-/.])(?P<month>\d{1,2})(?P=sign)(?P<day>\d{1,2})(?!\d)")
_FOURTH = re.compile(rf"(?P<whole>{_TIME}:[0-5]\d):(?P<part>\d{{3}}|\d{{6}}|\d{{9}})(?!\d)")
_HOUR_MINUTE = re.compile(
    rf"(?P<date>.*\d(?:[T ]|, ?))(?P<time>{_TIME})(?P<rest>\s*(?:[AaPp]\.?[Mm]\.?)?\s*(?:Z|[+-]\d\d(?::?\d\d)?)?)"
)
_PLACE = re.compile(r"(?<=\d)\[[A-Za-z_+\-/\d]+\]$")
_SPAN = re.compile(
    r"(?P<sign>-?)(?P<days>\d+) days?,? \+?(?P<hours>\d{1,2}):(?P<minutes>[0-5]\d):(?P<seconds>[0-5]\d(?:\.\d+)?)"
)
_MINUTES = re.compile(r"(?P<minutes>\d{1,3}):(?P<seconds>[0-5]\d[.,]\d+)", re.ASCII)


def plain_time(cell: str) -> str:
    """Return a date with a time in a form of ISO 8601 or with points and slashes; what is none comes back as it is.

    Names of months and days, signs of East Asia, AM and PM before the time, days and months without a zero before
    them, hours and minutes without seconds behind a date, fractions behind a colon, and names of a place behind an
    offset.

    Examples
    --------
    >>> plain_time("31-Mar-2024 00:30:00.5"), plain_time("2024/3/1 0:30"), plain_time("2024年3月1日 上午 9:30:05")
    ('31.3.2024 00:30:00.5', '2024/03/01 0:30:00', '2024-03-01 9:30:05 AM')
    >>> plain_time("Sun Mar 31 00:30:00 2024"), plain_time("12:00:01:250"), plain_time("0.5")
    ('31.3.2024 00:30:00', '12:00:01.250', '0.5')
    """
    text = cell.strip()
    if not text.isascii():
        text = re.sub(r"(\d{4})\s*[年년]\s*(\d{1,2})\s*[月월]\s*(\d{1,2})\s*[日일]", r"\1-\2-\3", text)
        for words, half in ((_MORNING, "AM"), (_AFTERNOON, "PM")):
            for word in words:
                if word in text:
                    text = f"{' '.join(text.replace(word, ' ').split())} {half}"
    text = _PLACE.sub("", text.removesuffix(" Uhr"))
    if re.search(_WORD, text):
        text = _with_month(text)
    text = _UNPADDED.sub(lambda one: f"{one['year']}{one['sign']}{one['month']:0>2}{one['sign']}{one['day']:0>2}", text)
    text = _FOURTH.sub(r"\g<whole>.\g<part>", text)
    found = _HOUR_MINUTE.fullmatch(text)
    return text if found is None else f"{found['date']}{found['time']}:00{found['rest']}"


def _with_month(text: str) -> str:
    """Return a text with a month's name as one with its number: ``31.3.2024 ...``."""
    for tried in (text, _DAY_NAME.sub("", text, count=1)):
        for pattern in (_YEAR_LAST, _NAME_FIRST, _NAMED):
            found = pattern.match(tried)
            month = None if found is None else MONTHS.get(found["month"].lower())
            if found is not None and month is not None:
                rest = f" {found['time']}" if pattern is _YEAR_LAST else ""
                behind = tried[found.end() :]
                joint = " " + behind.lstrip(" ,") if behind.strip(" ,") else ""
                return f"{found['day']}.{month}.{found['year']}{rest}{joint}"
    return text


def span_of(cell: str) -> float | None:
    """Return a span as pandas writes it in seconds; None for anything else.

    Examples
    --------
    >>> span_of("1 days 00:00:00.500000"), span_of("00:00:01")
    (86400.5, None)
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
