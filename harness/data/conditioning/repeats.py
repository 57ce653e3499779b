"""Rows that share a time stamp, or a sample of a clock: parts of one row, doubled rows, or two rows too many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.data.conditioning.clock import TimeRules
from harness.errors import InputError
from harness.signals import FloatArray

TWICE = 0.25  # Part of a step by which the stamps of a row that was logged twice may differ.

REPEATED = 0.1
"""Share of rows that may repeat a time stamp with other readings: beyond it the stamps are coarser than the steps, and
to keep one row of each would leave instants that nobody knows."""

UNUSED = 3
"""Rows that repeat one row with its stamp at the end of a record from which they are space that was set aside and never
written to: two may be one row that was logged twice."""
COARSE = 0.01
"""Share of stamps that repeat elsewhere beyond which the clock is coarse, and rows at rest may look alike."""


def without_tail(time: FloatArray, values: FloatArray, notes: list[str]) -> int:
    """Return how many rows count where the last ones repeat one row, its stamp included, that no clock took.

    A buffer that was set aside before the measurement ends in zeros, or in the last row over and over.
    """
    rows = len(time)
    if rows <= UNUSED or time[-1] != time[-2]:
        return rows
    like = (time == time[-1]) & np.isclose(values, values[-1], rtol=0.0, atol=0.0, equal_nan=True).all(axis=1)
    begin = rows - int(np.argmin(like[::-1])) if not like.all() else 0
    if rows - begin < UNUSED or begin < 2 or np.mean(np.diff(time[:begin]) == 0) > COARSE:
        return rows
    end = begin + int(time[begin] > time[begin - 1])
    if end < rows:
        notes.append(
            f"the last {rows - end} rows repeat one row and its stamp: nothing was written there, they are left out"
        )
    return end


def complemented(
    time: FloatArray, values: FloatArray, notes: list[str]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Return rows that share a stamp as one where no signal is filled twice: a logger wrote each signal by itself."""
    rows = np.arange(len(time))
    first = np.concatenate(([True], np.diff(time) != 0))
    there = np.isfinite(values)
    if first.all() or there.all():
        return time, values, rows
    groups = np.cumsum(first) - 1
    filled = np.zeros((int(groups[-1]) + 1, values.shape[1]), dtype=np.int64)
    np.add.at(filled, groups, there)
    if filled.max(initial=0) > 1:
        return time, values, rows
    whole = np.full(filled.shape, np.nan)
    row, column = np.nonzero(there)
    whole[groups[row], column] = values[row, column]
    notes.append(
        f"{len(time)} rows of {len(whole)} instants, none with a signal twice, are put together by their stamps"
    )
    return time[first], whole, rows[first]


def without_duplicates(
    keys: npt.NDArray[Any], time: FloatArray, values: FloatArray, rules: TimeRules, notes: list[str]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Return the rows with keys (time stamps or samples) of their own, as declared, and their rows in the file."""
    rows = np.arange(len(time))
    if rules.duplicates == "refuse" or len(time) < 2:
        return time, values, rows
    first = np.concatenate(([True], np.diff(keys) != 0))
    if first.all():
        return time, values, rows
    differ = ~first[1:] & ~np.isclose(values[1:], values[:-1], rtol=0.0, atol=0.0, equal_nan=True).all(axis=1)
    if differ.mean() > REPEATED:
        raise InputError(
            f"{int(differ.sum())} of {len(time)} rows repeat the time stamp of the row before with other readings",
            expected=f"at most {REPEATED:.0%} of the rows: more are no doubled rows, but stamps coarser than the steps",
            got=f"{int(first.sum())} time stamps for {len(time)} rows, and duplicates = {rules.duplicates!r}",
            remedy="declare sample_time without duplicates if a clock took the rows, or record finer time stamps",
            place="duplicates",
        )
    groups = np.cumsum(first) - 1
    count = int(groups[-1]) + 1
    last = np.concatenate((first[1:], [True]))
    kept = last if rules.duplicates == "last" else first
    chosen = values[kept]
    if rules.duplicates == "mean":
        chosen = np.column_stack([np.bincount(groups, column) for column in values.T]) / np.bincount(groups)[:, None]
    other = f"; {int(differ.sum())} of them have other readings" if differ.any() else ""
    notes.append(
        f"{len(time) - count} rows repeat the time stamp of the row before: the {rules.duplicates} counts{other}"
    )
    return time[kept], chosen, rows[kept]


def refuse_two_in_one(
    index: npt.NDArray[np.int64], time: FloatArray, dt: float, rules: TimeRules, where: Callable[[int], str]
) -> None:
    """Refuse rows in one sample of a clock whose stamps are apart: they are no doubled rows, of which one is enough."""
    apart = (np.diff(index) == 0) & (np.diff(time) > TWICE * dt)
    if rules.duplicates != "refuse" and apart.any():
        row = int(np.argmax(apart)) + 1
        raise InputError(
            "two rows in one sample of the declared clock",
            expected=f"stamps of doubled rows within {TWICE:g} of {dt:g} s, or rows in samples of their own",
            got=f"{time[row] - time[row - 1]:.3g} s between {where(row - 1)} and {where(row)}",
            remedy="correct sample_time, or cut the run there by rows = [start, stop]: the stamps are too rough to say "
            "which samples these rows are",
            place=where(row),
        )
