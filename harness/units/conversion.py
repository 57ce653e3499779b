"""Units: converted once, at the border, with pint."""

from __future__ import annotations

import functools
import re
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from harness.units.grammar import LONGEST, RAISED, factors
from harness.units.known import is_known, is_with_seconds

if TYPE_CHECKING:
    import pint

T = TypeVar("T", float, FloatArray)


WRITTEN = {
    "Nm": "N*m",
    "Nmm": "N*mm",
    "Ncm": "N*cm",
    "Nms": "N*m*s",
    "Vs": "V*s",
    "rev": "turn",
    "revs": "turn",
    "Kg": "kg",
    "KG": "kg",
    "Newton": "N",
    "million": "1e6",
    "Amp": "A",
    "Amps": "A",
    "amp": "A",
    "amps": "A",
    "inlb": "inch*force_pound",
    "ftlb": "foot*force_pound",
    "lsb": "count",
    "LSB": "count",
    "kp": "force_kilogram",
    "kmph": "km/hour",
    "kmh": "km/hour",
    "kts": "knot",
    "lbs": "pound",
    "rads": "radian",
}
"""What engineers write and pint does not know, or takes for something else (its Nm is a number metre)."""

# ruff: noqa: RUF001 - words of other alphabets

ELSEWHERE = {
    word: meaning
    for meaning, words in {
        "s": "с сек 秒 초",
        "ms": "мс 毫秒 밀리초",
        "us": "мкс 微秒",
        "min": "мин 分钟 分鐘",
        "hour": "ч 小时 小時",
        "rad": "рад 弧度 ラジアン 라디안",
        "mrad": "мрад",
        "turn": "об tr giri giro vuelta vueltas Umdr Umdrehung Umdrehungen 转 轉 회전",
        "V": "В вольт voltio voltios 伏 伏特 ボルト 볼트",
        "mV": "мВ 毫伏",
        "kV": "кВ",
        "A": "А ампер amperio amperios 安 安培 アンペア 암페어",
        "mA": "мА 毫安",
        "N": "Н ньютон 牛 牛顿 ニュートン 뉴턴",
        "kN": "кН",
        "Nm": "Нм 牛米",
        "m": "м 米 メートル 미터",
        "mm": "мм 毫米 ミリメートル",
        "cm": "см 厘米",
        "kg": "кг 千克 公斤",
        "g": "г 克",
        "Hz": "Гц 赫兹 ヘルツ 헤르츠",
        "kHz": "кГц",
        "W": "Вт 瓦 瓦特",
        "kW": "кВт",
        "ohm": "Ом 欧姆",
        "Pa": "Па 帕",
        "kPa": "кПа",
        "MPa": "МПа",
        "bar": "бар",
        "K": "开尔文",
        "pixel": "px",
    }.items()
    for word in words.split()
}
"""Names of units in other languages and alphabets."""

WHOLE = {
    "-": "1",
    "unitless": "1",
    "dimensionless": "1",
    "none": "1",
    "p.u.": "1",
    "pu": "1",
    "U/min": "rpm",
    "r/min": "rpm",
    "rps": "turn/s",
    "dps": "degree/s",
    "Celsius": "degC",
    "celsius": "degC",
    "℃": "degC",
    "摄氏度": "degC",
    "角度": "degree",
    "转/分": "rpm",
    "r.p.m.": "rpm",
}
"""Texts that mean something as a whole."""

DEGREES = tuple(
    "degré degrés grado grados grau graus gradi graden stopień stopni градус градусы градусов 度 도".split()
)
"""Words for degrees, of an angle or of temperature."""

AMBIGUOUS = {
    "C": ("coulomb", "degC"),
    "F": ("farad", "degF"),
    "g": ("gram", "standard_gravity"),
    "G": ("gauss", "standard_gravity"),
    "NM": ("N*m", "nanometer"),
    "grad": ("gradian", "degree"),
    "Grad": ("gradian", "degree"),
    **dict.fromkeys(DEGREES, ("degree", "degC")),
    "au": ("astronomical_unit", "1"),
    "a.u.": ("astronomical_unit", "1"),
    "M": ("molar", "million"),
    "MM": ("megamolar", "millimeter"),
    "pH": ("picohenry", "1"),
    "mg": ("milligram", "millistandard_gravity"),
    "ug": ("microgram", "microstandard_gravity"),
    "µg": ("microgram", "microstandard_gravity"),
    "μg": ("microgram", "microstandard_gravity"),
    "lb": ("pound", "force_pound"),
    "lbs": ("pound", "force_pound"),
    "oz": ("ounce", "force_ounce"),
    "fps": ("foot/second", "1/second"),
    "a": ("year", "ampere"),
}
"""Texts with two readings: one counts only where the other does not fit what is measured."""

