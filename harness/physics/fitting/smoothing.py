"""Smoothed signals and their derivatives, the amount of smoothing chosen by leave-one-out error."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

_WIDTHS = (5, 7, 9, 13, 19, 27, 41, 61, 91)
_KEPT = 32  # Signals whose answer is kept: a diagnosis asks for those of its records again with every model.


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothed signal (N,), its first and second derivative, and the leave-one-out error (its noise, about)."""

    value: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    error: float
    width: int


def smooth(signal: FloatArray, dt: float, *, period: float | None = None) -> Smoothed:
    """Return a signal smoothed by local cubics (Savitzky & Golay 1964).

    - ``signal`` (N,): uniformly sampled
    - ``dt``: sample time [s]
    - ``period``: of an angle: it is unwrapped first
    - returns the signal at the width, among 5 to 91 samples, with the least leave-one-out error; its arrays cannot be
      written to

    Examples
    --------
    >>> t = np.arange(200) * 0.01
    >>> smooth(np.sin(t), 0.01).rate[[0, 50, 100]].round(3).tolist()
    [1.0, 0.878, 0.54]
    """
    given = np.ascontiguousarray(signal, dtype=float)
    return _smoothed(given.tobytes(), float(dt), period)


@functools.lru_cache(maxsize=_KEPT)
def _smoothed(data: bytes, dt: float, period: float | None) -> Smoothed:
    """Return the smoothed signal of the bytes of an array."""
    y = np.frombuffer(data)
    if period is not None:
        y = np.unwrap(y, period=period)
    n = y.shape[0]
    if n < 5:
        rate = np.gradient(y, dt) if n > 1 else np.zeros(n)
        return _closed(Smoothed(y.copy(), rate, np.zeros(n), 0.0, n))
    best: tuple[float, int] | None = None
    for width in _WIDTHS:
        if width > max(5, n // 3):
            break
        half = width // 2
        middle = local_taps(width)[0][0, half]
        left_out = (y - local_cubics(y, width, dt)[0])[half : n - half] / (1.0 - middle)
        error = float(np.sqrt(np.mean(left_out**2)))
        if best is None or error < best[0]:
            best = (error, width)
    assert best is not None
    error, width = best
    return _closed(Smoothed(*local_cubics(y, width, dt), error, width))


def local_cubics(signal: FloatArray, width: int, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a signal (N,), its first and its second derivative by a cubic through ``width`` samples about each.

    At the ends the cubic through the last ``width`` samples goes on (Savitzky & Golay 1964, Anal. Chem. 36:1627).

    - ``signal`` (N,): uniformly sampled, N >= width
    - ``width``: odd
    - ``dt``: sample time [s]

    Examples
    --------
    >>> t = np.arange(50) * 0.1
    >>> [bool(np.allclose(a, b)) for a, b in zip(local_cubics(t**3, 7, 0.1), (t**3, 3 * t**2, 6 * t), strict=True)]
    [True, True, True]
    """
    y = np.asarray(signal, dtype=float)
    middle, first, last = local_taps(width)
    half = width // 2
    found = np.empty((3, y.size))
    for order in range(3):
        found[order, half : y.size - half] = np.correlate(y, middle[order], "valid")
    found[:, :half], found[:, y.size - half :] = first @ y[:width], last @ y[y.size - width :]
    value, rate, acceleration = found
    return value, rate / dt, acceleration / dt**2


@functools.cache
def local_taps(width: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weights of the value and its derivatives per sample, by a cubic through ``width`` samples.

    - returns weights of the middle (3, width), and of the samples before and after it (3, half, width), each for the
      value and its first and second derivative
    """
    half = width // 2
    at = np.arange(-half, half + 1) / max(half, 1)
    fit = np.linalg.pinv(np.vander(at, 4, increasing=True))
    powers = [np.polynomial.Polynomial(row).deriv(order) for order in range(3) for row in np.eye(4)]
    every = np.array([[polynomial(at) for polynomial in powers[4 * order : 4 * order + 4]] for order in range(3)])
    weights = np.einsum("opn,pw->onw", every, fit) / np.array([1.0, max(half, 1), max(half, 1) ** 2])[:, None, None]
    return weights[:, half].copy(), weights[:, :half].copy(), weights[:, half + 1 :].copy()


def _closed(found: Smoothed) -> Smoothed:
    """Make the arrays of an answer that several share read-only."""
    for array in (found.value, found.rate, found.acceleration):
        array.flags.writeable = False
    return found
