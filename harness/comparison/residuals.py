"""Whether residuals are white, and whether they still hold something of the input (Ljung 1999, section 16.6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.models.whiteness import white
from harness.signals import FloatArray

LAGS = 25  # Lags looked at: Ljung's recommendation.
BOUND = 2.576  # Standard deviations of the 99 % region.


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations of one residual.

    Parameters
    ----------
    auto : array (LAGS + 1,)
        Of the residual with itself, 1 at lag 0.
    cross : array (nu, 2 LAGS + 1)
        Of the residual with each input, lags from -LAGS to LAGS; a positive lag is an earlier input.
    auto_bound : float
        99 % region of ``auto`` for a white residual.
    cross_bound : array (nu,)
        99 % region of each ``cross`` for a residual that is independent of the inputs.
    white : bool
        Chance explains how the residual is correlated in time (:func:`harness.models.whiteness.white`).
    """

    auto: FloatArray
    cross: FloatArray
    auto_bound: float
    cross_bound: FloatArray
    white: bool

    @property
    def independent(self) -> bool:
        """True if no earlier input is left in the residual."""
        middle = LAGS + 1
        return all(_within(row[middle:], bound) for row, bound in zip(self.cross, self.cross_bound, strict=True))


def _within(values: FloatArray, bound: float) -> bool:
    """Return True if at most one of the lags lies outside, and none far outside."""
    size = np.abs(values)
    return bool(np.count_nonzero(size > bound) <= 1 and size.max(initial=0.0) < 1.5 * bound)


def correlations(residual: FloatArray, inputs: FloatArray, outputs: int = 1) -> Correlation:
    """Return the correlations of one residual (N,), of so many outputs, with itself and with the inputs (N, nu).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> e, u = rng.normal(size=2000), rng.normal(size=(2000, 1))
    >>> found = correlations(e, u)
    >>> found.white, found.independent
    (True, True)
    >>> found = correlations(e + np.roll(u[:, 0], 3), u)
    >>> found.independent
    False
    """
    e = residual - residual.mean()
    n = len(e)
    power = max(float(e @ e), 1e-300)
    lags = min(LAGS, n - 2)
    auto = np.zeros(LAGS + 1)
    auto[: lags + 1] = [float(e[: n - k] @ e[k:]) / power for k in range(lags + 1)]
    u0 = inputs - inputs.mean(axis=0)
    cross = np.zeros((u0.shape[1], 2 * LAGS + 1))
    bounds = np.zeros(u0.shape[1])
    for column in range(u0.shape[1]):
        u = u0[:, column]
        size = np.sqrt(power * max(float(u @ u), 1e-300))
        for k in range(-lags, lags + 1):
            cross[column, k + LAGS] = float(e[max(k, 0) : n + min(k, 0)] @ u[max(-k, 0) : n - max(k, 0)]) / size
        own = np.array([float(u[: n - k] @ u[k:]) for k in range(lags + 1)]) / max(float(u @ u), 1e-300)
        spread = 1.0 + 2.0 * float(np.sum(auto[1 : lags + 1] * own[1:]))  # both may be coloured
        bounds[column] = BOUND * np.sqrt(max(spread, 1e-2) / n)
    return Correlation(auto, cross, BOUND / np.sqrt(n), bounds, white([e], outputs))
