"""Ode: a model that is not mechanical, written once in SymPy as differential equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import sympy as sp

from harness.errors import InputError
from harness.physics.compiled.system import System
from harness.physics.definition.parameters import Parameter, as_parameter
from harness.physics.symbolic.convert import to_casadi
from harness.physics.symbolic.mechanism import _check_names
from harness.signals import Channel

__all__ = ["Ode"]


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

    def parameter_list(self) -> tuple[Parameter, ...]:
        """Return the parameters, in the order of ``p``."""
        return tuple(self._parameters.get(str(symbol), Parameter(str(symbol))) for symbol in self.p)

    def system(self) -> System:
        """Return the equations as a :class:`System`."""
        if len(list(self.rhs)) != len(self.x):
            raise InputError(
                f"right-hand sides of {self.name!r}",
                expected=f"{len(self.x)}, one for each of {', '.join(map(str, self.x))}",
                got=str(len(list(self.rhs))),
                remedy="give rhs one expression for each state",
            )
        x, u, p = ca.SX.sym("x", len(self.x)), ca.SX.sym("u", len(self.u)), ca.SX.sym("p", len(self.p))
        t = ca.SX.sym("t")
        table: dict[Any, Any] = {self.t: t}
        for symbols, column in ((self.x, x), (self.u, u), (self.p, p)):
            table.update({symbol: column[row] for row, symbol in enumerate(symbols)})

        def convert(expression: Any) -> Any:
            return to_casadi(sp.sympify(expression, strict=True), table)

        chosen: dict[str, Any] = self.outputs or {str(symbol): symbol for symbol in self.x}
        channels, rows = [], []
        for name, given in chosen.items():
            expression, unit = given if isinstance(given, tuple) else (given, self.units.get(name, "1"))
            channels.append(Channel(name, unit))
            rows.append(convert(expression))
        return System(
            name=self.name,
            inputs=tuple(Channel(str(symbol), self.units.get(str(symbol), "1")) for symbol in self.u),
            outputs=tuple(channels),
            states=tuple(Channel(str(symbol), self.units.get(str(symbol), "1")) for symbol in self.x),
            parameters=self.parameter_list(),
            x=x,
            u=u,
            p=p,
            t=t,
            gravity=ca.SX.sym("gravity", 2),
            mass_matrix=ca.SX(0, 0),
            generalized_forces=ca.SX(0, 1),
            rates=ca.vertcat(*(convert(row) for row in self.rhs)) if self.x else ca.SX(0, 1),
            h=ca.vertcat(*rows),
            loads=ca.SX(0, 1),
            mechanism=self,
            process=self.process,
            starts=self.starts,
        )

    def __repr__(self) -> str:
        return f"Ode({self.name!r}, x={' '.join(map(str, self.x))!r}, u={' '.join(map(str, self.u))!r})"
