"""Parameters of effects: unit, sign, bounds, and how a start value follows from the sizes of the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.effects.unit_templates import tokens

Sign = Literal["+", "-", "any"]
Role = Literal["", "phase", "frequency", "wave number", "instant", "step", "zero"]
_USUAL = {"dt": 0.01, "T": 10.0}


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Parameters
    ----------
    name : str
        Short and unique within the effect.
    unit : str
        Template: ``F`` stands for the unit of the force on the coordinate, ``q``, ``v`` and ``a`` for the coordinate,
        its rate and acceleration, ``u``, ``y`` and ``x`` for the input, output or process state; ``s``, ``rad``,
        ``1`` for themselves.
    scale : str
        Start value: a number and a template filled with the *sizes* of the data, e.g. ``"0.05 F"`` (5 % of the rms
        force) or ``"2 dt"`` (two samples; ``T`` is the record's length). A number alone is taken as it is.
    sign : {"+", "-", "any"}
        Sign that physics allows. The fit may cross it: an answer of the wrong sign is a reason to reject.
    minimum, maximum : float
        Bounds that the formula needs (fits take the logarithm where ``minimum >= 0``).
    neutral : float, optional
        Value at which the effect leaves the nominal as it is; None if no single parameter switches it off.
    main : bool
        The parameter whose interval must exclude ``neutral`` (0 where that is None) for the effect to be accepted.
    nuisance : bool
        Needed by the formula, not by the reader: smoothing widths, phases. Left free, because a fixed smoothing
        width turns Coulomb friction into Stribeck friction.
    fixed : bool
        Kept at its start value unless the user frees it.
    linear : bool
        The block's output is affine in it, with the others given.
    angle_only : bool
        Means something only on a coordinate in rad; fixed at its neutral value elsewhere.
    per_record : bool
        It belongs to a record, not to the plant (an instant, a phase of a line): refitted on every record.
    role : {"", "phase", "frequency", "wave number", "instant", "step", "zero"}
        What it is to its law, where fits and tests treat it by that: the ``phase`` of a wave whose amplitude is the
        main parameter, with its ``frequency`` over time or its ``wave number`` along a coordinate or a reading; the
        ``instant`` at which something happens once in a record; the ``step`` of a grid of readings; the ``zero`` of an
        instrument, which is set anew with every session.
    floor : str
        Lower bound that follows from the sizes of the data, written as ``scale`` is: what this motion could show.
    ceiling : str
        Upper bound of the same kind: a constant so fast that nothing in these samples could show it.
    grid : tuple of float
        Factors on the start value for several starts and for screens (local minima: gaps, change times, orders). A
        grid without 1 starts elsewhere than where the effect is simulated.
    refined : tuple of float
        Factors on the value of a special case of the law from which that is refined.
    meaning : str
        A few words for the report.
    """

    name: str
    unit: str = "1"
    scale: str = ""
    sign: Sign = "any"
    minimum: float = -np.inf
    maximum: float = np.inf
    neutral: float | None = None
    main: bool = False
    nuisance: bool = False
    fixed: bool = False
    linear: bool = False
    angle_only: bool = False
    per_record: bool = False
    role: Role = ""
    floor: str = ""
    ceiling: str = ""
    grid: tuple[float, ...] = (1.0,)
    refined: tuple[float, ...] = (1.0,)
    meaning: str = ""

    def start(self, sizes: Mapping[str, float]) -> float:
        """Return the start value for data of these sizes, within the bounds (those that they set included).

        Parameters
        ----------
        sizes : mapping
            Typical size (rms) of ``F``, ``q``, ``v``, ``a``, ``u``, ``y``, ``x`` at the port, sample time ``dt`` and
            length ``T`` [s]; a size that is missing or zero counts as 1, a missing time as 10 ms and 10 s.

        Examples
        --------
        >>> par("tau", "s", scale="2 dt", minimum=0.0).start({"dt": 0.01})
        0.02
        """
        value = _sized(self.scale or self._default_scale(), sizes)
        return float(np.clip(value, self.lowest(sizes, np.inf), self.highest(sizes, -np.inf)))

    def lowest(self, sizes: Mapping[str, float], value: float) -> float:
        """Return the lower bound for data of these sizes; never above a value that was given."""
        if not self.floor or not sizes:
            return self.minimum
        return float(max(self.minimum, min(_sized(self.floor, sizes), value, self.maximum)))

    def highest(self, sizes: Mapping[str, float], value: float) -> float:
        """Return the upper bound for data of these sizes; never below a value that was given."""
        if not self.ceiling or not sizes:
            return self.maximum
        return float(min(self.maximum, max(_sized(self.ceiling, sizes), value, self.minimum)))

    def starts(self, sizes: Mapping[str, float]) -> tuple[float, ...]:
        """Return the start values worth trying, the usual one first."""
        first = self.start(sizes)
        low, high = self.lowest(sizes, np.inf), self.highest(sizes, -np.inf)
        return tuple(dict.fromkeys(float(np.clip(first * factor, low, high)) for factor in self.grid))

    def _default_scale(self) -> str:
        """Return 5 % of what the unit stands for; two samples for a time."""
        if self.unit == "s":
            return "2 dt"
        sized = {
            name: power for name, power in tokens(self.unit).items() if name in ("F", "q", "v", "a", "u", "y", "x")
        }
        return " ".join(["0.05", *(f"{name}^{power}" for name, power in sized.items())])


def _sized(text: str, sizes: Mapping[str, float]) -> float:
    """Return a number times the sizes that a template names."""
    number, _, template = text.partition(" ")
    value = float(number)
    for name, power in tokens(template).items():
        size = float(sizes.get(name, _USUAL.get(name, 1.0)))
        value *= (size if np.isfinite(size) and size > 0 else 1.0) ** power
    return value


def par(name: str, unit: str = "1", **fields: Any) -> EffectParameter:
    """Return an :class:`EffectParameter`; the short name keeps dictionaries readable."""
    return EffectParameter(name, unit, **fields)
