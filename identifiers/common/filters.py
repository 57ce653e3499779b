"""The filter that corrects a linear model by what it sees."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

__all__ = ["stationary_gain"]


def stationary_gain(a: FloatArray, c: FloatArray) -> FloatArray:
    """Return the filter gain of a stationary Kalman filter with equal noise on states and outputs.

    Parameters
    ----------
    a, c : array (nx, nx), (ny, nx)

    Returns
    -------
    array (nx, ny)
        ``L`` of ``x + L (y - C x)``; zeros where the Riccati equation has no solution.

    Examples
    --------
    >>> stationary_gain(np.array([[0.5]]), np.array([[1.0]])).round(4)
    array([[0.5311]])
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    try:
        p = solve_discrete_are(a.T, c.T, np.eye(a.shape[0]), np.eye(c.shape[0]))
    except (LinAlgError, ValueError):
        return np.zeros((a.shape[0], c.shape[0]))
    gain: FloatArray = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.eye(c.shape[0]))
    return gain
