"""Mechanism: a mechanical model written once, in SymPy; everything else is derived from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from harness.errors import InputError, unknown_name
from harness.physics.compiled.system import BodyTerm, Coordinate, System
from harness.physics.definition.parameters import Parameter, as_parameter
from harness.physics.symbolic.convert import to_casadi
from harness.signals import Channel

_TRIGONOMETRIC = (sp.sin, sp.cos, sp.tan)


@dataclass(frozen=True)
class Body:
    """A rigid body in a vertical plane: mass, centre of mass, inertia about it with its angle, and weight."""

    mass: Any
    position: tuple[Any, Any]
    inertia: Any
    angle: Any
    weight: Any


class Mechanism:
    """A planar mechanical model in generalized coordinates, gravity along the negative second axis.

    Parameters
    ----------
    name : str
        For titles and reports.
    q : str
        Names of the coordinates, separated by spaces; the rates are called ``v_NAME``.
    u : str
        Names of the inputs (may be empty).
    p : str
        Names of the parameters.
    g : float
        Gravity [m/s^2], known.
    units : mapping, optional
        Unit of a coordinate or an input by name. A coordinate of whose sine or cosine something is made is in rad, any
        other in m; an input that adds to one generalized force has its unit.
    parameters : mapping, optional
        What is known of parameters: a :class:`Parameter`, a value, or ``(unit, value[, minimum[, maximum]])``.
        Without a minimum a parameter of a mechanism is positive: it is a mass, a length, a stiffness, a damping.

    Attributes
    ----------
    q, v, u, p : tuple of sympy.Symbol
        The symbols to write the model with; ``t`` is the time.
    Q : list of expressions
        Generalized force on each coordinate (inputs and friction), set by the user; 0 by default.
    T, V : expression
        Kinetic and potential energy [J] beside those of the bodies.
    symbolic : bool
        True unless energies and forces are generated code (a large arm).
    outputs : dict
        Output name to expression (in q, v, p, t), or to ``(expression, unit)``; by default the coordinates.

    Raises
    ------
    InputError
        If a name is used twice or is not an identifier, or (by :meth:`system`) an expression does not fit.

    Examples
    --------
    >>> from sympy import cos, sin
    >>> m = Mechanism("cart-pole", q="x theta", u="f", p="mc mp l bx bt")
    >>> (x, th), (xd, thd), (f,), (mc, mp, l, bx, bt) = m.q, m.v, m.u, m.p
    >>> m.body(mc, (x, 0))
    >>> m.body(mp, (x + l*sin(th), -l*cos(th)))
    >>> m.Q = [f - bx*xd, -bt*thd]
    >>> print(m.system())
    cart-pole: f [N] -> x [m], theta [rad]
    """

    def __init__(
        self,
        name: str,
        q: str,
        u: str = "",
        p: str = "",
        *,
        g: float = 9.81,
        units: Mapping[str, str] | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        self.name, self.g = name, float(g)
        self.symbolic = True
        coordinates, inputs, constants = q.split(), u.split(), p.split()
        _check_names(name, [*coordinates, *inputs, *constants])
        if not coordinates:
            raise InputError(
                f"mechanism {name!r}", expected="at least one coordinate", got="none", remedy='write q="theta"'
            )
        # Symbols are made from the names, never parsed: a parameter may be called S, N or lambda_1.
        self.q = tuple(sp.Symbol(coordinate, real=True) for coordinate in coordinates)
        self.v = tuple(sp.Symbol(f"v_{coordinate}", real=True) for coordinate in coordinates)
        self.u = tuple(sp.Symbol(channel, real=True) for channel in inputs)
        self.p = tuple(sp.Symbol(constant, real=True) for constant in constants)
        self.t = sp.Symbol("t", real=True)
        self.Q: Sequence[Any] = [0] * len(coordinates)
        self.T: Any = sp.Integer(0)
        self.V: Any = sp.Integer(0)
        self.outputs: dict[str, Any] = {}
        self.bodies: list[Body] = []
        self.units = dict(units or {})
        self._parameters: dict[str, Any] = {}
        self.parameters(parameters or {})

    def body(
        self,
        mass: Any,
        position: tuple[Any, Any],
        inertia: Any = 0,
        angle: Any = 0,
        *,
        weight: Any = None,
    ) -> None:
        """Add a body.

        Parameters
        ----------
        mass : expression
            [kg].
        position : pair of expressions
            Centre of mass (horizontal, up) [m], in q, p and t.
        inertia, angle : expression
            Moment of inertia about the centre of mass [kg m^2] and the angle it turns by [rad].
        weight : expression, optional
            [N]; by default ``mass * g``. Lets lumped parameters be used: a pendulum of inertia J and moment mgl is a
            body of mass J and weight mgl at unit radius.
        """
        if len(position) != 2:
            raise InputError(
                f"position of a body of {self.name!r}",
                expected="(horizontal, up)",
                got=repr(position),
                remedy="give two expressions",
            )
        self.bodies.append(
            Body(
                sp.sympify(mass, strict=True),
                (sp.sympify(position[0], strict=True), sp.sympify(position[1], strict=True)),
                sp.sympify(inertia, strict=True),
                sp.sympify(angle, strict=True),
                sp.sympify(mass * self.g if weight is None else weight, strict=True),
            )
        )

    def parameters(self, known: Mapping[str, Any] | None = None, **more: Any) -> None:
        """Set the unit, the value and the bounds of parameters.

        Parameters
        ----------
        known, **more
            Name to :class:`Parameter`, value, or ``(unit, value[, minimum[, maximum]])``.
        """
        names = [str(symbol) for symbol in self.p]
        for key, value in {**(known or {}), **more}.items():
            if key not in names:
                raise unknown_name(f"unknown parameter of {self.name!r}", key, names)
            self._parameters[key] = as_parameter(key, value, minimum=0.0)

    # ---- derived -------------------------------------------------------------------------------------------------

    def parameter_list(self) -> tuple[Parameter, ...]:
        """Return the parameters, in the order of ``p``."""
        return tuple(
            self._parameters.get(str(symbol), Parameter(str(symbol), minimum=0.0, declared=False)) for symbol in self.p
        )

    def forces(self) -> list[Any]:
        """Return the generalized forces as SymPy expressions, one for each coordinate."""
        given = list(self.Q)
        if len(given) != len(self.q):
            raise InputError(
                f"generalized forces of {self.name!r}",
                expected=f"{len(self.q)}, one for each of {', '.join(map(str, self.q))}",
                got=str(len(given)),
                remedy="give Q one expression for each coordinate",
            )
        return [sp.sympify(force, strict=True) for force in given]

    def coordinate_units(self) -> tuple[str, ...]:
        """Return the units of the coordinates."""
        everything = [part for body in self.bodies for part in body.position] + [sp.sympify(self.V), sp.sympify(self.T)]
        turning = {
            symbol
            for expression in everything
            for node in expression.atoms(*_TRIGONOMETRIC)
            for symbol in node.free_symbols
        } | {symbol for body in self.bodies for symbol in body.angle.free_symbols}
        return tuple(self.units.get(str(coordinate), "rad" if coordinate in turning else "m") for coordinate in self.q)

    def input_units(self) -> tuple[str, ...]:
        """Return the units of the inputs."""
        coordinates, found = self.coordinate_units(), []
        for symbol in self.u:
            units = {
                "N m" if unit == "rad" else "N"
                for force, unit in zip(self.forces(), coordinates, strict=True)
                if symbol in force.free_symbols and abs(sp.diff(force, symbol)) == 1
            }
            found.append(self.units.get(str(symbol), units.pop() if len(units) == 1 else "1"))
        return tuple(found)

    def system(self) -> System:
        """Return the equations of motion as a :class:`System`.

        Lagrange's equations of the second kind (Goldstein, *Classical Mechanics*, eq. 1.53 with generalized forces),
        differentiated by CasADi: ``M = d2T/dv2``, ``Q_total = Q + dL/dq - (d/dq dT/dv) v - d/dt dT/dv``.
        """
        n, nu, npar = len(self.q), len(self.u), len(self.p)
        x, u, p, t = ca.SX.sym("x", 2 * n), ca.SX.sym("u", nu), ca.SX.sym("p", npar), ca.SX.sym("t")
        gravity = ca.SX.sym("gravity", 2)
        q, v = x[:n], x[n:]
        table: dict[Any, Any] = {self.t: t}
        for symbols, column in ((self.q, q), (self.v, v), (self.u, u), (self.p, p)):
            table.update({symbol: column[row] for row, symbol in enumerate(symbols)})

        def convert(expression: Any) -> Any:
            return to_casadi(sp.sympify(expression, strict=True), table)

        matrix, total = _lagrange(convert(self.T), convert(self.V), q, v, t)
        loads = ca.SX.zeros(n)
        terms: list[BodyTerm] = []
        for body in self.bodies:
            position = ca.vertcat(convert(body.position[0]), convert(body.position[1]))
            mass, weight = convert(body.mass), convert(body.weight)
            own_matrix, own_forces, bias = _body_terms(
                mass, convert(body.inertia), weight, position, convert(body.angle), gravity, q, v, t
            )
            matrix, total = matrix + own_matrix, total + own_forces
            motion = ca.jacobian(position, q)
            moved = tuple(row for row in range(n) if ca.depends_on(ca.vertcat(position, convert(body.angle)), q[row]))
            terms.append(BodyTerm(moved, own_matrix, own_forces))
            # Across the motion: the direction of motion turned by 90 degrees, times what must be held there.
            held = -weight * gravity + mass * bias
            loads = loads + ca.vertcat(*(held[1] * motion[0, row] - held[0] * motion[1, row] for row in range(n)))
        total = total + ca.vertcat(*(convert(force) for force in self.forces()))
        channels, rows = self._outputs(convert)
        coordinates, states, rates = [], [], []
        for row, (symbol, unit) in enumerate(zip(self.q, self.coordinate_units(), strict=True)):
            coordinates.append(Coordinate(str(symbol), unit, "N m" if unit == "rad" else "N", row, n + row, row))
            states.append(Channel(str(symbol), unit))
            rates.append(Channel(f"{symbol}_rate", f"{unit}/s"))
        return System(
            name=self.name,
            inputs=tuple(Channel(str(symbol), unit) for symbol, unit in zip(self.u, self.input_units(), strict=True)),
            outputs=channels,
            states=(*states, *rates),
            parameters=self.parameter_list(),
            x=x,
            u=u,
            p=p,
            t=t,
            gravity=gravity,
            mass_matrix=ca.simplify(matrix),
            generalized_forces=total,
            rates=ca.SX(0, 1),
            h=ca.vertcat(*rows),
            coordinates=tuple(coordinates),
            loads=loads,
            bodies=tuple(terms),
            mechanism=self,
        )

    def _outputs(self, convert: Any) -> tuple[tuple[Channel, ...], list[Any]]:
        """Return the channels of the outputs and their expressions."""
        units = dict(zip(map(str, self.q), self.coordinate_units(), strict=True))
        chosen: dict[str, Any] = self.outputs or {str(symbol): symbol for symbol in self.q}
        channels, rows = [], []
        for name, given in chosen.items():
            expression, unit = given if isinstance(given, tuple) else (given, units.get(str(given), "1"))
            whole_turns = unit == "rad" and str(expression) in units
            channels.append(Channel(name, unit, period=2 * np.pi if whole_turns else None))
            rows.append(convert(expression))
        return tuple(channels), rows

    def __repr__(self) -> str:
        return f"Mechanism({self.name!r}, q={' '.join(map(str, self.q))!r}, u={' '.join(map(str, self.u))!r})"


def _lagrange(kinetic: Any, potential: Any, q: Any, v: Any, t: Any) -> tuple[Any, Any]:
    """Return the mass matrix and the generalized force of an energy."""
    momentum = ca.gradient(kinetic, v)
    matrix = ca.jacobian(momentum, v)
    force = ca.gradient(kinetic, q) - ca.gradient(potential, q)
    force = force - ca.jtimes(momentum, q, v) - ca.jtimes(momentum, t, ca.SX(1.0))
    return matrix, force


def _body_terms(
    mass: Any, inertia: Any, weight: Any, position: Any, angle: Any, gravity: Any, q: Any, v: Any, t: Any
) -> tuple[Any, Any, Any]:
    """Return the mass matrix, the generalized force and the acceleration at v' = 0 of one body.

    Newton-Euler projected on the motion (Kane): shorter code than the derivatives of the kinetic energy.
    """
    if ca.depends_on(ca.vertcat(mass, inertia), ca.vertcat(q, v, t)):
        raise InputError(
            "mass or inertia of a body",
            expected="an expression in parameters only",
            got=str(mass),
            remedy="write the kinetic energy of a body whose mass changes into T",
        )
    one = ca.SX(1.0)
    motion, turn = ca.jacobian(position, q), ca.jacobian(angle, q)
    velocity = ca.mtimes(motion, v) + ca.jtimes(position, t, one)
    spin = ca.mtimes(turn, v) + ca.jtimes(angle, t, one)
    bias = ca.jtimes(velocity, q, v) + ca.jtimes(velocity, t, one)
    bias_spin = ca.jtimes(spin, q, v) + ca.jtimes(spin, t, one)
    matrix = mass * ca.mtimes(motion.T, motion) + inertia * ca.mtimes(turn.T, turn)
    force = ca.mtimes(motion.T, weight * gravity - mass * bias) - inertia * turn.T * bias_spin
    return matrix, force, bias


def _check_names(owner: str, names: Sequence[str]) -> None:
    """Refuse names that are no identifiers or are used twice."""
    for name in names:
        if not name.isidentifier():
            raise InputError(
                f"name in {owner!r}", expected="a word of letters, digits and _", got=repr(name), remedy="rename it"
            )
    twice = sorted({name for name in names if names.count(name) > 1} | ({"t"} & set(names)))
    if twice:
        raise InputError(
            f"names in {owner!r}", expected="each once, and none called t", got=", ".join(twice), remedy="rename one"
        )
