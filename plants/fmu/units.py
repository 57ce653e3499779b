"""Units of an FMU: its own words and definitions, turned into SI once, at the border."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError

BASE = ("kg", "m", "s", "A", "K", "mol", "cd")
# exponents of kg m s A K mol cd; the first of two names with equal exponents is the one that is chosen
KNOWN: dict[str, tuple[int, ...]] = {
    "1": (0, 0, 0, 0, 0, 0, 0),
    "rad": (0, 0, 0, 0, 0, 0, 0),
    "m": (0, 1, 0, 0, 0, 0, 0),
    "s": (0, 0, 1, 0, 0, 0, 0),
    "kg": (1, 0, 0, 0, 0, 0, 0),
    "A": (0, 0, 0, 1, 0, 0, 0),
    "K": (0, 0, 0, 0, 1, 0, 0),
    "mol": (0, 0, 0, 0, 0, 1, 0),
    "1/s": (0, 0, -1, 0, 0, 0, 0),
    "Hz": (0, 0, -1, 0, 0, 0, 0),
    "rad/s": (0, 0, -1, 0, 0, 0, 0),
    "rad/s^2": (0, 0, -2, 0, 0, 0, 0),
    "m/s": (0, 1, -1, 0, 0, 0, 0),
    "m/s^2": (0, 1, -2, 0, 0, 0, 0),
    "m^2": (0, 2, 0, 0, 0, 0, 0),
    "m^3": (0, 3, 0, 0, 0, 0, 0),
    "m^3/s": (0, 3, -1, 0, 0, 0, 0),
    "kg/s": (1, 0, -1, 0, 0, 0, 0),
    "kg/m^3": (1, -3, 0, 0, 0, 0, 0),
    "kg m^2": (1, 2, 0, 0, 0, 0, 0),
    "N": (1, 1, -2, 0, 0, 0, 0),
    "N m": (1, 2, -2, 0, 0, 0, 0),
    "J": (1, 2, -2, 0, 0, 0, 0),
    "N m/rad": (1, 2, -2, 0, 0, 0, 0),
    "W": (1, 2, -3, 0, 0, 0, 0),
    "Pa": (1, -1, -2, 0, 0, 0, 0),
    "N/m": (1, 0, -2, 0, 0, 0, 0),
    "N s/m": (1, 0, -1, 0, 0, 0, 0),
    "N m s/rad": (1, 2, -1, 0, 0, 0, 0),
    "C": (0, 0, 1, 1, 0, 0, 0),
    "V": (1, 2, -3, -1, 0, 0, 0),
    "ohm": (1, 2, -3, -2, 0, 0, 0),
    "H": (1, 2, -2, -2, 0, 0, 0),
    "F": (-1, -2, 4, 2, 0, 0, 0),
    "N m/A": (1, 2, -2, -1, 0, 0, 0),
}


@dataclass(frozen=True)
class Conversion:
    """SI value = scale * value of the FMU + offset; ``complaint`` tells what is odd about the unit."""

    unit: str
    scale: float = 1.0
    offset: float = 0.0
    complaint: str | None = None


def si_conversion(text: str | None, definition: Any = None) -> Conversion:
    """Return the scale and the offset that turn values in a unit of an FMU into SI.

    - ``text``: as the variable or its type says it, e.g. ``"N.m"``.
    - ``definition``: the FMU's own definition by base units; it decides where there is one (FMI 2.0.5 sec. 2.2.2).

    Examples
    --------
    >>> si_conversion("N.m").unit, si_conversion("kg.m2").unit
    ('N m', 'kg m^2')
    >>> si_conversion("deg").unit, round(si_conversion("deg").scale, 6)
    ('rad', 0.017453)
    """
    if text is None or not text.strip():
        return Conversion("1")
    name = _spelled(text)
    base = None if definition is None else definition.baseUnit
    if base is None:
        return _by_name(name)
    powers = tuple(int(getattr(base, unit)) for unit in BASE)
    angle = int(base.rad)
    if base.factor == 1.0 and base.offset == 0.0:
        if KNOWN.get(name) == powers:
            return Conversion(name)
        unit = _composed(powers, angle)
        found = _by_name(name)
        if found.complaint is not None:  # a name of the FMU's own: its definition says what it is
            return Conversion(unit)
        if not _fits(name, unit):
            return Conversion(unit, complaint=f"unit {text!r} is declared as {unit!r}, which it is not")
        return Conversion(name if found.scale == 1.0 and found.offset == 0.0 else unit)
    return Conversion(_composed(powers, angle), float(base.factor), float(base.offset))


def _spelled(text: str) -> str:
    """Return Modelica's spelling (``N.m``, ``m/s2``) in ours (``N m``, ``m/s^2``)."""
    text = re.sub(r"(?<=[A-Za-z0-9)])\.(?=[A-Za-z(])", " ", text.strip())
    text = re.sub(r"(?<=[A-Za-z])(-?\d+)", r"^\1", text)
    return {"-": "1", "Ohm": "ohm", "degree": "deg"}.get(text, text.replace("**", "^"))


def _composed(powers: tuple[int, ...], angle: int) -> str:
    """Return the text of a product of base units."""
    names = [name for name, known in KNOWN.items() if known == powers]
    if angle:
        names = [name for name in names if "rad" in name] or names
    if names:
        return names[0]
    above = [f"{u}^{p}" if p > 1 else u for u, p in zip(BASE, powers, strict=True) if p > 0]
    below = [f"{u}^{-p}" if p < -1 else u for u, p in zip(BASE, powers, strict=True) if p < 0]
    return " ".join(above or ["1"]) + "".join(f"/{unit}" for unit in below)


def _fits(unit: str, target: str) -> bool:
    from harness.units import fits

    try:
        return fits(unit, target)
    except InputError:
        return False


def _by_name(name: str) -> Conversion:
    """Return the conversion of a unit that is known by its name only."""
    if name in KNOWN:
        return Conversion(name)
    from harness.units import convert, fits

    angular = re.search("deg|rad|rev|rpm|turn", name) is not None and not re.search("degC|degF", name)
    for target in sorted(KNOWN, key=lambda known: ("rad" in known) != angular):
        if _fits(name, target):
            zero, one = convert(np.array([0.0, 1.0]), name, target)
            scale = float(one - zero)
            if abs(scale - 1.0) < 1e-12 and zero == 0.0:
                return Conversion(name)
            return Conversion(target, scale, float(zero))
    try:
        fits(name, name)
    except InputError:
        return Conversion("1", complaint=f"unit {name!r} is unknown: its numbers are passed on as they are")
    return Conversion(name)
