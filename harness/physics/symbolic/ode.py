"""Ode: a model that is not mechanical, written once in SymPy as differential equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import sympy as sp

from harness.errors import InputError
from harness.physics.compiled.system import System
from harness.physics.definition.parameters import Parameter, as_parameter
from harness.physics.definition.ports import Coordinate
from harness.physics.symbolic.convert import to_casadi
from harness.physics.symbolic.mechanism import _check_names
from harness.signals import Channel


class Ode:
    """Ordinary differential equations ``x' = rhs(x, u, p, t)``, ``y = outputs(x, u, p, t)``.

    Parameters
    ----------
    name : str
        For titles and reports.
    x, u, p : str
        Names of states, inputs and parameters, separated by spaces.
    units : mapping, optional
        Unit by name of a state, input or output; ``"1"`` by default.
    parameters : mapping, optional
        What is known of parameters, see :class:`harness.physics.Mechanism`; unlike there, no sign is assumed.
    process : str
        Names of the states that are levels, in the order in which they flow into each other: where process effects
        (overflow, leak, level saturation) can act.
    motions : mapping, optional
        What of the states moves: name of a coordinate to ``(speed, inertia)``, the name of the state that is its speed
        (rad/s or m/s) and the parameter or expression by which its rate is multiplied to give a torque or force. There
        the effects of a joint can act, dry friction or backlash, as on a coordinate of a :class:`Mechanism`. The
        coordinate may be a state itself, whose rate then is the speed, or one that no equation needs. Everything else,
        a current, a temperature, a level, stays a state beside it. Coordinates that accelerate each other, a cart and
        what hangs on it, have a mass matrix: ``inertia`` is then a mapping from speeds to the entries of the
        coordinate's row, and ``rhs`` of its speed is the generalized force, the right side of ``M(q) a = force``.

    Attributes
    ----------
    x, u, p : tuple of sympy.Symbol
        The symbols to write the model with; ``t`` is the time.
    rhs : list of expressions
        Derivative of each state.
    outputs : dict
        Output name to expression, or to ``(expression, unit)``; by default the states.

    Examples
    --------
    >>> o = Ode("tank", x="h", u="inflow", p="k", process="h")
    >>> (h,), (inflow,), (k,) = o.x, o.u, o.p
    >>> o.rhs = [inflow - k * sp.sqrt(h)]
    >>> print(o.system())
    tank: inflow [1] -> h [1]

    A motor: its shaft is a coordinate, its current a state beside it.

    >>> o = Ode("motor", x="i w", u="v", p="R L K J", units={"i": "A", "w": "rad/s"}, motions={"shaft": ("w", "J")})
    >>> (i, w), (v,), (R, L, K, J) = o.x, o.u, o.p
    >>> o.rhs = [(v - R * i - K * w) / L, K * i / J]
    >>> [f"{port.kind}:{port.name}" for port in o.system().ports]
    ['input:v', 'coordinate:shaft', 'output:i', 'output:w']

    A crane: what acts on the trolley moves its load as well.

    >>> units = {"v": "m/s", "w": "rad/s"}
    >>> o = Ode("crane", x="s a v w", u="F", p="m C J", units=units)
    >>> (s, a, v, w), (F,), (m, C, J) = o.x, o.u, o.p
    >>> o.move("s", "v", {"v": m, "w": C * sp.cos(a)})
    >>> o.move("a", "w", {"v": C * sp.cos(a), "w": J})
    >>> o.rhs = [v, w, F + C * sp.sin(a) * w**2, -9.81 * C * sp.sin(a)]
    >>> o.system().mass_matrix.shape
    (2, 2)
    """

    def __init__(
        self,
        name: str,
        x: str,
        u: str = "",
        p: str = "",
        *,
        units: Mapping[str, str] | None = None,
        parameters: Mapping[str, Any] | None = None,
        process: str = "",
        motions: Mapping[str, tuple[str, Any]] | None = None,
    ) -> None:
        self.name = name
        _check_names(name, [*x.split(), *u.split(), *p.split()])
        self.x = tuple(sp.Symbol(state, real=True) for state in x.split())
        self.u = tuple(sp.Symbol(channel, real=True) for channel in u.split())
        self.p = tuple(sp.Symbol(parameter, real=True) for parameter in p.split())
        self.t = sp.Symbol("t", real=True)
        self.rhs: Sequence[Any] = []
        self.outputs: dict[str, Any] = {}
        self.units = dict(units or {})
        self.process = tuple(process.split())
        self.starts: Any = None
        unknown = sorted(set(self.process) - set(x.split())) + sorted(set(parameters or {}) - set(p.split()))
        if unknown:
            raise InputError(
                f"names in {name!r}",
                expected=f"states among ({x}) and parameters among ({p})",
                got=", ".join(unknown),
                remedy="correct the names",
            )
        self._parameters = {key: as_parameter(key, value) for key, value in (parameters or {}).items()}
        self.motions: dict[str, tuple[str, Any]] = {}
        for coordinate, given in (motions or {}).items():
            self.move(coordinate, *given)

    def move(self, coordinate: str, speed: str, inertia: Any) -> None:
        """Declare a coordinate, as ``motions`` does.

        Parameters
        ----------
        coordinate, speed : str
        inertia : str, expression or mapping
            A parameter by name, an expression, or the coordinate's row of the mass matrix by speed.

        Raises
        ------
        InputError
            If the speed is no state with a unit of one, or the inertia is unknown.
        """
        names, known = [str(state) for state in self.x], {str(parameter): parameter for parameter in self.p}
        unit = self.units.get(speed, "1")
        if coordinate == speed:
            raise InputError(
                f"motion {coordinate!r} of {self.name!r}",
                expected="a name for what moves, such as its position or a new one",
                got="the name of its speed",
                remedy=f"call it something else: effects will act on that name, with the speed {speed}",
            )
        if speed not in names or not unit.endswith("/s"):
            raise InputError(
                f"motion {coordinate!r} of {self.name!r}",
                expected="(speed, inertia): a state with a unit such as rad/s or m/s, and a parameter",
                got=f"({speed}, {inertia})" + (f" with {speed} in {unit}" if speed in names else ""),
                remedy=f'name one of {", ".join(names)}, and state its unit: units={{"{speed}": "rad/s"}}',
            )
        if isinstance(inertia, str) and inertia not in known:
            raise InputError(
                f"inertia of {coordinate!r} of {self.name!r}",
                expected=f"one of {', '.join(known) or 'no parameter'}, or an expression in them",
                got=repr(inertia),
                remedy="correct the name",
            )
        if coordinate not in names:
            _check_names(self.name, [*names, *map(str, self.u), *known, coordinate])
        self.motions[coordinate] = speed, known[inertia] if isinstance(inertia, str) else inertia

    def mass_matrix(self) -> list[list[Any]]:
        """Return the mass matrix, a row for each coordinate.

        Raises
        ------
        InputError
            If it is not symmetric: then its rows are not the balances of forces at these coordinates.
        """
        speeds = [speed for speed, _ in self.motions.values()]
        rows = [_row(speed, inertia) for speed, inertia in self.motions.values()]
        for row, name in zip(rows, self.motions, strict=True):
            if unknown := sorted(set(row) - set(speeds)):
                raise InputError(
                    f"the mass matrix of {self.name!r}, row {name}",
                    expected=f"rates of the speeds {', '.join(speeds)}",
                    got=f"a rate of {', '.join(unknown)}",
                    remedy="declare it as the speed of a coordinate too",
                )
        matrix = [[sp.sympify(row.get(speed, 0)) for speed in speeds] for row in rows]
        names = list(self.motions)
        for i in range(len(names)):
            for j in range(i):
                if sp.simplify(matrix[i][j] - matrix[j][i]) != 0:
                    raise InputError(
                        f"the mass matrix of {self.name!r}",
                        expected="a symmetric one: each row the balance of what acts along its coordinate",
                        got=f"{matrix[i][j]} for {speeds[j]} in the row of {names[i]}, {matrix[j][i]} for {speeds[i]} "
                        f"in that of {names[j]}",
                        remedy="write the rows as Lagrange's equations of these coordinates, none divided or added "
                        "to another",
                    )
        return matrix

    def parameter_list(self) -> tuple[Parameter, ...]:
        """Return the parameters, in the order of ``p``."""
        return tuple(self._parameters.get(str(symbol), Parameter(str(symbol), declared=False)) for symbol in self.p)

    def system(self) -> System:
        """Return the equations as a :class:`System`."""
        if len(list(self.rhs)) != len(self.x):
            raise InputError(
                f"right-hand sides of {self.name!r}",
                expected=f"{len(self.x)}, one for each of {', '.join(map(str, self.x))}",
                got=str(len(list(self.rhs))),
                remedy="give rhs one expression for each state",
            )
        order = self._order()
        places = {name: place for place, name in enumerate(order)}
        x, u, p = ca.SX.sym("x", len(order)), ca.SX.sym("u", len(self.u)), ca.SX.sym("p", len(self.p))
        t = ca.SX.sym("t")
        table: dict[Any, Any] = {self.t: t}
        table.update({symbol: x[places[str(symbol)]] for symbol in self.x})
        for symbols, column in ((self.u, u), (self.p, p)):
            table.update({symbol: column[row] for row, symbol in enumerate(symbols)})

        def convert(expression: Any) -> Any:
            return to_casadi(sp.sympify(expression, strict=True), table)

        chosen: dict[str, Any] = self.outputs or {str(symbol): symbol for symbol in self.x}
        channels, rows = [], []
        for name, given in chosen.items():
            expression, unit = given if isinstance(given, tuple) else (given, self._unit(name))
            channels.append(Channel(name, unit))
            rows.append(convert(expression))
        slopes = {str(state): convert(row) for state, row in zip(self.x, self.rhs, strict=True)}
        masses = [[convert(entry) for entry in row] for row in self.mass_matrix()]
        n = len(masses)
        coordinates = [
            Coordinate(name, self._unit(name), "N m" if self._unit(name) == "rad" else "N", row, n + row, row)
            for row, name in enumerate(self.motions)
        ]
        forces = [
            slopes[speed] if isinstance(inertia, Mapping) else masses[row][row] * slopes[speed]
            for row, (speed, inertia) in enumerate(self.motions.values())
        ]
        return System(
            name=self.name,
            inputs=tuple(Channel(str(symbol), self._unit(str(symbol))) for symbol in self.u),
            outputs=tuple(channels),
            states=tuple(Channel(name, self._unit(name)) for name in order),
            parameters=self.parameter_list(),
            x=x,
            u=u,
            p=p,
            t=t,
            gravity=ca.SX.sym("gravity", 2),
            mass_matrix=ca.vertcat(*(ca.horzcat(*row) for row in masses)) if masses else ca.SX(0, 0),
            generalized_forces=ca.vertcat(*forces) if forces else ca.SX(0, 1),
            rates=ca.vertcat(*(slopes[name] for name in order[2 * n :])) if order[2 * n :] else ca.SX(0, 1),
            h=ca.vertcat(*rows),
            coordinates=tuple(coordinates),
            loads=ca.SX.zeros(n, 1),
            mechanism=self,
            process=self.process,
            starts=self.starts,
            remarks=self._apart(),
        )

    def _apart(self) -> tuple[str, ...]:
        """Return what to say where one input moves several joints that have an inertia each, and no mass matrix."""
        slopes = {str(state): sp.sympify(row) for state, row in zip(self.x, self.rhs, strict=True)}
        alone = {name: speed for name, (speed, inertia) in self.motions.items() if not isinstance(inertia, Mapping)}
        said = []
        for symbol in self.u:
            moved = [name for name, speed in alone.items() if symbol in slopes[speed].free_symbols]
            if len(moved) > 1:
                said.append(
                    f"{symbol} accelerates {' and '.join(moved)}, which have an inertia each: what is found at one of "
                    "them then acts on its own rate alone. If they accelerate each other, as a cart and what hangs on "
                    "it, give their equations of motion with a mass matrix, a row for each "
                    f"({moved[0]}: M*{alone[moved[0]]}' + C*{alone[moved[1]]}' = ...)"
                )
        return tuple(said)

    def _order(self) -> list[str]:
        """Return the names of the states: coordinates, their speeds, and all others as they were written."""
        speeds = [speed for speed, _ in self.motions.values()]
        slopes = {str(state): row for state, row in zip(self.x, self.rhs, strict=True)}
        for coordinate, speed in zip(self.motions, speeds, strict=True):
            if coordinate in slopes and str(slopes[coordinate]) != speed:
                raise InputError(
                    f"rate of {coordinate!r} of {self.name!r}",
                    expected=f"{speed}, which is declared to be its speed",
                    got=str(slopes[coordinate]),
                    remedy="write its right-hand side so, or choose another name for the coordinate",
                )
            same = [state for state, slope in slopes.items() if state != coordinate and str(slope) == speed]
            if same:
                raise InputError(
                    f"state {same[0]!r} of {self.name!r}",
                    expected=f"one integral of the speed {speed}, the coordinate",
                    got=f"{same[0]}' = {speed} beside the coordinate {coordinate!r}: the same motion twice",
                    remedy=f"name the coordinate {same[0]!r}",
                )
        moving = [*self.motions, *speeds]
        return [*moving, *(str(state) for state in self.x if str(state) not in moving)]

    def _unit(self, name: str) -> str:
        """Return the unit of a state, an input or an output; a coordinate's is that of its speed times seconds."""
        if name in self.motions and name not in self.units:
            return self.units[self.motions[name][0]].removesuffix("/s")
        return self.units.get(name, "1")

    def __repr__(self) -> str:
        return f"Ode({self.name!r}, x={' '.join(map(str, self.x))!r}, u={' '.join(map(str, self.u))!r})"


def _row(speed: str, inertia: Any) -> Mapping[str, Any]:
    """Return a coordinate's row of the mass matrix by speed."""
    return inertia if isinstance(inertia, Mapping) else {speed: inertia}
