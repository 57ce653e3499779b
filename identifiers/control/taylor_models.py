"""Quadratic Taylor models of CasADi functions: what a function is at most over many small boxes at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

_ROUNDING = 64 * float(np.finfo(float).eps)
"""Relative error of an operation on all coefficients, with room to spare: of some tens of products and sums each."""


class TaylorModel:
    """``c + l't + t'Qt + [-e, e]`` for t in ``[-1, 1]^m``, many at once; every operation encloses what it may give.

    Unlike plain intervals, what depends on the same t cancels up to second order (Makino & Berz 2003, *Int. J. Pure
    Appl. Math.* 4:379). What an operation leaves out, rounding included, goes into e.

    - ``constant, slope, bend, error`` (n,), (n, m), (n, m, m), (n,)

    Examples
    --------
    >>> t = TaylorModel(np.zeros(1), np.ones((1, 1)), np.zeros((1, 1, 1)), np.zeros(1))
    >>> none = t * t - t.square()
    >>> float(none.most()[0]) < 1e-12
    True
    """

    def __init__(self, constant: FloatArray, slope: FloatArray, bend: FloatArray, error: FloatArray) -> None:
        self.constant, self.slope, self.bend, self.error = constant, slope, bend, error

    def sizes(self) -> tuple[FloatArray, FloatArray]:
        """Return bounds of the linear and of the quadratic part (n,)."""
        return np.abs(self.slope).sum(axis=1), np.abs(self.bend).sum(axis=(1, 2))

    def most(self) -> FloatArray:
        """Return an upper bound (n,)."""
        linear, quadratic = self.sizes()
        return self._rounded(self.constant + linear + quadratic + self.error)

    def _rounded(self, value: FloatArray) -> FloatArray:
        linear, quadratic = self.sizes()
        return np.asarray(value + _ROUNDING * (np.abs(self.constant) + linear + quadratic))

    def _made(self, constant: FloatArray, slope: FloatArray, bend: FloatArray, error: FloatArray) -> TaylorModel:
        found = TaylorModel(constant, slope, bend, error)
        found.error = found._rounded(found.error)
        return found

    def __add__(self, other: TaylorModel) -> TaylorModel:
        made = self._made(
            self.constant + other.constant, self.slope + other.slope, self.bend + other.bend, self.error + other.error
        )
        made.error = made.error + _ROUNDING * (np.abs(self.constant) + np.abs(other.constant))  # what cancelled
        return made

    def __neg__(self) -> TaylorModel:
        return TaylorModel(-self.constant, -self.slope, -self.bend, self.error)

    def __sub__(self, other: TaylorModel) -> TaylorModel:
        return self + (-other)

    def __mul__(self, other: TaylorModel) -> TaylorModel:
        outer = self.slope[:, :, None] * other.slope[:, None, :]
        (a1, a2), (b1, b2) = self.sizes(), other.sizes()
        a0, b0 = np.abs(self.constant), np.abs(other.constant)
        error = (a0 + a1 + a2) * other.error + (b0 + b1 + b2) * self.error + self.error * other.error
        error = error + a1 * b2 + a2 * b1 + a2 * b2 + _ROUNDING * (a0 + a1 + a2) * (b0 + b1 + b2)
        return TaylorModel(
            self.constant * other.constant,
            self.constant[:, None] * other.slope + other.constant[:, None] * self.slope,
            self.constant[:, None, None] * other.bend + other.constant[:, None, None] * self.bend + outer,
            error,
        )

    def square(self) -> TaylorModel:
        """Return the square."""
        return self * self

    def _of(self, value: FloatArray, first: FloatArray, second: FloatArray, third: FloatArray) -> TaylorModel:
        """Return f of it, by f and two derivatives at the constant and a bound of the third wherever it may be."""
        linear, quadratic = self.sizes()
        away = linear + quadratic
        error = np.abs(first) * self.error + np.abs(second) * (away * self.error + 0.5 * self.error**2)
        error = (
            error + np.abs(second) * (linear * quadratic + 0.5 * quadratic**2) + third * (away + self.error) ** 3 / 6
        )
        outer = self.slope[:, :, None] * self.slope[:, None, :]
        return self._made(
            value,
            first[:, None] * self.slope,
            first[:, None, None] * self.bend + 0.5 * second[:, None, None] * outer,
            error + _ROUNDING * (np.abs(first) + np.abs(second) * away) * away,
        )

    def sine(self) -> TaylorModel:
        """Return the sine."""
        sine, cosine = np.sin(self.constant), np.cos(self.constant)
        return self._of(sine, cosine, -sine, np.ones_like(sine))

    def cosine(self) -> TaylorModel:
        """Return the cosine."""
        sine, cosine = np.sin(self.constant), np.cos(self.constant)
        return self._of(cosine, -sine, -cosine, np.ones_like(sine))

    def inverse(self) -> TaylorModel:
        """Return ``1 / x``; without bound where x may be 0."""
        away = self.sizes()
        least = np.abs(self.constant) - away[0] - away[1] - self.error
        sure = least > 0
        c = np.where(sure, self.constant, 1.0)
        third = np.where(sure, 6.0 / np.where(sure, least, 1.0) ** 4, np.inf)
        return self._of(1.0 / c, -1.0 / c**2, 2.0 / c**3, third)

    def root(self) -> TaylorModel:
        """Return the square root; without bound where x may be 0 or less."""
        away = self.sizes()
        least = self.constant - away[0] - away[1] - self.error
        sure = least > 0
        c = np.where(sure, self.constant, 1.0)
        third = np.where(sure, 0.375 / np.where(sure, least, 1.0) ** 2.5, np.inf)
        return self._of(np.sqrt(c), 0.5 / np.sqrt(c), -0.25 / c**1.5, third)


def bounded(function: Any, middle: FloatArray, half: FloatArray, *fixed: tuple[FloatArray, FloatArray]) -> TaylorModel:
    """Return the Taylor model of a scalar CasADi function over boxes of its first input.

    Raises InputError if the function holds another operation.

    - ``function``: of SX expressions of sums, products, quotients, squares, roots, sines and cosines; one scalar
      output, dense
    - ``middle, half`` (n, m): middles and half widths of n boxes
    - ``*fixed`` (value, error), arrays (size,): the other inputs, by columns, the same for all boxes, and how far each
      may be off

    Examples
    --------
    >>> import casadi as ca
    >>> x = ca.SX.sym("x", 2)
    >>> f = ca.Function("f", [x], [ca.sin(x[0]) * x[1]])
    >>> float(bounded(f, np.array([[0.5, 1.0]]), np.array([[0.01, 0.01]])).most()[0].round(3))
    0.493
    """
    import casadi as ca

    n, m = middle.shape
    flat, none = np.zeros((1, m)), np.zeros((1, m, m))
    work: list[Any] = [None] * function.sz_w()
    pairs: dict[int, Callable[..., TaylorModel]] = {
        ca.OP_ADD: TaylorModel.__add__, ca.OP_SUB: TaylorModel.__sub__, ca.OP_MUL: TaylorModel.__mul__,
        ca.OP_DIV: lambda one, other: one * other.inverse(),
    }  # fmt: skip
    singles: dict[int, Callable[..., TaylorModel]] = {
        ca.OP_NEG: TaylorModel.__neg__, ca.OP_INV: TaylorModel.inverse, ca.OP_SQ: TaylorModel.square,
        ca.OP_SQRT: TaylorModel.root, ca.OP_SIN: TaylorModel.sine, ca.OP_COS: TaylorModel.cosine,
        ca.OP_TWICE: lambda one: one + one, ca.OP_ASSIGN: lambda one: one,
    }  # fmt: skip
    result = TaylorModel(np.zeros(n), np.zeros((n, m)), np.zeros((n, m, m)), np.zeros(n))
    for k in range(function.n_instructions()):
        kind, into, come = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if kind == ca.OP_CONST:
            work[into[0]] = TaylorModel(np.array([function.instruction_constant(k)]), flat, none, np.zeros(1))
        elif kind == ca.OP_INPUT and come[0] == 0:
            slope = np.zeros((n, m))
            slope[:, come[1]] = half[:, come[1]]
            work[into[0]] = TaylorModel(middle[:, come[1]], slope, none, np.zeros(1))
        elif kind == ca.OP_INPUT:
            value, off = fixed[come[0] - 1]
            work[into[0]] = TaylorModel(value[come[1] : come[1] + 1], flat, none, off[come[1] : come[1] + 1])
        elif kind == ca.OP_OUTPUT:
            result = work[come[0]]
        elif kind in pairs:
            work[into[0]] = pairs[kind](work[come[0]], work[come[1]])
        elif kind in singles:
            work[into[0]] = singles[kind](work[come[0]])
        else:
            raise InputError(
                "bound of a function",
                expected="sums, products, quotients, squares, roots, sines and cosines",
                got=f"operation {kind} of CasADi",
                remedy="write the model with these",
            )
    return result
