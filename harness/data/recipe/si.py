"""The SI form of a unit text, for signals whose target unit no model prescribes."""

from __future__ import annotations

import numpy as np

from harness.errors import InputError
from harness.units import base_units, convert, fits, refuse_two_readings

__all__ = ["SI_UNITS", "si_unit"]

SI_UNITS = (
    *("rad", "rad/s", "rad/s^2", "m", "m/s", "m/s^2", "s", "kg", "N", "N m", "V", "A", "K", "Pa", "W", "J", "ohm"),
    *("farad", "H", "coulomb", "T", "S", "m^2", "m^3", "m^3/s", "kg/s", "kg m^2", "N/m", "N s/m", "V/s", "A/s", "K/s"),
    *("N/s", "N m/s", "mol", "mol/m^3", "kg/m^3", "cd", "lx"),
)
"""Units that a signal is stored in. Angles stand before plain numbers: degrees become radians, rpm becomes rad/s."""

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
        If the unit is unknown, has two readings, or no SI unit of the list measures the same thing.

    Examples
    --------
    >>> si_unit("deg"), si_unit("mV"), si_unit("rpm"), si_unit("tick/s"), si_unit("degC"), si_unit("%")
    ('rad', 'V', 'rad/s', 'tick/s', 'K', '1')
    >>> si_unit("Hz"), si_unit("1/min"), si_unit("kHz"), si_unit("1/min^2"), si_unit("mV/V")
    ('Hz', '1/s', '1/s', '1/s^2', '1')
    """
    text = unit.strip()
    if text in ("", "1", "-") or text in SI_UNITS:
        return text if text in SI_UNITS else "1"
    if text.lower() in _PLAIN:
        return "1"
    refuse_two_readings(text)
    for candidate in SI_UNITS:
        if fits(text, candidate):
            try:
                zero, one = convert(np.array([0.0, 1.0]), text, candidate)
            except InputError:  # a count or a frequency, which is no angle
                powers, factor, _ = base_units(text)
                times = -powers.get("s", 0)
                return text if factor == 1.0 else "1/s" if times == 1 else f"1/s^{times}" if times else "1"
            return text if zero == 0.0 and one == 1.0 and candidate not in SI_UNITS[:3] else candidate
    if base_units(text)[1:] == (1.0, 0.0):
        return text
    raise InputError(
        "unit without a known SI form",
        expected=f"a unit that converts to one of {', '.join(SI_UNITS)} or 1",
        got=repr(unit),
        remedy="declare the SI unit and a scale into it",
    )
