"""Parameters of a model: name, unit, start value, bounds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from harness.errors import InputError, unknown_name
from harness.units import behind

FAR = 100.0
"""Factor between a fitted parameter and its declared value from which both sides are said: a power of ten is a rough
declaration, and a unit wrong by 1000 moves some parameter by 1000 or its square; halfway, in powers of ten, is 100."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model.

    Parameters
    ----------
    name : str
        Unique within the model; an effect's parameter is called ``effect@port.name``.
    unit : str
        SI unit as text.
    value : float
        Nominal value, and where a fit starts.
    minimum, maximum : float
        Physical bounds, in ``unit``. A parameter with ``minimum >= 0`` is fitted through its logarithm.
    fixed : bool
        True for a value that is known (measured with a ruler or a scale) and not fitted.
    declared : bool
        False for a value that is a place to start from and says nothing of the size: coefficients of a black box.

    Raises
    ------
    InputError
        If the name is empty, or the value lies outside its bounds.

    Examples
    --------
    >>> Parameter("m", "kg", 2.0, minimum=0.0).positive
    True
    """

    name: str
    unit: str = "1"
    value: float = 1.0
    minimum: float = -np.inf
    maximum: float = np.inf
    fixed: bool = False
    declared: bool = field(default=True, repr=False)

    def __post_init__(self) -> None:
        if not self.name or not self.name.strip():
            raise InputError("a parameter without a name", expected="a name", got=repr(self.name), remedy="name it")
        for what in ("value", "minimum", "maximum"):
            object.__setattr__(self, what, float(getattr(self, what)))
        if not (np.isfinite(self.value) and self.minimum <= self.value <= self.maximum):
            raise InputError(
                f"value of parameter {self.name!r}",
                expected=f"a finite number in [{self.minimum:g}, {self.maximum:g}]",
                got=f"{self.value:g}",
                remedy="correct the value or its bounds",
            )

    @property
    def positive(self) -> bool:
        """True if the parameter cannot be negative, so that a fit works on its logarithm."""
        return self.minimum >= 0.0

    def __str__(self) -> str:
        return f"{self.name} = {self.value:g} {self.unit}"


def as_parameter(name: str, given: Any, *, minimum: float = -np.inf) -> Parameter:
    """Return a parameter from its compact form.

    Raises InputError if the compact form is none of these.

    - ``name``: its name
    - ``given``: a number is the value; a tuple is ``(unit, value[, minimum[, maximum]])``
    - ``minimum``: lower bound where none is given and the value lies above it; a value of 0 (an offset) may go either
      way

    Examples
    --------
    >>> as_parameter("m", ("kg", 2.0), minimum=0.0)
    Parameter(name='m', unit='kg', value=2.0, minimum=0.0, maximum=inf, fixed=False)
    """
    if isinstance(given, Parameter):
        if given.name != name:
            raise InputError(
                "name of a parameter", expected=repr(name), got=repr(given.name), remedy="use the same name twice"
            )
        return given
    if isinstance(given, int | float) and not isinstance(given, bool):
        return Parameter(name, value=float(given), minimum=minimum if given > minimum else -np.inf)
    if isinstance(given, tuple) and 2 <= len(given) <= 4 and isinstance(given[0], str):
        numbers = [float(number) for number in given[1:]]
        low = numbers[1] if len(numbers) > 1 else (minimum if numbers[0] > minimum else -np.inf)
        high = numbers[2] if len(numbers) > 2 else np.inf
        return Parameter(name, given[0], numbers[0], low, high)
    raise InputError(
        f"parameter {name!r}",
        expected="a Parameter, a number, or a tuple (unit, value[, minimum[, maximum]])",
        got=repr(given),
        remedy="write for example mass=('kg', 1.0)",
    )


GONE = 1e-7
"""Share of its declared value below which a parameter has vanished: what is not there has no unit that may be wrong."""


@dataclass(frozen=True)
class FarOff:
    """A fitted parameter that lies a factor from its declared value.

    Examples
    --------
    >>> str(FarOff("J", "kg m^2", 5e4, 0.1))
    'J = 5e+04 kg m^2 is 5e+05 times the declared 0.1'
    """

    name: str
    unit: str
    # In ``unit``
    value: float
    declared: float

    @property
    def ratio(self) -> float:
        """How many times the declared value it is, without its sign."""
        return abs(self.value / self.declared)

    def __str__(self) -> str:
        size = f"{self.value:.4g}{behind(self.unit)} is {self.ratio:.2g} times the declared {self.declared:g}"
        return f"{self.name} = {size}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {**asdict(self), "ratio": self.ratio}


def far_off(
    parameters: Iterable[Parameter],
    values: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]] | None = None,
    factor: float = FAR,
) -> tuple[FarOff, ...]:
    """Return the fitted parameters that lie a factor from their declared values.

    - ``parameters``: with the declared values; known ones and a declared 0 say nothing about the size
    - ``values``: the fitted values
    - ``intervals``: low and high where the data tell them: a large value counts only where its interval leaves the
      declared one out, a small one only where it is told within a power of ten, as a friction that is not there is no
      mistake

    Examples
    --------
    >>> [one.name for one in far_off([Parameter("J", "kg m^2", 0.1), Parameter("b", value=1.0)], {"J": 5e4, "b": 1e-6})]
    ['J']
    """
    found = []
    for one in parameters:
        if one.fixed or not one.declared or not one.value or one.name not in values:
            continue
        far = FarOff(one.name, one.unit, float(values[one.name]), one.value)
        low, high = (intervals or {}).get(one.name, (0.0, 0.0))
        within = one.name in (intervals or {}) and min(low, high) <= one.value <= max(low, high)
        if (far.ratio >= factor and not within) or (
            GONE < far.ratio <= 1 / factor and 0 < abs(high) < 10 * abs(low) and low * high > 0
        ):
            found.append(far)
    return tuple(found)


def said_far(far: Sequence[FarOff]) -> str:
    """Return in words what to check where parameters lie far from what was declared.

    Examples
    --------
    >>> said_far([FarOff("J", "kg m^2", 5e4, 0.1)])
    'check the units of the columns, time included: J = 5e+04 kg m^2 is 5e+05 times the declared 0.1'
    """
    return f"check the units of the columns, time included: {', '.join(map(str, far))}"


def defaults(parameters: Iterable[Parameter], given: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return the value of every parameter by name, those in ``given`` replaced.

    Raises InputError if ``given`` names a parameter that there is not, or holds a value that is not finite.

    Examples
    --------
    >>> defaults([Parameter("m", value=2.0), Parameter("k")], {"k": 3.0})
    {'m': 2.0, 'k': 3.0}
    """
    values = {parameter.name: parameter.value for parameter in parameters}
    for name, value in (given or {}).items():
        if name not in values:
            raise unknown_name("unknown parameter", name, values)
        if not np.isfinite(value):
            raise InputError(
                f"value of parameter {name!r}", expected="a finite number", got=repr(value), remedy="correct the value"
            )
        values[name] = float(value)
    return values
