"""The time axis of a record: checked for uniformity; split at gaps or resampled where that is declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from harness.data.decimation import EDGE, filtered, hold_means
from harness.data.sections import Gaps, ResampleSection
from harness.errors import InputError
from harness.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]

__all__ = [
    "JITTER_ACCEPTED",
    "JITTER_UNNOTICED",
    "Piece",
    "TimeRules",
    "pieces_of",
    "refuse_unlikely_seconds",
    "sample_time_of",
]

JITTER_UNNOTICED = 1e-3
"""Deviation from the grid, in sample times, that recorded time stamps have anyway (rounding)."""

JITTER_ACCEPTED = 2e-2
"""Up to this deviation a record counts as uniform, with a warning; beyond it is refused or resampled."""

SLOWEST_UNSTATED = 1.0
"""Steps [s] from which a time column without a unit is asked for one: whole numbers at 1 kHz count milliseconds, and a
log of seconds that is as slow is told apart by nothing but its title."""

_SHORTEST = 10


@dataclass(frozen=True)
class TimeRules:
    """What the data set declares about time."""

    sample_time: float | None = None
    gaps: Gaps = "refuse"
    resample: ResampleSection | None = None
    intersample: Literal["zoh", "foh", "smooth"] = "zoh"
    duplicates: Literal["refuse", "first", "last", "mean"] = "refuse"


@dataclass(frozen=True, eq=False)
class Piece:
    """One uninterrupted piece: its first instant [s], its signals (N, m), and the sample time [s] they came with."""

    start: float
    values: FloatArray
    sample_time: float


def sample_time_of(time: FloatArray) -> float:
    """Return the sample time that the steady part of a time column has, to nine digits.

    Examples
    --------
    >>> sample_time_of(np.array([0.0, 0.1, 0.2, 0.3, 0.7, 0.8]))
    0.1
    """
    steps = np.diff(time)
    typical = float(np.median(steps))
    steady = steps[np.abs(steps - typical) < 0.5 * typical]
    return float(f"{steady.mean():.9g}")


def refuse_unlikely_seconds(time: FloatArray, title: str) -> None:
    """Refuse time stamps without a unit whose steps would be rare ones in seconds.

    Raises
    ------
    InputError
        If the median step is :data:`SLOWEST_UNSTATED` or more.

    Examples
    --------
    >>> refuse_unlikely_seconds(np.arange(5) * 0.01, "time")
    """
    steps = np.diff(time[np.isfinite(time)])
    typical = float(np.median(steps)) if steps.size else 0.0
    if typical >= SLOWEST_UNSTATED:
        raise InputError(
            f"the time column {title!r} states no unit",
            expected=f"a unit where rows are {SLOWEST_UNSTATED:g} or more apart",
            got=f"steps of {typical:g}",
            remedy=f'title it "{title} [ms]" or "{title} [s]", or declare [time] unit in a dataset.toml',
            place="time.unit",
        )


def pieces_of(
    time: FloatArray | None,
    values: FloatArray,
    *,
    names: tuple[str, ...],
    inputs: tuple[bool, ...],
    rules: TimeRules,
    common: float | None = None,
    where: Callable[[int], str] = "row {}".format,
) -> tuple[list[Piece], list[str]]:
    """Turn the columns of one run into pieces with a uniform time axis.

    Parameters
    ----------
    time : array (N,) or None
        Time stamps [s]; None where only a sample time is declared.
    values : array (N, m)
        Signals; NaN where nothing was recorded.
    names : tuple of str
        Names of the m signals, for messages.
    inputs : tuple of bool
        Which of them are inputs: resampled as they are held between samples.
    rules : TimeRules
        What the data set declares.
    common : float, optional
        Sample time [s] of the runs before: all share one.
    where : callable
        Returns what a person calls a row (from 0), for messages.

    Returns
    -------
    pieces : list of Piece
    notes : list of str
        What was noticed and done, for the warnings of the data set.

    Raises
    ------
    InputError
        If the time is not usable and no declared remedy covers it.
    """
    notes: list[str] = []
    if time is None:
        if rules.sample_time is None:
            raise InputError(
                "no time",
                expected="sample_time = ... or a time column",
                got="neither",
                remedy="declare sample_time in s, or [time] column = ...",
                place="sample_time",
            )
        dt = rules.sample_time
        stamps: FloatArray = np.arange(values.shape[0], dtype=np.float64) * dt
    else:
        time, values, rows = _without_duplicates(time, values, rules, notes)
        where = _renamed(where, rows)
        stamps = time
        _check_time(time, where)
        dt = _agreed(time, rules, common) if len(time) > 1 else (rules.sample_time or common or 1.0)
    present: BoolArray = np.asarray(np.isfinite(values).all(axis=1), dtype=np.bool_)
    if rules.resample is not None:
        return _resampled(stamps, values, present, dt, inputs, rules, notes), notes
    if not present.all() and rules.gaps == "refuse":
        row, column = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
        missing = int((~present).sum())
        raise InputError(
            f"nothing recorded in {missing} of {len(present)} rows",
            expected="a number in every row",
            got=f"{values[row, column]} in {where(row)} of {names[column]}",
            remedy='cut the run with rows = [start, stop], or declare gaps = "split" or [resample]',
            place=f"{where(row)}, signal {names[column]}",
        )
    steps = np.diff(stamps)
    jumps = np.abs(steps - dt) > 0.5 * dt
    if jumps.any() and rules.gaps == "refuse":
        k = int(np.argmax(jumps))
        raise InputError(
            f"time is not uniform ({int(jumps.sum())} gaps)",
            expected=f"a step of {dt:g} s between rows",
            got=f"{steps[k]:g} s between {where(k)} and {where(k + 1)} (t = {stamps[k]:g} s)",
            remedy='declare gaps = "split" or [resample] in a dataset.toml, or cut the run with rows = [start, stop]',
            place=where(k + 1),
        )
    cuts = np.flatnonzero(~present[:-1] | ~present[1:] | jumps) + 1
    kept, lost = [], 0
    for rows in np.split(np.arange(len(stamps)), cuts):
        good = rows[present[rows]]
        if good.size and (good.size >= _SHORTEST or cuts.size == 0):
            kept.append(good)
        else:
            lost += rows.size
    if cuts.size:
        notes.append(
            f"gaps: split into {len(kept)} pieces of {', '.join(str(rows.size) for rows in kept[:8])}"
            f"{' ...' if len(kept) > 8 else ''} samples; {lost} of {len(stamps)} rows dropped "
            f"(empty, or in pieces shorter than {_SHORTEST})"
        )
    if not kept:
        raise InputError(
            "only fragments between the gaps",
            expected=f"at least one piece of {_SHORTEST} samples",
            got=f"{len(stamps)} rows with {cuts.size} cuts",
            remedy="declare [resample] instead, or record anew",
        )
    return [_uniform(stamps[rows], values[rows], _renamed(where, rows), dt, notes) for rows in kept], notes


def _renamed(where: Callable[[int], str], rows: npt.NDArray[np.int64]) -> Callable[[int], str]:
    """Return what names rows that were chosen from others."""
    return lambda row: where(int(rows[row]))


def _without_duplicates(
    time: FloatArray, values: FloatArray, rules: TimeRules, notes: list[str]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Return the rows with time stamps of their own, as declared, and which rows of the file they are."""
    rows = np.arange(len(time))
    if rules.duplicates == "refuse" or len(time) < 2:
        return time, values, rows
    first = np.concatenate(([True], np.diff(time) != 0.0))
    if first.all():
        return time, values, rows
    groups = np.cumsum(first) - 1
    count = int(groups[-1]) + 1
    last = np.concatenate((first[1:], [True]))
    kept = last if rules.duplicates == "last" else first
    chosen = values[kept]
    if rules.duplicates == "mean":
        chosen = np.column_stack([np.bincount(groups, column) for column in values.T]) / np.bincount(groups)[:, None]
    notes.append(f"{len(time) - count} rows repeat the time stamp of the row before: the {rules.duplicates} counts")
    return time[kept], chosen, rows[kept]


