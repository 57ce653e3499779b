"""Effects and a system: where an effect fits, and the system that has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.effects.effect import Placed, port_units, unit_of
from harness.effects.places import carried_load, measured_temperature, port_of, unforced
from harness.errors import InputError

if TYPE_CHECKING:
    from harness.physics.compiled.system import Port, System
    from harness.signals import FloatArray

_LARGEST_SUBSTEPS = 64
FOLLOWED, _STABLE = 1.4, 2.5
"""Eigenvalue times a step: what is followed, half of what the method of order 4 endures (2.78), and what is stable."""


def compose(
    system: System,
    placed: Sequence[Placed],
    *,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
) -> System:
    """Return the system with effects built in.

    Parameters
    ----------
    system : harness.physics.System
        A nominal system, or one that has effects already: the new ones come after these.
    placed : sequence of Placed
        Input effects act on the command in this order, then force effects (transmissions last, so that the others see
        the motor's side), then output effects in this order, but what cuts a reading off (``cuts``) after what bends
        it. Delays and rounding are carried out on samples.
    sizes : mapping, optional
        Sizes of the data by port (``str(placed)``, ``placed.at`` or ``""`` for all), for start values that are not
        given; see :meth:`harness.effects.EffectParameter.start`.

    Returns
    -------
    harness.physics.System
        Its parameters are the nominal ones and ``effect@port.name``; its states end with the hidden ones.

    Raises
    ------
    InputError
        If an effect does not fit its port, stands there twice, or a value is out of bounds.

    Examples
    --------
    >>> from harness.effects import builtin
    >>> from harness.physics.models import pendulum
    >>> dry = compose(pendulum().system(), [Placed(builtin()["coulomb_friction"], "theta", {"Fc": 0.1, "w": 0.01})])
    >>> dry.parameter("coulomb_friction@theta.Fc")
    Parameter(name='coulomb_friction@theta.Fc', unit='N m', value=0.1, minimum=-inf, maximum=inf, fixed=False)
    """
    wanted = [*system.effects, *placed]
    _refuse_twice(wanted)
    nominal = system if system.nominal is None else system.nominal
    known = {parameter.name: parameter for parameter in system.parameters}
    result = nominal.with_parameters({parameter.name: known[parameter.name] for parameter in nominal.parameters})
    for effect in _placing_order(result, wanted):
        result = _place(result, effect, _sizes(effect, sizes), nominal)
    kept = {parameter.name: known[parameter.name] for parameter in result.parameters if parameter.name in known}
    return replace(result.with_parameters(kept), effects=tuple(wanted), nominal=nominal)


def recommended_substeps(
    system: System, parameters: Mapping[str, float] | None, dt: float, *, x: FloatArray | None = None
) -> int:
    """Return the number of Runge-Kutta steps in a sample time that follow the fastest motion.

    Parameters
    ----------
    system : harness.physics.System
    parameters : mapping, optional
        Values, the system's own where not given.
    dt : float
        Sample time [s].
    x : array (nx,) or (K, nx), optional
        States to look at, beside rest, such as :func:`moving`: a sign is steepest at zero speed, a contact is stiff
        where it is closed, and what slips within a short length does so the faster the faster the joint turns.

    Returns
    -------
    int
        So that the fastest eigenvalue times a step stays below 1.4 at rest (half of what RK4 endures), and below 2.5
        in the states ``x``, where what slips has done so before: there it need not be followed. Where a force takes
        the sign of a speed, steps near zero are divided by themselves (``System.switches``). At most 64.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> recommended_substeps(pendulum().system(), None, 0.01)
    1
    """
    from harness.physics.compiled.ccode import FINE, without_signs

    p = system.vector(parameters)
    points = [np.zeros(system.nx)]
    hidden = system.nx - system.hidden_count
    for placed in system.effects:
        gap = system.values(parameters).get(placed.name("gap"))
        if gap is not None and "e" in placed.effect.states:  # the contact must be looked at closed
            closed = np.zeros(system.nx)
            names = [channel.name for channel in system.states]
            closed[names.index(placed.name("e"), hidden)] = 2.0 * gap
            points.append(closed)
    rests = len(points)
    if x is not None:
        points.extend(np.atleast_2d(np.asarray(x, dtype=float)))

    smooth = without_signs(system, p)
    needed = 1.0
    for number, point in enumerate(points):
        rate = _fastest(system, point, p)
        if number < rests and system.switches:
            rate = max(_fastest(system, point, smooth), rate / FINE)
        needed = max(needed, rate * dt / (FOLLOWED if number < rests else _STABLE))
    return int(np.clip(np.ceil(needed), 1, _LARGEST_SUBSTEPS))


def fastest_at_rest(system: System, parameters: Mapping[str, float] | None, dt: float) -> float:
    """Return the largest eigenvalue of a system at rest times a sample time, where no force takes the sign of a speed.

    Parameters are those of :func:`recommended_substeps`.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> round(fastest_at_rest(pendulum().system(), None, 0.01), 3)
    0.032
    """
    from harness.physics.compiled.ccode import without_signs

    return dt * _fastest(system, np.zeros(system.nx), without_signs(system, system.vector(parameters)))


def _fastest(system: System, x: FloatArray, p: FloatArray) -> float:
    """Return the largest eigenvalue [1/s] in a state; 0 where it is not finite."""
    import casadi as ca

    jacobian = system.__dict__.get("_jacobian_function")
    if jacobian is None:
        jacobian = ca.Function("A", [system.x, system.u, system.p, system.t], [ca.jacobian(system.f, system.x)])
        system.__dict__["_jacobian_function"] = jacobian
    matrix = jacobian(x, np.zeros(system.nu), p, 0.0).full()
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0)) if np.isfinite(matrix).all() else 0.0


def moving(system: System, sizes: Mapping[str, Mapping[str, float]]) -> FloatArray:
    """Return the state in which every coordinate moves at three times its rms speed, (nx,); 0 where none is known.

    Parameters
    ----------
    system : harness.physics.System
    sizes : mapping
        Port name to rms sizes, of which ``v`` is taken, see :func:`harness.effects.columns.motion_sizes`.
    """
    x = np.zeros(system.nx)
    for coordinate in system.coordinates:
        x[coordinate.v] = 3.0 * sizes.get(coordinate.name, {}).get("v", 0.0)
    return x


# ---- placing one effect ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Symbols:
    """Symbols of one placed effect: its parameters with what is declared about them, and its hidden states."""

    declared: list[tuple[Any, Any]]
    values: dict[str, Any]
    states: list[Any]


def _place(system: System, placed: Placed, sizes: Mapping[str, float], nominal: System) -> System:
    """Return the system with one more effect."""
    port = port_of(system, placed)
    made = _symbols(system, placed, port, sizes)
    if placed.effect.sampled:
        return _place_sampled(system, placed, port, made)
    if port.kind == "coordinate":
        return _place_force(system, placed, port, made, nominal)
    return {
        "input": _place_input,
        "output": _place_output,
        "base": _place_base,
        "process": _place_process,
        "mass": _place_mass,
    }[port.kind](system, placed, port, made)


def _symbols(system: System, placed: Placed, port: Port, sizes: Mapping[str, float]) -> _Symbols:
    """Return fresh symbols for an effect's parameters and hidden states."""
    import casadi as ca

    from harness.physics.definition.parameters import Parameter

    units = _units(system, port)
    values = placed.effect.complete(placed.values, sizes)
    declared, named = [], {}
    for parameter in placed.effect.parameters:
        symbol = ca.SX.sym(placed.name(parameter.name))
        fixed, value = parameter.fixed, values[parameter.name]
        if parameter.angle_only and port.unit != "rad":
            fixed, value = True, parameter.neutral or 0.0
        name, unit = placed.name(parameter.name), unit_of(parameter.unit, units)
        low, high = parameter.lowest(sizes, value), parameter.highest(sizes, value)
        declared.append((Parameter(name, unit, value, low, high, fixed), symbol))
        named[parameter.name] = symbol
    return _Symbols(declared, named, [ca.SX.sym(placed.name(name)) for name in placed.effect.states])


def _hidden(
    system: System, placed: Placed, port: Port, made: _Symbols, derivatives: Sequence[Any], context: Mapping[str, Any]
) -> list[Any]:
    """Return the hidden states of an effect as the system wants them."""
    from harness.physics.compiled.system import Hidden
    from harness.signals import Channel

    units, effect, found = _units(system, port), placed.effect, []
    for name, unit, symbol, derivative in zip(effect.states, effect.state_units, made.states, derivatives, strict=True):
        initial = context[effect.initial[name]] if name in effect.initial else None
        found.append(Hidden(Channel(placed.name(name), unit_of(unit, units)), symbol, derivative, initial))
    return found


def _place_input(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Put a block before an input."""
    signal = system.u[[channel.name for channel in system.inputs].index(port.name)]
    row = system.driven_by(port.name)
    q, v = (0.0, 0.0) if row is None else _motion(system, system.coordinates[row].name)
    heat = measured_temperature(system)
    value, derivatives = placed.effect.evaluate(
        signal, made.states, made.values, q, v, t=system.t, a=0.0, load=0.0, temperature=heat
    )
    if "coordinate" in placed.effect.kinds:
        value = signal + value
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": signal, "q": q, "v": v})
    return system.rebuild(inputs={port.name: value}, states=hidden, parameters=made.declared)


def _place_force(system: System, placed: Placed, port: Port, made: _Symbols, nominal: System) -> System:
    """Add a force to a coordinate; what it takes in proportion to the acceleration joins the mass matrix."""
    import casadi as ca

    row = system.coordinate(port.name).force
    q, v = _motion(system, port.name)
    signal, a = system.input_forces[row], ca.SX.sym("a")
    load = carried_load(system, port.name)
    asks = {"damping", "pull"} & set(placed.effect.extras)
    damping, pull = unforced(nominal, port.name) if asks else (0.0, 0.0)
    value, derivatives = placed.effect.evaluate(
        signal,
        made.states,
        made.values,
        q,
        v,
        t=system.t,
        a=a,
        load=0.0 if load is None else load,
        damping=damping,
        pull=pull,
        temperature=measured_temperature(system),
    )
    value, mass = ca.SX(value), None
    if ca.depends_on(value, a):
        share = ca.jacobian(value, a)
        if ca.depends_on(share, a):
            raise InputError(
                f"effect {placed.effect.name}",
                expected="a force that is linear in the acceleration a",
                got="a nonlinear one",
                remedy="write it with a to the first power only",
            )
        mass = ca.SX.zeros(*system.mass_matrix.shape)
        mass[row, row] = -share
        value = ca.substitute(value, a, 0.0)
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": signal, "q": q, "v": v})
    # a nuisance parameter that is a speed is the width over which a sign of v is smoothed
    widths = [
        placed.name(parameter.name)
        for parameter in placed.effect.parameters
        if parameter.nuisance and parameter.unit == "v"
    ]
    switches = [(system.coordinate(port.name).v, name) for name in widths]
    return system.rebuild(
        forces={port.name: value},
        mass=mass,
        states=hidden,
        parameters=made.declared,
        switches=switches,
        corners=placed.effect.corners_at(made.values, q),
    )


def _place_output(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Put a block behind an output."""
    signal = system.h[[channel.name for channel in system.outputs].index(port.name)]
    coordinate = any(candidate.name == port.name for candidate in system.coordinates)
    q, v = _motion(system, port.name) if coordinate else (signal, 0.0)
    value, derivatives = placed.effect.evaluate(signal, made.states, made.values, q, v, t=system.t, a=0.0, load=0.0)
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": signal, "q": q, "v": v})
    return system.rebuild(outputs={port.name: value}, states=hidden, parameters=made.declared)


def _place_base(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Turn gravity."""
    gravity = (system.gravity[0], system.gravity[1])
    turned, derivatives = placed.effect.evaluate(
        gravity, made.states, made.values, 0.0, 0.0, t=system.t, a=0.0, load=0.0
    )
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": 0.0, "q": 0.0, "v": 0.0})
    return system.rebuild(gravity=turned, states=hidden, parameters=made.declared)


def _place_mass(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Put another mass in the place of one that moves with several coordinates."""
    mass = system.p[system.parameter_names.index(port.name)]
    value, derivatives = placed.effect.evaluate(mass, made.states, made.values, 0.0, 0.0, t=system.t, a=0.0, load=0.0)
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": mass, "q": 0.0, "v": 0.0})
    return system.rebuild(parameters_as={port.name: value}, states=hidden, parameters=made.declared)


def _place_process(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Add to the rate of a process state, and to the next one's if the effect says so."""
    row = [channel.name for channel in system.states].index(port.name)
    rate, level = system.rates[row - 2 * len(system.coordinates)], system.x[row]
    value, derivatives = placed.effect.evaluate(rate, made.states, made.values, level, 0.0, t=system.t, a=0.0, load=0.0)
    rates = {port.name: value}
    if placed.effect.downstream:
        here, there = value
        rates = {port.name: here, system.process[system.process.index(port.name) + 1]: there}
    hidden = _hidden(system, placed, port, made, derivatives, {"signal": rate, "q": level, "v": 0.0})
    return system.rebuild(rates=rates, states=hidden, parameters=made.declared)


def _place_sampled(system: System, placed: Placed, port: Port, made: _Symbols) -> System:
    """Leave a block to the simulator, which works on samples."""
    from harness.physics.compiled.system import SampledBlock

    channels = system.inputs if port.kind == "input" else system.outputs
    index = [channel.name for channel in channels].index(port.name)
    name = placed.name(placed.effect.parameters[0].name)
    block = SampledBlock(placed.effect.sampled, index, name)  # type: ignore[arg-type]
    return system.rebuild(parameters=made.declared, sampled=[block])


# ---- helpers ---------------------------------------------------------------------------------------------------------


def _placing_order(system: System, placed: Sequence[Placed]) -> list[Placed]:
    """Return the order of substitution.

    An input effect reaches into all that was there before, so the one that acts first is placed last. Tanks are placed
    from the first one down, so that what spills counts in the next level.
    """
    kinds = [port_of(system, effect).kind for effect in placed]

    def those(kind: str) -> list[Placed]:
        return [effect for effect, its_kind in zip(placed, kinds, strict=True) if its_kind == kind]

    forces = sorted(those("coordinate"), key=lambda force: force.effect.drives)
    tanks = sorted(those("process"), key=lambda tank: system.process.index(tank.at))
    readings = sorted(those("output"), key=lambda reading: reading.effect.cuts)
    return [*those("mass"), *forces, *those("base"), *tanks, *reversed(those("input")), *readings]


def _refuse_twice(placed: Sequence[Placed]) -> None:
    """Raise if an effect stands twice at one port."""
    names = [str(effect) for effect in placed]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{name} is placed twice",
                expected="an effect once at a port",
                got=", ".join(names),
                remedy="remove one of them",
            )


def _sizes(placed: Placed, sizes: Mapping[str, Mapping[str, float]] | None) -> Mapping[str, float]:
    """Return the sizes that belong to one placed effect."""
    for key in (str(placed), placed.at, ""):
        if sizes is not None and key in sizes:
            return sizes[key]
    return {}


def _units(system: System, port: Port) -> dict[str, str]:
    """Return what the names in unit templates stand for at a port."""
    force = system.coordinate(port.name).force_unit if port.kind == "coordinate" else ""
    return port_units(port.kind, port.unit, force)


def _motion(system: System, name: str) -> tuple[Any, Any]:
    """Return the symbols of a coordinate and its rate."""
    coordinate = system.coordinate(name)
    return system.x[coordinate.q], system.x[coordinate.v]
