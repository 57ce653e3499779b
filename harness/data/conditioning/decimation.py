"""Lower sample rates without folding: a zero-phase filter for what was measured, means for what was held."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

EDGE = 0.8
"""Edge of the filter's pass band, as a part of half the new sample rate (the choice of ``scipy.signal.decimate``)."""


def filtered(time: FloatArray, values: FloatArray, grid: FloatArray, *, cubic: bool) -> FloatArray:
    """Return a signal on a coarser grid, low-passed before without a shift in phase.

    The signal is brought onto a uniform grid at least as fine as its own, filtered forwards and backwards by a
    Chebyshev filter of order 8 and ripple 0.05 dB, and every q-th value is kept.

    - ``time, values`` (N,): time stamps [s], possibly with jitter, and the signal
    - ``grid`` (n,): the new, uniform instants [s]
    - ``cubic``: interpolate by a cubic spline instead of straight lines

    Examples
    --------
    >>> t = np.arange(2000) * 0.01
    >>> slow, fast = np.sin(2 * np.pi * 0.5 * t), np.sin(2 * np.pi * 19.0 * t)
    >>> grid = np.arange(200) * 0.1  # 19 Hz would come out as 1 Hz
    >>> error = filtered(t, slow + fast, grid, cubic=True) - np.sin(2 * np.pi * 0.5 * grid)
    >>> bool(np.abs(error[20:-20]).max() < 0.01)
    True
    """
    from scipy.interpolate import CubicSpline
    from scipy.signal import cheby1, sosfiltfilt

    step = (grid[-1] - grid[0]) / (len(grid) - 1) if len(grid) > 1 else 1.0
    q = max(2, int(np.ceil(step / float(np.median(np.diff(time))) - 1e-6)))
    fine = grid[0] + np.arange((len(grid) - 1) * q + 1) * step / q
    signal = CubicSpline(time, values)(fine) if cubic else np.interp(fine, time, values)
    sections = cheby1(8, 0.05, EDGE / q, output="sos")
    smooth: FloatArray = sosfiltfilt(sections, signal, padlen=min(10 * q, len(fine) - 1))[::q]
    return smooth


def hold_means(time: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Return the mean of a held input over each hold of a coarser grid: its impulse is kept, and nothing folds.

    Examples
    --------
    >>> hold_means(np.arange(6.0), np.array([1.0, 3.0, 5.0, 5.0, 0.0, 2.0]), np.array([0.0, 2.0, 4.0])).tolist()
    [2.0, 5.0, 0.0]
    """
    area = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    step = (grid[-1] - grid[0]) / (len(grid) - 1) if len(grid) > 1 else 0.0
    ends = np.minimum(grid + step, time[-1])
    spans = ends - grid
    held = values[np.clip(np.searchsorted(time, grid + 1e-6 * step, side="right") - 1, 0, len(time) - 1)]
    whole = spans > 1e-6 * step
    means = (np.interp(ends, time, area) - np.interp(grid, time, area)) / np.where(whole, spans, 1.0)
    return np.where(whole, means, held)
