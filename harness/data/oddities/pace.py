"""Whether a record is sampled at the pace of its motion, and whether it drifts."""

from __future__ import annotations

import numpy as np
from scipy.signal import detrend, welch

from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray


def band_of(y: FloatArray) -> float:
    """Return the part of half the sampling frequency below which nearly all of the motion lies; 0 if there is none.

    The level of the noise, taken from the upper quarter of the spectrum, is no motion.

    Examples
    --------
    >>> round(band_of(np.sin(2 * np.pi * 0.01 * np.arange(4000.0))), 2)
    0.02
    """
    length = min(len(y), 1024)
    frequency, power = welch(detrend(y), nperseg=length)
    floor = float(np.median(power[3 * len(power) // 4 :]))
    above = np.maximum(power - 3.0 * floor, 0.0)
    if not above.sum() > 0.1 * power.sum():
        return 0.0
    share = np.cumsum(above) / above.sum()
    return float(2 * frequency[np.searchsorted(share, ODD.power)])


def trend_of(y: FloatArray, u: FloatArray) -> float:
    """Return the share of a signal that its straight line is, where no input has such a line; else 0.

    Examples
    --------
    >>> t = np.arange(500.0)
    >>> round(trend_of(0.01 * t + np.sin(t), np.zeros((500, 0))), 1), trend_of(0.01 * t, t[:, None])
    (0.8, 0.0)
    """
    # a plant that integrates an input with a mean has a trend too
    inputs = [*u.T, *np.cumsum(u, axis=0).T]
    found = line_share(y)
    return found if found >= ODD.trend and all(line_share(values) < ODD.trend for values in inputs) else 0.0


def line_share(y: FloatArray) -> float:
    """Return the share of the scatter of values (N,) about their mean that a straight line is."""
    line, centred = np.linspace(-1.0, 1.0, len(y)), y - y.mean()
    power = float(centred @ centred)
    return float((centred @ line) ** 2 / (line @ line) / power) if power > 0 else 0.0
