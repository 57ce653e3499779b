"""The time axis of a record: checked for uniformity; split at gaps or resampled where that is declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.data.conditioning.decimation import EDGE, filtered, hold_means
from harness.data.sections import Gaps, ResampleSection
from harness.errors import InputError
from harness.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]

__all__ = [
    "JITTER_ACCEPTED",
    "JITTER_UNNOTICED",
    "SHORTEST",
    "Piece",
    "TimeRules",
    "pieces_of",
    "sample_time_of",
]

JITTER_UNNOTICED = 1e-3
"""Deviation from the grid, in sample times, that recorded time stamps have anyway (rounding)."""

JITTER_ACCEPTED = 2e-2
"""Up to this deviation a record counts as uniform, with a warning; beyond it is refused or resampled."""

ROUNDED = 1.1
"""Spread of rounded stamps about their clock, in units of their resolution: 1, and some for the fitted rate."""

FOLLOWED = 0.05
"""Part of each stamp's deviation by which the phase of a clock follows: clocks drift by 1e-4 at most, and jitter is
averaged over twenty rows."""

REGULAR = 0.9
"""Share of steps of one sample from which a record is a clock's with lost rows, and not one of irregular instants."""

DENSER = 0.1
"""Part of a step by which readings must be further apart than the samples of a grid for some of these to have none: as
much as a clock wanders."""

TWICE = 0.25
"""Part of a step by which the stamps of a row that was logged twice may differ."""

REPEATED = 0.1
"""Share of rows that may repeat a time stamp with other readings: beyond it the stamps are coarser than the steps, and
to keep one row of each would leave instants that nobody knows."""

SHORTEST = 20
"""Rows of a record: a model of second order in one input has three parameters and two initial values, and an estimate
needs several readings for each unknown (Ljung 1999, sec. 16.4, counts parameters against samples); four here."""


@dataclass(frozen=True)
class TimeRules:
    """What the data set declares about time."""

    sample_time: float | None = None
    gaps: Gaps = "refuse"
    resample: ResampleSection | None = None
    intersample: Literal["zoh", "foh", "smooth"] | None = "zoh"
    """None where nothing is declared: held, unless it matters from when on."""
    duplicates: Literal["refuse", "first", "last", "mean"] = "refuse"


@dataclass(frozen=True, eq=False)
class Piece:
    """One uninterrupted piece of a record.

    Attributes
    ----------
    start : float
        First instant [s].
    values : array (N, m)
        Signals.
    sample_time : float
        [s]
    between : array of bool (N, m), optional
        True for what lies between two readings and was read by nobody.
    """

    start: float
    values: FloatArray
    sample_time: float
    between: BoolArray | None = None


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
    return float(f"{steady.mean():.9g}") if steady.size else float(f"{steps.mean():.9g}")


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
        _check_finite(time, where)
        time, values, rows = _without_duplicates(time, time, values, rules, notes)
        where = _renamed(where, rows)
        dt, index = _clock(time, rules, common, notes)
        if index is not None and not (np.diff(index) > 0).all():
            _refuse_two_in_one(index, time, dt, rules, where)
            time, values, rows = _without_duplicates(index, time, values, rules, notes)
            where, index = _renamed(where, rows), index[rows]
        _check_order(time if index is None else index, time, where)
        stamps = time if index is None else time[0] + index * dt
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
            remedy=f"cut the run with rows = [start, stop], or declare {_remedy(inputs, rules, inputs[column])}",
            place=f"{where(row)}, signal {names[column]}",
        )
    steps = np.diff(stamps)
    jumps = np.abs(steps - dt) > 0.5 * dt
    if jumps.any() and (np.diff(_tracked(stamps, dt)) == 1).all():
        jumps = np.zeros_like(jumps)  # no row is lost: the steps vary, which is said below
    if jumps.any() and rules.gaps == "refuse":
        k = int(np.argmax(jumps))
        raise InputError(
            f"time is not uniform ({int(jumps.sum())} gaps)",
            expected=f"a step of {dt:g} s between rows",
            got=f"{steps[k]:g} s between {where(k)} and {where(k + 1)} (t = {stamps[k]:g} s)",
            remedy=f"declare {_remedy(inputs, rules, True)} in a dataset.toml (of a bare table: --gaps split), or cut "
            "the run by rows = [start, stop]",
            place=where(k + 1),
        )
    cuts = np.flatnonzero(~present[:-1] | ~present[1:] | jumps) + 1
    kept, lost = [], 0
    for rows in np.split(np.arange(len(stamps)), cuts):
        good = rows[present[rows]]
        if good.size and (good.size >= SHORTEST or cuts.size == 0):
            kept.append(good)
        else:
            lost += rows.size
    if cuts.size:
        notes.append(
            f"gaps: split into {len(kept)} pieces of {', '.join(str(rows.size) for rows in kept[:8])}"
            f"{' ...' if len(kept) > 8 else ''} samples; {lost} of {len(stamps)} rows dropped "
            f"(empty, or in pieces shorter than {SHORTEST})"
        )
    if not kept:
        raise InputError(
            "only fragments between the gaps",
            expected=f"at least one piece of {SHORTEST} samples",
            got=f"{len(stamps)} rows with {cuts.size} cuts",
            remedy="record anew, without losing rows",
        )
    return [_uniform(stamps[rows], values[rows], _renamed(where, rows), dt, notes) for rows in kept], notes