def _check_time(time: FloatArray, where: Callable[[int], str]) -> None:
    """Refuse time stamps that are missing or do not increase."""
    if not np.isfinite(time).all():
        row = int(np.argmax(~np.isfinite(time)))
        raise InputError(
            "no time stamp",
            expected="a time in every row",
            got=f"{time[row]} in {where(row)}",
            remedy="cut the run with rows = [start, stop]",
            place=where(row),
        )
    back = np.diff(time) <= 0
    if back.any():
        row = int(np.argmax(back)) + 1
        stands = time[row] == time[row - 1]
        raise InputError(
            "time stands still" if stands else "time runs back",
            expected=f"more than {time[row - 1]:g} s in {where(row)}",
            got=f"{time[row]:g} s",
            remedy='declare duplicates = "first", "last" or "mean" in a dataset.toml'
            if stands
            else 'sort or cut the rows first; neither [resample] nor gaps = "split" mends this',
            place=where(row),
        )


def _agreed(time: FloatArray, rules: TimeRules, common: float | None) -> float:
    """Return the sample time of a time column, which must agree with the declared one and that of other runs."""
    measured = sample_time_of(time)
    for wanted, who, place in ((rules.sample_time, "sample_time", "sample_time"), (common, "the runs before", None)):
        if wanted is None or rules.resample is not None:
            continue
        ratio = measured / wanted
        if abs(ratio - 1.0) * len(time) <= 0.1 or abs(ratio - 1.0) <= 1e-4:
            return wanted
        if abs(ratio - 1.0) <= 1e-3:
            return wanted
        factor = next((f for f in (1000.0, 1e-3, 1e6, 1e-6) if abs(ratio / f - 1.0) < 0.05), None)
        hint = f" (a factor of {factor:g}: is the time column in another unit?)" if factor is not None else ""
        raise InputError(
            f"the time column disagrees with {who}",
            expected=f"steps of {wanted:g} s",
            got=f"steps of {measured:g} s{hint}",
            remedy="correct sample_time or the unit of [time]"
            if place
            else "declare [resample] with one sample_time, or put the runs into data sets of their own",
            place=place,
        )
    return measured