ANGLES = ("radian", "degree", "turn", "revolutions_per_minute", "grade", "arcminute", "arcsecond")
"""Angles and rates of them: SI calls these plain numbers, as it does shares and counts, which are none."""

CYCLES = ("Hz", "kHz", "1/min", "min^-1", "cps")
"""What counts turns or events in a time: as a rate of an angle it may mean turns or radians."""

COMMON = frozenset(
    "s ms us µs μs ns min h V mV A mA N kN mm m cm m/s m/s^2 m/s² rad mrad rad/s deg ° deg/s °/s rpm Hz kHz Nm N.m N·m "
    "mNm Ncm % °C K Pa bar kg W ohm".split()
)
"""Texts that are units for certain: who asks no more of them need not wait for pint, which takes 0.3 s to load."""

SECONDS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Units of time that clocks count in, for the same reason."""

STRAIGHT = 1e-9
"""Part of a value by which a unit may miss a straight line: rounding (of decibels 0.04, of octaves 0.25)."""

_RATE = re.compile(r"ms(?:\^|\*\*)?[-\u2212\u207b](?P<power>[1-3\u00b9\u00b2\u00b3])")
_WORD = re.compile("[a-z]+|[a-z]?(?:[A-Z][a-z]{2,}|[A-Z]{3,})")
_EXPONENT = re.compile(r"(?<=[A-Za-z°µμΩ])([-\u2212]?[1-4])(?![\w.])")
_INERTIA = re.compile(r"\b(k?g)([cm]?m)(?:\^?2|²)")
_SCALE = re.compile(
    rf"(?<!\w)(?:(?i:deg(?:ree)?s?|grad)\.?|°|{'|'.join(DEGREES)})[ _]?"
    r"(?P<scale>(?i:[CFK]|Celsius|Fahrenheit|Kelvin))(?!\w)"
)
"""A degree beside the letter of a scale is one of temperature: nobody measures an angle times a charge."""
_HYPHEN = re.compile(r"(?<=[A-Za-z])-(?=[A-Za-z])")


@functools.cache
def _registry() -> pint.UnitRegistry[Any]:
    """Return the one registry (pint takes a moment to load, so only where a unit is converted)."""
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry(autoconvert_offset_to_baseunit=True, on_redefinition="ignore")
    registry.define("tick = count")
    for name, meaning in WRITTEN.items():
        registry.define(f"{name} = {meaning}")
    return registry


def _readings(unit: str) -> tuple[str, ...]:
    """Return what a text may mean: one text for pint, or two."""
    text = unit.strip()
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1].strip()
    if (rate := _RATE.fullmatch(text)) is not None:  # m s-1 without its space, or one in a millisecond
        power = rate["power"].translate(RAISED)
        return f"m/s^{power}", f"1/ms^{power}"
    return AMBIGUOUS.get(text, (WHOLE.get(text, text),))


@functools.cache
def _parsed(text: str) -> Any:
    """Return the pint unit of a text with one reading."""
    if text in ("", "1", "-"):
        return _registry().dimensionless
    import pint

    for sign in "·⋅•\u00d7∙･・":
        text = text.replace(sign, "*")
    for sign in "º˚∘":  # rings that keyboards and fonts give for a degree
        text = text.replace(sign, "°")
    text = _SCALE.sub(lambda found: {"C": "degC", "F": "degF", "K": "K"}[found["scale"][0].upper()], text)
    plain = _INERTIA.sub(r"\1*\2^2", text.replace("\u2212", "-"))
    plain = _HYPHEN.sub("*", _EXPONENT.sub(r"^\1", plain))
    # a word of three letters or more is the same with capitals (RPM, Sec, mVolt); a short sign never is
    words = re.sub("[A-Za-z]+", lambda word: word[0].lower() if _WORD.fullmatch(word[0]) else word[0], plain)
    last: Exception | None = None
    for tried in dict.fromkeys((plain, words)):
        try:
            return _built(tried)
        except (pint.PintError, ValueError, TypeError, AttributeError, AssertionError, KeyError) as error:
            last = error
    raise InputError(
        "unknown unit",
        expected="a unit such as 'N m', 'Nm', 'rad/s', 'deg', 'rpm', 'V', 'm/s^2' or '1'",
        got=repr(text if len(text) <= LONGEST else f"{text[:LONGEST]}..."),
        remedy="write products with a space and quotients with '/'; counts and other plain numbers are in '1' "
        "(sysid: --unit NAME=1)",
    ) from last


def _built(text: str) -> Any:
    """Return the pint unit of a text."""
    registry, read = _registry(), factors(text)
    unit: Any = registry.dimensionless
    for name, power in read:
        meant = "degree" if name in DEGREES else ELSEWHERE.get(name, name)
        one = registry.parse_units(meant)
        for whole, _ in registry.Quantity(1.0, one).unit_items():
            prefix, root, _ = registry.parse_unit_name(whole)[0]
            if not is_known(prefix, root) or is_with_seconds(meant, registry.get_symbol(whole)):
                raise ValueError(name)
        if (len(read) > 1 or power != 1) and registry.Quantity(0.0, one).to_base_units().magnitude:
            one = registry.parse_units(f"delta_{one}")  # in a product a degree is a difference
        unit = unit * (one if power == 1 else one ** (int(power) if power.denominator == 1 else float(power)))
    return unit


def _parse(unit: str, target: Any = None) -> Any:
    """Return the pint unit of a text such as ``N m``, ``rad/s``, ``1``; of two readings the one that fits a target."""
    readings = _readings(unit)
    if len(readings) == 1:
        return _linear(readings[0])
    fitting = [
        text for text in readings if target is not None and _parsed(text).dimensionality == target.dimensionality
    ]
    if len(fitting) == 1:
        return _parsed(fitting[0])
    raise _two_readings(unit)


@functools.cache
def _linear(text: str) -> Any:
    """Return the pint unit of a text with one reading; refuse one of a logarithm, whose reference texts leave open.

    A decibel is ten times the logarithm of a power or twenty times that of an amplitude, dBu is of 1 uW or of 0.775 V.
    """
    parsed = _parsed(text)
    zero, one, two = (float(_registry().Quantity(value, parsed).to_base_units().magnitude) for value in (0.0, 1.0, 2.0))
    if abs(two - 2 * one + zero) > STRAIGHT * abs(two):
        raise InputError(
            f"the unit {text!r} counts a logarithm",
            expected="a unit that is proportional to what is measured, such as 'W' or 'V'",
            got=repr(text),
            remedy="convert the values before, or declare unit = '1' to keep the numbers as they are",
        )
    return parsed


def _two_readings(unit: str) -> InputError:
    """Return the refusal of a unit with two readings."""
    return InputError(
        f"the unit {unit.strip()!r} has two readings",
        expected=" or ".join(repr(text) for text in _readings(unit)),
        got=repr(unit),
        remedy="declare the one that is meant (unit = ... in a dataset.toml, or the title of the column; "
        "sysid: --unit NAME=UNIT)",
    )


def refuse_two_readings(unit: str) -> None:
    """Refuse a unit that means two things, where nothing says what is measured.

    Raises
    ------
    InputError
        With both.

    Examples
    --------
    >>> refuse_two_readings("V")
    >>> try:
    ...     refuse_two_readings("NM")
    ... except InputError as error:
    ...     print(error.expected)
    'N*m' or 'nanometer'
    """
    if len(_readings(unit)) > 1:
        raise _two_readings(unit)


def _is_angle(unit: Any) -> bool:
    """Return True if a unit is one of an angle or its rates, and of nothing else."""
    powers = {_root(name): power for name, power in _registry().Quantity(1.0, unit).unit_items()}
    found = [name for name in powers if name in ANGLES]
    return len(found) == 1 and powers[found[0]] == 1 and set(powers) <= {*ANGLES, "second", "minute", "hour"}


def _root(name: str) -> str:
    """Return the name of a unit without its prefix."""
    _, root, _ = _registry().parse_unit_name(name)[0]
    return WRITTEN.get(root, root)


def fits(unit: str, target: str) -> bool:
    """Return True if values in ``unit`` can be converted to ``target``.

    Examples
    --------
    >>> fits("deg", "rad"), fits("V", "rad")
    (True, False)
    """
    goal = _parse(target)
    return any(_parsed(text).dimensionality == goal.dimensionality for text in _readings(unit))


def factors_of(unit: str) -> dict[str, float]:
    """Return the units that a unit is a product of, without prefixes, with their powers.

    Examples
    --------
    >>> factors_of("Nmm"), factors_of("mV/krpm")
    ({'newton': 1.0, 'meter': 1.0}, {'volt': 1.0, 'revolutions_per_minute': -1.0})
    """
    registry, found = _registry(), dict[str, float]()
    for name, power in registry.Quantity(1.0, _parse(unit)).unit_items():
        for part, own in registry.Quantity(1.0, registry.parse_units(_root(name))).unit_items():
            root = _root(part)
            found[root] = found.get(root, 0.0) + float(str(own)) * float(str(power))
    return found


def is_unit(text: str) -> bool:
    """Return True if a text is a unit, be it one with two readings.

    Examples
    --------
    >>> is_unit("deg"), is_unit("theta")
    (True, False)
    """
    if text in COMMON:
        return True
    if text.count("[") != text.count("]"):  # a part of a title, which needs no library to tell it
        return False
    try:
        fits(text, "1")
    except InputError:
        return False
    return True


def convert(values: FloatArray, unit: str, target: str) -> FloatArray:
    """Return the values converted from one unit to another.

    Parameters
    ----------
    values : array
        Any shape, in ``unit``.
    unit, target : str
        Unit texts; ``"1"`` is dimensionless.

    Returns
    -------
    array
        A new float64 array in ``target``.

    Raises
    ------
    InputError
        If a unit is unknown or has two readings, or the two do not measure the same thing. A share, a count or a
        frequency is no angle, although SI calls all of them plain numbers.

    Notes
    -----
    What engineers write is read: ``Nm``, ``N.m``, ``N-m``, ``m/s2``, ``°/s``, ``RPM``, ``kgm2``.

    Examples
    --------
    >>> convert(np.array([180.0]), "deg", "rad").round(4).tolist()
    [3.1416]
    """
    values = np.array(values, dtype=float)
    if unit.strip() == target.strip():
        return values
    if target == "s" and unit in SECONDS:
        return values * SECONDS[unit]
    goal = _parse(target)
    if not any(_parsed(text).dimensionality == goal.dimensionality for text in _readings(unit)):
        raise _misfit(unit, target)
    source = _parse(unit, goal)
    if _is_angle(goal) and not _is_angle(source):
        _refuse_count(unit, target)
    return np.asarray(_registry().Quantity(values, source).to(goal).magnitude, dtype=float)


def told(values: T, unit: str, own: str, *, reading: bool = False) -> tuple[T, str]:
    """Return values in the user's own unit, and that unit; as they are where it is another quantity.

    Parameters
    ----------
    values : float or array
        Any shape, in ``unit``.
    unit, own : str
        Unit of the values, and that of the user.
    reading : bool
        True for what a sensor reads, which has the zero of its unit; a difference, an error or a noise has none.

    Examples
    --------
    >>> told(0.25, "m", "mm"), told(0.5, "K", "degC"), told(293.15, "K", "degC", reading=True)
    ((250.0, 'mm'), (0.5, 'degC'), (20.0, 'degC'))
    """
    try:
        meant = next(text for text in _readings(own) if fits(text, unit))
        found = convert(np.asarray(values, dtype=float), unit, meant)
        if not reading:
            found = found - convert(np.zeros(()), unit, meant)
    except (InputError, StopIteration):  # a count that was taken for an angle
        return values, unit
    return (found if isinstance(values, np.ndarray) else float(found)), own


def _misfit(unit: str, target: str) -> InputError:
    """Return the refusal of a unit that measures something else."""
    return InputError(
        "unit does not fit",
        expected=f"a unit that converts to {target!r}",
        got=repr(unit),
        remedy=f"correct the unit, or declare unit = {target!r} and a scale in a dataset.toml",
    )


def _refuse_count(unit: str, target: str) -> None:
    """Refuse shares, counts and frequencies where an angle is meant: pint would take one turn for one radian."""
    text = unit.strip()
    if text in CYCLES:
        raise InputError(
            f"the unit {text!r} has two readings",
            expected=f"turns ('turn/s', 'rpm') or radians ('rad/s'), for {target!r}",
            got=repr(unit),
            remedy="declare the one that is meant (unit = ... in a dataset.toml, or the title of the column)",
        )
    if not re.fullmatch(r"1?|-|1/s|s\^?-1|1/s\^?2|s\^?-2", text):
        raise _misfit(unit, target)


def base_units(unit: str) -> tuple[dict[str, float], float, float]:
    """Return a unit as powers of the SI base units and radian, with the factor and offset to them.

    Parameters
    ----------
    unit : str
        Unit text; a count or tick is dimensionless.

    Returns
    -------
    (dict, float, float)
        Powers by ``kg m s A K mol cd rad``, zero powers left out; ``base = factor * value + offset``.

    Examples
    --------
    >>> base_units("N m")
    ({'kg': 1, 'm': 2, 's': -2}, 1.0, 0.0)
    """
    registry = _registry()
    names = {
        "kilogram": "kg",
        "meter": "m",
        "second": "s",
        "ampere": "A",
        "kelvin": "K",
        "mole": "mol",
        "candela": "cd",
        "radian": "rad",
    }
    parsed = _parse(unit)
    based = registry.Quantity(1.0, parsed).to_base_units()
    offset = float(registry.Quantity(0.0, parsed).to_base_units().magnitude)
    powers = {names[name]: float(str(power)) for name, power in based.unit_items() if name in names}
    radians = float(str(dict(registry.Quantity(1.0, parsed).unit_items()).get("radian", 0)))
    if radians:
        powers["rad"] = radians
    whole = {name: int(power) if power == int(power) else power for name, power in powers.items()}
    return whole, float(based.magnitude) - offset, offset
