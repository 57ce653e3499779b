"""Kernels of impulse responses, and the marginal likelihood by which the data choose their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from harness.signals import FloatArray

Kernel = Literal["tc", "dc", "ss"]
KERNELS: tuple[Kernel, ...] = ("tc", "dc", "ss")
# Of a kernel's largest eigenvalue: below it a direction is rounding, and expected to be none.
_ROUNDING = 1e-14


def kernel_matrix(kernel: Kernel, length: int, decay: float, correlation: float = 0.0) -> FloatArray:
    """Return the covariance (length, length) of an impulse response, whose variance at lag i is ``d^i``.

    With i, j = 0, 1, ... and m the larger: TC ``d^m`` and DC ``d^((i + j) / 2) r^|i - j|`` (Chen, Ohlsson & Ljung 2012,
    Automatica 48:1525, sec. 4), SS ``3/2 d^((i + j + m) / 3) - 1/2 d^m`` (the stable spline of second order: Pillonetto
    & De Nicolao 2010, Automatica 46:81, sec. 3; here scaled to a first variance of 1).

    - ``kernel`` {"tc", "dc", "ss"}
    - ``decay``: d, between 0 and 1, of the variance from sample to sample
    - ``correlation``: r of DC, between -1 and 1; TC is that of ``sqrt(d)``, and 0 is DI, the diagonal

    Examples
    --------
    >>> kernel_matrix("tc", 3, 0.25).tolist()
    [[1.0, 0.25, 0.0625], [0.25, 0.25, 0.0625], [0.0625, 0.0625, 0.0625]]
    >>> bool(np.allclose(kernel_matrix("dc", 5, 0.25, 0.5), kernel_matrix("tc", 5, 0.25)))
    True
    """
    i, j = np.meshgrid(np.arange(length), np.arange(length), indexing="ij")
    late = np.maximum(i, j)
    if kernel == "tc":
        return np.asarray(decay**late, dtype=float)
    if kernel == "dc":
        return np.asarray(decay ** ((i + j) / 2.0) * float(correlation) ** np.abs(i - j), dtype=float)
    return np.asarray(1.5 * decay ** ((i + j + late) / 3.0) - 0.5 * decay**late, dtype=float)


def kernel_root(kernel: Kernel, length: int, decay: float, correlation: float = 0.0) -> FloatArray:
    """Return L (length, length) with ``L L'`` the kernel; closed for TC and DC.

    - ``kernel, length, decay, correlation``: as of :func:`kernel_matrix`

    Examples
    --------
    >>> all(np.allclose((r := kernel_root(k, 6, 0.7, 0.3)) @ r.T, kernel_matrix(k, 6, 0.7, 0.3)) for k in KERNELS)
    True
    """
    lags = np.arange(length)
    if kernel == "tc":  # a random walk backwards from the end
        return np.asarray(np.triu(np.broadcast_to(_steps(decay, length), (length, length))))
    if kernel == "dc":  # an autoregression of first order, fading
        apart = lags[:, None] - lags
        root = np.where(apart >= 0, float(correlation) ** np.maximum(apart, 0), 0.0)
        root[:, 1:] *= np.sqrt(1.0 - correlation**2)
        return np.asarray(decay ** (lags / 2.0)[:, None] * root)
    values, vectors = np.linalg.eigh(kernel_matrix(kernel, length, decay))
    return np.asarray(vectors * np.sqrt(np.clip(values, _ROUNDING * values[-1], None)))


def _steps(decay: float, length: int) -> FloatArray:
    lags = np.arange(length)
    return np.asarray(np.sqrt(decay**lags * np.where(lags < length - 1, 1.0 - decay, 1.0)))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a prior makes of the data."""

    value: float  # ``-2 ln`` of the marginal likelihood but for a constant, the noise at its best
    noise: float  # Variance of the noise
    mean: FloatArray  # (p,): Of the coefficients, given the data
    root: FloatArray  # (p, p): Their covariance is ``root root'``


