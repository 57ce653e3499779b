"""Jumps of the state in sampled records: between which samples, when, and from where to where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray, Trajectory

_DEGREE = 2  # Of the polynomials that continue a record to the instant of a jump from either side.
_GAP = 12.0  # A gap between both sides of so many robust standard deviations of all gaps is a jump.
_INSTANTS = 201  # Instants within a sample at which both sides are compared before the best one is refined.


@dataclass(frozen=True, eq=False)
class StateJump:
    """One jump between two samples."""

    # It lies between ``sample`` and ``sample + 1`` of this record
    record: int
    sample: int
    instant: float  # In samples after ``sample``, 0 to 1
    # (ny,): Outputs on both sides
    before: FloatArray
    after: FloatArray


def find_jumps(
    records: Sequence[Trajectory],
    continuous: npt.NDArray[np.intp],
    roles: npt.NDArray[np.intp],
    *,
    width: int = 6,
) -> list[StateJump]:
    """Find jumps by continuing the record to each gap between samples from both sides (local parabolas).

    The instant within the gap is where those outputs meet that do not jump.

    - ``continuous`` array (n,) of int: outputs that do not jump, such as positions
    - ``roles`` array (ny,) of int: output i before a jump is output ``roles[i]`` after it (legs that change roles)
    - ``width``: samples on each side that a parabola is fitted to, at least 3. Jumps nearer to each other or to the
      ends of a record are left out.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> t = np.arange(100.0)
    >>> z = np.abs(t - 50.3)
    >>> spec = PlantSpec((), (Channel("z"), Channel("z_rate")), 1.0)
    >>> record = Trajectory(t, np.zeros((100, 0)), np.stack([z, np.where(t < 50.3, -1.0, 1.0)], axis=1), spec)
    >>> (jump,) = find_jumps([record], np.array([0]), np.array([0, 1]))
    >>> jump.sample, round(jump.instant, 6), float(jump.before[1].round(6)), float(jump.after[1].round(6))
    (50, 0.3, -1.0, 1.0)
    """
    gaps = [_gaps(record.y, width) for record in records]
    known = [gap for gap in gaps if len(gap)]
    if not known:
        return []
    moved = np.concatenate(known)
    size = np.median(np.abs(moved), axis=0) / 0.6745
    # Rounding of exact data is no scale for a jump.
    size = np.maximum(size, 1e-6 * np.concatenate([record.y for record in records]).std(axis=0) + 1e-300)
    found = []
    for number, (record, gap) in enumerate(zip(records, gaps, strict=True)):
        strength = np.abs(gap / size).max(axis=1) if len(gap) else np.zeros(0)
        # The first and the last gap may only feel a jump that lies beyond them.
        for k in np.flatnonzero(strength[1:-1] > _GAP) + 1:
            near = strength[max(k - width + 1, 0) : k + width]
            if strength[k] == near.max():
                jump, apart = _timed(number, int(k) + width - 1, record.y, continuous, roles, width, size)
                found += [jump] if apart <= _GAP else []  # positions that never meet: two jumps close together
    return found


def _weights(width: int, at: FloatArray) -> FloatArray:
    """Return the weights (len(at), width) that continue samples at -width+1 .. 0 to instants by a parabola."""
    powers = np.vander(np.arange(1.0 - width, 1.0), _DEGREE + 1)
    return np.asarray(np.vander(at, _DEGREE + 1) @ np.linalg.pinv(powers))


def _gaps(y: FloatArray, width: int) -> FloatArray:
    """Return how far both sides are apart in the middle of each gap (N - 2 width + 1, ny)."""
    count = len(y) - 2 * width + 1
    if count < 1:
        return np.zeros((0, y.shape[1]))
    (weights,) = _weights(width, np.array([0.5]))
    both = np.concatenate([-weights, weights[::-1]])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(y, 2 * width, axis=0) @ both)


def _timed(
    number: int,
    k: int,
    y: FloatArray,
    continuous: npt.NDArray[np.intp],
    roles: npt.NDArray[np.intp],
    width: int,
    size: FloatArray,
) -> tuple[StateJump, float]:
    """Return the jump between samples k and k + 1, and how far apart the outputs are that should meet."""
    at = np.linspace(0.0, 1.0, _INSTANTS)
    left = _weights(width, at) @ y[k - width + 1 : k + 1]
    right = _weights(width, 1.0 - at) @ y[k + 1 : k + 1 + width][::-1]
    right = right[:, roles]
    apart = (left - right)[:, continuous] / size[continuous]
    best = int(np.argmin((apart**2).sum(axis=1)))
    low = min(max(best - 1, 0), _INSTANTS - 2)
    # The gap is nearly linear in time between two neighbours: the root of its least squares.
    step = apart[low + 1] - apart[low]
    part = float(np.clip(-(apart[low] @ step) / max(float(step @ step), 1e-300), 0.0, min(2.0, _INSTANTS - 1 - low)))
    instant = np.array([(low + part) / (_INSTANTS - 1)])
    before = _weights(width, instant) @ y[k - width + 1 : k + 1]
    after = _weights(width, 1.0 - instant) @ y[k + 1 : k + 1 + width][::-1]
    jump = StateJump(number, k, float(instant[0]), before[0], after[0])
    return jump, float(np.abs((before[0] - after[0, roles])[continuous] / size[continuous]).max())
