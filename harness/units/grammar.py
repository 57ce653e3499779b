"""The grammar of a unit's text: names multiplied, divided and raised to small powers, and nothing else.

A text comes from anybody's file. It is read here, in bounded time, and pint is asked for one name at a time: its own
reading of a whole text computes what it finds, and 9^9^9 does not end.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from fractions import Fraction

LONGEST, DEEPEST, HIGHEST = 80, 4, 9
"""Characters, nested parentheses and size of an exponent that a unit may have: nothing that is measured needs more."""

_NUMBER = r"[-+]?\d{1,4}(?:\.\d{1,4})?(?![eE]?\d)"
_TOKEN = re.compile(
    r" *(?:(?P<name>Δ?°?[^\W\d_]\w*|[°%‰])|(?P<one>1(?:\.0*)?(?![\w.]))|(?P<sign>\*(?!\*)|[/.()])"
    rf"|(?:\^|\*\*) *(?:(?P<power>{_NUMBER})|[({{] *(?P<part>{_NUMBER}) *(?:/ *(?P<whole>\d{{1,4}}) *)?[)}}]))"
)
RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")  # Raised signs, and those that they stand for.
_WORDS = (
    (re.compile("[\t\u00a0\u2009\u202f]"), " "),
    (re.compile(r"\bper\b"), "/"),
    (re.compile(r"\b(?:square|sq) +(\w+)"), r"\1^2"),
    (re.compile(r"\bcubic +(\w+)"), r"\1^3"),
    (re.compile(r" squared\b"), "^2"),
    (re.compile(r" cubed\b"), "^3"),
)
"""What is said in words, and how the grammar writes it."""

Factors = list[tuple[str, Fraction]]


def behind(unit: str) -> str:
    """Return a unit as it stands behind a number: nothing for plain numbers.

    Examples
    --------
    >>> f"0.2{behind('N m')}", f"0.2{behind('1')}"
    ('0.2 N m', '0.2')
    """
    return "" if unit == "1" else f" {unit}"


def factors(text: str) -> Factors:
    """Return the names in a unit's text with their powers, in order; empty for ``1``.

    Raises ValueError if the text is anything else, longer than 80 characters, or has an exponent above 9.

    - ``text``: ``product = factor {["*" | "." | "/"] factor}``, ``factor = (name | "1" | "(" product ")") ["^"
      exponent]``. An exponent is a number or a fraction in parentheses, also as raised signs; ``**`` is ``^``.

    Examples
    --------
    >>> [(name, str(power)) for name, power in factors("kg m² / (s^2 K)^(1/2)")]
    [('kg', '1'), ('m', '2'), ('s', '-1'), ('K', '-1/2')]
    """
    if len(text) > LONGEST:
        raise ValueError("too long")
    for pattern, written in _WORDS:
        text = pattern.sub(written, text)
    text = re.sub("[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+", lambda found: f"^{found[0].translate(RAISED)} ", text).strip()
    tokens: list[re.Match[str]] = []
    place = 0
    while place < len(text):
        found = _TOKEN.match(text, place)
        if found is None:
            raise ValueError(f"character {place + 1}")
        tokens.append(found)
        place = found.end()
    result, left = _product(tokens, 0)
    if left:
        raise ValueError("a parenthesis too many")
    return result


def composed(powers: Mapping[str, float]) -> str:
    """Return the text of a product of units with their powers, in order; ``1`` where nothing is left.

    Examples
    --------
    >>> composed({"m": 1, "s": -2, "N": -1, "kg": 0}), composed({"s": 0.5})
    ('m/(s^2 N)', 's^0.5')
    """
    over, under = (
        [
            name if size == 1 else f"{name}^{float(size):g}"
            for name, power in powers.items()
            if (size := sign * power) > 0
        ]
        for sign in (1, -1)
    )
    below = f"/({' '.join(under)})" if len(under) > 1 else f"/{under[0]}" if under else ""
    return (" ".join(over) or "1") + below


def product(parts: Iterable[tuple[str, int]]) -> str:
    """Return the unit of a product of units, each with its power; what stands above and below goes out.

    Examples
    --------
    >>> product([("m/s", 2), ("N", 1)]), product([("m?", 1), ("s", -1)])
    ('m^2 N/s^2', '(m?)/(s)')
    """
    parts, powers = [(unit, power) for unit, power in parts if unit != "1" and power], dict[str, Fraction]()
    if len(parts) == 1 and parts[0][1] == 1:
        return parts[0][0]
    try:
        for unit, power in parts:
            for name, own in factors(unit):
                powers[name] = powers.get(name, Fraction(0)) + power * own
    except ValueError:  # such as a name with a sign of its own: nothing is reckoned
        over, under = (
            " ".join(f"({unit})" + f"^{sign * power}" * (sign * power > 1) for unit, power in parts if sign * power > 0)
            for sign in (1, -1)
        )
        return (over or "1") + f"/{under}" * bool(under)
    return composed({name: float(power) for name, power in powers.items()})


def quotient(unit: str, by: str) -> str:
    """Return the unit of a coefficient: of what it makes, over that of what it is multiplied by.

    Examples
    --------
    >>> quotient("rad", "m"), quotient("m/s", "m/s"), quotient("m", "1"), quotient("1/s^2", "1/s")
    ('rad/m', '1', 'm', '1/s')
    """
    return "1" if unit == by else product([(unit, 1), (by, -1)])


def _product(tokens: list[re.Match[str]], depth: int) -> tuple[Factors, list[re.Match[str]]]:
    """Return the factors of a product, and the tokens after it."""
    if depth > DEEPEST:
        raise ValueError("parentheses in parentheses")
    result, tokens = _factor(tokens, depth)
    while tokens and tokens[0]["sign"] != ")":
        over = tokens[0]["sign"] == "/"
        more, tokens = _factor(tokens[1:] if tokens[0]["sign"] in ("*", ".", "/") else tokens, depth)
        result = result + [(name, -power if over else power) for name, power in more]
    return result, tokens


def _factor(tokens: list[re.Match[str]], depth: int) -> tuple[Factors, list[re.Match[str]]]:
    """Return the factors of a name, a 1 or a parenthesis with its exponent, and the tokens after it."""
    if not tokens:
        raise ValueError("an end where a unit is expected")
    first, tokens = tokens[0], tokens[1:]
    if first["sign"] == "(":
        result, tokens = _product(tokens, depth + 1)
        if not tokens:
            raise ValueError("an open parenthesis")
        tokens = tokens[1:]
    elif first["name"] or first["one"]:
        result = [(first["name"], Fraction(1))] if first["name"] else []
    else:
        raise ValueError("a sign where a unit is expected")
    if tokens and (given := tokens[0]["power"] or tokens[0]["part"]):
        whole = int(tokens[0]["whole"] or 1)
        if not whole:
            raise ValueError("an exponent over 0")
        result = [(name, power * Fraction(given) / whole) for name, power in result]
        tokens = tokens[1:]
    if any(abs(power) > HIGHEST for _, power in result):
        raise ValueError("too high an exponent")
    return result, tokens
