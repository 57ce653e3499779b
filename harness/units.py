"""Units: converted once, at the border, with pint."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

if TYPE_CHECKING:
    import pint

__all__ = ["base_units", "convert", "fits"]


@functools.cache
def _registry() -> pint.UnitRegistry[Any]:
    """Return the one registry (pint takes a moment to load, so only where a unit is converted)."""
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("tick = count")
    return registry


def _parse(unit: str) -> Any:
    """Return the pint unit of a text such as ``N m``, ``rad/s``, ``1``."""
    text = unit.strip()
    if text in ("", "1", "-"):
        return _registry().dimensionless
    import pint

    try:
        return _registry().parse_units(text.replace("·", "*"))
    except (pint.PintError, ValueError, TypeError, AttributeError, AssertionError) as error:
        raise InputError(
            "unknown unit",
            expected="a unit such as 'N m', 'rad/s', 'V', 'm' or '1'",
            got=repr(unit),
            remedy="write products with a space and quotients with '/'",
        ) from error


def fits(unit: str, target: str) -> bool:
    """Return True if values in ``unit`` can be converted to ``target``.

    Examples
    --------
    >>> fits("deg", "rad"), fits("V", "rad")
    (True, False)
    """
    return bool(_parse(unit).dimensionality == _parse(target).dimensionality)


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
        If a unit is unknown or the two do not measure the same thing.

    Examples
    --------
    >>> convert(np.array([180.0]), "deg", "rad").round(4).tolist()
    [3.1416]
    """
    values = np.array(values, dtype=float)
    if unit.strip() == target.strip():
        return values
    source, goal = _parse(unit), _parse(target)
    if source.dimensionality != goal.dimensionality:
        raise InputError(
            "unit does not fit",
            expected=f"a unit that converts to {target!r}",
            got=repr(unit),
            remedy="correct the unit, or declare a scale into the right one",
        )
    return np.asarray(_registry().Quantity(values, source).to(goal).magnitude, dtype=float)


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
