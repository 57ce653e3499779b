"""From a SymPy expression to a CasADi expression, by a walk over the tree."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import casadi as ca
import sympy as sp

from harness.errors import InputError

_UNARY: dict[Any, Callable[[Any], Any]] = {
    sp.sin: ca.sin,
    sp.cos: ca.cos,
    sp.tan: ca.tan,
    sp.asin: ca.asin,
    sp.acos: ca.acos,
    sp.atan: ca.atan,
    sp.sinh: ca.sinh,
    sp.cosh: ca.cosh,
    sp.tanh: ca.tanh,
    sp.exp: ca.exp,
    sp.log: ca.log,
    sp.Abs: ca.fabs,
    sp.sign: ca.sign,
    sp.floor: ca.floor,
    sp.ceiling: ca.ceil,
    sp.erf: ca.erf,
}

_JOINED: dict[Any, Callable[[Any, Any], Any]] = {
    sp.Add: operator.add,
    sp.Mul: operator.mul,
    sp.Max: ca.fmax,
    sp.Min: ca.fmin,
    sp.And: ca.logic_and,
    sp.Or: ca.logic_or,
    sp.atan2: ca.atan2,
    sp.StrictLessThan: operator.lt,
    sp.LessThan: operator.le,
    sp.StrictGreaterThan: operator.gt,
    sp.GreaterThan: operator.ge,
}
"""What joins the arguments of a node, from the left."""


def to_casadi(expression: Any, symbols: Mapping[Any, Any]) -> Any:
    """Return a SymPy expression as a CasADi SX.

    Raises InputError if a symbol or a function is unknown.

    - ``expression``: text is refused: nothing that a user names is ever evaluated
    - ``symbols``: casADi symbol of every SymPy symbol

    Examples
    --------
    >>> a, x = sp.Symbol("a"), ca.SX.sym("x")
    >>> to_casadi(2 * sp.sin(a) ** 2 + 1, {a: x})
    SX((1+(2.*sq(sin(x)))))
    """
    if isinstance(expression, int | float):
        return ca.SX(expression)
    if not isinstance(expression, sp.Basic):
        raise InputError(
            "expression of a model",
            expected="a SymPy expression or a number",
            got=repr(expression),
            remedy="build it from the model's own symbols",
        )
    return _walk(expression, symbols, {})


def _walk(node: Any, symbols: Mapping[Any, Any], seen: dict[Any, Any]) -> Any:
    """Convert one node, each distinct node once."""
    if node in seen:
        return seen[node]
    result = _convert(node, symbols, seen)
    seen[node] = result
    return result


def _convert(node: Any, symbols: Mapping[Any, Any], seen: dict[Any, Any]) -> Any:
    if isinstance(node, sp.Symbol):
        if node not in symbols:
            raise InputError(
                "unknown symbol in a model",
                expected=f"one of {', '.join(str(symbol) for symbol in symbols)}",
                got=str(node),
                remedy="declare it as a coordinate, an input or a parameter",
            )
        return symbols[node]
    if node.is_Number or isinstance(node, sp.NumberSymbol):
        return ca.SX(float(node))
    if node is sp.true or node is sp.false:
        return ca.SX(1.0 if node is sp.true else 0.0)
    if isinstance(node, sp.Piecewise):
        result = ca.SX(float("nan"))
        for value, condition in reversed(node.args):
            branch = _walk(value, symbols, seen)
            result = branch if condition is sp.true else ca.if_else(_walk(condition, symbols, seen), branch, result)
        return result
    if isinstance(node, sp.Heaviside):
        return ca.if_else(_walk(node.args[0], symbols, seen) >= 0, 1.0, 0.0)
    arguments = [_walk(argument, symbols, seen) for argument in node.args]
    if isinstance(node, sp.Pow):
        return _power(node, arguments)
    for kind, join in _JOINED.items():
        if isinstance(node, kind):
            return reduce(join, arguments)
    if node.func in _UNARY:
        return _UNARY[node.func](arguments[0])
    raise InputError(
        "function in a model",
        expected="+ - * / **, " + ", ".join(sorted(kind.__name__ for kind in _UNARY)) + ", atan2, Max, Min, Piecewise",
        got=str(node.func),
        remedy="write it with these functions",
    )


def _power(node: Any, arguments: list[Any]) -> Any:
    """Return a power; small integers and halves in the form that keeps derivatives finite and cheap."""
    base, exponent = arguments
    if node.args[1].is_Integer:
        count = int(node.args[1])
        if 0 <= abs(count) <= 8:
            power = ca.SX(1.0)
            for _ in range(abs(count)):
                power = power * base
            return power if count >= 0 else 1.0 / power
    if node.args[1] == sp.Rational(1, 2):
        return ca.sqrt(base)
    if node.args[1] == sp.Rational(-1, 2):
        return 1.0 / ca.sqrt(base)
    return base**exponent
