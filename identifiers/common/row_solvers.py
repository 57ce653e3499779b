"""Solvers of linear equations between parameters and motion: weighted, total, instrumental, robust."""

from __future__ import annotations

from typing import Literal

import numpy as np

from harness.algebra import column_norms
from harness.errors import FitError
from harness.signals import FloatArray

Estimator = Literal["least-squares", "unweighted", "total", "instruments", "huber", "l1"]
HUBER = 1.345
"""Residuals above so many robust standard deviations weigh less: 95 % efficiency at the normal (Huber 1981, ch. 4)."""


def whitening(residuals: FloatArray) -> FloatArray:
    """Return L' (n, n) such that the residuals of one instant, times it, have the unit covariance.

    - ``residuals`` (N, n): of the equations of n coordinates

    Notes
    -----
    The coordinates' equations have units of their own and share their noise: they weigh by the inverse of their joint
    covariance (generalised least squares; Aitken 1936).
    """
    n = residuals.shape[1]
    covariance = residuals.T @ residuals / max(len(residuals), 1)
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    # 1e-6: coordinates without any residual would else weigh infinitely
    correlation = covariance / np.outer(scale, scale) + 1e-6 * np.eye(n)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)) / scale)


def total(rows: FloatArray, target: FloatArray, noise: FloatArray, noise_target: FloatArray, what: str) -> FloatArray:
    """Return theta (k,) of equations whose rows are as noisy as their target.

    Generalised total least squares: the direction in which ``[rows, target]`` moves least, measured by what noise alone
    makes of it (Van Huffel & Vandewalle 1989, SIAM J. Matrix Anal. 10:294; consistent if the noise is so).

    Raises FitError if the direction found does not contain the target.

    - ``rows, target`` (M, k), (M,)
    - ``noise, noise_target`` (M, k), (M,): what noise alone changes in them: those of a noisier copy of the records,
      minus these
    - ``what``: for messages
    """
    from scipy.linalg import eigh

    both, shaken = np.column_stack([rows, target]), np.column_stack([noise, noise_target])
    size = column_norms(both)
    gram, error = (both / size).T @ (both / size), (shaken / size).T @ (shaken / size)
    # A floor for columns without noise (known inputs): rounding.
    error = error + 1e-13 * np.eye(len(size)) * max(float(np.trace(error)), 1e-12)
    vector = eigh(gram, error)[1][:, 0]
    if abs(vector[-1]) < 1e-9 * np.abs(vector).max():
        raise FitError(
            f"{what}: no total least squares solution",
            expected="a direction of least motion that contains the known side",
            got="parameters that stand against each other",
            remedy="excite the plant more richly, or use least-squares",
        )
    found: FloatArray = -vector[:-1] / size[:-1] / vector[-1] * size[-1]
    return found


def instrumental(rows: FloatArray, target: FloatArray, instruments: FloatArray, what: str) -> FloatArray:
    """Return theta (k,) of ``instruments' (target - rows theta) = 0``.

    Raises FitError if the instruments do not determine theta.

    - ``rows, target`` (M, k), (M,)
    - ``instruments`` (M, k): the rows of a simulated motion, which sensor noise has not reached (Janot, Vandanjon &
      Gautier 2014, IEEE Trans. Control Syst. Technol. 22:132).
    - ``what``: for messages
    """
    size, length = column_norms(rows), column_norms(instruments)
    cross = (instruments / length).T @ (rows / size)
    if np.linalg.cond(cross) > 1e10:
        raise FitError(
            f"{what}: the simulated motion does not determine the parameters",
            expected="instruments that move with the regressor",
            got="a direction without motion",
            remedy="excite the plant more richly",
        )
    found: FloatArray = np.linalg.solve(cross, (instruments / length).T @ target) / size
    return found


def huber(rows: FloatArray, target: FloatArray, *, iterations: int = 50) -> tuple[FloatArray, FloatArray]:
    """Return theta (k,) and weights (M,) of Huber's criterion, by iterated weights.

    - ``rows, target`` (M, k), (M,)
    - ``iterations``: at most

    Examples
    --------
    >>> x = np.ones((9, 1))
    >>> y = np.array([1.0, 1.1, 0.9, 1.0, 1.1, 0.9, 1.0, 1.0, 50.0])
    >>> bool(abs(huber(x, y)[0][0] - 1.0) < 0.1)
    True
    """
    weights = np.ones(len(target))
    size = column_norms(rows)
    theta: FloatArray = np.zeros(rows.shape[1])
    for number in range(iterations):
        root = np.sqrt(weights)
        new = np.asarray(np.linalg.lstsq(rows / size * root[:, None], target * root, rcond=None)[0], dtype=np.float64)
        residual = target - rows / size @ new
        # 1.4826: median absolute deviation to standard deviation of a normal
        spread = 1.4826 * float(np.median(np.abs(residual)))
        if spread == 0.0 or (number and np.allclose(new, theta, rtol=1e-10, atol=1e-14)):
            return new / size, weights
        theta = np.asarray(new, dtype=np.float64)
        weights = np.minimum(1.0, HUBER * spread / np.maximum(np.abs(residual), 1e-300))
    return theta / size, weights
