"""Tests of one residual: is it larger than the noise, white, free of the input, steady, free of lines.

They detect, they do not isolate. At N = 5000 the p-values reject models that are numerically perfect, so the loop
decides on effect size (:func:`detect`) and prints the p-values beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray

__all__ = [
    "Line",
    "Outcome",
    "autocorrelation",
    "correlation_band",
    "cross_correlation",
    "cusum_of_squares",
    "detect",
    "effective_samples",
    "fisher_g",
    "higher_order",
    "input_correlation",
    "ljung_box",
    "max_autocorrelation",
]

RATIO = 1.15
"""A residual this many times the noise floor counts as detected."""
ACF = 0.1
"""A largest autocorrelation above this counts as detected."""


@dataclass(frozen=True)
class Outcome:
    """One statistical test: statistic, degrees of freedom, p-value (NaN where the test cannot be made)."""

    name: str
    statistic: float
    dof: int
    p: float

    def to_dict(self) -> dict[str, Any]:
        """Return the test for ``report.json``; figures that do not exist are None."""
        return {"name": self.name, "statistic": _known(self.statistic), "dof": self.dof, "p": _known(self.p)}


@dataclass(frozen=True)
class Line:
    """A spectral line found by Fisher's g test: angular frequency [rad/s], share of the whitened power, p-value."""

    omega: float
    g: float
    p: float


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


def ljung_box(r: FloatArray, lags: int = 25, fitted: int = 0) -> Outcome:
    """Test ``r`` (N,) for whiteness (Ljung & Box 1978): Q = N (N + 2) sum rho_k^2 / (N - k).

    Parameters
    ----------
    r : array (N,)
        Residual.
    lags : int
        Lags in the sum.
    fitted : int
        Parameters fitted to the data, taken off the degrees of freedom.
    """
    n = r.size
    rho = autocorrelation(r, lags)[1:]
    q = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, rho.size + 1))))
    return _chi2("Ljung-Box", q, max(rho.size - fitted, 1))


def input_correlation(u: FloatArray, r: FloatArray, lags: int = 25) -> Outcome:
    """Test the residual for independence of the last ``lags`` inputs (Lagrange multiplier form, any colour of ``u``).

    With X the matrix of lagged inputs, r' X (X' X)^-1 X' r / s^2 is chi-square if ``r`` is white and free of ``u``
    (Ljung, System Identification, section 16.6).
    """
    return _projection("input cross-correlation", _lagged(u, lags), r)


def higher_order(u: FloatArray, y: FloatArray, r: FloatArray, lags: int = 10) -> tuple[Outcome, ...]:
    """Return the higher-order tests of Billings & Voon (Int. J. Control 44:803, 1986).

    They relate u^2 to r, u^2 to r^2, and y r to u^2: a nonlinear term that the linear tests cannot see.
    """
    squares = _lagged(u**2, lags)
    return (
        _projection("u^2 with r", squares, r),
        _projection("u^2 with r^2", squares, r**2),
        _projection("u^2 with y r", squares, y * r),
    )


def cusum_of_squares(r: FloatArray) -> tuple[FloatArray, float, Outcome]:
    """Return the path C_k - k / N of the cumulative squares, its 99 % half width, and the test of its largest value.

    The half width is 2.58 / sqrt(N); the p-value is Kolmogorov's, with the spread of r^2 taken from the data.
    """
    from scipy import stats

    squares = np.asarray(r, dtype=float) ** 2
    n = squares.size
    total = float(squares.sum())
    path = np.cumsum(squares) / total - np.arange(1, n + 1) / n if total > 0 else np.zeros(n)
    largest = float(np.abs(path).max())
    spread = float(squares.std()) / (total / n) if total > 0 else 0.0
    p = float(stats.kstwobign.sf(largest * np.sqrt(n) / spread)) if spread > 0 else float("nan")
    return path, correlation_band(n), Outcome("CUSUM of squares", largest, n, p)


