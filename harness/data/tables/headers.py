"""Titles of columns: a name, and the unit that stands behind it in one of the ways in which people write it."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence

from harness.errors import InputError
from harness.units import fits, is_unit

__all__ = ["REFERENCE", "TRUTH", "clock_of", "clock_unit", "split_header", "stated_unit"]

REFERENCE = "reference:"
"""Prefix of columns that hold what came from outside a control loop: the instruments of the test for its bias."""

TRUTH = "truth:"
"""Prefix of columns that hold true states: for scoring only, never read as measurements."""

_HEADER = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]\s*$")
_ROUND = re.compile(r"^(?P<name>.*?)\s*[(<](?P<unit>[^()<>]*)[)>]\s*$")
_BRACKETS = re.compile(r"^(?P<name>.*?)\s*[\[({<](?P<unit>[^\[\](){}<>]*)[\])}>]\s*$")
_BREAK = re.compile(r"[\s_,;:/.\-]+(?:in[\s_]+)?|(?<=[a-z])(?=[A-Z])")
_UNIT = re.compile(r"[^\W_][\w\s°%/*^.·⋅•×∙²³\-\u2212]*|[°%][\w\s/]*")
_OF_DAY = re.compile(r"of[\s_\-.]*day", re.IGNORECASE)

# ruff: noqa: RUF001 - words of other alphabets

TIME_WORDS = frozenset(
    "time times t ts timestamp timestamps stamp datetime elapsed clock zeit zeitstempel uhrzeit temps horodatage "
    "tiempo tempo tijd tijdstempel tid czas čas cas aika idő zaman vreme vrijeme waktu час время 时间 時間 시간".split()
)
"""Words for time, in small letters."""

TIME_UNITS = {
    word: unit
    for unit, words in {
        "s": "s sec secs second seconds sekunde sekunden seconde secondes segundo segundos secondo secondi сек с 秒 초",
        "ms": "ms msec msecs milli millis millisec millisecs millisecond milliseconds millisekunde millisekunden "
        "milliseconde millisecondes milisegundo milisegundos millisecondo millisecondi мс мсек 毫秒 ミリ秒 밀리초",
        "us": "us µs μs usec usecs micro micros microsec microsecs microsecond microseconds mikrosekunde mikrosekunden "
        "microseconde microsecondes microsegundo microsegundos microsecondi мкс 微秒 マイクロ秒",
        "ns": "ns nsec nsecs nano nanos nanosec nanosecs nanosecond nanoseconds nanosekunde nanosekunden nanoseconde "
        "nanosecondes nanosegundo nanosegundos нс 纳秒 ナノ秒",
        "min": "min mins minute minutes minuten minuto minutos minuti мин 分",
        "h": "h hr hrs hour hours stunde stunden heure heures hora horas ore ч",
        "d": "days day tage jours",
    }.items()
    for word in words.split()
}
"""What a word beside one for time means, in small letters."""

COUNTS = frozenset("tick ticks count counts cycle cycles sample samples frame frames step steps index jiffies".split())
"""Words that count instead of measuring time: how long one takes is not in the title."""


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit of a column title that has the unit in brackets; in round ones only where it is a unit.

    Examples
    --------
    >>> split_header("u [N m]"), split_header("theta"), split_header("theta (deg)"), split_header("theta (raw)")
    (('u', 'N m'), ('theta', None), ('theta', 'deg'), ('theta (raw)', None))
    """
    found = _HEADER.match(header)
    if found is not None and found["name"]:
        return found["name"].strip(), found["unit"].strip() or "1"
    found = _ROUND.match(header)
    if found is not None and found["name"] and _says_unit(found["unit"]):
        return found["name"].strip(), found["unit"].strip()
    return header.strip(), None


def stated_unit(title: str, like: str) -> tuple[str, str] | None:
    """Return name and unit of a title that states the unit without brackets; None where none fits what is expected.

    Parameters
    ----------
    title : str
        Such as ``theta_deg``, ``U / V``, ``speed_rad_s``, ``torque, Nm``.
    like : str
        A unit of what the column is expected to measure: of several readings the one that fits counts, and a word that
        is a unit of something else is a part of the name.

    Examples
    --------
    >>> stated_unit("theta_deg", "rad"), stated_unit("tau_V", "N m"), stated_unit("w_rad_per_s", "rad/s")
    (('theta', 'deg'), None, ('w', 'rad/s'))
    """
    for name, text in _divided(title):
        # "in" is an input as often as an inch
        if not _says_unit(text, joined=True) or text == "in":
            continue
        texts = (text, re.sub(r"_?per_?", "/", text), text.replace("_", "/"), text.replace("_", " "))
        for unit in dict.fromkeys(texts):
            if is_unit(unit) and fits(unit, like):
                return name, unit
    return None


