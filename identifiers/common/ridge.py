"""Ridge regression whose penalty the data choose."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

__all__ = ["ridge_by_cross_validation"]

# Candidates: none, and half decades of the largest squared singular value of the columns, down to rounding.
_PENALTIES = np.concatenate([[0.0], 10.0 ** np.arange(-16.0, 0.0, 0.5)])
# Directions of the columns below this share of the largest are rounding.
_ROUNDING = 1e-10


def ridge_by_cross_validation(columns: FloatArray, targets: FloatArray, samples: int) -> FloatArray:
    """Return the ridge solution of least generalised cross-validation (Golub, Heath & Wahba 1979, eq. 1.4).

    Parameters
    ----------
    columns : array (n, k)
        Centred columns of similar size, or the triangle of their QR decomposition.
    targets : array (n, m)
        What they explain, in the same rows.
    samples : int
        Rows before the decomposition.

    Returns
    -------
    array (k, m)

    Examples
    --------
    Two columns that are almost the same share what one of them would have to take alone:

    >>> rng = np.random.default_rng(0)
    >>> first = rng.normal(size=(200, 1))
    >>> columns = np.hstack([first, first + 1e-6 * rng.normal(size=(200, 1))])
    >>> targets = 2.0 * first + 0.1 * rng.normal(size=(200, 1))
    >>> ridge_by_cross_validation(columns, targets, 200).round(1).ravel()
    array([1., 1.])
    """
    left, values, right = np.linalg.svd(columns, full_matrices=False)
    keep = values > _ROUNDING * values[0]
    left, values, right = left[:, keep], values[keep], right[keep]
    found = left.T @ targets
    unexplained = float(np.sum(targets**2) - np.sum(found**2))

    def criterion(penalty: float) -> float:
        share = values**2 / (values**2 + penalty)
        residual = max(unexplained, 0.0) + float(np.sum(((1.0 - share)[:, None] * found) ** 2))
        return residual / max(samples - float(share.sum()), 1.0) ** 2

    penalties = _PENALTIES * values[0] ** 2
    penalty = penalties[int(np.argmin([criterion(trial) for trial in penalties]))]
    solution: FloatArray = right.T @ ((values / (values**2 + penalty))[:, None] * found)
    return solution
