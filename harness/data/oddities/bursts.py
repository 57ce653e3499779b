"""Stretches in which a sensor scatters far more than elsewhere."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from harness.data.oddities.foretold import foretold
from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

_WINDOW = 32  # Rows that are asked together: an edge is known to half of them.
_TIMES = 2.0
"""Times the usual error that the middle one of a window is at least: a few large ones are spikes, or a kick."""
_GAUSS = 0.6745  # Median of the sizes of Gaussian errors over their standard deviation.
_USUAL, _ALIKE = 1e-3, 0.9
"""Chance that errors as usual are taken for others, and share of the other windows in which they are as usual: without,
they are no noise of a sensor."""
_NEUMANN = 1.5
"""Mean square of the differences of neighbouring errors over that of the errors, at least: 2 for noise of the sensor,
and less where a load or the plant itself is not foretold, for both move from row to row."""


def bursts_of(y: FloatArray, u: FloatArray) -> list[tuple[int, int, float]]:
    """Return first and last row of each burst, and the standard deviation of what a prediction misses in it.

    A window of 32 rows counts if its errors are larger than elsewhere (chi-square, Bonferroni over the windows), most
    of them, and without the correlation of neighbours that a load, or what a linear prediction does not know of a
    plant, leaves (von Neumann 1941, Ann. Math. Stat. 12:367). The errors of nearly all other windows must be alike.
    What is below a thousandth of the range is no matter.

    - ``y`` (N,)
    - ``u`` (N, nu)

    Examples
    --------
    >>> rng, k = np.random.default_rng(0), np.arange(800)
    >>> y = np.sin(0.05 * k) + 1e-3 * rng.standard_normal(800)
    >>> loud = y.copy()
    >>> loud[328:424] += 2e-2 * rng.standard_normal(96)
    >>> [(first, last) for first, last, _ in bursts_of(loud, np.zeros((800, 0)))], bursts_of(y, np.zeros((800, 0)))
    ([(328, 439)], [])
    """
    if len(y) < max(ODD.fewest, 4 * _WINDOW) or np.mean(np.diff(y) != 0.0) < 0.5:
        return []
    told = foretold(y, u)
    usual = float(np.median(told.scale))
    if usual <= 0.0:
        return []
    starts = np.arange(len(told.own), len(y) - _WINDOW + 1, _WINDOW // 2)
    errors = np.lib.stride_tricks.sliding_window_view(told.error / usual, _WINDOW)[starts]
    power = np.sum(errors**2, axis=1)
    loud = power > ODD.heavy * float(chi2.isf(ODD.rate / len(starts), _WINDOW))
    loud &= np.median(np.abs(errors), axis=1) > _TIMES * _GAUSS
    loud &= np.sum(np.diff(errors, axis=1) ** 2, axis=1) > _NEUMANN * power
    low, high = chi2.ppf([_USUAL, 1.0 - _USUAL], _WINDOW) * np.array([1.0 / ODD.heavy, ODD.heavy])
    alike = (power > low) & (power < high)
    smallest = ODD.smallest * float(np.subtract(*np.percentile(y, [90, 10])))
    loud &= power * usual**2 > _WINDOW * smallest**2
    if loud.mean() > 0.5 or alike[~loud].mean() < _ALIKE:
        return []
    found: list[tuple[int, int, float]] = []
    for start, size in zip(starts[loud], np.sqrt(power[loud] / _WINDOW) * usual, strict=True):
        first, last = int(start), int(start) + _WINDOW - 1
        if found and first <= found[-1][1] + 1:
            found[-1] = (found[-1][0], last, max(found[-1][2], float(size)))
        else:
            found.append((first, last, float(size)))
    return found