def evidence(gram: FloatArray, right: FloatArray, square: float, rows: int, root: FloatArray) -> Evidence:
    """Return the marginal likelihood of ``y = Phi g + e`` under ``g ~ N(0, s^2 root root')``, ``e ~ N(0, s^2)``.

    The noise's variance s^2 has its maximum in closed form, ``y' (I + Phi K Phi')^-1 y / N`` (Chen, Ohlsson & Ljung
    2012, sec. 5, with their P over s^2), so that outputs of unequal noise each have their own.

    - ``gram`` (p, p): ``Phi' Phi``
    - ``right`` (p,): ``Phi' y``
    - ``square``: ``y' y``
    - ``rows``: N
    - ``root`` (p, p)

    Examples
    --------
    >>> found = evidence(np.array([[100.0]]), np.array([50.0]), 26.0, 100, np.array([[10.0]]))
    >>> round(float(found.mean[0]), 3), round(found.noise, 3)
    (0.5, 0.01)
    """
    value, noise, factor, seen = _weighed(gram, right, square, rows, root)
    spread = np.linalg.solve(factor, root.T).T
    return Evidence(value, noise, spread @ seen, np.sqrt(noise) * spread)


def misfit(gram: FloatArray, right: FloatArray, square: float, rows: int, root: FloatArray) -> float:
    """Return the ``value`` of :func:`evidence` of the same arguments alone, for searches.

    Examples
    --------
    >>> given = np.array([[100.0]]), np.array([50.0]), 26.0, 100, np.array([[10.0]])
    >>> misfit(*given) == evidence(*given).value
    True
    """
    return _weighed(gram, right, square, rows, root)[0]


def _weighed(
    gram: FloatArray, right: FloatArray, square: float, rows: int, root: FloatArray
) -> tuple[float, float, FloatArray, FloatArray]:
    """Return the misfit, the variance of the noise, the factor of the inner matrix, and what it makes of the data."""
    from scipy.linalg import solve_triangular

    factor = _factor(root.T @ gram @ root)
    seen = np.asarray(solve_triangular(factor, root.T @ right, lower=True, check_finite=False), dtype=np.float64)
    noise = max(square - float(seen @ seen), 1e-14 * square) / rows
    value = rows * np.log(max(noise, 1e-300)) + 2.0 * float(np.log(np.diag(factor)).sum())
    return float(value), noise, factor, seen


def _factor(inner: FloatArray) -> FloatArray:
    """Return the triangle of ``inner + I``; where its rounding is more than I, as of few lines, that is added too."""
    least = 1.0 + len(inner) * np.finfo(float).eps * float(np.trace(inner))
    return np.asarray(np.linalg.cholesky(inner + least * np.eye(len(inner))), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Loose:
    """What data say of coefficients under a prior that is meant to say little."""

    mean: FloatArray  # (p,)
    covariance: FloatArray  # (p, p)
    freedom: float  # Equations less the coefficients that the data decide


def loose(gram: FloatArray, right: FloatArray, square: float, rows: int, root: FloatArray) -> Loose:
    """Return the posterior under a loose prior, the variance of the noise from what is left over.

    Where the prior says little the fit follows the noise, so that the noise is ``|y - Phi g|^2`` over the equations
    less the trace of the matrix that takes y to the fit (Wahba 1983, J. R. Stat. Soc. B 45:133, eq. 3.5).

    - ``gram, right, square, rows, root``: as of :func:`evidence`

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.normal(size=(40, 20))
    >>> y = x @ np.ones(20) + rng.normal(size=40)
    >>> found = loose(x.T @ x, x.T @ y, float(y @ y), 40, 1e3 * np.eye(20))
    >>> plain = np.linalg.lstsq(x, y, rcond=None)
    >>> bool(np.allclose(found.mean, plain[0], atol=1e-4)), round(found.freedom, 3)
    (True, 20.0)
    >>> variance = float(plain[1][0]) / 20
    >>> bool(np.allclose(found.covariance, variance * np.linalg.inv(x.T @ x), rtol=1e-4))
    True
    """
    factor = _factor(root.T @ gram @ root)
    spread = np.linalg.solve(factor, root.T)
    mean = spread.T @ (spread @ right)
    decided = len(root) - float(np.sum(np.linalg.inv(factor) ** 2))
    freedom = max(rows - decided, 1.0)
    left = max(square - 2.0 * float(mean @ right) + float(mean @ gram @ mean), 1e-14 * square)
    return Loose(mean, left / freedom * (spread.T @ spread), freedom)


def joined(roots: Sequence[FloatArray]) -> FloatArray:
    """Return the root of the prior of several inputs, independent of each other: lags of the first, then the second."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*roots), dtype=float)
