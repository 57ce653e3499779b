"""Stable models: the nearest one to a fit that is not, in what it predicts on the data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from harness.models.lqr import spectral_radius
from harness.signals import FloatArray

__all__ = ["RADIUS", "clip_eigenvalues", "nearest_stable", "stable_lags"]

# Eigenvalues of a model that is asked to be stable stay within this: at 1 itself a free run never forgets its start.
RADIUS = 0.999
# Rounds of the search: each halves the rest at most, and costs one small eigenvalue problem.
_ROUNDS = 40


def clip_eigenvalues(a: FloatArray, radius: float = RADIUS) -> FloatArray:
    """Return A with the eigenvalues outside a circle moved onto it, eigenvectors and angles kept.

    Of a matrix without a full set of eigenvectors all eigenvalues are shrunk together.

    Examples
    --------
    >>> clip_eigenvalues(np.diag([1.2, 0.5]), 0.9).tolist()
    [[0.9, 0.0], [0.0, 0.5]]
    """
    values, vectors = np.linalg.eig(a)
    moduli = np.abs(values)
    if not a.size or moduli.max() <= radius:
        return a
    if np.linalg.cond(vectors) < 1e8:
        moved = np.where(moduli > radius, values / np.where(moduli > 0, moduli, 1.0) * radius, values)
        found: FloatArray = np.real(vectors @ np.diag(moved) @ np.linalg.inv(vectors))
        if spectral_radius(found) <= radius * (1 + 1e-6):
            return found
    return np.asarray(a * (radius / moduli.max()), dtype=np.float64)


def stable_lags(coefficients: FloatArray, radius: float = RADIUS) -> FloatArray:
    """Return coefficients (lags * ny, ny) of ``y[k+1] = sum A_i y[k-i]`` whose roots lie within a circle.

    One output: each root outside is moved onto the circle. Several: all roots shrink together (A_i times g^(i+1)).

    Examples
    --------
    >>> stable_lags(np.array([[2.0], [-0.75]]), 0.9).ravel().round(6).tolist()
    [1.4, -0.45]
    """
    ny = coefficients.shape[1]
    lags = coefficients.shape[0] // ny
    if ny == 1:
        roots = np.roots(np.concatenate([[1.0], -coefficients[:, 0]]))
        moduli = np.abs(roots)
        roots = np.where(moduli > radius, roots / np.where(moduli > 0, moduli, 1.0) * radius, roots)
        return -np.real(np.poly(roots))[1:, None] if roots.size == lags else coefficients
    companion = np.zeros((lags * ny, lags * ny))
    companion[:ny] = coefficients.T
    companion[ny:, :-ny] = np.eye((lags - 1) * ny)
    largest = spectral_radius(companion)
    shrink = min(1.0, radius / largest) if largest > 0 else 1.0
    return coefficients * np.repeat(shrink ** np.arange(1, lags + 1), ny)[:, None]


def nearest_stable(
    theta: FloatArray,
    factor: FloatArray,
    own: int,
    project: Callable[[FloatArray], FloatArray],
    weights: FloatArray,
) -> FloatArray:
    """Return the coefficients nearest to a fit whose state part is stable, in the predictions on the data.

    Minimises ``||factor (theta - new)||`` with outputs weighted: projected Newton steps with halving, the coefficients
    of inputs and constants solved for at each trial. (Projection on eigenvalues as in Mamakoukas, Abraham & Murphey
    2023, IEEE Trans. Robotics 39:3; the problem is not convex, and a step is kept only if it is nearer.)

    Parameters
    ----------
    theta : array (p, ny)
        The unconstrained fit; its first ``own`` rows are the coefficients of states or lagged outputs.
    factor : array (p, p)
        R with ``R' R`` the Gram matrix of the regressors.
    own : int
    project : callable
        Returns stable coefficients (own, ny) for any.
    weights : array (ny,)
        One over the size of each output.
    """
    left, remaining = factor[:, :own], factor[:, own:]

    def completed(part: FloatArray) -> tuple[float, FloatArray]:
        """Return the distance and the whole coefficients for a given state part."""
        miss = left @ (theta[:own] - part)
        others = (
            np.linalg.lstsq(remaining, miss, rcond=1e-12)[0] if remaining.shape[1] else np.zeros((0, theta.shape[1]))
        )
        lost = float(np.sum(((miss - remaining @ others) * weights) ** 2))
        return lost, np.vstack([part, theta[own:] + others])

    best = project(theta[:own])
    cost, found = completed(best)
    for _ in range(_ROUNDS):
        step, nearer = 1.0, False
        while step > 1e-4:
            trial = project(best + step * (theta[:own] - best))
            lost, whole = completed(trial)
            if lost < cost * (1 - 1e-9):
                best, cost, found, nearer = trial, lost, whole, True
                break
            step *= 0.5
        if not nearer:
            break
    return found
