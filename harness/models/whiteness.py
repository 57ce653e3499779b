"""Whether residuals are white: asked once, by fits of their own residuals and by ``compare`` of those on other data."""

from __future__ import annotations

from collections.abc import Sequence

from harness.signals import FloatArray

LAGS = 20  # Lags of the residuals' autocorrelation that are tested together (Ljung & Box 1978), as usual in the field.
DOUBT = 1e-3  # Probability, over all outputs, of calling white residuals correlated.


def whiteness(residuals: Sequence[FloatArray]) -> float:
    """Return the probability of residuals at least so correlated in time, were they white (Ljung & Box 1978).

    - ``residuals`` sequence of array (N_i,): record by record: no product crosses a seam

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


def white(residuals: Sequence[FloatArray], outputs: int = 1) -> bool:
    """Return True where chance explains how the residuals of one of so many outputs are correlated in time.

    - ``residuals``: as of :func:`whiteness`
    """
    return whiteness(residuals) >= DOUBT / outputs
