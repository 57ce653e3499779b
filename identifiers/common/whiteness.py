"""Whether residuals are correlated in time: the portmanteau test of Ljung and Box over records."""

from __future__ import annotations

from collections.abc import Sequence

from harness.signals import FloatArray

__all__ = ["LAGS", "whiteness"]

LAGS = 20
"""Lags of the residuals' autocorrelation that are tested together (Ljung & Box 1978), as usual in the field."""


def whiteness(residuals: Sequence[FloatArray]) -> float:
    """Return the probability of residuals at least so correlated in time, were they white (Ljung & Box 1978).

    Parameters
    ----------
    residuals : sequence of array (N_i,)
        Record by record: no product crosses a seam.

    Examples
    --------
    >>> import numpy as np
    >>> noise = np.random.default_rng(0).normal(size=500)
    >>> whiteness([noise]) > 0.01, whiteness([np.cumsum(noise)]) < 1e-6
    (True, True)
    """
    from scipy.stats import chi2

    n = sum(len(miss) for miss in residuals)
    power = sum(float(miss @ miss) for miss in residuals)
    lags = min(LAGS, max(len(miss) for miss in residuals) - 2)
    if power == 0 or lags < 1:
        return 1.0
    shares = [sum(float(miss[j:] @ miss[:-j]) for miss in residuals) / power for j in range(1, lags + 1)]
    return float(chi2.sf(n * (n + 2) * sum(s**2 / (n - j) for j, s in enumerate(shares, 1)), lags))
