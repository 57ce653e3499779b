"""Where an effect fits: the ports of a system, and why one does not fit."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from harness.effects.effect import Effect, Placed
from harness.errors import InputError

if TYPE_CHECKING:
    from harness.physics.compiled.system import Port, System

_TEMPERATURES = {"K": 0.0, "degC": 273.15}
"""Units of an input that is a temperature, with what makes kelvins of it."""


def place_all(system: System, effects: Iterable[Effect] | None = None) -> list[Placed]:
    """Return every effect at every port of a system that it fits; where nothing turns, without what needs an angle.

    A law about a place is left out where nothing tells where the coordinate stands: it fits there, and any record would
    put it elsewhere.

    Parameters
    ----------
    system : harness.physics.System
    effects : iterable of Effect, optional
        The built-in dictionary if not given.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> [str(placed) for placed in place_all(pendulum().system()) if placed.at == "base"]
    ['gravity_tilt@base']
    """
    if effects is None:
        from harness.effects import builtin

        effects = builtin().values()
    found = []
    for effect in effects:
        for port in system.ports:
            if port.kind in effect.kinds and obstacle(system, effect, port) is None and _placed(system, effect, port):
                found.append(Placed(effect if port.unit == "rad" else _straight(effect), port.name))
    return found


@functools.cache
def _straight(effect: Effect) -> Effect:
    """Return an effect with the parameters that need an angle held where they do nothing."""
    if not any(parameter.angle_only for parameter in effect.parameters):
        return effect
    held = [
        replace(parameter, fixed=True, scale=f"{parameter.neutral or 0.0:g}") if parameter.angle_only else parameter
        for parameter in effect.parameters
    ]
    return replace(effect, parameters=tuple(held))


def fits(system: System, placed: Placed) -> bool:
    """Return True if an effect fits the port it is placed at."""
    return any(
        port.name == placed.at and port.kind in placed.effect.kinds and obstacle(system, placed.effect, port) is None
        for port in system.ports
    )


def port_of(system: System, placed: Placed) -> Port:
    """Return the port that an effect acts on, or refuse it with what it would fit.

    Raises
    ------
    InputError
        If there is no such port, or the effect does not fit it.
    """
    reasons = []
    for port in system.ports:
        if port.name == placed.at and port.kind in placed.effect.kinds:
            reason = obstacle(system, placed.effect, port)
            if reason is None:
                return port
            reasons.append(reason)
    where = [port.name for port in system.ports if fits(system, Placed(placed.effect, port.name))]
    raise InputError(
        f"{placed.effect.name} does not fit {placed.at!r} of {system.name}"
        + "".join(f" ({reason})" for reason in reasons),
        expected=f"one of {', '.join(dict.fromkeys(where))}" if where else "a model with such a port",
        got=repr(placed.at),
        remedy=f"write {placed.effect.name}@{where[0]}"
        if where
        else f"choose another effect: this one acts on {', '.join(placed.effect.kinds)}",
    )


def obstacle(system: System, effect: Effect, port: Port) -> str | None:
    """Return the reason why an effect of the right kind does not fit a port; None if it does."""
    if port.kind == "input" and "coordinate" in effect.kinds and system.driven_by(port.name) is not None:
        return "it acts on the coordinate that this input drives"
    if port.kind == "input" and "process" in effect.kinds and (fed := _fed_by(system, port.name)) is not None:
        return f"it acts on {fed}, which this input feeds"
    if port.kind in ("coordinate", "output") and effect.angles and port.unit != "rad":
        return "it needs an angle"
    if port.kind == "coordinate":
        if effect.drives and not _driven(system, port.name):
            return "no input drives this coordinate"
        if "load" in effect.extras and carried_load(system, port.name) is None:
            return "the joint carries no load"
    if "temperature" in effect.extras:
        if measured_temperature(system) is None:
            return "no temperature is measured: no input has the unit K or degC"
        if port.kind == "input" and (port.unit in _TEMPERATURES or system.driven_by(port.name) is None):
            return "it acts on the force of an input"
    if (missing := _missing(system, effect, port)) is not None:
        return missing
    if port.kind == "process" and effect.downstream and system.process[-1] == port.name:
        return "nothing lies downstream"
    return None


def _fed_by(system: System, name: str) -> str | None:
    """Return the first process state whose rate an input changes; None if there is none."""
    import casadi as ca

    if not system.process:
        return None
    column = system.u[[channel.name for channel in system.inputs].index(name)]
    states = [channel.name for channel in system.states]
    fed = (one for one in system.process if ca.depends_on(system.f[states.index(one)], column))
    return next(fed, None)


def _missing(system: System, effect: Effect, port: Port) -> str | None:
    """Return what the plant lacks about a port of what a law needs; None if it lacks nothing."""
    if "drive" in effect.needs and port.kind == "coordinate" and not _driven(system, port.name):
        return "no input drives this coordinate"
    if "drive" in effect.needs and port.kind == "input" and system.driven_by(port.name) is None:
        return "this input drives no coordinate"
    if "gravity" in effect.needs and not any(other.kind == "base" for other in system.ports):
        return "gravity does not act on the plant"
    if "alone" in effect.needs and len(system.coordinates) > 1:
        return "other coordinates move with it"
    if "astatic" in effect.needs and port.kind == "coordinate" and not _astatic(system, port.name):
        return "the model holds it somewhere: a force at rest depends on where it stands"
    if "temperature" in effect.needs and port.unit not in _TEMPERATURES:
        return "it is no temperature"
    return None


def measured_temperature(system: System) -> Any:
    """Return the first input that is a temperature, in kelvin; None if there is none."""
    for row, channel in enumerate(system.inputs):
        if channel.unit in _TEMPERATURES:
            return system.u[row] + _TEMPERATURES[channel.unit]
    return None


def _driven(system: System, name: str) -> bool:
    """Return True if an input's force acts on a coordinate."""
    import casadi as ca

    return bool(system.nu and ca.depends_on(system.input_forces[system.coordinate(name).force], system.u))


