"""Units of effect parameters: a template such as ``F/v`` becomes ``N m s/rad`` on a coordinate in rad."""

from __future__ import annotations

import re
from collections.abc import Mapping

from harness.errors import InputError

_FACTOR = re.compile(r"^([^\d\s/()^*]+)(?:(?:\^|\*\*)(-?\d+))?$")


def tokens(text: str) -> dict[str, int]:
    """Return the factors of a unit text with their exponents.

    Raises InputError if the text cannot be read.

    - ``text``: products with spaces or ``*``, one or more quotients with ``/``, exponents with ``^`` or ``**``;
      parentheses only around a denominator

    Examples
    --------
    >>> tokens("N m s^2/rad")
    {'N': 1, 'm': 1, 's': 2, 'rad': -1}
    """
    result: dict[str, int] = {}
    parts = text.replace("·", " ").replace("**", "^").split("/")
    for position, part in enumerate(parts):
        sense = 1 if position == 0 else -1
        for word in part.replace("(", " ").replace(")", " ").replace("*", " ").split():
            if word == "1":
                continue
            match = _FACTOR.match(word)
            if match is None:
                raise InputError(
                    "unit of an effect parameter",
                    expected="factors such as 'N m', 's^2', '1/rad'",
                    got=repr(text),
                    remedy="write products with a space, quotients with '/', exponents with '^'",
                )
            result[match[1]] = result.get(match[1], 0) + sense * int(match[2] or 1)
    return {name: power for name, power in result.items() if power}


def fill(template: str, units: Mapping[str, str]) -> str:
    """Return the unit that a template stands for.

    - ``template``: unit text in which the names in ``units`` (``F``, ``q``, ``v``, ``u``, ``y``, ``x``, ``Q``) stand
      for the units of the port; other names stand for themselves
    - ``units``: unit text of each of these names at one port
    - returns it in the form that :mod:`harness.units` reads; a radian stays a radian

    Examples
    --------
    >>> fill("F/v", {"F": "N m", "v": "rad/s"})
    'N m s/rad'
    >>> fill("F/F", {"F": "N"}), fill("s", {})
    ('1', 's')
    """
    total: dict[str, int] = {}
    for name, power in tokens(template).items():
        for factor, exponent in tokens(units[name]).items() if name in units else [(name, 1)]:
            total[factor] = total.get(factor, 0) + power * exponent
    return _write(total)


def rate_unit(unit: str) -> str:
    """Return the unit of the rate of something in ``unit``.

    Examples
    --------
    >>> rate_unit("rad"), rate_unit("m")
    ('rad/s', 'm/s')
    """
    return fill("x/s", {"x": unit})


def _write(factors: Mapping[str, int]) -> str:
    """Return the text of a product of powers."""

    def text(name: str, power: int) -> str:
        return name if power == 1 else f"{name}^{power}"

    above = [text(name, power) for name, power in factors.items() if power > 0]
    below = [text(name, -power) for name, power in factors.items() if power < 0]
    if not below:
        return " ".join(above) or "1"
    return f"{' '.join(above) or '1'}/{below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"
