"""The SI form of a unit text, for signals whose target unit no model prescribes."""

from __future__ import annotations

import functools

import numpy as np

from harness.errors import InputError
from harness.units import base_units, convert, factors_of, fits, refuse_two_readings
from harness.units.conversion import ANGLES
from harness.units.grammar import composed, factors

SI_UNITS = (
    *("rad", "rad/s", "rad/s^2", "m", "m/s", "m/s^2", "s", "kg", "N", "N m", "V", "A", "K", "Pa", "W", "J", "ohm"),
    *("farad", "H", "coulomb", "T", "S", "m^2", "m^3", "m^3/s", "kg/s", "kg m^2", "N/m", "N s/m", "V/s", "A/s", "K/s"),
    *("N/s", "N m/s", "mol", "mol/m^3", "kg/m^3", "cd", "lx"),
)
"""Units that a signal is stored in. Angles stand before plain numbers: degrees become radians, rpm becomes rad/s."""

ROTATIONS = SI_UNITS[:3]
_PLAIN = ("%", "percent", "ppm", "permille")


def si_unit(unit: str) -> str:
    """Return the SI unit that values in ``unit`` are converted to.

    A unit that is coherent with SI already keeps its own text, so counts stay counts.

    Parameters
    ----------
    unit : str
        Unit text such as ``"deg"``, ``"mV"`` or ``"N m"``.

    Raises
    ------
    InputError
        If the unit is unknown or has two readings.

    Examples
    --------
    >>> si_unit("deg"), si_unit("mV"), si_unit("rpm"), si_unit("tick/s"), si_unit("degC"), si_unit("%")
    ('rad', 'V', 'rad/s', 'tick/s', 'K', '1')
    >>> si_unit("kWh"), si_unit("ft lbf"), si_unit("V/krpm")
    ('J', 'N m', 'V s/rad')
    >>> si_unit("Hz"), si_unit("1/min"), si_unit("kHz"), si_unit("1/min^2"), si_unit("mV/V")
    ('Hz', '1/s', '1/s', '1/s^2', '1')
    """
    text = unit.strip()
    if text in ("", "1", "-") or text in SI_UNITS:
        return text if text in SI_UNITS else "1"
    if text.lower() in _PLAIN:
        return "1"
    refuse_two_readings(text)
    for candidate in _alike(text):
        if fits(text, candidate):
            try:
                zero, one = convert(np.array([0.0, 1.0]), text, candidate)
            except InputError:  # a count or a frequency, which is no angle
                powers, factor, _ = base_units(text)
                times = -powers.get("s", 0)
                return text if factor == 1.0 else "1/s" if times == 1 else f"1/s^{times}" if times else "1"
            return text if zero == 0.0 and one == 1.0 and candidate not in ROTATIONS else candidate
    return text if base_units(text)[1:] == (1.0, 0.0) else _composed(text)


def _alike(unit: str) -> list[str]:
    """Return the units of the list that may be meant, the likeliest first.

    SI makes the same of a torque and an energy, and of a stiffness with an angle and without: who names a force means
    the first, and an angle that is named stays.
    """
    angle, force = any(name in ANGLES for name in factors_of(unit)), _has_force(unit)
    found = [one for one in SI_UNITS if one in ROTATIONS or not angle]
    return sorted(found, key=lambda one: _has_force(one) != force)


@functools.cache
def _has_force(unit: str) -> bool:
    """Return True if a unit is a product with a force."""
    return any(fits(name, "N") for name in factors_of(unit))


def _composed(unit: str) -> str:
    """Return the SI unit of a product that is in no list."""
    powers: dict[str, float] = {}
    for name, power in factors_of(unit).items():
        if name not in ANGLES and fits(name, "1"):
            continue  # shares and counts
        whole = next((one for one in _alike(name) if fits(name, one)), None)
        parts = base_units(name)[0].items() if whole is None else factors(whole)
        for part, own in parts:
            powers[part] = powers.get(part, 0.0) + float(own) * power
    return composed(powers)
