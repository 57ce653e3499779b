"""Fits without one stretch of the records each: what all linear identifiers take the spread of their answers from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import numpy as np

from harness.algebra import column_norms, divisor
from harness.models.spread import Matrices, Spread
from harness.signals import FloatArray
from identifiers.common.regression import Solution

GROUPS = 20
"""Stretches, each 5 % of the rows: long beside the memory of the noise, and 19 degrees of freedom (Kott 2001)."""
STRETCHES = f"jackknife: fits that leave out one of {GROUPS} stretches of the records"
CHECKED = 20_000  # Rows of a regression whose scatter is looked at: it is known to a part in a hundred from so many.
LARGEST = 200
"""Regressors, and states, beyond which no neighbours are kept: a system of equations for each, and a large file."""
LITTLE = 0.1
"""Steps along a covariance, in standard deviations: small enough that what follows is nearly linear in them."""
BIAS = (
    "residuals that are correlated in time (noise on measured outputs) also move the answer as a whole, by what no "
    "spread shows: use more lags, method iv, prediction-error or n4sid"
)
"""What is said of least squares on one-step equations whose residuals are not white."""


def edges(rows: int, groups: int = GROUPS) -> list[tuple[int, int]]:
    """Return first and last row (exclusive) of so many stretches of nearly equal length; none of too few rows.

    Examples
    --------
    >>> edges(41)[:3], edges(10)
    ([(0, 2), (2, 4), (4, 6)], [])
    """
    if rows < 2 * groups:
        return []
    cuts = np.linspace(0, rows, groups + 1).astype(int)
    return [(int(low), int(high)) for low, high in pairwise(cuts)]


def coefficients_without(
    blocks: Callable[[], Iterable[tuple[FloatArray, FloatArray]]], solution: Solution
) -> tuple[FloatArray, float] | None:
    """Return the coefficients (G, p, m) that a regression finds without one stretch each, and the factor of a spread.

    ``theta_g = theta - (H - H_g)^-1 S_g`` with ``H_g = sum phi phi'`` and ``S_g = sum phi e'`` of the stretch that is
    left out: exact for least squares, so that residuals that are correlated within a stretch, or larger here than
    there, count as they are.

    - ``blocks``: yields ``(Phi (n, p), Y (n, m))`` in the order of time, as for
      :func:`identifiers.common.regression.solve`
    - ``solution``: over all rows; with a ridge in its factor where there was one
    - returns array (G, p, m) and a number; None of too few rows or too many regressors

    Examples
    --------
    >>> from identifiers.common.regression import solve
    >>> rng = np.random.default_rng(0)
    >>> x = rng.normal(size=(400, 2))
    >>> y = x @ [[1.0], [2.0]] + rng.normal(size=(400, 1))
    >>> near, factor = coefficients_without(lambda: [(x, y)], solve(lambda: [(x, y)], "example"))
    >>> again = np.linalg.lstsq(x[20:], y[20:], rcond=None)[0]
    >>> bool(np.allclose(near[0], again)), near.shape
    (True, (20, 2, 1))
    """
    p, m = solution.coefficients.shape
    used = min(solution.rows, CHECKED)
    bounds = edges(used, GROUPS)
    if not bounds or p > LARGEST or used < solution.rows // GROUPS + p + 1:
        return None
    share = used / solution.rows
    gram, right = np.zeros((GROUPS, p, p)), np.zeros((GROUPS, p, m))
    place = 0
    for phi, y in blocks():
        for group, (low, high) in enumerate(bounds):
            first, last = max(low - place, 0), min(high - place, len(phi))
            if first < last:
                rows = phi[first:last] / solution.scale
                gram[group] += rows.T @ rows
                right[group] += rows.T @ (y[first:last] - phi[first:last] @ solution.coefficients)
        place += len(phi)
        if place >= used:
            break
    away = _left_out(share * solution.factor.T @ solution.factor, gram, right - right.mean(axis=0))
    return solution.coefficients + away / solution.scale[:, None], share * (GROUPS - 1) / GROUPS


def steps_without(gradients: FloatArray, errors: FloatArray) -> FloatArray | None:
    """Return the shifts of parameters (G, k) at the minimum of a sum of squares, one stretch of errors left out each.

    - ``gradients`` (N, k): of the errors; columns of zeros belong to parameters that are not fitted
    - ``errors`` (N,): record by record
    """
    bounds = edges(len(errors), GROUPS)
    if not bounds:
        return None
    length = column_norms(gradients)
    psi = gradients / length
    gram = np.array([psi[low:high].T @ psi[low:high] for low, high in bounds])
    right = np.array([-psi[low:high].T @ errors[low:high] for low, high in bounds])[..., None]
    return _left_out(gram.sum(axis=0), gram, right - right.mean(axis=0))[..., 0] / length


def along_covariance(values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return parameters (J, k) a little along each direction of a covariance, and the factor of their spread.

    Examples
    --------
    >>> near, factor = along_covariance(np.zeros(2), np.diag([4.0, 1.0]))
    >>> (factor * near.T @ near).round(9).tolist()
    [[4.0, 0.0], [0.0, 1.0]]
    """
    size = divisor(np.sqrt(np.diag(covariance)))
    squares, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    kept = squares > 1e-12 * max(float(squares[-1]), 1e-300)
    return values + LITTLE * (vectors[:, kept] * np.sqrt(squares[kept])).T * size, 1.0 / LITTLE**2