def _renamed(where: Callable[[int], str], rows: npt.NDArray[np.int64]) -> Callable[[int], str]:
    """Return what names rows that were chosen from others."""
    return lambda row: where(int(rows[row]))


def _remedy(inputs: tuple[bool, ...], rules: TimeRules, lost: bool) -> str:
    """Return what may be declared for holes: a held input that is not recorded in one cannot be made up."""
    return (
        'gaps = "split"'
        if lost and any(inputs) and rules.intersample in (None, "zoh")
        else 'gaps = "split" or [resample]'
    )


def _without_duplicates(
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


def _refuse_two_in_one(
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


def _check_finite(time: FloatArray, where: Callable[[int], str]) -> None:
    """Refuse time stamps that are missing."""
    if not np.isfinite(time).all():
        row = int(np.argmax(~np.isfinite(time)))
        raise InputError(
            "no time stamp",
            expected="a time in every row",
            got=f"{time[row]} in {where(row)}",
            remedy="cut the run with rows = [start, stop]",
            place=where(row),
        )


def _check_order(keys: npt.NDArray[Any], time: FloatArray, where: Callable[[int], str]) -> None:
    """Refuse time stamps (or the samples that they stand for) that do not increase."""
    back = np.diff(keys) <= 0
    if back.any():
        row = int(np.argmax(back)) + 1
        stands = keys[row] == keys[row - 1]
        raise InputError(
            "time stands still" if stands else "time runs back",
            expected=f"more than {time[row - 1]:g} s in {where(row)}",
            got=f"{time[row]:g} s",
            remedy='declare duplicates = "first", "last" or "mean" in a dataset.toml'
            + (", or sample_time where the stamps are coarser than the steps" if time[row] == time[row - 1] else "")
            if stands
            else 'sort or cut the rows first; neither [resample] nor gaps = "split" mends this',
            place=where(row),
        )


def _clock(
    time: FloatArray, rules: TimeRules, common: float | None, notes: list[str]
) -> tuple[float, npt.NDArray[np.int64] | None]:
    """Return the sample time [s], and the sample that each row is where a clock explains rough stamps; else None.

    A declared sample time says that a clock took the rows, whatever was stamped on them. Without one, stamps that are
    all within their own resolution of a uniform clock are that clock's, rounded.
    """
    if len(time) < 2:
        return rules.sample_time or common or 1.0, None
    wanted = None if rules.resample is not None else rules.sample_time
    if (np.diff(time) < 0).any() or not np.ptp(time):
        return wanted or common or 1.0, None  # refused by its order
    if wanted is None:
        return _rounded(time, rules, common, notes)
    n, coarse = len(time), max(_resolution(time), _tick(time))
    own = float((time[-1] - time[0]) / (n - 1))
    if np.ptp(time - time[0] - np.arange(n) * own) <= 2 * JITTER_ACCEPTED * wanted and own > 0.5 * wanted:
        return _agreed(own, n, rules, common), None
    if coarse > wanted:
        if np.ptp(time - time[0] - np.arange(n) * wanted) > coarse + 0.5 * wanted:
            raise InputError(
                f"time stamps of {coarse:g} s that {n} samples of the declared {wanted:g} s do not explain",
                expected=f"{(n - 1) * wanted:g} s from the first to the last row, within {coarse:g} s all along",
                got=f"{time[-1] - time[0]:g} s: rows were lost or doubled, or sample_time is another",
                remedy="correct sample_time, or record finer time stamps",
                place="sample_time",
            )
        notes.append(
            f"the time stamps are multiples of {coarse:g} s, coarser than the declared sample time of {wanted:g} s: "
            "rows are taken as its samples one by one, and few lost ones would not show"
        )
        return wanted, np.arange(n)
    index = _tracked(time, wanted)
    for measured in (sample_time_of(time), float((time[-1] - time[0]) / max(index[-1], 1))):
        _agreed(measured, n, rules, common, slack=1 / n)  # rough stamps at both ends, half a sample each
    if index[-1] > 2:
        slope, offset = np.polyfit(index, time - time[0], 1)
        rough = float(np.ptp(time - time[0] - offset - slope * index)) / wanted
        _agreed(float(slope), n, rules, common, slack=2 * min(rough, 0.5) / n)  # a line sees the clock more sharply
    off = float(np.abs(np.diff(time) / wanted - np.diff(index)).max())
    notes.append(
        f"the steps of the time stamps are up to {100 * off:.2g} % of a sample off: rows are samples of the declared "
        f"clock of {wanted:g} s"
    )
    return wanted, index


def _rounded(
    time: FloatArray, rules: TimeRules, common: float | None, notes: list[str]
) -> tuple[float, npt.NDArray[np.int64] | None]:
    """Return the sample time [s] of undeclared stamps, and their samples where they are a clock's, rounded."""
    if not (np.diff(time) > 0).all():
        return common or 1.0, None  # refused by its order
    steps, resolution = np.diff(time), _resolution(time)
    for typical in (sample_time_of(time), float(steps.mean())):  # where half of the steps are rounded up, their mean
        index = np.concatenate(([0], np.cumsum(np.round(steps / typical)))).astype(np.int64)
        steady = index[-1] > 2 and (np.diff(index) > 0).all()
        if not steady or not 2 * JITTER_UNNOTICED * typical < resolution <= 0.5 * typical:
            continue
        slope, offset = np.polyfit(index, time - time[0], 1)
        left = np.ptp(time - time[0] - offset - slope * index)
        if 2 * JITTER_UNNOTICED * typical < left <= ROUNDED * resolution:
            dt = _agreed(float(f"{slope:.9g}"), len(time), rules, common)
            notes.append(f"the time stamps are rounded to {resolution:g} s: a clock of {dt:g} s explains them all")
            return dt, index
    return _agreed(sample_time_of(time), len(time), rules, common), None


def _resolution(time: FloatArray) -> float:
    """Return the largest power of ten [s] of which all stamps are multiples; 0 where none from a second to 1 ns is.

    Examples
    --------
    >>> _resolution(np.array([0.0, 0.008, 0.017])), _resolution(np.array([0.0, 1 / 3]))
    (0.001, 0.0)
    """
    for digits in range(10):
        scaled = time * 10.0**digits
        if (np.abs(scaled - np.round(scaled)) <= 1e-6 + 4e-16 * np.abs(scaled)).all():
            return float(10.0**-digits)
    return 0.0


def _tick(time: FloatArray) -> float:
    """Return the step [s] of which all steps are multiples, where some stamps repeat; 0 else: 5 ms, a 64th of a second.

    Examples
    --------
    >>> _tick(np.array([0.0, 0.005, 0.005, 0.015])), _tick(np.array([0.0, 0.01, 0.03]))
    (0.005, 0.0)
    """
    steps = np.diff(time)
    moved = steps[steps > 0]
    if not moved.size or moved.size == steps.size:
        return 0.0
    tick = float(moved.min())
    return tick if (np.abs(moved / tick - np.round(moved / tick)) < 1e-3).all() else 0.0


def _tracked(time: FloatArray, dt: float) -> npt.NDArray[np.int64]:
    """Return which sample of a clock each row is: the nearest one, the clock's phase following the stamps slowly.

    Examples
    --------
    >>> _tracked(np.array([0.0, 0.08, 0.21, 0.3, 0.52]), 0.1).tolist()
    [0, 1, 2, 3, 5]
    """
    index = np.zeros(len(time), dtype=np.int64)
    edge, at = float(time[0]), 0
    for row, stamp in enumerate(time.tolist()[1:], start=1):
        steps = round((stamp - edge) / dt)
        edge += steps * dt
        edge += FOLLOWED * (stamp - edge)
        at += steps
        index[row] = at
    return index


def _agreed(measured: float, n: int, rules: TimeRules, common: float | None, *, slack: float = 0.0) -> float:
    """Return the sample time of a time column, which must agree with the declared one and that of other runs."""
    for wanted, who, place in ((rules.sample_time, "sample_time", "sample_time"), (common, "the runs before", None)):
        if wanted is None or rules.resample is not None:
            continue
        ratio = measured / wanted
        if abs(ratio - 1.0) <= max(1e-3, 0.1 / n, slack):
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
            remedy=f"declare sample_time = {dt:.6g} if a clock took the rows and the stamps are rough; or [resample], "
            "and intersample, if the stamps are true",
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
    """Return the pieces between long gaps, brought onto a uniform grid."""
    assert rules.resample is not None
    section = rules.resample
    new = section.sample_time or rules.sample_time or dt
    longest = section.max_gap or 5 * max(new, dt)
    if not present.any():
        raise InputError("nothing recorded", expected="numbers", got="empty rows only", remedy="check the columns")
    steps = np.diff(time[present])
    cuts = [*_held_gaps(time, values, dt, inputs, rules), *_long_gaps(time[present], steps, longest, rules)]
    pieces = []
    parts = np.split(np.arange(len(time)), np.unique(np.searchsorted(time, cuts)) if cuts else [])
    for rows in parts:
        kept = rows[present[rows]]
        if kept.size < SHORTEST:
            notes.append(f"resample: a piece of {kept.size} rows between gaps dropped")
            continue
        whole = rows[(rows >= kept[0]) & (rows <= kept[-1])]
        pieces.append(_interpolated(time[whole], values[whole], new, inputs, rules))
    if not pieces:
        raise InputError(
            "only fragments between the gaps",
            expected=f"at least one piece of {SHORTEST} rows",
            got=f"{int(present.sum())} rows with {len(parts) - 1} gaps",
            remedy="declare a longer resample.max_gap, or record anew",
        )
    count = sum(piece.values.shape[0] for piece in pieces)
    made = sum(0 if piece.between is None else int(piece.between.any(axis=1).sum()) for piece in pieces)
    text = (
        f"resampled to {new:g} s ({section.method} outputs, {'held' if _held(rules) else 'linear'} "
        f"inputs): {int(present.sum())} rows with steps of {steps.min():g} to {steps.max():g} s became {count} samples"
        + (f" in {len(pieces)} pieces" if len(pieces) > 1 else "")
        + (f"; {int((~present).sum())} empty rows bridged" if not present.all() else "")
    )
    if _coarser(steps, new) and section.antialias:
        held = ", inputs by their mean over each hold" if _held(rules) else ""
        text += f"; content above {EDGE * 0.5 / new:g} Hz filtered out without a shift in phase{held}"
    elif _coarser(steps, new):
        text += f"; nothing was filtered: content above {0.5 / new:g} Hz folds back"
    if made:
        text += f"; {made} samples lie between readings of an output, which count as missing there (a grid of "
        text += f"{float(np.median(steps)):.4g} s has as many samples as there are readings)"
    notes.append(text)
    return pieces


def _held(rules: TimeRules) -> bool:
    """Return True if inputs are held between samples."""
    return rules.intersample in (None, "zoh")


def _long_gaps(time: FloatArray, steps: FloatArray, longest: float, rules: TimeRules) -> FloatArray:
    """Return the instants behind gaps that are too long to be bridged, or refuse them."""
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
    return time[1:][holes]


def _held_gaps(
    time: FloatArray, values: FloatArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules
) -> FloatArray:
    """Return the instants behind holes in which a held input changed at an instant that nobody recorded, or refuse.

    Rows of a clock tell what the input was in each sample, and a lost one takes that along. Where instants are
    irregular every row says from when on its input is held, if that is what is meant: then it must be declared.
    """
    if not any(inputs) or not _held(rules):
        return np.zeros(0)
    table = values[:, np.array(inputs)]
    known = np.isfinite(table).all(axis=1)
    time, table = time[known], table[known]
    steps = np.diff(time) / dt
    whole = np.diff(_tracked(time, dt))
    regular = bool(np.mean(whole == 1) >= REGULAR)
    rough = float(np.abs(steps - whole).max()) if regular else np.inf
    if rough > JITTER_ACCEPTED and rules.intersample is None:
        raise InputError(
            "held inputs whose time stamps are no clock's",
            expected="what an input does between its stamps",
            got=f"steps of {float(np.diff(time).min()):.4g} to {float(np.diff(time).max()):.4g} s, and no intersample",
            remedy='declare intersample = "zoh" if each row sets the input from its own stamp on, "foh" if a row is a '
            f"reading of it; or sample_time = {dt:.6g} without [resample] if a clock took the rows",
            place="intersample",
        )
    if not regular:
        return np.zeros(0)
    holes = (whole > 1) & (np.diff(table, axis=0) != 0).any(axis=1)
    if holes.any() and rules.gaps == "refuse":
        k = int(np.argmax(holes))
        raise InputError(
            f"a held input changes in {int(holes.sum())} holes",
            expected="its value in every sample",
            got=f"{int(whole[k]) - 1} lost after t = {time[k]:g} s",
            remedy='declare gaps = "split", with or without [resample], or intersample = "foh" if it moves in straight '
            "lines between samples",
            place="resample",
        )
    behind: FloatArray = time[1:][holes]
    return behind


def _coarser(steps: FloatArray, new: float) -> bool:
    """Return True if a new sample time is so much longer than the old one that content would fold back."""
    return bool(new > 1.5 * float(np.median(steps)))


def _interpolated(time: FloatArray, values: FloatArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules) -> Piece:
    """Return one piece on a uniform grid: inputs as they are held between samples, outputs by the declared method."""
    assert rules.resample is not None
    n = int(np.floor((time[-1] - time[0]) / dt + 1e-6)) + 1
    grid = time[0] + np.arange(n) * dt
    result, between = np.empty((n, values.shape[1])), np.zeros((n, values.shape[1]), dtype=np.bool_)
    filters = rules.resample.antialias and n > 1 and _coarser(np.diff(time), dt)
    for column, is_input in enumerate(inputs):
        there = np.isfinite(values[:, column])  # an empty reading of one signal is none of the others'
        own, signal = time[there], values[there, column]
        cubic = rules.resample.method == "cubic" and not is_input
        between[:, column] = False if is_input else _between(own, grid)
        if is_input and _held(rules) and len(own) == n and np.abs(own - grid).max() <= 1e-6 * dt:
            result[:, column] = signal
        elif is_input and _held(rules) and rules.resample.antialias:
            result[:, column] = hold_means(own, signal, grid)
        elif is_input and _held(rules):
            # the slack lets a stamp rounded up still count as "at" its instant
            result[:, column] = signal[np.clip(np.searchsorted(own, grid + 1e-6 * dt, side="right") - 1, 0, None)]
        elif filters:
            result[:, column] = filtered(own, signal, grid, cubic=cubic)
        elif cubic:
            from scipy.interpolate import CubicSpline

            result[:, column] = CubicSpline(own, signal)(grid)
        else:
            result[:, column] = np.interp(grid, own, signal)
    return Piece(float(time[0]), result, dt, between if between.any() else None)


def _between(time: FloatArray, grid: FloatArray) -> BoolArray:
    """Return which instants of a grid lie between two readings, while others are nearer to both of these.

    A reading counts once, at the instant that is nearest to it, however dense the grid is: values made between two
    readings tell nothing new, and their noise is not that of a reading. Where a clock is rough, every sample has its
    reading, a little beside it.

    Examples
    --------
    >>> _between(np.array([0.0, 0.4, 0.8]), np.arange(5) * 0.2).tolist()
    [False, True, False, True, False]
    >>> _between(np.array([0.0, 0.23, 0.38, 0.6]), np.arange(4) * 0.2).tolist()
    [False, False, False, False]
    """
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    nearest = right - (grid - time[right - 1] < time[right] - grid)
    found = np.abs(time[nearest] - grid)
    first = np.full(len(time), np.inf)
    np.minimum.at(first, nearest, found)
    step = grid[1] - grid[0] if len(grid) > 1 else np.inf
    wide = (time[right] - time[right - 1]) > (1 + DENSER) * step
    return np.asarray(wide & (found > first[nearest]), dtype=np.bool_)
