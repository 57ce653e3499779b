"""The offset between the clocks of two loggers, from a quantity that both recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

OVERLAP = 0.5  # Share of the shorter record that the two must have in common: few rows agree by chance.
ALIKE = 0.9  # Least correlation of two records of one quantity: below it a fifth of the motion is in one of them alone.
RIVAL = 4.0
"""Times the unexplained part of the best offset within which another offset is as good: noise that meets the two
records by chance changes it by less where they have half of the shorter one in common."""
WIDE = 0.1
"""Part of the shorter record over which offsets may be as good as the best: beyond it they are not determined."""
REACH = 5.0
"""Rows of the coarser record to either side over which a slope is taken: noise adds to it one over ten of them."""
BLOCKS = 20  # Stretches between which errors are taken to be independent: the deviation follows from how they scatter.
FLOOR = 1e-4  # Unexplained part below which two offsets are alike, whatever noise there is: what interpolation leaves.
FINEST = 1 << 22  # Most rows of the common grid.


@dataclass(frozen=True)
class Offset:
    """What is to be added to the second clock [s], its standard deviation, and how alike the records then are."""

    seconds: float
    deviation: float
    correlation: float


def offset_between(t: FloatArray, y: FloatArray, other_t: FloatArray, other_y: FloatArray) -> Offset:
    """Return the offset of a second clock: the maximum of the correlation, refined between the rows.

    The refined offset minimises what a straight line through the first record leaves of the second. Its deviation is
    that of a least-squares estimate whose errors are independent between stretches only (White 1980, clustered).

    Raises InputError if the records are not alike at any offset, or alike at several.

    - ``t``, ``y`` (N,), ``other_t``, ``other_y`` (M,): stamps [s] and readings of one quantity

    Examples
    --------
    >>> t = 0.01 * np.arange(3000)
    >>> move = lambda s: np.sin(s) * np.exp(-0.1 * (s - 12.0) ** 2)
    >>> found = offset_between(t, move(t), t[:2500], move(t[:2500] + 3.2))
    >>> round(found.seconds, 3), round(found.correlation, 3)
    (3.2, 1.0)
    """
    kept, other_kept = np.isfinite(t) & np.isfinite(y), np.isfinite(other_t) & np.isfinite(other_y)
    t, y, other_t, other_y = t[kept], y[kept], other_t[other_kept], other_y[other_kept]
    if min(len(t), len(other_t)) < 3 or not np.ptp(y) or not np.ptp(other_y):
        raise _unlike("one that does not move, or too few rows")
    spans = (t[-1] - t[0], other_t[-1] - other_t[0])
    step = max(min(np.median(np.diff(t)), np.median(np.diff(other_t))), sum(spans) / FINEST)
    one, two = (
        np.interp(np.arange(clock[0], clock[-1], step), clock, values) for clock, values in ((t, y), (other_t, other_y))
    )
    correlation = _correlations(one, two)
    best = int(np.argmax(correlation))
    if not correlation[best] >= ALIKE:
        raise _unlike(f"a correlation of at most {max(correlation[best], 0.0):.2f}")
    lag = float(t[0] - other_t[0] + (best - (len(two) - 1)) * step)
    _refuse_rivals(correlation, best, lag, step, min(spans))
    return _refined(t, y, other_t, other_y, lag, step)


def _correlations(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the correlation of two records at every lag (N + M - 1,) of the second; -1 where too few rows meet."""
    from scipy.signal import fftconvolve

    one, two = one - one.mean(), two[::-1] - two.mean()
    ones, twos = np.ones(len(one)), np.ones(len(two))
    count = np.maximum(np.round(fftconvolve(ones, twos)), 1.0)
    sums = fftconvolve(one, twos), fftconvolve(ones, two)
    products = fftconvolve(one, two) - sums[0] * sums[1] / count
    squares = fftconvolve(one**2, twos) - sums[0] ** 2 / count, fftconvolve(ones, two**2) - sums[1] ** 2 / count
    floor = 1e-9 * np.array([np.sum(one**2), np.sum(two**2)])
    found = products / np.sqrt(np.maximum(squares[0], floor[0]) * np.maximum(squares[1], floor[1]))
    return np.where(count >= OVERLAP * min(len(one), len(two)), found, -1.0)


def _refuse_rivals(correlation: FloatArray, best: int, lag: float, step: float, span: float) -> None:
    """Refuse an offset beside which others are as good: of a motion that repeats itself, or is a ramp."""
    left = 1.0 - correlation
    limit = RIVAL * left[best] + FLOOR
    near = np.flatnonzero(left < limit)
    wide = (near[-1] - near[0]) * step > WIDE * span
    if wide or left[near[0] : near[-1]].max(initial=0.0) > 2.0 * limit:
        rival = int(near[0] if best - near[0] > near[-1] - best else near[-1])
        raise InputError(
            "the offset of two clocks",
            expected="one at which the two records are alike",
            got=f"{lag:.6g} s and {lag + (rival - best) * step:.6g} s, correlations {correlation[best]:.4f} and "
            f"{correlation[rival]:.4f}",
            remedy="declare offset (s): a motion that repeats itself, or only grows or decays, does not tell it",
        )


def _refined(t: FloatArray, y: FloatArray, other_t: FloatArray, other_y: FloatArray, lag: float, step: float) -> Offset:
    """Return the offset between the rows of the grid, with its deviation."""
    from scipy.optimize import minimize_scalar

    def fitted(offset: float) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        at = other_t + offset
        inside = (at >= t[0]) & (at <= t[-1])
        shown = np.column_stack((np.interp(at[inside], t, y), np.ones(int(inside.sum()))))
        factors = np.linalg.lstsq(shown, other_y[inside], rcond=None)[0]
        return float(factors[0]), other_y[inside] - shown @ factors, at[inside], other_y[inside]

    def mean_square(offset: float) -> float:
        return float(np.mean(fitted(offset)[1] ** 2))

    found = minimize_scalar(
        mean_square, bounds=(lag - 2 * step, lag + 2 * step), method="bounded", options={"xatol": 1e-4 * step}
    )
    offset = float(found.x)
    factor, left, at, readings = fitted(offset)
    reach = REACH * max(float(np.median(np.diff(t))), float(np.median(np.diff(other_t))))
    slopes = factor * (np.interp(at + reach, t, y) - np.interp(at - reach, t, y)) / (2.0 * reach)
    slopes -= slopes.mean()
    scores = [float(block.sum()) for block in np.array_split(left * slopes, BLOCKS)]
    deviation = float(np.linalg.norm(scores)) / max(float(np.sum(slopes**2)), 1e-300)
    share = 1.0 - float(np.var(left)) / float(np.var(readings))
    return Offset(offset, deviation, float(np.sqrt(max(share, 0.0))))


def _unlike(got: str) -> InputError:
    """Return the refusal of two records that do not show one quantity."""
    return InputError(
        "the offset of two clocks",
        expected="two records of one quantity that moves, in common for half of the shorter one",
        got=got,
        remedy="name columns of the same quantity (same = [...]), or declare offset (s)",
    )
