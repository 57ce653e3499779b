"""Readings that went through a filter before they were written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

_ORDER = 4
"""Differences that are taken before a spectrum: what leaks of the motion into its upper part is as far below."""
_SEGMENT, _SHORTEST = 256, 64  # Rows of a segment at most, and at least.
_SEGMENTS = 5  # Segments of a record at least: their median hides what happens once.
_POOLED = 3  # Bins of the spectrum that are one: a null is wider, and chance makes no hundredth of them.
_SIDES = 16  # Bins to each side among which something must stand above the null.
_ALSO = 0.7  # Share of that depth which another null of the same comb has, or one of an input that the reading answers.
_MOVES = 0.5
"""Share of the rows in which a reading changes at least: one that moves in a few coarse steps has nulls of its own."""
_EDGE = 0.49
"""Frequency in cycles a row from which a null is that of a digital low-pass at half the sampling frequency."""
_TOP, _ZEROS = (0.35, 0.485), 1.5
"""Frequencies along which zeros at half the sampling frequency are counted, and how many a low-pass has at least."""
_LONGEST = 6  # Rows over which the noise behind a low-pass is followed: further the motion is more than it.


@dataclass(frozen=True)
class SensorFilter:
    """A filter behind a sensor."""

    null: float  # Lowest frequency that it takes away [cycles a row]; 1/2 for a digital low-pass
    every: int  # Rows after which a reading says something new

    @property
    def mean(self) -> bool:
        """True for a mean over ``every`` rows, False for a digital low-pass."""
        return self.null < _EDGE


def filter_of(y: FloatArray, u: FloatArray) -> SensorFilter | None:
    """Return the filter of which a reading shows the null; None without one.

    No motion and no noise has a spectrum with a null that no input has: a mean over ``m`` rows has nulls at multiples
    of ``1/m`` of the sampling frequency, a low-pass made by the bilinear transform at its half (Oppenheim & Schafer,
    *Discrete-Time Signal Processing*, sec. 5.1 and 7.1). There a position that a held force accelerates has a null
    too, of first order (Astrom, Hagander & Sternby 1984, Automatica 20:31): filters of first order, and means over
    two rows, are not told.

    - ``y`` (N,)
    - ``u`` (N, nu)

    Examples
    --------
    >>> rng, k = np.random.default_rng(0), np.arange(1000)
    >>> y, none = np.sin(0.05 * k) + 1e-3 * rng.standard_normal(1000), np.zeros((1000, 0))
    >>> found = filter_of(np.convolve(y, np.full(5, 0.2), "valid"), none)
    >>> found.every, round(found.null, 1), filter_of(y, none)
    (5, 0.2, None)
    """
    if len(y) < _SEGMENTS * _SHORTEST or np.mean(np.diff(y) != 0.0) < _MOVES:
        return None
    frequency, power = _spectrum(y)
    depth = _depths(power)
    depth[frequency >= _EDGE] *= _steep(frequency, power)
    if not (depth >= ODD.null).any():
        return None
    for column in u.T:
        if np.ptp(column) > 0:
            other = _depths(_spectrum(column)[1])
            near = np.max(np.lib.stride_tricks.sliding_window_view(np.pad(other, 2), 5), axis=1)
            depth = np.where(near >= _ALSO * ODD.null, 0.0, depth)
    if not (depth >= ODD.null).any():
        return None
    # one null of a comb may be filled by the motion: the lowest that is nearly as deep is the comb's
    null = float(frequency[np.flatnonzero(depth >= _ALSO * ODD.null)[0]])
    found = SensorFilter(null, round(1 / null))
    return found if found.mean else SensorFilter(null, _remembered(y))


def _spectrum(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [cycles a row] and the decimal logarithm of the power, of the median segment."""
    n = min(_SEGMENT, len(y) // _SEGMENTS)
    frequency, power = welch(
        np.diff(y, _ORDER), window="blackman", nperseg=n - n % 2, average="median", detrend=False, return_onesided=False
    )
    half = len(frequency) // 2 + 1
    frequency = np.abs(frequency[:half])
    wide = np.concatenate([power[-1:], power[: half + 1]])  # a spectrum goes on to both sides as it came
    pooled = np.convolve(wide, np.full(_POOLED, 1.0 / _POOLED), "valid")[:half]
    shape = np.maximum(2 * np.sin(np.pi * frequency), 1e-3) ** (2 * _ORDER)
    tiny = 1e-30 * float(pooled.max(initial=0.0)) + float(np.finfo(float).tiny)
    return frequency, np.log10(np.maximum(pooled, tiny) / shape)


def _steep(frequency: FloatArray, power: FloatArray) -> bool:
    """Return True if a spectrum falls to half the sampling frequency as behind two zeros there, or more.

    One is there by itself where a force is held from row to row.
    """
    top = (frequency > _TOP[0]) & (frequency < _TOP[1])
    return float(np.polyfit(np.log10(np.cos(np.pi * frequency[top]) ** 2), power[top], 1)[0]) > _ZEROS


def _depths(power: FloatArray) -> FloatArray:
    """Return how far every bin's power, a logarithm, lies below what is usual on both sides; 0 where beside lower."""
    n, depth = len(power), np.zeros(len(power))
    sides = min(_SIDES, n // 4)
    around = np.concatenate([power, power[-2 : -sides - 2 : -1]])  # beyond half the sampling frequency it comes back
    for k in range(sides, n):
        if power[k] <= around[k - 3 : k + 4].min():
            usual = np.median(around[k - sides : k]), np.median(around[k + 1 : k + sides + 1])
            depth[k] = min(usual) - power[k]
    return depth


def _remembered(y: FloatArray) -> int:
    """Return after how many rows the noise of readings is another one: where their differences grow least."""
    rows = np.arange(2, _LONGEST + 2)
    sizes = [np.median(np.abs(_apart(y, k))) for k in rows.tolist()]
    growth = np.diff(np.log(np.maximum(sizes, np.finfo(float).tiny))) / np.diff(np.log(rows))
    calm = np.flatnonzero(growth < 1.0)
    return int(rows[1 + (calm[0] if calm.size else int(np.argmin(growth)))])


def _apart(y: FloatArray, k: int) -> FloatArray:
    """Return fourth differences of readings that lie ``k`` rows apart."""
    return y[4 * k :] - 4 * y[3 * k : -k] + 6 * y[2 * k : -2 * k] - 4 * y[k : -3 * k] + y[: -4 * k]
