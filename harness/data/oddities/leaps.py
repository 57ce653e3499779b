"""Rows that were lost without a trace, or a sensor that slipped: a position goes on elsewhere than where it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

POSITIONS = ("rad", "m")  # Units of what has a rate, and so does not leap.
SIDE = 8  # Rows on each side from which a parabola tells where the motion is between two rows.
STRIDES = 4.0
"""Times the largest step of the motion about it that a leap must be: less may be a row or two, and a quick motion."""
BADLY = 3.0  # Times its usual scatter about a parabola up to which a side counts as followed.


def leaps_of(y: FloatArray, step: float = 0.0) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the rows before which a position leaps, and by how much.

    The motion before and after, each followed by a parabola of its own, would have to meet between two rows. A kick or
    a stop bends it there, and it still meets.

    - ``y`` (N,): a position, an angle without the jumps of a turn
    - ``step``: of the sensor: at rest a reading goes to and fro by one

    - returns ``rows``
    - returns ``sizes``

    Examples
    --------
    >>> t = np.arange(400) * 0.02
    >>> y = np.sin(2 * t) + 1e-3 * np.random.default_rng(0).standard_normal(400)
    >>> cut = np.delete(y, np.arange(155, 175))
    >>> rows, sizes = leaps_of(cut)
    >>> rows.tolist(), bool(abs(sizes[0] - (y[175] - y[155])) < 0.05), leaps_of(y)[0].tolist()
    ([155], True, [])
    """
    nothing = np.zeros(0, dtype=np.intp), np.zeros(0)
    if len(y) < max(ODD.fewest, 4 * SIDE):
        return nothing
    windows = np.lib.stride_tricks.sliding_window_view(y, SIDE)
    place = np.arange(SIDE) - (SIDE - 1) - 0.5  # of the rows before, from between the two
    basis = np.vander(place, 3, increasing=True)
    solve = np.linalg.pinv(basis)
    before, after = windows[:-SIDE], windows[SIDE:, ::-1]  # the same parabola, seen from the other side
    told, other = before @ solve[0], after @ solve[0]
    gap = other - told
    scatter = np.maximum(_rms(before, basis, solve), _rms(after, basis, solve))
    usual = 1.4826 * float(np.median(np.abs(gap)))
    largest = np.maximum(np.abs(np.diff(before, axis=1)).max(axis=1), np.abs(np.diff(after, axis=1)).max(axis=1))
    bound = ODD.heavy * float(norm.isf(0.5 * ODD.rate / len(y))) * usual
    leaps = (np.abs(gap) > np.maximum(bound, STRIDES * np.maximum(largest, step))) & (
        scatter <= BADLY * float(np.median(scatter))
    )
    rows = np.flatnonzero(leaps)
    return rows + SIDE, gap[rows]


def _rms(windows: FloatArray, basis: npt.NDArray[Any], solve: npt.NDArray[Any]) -> FloatArray:
    """Return the rms of what parabolas leave of windows (n,)."""
    return np.asarray(np.sqrt(np.mean((windows - windows @ solve.T @ basis.T) ** 2, axis=1)))