def clock_unit(title: str) -> str | None:
    """Return the unit that the title of a time column states, in whatever form; None where it states none.

    Raises
    ------
    InputError
        If the title states something that is no unit of time, or two of them.

    Examples
    --------
    >>> [clock_unit(title) for title in ("Zeit (ms)", "time_ms", "t/us", "timestampNs", "Time, min", "Sekunden")]
    ['ms', 'ms', 'us', 'ns', 'min', 's']
    >>> clock_unit("time") is None
    True
    """
    found = _BRACKETS.match(title)
    name = title if found is None or not found["name"] else found["name"]
    inside = None if found is None or not found["name"] else _time_unit(found["unit"])
    if found is not None and found["name"] and inside is None:
        raise _no_time(title, found["unit"])
    words = _words(name)
    units = {TIME_UNITS[word] for word in words if word in TIME_UNITS}
    units |= {unit for word in words for unit in _fused(word)}
    units |= set() if inside is None else {inside}
    if len(units) > 1:
        raise _no_time(title, " and ".join(sorted(units)))
    if units:
        return units.pop()
    last = max((place for place, word in enumerate(words) if word in TIME_WORDS), default=-1)
    for word in words:
        if word in COUNTS or re.fullmatch(r"\d+[^\W\d]+", word):
            raise _no_time(title, word)
    for word in words[last + 1 :]:
        if last >= 0 and _says_unit(word):
            raise _no_time(title, word)
    return None


def clock_of(titles: Sequence[str], taken: Collection[str] = ()) -> str | None:
    """Return the title of the time column; None if there is none.

    ``time``, ``t`` and ``timestamp`` come first, then any title that holds words for time and its units only, then one
    that is a unit of time.

    Parameters
    ----------
    titles : sequence of str
    taken : collection of str
        Titles that are signals.

    Raises
    ------
    InputError
        If two columns may be meant.

    Examples
    --------
    >>> clock_of(["time [s]", "u"]), clock_of(["u", "Zeit (ms)", "theta"]), clock_of(["u", "y"])
    ('time [s]', 'Zeit (ms)', None)
    """
    free = [title for title in titles if title not in taken]
    names = {title: split_header(title)[0] for title in free}
    for wanted in ("time", "t", "timestamp"):
        exact = [title for title in free if names[title] == wanted]
        found = exact or [title for title in free if names[title].lower() == wanted]
        if found:
            return _only(found)
    spoken = [title for title in free if _is_clock(title)]
    if spoken:
        return _only(spoken)
    return _only([title for title in free if len(title) > 1 and title.strip().lower() in TIME_UNITS])


def _only(titles: Sequence[str]) -> str | None:
    """Return the one title; None for none."""
    if len(titles) > 1:
        raise InputError(
            f"{len(titles)} columns may be the time",
            expected="one",
            got=", ".join(titles[:6]),
            remedy='say which ([time] column = "..."; sysid: --column time=TITLE), or rename the others',
            place="time",
        )
    return titles[0] if titles else None


def _is_clock(title: str) -> bool:
    """Return True if a title holds a word for time, and beside it only such words and units of time."""
    found = _BRACKETS.match(title)
    words = _words(title if found is None or not found["name"] else found["name"])
    spoken = [word for word in words if word in TIME_WORDS or _fused(word)]
    return bool(spoken) and all(word in TIME_UNITS or word in COUNTS or word in spoken for word in words)


def _words(text: str) -> list[str]:
    """Return the words of a title in small letters."""
    return [word.lower() for word in _BREAK.split(_OF_DAY.sub("", text)) if word]


def _fused(word: str) -> list[str]:
    """Return the unit that a word such as ``timems`` states behind one for time."""
    if word in TIME_WORDS:
        return []
    ends = [word[len(head) :] for head in TIME_WORDS if word.startswith(head)]
    return list({TIME_UNITS[end] for end in ends if end in TIME_UNITS})


def _time_unit(text: str) -> str | None:
    """Return a unit of time that stands in brackets; None for anything else."""
    text = text.strip()
    if text.lower() in TIME_UNITS and text != "Ms":  # a megasecond to SI, a millisecond to whoever wrote it
        return TIME_UNITS[text.lower()]
    return text if text not in ("Ms", "a") and is_unit(text) and fits(text, "s") else None


def _no_time(title: str, what: str) -> InputError:
    """Return the refusal of a title whose unit of time is not understood."""
    return InputError(
        f"the time column {title!r}",
        expected="one unit of time (s, ms, us, ns, min, h)",
        got=repr(what),
        remedy='write it as in "time [ms]", or declare [time] unit = "ms" in a dataset.toml',
        place="time.unit",
    )


def _divided(title: str) -> Iterator[tuple[str, str]]:
    """Yield every name with what stands behind it, the shortest name first."""
    for found in _BREAK.finditer(title):
        name, behind = title[: found.start()].strip(), title[found.end() :].strip(" .,;:")
        if name and behind:
            yield name, behind


def _says_unit(text: str, *, joined: bool = False) -> bool:
    """Return True if a text is a unit and no bare number; ``joined`` also lets words be joined by ``_``."""
    text = text.strip()
    if not _UNIT.fullmatch(text) or not any(sign.isalpha() or sign in "°%" for sign in text):
        return False
    return (joined and "_" in text) or is_unit(text)
