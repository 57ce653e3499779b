"""Titles of columns: a name, and the unit that stands behind it in one of the ways in which people write it."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterator, Sequence

from harness.data.times.parts import PARTS
from harness.errors import InputError
from harness.units import fits, is_unit

REFERENCE = "reference:"
"""Prefix of columns that hold what came from outside a control loop: the instruments of the test for its bias."""

TRUTH = "truth:"  # Prefix of columns that hold true states: for scoring only, never read as measurements.

_HEADER = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]\s*$")
_INDEX = re.compile(r"(?!\s*1?\s*$)\s*(?:\d+|:)\s*(?:,\s*(?:\d+|:)\s*)*")
_ROUND = re.compile(r"^(?P<name>.*?)\s*[(<{](?P<unit>[^()<>{}]*)[)>}]\s*$")
_BEHIND = re.compile(r"^(?P<name>.*[^\s,])(?P<sign>\s+/|\s+in|,)\s+(?P<unit>[^\s/\[\](){}][^\[\](){}]*)$")
_ABOUT = re.compile(r"\s*\((?:[^():,]+: [^():,]+(?:, *|(?=\))))+\)$")
"""What a logger says of a channel behind its title, as HOBOware does: ``(LGR S/N: 1023, LBL: inlet)``."""
_OF_NODE = {"V": ("V", "m^3", "m/s"), "I": ("A", "kg m^2", "m^4", "W/m^2", "cd", "%")}
"""What V and I stand for: in brackets behind them no other unit stands, but a node or a part (SPICE's ``V(in)``)."""
_ALONE = frozenset("smgVAWNJKCFHTh%°")
"""Units of one sign that may stand behind ``in`` or a slash: ``y / u`` is a ratio, and no atomic mass."""
_INNER = re.compile(
    r"(?P<name>.*[^\s(\[])\s*(?P<unit>\([^()]+\)|\[[^\[\]]+\])(?P<rest>\s*\((?P<kind>[^()]*)\)|\s+[^\W\d]+ #?\d+)$"
)
"""A unit before a further bracket, or the number of a run."""
_GROUP = re.compile(r"[\[({<]([^\[\](){}<>]*)[\])}>]")
_WIDE = str.maketrans("（）［］｛｝【】〔〕〈〉《》＜＞／：，、；．＿－　＊･・｡˚∘", "()[]{}[][]<><><>/:,,;._- *··.°°")
_BREAK = re.compile(r"[\s_,;:/.|=\-]+(?:in[\s_]+)?|(?<=[a-z])(?=[A-Z])")
_SPLIT = re.compile(
    r"[^\w*^×·]+|_+|(?<=\w)(?=[*^×·])|(?<=[a-zäöüéèß])(?=[A-Z])|(?<=[a-zA-Z\d])(?=[\u3040-\u9fff\uac00-\ud7af])"
    r"|(?<=[\u3040-\u9fff\uac00-\ud7af])(?=[a-zA-Zµμ\d])"
)
_UNIT = re.compile(r"[^\W_][\w\s°%/*^.·⋅•×∙²³\-\u2212⁻]*|[°%][\w\s/]*")
_OF_DAY = re.compile(r"of[\s_\-.]*day", re.IGNORECASE)
_NUMBERED = re.compile(r"(?P<word>[^\W\d]+?)\d{1,2}")
_FACTOR = re.compile(r"[x*^×·]?\d.*|.*[*^×·].*")

# ruff: noqa: RUF001 - words of other alphabets

TIME_WORDS = frozenset(
    "time times t tout ts timestamp timestamps stamp datetime elapsed clock epoch unix unixtime zeit zeitstempel "
    "uhrzeit zeitpunkt dauer temps horodatage durée duree instant tiempo instante tempo istante durata tijd "
    "tijdstempel tid czas čas cas aika idő zaman vreme vrijeme waktu час время "
    "χρόνος ώρα เวลา زمن الزمن وقت الوقت समय laikas timp timpul aeg laiks thời gian "
    "时间 時間 时间戳 時間戳 时刻 時刻 经过时间 経過時間 采样时间 测量时间 測定時間 タイム "
    "タイムスタンプ 시간 시각".split()
)
"""Words for time, in small letters."""

TIMES_OF_DAY = frozenset("hora horas heure heures ora ore uur uren godzina hodina saat".split())
"""Words for an hour that head columns of times of day too: of numbers below them nobody can say what they count."""

_OTHERWISE = frozenset("min std sn tag dag dia dias".split())
"""Units of time that alone are titles of something else: a minimum, a deviation, a number of a series, a label."""

_ENDINGS = ("zeit", "time", "时间", "時間", "时刻", "時刻", "시간", "stempel", "stamp")
"""How compounds for time end: Messzeit, runtime, 運転時間."""

_BESIDE = frozenset(
    "of in the since from start begin beginning reset boot up abs absolute rel relative raw log logged recorded record "
    "rec publish header msg system sys local utc gps gmt ros sim simulation run test total measured measurement value "
    "values val data array vec vector axis col column base code seit ab beginn messung écoulé ecoule écoulée depuis "
    "début debut transcurrido decorrido desde inicio trascorso da inizio en em i achse axe eje asse 轴 軸 "
    "real wall source date datum fecha today de du la le el il da di der die das and".split()
)
"""Words beside one for time that say nothing of its unit, in small letters."""

TIME_UNITS = {
    word: unit
    for unit, words in {
        "s": "s sec secs second seconds sek sekunde sekunden seconde seconden secondes seg segs segundo segundos "
        "secondo secondi sekunda sekundy sekund sekunder saniye sn sekundės secunde sekundit "
        "δευτερόλεπτα ثانية сек секунда секунды секунд с 秒 初 초",
        "ms": "ms msec msecs msek mseg milli millis millitm millisec millisecs millisecond milliseconds millisekunde "
        "millisekunden milliseconde milliseconden millisecondes milisegundo milisegundos milissegundo milissegundos "
        "millisecondo millisecondi milisekunda milisekundy milisekund millisekunder milisaniye msn milisekundės "
        "milisecunde millisekundit миллисекунда миллисекунды миллисекунд мс мсек 毫秒 ミリ秒 밀리초",
        "us": "us µs μs usec µsec μsec usecs micro micros microsec microsecs microsecond microseconds mikrosekunde "
        "mikrosekunden microseconde microsecondes microsegundo microsegundos microsecondo microsecondi mikrosekundy "
        "микросекунды мкс 微秒 マイクロ秒 마이크로초",
        "ns": "ns nsec nsecs nano nanos nanosec nanosecs nanosecond nanoseconds nanosekunde nanosekunden nanoseconde "
        "nanosecondes nanosegundo nanosegundos nanosecondi нс наносекунды 纳秒 奈秒 ナノ秒 나노초",
        "min": "min mins minute minutes minuten minuut minuto minutos minuti minuta minuty minutter minuter dakika мин "
        "минута минуты минут 分 分钟 分鐘 분",
        "h": "h hr hrs hour hours std stunde stunden heure heures hora horas ora ore uur uren godz godzina godziny "
        "godzin hodina hodiny hodin timmar saat ч часы часов часа 小时 小時",
        "d": "days day tag tage jour jours día días dia dias giorno giorni dag dagen dni дни дней 天 日",
    }.items()
    for word in words.split()
}
"""What a word beside one for time means, in small letters."""

for _part, _unit in (("zehntel", "ds"), ("hundertstel", "cs"), ("tausendstel", "ms"), ("millionstel", "us")):
    TIME_UNITS.update({f"{_part}{_second}": _unit for _second in ("sekunde", "sekunden", "s")})

TIME_UNITS.update(decisecond="ds", deciseconds="ds", centisecond="cs", centiseconds="cs")
_AND = re.compile(r"(?<=\w)\s+(?:y|e|et|og|und|and|&)\s+(?=\w)")
_PARTS = {"10": "decisecond", "100": "centisecond", "1000": "millisecond", "1000000": "microsecond"}
_PART = re.compile(r"\b1\s*/\s*(?P<parts>10{1,6})\s*(?:s|sec|sek|sekunden?|seconds?)\b", re.IGNORECASE)
"""A part of a second as a unit: ``Zeit in 1/100 s``."""

_SI_SECONDS = frozenset({"ps", "cs", "ds", "d", "week", "weeks"})
"""Further units of time that are read; not what else SI would make of letters: hh is no hundred hours."""

COUNTS = frozenset("tick ticks count counts cycle cycles sample samples frame frames step steps index jiffies".split())
"""Words that count instead of measuring time: how long one takes is not in the title."""


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit of a column title that has the unit in brackets; in round ones only where it is a unit.

    So it is behind ``in`` or a slash between blanks (ISO 80000-1), and behind a comma where a logger's remarks follow:
    else ``Leg, fl`` is a part. A number in brackets is the index of an element, but for 1, which is the unit of plain
    numbers.

    Examples
    --------
    >>> split_header("tau_J[0]"), split_header("data[:,1]"), split_header("share [1]")
    (('tau_J[0]', None), ('data[:,1]', None), ('share', '1'))
    >>> split_header("u [N m]"), split_header("theta"), split_header("theta (deg)"), split_header("theta (raw)")
    (('u', 'N m'), ('theta', None), ('theta', 'deg'), ('theta (raw)', None))
    >>> split_header("u / V"), split_header("CH1 in mV"), split_header("V(in)")
    (('u', 'V'), ('CH1', 'mV'), ('V(in)', None))
    >>> split_header("Leg, fl"), split_header("Volt, V (LGR S/N: 1023, SEN S/N: 7)")
    (('Leg, fl', None), ('Volt', 'V'))
    >>> split_header("Force (N) Run #1"), split_header("theta [deg] (raw)"), split_header("Throttle (Manifold)(%)")
    (('Force Run #1', 'N'), ('theta (raw)', 'deg'), ('Throttle (Manifold)', '%'))
    """
    header, remarks = _with_unit_last(header)
    found = _HEADER.match(header)
    if found is not None and found["name"] and _INDEX.fullmatch(found["unit"]):
        return header.strip(), None
    if found is not None and found["name"]:
        return _bare(found["name"]), found["unit"].strip() or "1"
    found = _ROUND.match(header)
    if found is not None and found["name"] and _says_unit(found["unit"]) and not _is_of_node(**found.groupdict()):
        return _bare(found["name"]), found["unit"].strip()
    found = _BEHIND.match(header.strip())
    if found is not None and _says_unit(found["unit"]) and (remarks or found["sign"] != ","):
        if len(found["unit"]) > 1 or found["unit"] in _ALONE:
            return _bare(found["name"]), found["unit"].strip()
    return header.strip(), None


def behind_slashes(titles: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return name and unit of the titles of a table that state it behind a slash without blanks, as ``U/V``.

    One such title may be a ratio or a path. The form is the table's where two names that are no units themselves have
    units of several letters among them behind it, or the clock has its own there.

    Examples
    --------
    >>> behind_slashes(["time/s", "Ewe/V", "<I>/mA", "ox/red"])
    {'time/s': ('time', 's'), 'Ewe/V': ('Ewe', 'V'), '<I>/mA': ('<I>', 'mA')}
    >>> behind_slashes(["t", "left/V", "right/T"]), behind_slashes(["t", "u/max", "u/min", "m/kg"])
    ({}, {})
    """
    found = {}
    for title in titles:
        name, sign, unit = (part.strip() for part in title.partition("/"))
        if sign and name and _says_unit(unit) and unit not in (*_OTHERWISE, "in") and (len(unit) > 1 or unit in _ALONE):
            found[title] = name, unit
    clock = any(TIME_UNITS.get(unit) and _is_clock(name, ()) for name, unit in found.values())
    plain = {name for name, _ in found.values() if not is_unit(name)}
    certain = clock or (1 < len(plain) == len(found) and any(len(unit) > 1 for _, unit in found.values()))
    return found if certain and len(found) == len({name for name, _ in found.values()}) else {}


def seeming_unit(title: str) -> str | None:
    """Return what may be the unit in a title that states none for certain; None where nothing looks so.

    Examples
    --------
    >>> seeming_unit("y_mm"), seeming_unit("Kraft/N"), seeming_unit("speed_rad_s"), seeming_unit("u_max")
    ('mm', 'N', 'rad/s', None)
    """
    for _, text in _divided(title):
        unit = text.replace("_", "/")
        if is_unit(unit) and unit not in (*_OTHERWISE, "in") and (len(unit) > 1 or f"/{unit}" in title):
            return unit
    return None


def _with_unit_last(header: str) -> tuple[str, int]:
    """Return a title with its unit at the end, and how many remarks of a logger stood there."""
    header = header.translate(_WIDE) if not header.isascii() else header
    header, remarks = _ABOUT.subn("", header.strip()) if header.endswith(")") and ":" in header else (header, 0)
    found = _INNER.match(header)
    if found is not None and _says_unit(found["unit"][1:-1]) and not _says_unit(found["kind"] or ""):
        header = f"{found['name']}{found['rest']} {found['unit']}"
    return header, remarks


def _is_of_node(name: str, unit: str) -> bool:
    """Return True for a voltage or current as SPICE titles it, whose node only looks like a unit of something else."""
    of = _OF_NODE.get(name.upper())
    return of is not None and not any(fits(unit, one) for one in of)


def _bare(name: str) -> str:
    """Return a name without the sign that stands between it and a unit in brackets: ``u / (N m)`` (ISO 80000-1)."""
    return (name.strip() if name.endswith(("_", "-")) else name.rstrip(" \t/|,;:=")).strip() or name.strip()


def stated_unit(title: str, like: str) -> tuple[str, str] | None:
    """Return name and unit of a title that states the unit without brackets; None where none fits what is expected.

    - ``title``: such as ``theta_deg``, ``U / V``, ``speed_rad_s``, ``torque, Nm``
    - ``like``: a unit of what the column is expected to measure: of several readings the one that fits counts, and a
      word that is a unit of something else is a part of the name

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


def clock_unit(title: str, *, path: bool = False) -> str | None:
    """Return the unit that the title of a time column states, in whatever form; None where it states none.

    A word where a unit would stand that is none is refused: nobody can say that it means seconds.

    Raises InputError if the title states something that is no unit of time, or two of them.

    - ``title``: in any of a dozen languages, with brackets and signs of any kind
    - ``path``: True where the title is a path in a file, whose steps may be called anything

    Examples
    --------
    >>> [clock_unit(title) for title in ("Zeit (ms)", "time_ms", "t/us", "timestampNs", "Time, min", "时间（毫秒）")]
    ['ms', 'ms', 'us', 'ns', 'min', 'ms']
    >>> clock_unit("Zeit in 1/100 s"), clock_unit("t [1/1000 s]")
    ('cs', 'ms')
    >>> clock_unit("time") is None
    True
    """
    plain = _plain(title)
    inside = [part.strip() for part in _GROUP.findall(plain) if part.strip()]
    units = set()
    for part in inside:
        unit = _time_unit(part)
        if unit is None:
            raise _no_time(title, part)
        units.add(unit)
    words = words_of(_GROUP.sub(" ", plain))
    first = next((place for place, word in enumerate(words) if _spoken(word)), None)
    if not units and first is None and any(word in TIMES_OF_DAY for word in words):
        raise _no_time(title, next(word for word in words if word in TIMES_OF_DAY))
    for place, word in enumerate(words):
        units |= {TIME_UNITS[word]} if word in TIME_UNITS else _fused(word)
        if place > (first or 0) and _FACTOR.fullmatch(word) and not (word.isdigit() and len(word) < 3):
            raise _no_time(title, word)
    if len(units) > 1:
        raise _no_time(title, " and ".join(sorted(units)))
    if not units:
        _refuse_no_unit(title, plain, words, first, path=path)
    return units.pop() if units else None


def _refuse_no_unit(title: str, plain: str, words: Sequence[str], first: int | None, *, path: bool) -> None:
    """Refuse a title without a unit of time that states something in its place: a count, a word, another unit."""
    for word in words:
        if word in COUNTS or re.fullmatch(r"\d+[^\W\d]+", word):
            raise _no_time(title, word)
    unknown = [] if path else [word for word in words[(first or 0) + 1 :] if not _silent(word)]
    stated = first is not None or re.search(r"[/,;|=]|\b(?:in|en|em)\b", plain.strip(" /,;|=")) is not None
    if unknown and stated:
        raise _no_time(title, unknown[0])
    for word in words[first + 1 :] if first is not None else ():
        if _says_unit(word) and word not in TIME_WORDS and word not in _BESIDE:
            raise _no_time(title, word)


def fraction_of(title: str, titles: Sequence[str]) -> str | None:
    """Return the column that holds the fraction of the whole seconds in another, as ROS and C write them; None if none.

    Examples
    --------
    >>> fraction_of("stamp.sec", ["stamp.sec", "stamp.nanosec", "u"]), fraction_of("secs", ["secs", "nsecs"])
    ('stamp.nanosec', 'nsecs')
    >>> fraction_of("time [s]", ["time [s]", "time [ms]"]), fraction_of("Seconds", ["Seconds", "Fraction", "u"])
    (None, 'Fraction')
    """
    stem, word = _last_word(title)
    if word not in _WHOLE:
        return None
    found = [other for other in titles if _last_word(other)[0] == stem and _last_word(other)[1] in _WHOLE[word]]
    found = found or [other for other in titles if part_unit(other) == "s"]
    return found[0] if len(found) == 1 else None


_WHOLE = {
    "sec": ("nsec", "nanosec", "usec", "msec"), "secs": ("nsecs", "nanosecs", "usecs", "msecs"),
    "s": ("ns", "us"), "seconds": ("nanoseconds", "microseconds", "milliseconds"),
    "second": ("nanosecond", "microsecond", "millisecond"),
}  # fmt: skip
"""Words for whole seconds, and those for their fraction beside them (``timespec``, ``timeval``, stamps of ROS)."""


_PART_WORDS = {
    **dict.fromkeys("year jahr année annee año ano anno jaar rok год 年".split(), "year"),
    **dict.fromkeys("month monat mois mes mês mese maand месяц 月".split(), "month"),
    "d": "day", "日": "day",
}  # fmt: skip
"""Words for parts of a date that are no units of time, in small letters."""


def parts_of(titles: Sequence[str]) -> dict[str, str]:
    """Return by part (:data:`harness.data.times.parts.PARTS`) the columns that hold one time together; else nothing.

    They are called by a part alone, and none between the coarsest and the finest is left out.

    Examples
    --------
    >>> parts_of(["Jahr", "Monat", "Tag", "Stunde", "u"])
    {'year': 'Jahr', 'month': 'Monat', 'day': 'Tag', 'h': 'Stunde'}
    >>> parts_of(["s", "ms", "u"]), parts_of(["Year", "Minute", "u"])
    ({'s': 's', 'ms': 'ms'}, {})
    """
    found: dict[str, str] = {}
    for title in titles:
        word = title.strip(" ()").lower()
        part = _PART_WORDS.get(word) or TIME_UNITS.get(word, "").replace("d", "day")
        if part in PARTS and found.setdefault(part, title) != title:
            return {}
    places = [place for place, part in enumerate(PARTS) if part in found]
    plain = any(
        title.strip(" ()").lower() not in _OTHERWISE and len(title.strip(" ()")) > 1 for title in found.values()
    )
    if (
        len(places) < 3 - plain
        or places != list(range(places[0], places[-1] + 1))
        or PARTS[places[-1]] in ("month", "day")
    ):
        return {}
    return {PARTS[place]: found[PARTS[place]] for place in places}


def part_unit(name: str) -> str | None:
    """Return the unit of a column that is called by a part of a second alone; None for any other.

    Examples
    --------
    >>> part_unit("ms"), part_unit("millis()"), part_unit("s"), part_unit("latency_ms"), part_unit("Fractional Seconds")
    ('ms', 'ms', None, None, 's')
    """
    unit = TIME_UNITS.get(name.strip(" ()").lower())
    first, *more = words_of(name) or [""]
    if first in _FRACTIONS and all(TIME_UNITS.get(word) == "s" or word in _BESIDE for word in more):
        return "s"
    return unit if unit in ("ms", "us", "ns") else None


_FRACTIONS = ("fraction", "fractional", "frac", "subsec", "subsecond", "subseconds")
"""Words for the part of a second behind whole ones."""


def _last_word(title: str) -> tuple[str, str]:
    """Return what stands before the last word of a title, and that word in small letters."""
    found = re.fullmatch(r"(?P<stem>.*?)(?P<word>[A-Za-z]+)", title.strip())
    return ("", "") if found is None else (found["stem"].lower(), found["word"].lower())


def clock_of(titles: Sequence[str], taken: Collection[str | int] = ()) -> str | None:
    """Return the title of the time column; None if there is none.

    ``time``, ``t`` and ``timestamp`` come first, then any title that holds words for time and its units only, then one
    that is a unit of time.

    Raises InputError if two columns may be meant.

    - ``taken``: titles that are signals

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
    for beside in ((), _BESIDE, (*_BESIDE, *COUNTS)):  # a time of a step or sample is a clock where no other is
        spoken = [title for title in free if _is_clock(title, beside)]
        if spoken:
            return _only(spoken)
    if parts := parts_of(free):
        return list(parts.values())[-1]
    units = [title for title in free if _counts_time(title)]
    return _only(units or [title for title in free if _leads(*split_header(title))])


def _counts_time(title: str) -> bool:
    """Return True if a title is a unit of time, perhaps with words that say nothing: millis(), ``in s``, ms_today."""
    words = words_of(title) or [""]
    if words[0] == "in":
        return len(words) == 2 and words[1] in TIME_UNITS
    if len(words) == 2 and words[0] in COUNTS:  # tick_ms
        words.reverse()
    first = words[0] in TIME_UNITS and words[0] not in _OTHERWISE and len(words[0]) > 1
    return first and all(word in _BESIDE or word in COUNTS for word in words[1:])


def _leads(name: str, unit: str | None) -> bool:
    """Return True if a title with a unit of time is that of an x axis, or a word for time with a channel's number."""
    words = words_of(name)
    axis = words in (["x"], ["x", "axis"], ["x", "value"])  # of scopes, and of LabVIEW
    numbered = len(words) > 1 and _spoken(words[0]) and words[1].isdigit()  # of catman: Time  1 - default sample rate
    return unit is not None and _time_unit(unit) is not None and (axis or numbered)


def _only(titles: Sequence[str]) -> str | None:
    """Return the one title; None for none."""
    if len(titles) == 2 and titles[1] in (fraction_of(titles[0], titles),):
        return titles[0]
    if len(titles) > 1:
        raise InputError(
            f"{len(titles)} columns may be the time",
            expected="one",
            got=", ".join(titles[:6]),
            remedy="rename one, or give its number ([time] column = 0 in a dataset.toml)"
            if len(set(titles)) < len(titles)
            else 'say which ([time] column = "..."; sysid: --column time=TITLE), or rename the others',
            place="time",
        )
    return titles[0] if titles else None


def says_time(title: str) -> bool:
    """Return True if a title holds a word for time or for dates, whatever stands beside it.

    Examples
    --------
    >>> says_time("TimeString"), says_time("theta")
    (True, False)
    """
    return any(_spoken(word) or word in _DATES for word in words_of(_GROUP.sub(" ", _plain(title))))


_DATES = ("date", "datum", "fecha", "data")  # Words for dates, in small letters.
_REMARK = re.compile(
    r"(?P<word>[^\W\d_]+)\s*(?:units?|einheit)?\s*(?:\bin\b|\ben\b|[:=\[(])\s*(?P<unit>[^\W\d_]+)", re.IGNORECASE
)


def remarked_unit(lines: Sequence[str]) -> tuple[str, str] | None:
    """Return the unit of time that a remark above a table states, if it is not the second, and the remark; else None.

    Examples
    --------
    >>> remarked_unit(["# pendulum 3", "# Time in minutes, angle in rad"])
    ('min', '# Time in minutes, angle in rad')
    >>> remarked_unit(["# time: 10:30", "# time in s", "# run time in the evening"]) is None
    True
    """
    for line in lines:
        for found in _REMARK.finditer(line):
            unit = TIME_UNITS.get(found["unit"].lower())
            if _spoken(found["word"].lower()) and unit not in (None, "s"):
                return unit, line.strip()
    return None


def unlike_remark(title: str, unit: str, remark: str) -> InputError:
    """Return the refusal of a time column without a unit where a remark above the table states another than the second.

    Examples
    --------
    >>> unlike_remark("time", "min", "# time in minutes").got
    "'# time in minutes'"
    """
    return InputError(
        f"the time column {title!r} states no unit",
        expected="the unit in its title, as a remark above the table states another than the second",
        got=repr(remark[:60]),
        remedy=f'title it "{title} [{unit}]", or declare [time] unit = "{unit}" in a dataset.toml '
        f"(sysid: --unit time={unit})",
        place="time.unit",
    )


def _is_clock(title: str, beside: Collection[str]) -> bool:
    """Return True if a title holds a word for time, and beside it only such words, units of time and the given ones.

    Where such are given, compounds (Messzeit) count, and so does the number of a run.
    """
    words = words_of(_GROUP.sub(" ", _plain(title)))
    spoken = [word for word in words if (_spoken(word) if beside else word in TIME_WORDS or _fused(word))]
    if beside and any(word in _DATES for word in words):  # Fecha/Hora
        spoken += [word for word in words if word in TIMES_OF_DAY]
    numbers = [word for word in words[-1:] if beside and word.isdigit() and len(word) < 3]
    return bool(spoken) and all(word in TIME_UNITS or word in (*spoken, *beside, *numbers) for word in words)


def _plain(title: str) -> str:
    """Return a title with the brackets, signs and letters that ASCII has for them, and words for parts of a second."""
    plain = _AND.sub(" ", unicodedata.normalize("NFC", _OF_DAY.sub("", title)).translate(_WIDE))
    return _PART.sub(lambda found: _PARTS.get(found["parts"], found[0]), plain)


def words_of(text: str) -> list[str]:
    """Return the words of a title in small letters, without the number of a sensor behind one.

    Examples
    --------
    >>> words_of("Messzeit [ms]"), words_of("timeStamp2")
    (['messzeit', 'ms'], ['time', 'stamp'])
    """
    words = [word.lower() for word in _SPLIT.split(text) if word]
    return [found["word"] if (found := _NUMBERED.fullmatch(word)) else word for word in words]


def _spoken(word: str) -> bool:
    """Return True if a word is one for time, or a compound of it (``Messzeit``), perhaps with a unit behind it."""
    return word in TIME_WORDS or bool(_fused(word)) or (word.endswith(_ENDINGS) and word not in TIME_UNITS)


def _silent(word: str) -> bool:
    """Return True if a word beside one for time says nothing of a unit."""
    return word in _BESIDE or _spoken(word) or (word.isdigit() and len(word) < 3)


def _fused(word: str) -> set[str]:
    """Return the unit that a word such as ``timems`` states behind one for time; empty where it states none."""
    if word in TIME_WORDS or word in TIME_UNITS:
        return set()
    ends = [word[len(head) :] for head in TIME_WORDS if word.startswith(head)]
    return {TIME_UNITS[end] for end in ends if end in TIME_UNITS}


def _time_unit(text: str) -> str | None:
    """Return a unit of time that stands in brackets; None for anything else."""
    text = text.strip(" ._")
    first, *more = words_of(text) or [""]
    if more and first in TIME_UNITS and all(word in _BESIDE for word in more):  # ns since boot
        return TIME_UNITS[first]
    joined = text.lower().replace("-", "")
    if joined in TIME_UNITS and text != "Ms":  # a megasecond to SI, a millisecond to whoever wrote it
        return TIME_UNITS[joined]
    return text if text in _SI_SECONDS else None


def unit_of_time(text: str) -> str:
    """Return a unit as it is known, words for times included; ``Ms`` is no ms.

    Examples
    --------
    >>> unit_of_time("Millisekunden"), unit_of_time("sec."), unit_of_time("Ms"), unit_of_time("V")
    ('ms', 's', 'Ms', 'V')
    """
    return text if text == "Ms" else TIME_UNITS.get(text.strip().rstrip(".").lower(), text)


def _no_time(title: str, what: str) -> InputError:
    """Return the refusal of a title whose unit of time is not understood."""
    return InputError(
        f"the time column {title!r}",
        expected="one unit of time (s, ms, us, ns, min, h)",
        got=repr(what),
        remedy='write it as in "time [ms]", or declare [time] unit, the one that the numbers count, in a dataset.toml '
        "(sysid: --unit time=UNIT)",
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
