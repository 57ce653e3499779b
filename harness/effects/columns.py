"""Columns for regression screens: the force that each effect would add along a recorded motion.

The equation residual of a system is ``r = M a - Q``. A missing effect shows in r, so its columns are what it adds to
``-r``: for parameters in which the effect is linear, their coefficients (at some values of the others); for an effect
that is linear in none, the whole force that it adds at some values (the coefficient sought is then 1).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.effects.along import Signals, along, arguments, down, rms
from harness.effects.claimed import SENSORS, ClaimedForce, claimable
from harness.effects.effect import Placed
from harness.effects.places import carried_load
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

_LARGEST_GRID = 12


@dataclass(frozen=True, eq=False)
class ColumnBlock:
    """The columns of one effect at one choice of its nonlinear parameters."""

    placed: Placed
    given: dict[str, float]  # Values of the parameters in which the effect is not linear, by short name
    names: tuple[str, ...]
    """Short names of the linear parameters, one for each column; ``("effect",)`` if there are none (coefficient 1)."""
    columns: FloatArray
    """Force on each coordinate (N, n, k), for a coefficient of 1, counted from where the effect does nothing."""


def motion_sizes(
    system: System, signals: Signals, parameters: Mapping[str, float] | None = None
) -> dict[str, dict[str, float]]:
    """Return the sizes of the data at every port, for start values.

    Parameters
    ----------
    system : harness.physics.System
    signals : Signals
    parameters : mapping, optional
        Values of the nominal parameters.

    Returns
    -------
    dict
        Port name to rms sizes ``F q v a u y dt T``, and ``L``, the force that a joint carries. The force on a
        coordinate is the rms of ``M a``, of the inputs' force, or of what the nominal adds besides (gravity, springs),
        whichever is largest. An input that drives a coordinate has its own rms as ``u`` and ``F``; a name used by
        several ports has the sizes of all of them.
    """
    import casadi as ca

    p, n = system.vector(parameters), len(system.coordinates)
    a = ca.SX.sym("a", n)
    parts = [ca.mtimes(system.mass_matrix, a), system.input_forces, system.generalized_forces - system.input_forces]
    terms = ca.Function("terms", [*arguments(system), a], [down(system, ca.vertcat(*parts))])
    forces = rms(along(terms, system, signals, p, None, signals.a)).reshape(3, n).max(axis=0)
    common = {"dt": signals.dt, "T": float(signals.t[-1] - signals.t[0] + signals.dt)}
    result: dict[str, dict[str, float]] = {"base": dict(common)}
    for column, channel in enumerate(system.inputs):
        size = float(rms(signals.u)[column])
        result.setdefault(channel.name, dict(common)).update(u=size, F=size)
    for row, coordinate in enumerate(system.coordinates):
        sizes = {name: float(rms(getattr(signals, name))[row]) for name in ("q", "v", "a")}
        result.setdefault(coordinate.name, dict(common)).update(F=float(forces[row]), **sizes)
        load = carried_load(system, coordinate.name)
        if load is not None:
            carried = ca.Function("load", arguments(system), [down(system, ca.SX(load))])
            result[coordinate.name]["L"] = float(rms(along(carried, system, signals, p, None))[0])
    for port in system.ports:
        if port.kind == "mass":
            result.setdefault(port.name, dict(common)).update(M=abs(float(p[system.parameter_names.index(port.name)])))
    outputs = ca.Function("h", arguments(system), [down(system, system.h)])
    values = rms(along(outputs, system, signals, p, None))
    for row, channel in enumerate(system.outputs):
        result.setdefault(channel.name, dict(common)).update(y=float(values[row]))
    return result


def column_blocks(
    system: System,
    placed: Placed,
    signals: Signals,
    *,
    parameters: Mapping[str, float] | None = None,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
) -> list[ColumnBlock]:
    """Return the columns of one effect along a motion, one block for each choice of its nonlinear parameters.

    Parameters
    ----------
    system : harness.physics.System
        The nominal, mechanical one.
    placed : Placed
        The effect and its port; its values, if any, replace the start values of the grid.
    signals : Signals
        The motion.
    parameters : mapping, optional
        Values of the nominal parameters (they matter where the effect works through them: gravity tilt, sensors).
    sizes : mapping, optional
        Sizes by port, from :func:`motion_sizes` if not given.

    Returns
    -------
    list of ColumnBlock
        Empty where a regression says nothing: resonances of hidden masses, rounding, rectified or saturated sensors,
        tanks, sensors of other things than coordinates. Hidden states are simulated along the motion from rest.

    Raises
    ------
    InputError
        If the effect does not fit its port.
    """
    if not claimable(system, placed):
        return []
    effect = placed.effect
    known = sizes if sizes is not None else motion_sizes(system, signals, parameters)
    at = known.get(placed.at, {})
    claimed = ClaimedForce(system, placed, at)
    if effect.name in SENSORS:  # of a small error: how the residual changes if it is undone
        name, neutral = effect.parameters[0].name, effect.parameters[0].neutral or 0.0
        unit = {"sensor_offset": 1e-3 * (at.get("y", 1.0) or 1.0), "sensor_gain": 1e-3, "sensor_delay": signals.dt}
        small = unit[effect.name]
        column = claimed(signals, {name: neutral + small}, parameters) / small
        return [ColumnBlock(placed, {}, (name,), column[..., None])]
    linear = [parameter.name for parameter in effect.parameters if parameter.linear and not parameter.fixed]
    nonlinear = [parameter for parameter in effect.parameters if parameter.name not in linear and not parameter.fixed]
    grids = [
        parameter.starts(at) if parameter.name not in placed.values else (claimed.start[parameter.name],)
        for parameter in nonlinear
    ]
    combinations = list(itertools.islice(itertools.product(*grids), _LARGEST_GRID))
    blocks = []
    for choice in combinations:
        given = dict(zip((parameter.name for parameter in nonlinear), choice, strict=True))
        if linear:
            nothing = {**given, **dict.fromkeys(linear, 0.0)}
            zero = 0.0 if _gone(placed, nothing, claimed.start) else claimed(signals, nothing, parameters)
            columns = [claimed(signals, {**nothing, name: 1.0}, parameters) - zero for name in linear]
        else:
            columns = [claimed(signals, given, parameters)]
        stack = np.stack(columns, axis=-1)
        if np.isfinite(stack).all():
            blocks.append(ColumnBlock(placed, given, tuple(linear) or ("effect",), stack))
    return blocks


def _gone(placed: Placed, nothing: Mapping[str, float], start: Mapping[str, float]) -> bool:
    """Return True if an effect is not there at some values: its force needs no look then."""
    values = {**start, **nothing}
    return placed.effect.vanishes and all(
        parameter.neutral is None or values[parameter.name] == parameter.neutral
        for parameter in placed.effect.parameters
    )