def _left_out(whole: FloatArray, gram: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``-(H - H_g)^-1 S_g`` of every stretch (G, p, m), in directions that the rest determines."""
    found = np.zeros_like(right)
    for group in range(len(gram)):
        values, vectors = np.linalg.eigh(whole - gram[group])
        good = values > 1e-14 * max(float(values[-1]), 1e-300)
        basis = vectors[:, good]
        found[group] = -basis @ ((basis.T @ right[group]) / values[good, None])
    return found


def stacked(triangle: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the triangle R of a triangle and rows below it: ``R' R`` is the sum of both Gram matrices."""
    return np.asarray(np.linalg.qr(np.vstack([triangle, rows]), mode="r"), dtype=np.float64)


def triangles_without(blocks: Iterable[FloatArray], rows: int, width: int) -> list[tuple[FloatArray, int]]:
    """Return the triangles of all rows but those of one stretch each, and how many rows are in them.

    The rows are read once: each stretch gets a triangle, and those before and after it are put together.

    - ``blocks`` iterable of array (n, width): in the order of time
    - ``rows, width``: of all blocks together
    - returns pairs of an array (width, width) and a count; none where a stretch less would leave too few rows

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(size=(100, 2))
    >>> found = triangles_without([x[:30], x[30:]], 100, 2)
    >>> r, kept = found[0]
    >>> bool(np.allclose(r.T @ r, x[5:].T @ x[5:])), kept, len(found)
    (True, 95, 20)
    """
    bounds = edges(rows)
    if not bounds or rows - max(high - low for low, high in bounds) < width:
        return []
    parts, place = [np.zeros((0, width)) for _ in bounds], 0
    for block in blocks:
        for group, (low, high) in enumerate(bounds):
            first, last = max(low - place, 0), min(high - place, len(block))
            if first < last:
                parts[group] = stacked(parts[group], block[first:last])
        place += len(block)
    before, after = [np.zeros((0, width))], [np.zeros((0, width))]
    for part in parts[:-1]:
        before.append(stacked(before[-1], part))
    for part in parts[:0:-1]:
        after.append(stacked(after[-1], part))
    return [
        (stacked(first, last), rows - (high - low))
        for first, last, (low, high) in zip(before, reversed(after), bounds, strict=True)
    ]


def spread_of(
    near: Sequence[Matrices],
    *,
    factor: float | None = None,
    freedom: float | None = None,
    method: str = "",
    warning: str = "",
) -> Spread | None:
    """Return the spread of neighbours; None where there are none, or they are too large to keep.

    - ``near`` sequence of (A, B, C, D): in the model's units and its number of states; one for each stretch left out
    - ``factor``: by default (G - 1) / G, that of the jackknife
    - ``freedom``: by default G - 1
    - ``method``: by default says how many stretches
    """
    if len(near) < 2 or len(near[0][0]) > LARGEST:
        return None
    a, b, c, d = (np.array([one[k] for one in near]) for k in range(4))
    if not all(np.isfinite(stack).all() for stack in (a, b, c, d)):
        return None
    count = len(near)
    share = (count - 1) / count if factor is None else factor
    free = float(count - 1) if freedom is None else freedom
    said = method or f"jackknife: fits that leave out one of {count} stretches of the records"
    return Spread(a, b, c, d, share, free, said, warning)