def _astatic(system: System, name: str) -> bool:
    """Return True if no force at rest depends on where a coordinate stands; False of an FMU, which does not tell."""
    import casadi as ca

    return system.h is not None and not ca.depends_on(unforced(system, name)[1], system.x[system.coordinate(name).q])


def _placed(system: System, effect: Effect, port: Port) -> bool:
    """Return True if a law finds its place: a reading, or a force of the plant, depends on where the coordinate stands.

    A car or a shaft that is read by its speed alone stands anywhere when a record begins.
    """
    import casadi as ca

    if "place" not in effect.needs or port.kind != "coordinate" or system.h is None:  # an FMU keeps its equations
        return True
    told = [system.h, system.f] if system.mass_matrix is None else [system.h, system.f, system.mass_matrix]
    place = system.x[system.coordinate(port.name).q]
    return bool(ca.depends_on(ca.vertcat(*(ca.vec(ca.SX(part)) for part in told)), place))


def carried_load(system: System, name: str) -> Any:
    """Return the force that the joint of a coordinate carries; None if there is none.

    A load that never changes cannot be told from Coulomb friction, so the input's force goes before it.
    """
    import casadi as ca

    row = system.coordinate(name).force
    carried = None if system.loads is None else ca.SX(system.loads[row])
    if carried is not None and (ca.depends_on(carried, system.x) or ca.depends_on(carried, system.u)):
        return carried
    if _driven(system, name):
        return system.input_forces[row]
    return None if carried is None or carried.is_zero() else carried


def unforced(system: System, name: str) -> tuple[Any, Any]:
    """Return the nominal forces on a coordinate that no input makes: what the speeds add, and what pulls at rest.

    - ``system``: the nominal system: what else brakes the joint is no part of its drive
    - ``name``: the coordinate
    """
    import casadi as ca

    force = system.generalized_forces[system.coordinate(name).force]
    still = [system.x[coordinate.v] for coordinate in system.coordinates]
    free = ca.substitute(force, system.u, ca.SX.zeros(*system.u.shape)) if system.nu else force
    pull = ca.substitute(free, ca.vertcat(*still), ca.SX.zeros(len(still)))
    return free - pull, pull
