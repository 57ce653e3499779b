"""System: a continuous-time grey box as CasADi expressions, the common ground of models, effects, fits and exports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np

from harness.errors import InputError
from harness.physics.linear_solve import solve_symmetric
from harness.physics.parameters import Parameter, defaults
from harness.physics.ports import BodyTerm, Coordinate, Hidden, Port, SampledBlock
from harness.signals import Channel, FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.simulator import Backend, Simulator

__all__ = ["BodyTerm", "Coordinate", "Hidden", "Port", "SampledBlock", "System"]


@dataclass(frozen=True, eq=False)
class System:
    r"""A continuous-time grey box ``x' = f(x, u, p, t)``, ``y = h(x, u, p, t)``; nominal, or with effects built in.

    States are the coordinates q, their rates v, then the other states (of an ODE, or hidden ones of effects)::

        q' = v,   M(q, p, t) v' = Q(q, v, z, u, p, t),   z' = rates(x, u, p, t)

    Attributes
    ----------
    name : str
    inputs, outputs, states : tuple of Channel
    parameters : tuple of Parameter
        Nominal ones, then those of effects, called ``effect@port.name``.
    x, u, p, t : casadi.SX
        Symbols: columns of length nx, nu, np; time [s], a scalar.
    gravity : casadi.SX
        Symbol (2,): direction of gravity (horizontal, vertical), ``(0, -1)`` unless an effect turns it.
    mass_matrix : casadi.SX (n, n)
    generalized_forces : casadi.SX (n,)
        The whole right-hand side Q: inputs, friction, gravity, Coriolis terms.
    rates : casadi.SX (nx - 2 n,)
        Derivatives of the states that are not coordinates.
    h : casadi.SX (ny,)
    coordinates : tuple of Coordinate
    loads : casadi.SX (n,)
        Force that the guide of a coordinate carries across its motion (weight and centripetal part): what a
        load-dependent friction is proportional to. For a joint it is a moment, radius included.
    bodies : tuple of BodyTerm
    sampled : tuple of SampledBlock
        Delays and quantisers, carried out on samples.
    initial : casadi.SX (hidden_count,) or None
        Where the hidden states start; an expression in x, u and p.
    effects : tuple
        What :mod:`harness.effects` placed.
    mechanism : Mechanism or Ode
        The symbolic definition.
    hidden_count : int
        The last so many states were brought by effects.
    switches : tuple of (int, str)
        States through whose zero a force changes its sign, each with the parameter that smooths it: a step that comes
        near zero is taken in finer ones.
    process : tuple of str
        States that are levels, in the order in which they flow into each other.
    nominal : System or None
        Where effects were placed: the system without them.
    starts : callable or None
        Start values of parameters from records.

    Notes
    -----
    *How effects hook in* (:mod:`harness.effects.compose` does it). One call of :meth:`rebuild` places one effect, and
    calls are chained. ``rebuild`` first substitutes in every expression: ``inputs`` (what the dynamics see in place of
    u), ``parameters_as`` (an expression in place of a parameter: a payload that comes at t0), ``gravity``. Then it adds
    ``forces`` to the generalized forces of coordinates, ``mass`` to the mass matrix, ``rates`` to the derivatives of
    named states, replaces ``outputs``, and appends states and parameters. Because a substitution reaches into
    everything that was there before, several input effects are placed in *reverse* order of their action on the
    command (the one next to the plant first); force and output effects in the order of action.

    ``acceleration``, ``loads``, ``input_forces`` (the part of Q that comes from the inputs), ``bodies`` and
    ``h`` are ordinary expressions that an effect may use. Everything of hidden states (``Hidden``) starts at its
    ``initial``.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> system = pendulum().system()
    >>> [str(port.kind) + ":" + port.name for port in system.ports]
    ['input:u', 'coordinate:theta', 'output:theta', 'base:base']
    >>> stuck = system.rebuild(forces={"theta": -0.3 * system.x[1]})
    >>> ca.depends_on(stuck.generalized_forces, stuck.x[1])
    True
    """

    name: str
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    states: tuple[Channel, ...]
    parameters: tuple[Parameter, ...]
    x: Any
    u: Any
    p: Any
    t: Any
    gravity: Any
    mass_matrix: Any
    generalized_forces: Any
    rates: Any
    h: Any
    coordinates: tuple[Coordinate, ...] = ()
    loads: Any = None
    bodies: tuple[BodyTerm, ...] = ()
    sampled: tuple[SampledBlock, ...] = ()
    initial: Any = None
    effects: tuple[Any, ...] = ()
    mechanism: Any = None
    hidden_count: int = 0
    switches: tuple[tuple[int, str], ...] = ()
    process: tuple[str, ...] = ()
    nominal: System | None = field(default=None, repr=False)
    starts: Callable[[Sequence[Trajectory]], Mapping[str, float]] | None = field(default=None, repr=False)

    # ---- sizes and names ------------------------------------------------------------------------------------------

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def np(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def ports(self) -> tuple[Port, ...]:
        """Where effects can act: inputs, coordinates, outputs, the base (gravity), process states."""
        found = [Port("input", channel.name, channel.unit) for channel in self.inputs]
        found += [Port("coordinate", one.name, one.unit) for one in self.coordinates]
        found += [Port("output", channel.name, channel.unit) for channel in self.outputs]
        if self.coordinates and ca.depends_on(self.generalized_forces, self.gravity):
            found.append(Port("base", "base", "rad"))
        units = {channel.name: channel.unit for channel in self.states}
        found += [Port("process", name, units[name]) for name in self.process]
        return tuple(found)

    @property
    def feedthrough(self) -> bool:
        """True if an output depends on an input of the same instant."""
        return bool(self.nu and ca.depends_on(self.h, self.u))

    def parameter(self, name: str) -> Parameter:
        """Return one parameter by name, or refuse the name."""
        return self.parameters[_index(name, self.parameter_names, "parameter")]

    def coordinate(self, name: str) -> Coordinate:
        """Return one coordinate by name, or refuse the name."""
        return self.coordinates[_index(name, [one.name for one in self.coordinates], "coordinate")]

    def values(self, given: Mapping[str, float] | None = None) -> dict[str, float]:
        """Return the value of every parameter by name, those in ``given`` replaced."""
        return defaults(self.parameters, given)

    def vector(self, given: Mapping[str, float] | None = None) -> FloatArray:
        """Return the values of the parameters as an array (np,), in the order of ``parameters``."""
        return np.array(list(self.values(given).values()), dtype=float)

    # ---- expressions ----------------------------------------------------------------------------------------------

    def upright(self, expression: Any) -> Any:
        """Return an expression with gravity pointing down (an effect may have turned it before)."""
        return ca.substitute(expression, self.gravity, ca.DM([0.0, -1.0]))

    @cached_property
    def acceleration(self) -> Any:
        """Accelerations of the coordinates, SX (n,), with the gravity symbol still inside."""
        return solve_symmetric(self.mass_matrix, self.generalized_forces)

    @cached_property
    def f(self) -> Any:
        """Derivative of the state, SX (nx,)."""
        n = len(self.coordinates)
        speeds = self.x[n : 2 * n] if n else ca.SX(0, 1)  # an empty slice of a single state would be a zero
        return self.upright(ca.vertcat(speeds, self.acceleration, self.rates))

    @cached_property
    def input_forces(self) -> Any:
        """The part of the generalized forces that comes from the inputs: Q(u) - Q(0), SX (n,)."""
        if not self.nu:
            return ca.SX.zeros(len(self.coordinates))
        slope = ca.jacobian(self.generalized_forces, self.u)
        if not ca.depends_on(slope, self.u):
            return ca.mtimes(slope, self.u)
        return self.generalized_forces - ca.substitute(self.generalized_forces, self.u, ca.DM.zeros(self.nu))

    def driven_by(self, name: str) -> int | None:
        """Return the index of the first coordinate on which an input's force acts; None if there is none."""
        column = self.u[_index(name, [channel.name for channel in self.inputs], "input")]
        for one in self.coordinates:
            if ca.depends_on(self.generalized_forces[one.force], column):
                return one.force
        return None

    # ---- other systems from this one ------------------------------------------------------------------------------

    def rebuild(
        self,
        *,
        inputs: Mapping[str, Any] | None = None,
        parameters_as: Mapping[str, Any] | None = None,
        gravity: Any = None,
        forces: Mapping[str, Any] | None = None,
        mass: Any = None,
        rates: Mapping[str, Any] | None = None,
        outputs: Mapping[str, Any] | None = None,
        states: Sequence[Hidden] = (),
        parameters: Sequence[tuple[Parameter, Any]] = (),
        sampled: Sequence[SampledBlock] = (),
        effects: Sequence[Any] = (),
        switches: Sequence[tuple[int, str]] = (),
        name: str | None = None,
    ) -> System:
        """Return a system in which something was changed.

        Parameters
        ----------
        inputs : mapping, optional
            Input name to the SX that the dynamics (and h) see instead of it.
        parameters_as : mapping, optional
            Parameter name to the SX used in place of it.
        gravity : sequence of 2 SX, optional
            Direction of gravity (horizontal, vertical), in place of ``self.gravity``.
        forces : mapping, optional
            Coordinate name to the SX added to its generalized force.
        mass : SX (n, n), optional
            Added to the mass matrix.
        rates : mapping, optional
            Name of a state that is not a coordinate to the SX added to its derivative.
        outputs : mapping, optional
            Output name to the SX that replaces it.
        states : sequence of Hidden
            New states; their derivatives see the *old* inputs (a later input effect is substituted into them too).
        parameters : sequence of (Parameter, SX symbol)
            New parameters.
        sampled : sequence of SampledBlock
            New delays or quantisers.
        effects : sequence
            Appended to ``effects``.
        switches : sequence of (int, str)
            Appended to ``switches``.
        name : str, optional
            New name.

        Raises
        ------
        InputError
            If a name is unknown or used twice.
        """
        swap_from: list[Any] = []
        swap_to: list[Any] = []
        for key, value in (inputs or {}).items():
            swap_from.append(self.u[_index(key, [channel.name for channel in self.inputs], "input")])
            swap_to.append(ca.SX(value))
        for key, value in (parameters_as or {}).items():
            swap_from.append(self.p[_index(key, self.parameter_names, "parameter")])
            swap_to.append(ca.SX(value))
        if gravity is not None:
            swap_from += [self.gravity[0], self.gravity[1]]
            swap_to += [ca.SX(gravity[0]), ca.SX(gravity[1])]

        def swapped(expression: Any) -> Any:
            if not swap_from or expression is None:
                return expression
            return ca.substitute(expression, ca.vertcat(*swap_from), ca.vertcat(*swap_to))

        total = ca.SX(swapped(self.generalized_forces))
        for key, value in (forces or {}).items():
            total[self.coordinate(key).force] += value
        change = ca.SX(swapped(self.rates))
        first = 2 * len(self.coordinates)
        names = [channel.name for channel in self.states[first:]]
        for key, value in (rates or {}).items():
            change[_index(key, names, "state")] += value
        h = ca.SX(swapped(self.h))
        for key, value in (outputs or {}).items():
            h[_index(key, [channel.name for channel in self.outputs], "output")] = value
        matrix = swapped(self.mass_matrix)
        start = self.initial if self.initial is not None else ca.SX.zeros(self.hidden_count)
        added = [one.initial if one.initial is not None else ca.SX(0.0) for one in states]
        known = {*self.parameter_names, *(channel.name for channel in self.states)}
        for fresh in [one.channel.name for one in states] + [one.name for one, _ in parameters]:
            if fresh in known:
                raise InputError(
                    f"{fresh!r} is there twice in {self.name}",
                    expected="states and parameters with names of their own",
                    got=repr(fresh),
                    remedy="place an effect only once at a port",
                )
            known.add(fresh)
        bodies = tuple(
            replace(body, mass_matrix=swapped(body.mass_matrix), forces=swapped(body.forces)) for body in self.bodies
        )
        return replace(
            self,
            name=self.name if name is None else name,
            states=(*self.states, *(one.channel for one in states)),
            parameters=(*self.parameters, *(one for one, _ in parameters)),
            x=ca.vertcat(self.x, *(one.symbol for one in states)),
            p=ca.vertcat(self.p, *(symbol for _, symbol in parameters)),
            mass_matrix=matrix if mass is None else matrix + mass,
            generalized_forces=total,
            rates=ca.vertcat(change, *(one.derivative for one in states)),
            h=h,
            loads=swapped(self.loads),
            bodies=bodies,
            sampled=(*self.sampled, *sampled),
            initial=ca.vertcat(swapped(start), *added),
            effects=(*self.effects, *effects),
            hidden_count=self.hidden_count + len(states),
            switches=(*self.switches, *switches),
        )

    def with_outputs(self, chosen: Sequence[str | tuple[str, int] | tuple[str, int, str]]) -> System:
        """Return the system with these measured outputs.

        Parameters
        ----------
        chosen : sequence
            Each a port (an output, coordinate or state by name) or ``(port, derivative)`` or
            ``(port, derivative, name)``; the rate of ``theta`` is called ``theta_rate`` unless named.

        Raises
        ------
        InputError
            If a port is unknown, a derivative is not 0, 1 or 2, or effects already act on the outputs.

        Examples
        --------
        >>> from harness.physics.models import pendulum
        >>> [str(channel) for channel in pendulum().system().with_outputs(["theta", ("theta", 1)]).outputs]
        ['theta [rad]', 'theta_rate [rad/s]']
        """
        if any(block.kind != "input_delay" for block in self.sampled) or self.effects:
            raise InputError(
                f"outputs of {self.name}",
                expected="a system without effects",
                got=", ".join(map(str, self.effects)),
                remedy="choose the outputs first and place the effects then",
            )
        known: dict[str, tuple[Channel, Any]] = {}
        for row, channel in enumerate(self.states):
            known[channel.name] = (channel, self.x[row])
        for row, channel in enumerate(self.outputs):
            known[channel.name] = (channel, self.h[row])
        channels, rows = [], []
        for item in chosen:
            port, order, label = (item, 0, "") if isinstance(item, str) else (item[0], item[1], "".join(item[2:]))
            if port not in known or order not in (0, 1, 2):
                raise InputError(
                    f"measured output of {self.name}",
                    expected=f"one of {', '.join(known)}, with derivative 0, 1 or 2",
                    got=repr(item),
                    remedy="correct the port or the derivative",
                )
            channel, row = known[port]
            for _ in range(order):
                row = ca.jtimes(row, self.x, self.f) + ca.jtimes(row, self.t, ca.SX(1.0))
            if order:
                suffix = "_rate" if order == 1 else "_acceleration"
                unit = _per_second(channel.unit, order)
                channel = Channel(label or port + suffix, unit)
            elif label and label != channel.name:
                channel = replace(channel, name=label)
            channels.append(channel)
            rows.append(row)
        names = [channel.name for channel in channels]
        if len(set(names)) != len(names) or not names:
            raise InputError(
                f"measured outputs of {self.name}",
                expected="at least one, each once",
                got=", ".join(names) or "none",
                remedy="remove the double or name it otherwise",
            )
        return replace(self, outputs=tuple(channels), h=ca.vertcat(*rows))

    def with_parameters(self, parameters: Mapping[str, Parameter | float]) -> System:
        """Return the system with other nominal values, bounds or fixed flags.

        Examples
        --------
        >>> from harness.physics.models import pendulum
        >>> pendulum().system().with_parameters({"J": 0.2}).parameter("J").value
        0.2
        """
        for name in parameters:
            self.parameter(name)
        changed = []
        for old in self.parameters:
            new = parameters.get(old.name, old)
            changed.append(new if isinstance(new, Parameter) else replace(old, value=float(new)))
        return replace(self, parameters=tuple(changed))

    def simulator(
        self,
        dt: float,
        *,
        intersample: Literal["zoh", "foh", "smooth"] = "zoh",
        substeps: int | None = None,
        backend: Backend = "auto",
    ) -> Simulator:
        """Return a fixed-step simulator of this system; see :class:`harness.physics.simulator.Simulator`."""
        from harness.physics.simulator import Simulator

        key = (float(dt), intersample, substeps, backend)
        cache: dict[Any, Simulator] = self.__dict__.setdefault("_simulators", {})
        if key not in cache:
            cache[key] = Simulator(self, dt, intersample=intersample, substeps=substeps, backend=backend)
        return cache[key]

    def __str__(self) -> str:
        effects = "".join(f" + {effect}" for effect in self.effects)
        inputs = ", ".join(map(str, self.inputs)) or "no input"
        return f"{self.name}{effects}: {inputs} -> {', '.join(map(str, self.outputs))}"

    # ---- travelling ----------------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields, the expressions packed as one serialized CasADi function."""
        state = {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}
        rows = [state.pop(name) for name in _EXPRESSIONS]
        packed = [row for row in rows if row is not None]
        for body in state.pop("bodies"):
            packed += [body.mass_matrix, body.forces]
        symbols = [state.pop(name) for name in _SYMBOLS]
        state["_expressions"] = ca.Function("system", symbols, packed).serialize()
        state["_present"] = [row is not None for row in rows]
        state["_bodies"] = [body.coordinates for body in self.bodies]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        function = ca.Function.deserialize(state.pop("_expressions"))
        symbols = [ca.SX.sym(name, function.size1_in(row)) for row, name in enumerate(_SYMBOLS)]
        packed = function.call(symbols)
        self.__dict__.update(zip(_SYMBOLS, symbols, strict=True))
        for name, present in zip(_EXPRESSIONS, state.pop("_present"), strict=True):
            self.__dict__[name] = packed.pop(0) if present else None
        bodies = []
        for coordinates in state.pop("_bodies"):
            matrix, forces = packed.pop(0), packed.pop(0)
            bodies.append(BodyTerm(coordinates, matrix, forces))
        self.__dict__["bodies"] = tuple(bodies)
        self.__dict__.update(state)


_SYMBOLS = ("x", "u", "p", "t", "gravity")
_EXPRESSIONS = ("mass_matrix", "generalized_forces", "rates", "h", "loads", "initial")


def _per_second(unit: str, order: int) -> str:
    """Return the unit of a time derivative."""
    return f"{unit}/s" if order == 1 else f"{unit}/s^2"


def _index(name: str, names: Sequence[str], what: str) -> int:
    """Return where a name stands, or refuse it."""
    if name not in names:
        raise InputError(
            f"unknown {what}",
            expected=f"one of {', '.join(names) or '(none)'}",
            got=repr(name),
            remedy="correct the name",
        )
    return list(names).index(name)