def _uniform(time: FloatArray, values: FloatArray, where: Callable[[int], str], dt: float, notes: list[str]) -> Piece:
    """Return a piece whose time stamps lie on a grid, near enough."""
    n = len(time)
    own = (time[-1] - time[0]) / (n - 1) if n > 1 else dt
    deviation = np.abs(time - (time[0] + np.arange(n) * own)) / dt
    jitter = float(deviation.max())
    if jitter > JITTER_ACCEPTED:
        k = int(np.argmax(deviation))
        raise InputError(
            "time is not uniform (clock jitter)",
            expected=f"{time[0] + k * own:.9g} s in {where(k)}, within {JITTER_ACCEPTED:.0%} of {dt:g} s",
            got=f"{time[k]:.9g} s ({jitter:.0%} of a sample time off)",
            remedy="declare [resample] in a dataset.toml",
            place=where(k),
        )
    if jitter > JITTER_UNNOTICED:
        notes.append(f"clock jitter up to {jitter:.2%} of the sample time: taken as uniform")
    drift = abs(own / dt - 1.0) * n
    if drift > 0.1:
        notes.append(f"the clock runs {own / dt - 1.0:+.1e} off: {drift:.2g} samples over the record, taken as uniform")
    return Piece(float(time[0]), values, dt)


