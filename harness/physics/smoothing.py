"""Smoothed signals and their derivatives, the amount of smoothing chosen by leave-one-out error."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

__all__ = ["Smoothed", "smooth"]

_WIDTHS = (5, 7, 9, 13, 19, 27, 41, 61, 91)
_KEPT = 32
"""Signals whose answer is kept: a diagnosis asks for those of its records again with every model."""


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

    Parameters
    ----------
    signal : array (N,)
        Uniformly sampled.
    dt : float
        Sample time [s].
    period : float, optional
        Of an angle: it is unwrapped first.

    Returns
    -------
    Smoothed
        Of the width, among 5 to 91 samples, with the least leave-one-out error; its arrays cannot be written to.

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
    from scipy.signal import savgol_coeffs, savgol_filter

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
        middle = savgol_coeffs(width, 3)[width // 2]
        half = width // 2
        left_out = (y - savgol_filter(y, width, 3))[half : n - half] / (1.0 - middle)
        error = float(np.sqrt(np.mean(left_out**2)))
        if best is None or error < best[0]:
            best = (error, width)
    assert best is not None
    error, width = best
    value, rate, acceleration = (savgol_filter(y, width, 3, deriv=order, delta=dt) for order in range(3))
    return _closed(Smoothed(value, rate, acceleration, error, width))


def _closed(found: Smoothed) -> Smoothed:
    """Make the arrays of an answer that several share read-only."""
    for one in (found.value, found.rate, found.acceleration):
        one.flags.writeable = False
    return found
