"""Values outside the bounds that a model declares: run as they are asked for, and said."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable

import numpy as np

__all__ = ["BoundsWarning", "outside", "say_beyond"]


class BoundsWarning(UserWarning):
    """A parameter was given a value outside the bounds that its model or its FMU declares; the run goes on."""


def outside(name: str, value: object, low: float, high: float, unit: str = "1") -> str | None:
    """Return what is to be said of a value outside its bounds; None inside them, or where it is no number.

    Parameters
    ----------
    name : str
        Of the parameter.
    value : number, or a sequence of them
        What it was given, in the unit of the bounds. Of a sequence the value that is farthest outside is named.
    low, high : float
        Bounds, infinite where there is none.
    unit : str
        Of all three.

    Examples
    --------
    >>> outside("J", -1.0, 0.0, 10.0, "kg m^2")
    'J = -1 kg m^2 is outside its bounds, 0 to 10 kg m^2'
    >>> outside("gain", [1.0, 7.0], -np.inf, 5.0), outside("J", 2.0, 0.0, 10.0)
    ('gain = 7 is outside its bounds, at most 5', None)
    """
    try:
        values = np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError):  # a text, or the name of an item
        return None
    beyond = np.maximum(low - values, values - high)
    if not beyond.size or not beyond.max() > 0.0:
        return None
    shown = "" if unit.strip() in ("", "1", "-") else f" {unit}"
    if np.isinf(low):
        bounds = f"at most {high:g}"
    elif np.isinf(high):
        bounds = f"at least {low:g}"
    else:
        bounds = f"{low:g} to {high:g}"
    return f"{name} = {values[int(beyond.argmax())]:g}{shown} is outside its bounds, {bounds}{shown}"


def say_beyond(texts: Iterable[str], note: Callable[[str], None] | None) -> None:
    """Say what :func:`outside` returned: to ``note``, or where there is none as :class:`BoundsWarning`."""
    for text in texts:
        if note is not None:
            note(text)
        else:
            warnings.warn(text, BoundsWarning, stacklevel=4)
