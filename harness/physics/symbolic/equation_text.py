"""Equations of motion for a reader: text or LaTeX, by SymPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import sympy as sp

from harness.physics.symbolic.lumping import lagrangian, without_squared_sines
from harness.physics.symbolic.mechanism import Mechanism
from harness.physics.symbolic.ode import Ode

SIMPLE = 200
"""Operations up to which identities of several angles are tried: minutes for an arm with all its parameters."""
SHORT = 12  # Largest denominator of a fraction that is read more easily than a decimal.


def equations(model: Mechanism | Ode, form: Literal["text", "latex"] = "text") -> list[str]:
    r"""Return the equations of a model: a line for each coordinate or state, and for outputs that are neither.

    Parameters
    ----------
    model : Mechanism or Ode
    form : {"text", "latex"}
        Plain text (``theta''`` is the second derivative) or LaTeX without dollar signs.

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
    else:
        coupled = {speed: row for speed, row in model.motions.values() if isinstance(row, Mapping)}
        rows = [
            (_changing(coupled.get(str(state), {str(state): 1})), sp.sympify(rhs))
            for state, rhs in zip(model.x, model.rhs, strict=True)
        ]
    symbols = _names(model)
    lines = [f"{symbols.write(left, form)} = {symbols.write(right, form)}" for left, right in rows]
    for name, given in model.outputs.items():
        expression = sp.sympify(given[0] if isinstance(given, tuple) else given)
        if str(expression) != name:
            lines.append(f"{symbols.write(sp.Symbol(name), form)} = {symbols.write(expression, form)}")
    return lines


def _changing(row: Mapping[str, Any]) -> Any:
    """Return the left side of an equation: rates of states by what multiplies them."""
    return sum((sp.sympify(entry) * sp.Symbol(f"v_{state}") for state, entry in row.items()), sp.Integer(0))


def written(expression: Any, model: Mechanism | Ode, form: Literal["text", "latex"] = "text") -> str:
    """Return one expression as :func:`equations` writes it; ``v_theta`` is a rate, ``a_theta`` an acceleration.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> written(sp.Symbol("J") * sp.Symbol("a_theta"), pendulum())
    "J*theta''"
    """
    return _names(model).write(_short(sp.sympify(expression)), form)


def _names(model: Mechanism | Ode) -> _Names:
    """Return the writer of the derivatives of a model."""
    rates = {str(symbol): 1 for symbol in model.v} if isinstance(model, Mechanism) else {}
    plain = [str(symbol) for symbol in (model.q if isinstance(model, Mechanism) else model.x)]
    return _Names({**rates, **{f"v_{name}": 1 for name in plain}, **{f"a_{name}": 2 for name in plain}})


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
    tried = [expanded, without_squared_sines(expanded)]
    angles = {node.args[0] for node in expanded.atoms(sp.sin, sp.cos)}
    if len(angles) > 1 and min(map(sp.count_ops, tried)) < SIMPLE:
        tried.append(sp.expand(sp.trigsimp(expanded)))
    return min(tried, key=sp.count_ops)


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
    """Return floats that are whole numbers as such, and long fractions as decimals."""
    whole = {number: sp.Integer(round(number)) for number in expression.atoms(sp.Float) if float(number).is_integer()}
    long = {number: sp.Float(float(number), 15) for number in expression.atoms(sp.Rational) if number.q > SHORT}
    return expression.xreplace({**whole, **long})
