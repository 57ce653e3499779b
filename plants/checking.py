"""Checks of arguments that the engine plants share."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn, get_type_hints

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.options import instead, meant_options
from harness.signals import Channel, FloatArray, PlantSpec


def refuse_input(u: Any, spec: PlantSpec) -> NoReturn:
    """Raise the error that fits an input ``step`` could not take; called only after the fast check failed."""
    array = np.asarray(u, dtype=float)
    names = ", ".join(channel.name for channel in spec.inputs) or "none"
    if array.shape != (spec.nu,):
        raise InputError(
            "shape of the input",
            expected=f"({spec.nu},) for the inputs ({names})",
            got=str(array.shape),
            remedy="give one number for each input",
        )
    bad = int(np.argmax(~np.isfinite(array)))
    raise InputError(
        f"value of input {spec.inputs[bad].name!r}",
        expected="a finite number",
        got=str(array[bad]),
        remedy="check the controller or the excitation",
    )


def finite(values: FloatArray) -> bool:
    """Return True if every number of a short row is finite; faster than NumPy's for rows of a few numbers.

    A sum is finite only if every term is; where it is not, the terms may have been large, and are looked at one by one.

    Examples
    --------
    >>> import numpy as np
    >>> finite(np.array([1.0, -2.0])), finite(np.array([1.0, np.nan])), finite(np.array([1e300]))
    (True, False, True)
    >>> finite(np.array([1.7e308, 1.7e308])), finite(np.array([np.inf, -np.inf]))
    (True, False)
    """
    numbers = values.tolist()
    return math.isfinite(sum(numbers)) or all(map(math.isfinite, numbers))


def checked_inputs(inputs: FloatArray, spec: PlantSpec) -> FloatArray:
    """Return the inputs of a rollout as float64 (N, nu), or refuse them.

    Raises InputError if the shape is not (N, nu) or a value is not finite.
    """
    array = np.asarray(inputs, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != spec.nu:
        raise InputError(
            "shape of the inputs",
            expected=f"(N, {spec.nu})",
            got=str(array.shape),
            remedy="give one row for each step and one column for each input",
        )
    if not np.isfinite(array).all():
        row = int(np.argmax(~np.isfinite(array).all(axis=1)))
        raise InputError(
            "value in the inputs",
            expected="finite numbers",
            got=f"{array[row].tolist()} in row {row}",
            remedy="check the excitation",
        )
    return array


def initial_values(x0: Mapping[str, float] | None, states: Sequence[Channel], default: Sequence[float]) -> list[float]:
    """Return the initial states in order: the defaults, overwritten by name.

    Raises InputError if a name is unknown or a value is not finite.

    Examples
    --------
    >>> initial_values({"v": 2.0}, [Channel("x", "m"), Channel("v", "m/s")], [0.5, 0.0])
    [0.5, 2.0]
    """
    values = [float(value) for value in default]
    places = {channel.name: place for place, channel in enumerate(states)}
    refuse_unknown("unknown initial state", x0 or (), places, remedy="correct the name in x0")
    for name, value in (x0 or {}).items():
        if not math.isfinite(value):
            raise InputError(f"initial state {name!r}", expected="a finite number", got=str(value), remedy="correct x0")
        values[places[name]] = float(value)
    return values


def positive(name: str, value: float, *, zero: bool = False, infinite: bool = False) -> float:
    """Return a number that must be positive (or zero where that is allowed).

    Raises InputError if it is not.

    Examples
    --------
    >>> positive("mass", 2)
    2.0
    """
    number = float(value)
    low_enough = number >= 0 if zero else number > 0
    fine = low_enough and (infinite or math.isfinite(number))
    refuse_option(name, value, fine, "a number >= 0" if zero else "a positive number", f"correct {name}")
    return number


def positives(*, zero: bool = False, **values: float) -> dict[str, float]:
    """Return numbers by name that must all be :func:`positive`.

    Examples
    --------
    >>> positives(m=1, k=4.0) | positives(b=0, zero=True)
    {'m': 1.0, 'k': 4.0, 'b': 0.0}
    """
    return {name: positive(name, value, zero=zero) for name, value in values.items()}


def whole(name: str, value: float, least: int = 1) -> int:
    """Return a number that must be whole and not below ``least``; raises InputError if it is not."""
    refuse_option(name, value, int(value) == value and value >= least, f"an integer >= {least}")
    return int(value)


def probability(**values: float) -> None:
    """Refuse the first of some options by name that is no probability."""
    for name, value in values.items():
        refuse_option(name, value, 0 <= value <= 1, "a probability", f"correct {name}")


def refuse_option(name: str, value: Any, fine: bool, expected: str, remedy: str = "correct it") -> None:
    """Refuse the value of an option that is not ``fine``."""
    if not fine:
        raise InputError(f"option {name}", expected=expected, got=repr(value), remedy=remedy)


def per_item(name: str, value: float | Sequence[float], n: int, what: str) -> list[float]:
    """Return one number for each of ``n`` things, from one number for all or a sequence.

    Examples
    --------
    >>> per_item("joint_damping", 0.5, 2, "joints")
    [0.5, 0.5]
    """
    array = np.asarray(value, dtype=float)
    fine = array.shape in ((), (n,)) and bool(np.isfinite(array).all())
    refuse_option(name, value, fine, f"a finite number, or one for each of the {n} {what}", f"correct {name}")
    return [float(item) for item in np.broadcast_to(array, (n,))]


def checked_options(
    factory: str, maker: Callable[..., Any], defaults: Mapping[str, Any], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a factory's defaults overwritten by its options, refusing what ``maker`` does not know.

    Raises InputError if an option is unknown.
    """
    parameters = inspect.signature(maker).parameters.values()
    known = {p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)}
    unknown = sorted(set(options) - known)
    if unknown:
        raise InputError(
            f"options of {factory}",
            expected=f"options among {', '.join(sorted(known))}",
            got=", ".join(unknown),
            remedy=instead(unknown, known),
        )
    return {**defaults, **meant_options(factory, maker, options)}


def with_fields(options: type, *needed: str) -> inspect.Signature:
    """Return the signature of a plant that takes its options by name: the fields of a dataclass, keyword only.

    - ``options``: a dataclass whose fields all have defaults
    - ``needed``: names of arguments that come first and have no default

    Examples
    --------
    >>> @dataclasses.dataclass
    ... class Options:
    ...     mass: float = 1.0
    >>> print(with_fields(Options, "file"))
    (file, *, mass: float = 1.0)
    """
    hints = get_type_hints(options)
    first = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in needed]
    named = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in dataclasses.fields(options)
    ]
    return inspect.Signature([*first, *named])
