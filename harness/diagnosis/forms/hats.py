"""Piecewise linear hat functions, the test functions of a free force."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

__all__ = ["hat_basis", "joint_basis"]


def hat_basis(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Return piecewise linear hat functions (N, K) of ``x`` (N,) at increasing ``knots`` (K,); flat outside.

    Examples
    --------
    >>> hat_basis(np.array([0.0, 0.25, 2.0]), np.array([0.0, 1.0])).tolist()
    [[1.0, 0.0], [0.75, 0.25], [0.0, 1.0]]
    """
    clipped = np.clip(np.asarray(x, dtype=float), knots[0], knots[-1])
    if knots.size == 1:
        return np.ones((clipped.size, 1))
    cell = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, knots.size - 2)
    part = (clipped - knots[cell]) / (knots[cell + 1] - knots[cell])
    basis = np.zeros((clipped.size, knots.size))
    rows = np.arange(clipped.size)
    basis[rows, cell] = 1 - part
    basis[rows, cell + 1] = part
    return basis


def joint_basis(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products (N, Ka * Kb) of two bases."""
    return (a[:, :, None] * b[:, None, :]).reshape(a.shape[0], -1)
