"""Readings that are none: the one before once more, or a point of the straight line from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.data.oddities.numbers import ODD
from harness.resolution import resolution
from harness.signals import FloatArray

_SHORTEST_STEP = 1e-9  # Step of readings over their range below which it is rounding of the numbers.
_ON_LATTICE = 0.01  # How far off a multiple of a step a difference may be, in steps.
_ALL = 0.99  # Share of the differences that must be such multiples.
_NEAR = 3.5  # Steps within which changes are counted: as many of every size up to there, and none among them.
_NEARLY_ALL = 99  # Percent of the other stretches that are meant: one that is a little short of a fault hides no other.
_BEFORE = 5  # Moves before a stretch of which one at least was as usual, if the signal was on its way.
_FAINT = 0.05  # Part of the typical change of a signal that a reading must have been behind to count.
_ROUNDED = 4.0  # Last places by which four rounded readings on a line may bend it.
_PLACES = 1e-9  # Last place of a reading over the largest one, at least.


@dataclass(frozen=True, eq=False)
class Held:
    """Readings that only repeat."""

    every: int | None  # Rows from one reading to the next, where they come in a rhythm
    fresh: npt.NDArray[np.bool_]  # array of bool (N,): The readings that are some


def runs_of_equal(values: FloatArray) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return start and length of every stretch of equal samples."""
    starts = np.concatenate(([0], np.flatnonzero(np.diff(values)) + 1))
    return starts, np.diff(np.concatenate((starts, [len(values)])))


def step_of(values: FloatArray) -> float:
    """Return the step of which all differences of the values are multiples; 0 where there is none.

    Examples
    --------
    >>> step_of(np.array([0.0, 0.5, 2.0, 1.5, 1.5])), step_of(np.array([0.1, 0.5, 1.7, 2.02, 3.14159]))
    (0.5, 0.0)
    """
    distinct = np.unique(values)
    gaps = np.diff(distinct)
    gaps = gaps[gaps > _SHORTEST_STEP * np.ptp(values)]
    if len(gaps) < 2:
        return 0.0
    step = float(gaps.min())
    step = float(np.median(gaps[gaps < 1.5 * step]))  # rounded numbers: the mean of many
    off = np.abs(gaps / step - np.round(gaps / step))
    few = len(distinct) > 0.5 * np.ptp(values) / step  # many values on few places
    return step if np.mean(off < _ON_LATTICE) >= _ALL and (few or np.ptp(values) / step < 1e7) else 0.0


