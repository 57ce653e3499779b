"""Tests of one residual: is it white, free of the input, steady. They detect; the likelihood decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray


@dataclass(frozen=True)
class TestOutcome:
    """One statistical test: statistic, degrees of freedom, p-value (NaN where the test cannot be made)."""

    name: str
    statistic: float
    dof: int
    p: float

    def to_dict(self) -> dict[str, Any]:
        """Return the test for ``report.json``; figures that do not exist are None."""
        return {"name": self.name, "statistic": _known(self.statistic), "dof": self.dof, "p": _known(self.p)}


def correlation_band(n: int) -> float:
    """Return the half width of the 99 % band of a sample correlation of ``n`` white samples (2.58 / sqrt(n)).

    Examples
    --------
    >>> round(correlation_band(10000), 4)
    0.0258
    """
    return 2.58 / float(np.sqrt(max(n, 1)))


def autocorrelation(r: FloatArray, lags: int = 25) -> FloatArray:
    """Return the sample autocorrelation (lags + 1,) of ``r`` (N,), lag 0 first (Box & Jenkins, biased form).

    Examples
    --------
    >>> autocorrelation(np.array([1.0, -1.0, 1.0, -1.0]), 1).tolist()
    [1.0, -0.75]
    """
    x = np.asarray(r, dtype=float) - np.mean(r)
    lags = min(lags, x.size - 1)
    size = 1 << int(np.ceil(np.log2(2 * x.size)))
    spectrum = np.fft.rfft(x, size)
    full = np.fft.irfft(np.abs(spectrum) ** 2, size)[: lags + 1]
    return np.asarray(full / full[0] if full[0] > 0 else np.r_[1.0, np.zeros(lags)])


def max_autocorrelation(r: FloatArray, lags: int = 25) -> float:
    """Return the largest absolute autocorrelation of ``r`` (N,) over lags 1 .. ``lags``."""
    return float(np.abs(autocorrelation(r, lags)[1:]).max(initial=0.0))


def cross_correlation(u: FloatArray, r: FloatArray, lags: int = 25) -> FloatArray:
    """Return the sample cross-correlation (2 lags + 1,) of input and residual, lag -lags first.

    A positive lag relates the residual to an earlier input; negative lags show feedback.
    """
    x, e = np.asarray(u, dtype=float) - np.mean(u), np.asarray(r, dtype=float) - np.mean(r)
    lags = min(lags, x.size - 1)
    scale = float(np.sqrt(np.sum(x**2) * np.sum(e**2)))
    if scale == 0:
        return np.zeros(2 * lags + 1)
    size = 1 << int(np.ceil(np.log2(2 * x.size)))
    full = np.fft.irfft(np.fft.rfft(e, size) * np.conj(np.fft.rfft(x, size)), size)
    return np.asarray(np.r_[full[-lags:] if lags else [], full[: lags + 1]] / scale)


def ljung_box(r: FloatArray, lags: int = 25, fitted: int = 0) -> TestOutcome:
    """Test ``r`` (N,) for whiteness (Ljung & Box 1978): Q = N (N + 2) sum rho_k^2 / (N - k).

    - ``r`` (N,): residual
    - ``lags``: lags in the sum
    - ``fitted``: parameters fitted to the data, taken off the degrees of freedom
    """
    n = r.size
    rho = autocorrelation(r, lags)[1:]
    q = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, rho.size + 1))))
    return _chi2("Ljung-Box", q, max(rho.size - fitted, 1))


def input_correlation(u: FloatArray, r: FloatArray, lags: int = 25) -> TestOutcome:
    """Test the residual for independence of the last ``lags`` inputs (Lagrange multiplier form, any colour of ``u``).

    Of a short record half of its length at most.

    With X the matrix of lagged inputs, r' X (X' X)^-1 X' r / s^2 is chi-square if ``r`` is white and free of ``u``
    (Ljung, System Identification, section 16.6).
    """
    return _projection("input cross-correlation", _lagged(u, min(lags, len(u) // 2)), r)


def cusum_of_squares(r: FloatArray) -> tuple[FloatArray, float, TestOutcome]:
    """Return the path C_k - k / N of the cumulative squares, its 99 % half width, and the test of its largest value.

    The half width is 2.58 / sqrt(N); the p-value is Kolmogorov's, with the spread of r^2 taken from the data.
    """
    from scipy import special

    squares = np.asarray(r, dtype=float) ** 2
    n = squares.size
    total = float(squares.sum())
    path = np.cumsum(squares) / total - np.arange(1, n + 1) / n if total > 0 else np.zeros(n)
    largest = float(np.abs(path).max())
    spread = float(squares.std()) / (total / n) if total > 0 else 0.0
    p = float(special.kolmogorov(largest * np.sqrt(n) / spread)) if spread > 0 else float("nan")
    return path, correlation_band(n), TestOutcome("CUSUM of squares", largest, n, p)


def effective_samples(r: FloatArray) -> float:
    """Return the number of independent samples that ``r`` (N,) is worth: N / (1 + 2 sum rho_k).

    The sum runs over Geyer's initial positive sequence of pairs (Stat. Sci. 7:473, 1992), squared correlations being
    left out; the result lies in [4, N].
    """
    n = r.size
    rho = autocorrelation(r, n // 2)
    pairs = rho[1:-1:2] + rho[2::2]
    stop = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else pairs.size
    time = 1.0 + 2.0 * float(pairs[:stop].sum())
    return float(np.clip(n / max(time, 1.0), min(4.0, n), n))


def _known(value: float) -> float | None:
    """Return a finite value, or None."""
    return float(value) if np.isfinite(value) else None


def _chi2(name: str, statistic: float, dof: int) -> TestOutcome:
    """Return a chi-square outcome."""
    from scipy import special

    return TestOutcome(name, statistic, dof, float(special.chdtrc(dof, statistic)))


def _lagged(u: FloatArray, lags: int) -> FloatArray:
    """Return the matrix (N - lags, lags + 1) of centred ``u`` and its past."""
    x = np.asarray(u, dtype=float) - np.mean(u)
    return np.lib.stride_tricks.sliding_window_view(x, lags + 1)[:, ::-1]


def _projection(name: str, x: FloatArray, r: FloatArray) -> TestOutcome:
    """Test whether ``r``, cut to the rows of ``x`` (N', k), lies in the span of ``x``."""
    e = np.asarray(r, dtype=float)[-x.shape[0] :]
    e = e - e.mean()
    x = x - x.mean(axis=0)
    power = float(e @ e)
    left, values, _ = np.linalg.svd(x, full_matrices=False)
    rank = int((values > 1e-8 * values.max(initial=0.0)).sum()) if values.size and values[0] > 0 else 0
    if rank == 0 or power == 0:
        return TestOutcome(name, float("nan"), 0, float("nan"))
    share = float(np.sum((left[:, :rank].T @ e) ** 2)) / power
    return _chi2(name, e.size * share, rank)
