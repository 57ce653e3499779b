"""Fits of one-step equations in other norms over the outputs: the sum over samples of the largest component."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray

__all__ = ["largest_components"]


def largest_components(x: FloatArray, y: FloatArray, what: str) -> FloatArray:
    """Return theta (p, m) that minimises ``sum_n max_i |y[n, i] - (x[n] theta)_i|``, by a linear program.

    The l-infinity criterion of the exercise on objectives in Tedrake, *Underactuated Robotics*, ch. 18: the largest
    component of each sample's error, summed over samples (Boyd & Vandenberghe 2004, *Convex Optimization*, sec. 6.1).

    Parameters
    ----------
    x, y : array (N, p), (N, m)
    what : str
        For messages.

    Raises
    ------
    FitError
        If the solver finds no optimum.

    Examples
    --------
    >>> x, y = np.ones((3, 1)), np.array([[0.0, 0.0], [0.0, 4.0], [0.0, 4.0]])
    >>> largest_components(x, y, "x").round(6).tolist()
    [[0.0, 4.0]]
    """
    from scipy import sparse
    from scipy.optimize import linprog

    n, p = x.shape
    m = y.shape[1]
    length = np.linalg.norm(x, axis=0)
    length = np.where(length > 0, length, 1.0)
    unit = float(np.abs(y).max()) or 1.0
    columns = sparse.kron(sparse.csr_matrix(x / length), sparse.identity(m), format="csr")  # rows: sample, component
    bound = sparse.kron(sparse.identity(n), np.ones((m, 1)), format="csr")
    above: Any = sparse.vstack([sparse.hstack([columns, -bound]), sparse.hstack([-columns, -bound])]).tocsr()
    target = (y / unit).ravel()
    bounds: list[tuple[float | None, float | None]] = [(None, None)] * (p * m) + [(0.0, None)] * n
    found = linprog(
        np.concatenate([np.zeros(p * m), np.ones(n)]),
        A_ub=above,
        b_ub=np.concatenate([target, -target]),
        bounds=bounds,
        method="highs",
    )
    if found.status != 0 or found.x is None:
        raise FitError(
            f"{what}: the linear program has no solution",
            expected="a bounded optimum",
            got=str(found.message),
            remedy="use least squares",
        )
    theta: FloatArray = found.x[: p * m].reshape(p, m) * unit / length[:, None]
    return theta