def fisher_g(r: FloatArray, sample_time: float) -> Line:
    """Return the strongest line in ``r`` (N,) with Fisher's exact p-value (Proc. R. Soc. A 125:54, 1929).

    The periodogram is first divided by its running median, so that a coloured residual is not mistaken for a line.
    Bins that the median cannot reach (the first few) are left out.
    """
    x = np.asarray(r, dtype=float) - np.mean(r)
    n = x.size
    power = np.abs(np.fft.rfft(x)[1 : (n - 1) // 2 + 1]) ** 2
    if power.size < 16 or not power.max() > 0:
        return Line(0.0, 0.0, 1.0)
    background = _running_median(power)
    flat = power / np.maximum(background, 1e-12 * power.max())
    skip = 2
    flat = flat[skip:]
    best = int(np.argmax(flat))
    g = float(flat[best] / flat.sum())
    omega = 2 * np.pi * _peak(power, best + skip) / (n * sample_time)
    return Line(omega, g, _fisher_p(g, flat.size))


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


def detect(ratio: float | None, acf: float, n: int) -> bool:
    """Decide by effect size whether a residual shows that something is missing.

    Parameters
    ----------
    ratio : float or None
        Residual over noise floor; None if the floor is unknown.
    acf : float
        Largest absolute autocorrelation.
    n : int
        Samples: in short records the chance value of ``acf`` (3.3 / sqrt(n)) replaces 0.1.
    """
    return (ratio is not None and ratio > RATIO) or acf > max(ACF, 3.3 / float(np.sqrt(n)))


def _known(value: float) -> float | None:
    """Return a finite value, or None."""
    return float(value) if np.isfinite(value) else None


def _chi2(name: str, statistic: float, dof: int) -> Outcome:
    """Return a chi-square outcome."""
    from scipy import stats

    return Outcome(name, statistic, dof, float(stats.chi2.sf(statistic, dof)))


def _lagged(u: FloatArray, lags: int) -> FloatArray:
    """Return the matrix (N - lags, lags + 1) of centred ``u`` and its past."""
    x = np.asarray(u, dtype=float) - np.mean(u)
    return np.lib.stride_tricks.sliding_window_view(x, lags + 1)[:, ::-1]


def _projection(name: str, x: FloatArray, r: FloatArray) -> Outcome:
    """Test whether ``r``, cut to the rows of ``x`` (N', k), lies in the span of ``x``."""
    e = np.asarray(r, dtype=float)[-x.shape[0] :]
    e = e - e.mean()
    x = x - x.mean(axis=0)
    power = float(e @ e)
    left, values, _ = np.linalg.svd(x, full_matrices=False)
    rank = int((values > 1e-8 * values.max(initial=0.0)).sum()) if values.size and values[0] > 0 else 0
    if rank == 0 or power == 0:
        return Outcome(name, float("nan"), 0, float("nan"))
    share = float(np.sum((left[:, :rank].T @ e) ** 2)) / power
    return _chi2(name, e.size * share, rank)


def _running_median(power: FloatArray) -> FloatArray:
    """Return the running median of a periodogram, narrow at low frequency, scaled to the mean of an exponential."""
    from scipy.ndimage import median_filter

    background = power
    narrow = median_filter(power, size=21, mode="reflect")
    wide = median_filter(power, size=min(101, power.size | 1), mode="reflect")
    index = np.arange(power.size)
    background = np.where(index < 15, narrow, wide)
    return np.asarray(background / np.log(2.0))


def _peak(power: FloatArray, k: int) -> float:
    """Return the place of a peak between bins, in bins counted from 0 Hz (parabola through the logarithms)."""
    if not 0 < k < power.size - 1:
        return float(k + 1)
    a, b, c = np.log(np.maximum(power[k - 1 : k + 2], 1e-300))
    curvature = a - 2 * b + c
    return float(k + 1 + (0.5 * (a - c) / curvature if curvature < 0 else 0.0))


def _fisher_p(g: float, m: int) -> float:
    """Return Fisher's exact tail probability of the largest share ``g`` of ``m`` exponential powers."""
    if g <= 0 or g >= 1:
        return 1.0 if g <= 0 else 0.0
    terms = int(min(1 / g, m))
    j = np.arange(1, terms + 1)
    from scipy.special import gammaln

    logs = gammaln(m + 1) - gammaln(j + 1) - gammaln(m - j + 1) + (m - 1) * np.log1p(-np.minimum(j * g, 1 - 1e-15))
    if logs.max() > 3.0:  # the alternating sum has lost its digits; here p is 1 for every purpose
        return 1.0
    return float(np.clip(np.sum(np.where(j % 2 == 1, 1.0, -1.0) * np.exp(logs)), 0.0, 1.0))
