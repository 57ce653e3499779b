"""Equations of motion for a reader: text or LaTeX, by SymPy."""

from __future__ import annotations

from typing import Any, Literal

import sympy as sp

from harness.physics.symbolic.lumping import lagrangian
from harness.physics.symbolic.mechanism import Mechanism
from harness.physics.symbolic.ode import Ode

__all__ = ["equations"]


def equations(model: Mechanism | Ode, form: Literal["text", "latex"] = "text") -> list[str]:
    r"""Return the equations of a model: a line for each coordinate or state, and for outputs that are neither.

    Parameters
    ----------
    model : Mechanism or Ode
    form : {"text", "latex"}
        Plain text (``theta''`` is the second derivative) or LaTeX without dollar signs.

    Returns
    -------
    list of str

    Examples
    --------
    >>> from harness.physics.models import oscillator, pendulum
    >>> equations(pendulum())
    ["J*theta'' + b*theta' + mgl*sin(theta) = u"]
    >>> equations(oscillator(), "latex")[0].endswith("= u")
    True
    """
    if isinstance(model, Mechanism):
        rows = _mechanical(model)
        names = {str(symbol): 1 for symbol in model.v}
        plain = [str(symbol) for symbol in model.q]
    else:
        rows = [(sp.Symbol(f"v_{state}"), sp.sympify(rhs)) for state, rhs in zip(model.x, model.rhs, strict=True)]
        names, plain = {}, [str(symbol) for symbol in model.x]
    symbols = _Names({**names, **{f"v_{name}": 1 for name in plain}, **{f"a_{name}": 2 for name in plain}})
    lines = [f"{symbols.write(left, form)} = {symbols.write(right, form)}" for left, right in rows]
    for name, given in model.outputs.items():
        expression = sp.sympify(given[0] if isinstance(given, tuple) else given)
        if str(expression) != name:
            lines.append(f"{symbols.write(sp.Symbol(name), form)} = {symbols.write(expression, form)}")
    return lines


def _mechanical(model: Mechanism) -> list[tuple[Any, Any]]:
    """Return Lagrange's equations: everything with parameters on the left, the rest of Q on the right."""
    total = lagrangian(model)
    acceleration = [sp.Symbol(f"a_{symbol}", real=True) for symbol in model.q]
    parameters = set(model.p)
    rows = []
    for q, v, force in zip(model.q, model.v, model.forces(), strict=True):
        momentum = sp.diff(total, v)
        rate = sp.diff(momentum, model.t)
        for q_other, v_other, a_other in zip(model.q, model.v, acceleration, strict=True):
            rate += sp.diff(momentum, q_other) * v_other + sp.diff(momentum, v_other) * a_other
        left = sp.expand(rate - sp.diff(total, q))
        right = sp.Integer(0)
        for term in sp.Add.make_args(sp.expand(force)):
            if term.free_symbols & parameters or not term.free_symbols:
                left -= term
            else:
                right += term
        rows.append((sp.collect(_tidy(_short(left)), [*acceleration, *model.v]), right))
    return rows


def _short(expression: Any) -> Any:
    """Return an expression with the trigonometry simplified where that makes it shorter."""
    expanded = sp.expand(expression)
    shorter = sp.expand(sp.trigsimp(expanded)) if sp.count_ops(expanded) < 400 else expanded
    return shorter if sp.count_ops(shorter) < sp.count_ops(expanded) else expanded


class _Names:
    """Writes expressions with derivatives as primes or dots."""

    def __init__(self, orders: dict[str, int]) -> None:
        self.orders = orders

    def write(self, expression: Any, form: str) -> str:
        """Return the text of an expression."""
        table = {}
        for symbol in expression.free_symbols:
            name, order = str(symbol), self.orders.get(str(symbol), 0)
            if order:
                name = name[2:]
            table[symbol] = (name, order)
        if form == "latex":
            shown = {
                symbol: ("\\" + "d" * order + "ot{" + sp.latex(sp.Symbol(name)) + "}")
                if order
                else sp.latex(sp.Symbol(name))
                for symbol, (name, order) in table.items()
            }
            return str(sp.latex(_tidy(expression), symbol_names=shown))
        primed = {symbol: sp.Symbol(name + "'" * order) for symbol, (name, order) in table.items()}
        return str(_tidy(expression).xreplace(primed))


def _tidy(expression: Any) -> Any:
    """Return floats that are whole numbers as such."""
    return expression.xreplace(
        {number: sp.Integer(round(number)) for number in expression.atoms(sp.Float) if float(number).is_integer()}
    )
