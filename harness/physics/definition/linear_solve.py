"""Symbolic solution of M a = Q for a small symmetric positive definite M, unrolled (LDL', no pivoting)."""

from __future__ import annotations

from typing import Any

import casadi as ca


def solve_symmetric(matrix: Any, right: Any) -> Any:
    """Return the solution of a symmetric positive definite system.

    - ``matrix`` casadi.SX (n, n): only the lower triangle is read
    - ``right`` casadi.SX (n,)

    Examples
    --------
    >>> solve_symmetric(ca.SX([[2.0, 1.0], [1.0, 3.0]]), ca.SX([4.0, 7.0]))
    SX([1, 2])
    """
    n = int(matrix.shape[0])
    if n == 0:
        return ca.SX(0, 1)
    if n == 1:
        return right / matrix[0, 0]
    lower = [[ca.SX(0.0)] * n for _ in range(n)]
    pivot: list[Any] = []
    for column in range(n):
        total = matrix[column, column]
        for k in range(column):
            total = total - lower[column][k] * lower[column][k] * pivot[k]
        pivot.append(total)
        for row in range(column + 1, n):
            total = matrix[row, column]
            for k in range(column):
                total = total - lower[row][k] * lower[column][k] * pivot[k]
            lower[row][column] = total / pivot[column]
    forward: list[Any] = []
    for row in range(n):
        total = right[row]
        for k in range(row):
            total = total - lower[row][k] * forward[k]
        forward.append(total)
    solution: list[Any] = [None] * n
    for row in reversed(range(n)):
        total = forward[row] / pivot[row]
        for k in range(row + 1, n):
            total = total - lower[k][row] * solution[k]
        solution[row] = total
    return ca.vertcat(*solution)
