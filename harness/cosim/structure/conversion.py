"""What happens to a number on its way between connectors: units, linear transformations, tables of values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from harness.errors import InputError
from harness.units import base_units

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")  # Base units of SSP and FMI (SSP 2.0 sec. BaseUnit).
BARE = ("", "1", "-")  # Units of a bare number, which is taken for what the other end of a connection measures.
ROUNDING = 8 * 2.0**-52  # A factor this close to one came out of unit factors that cancel.


@dataclass(frozen=True)
class Unit:
    """A unit of a file: ``SI = factor * number + offset``, and the SI unit's text; ``powers`` leave the radian out."""

    text: str
    si: str
    factor: float = 1.0
    offset: float = 0.0
    powers: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        return self.text if self.text == self.si else f"{self.text} ({self.factor:g} {self.si})"

    @property
    def to_si(self) -> LinearConversion:
        """The way from a number in this unit to SI."""
        return LinearConversion(self.factor, self.offset)

    @property
    def from_si(self) -> LinearConversion:
        """The way from SI to a number in this unit."""
        return LinearConversion(1.0 / self.factor, -self.offset / self.factor)

    def same_as(self, other: Unit) -> bool:
        """Return True if a number means the same in both."""
        return (self.factor, self.offset, self.powers) == (other.factor, other.offset, other.powers)


def unit_of(text: str, powers: Mapping[str, float], factor: float, offset: float) -> Unit:
    """Return a unit that a file defines by base units.

    Examples
    --------
    >>> unit_of("degC", {"K": 1}, 1.0, 273.15).si, unit_of("rpm", {"rad": 1, "s": -1}, 0.1047, 0.0).si
    ('K', 'rad/s')
    """
    above = [_power(name, powers.get(name, 0)) for name in BASE if powers.get(name, 0) > 0]
    below = [_power(name, -powers.get(name, 0)) for name in BASE if powers.get(name, 0) < 0]
    si = "*".join(above) or "1"
    if below:
        si = f"{si}/{below[0]}" if len(below) == 1 else f"{si}/({'*'.join(below)})"
    if factor == 1.0 and offset == 0.0 and _known(text, powers):
        si = text.replace(".", " ")
    return Unit(text, si, factor, offset, _without_angle(powers))


def named_unit(text: str, si: str, factor: float, offset: float) -> Unit | None:
    """Return a unit by the text of its SI unit; None for a bare number, or where the text says nothing."""
    if si == "1" and factor == 1.0 and offset == 0.0:
        return None
    try:
        powers, _, _ = base_units(si)
    except InputError:
        return None
    return Unit(text, si, factor, offset, _without_angle(powers))


def undefined_unit(text: str) -> Unit | None:
    """Return a unit that a file uses and does not define, by its name; None where the name says nothing."""
    if text.strip() in BARE:
        return None
    try:
        powers, factor, offset = base_units(text.replace(".", " "))
    except InputError:
        return None
    return unit_of(text, powers, factor, offset)


def _power(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:g}"


def _without_angle(powers: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return powers to compare by: a radian is a number (FMI 2.0.5 sec. 2.2.2)."""
    return tuple((name, float(powers[name])) for name in BASE if name != "rad" and powers.get(name, 0))


def _known(text: str, powers: Mapping[str, float]) -> bool:
    """Return True if our own reading of a unit's name is what the file defines."""
    try:
        found, factor, offset = base_units(text.replace(".", " "))
    except InputError:
        return False
    return _without_angle(found) == _without_angle(powers) and factor == 1.0 and offset == 0.0


def change_of_unit(source: Unit, target: Unit) -> LinearConversion | None:
    """Return the way from a number in one unit to a number in another; None where they measure different things.

    Examples
    --------
    >>> celsius, kelvin = unit_of("degC", {"K": 1}, 1.0, 273.15), unit_of("K", {"K": 1}, 1.0, 0.0)
    >>> change_of_unit(celsius, kelvin)
    LinearConversion(factor=1.0, offset=273.15)
    >>> change_of_unit(unit_of("m", {"m": 1}, 1.0, 0.0), kelvin) is None
    True
    """
    if source.same_as(target) or (source.text, source.factor, source.offset) == (
        target.text,
        target.factor,
        target.offset,
    ):  # one name and one factor is one unit, even where a file gets its powers wrong
        return LinearConversion()
    if source.powers != target.powers:
        return None
    return LinearConversion(source.factor / target.factor, (source.offset - target.offset) / target.factor)


@dataclass(frozen=True)
class LinearConversion:
    """``factor * x + offset``."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, x: float) -> float:
        """Return the number after it."""
        return self.factor * x + self.offset


@dataclass(frozen=True)
class IntegerConversion:
    """Some whole numbers become others; all others stay (SSP 2.0, IntegerMappingTransformation)."""

    entries: tuple[tuple[float, float], ...]
    _found: dict[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_found", dict(self.entries))

    def __call__(self, x: float) -> float:
        """Return the number after it."""
        return self._found.get(x, x)


@dataclass(frozen=True)
class Chain:
    """What is done to a number one after another; neighbouring linear steps are one.

    Examples
    --------
    >>> chain = Chain().then(LinearConversion(2.0, 1.0)).then(LinearConversion(0.5, 0.0))
    >>> chain.linear, chain(4.0)
    (LinearConversion(factor=1.0, offset=0.5), 4.5)
    >>> Chain().then(IntegerConversion(((1.0, 7.0),))).linear is None
    True
    """

    steps: tuple[LinearConversion | IntegerConversion, ...] = ()

    def then(self, step: LinearConversion | IntegerConversion) -> Chain:
        """Return the chain with one more step."""
        if step == LinearConversion():
            return self
        last = self.steps[-1] if self.steps else None
        if not isinstance(step, LinearConversion) or not isinstance(last, LinearConversion):
            return Chain((*self.steps, step))
        factor, offset = step.factor * last.factor, step.factor * last.offset + step.offset
        size = abs(step.factor * last.offset) + abs(step.offset)
        if abs(factor - 1.0) < ROUNDING:
            factor = 1.0
        if abs(offset) < ROUNDING * size:
            offset = 0.0
        before = self.steps[:-1]
        return Chain(before if (factor, offset) == (1.0, 0.0) else (*before, LinearConversion(factor, offset)))

    @property
    def linear(self) -> LinearConversion | None:
        """The whole as one linear step, where it is one."""
        if not self.steps:
            return LinearConversion()
        only = self.steps[0]
        return only if len(self.steps) == 1 and isinstance(only, LinearConversion) else None

    def __call__(self, x: float) -> float:
        """Return the number after all of it."""
        for step in self.steps:
            x = step(x)
        return x