def _resampled(
    time: FloatArray,
    values: FloatArray,
    present: BoolArray,
    dt: float,
    inputs: tuple[bool, ...],
    rules: TimeRules,
    notes: list[str],
) -> list[Piece]:
    """Return the pieces between long gaps, interpolated onto a uniform grid."""
    assert rules.resample is not None
    section = rules.resample
    new = section.sample_time or rules.sample_time or dt
    longest = section.max_gap or 5 * max(new, dt)
    if not present.any():
        raise InputError("nothing recorded", expected="numbers", got="empty rows only", remedy="check the columns")
    time, values = time[present], values[present]
    steps = np.diff(time)
    holes = steps > longest * (1 + 1e-9)
    if holes.any() and rules.gaps == "refuse":
        k = int(np.argmax(holes))
        raise InputError(
            "a gap too long to interpolate",
            expected=f"at most {longest:g} s (resample.max_gap)",
            got=f"{steps[k]:g} s after t = {time[k]:g} s",
            remedy='declare gaps = "split" as well, or a longer max_gap',
            place="resample.max_gap",
        )
    pieces = []
    for rows in np.split(np.arange(len(time)), np.flatnonzero(holes) + 1):
        if rows.size < _SHORTEST:
            notes.append(f"resample: a piece of {rows.size} rows between gaps dropped")
            continue
        pieces.append(_interpolated(time[rows], values[rows], new, inputs, rules))
    if not pieces:
        raise InputError(
            "only fragments between the gaps",
            expected=f"at least one piece of {_SHORTEST} rows",
            got=f"{len(time)} rows with {int(holes.sum())} gaps",
            remedy="declare a longer resample.max_gap, or record anew",
        )
    count = sum(piece.values.shape[0] for piece in pieces)
    text = (
        f"resampled to {new:g} s ({section.method} outputs, {'held' if rules.intersample == 'zoh' else 'linear'} "
        f"inputs): {len(time)} rows with steps of {steps.min():g} to {steps.max():g} s became {count} samples"
        + (f" in {len(pieces)} pieces" if len(pieces) > 1 else "")
        + (f"; {int((~present).sum())} empty rows bridged" if not present.all() else "")
    )
    if _coarser(steps, new) and section.antialias:
        held = ", inputs by their mean over each hold" if rules.intersample == "zoh" else ""
        text += f"; content above {EDGE * 0.5 / new:g} Hz filtered out without a shift in phase{held}"
    elif _coarser(steps, new):
        text += f"; nothing was filtered: content above {0.5 / new:g} Hz folds back"
    notes.append(text)
    return pieces


def _coarser(steps: FloatArray, new: float) -> bool:
    """Return True if a new sample time is so much longer than the old one that content would fold back."""
    return bool(new > 1.5 * float(np.median(steps)))


def _interpolated(time: FloatArray, values: FloatArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules) -> Piece:
    """Return one piece on a uniform grid: inputs as they are held between samples, outputs by the declared method."""
    assert rules.resample is not None
    n = int(np.floor((time[-1] - time[0]) / dt + 1e-6)) + 1
    grid = time[0] + np.arange(n) * dt
    result = np.empty((n, values.shape[1]))
    # half a nanosecond of slack, so that a stamp rounded up still counts as "at" its instant
    filters = rules.resample.antialias and n > 1 and _coarser(np.diff(time), dt)
    previous = np.clip(np.searchsorted(time, grid + 1e-6 * dt, side="right") - 1, 0, len(time) - 1)
    for column, is_input in enumerate(inputs):
        held = is_input and rules.intersample == "zoh"
        if filters and held:
            result[:, column] = hold_means(time, values[:, column], grid)
        elif filters:
            cubic = rules.resample.method == "cubic" and not is_input
            result[:, column] = filtered(time, values[:, column], grid, cubic=cubic)
        elif held:
            result[:, column] = values[previous, column]
        elif not is_input and rules.resample.method == "cubic":
            from scipy.interpolate import CubicSpline

            result[:, column] = CubicSpline(time, values[:, column])(grid)
        else:
            result[:, column] = np.interp(grid, time, values[:, column])
    return Piece(float(time[0]), result, dt)
