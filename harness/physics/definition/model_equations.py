"""The equations of a continuous-time grey box as CasADi expressions: what is simulated, compiled and exported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np

from harness.errors import unknown_name
from harness.fingerprint import fingerprint
from harness.physics.definition.dimensions import Dimensions
from harness.physics.definition.linear_solve import solve_symmetric
from harness.physics.definition.parameters import Parameter, defaults
from harness.physics.definition.ports import BodyTerm, Coordinate, Port, SampledBlock
from harness.signals import Channel, FloatArray, Trajectory


@dataclass(frozen=True, eq=False)
class Equations(Dimensions):
    """A continuous-time grey box ``x' = f(x, u, p, t)``, ``y = h(x, u, p, t)``; nominal, or with effects built in.

    States are the coordinates q, their rates v, then the other states (of an ODE, or hidden ones of effects)::

        q' = v,   M(q, p, t) v' = Q(q, v, z, u, p, t),   z' = rates(x, u, p, t)
    """

    name: str
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    states: tuple[Channel, ...]
    parameters: tuple[Parameter, ...]  # Nominal ones, then those of effects, called ``effect@port.name``
    # Symbols: columns of length nx, nu, np; time [s], a scalar
    x: Any
    u: Any
    p: Any
    t: Any
    gravity: Any  # Symbol (2,): direction of gravity (horizontal, vertical), ``(0, -1)`` unless an effect turns it
    mass_matrix: Any  # casadi.SX (n, n)
    generalized_forces: Any  # casadi.SX (n,): The whole right-hand side Q: inputs, friction, gravity, Coriolis terms
    rates: Any  # casadi.SX (nx - 2 n,): Derivatives of the states that are not coordinates
    h: Any  # casadi.SX (ny,)
    coordinates: tuple[Coordinate, ...] = ()
    loads: Any = None
    """Casadi.SX (n,): Force that the guide of a coordinate carries across its motion (weight and centripetal part):
    what a load-dependent friction is proportional to. For a joint it is a moment, radius included."""
    bodies: tuple[BodyTerm, ...] = ()
    sampled: tuple[SampledBlock, ...] = ()  # Delays and quantisers, carried out on samples
    initial: Any = None  # casadi.SX (hidden_count,): Where the hidden states start; an expression in x, u and p
    effects: tuple[Any, ...] = ()  # What :mod:`harness.effects` placed
    mechanism: Any = None  # The symbolic definition
    hidden_count: int = 0  # The last so many states were brought by effects
    switches: tuple[tuple[int, str], ...] = ()
    """Tuple of (int, str): States through whose zero a force changes its sign, each with the parameter that smooths it:
    a step that comes near zero is taken in finer ones."""
    corners: tuple[Any, ...] = ()
    """Casadi.SX in x and p that are 0 where a force has a corner or a jump: a step that passes one is taken in finer
    ones."""
    process: tuple[str, ...] = ()  # States that are levels, in the order in which they flow into each other
    nominal: Self | None = field(default=None, repr=False)  # Where effects were placed: the system without them
    starts: Callable[[Sequence[Trajectory]], Mapping[str, float]] | None = field(default=None, repr=False)
    """Start values of parameters from records."""
    remarks: tuple[str, ...] = ()
    """What a reader of an exported model must be told, such as that a force was learned and is not physical."""

    # ---- sizes and names ------------------------------------------------------------------------------------------

    @property
    def ports(self) -> tuple[Port, ...]:
        """Where effects can act: inputs, coordinates, outputs, the base (gravity), process states, carried masses."""
        found = [Port("input", channel.name, channel.unit) for channel in self.inputs]
        found += [Port("coordinate", coordinate.name, coordinate.unit) for coordinate in self.coordinates]
        found += [Port("output", channel.name, channel.unit) for channel in self.outputs]
        if self.coordinates and ca.depends_on(self.generalized_forces, self.gravity):
            found.append(Port("base", "base", "rad"))
        units = {channel.name: channel.unit for channel in self.states}
        found += [Port("process", name, units[name]) for name in self.process]
        found += [Port("mass", name, "kg") for name in self._carried]
        return tuple(found)

    @cached_property
    def _carried(self) -> tuple[str, ...]:
        """Names of the masses whose inertia couples coordinates: a load on one of them is no load on one coordinate."""
        n, found = len(self.coordinates), []
        declared = (self if self.nominal is None else self.nominal).parameters
        for k, parameter in enumerate(declared if n > 1 else ()):
            if parameter.unit != "kg":
                continue
            entries = ca.jacobian(ca.vec(self.mass_matrix), self.p[k]).sparsity().row()
            if any(entry // n != entry % n for entry in entries):
                found.append(parameter.name)
        return tuple(found)

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the compiled equations and of all that is declared: equal for equal models."""
        forces, start = self.generalized_forces, self.initial
        parts = [self.mass_matrix, forces, self.rates, self.h, *([] if start is None else [start]), *self.corners]
        function = ca.Function("model", [self.x, self.u, self.p, self.t, self.gravity], [ca.SX(part) for part in parts])
        channels = [str(channel) for group in (self.inputs, self.outputs, self.states) for channel in group]
        declared = (self.parameters, self.coordinates, self.sampled, self.switches, self.process, self.hidden_count)
        return fingerprint(function.serialize(), channels, declared)

    @property
    def divided(self) -> bool:
        """True if some steps are taken in finer ones."""
        return bool(self.switches or self.corners)

    @property
    def feedthrough(self) -> bool:
        """True if an output depends on an input of the same instant."""
        return bool(self.nu and ca.depends_on(self.h, self.u))

    def parameter(self, name: str) -> Parameter:
        """Return one parameter by name, or refuse the name."""
        return self.parameters[index_of(name, self.parameter_names, "parameter")]

    def coordinate(self, name: str) -> Coordinate:
        """Return one coordinate by name, or refuse the name."""
        return self.coordinates[index_of(name, [coordinate.name for coordinate in self.coordinates], "coordinate")]

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
        jacobian = ca.jacobian(self.generalized_forces, self.u)
        if not ca.depends_on(jacobian, self.u):
            return ca.mtimes(jacobian, self.u)
        return self.generalized_forces - ca.substitute(self.generalized_forces, self.u, ca.DM.zeros(self.nu))

    def driven_by(self, name: str) -> int | None:
        """Return the index of the first coordinate on which an input's force acts; None if there is none."""
        column = self.u[index_of(name, [channel.name for channel in self.inputs], "input")]
        for coordinate in self.coordinates:
            if ca.depends_on(self.generalized_forces[coordinate.force], column):
                return coordinate.force
        return None

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


def index_of(name: str, names: Sequence[str], what: str) -> int:
    """Return the index of a name, or refuse it."""
    if name not in names:
        raise unknown_name(f"unknown {what}", name, names)
    return list(names).index(name)
