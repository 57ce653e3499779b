"""Arithmetic that every room needs: sizes to divide by, what columns span, one step of Runge-Kutta."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.signals import FloatArray


def divisor(size: Any) -> FloatArray:
    """Return sizes, 1 where one is 0: what is silent stays as it is.

    - ``size``: not negative

    Examples
    --------
    >>> divisor(np.array([2.0, 0.0]))
    array([2., 1.])
    """
    return np.where(size > 0, size, 1.0)


def column_norms(matrix: FloatArray) -> FloatArray:
    """Return the length of each column, 1 for an empty one.

    Shapes: ``matrix`` (N, p).

    - returns array (p,)

    Examples
    --------
    >>> column_norms(np.array([[3.0, 0.0], [4.0, 0.0]]))
    array([5., 1.])
    """
    return divisor(np.linalg.norm(matrix, axis=0))


def unit_columns(matrix: FloatArray) -> FloatArray:
    """Return columns of length 1; those of zeros stay.

    Examples
    --------
    >>> unit_columns(np.array([[3.0, 0.0], [4.0, 0.0]]))
    array([[0.6, 0. ],
           [0.8, 0. ]])
    """
    return np.asarray(matrix / column_norms(matrix), dtype=np.float64)


def orthonormal(matrix: FloatArray, tolerance: float) -> FloatArray:
    """Return an orthonormal basis (N, r) of what columns span.

    - ``matrix`` (N, p): its columns count alike, whatever their units
    - ``tolerance``: directions below this share of the largest are rounding

    Examples
    --------
    >>> orthonormal(np.array([[1.0, 2.0], [1.0, 2.0], [0.0, 0.0]]), 1e-10).shape
    (3, 1)
    """
    left, values, _ = np.linalg.svd(unit_columns(matrix), full_matrices=False)
    return np.asarray(left[:, values > tolerance * values.max(initial=0.0)], dtype=np.float64)


def least_squares(matrix: FloatArray, target: FloatArray, tolerance: float) -> FloatArray:
    """Return the smallest least-squares solution of columns at unit length, in their own units.

    - ``matrix`` (N, p)
    - ``target`` (N,) or (N, m)
    - ``tolerance``: directions below this share of the largest are left out
    - returns array (p,) or (p, m)

    Examples
    --------
    >>> least_squares(np.array([[1.0, 1e6], [1.0, 3e6]]), np.array([2.0, 4.0]), 1e-10).round(9)
    array([1.e+00, 1.e-06])
    """
    norms = column_norms(matrix)
    return np.asarray((np.linalg.lstsq(matrix / norms, target, rcond=tolerance)[0].T / norms).T)


def runge_kutta(rates: Callable[[Any], Any], x: Any, h: float) -> Any:
    """Return the state after one step of the classical method of order four.

    - ``rates``: state to its rate of change: arrays, or expressions of a symbolic library
    - ``x`` array or expression
    - ``h``: step [s]

    Examples
    --------
    >>> round(runge_kutta(lambda x: -x, 1.0, 0.1), 7)
    0.9048375
    """
    return advanced(lambda now, share: rates(now), x, h, 1)


def advanced(rates: Callable[[Any, float], Any], x: Any, h: float, parts: int) -> Any:
    """Return the state after a step in so many parts, each by that method, of rates that change meanwhile.

    - ``rates``: state, and the share of the step that has gone by, to its rate of change
    - ``x`` array or expression
    - ``h``: step [s]

    Examples
    --------
    >>> round(advanced(lambda x, share: share - x, 1.0, 0.5, 4), 5)
    0.81959
    """
    part = h / parts
    for k in range(parts):
        first, middle, last = k / parts, (k + 0.5) / parts, (k + 1) / parts
        k1 = rates(x, first)
        k2 = rates(x + part / 2 * k1, middle)
        k3 = rates(x + part / 2 * k2, middle)
        k4 = rates(x + part * k3, last)
        x = x + part / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
