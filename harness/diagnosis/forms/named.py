"""Values of a fit by name: initial states, what belongs to a record, what is told, and values within their bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY
from harness.diagnosis.systems import AnySystem
from harness.effects.effect import DRY, Placed
from harness.effects.parameter import Role
from harness.physics.compiled.kalman_pass import Pass
from harness.physics.fitting.maximum import LikelihoodFit, Point


def state_name(number: int, name: str) -> str:
    """Return the name of an initial state of a record, as :class:`Likelihood` has it."""
    return f"x0[{number}].{name}"


def state_values(passes: Pass, point: Point) -> dict[str, float]:
    """Return the initial states of all records by name."""
    return {
        state_name(number, name): float(value)
        for number, x0 in enumerate(point.x0)
        for name, value in zip(passes.state_names, x0, strict=True)
    }


def per_record(effects: Sequence[Placed], role: Role = "") -> list[str]:
    """Return the names of the parameters of effects that belong to a record, of one role if it is given."""
    return [
        placed.name(parameter.name)
        for placed in effects
        for parameter in placed.effect.parameters
        if parameter.per_record and role in ("", parameter.role)
    ]


def day_groups(effects: Sequence[Placed]) -> list[tuple[list[str], float]]:
    """Return what may be another one on another day, names that go together, with the standard deviation of its share.

    What the force of a law of dry friction is proportional to, and zeros of instruments, which may as well be none.
    """
    dry = [
        ([placed.name(parameter.name) for parameter in placed.effect.parameters if parameter.linear], POLICY.day)
        for placed in effects
        if placed.effect.whole == DRY
    ]
    zeros = [placed.name(zero.name) for placed in effects if (zero := placed.effect.parameter_of("zero")) is not None]
    return [*dry, *(([name], POLICY.zero) for name in zeros)]


def nuisances(effects: Sequence[Placed], fit: LikelihoodFit) -> list[str]:
    """Return the names of smoothing widths and the like of which the data say nothing."""
    names = [
        placed.name(parameter.name)
        for placed in effects
        for parameter in placed.effect.parameters
        if parameter.nuisance
    ]
    return [name for name in names if untold(name, fit)]


def untold(name: str, fit: LikelihoodFit) -> bool:
    """Return True for a parameter that lies on its bound, or whose logarithm is not known well enough to be told."""
    if name in fit.on_bound or name not in fit.names:
        return name in fit.on_bound
    return bool(fit.logarithmic[fit.names.index(name)]) and fit.deviation(name) > EFFORT.untold


def beside(effects: Sequence[Placed], fit: LikelihoodFit) -> dict[str, float]:
    """Return deviations of effects' parameters where nominal ones of which the records tell nothing are held."""
    own = {placed.name(parameter.name) for placed in effects for parameter in placed.effect.parameters}
    nominal = [name for name in fit.names if name in fit.system.parameter_names and name not in own]
    lost = {name for name in nominal if name in fit.undetermined or untold(name, fit)}
    return {name: fit.deviation_given(name, lost) for name in fit.names if lost and name in own}


def known(system: AnySystem, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of parameters that the system has."""
    names = set(system.parameter_names)
    return {name: value for name, value in values.items() if name in names}


def awake(system: AnySystem, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of all parameters, none that is fitted through its logarithm left at nothing.

    No derivative brings it back from there, and another law may need it: a lag that is missing leaves no friction.
    """
    declared = system.values()
    return {
        parameter.name: max(value, EFFORT.awake * declared[parameter.name]) if parameter.positive else value
        for parameter in system.parameters
        for value in (values.get(parameter.name, declared[parameter.name]),)
    }


def within(system: AnySystem, values: dict[str, float]) -> dict[str, float]:
    """Return values within the bounds."""
    return {
        parameter.name: float(np.clip(values[parameter.name], parameter.minimum, parameter.maximum))
        for parameter in system.parameters
    }
