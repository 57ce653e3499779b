"""Rows that a log lost, or wrote twice, without a trace in its clock: what follows is a record of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d
from scipy.special import chdtri
from scipy.stats import norm

from harness.data.oddities.foretold import Foretold, foretold
from harness.data.oddities.leaps import STRIDES
from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

_USUAL = 1e-3  # Chance that errors as usual are taken for ones that another number of rows does not explain.


@dataclass(frozen=True)
class Slip:
    """A place where rows and time part."""

    row: int  # The first one that belongs to what follows
    lost: int  # Rows that are missing before it; -1 for one that was written twice


def slips_of(y: FloatArray, u: FloatArray, odd: npt.NDArray[np.bool_]) -> list[Slip]:
    """Return where a log lost up to ``ODD.lost`` rows, or wrote one twice.

    Outputs are foretold from their past and the inputs. Where rows are missing, every prediction across the gap errs;
    with as many unknown rows put in their place, the outputs are as well foretold as elsewhere. A kick of the plant,
    which leaves one error, is the rival: rows are called lost where they explain the errors far better, and with as few
    numbers. A row that was written twice is equal in every channel, and the outputs are as well foretold as elsewhere
    without it; of readings that were held it would have to stay. Outputs that often repeat a reading tell nothing.

    - ``y`` (N, ny)
    - ``u`` (N, nu)
    - ``odd`` array of bool (N,): rows with a reading that is none

    Examples
    --------
    >>> rng, t = np.random.default_rng(0), 0.02 * np.arange(600)
    >>> y, nothing, no = np.sin(3 * t)[:, None] + 1e-3 * rng.standard_normal((600, 1)), np.zeros((600, 0)), t < 0
    >>> slips_of(np.delete(y, 200, axis=0), nothing[1:], no[1:]), slips_of(y, nothing, no)
    ([Slip(row=200, lost=1)], [])
    >>> slips_of(np.insert(y, 200, y[199], axis=0), np.zeros((601, 0)), np.zeros(601, dtype=bool))
    [Slip(row=200, lost=-1)]
    """
    count = len(y)
    moving = np.mean(np.diff(y, axis=0) != 0.0, axis=0) > 1.0 - ODD.repeats
    if count < ODD.fewest or not moving.any():
        return []
    twice = np.flatnonzero((np.diff(np.hstack([y, u]), axis=0) == 0.0).all(axis=1)) + 1
    y = y[:, moving]
    told = [foretold(one, u, odd) for one in y.T]
    errors = np.array([one.error / one.scale for one in told])
    n = len(told[0].own)
    bound = ODD.heavy * float(norm.isf(0.5 * ODD.rate / count))
    far = np.flatnonzero(np.abs(errors).max(axis=0) > bound)
    asked = [(int(row), -1) for row in twice]
    asked += [(int(row) - early, lost) for row in far for lost in range(1, ODD.lost + 1) for early in (0, 1)]
    near_odd = maximum_filter1d(odd, 4 * n + 1)
    unknown = {lost: [_unknown(one, max(lost, 0)) for one in told] for lost in {lost for _, lost in asked}}
    found: list[Slip] = []
    for row, lost in asked:
        whole = 2 * n <= row < count - 2 * n - 1 and not near_odd[row]
        if not whole or any(abs(row - slip.row) <= 2 * n for slip in found):
            continue
        if (lost < 0 or _calm(u[row - 2 * n : row + 2 * n])) and _told(y, u, told, row, lost, unknown[lost]):
            found.append(Slip(row, lost))
    return sorted(found, key=lambda slip: slip.row)


def _calm(u: FloatArray) -> bool:
    """Return True where no input jumps in the middle of a stretch: what answers it may look like rows that are lost."""
    moves, middle = np.abs(np.diff(u, axis=0)), len(u) // 2
    return bool((moves[middle - 3 : middle + 1] <= STRIDES * np.median(moves, axis=0)).all())


def _told(y: FloatArray, u: FloatArray, told: list[Foretold], row: int, lost: int, unknown: list[FloatArray]) -> bool:
    """Return True where rows that are lost before one, or it itself written twice, explain the errors after it."""
    n, more, first = len(told[0].own), max(lost, 0), row - min(lost, 0)
    before, after = slice(row - n, row), slice(first, first + 2 * n)
    share = np.arange(1, more + 1)[:, None] / (more + 1)
    inputs = np.vstack([u[before], u[row - 1] + share * (u[row] - u[row - 1]), u[after]])
    left = rival = whole = 0.0
    for one, readings, free in zip(told, y.T, unknown, strict=True):
        scale, level = one.scale[row], _level(one, readings, u, row)
        wrong = _errors(one, np.concatenate([readings[before], np.zeros(more), readings[after]]), inputs, level)
        wrong = wrong - free @ (free.T @ wrong)
        left += float(wrong @ wrong) / scale**2
        own = np.sort((one.error[row : row + 2 * n] / scale) ** 2)
        whole += float(own.sum())
        rival += float(own[: -max(more * (1 + u.shape[1]), 1)].sum())  # what as many kicks would leave
    usual = left <= ODD.heavy * float(chdtri(2 * n * len(told), _USUAL))
    return usual and 0.5 * (whole - left) > ODD.felt and left <= ODD.rival * rival


def _unknown(one: Foretold, rows: int) -> FloatArray:
    """Return a basis (2 n + rows, k), of unit length, of what unknown readings and inputs of some rows do to errors."""
    n = len(one.own)
    each = np.column_stack([one.pattern, -one.other])
    columns = np.zeros((2 * n + rows, rows, each.shape[1]))
    for row in range(rows):
        columns[row : row + n + 1, row] = each
    left, values, _ = np.linalg.svd(columns.reshape(len(columns), -1), full_matrices=False)
    return np.asarray(left[:, values > len(columns) * np.finfo(float).eps * values.max(initial=0.0)])


def _errors(one: Foretold, y: FloatArray, u: FloatArray, level: float) -> FloatArray:
    """Return what a prediction misses of a stretch, without its first n rows."""
    n = len(one.own)
    wrong = y[n:] - level
    for lag, value in enumerate(one.own, 1):
        wrong = wrong - value * y[n - lag : len(y) - lag]
    for lag, values in enumerate(one.other):
        wrong = wrong - u[n - lag : len(u) - lag] @ values
    return np.asarray(wrong)


def _level(one: Foretold, y: FloatArray, u: FloatArray, row: int) -> float:
    """Return the constant of a prediction."""
    n = len(one.own)
    part = slice(row - n, row + 1)
    return float(_errors(one, y[part], u[part], 0.0)[0] - one.error[row])
