"""Bounds on one-step equations: self-normalised martingales, and small balls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.algebra import column_norms
from harness.signals import FloatArray

_FIRST = 0.1  # Share of the rows that come first: their Gram matrix is what the others are weighed against.
_BALL = 3.0 / 20.0  # Probability of the small ball of Gaussian states (Simchowitz et al. 2018, sec. 2.3).
_BLOCKS = 200  # Lengths of blocks that are tried.


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Where coefficients lie: of every output an ellipsoid around the least squares of the later rows."""

    coefficients: FloatArray  # (p, m): By least squares of the rows after the first tenth
    half: FloatArray  # (p, m): Half widths of the boxes around the ellipsoids: all hold at once
    measured: FloatArray  # (p, m): Half widths of ordinary intervals of the same rows, each by itself


def ellipsoids(phi: FloatArray, y: FloatArray, confidence: float) -> Ellipsoids | None:
    """Return ellipsoids for ``y = phi theta + e``, e a martingale difference: no noise must be white beyond the past.

    With G the Gram matrix of the rows and V any positive matrix that is known before them, ``S' (G + V)^-1 S <= 2 s^2
    ln(det(G + V)^(1/2) det(V)^(-1/2) / d)`` for ``S = sum phi e`` with probability 1 - d (Abbasi-Yadkori, Pal &
    Szepesvari 2011, *NeurIPS*, theorem 1), the step that Sarkar & Rakhlin 2019 and Tsiamis & Pappas 2019 take for
    systems. V is here the Gram matrix of the first tenth of the rows, so that ``S' G^-1 S`` is at most 1 + r times as
    much, r the largest eigenvalue of ``G^-1 V``. e is taken to be Gaussian with the deviation of the residuals.

    - ``phi, y`` (N, p), (N, m): in the order of time
    - ``confidence``: of all coefficients of all outputs together
    - returns None where the first rows, or the others, do not determine the coefficients

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.normal(size=(1000, 2))
    >>> found = ellipsoids(x, x @ [[1.0], [2.0]] + rng.normal(size=(1000, 1)), 0.95)
    >>> bool(np.all(np.abs(found.coefficients[:, 0] - [1.0, 2.0]) < found.half[:, 0]))
    True
    >>> bool(np.all((found.half > found.measured) & (found.half < 4 * found.measured)))
    True
    """
    from scipy.stats import t

    (rows, p), outputs = phi.shape, y.shape[1]
    few = max(int(_FIRST * rows), 2 * p)
    if rows - few <= 2 * p:
        return None
    size = column_norms(phi)
    unit = phi / size
    before, after = unit[:few].T @ unit[:few], unit[few:].T @ unit[few:]
    if min(float(np.linalg.eigvalsh(part)[0]) for part in (before, after)) <= 1e-12:
        return None
    inverse = np.linalg.inv(after)
    theta = inverse @ (unit[few:].T @ y[few:])
    free = rows - few - p
    noise = np.sum((y[few:] - unit[few:] @ theta) ** 2, axis=0) / free
    ratio = float(np.linalg.eigvals(inverse @ before).real.max())
    volume = float(np.linalg.slogdet(after + before)[1] - np.linalg.slogdet(before)[1])
    level = (1.0 + ratio) * (volume + 2.0 * np.log(outputs / (1.0 - confidence)))
    each = np.sqrt(np.diag(inverse))[:, None] * np.sqrt(noise) / size[:, None]
    own = float(t.ppf(0.5 + confidence / 2, free))
    return Ellipsoids(theta / size[:, None], np.sqrt(level) * each, own * each)


@dataclass(frozen=True)
class SmallBall:
    """A bound on the norm of the error of ``x+ = A x + B u + w``, decided before the data."""

    bound: float  # On the largest singular value of the error of [A B], states and inputs scaled to unit deviation
    needed: float  # Samples from which the theorem speaks at all
    block: int  # Length of the blocks that gave the least bound


def small_ball(
    a: FloatArray, b: FloatArray, inputs: FloatArray, noise: FloatArray, samples: int, confidence: float
) -> SmallBall:
    """Return the bound of Simchowitz, Mania, Tu, Jordan & Recht 2018, *COLT* ("Learning without mixing"), theorem 2.4.

    For T samples, d regressors and n states ``90 s / p sqrt((n + d ln(10 / p) + ln det(G G_k^-1) + ln(1 / d')) / (T
    lmin(G_k)))`` with probability 1 - 3 d', once ``T >= 10 k / p^2 (ln(1 / d') + 2 d ln(10 / p) + ln det(G G_k^-1))``;
    p = 3/20 for Gaussian states, G_k the covariance that k / 2 steps of noise and inputs bring, G the stationary one
    times d / d'. The length k of the blocks is that of the least bound.

    - ``a, b`` (n, n), (n, nu)
    - ``inputs`` (nu, nu): covariance of the inputs, taken to be white
    - ``noise`` (n, n): covariance of w

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> found = small_ball(0.9 * one, one, one, one, 100_000, 0.95)
    >>> found.needed < 100_000, 1.0 < found.bound < 10.0
    (True, True)
    """
    from scipy.linalg import solve_discrete_lyapunov

    n, nu = len(a), b.shape[1]
    d, doubt = n + nu, (1.0 - confidence) / 3.0
    driven = b @ inputs @ b.T + noise
    if np.abs(np.linalg.eigvals(a)).max(initial=0.0) >= 1.0:
        return SmallBall(float("inf"), float("inf"), 0)
    stationary = np.asarray(solve_discrete_lyapunov(a, driven), dtype=float)
    whole = np.zeros((d, d))
    whole[:n, :n], whole[n:, n:] = stationary, inputs
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    upper = whole / np.outer(size, size) * d / doubt
    out = np.sqrt(float(np.linalg.eigvalsh(noise / np.outer(size[:n], size[:n]))[-1]))
    least = SmallBall(float("inf"), float("inf"), 0)
    power, reached, lengths = np.eye(n), np.zeros((n, n)), 0
    for half in range(1, _BLOCKS + 1):
        reached = reached + power @ driven @ power.T
        power, lengths = a @ power, 2 * half
        small = np.zeros((d, d))
        small[:n, :n], small[n:, n:] = reached, inputs
        small /= np.outer(size, size)
        value = float(np.linalg.eigvalsh(small)[0])
        if value <= 1e-14:
            continue
        volume = float(np.linalg.slogdet(upper)[1] - np.linalg.slogdet(small)[1])
        spread = d * np.log(10.0 / _BALL)
        needed = 10.0 * lengths / _BALL**2 * (np.log(1.0 / doubt) + 2.0 * spread + volume)
        bound = 90.0 * out / _BALL * np.sqrt((n + spread + volume + np.log(1.0 / doubt)) / (samples * value))
        speaks, spoke = needed <= samples, least.needed <= samples
        if (speaks and not spoke) or (speaks == spoke and (bound < least.bound if speaks else needed < least.needed)):
            least = SmallBall(float(bound), float(needed), lengths)
    return least