def rhythm_of(values: FloatArray) -> int | None:
    """Return the number of rows from one change of a signal to the next, if all its changes keep a rhythm.

    Examples
    --------
    >>> rhythm_of(np.repeat(np.random.default_rng(0).normal(size=100), 5)), rhythm_of(np.arange(100.0))
    (5, None)
    """
    changes = np.flatnonzero(np.diff(values)) + 1
    if len(changes) < ODD.changes or len(changes) > 0.6 * len(values):
        return None
    for every in range(min(ODD.slowest, len(values) // len(changes) + 1), 1, -1):
        if np.bincount(changes % every).max() >= ODD.phase * len(changes):
            return every
    return None


def held_readings(y: FloatArray, u: FloatArray) -> Held | None:
    """Return which readings of an output only repeat the last one, None if none does.

    A repeated reading is held if the next one catches up: a plant that stands still starts slowly, and the readings of
    an encoder are steps apart.

    - ``y`` (N,)
    - ``u`` (N, nu)

    Examples
    --------
    >>> y = np.sin(0.05 * np.arange(600.0))
    >>> held_readings(np.repeat(y[::3], 3), np.zeros((600, 0))).every, held_readings(y, np.zeros((600, 0)))
    (3, None)
    """
    n = len(y)
    starts, lengths = runs_of_equal(y)
    rails = (y[starts] == y.max()) | (y[starts] == y.min())  # where it rests at a rail it is held by that
    repeats = int((lengths - 1)[~rails].sum())
    if n < ODD.fewest or repeats < max(10, ODD.repeats * n) or len(np.unique(y)) < ODD.changes:
        return None
    step = step_of(y)
    jumps = np.abs(np.diff(y[starts]))
    by_chance = np.sum(jumps < _NEAR * step) / (2 * int(_NEAR)) if step else 0.0
    if repeats < ODD.above_step * by_chance + 10:  # noise falls on the same step again
        return None
    typical = float(np.median(jumps)) if jumps.size else 0.0
    if typical <= ODD.above_step * step:
        return None
    fresh = np.zeros(n, dtype=bool)
    fresh[starts] = True
    every = rhythm_of(y)
    if every is not None:
        if any(rhythm_of(column) == every for column in u.T):
            return None  # an output that only follows an input held as long
        phase = int(np.bincount(starts[1:] % every).argmax())
        fresh[:] = False
        fresh[phase::every] = True
        fresh[0] = True
        return Held(every, fresh)
    held = np.flatnonzero((lengths[1:-1] > 1) & (lengths[1:-1] <= ODD.slowest) & ~rails[1:-1]) + 1
    if held.size < 10:
        return None
    # what the signal moved per row before and after, against the jump after the hold
    before, after = np.abs(y[starts[held]] - y[starts[held] - 1]), np.abs(y[starts[held + 1]] - y[starts[held]])
    meanwhile = np.maximum(before / lengths[held - 1], _FAINT * typical) * lengths[held]
    caught = after / meanwhile
    if np.median(caught) < ODD.catch_up or np.median(after) <= ODD.above_step * step:
        return None
    return Held(None, fresh)


def filled_readings(y: FloatArray, u: FloatArray) -> Held | None:
    """Return which readings of an output are no points of straight lines between others, None if all are readings.

    A log that was filled in, or brought to a faster clock, goes on straight and bends where a reading was: in a rhythm
    that no input has, or in stretches as :func:`stuck_rows` has them of a slope that scatters with the sensor's noise.

    - ``y`` (N,)
    - ``u`` (N, nu)

    Examples
    --------
    >>> k = np.arange(601.0)
    >>> y = np.interp(k, k[::3], np.sin(0.05 * k[::3]))
    >>> filled_readings(y, np.zeros((601, 0))).every, filled_readings(np.sin(0.05 * k), np.zeros((601, 0)))
    (3, None)
    """
    if len(y) < ODD.fewest:
        return None
    slope = np.diff(y)
    least = max(resolution([y]), _PLACES * float(np.abs(y).max()))
    bends = np.concatenate([[True], np.abs(np.diff(slope)) > _ROUNDED * least])
    slope = slope[np.maximum.accumulate(np.where(bends, np.arange(len(slope)), 0))]
    every = rhythm_of(slope)
    fresh = np.ones(len(y), dtype=bool)
    if every is not None and not any(every in (rhythm_of(one), rhythm_of(np.diff(one))) for one in u.T):
        knots = np.flatnonzero(np.diff(slope)) + 1
        fresh[:] = False
        fresh[int(np.bincount(knots % every).argmax()) :: every] = True
        fresh[0] = True
        return Held(every, fresh)
    if scatters(slope):
        for first, length in stuck_rows(slope):
            fresh[first + 1 : first + length] = slope[first] == 0.0  # a reading that rests, at a rail or stuck
    return None if fresh.all() else Held(None, fresh)


def scatters(values: FloatArray) -> bool:
    """Return True where a signal turns back as often as the noise of a sensor does, and no plant that moves by itself.

    Examples
    --------
    >>> k = np.arange(600.0)
    >>> scatters(np.sin(0.05 * k)), scatters(np.random.default_rng(0).standard_normal(600))
    (False, True)
    """
    moves = np.diff(values)
    return bool(np.mean(moves[1:] * moves[:-1] < 0.0) > ODD.turns)


def stuck_rows(y: FloatArray) -> list[tuple[int, int]]:
    """Return first row and length of every stretch in which a sensor stood still while it otherwise never does.

    One that is ten times longer than any other between start and end is told by that. Others, which may be shorter, are
    exceptions so much longer than nearly all the rest, and than all rests at the same value, and less than half of the
    rows; and the signal was on its way before each, as one that settles is not, and went on at once, as one that sticks
    does not, by more than a few steps of its readings, as an encoder at rest does not.

    - ``y`` (N,)

    Examples
    --------
    >>> y = np.sin(0.05 * np.arange(600.0))
    >>> y[100:130], y[310:420], y[500:510] = y[100], y[310], y[500]
    >>> stuck_rows(y), stuck_rows(np.round(y))
    ([(100, 30), (310, 110), (500, 10)], [])
    """
    starts, lengths = runs_of_equal(y)
    moves = np.abs(np.diff(y[starts]))
    if not moves.size:
        return []
    usual, step = float(np.median(moves)), step_of(y)
    ends = starts + lengths
    # a plant at rest before its first and after its last excitation is no fault
    between = (starts > 0) & (ends < len(y))
    inside = between & (y[starts] != y.max()) & (y[starts] != y.min())
    sudden = inside & (lengths >= ODD.brief)
    for k in np.flatnonzero(sudden):
        arrived = moves[max(k - _BEFORE, 0) : k].max()
        sudden[k] = min(arrived, float(moves[k])) >= ODD.on_its_way * usual and moves[k] > ODD.above_step * step
    places = np.flatnonzero(sudden)
    places = places[np.argsort(-lengths[places], kind="stable")]
    for count in range(len(places), 0, -1):
        others = np.delete(lengths, places[:count])
        least = int(lengths[places[count - 1]])
        again = between & np.isin(y[starts], y[starts[places[:count]]])
        again[places[:count]] = False
        if least < 10 * lengths[again].max(initial=0):  # a machine that sticks has no speed at all its turns
            continue
        if 2 * others.sum() > len(y) and least >= min(10 * np.percentile(others, _NEARLY_ALL), 50 * np.mean(others)):
            return [(int(starts[k]), int(lengths[k])) for k in np.sort(places[:count])]
    first = int(np.argmax(lengths))
    others = np.where(inside, lengths, 1)
    others[first] = 1
    if inside[first] and lengths[first] >= max(ODD.still, 0.01 * len(y), 10 * int(others.max())):
        return [(int(starts[first]), int(lengths[first]))]
    return []
