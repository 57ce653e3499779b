"""The time axis of a record: checked for uniformity; split at gaps or resampled where that is declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from harness.data.conditioning.clock import (
    JITTER_ACCEPTED,
    JITTER_UNNOTICED,
    ROUGH,
    TimeRules,
    clock_of_rows,
    first_instant,
    tracked,
)
from harness.data.conditioning.decimation import EDGE, filtered, hold_means
from harness.data.conditioning.repeats import (
    REPEATED,
    complemented,
    refuse_two_in_one,
    without_duplicates,
    without_tail,
)
from harness.errors import InputError
from harness.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]

REGULAR = 0.9
"""Share of steps of one sample from which a record is a clock's with lost rows, and not one of irregular instants."""

FEW_FIRST = 2
"""Rows before a record that may be no readings: factors and offsets, or zeros of a logger that was not ready."""

MOSTLY = 0.5
"""Share of rows in stretches whose clock runs on, from which it begins anew there; shuffled rows have none."""

DENSER = 0.1
"""Part of a step by which readings must be further apart than the samples of a grid for some of these to have none: as
much as a clock wanders."""

SHORTEST = 20
"""Rows of a record: a model of second order in one input has three parameters and two initial values, and an estimate
needs several readings for each unknown (Ljung 1999, sec. 16.4, counts parameters against samples); four here."""

_GRID = "declare [resample], and intersample, in a dataset.toml"
_NO_CLOCK = f"{_GRID}: no one clock explains the stamps"


Where = Callable[[int], str]  # Says where a row stands, by its number.


@dataclass(frozen=True, eq=False)
class RecordPiece:
    """One uninterrupted piece of a record."""

    start: float  # First instant [s]
    values: FloatArray  # (N, m): Signals
    sample_time: float  # [s]
    between: BoolArray | None = None
    """Array of bool (N, m): True for what lies between two readings and was read by nobody."""


class _Run(NamedTuple):
    """What stays while the rows of a run are sorted: its signals, what is declared, and what was noticed."""

    names: tuple[str, ...]
    inputs: tuple[bool, ...]
    rules: TimeRules
    notes: list[str]


def pieces_of(
    time: FloatArray | None,
    values: FloatArray,
    *,
    names: tuple[str, ...],
    inputs: tuple[bool, ...],
    rules: TimeRules,
    common: float | None = None,
    where: Where = "row {}".format,
) -> tuple[list[RecordPiece], list[str]]:
    """Turn the columns of one run into pieces with a uniform time axis.

    Raises InputError if the time is not usable and no declared remedy covers it.

    - ``time`` (N,): time stamps [s]; None where only a sample time is declared
    - ``values`` (N, m): signals; NaN where nothing was recorded
    - ``names``: names of the m signals, for messages
    - ``inputs``: which of them are inputs: resampled as they are held between samples
    - ``rules``: what the data set declares
    - ``common``: sample time [s] of the runs before: all share one
    - ``where``: returns what a person calls a row (from 0), for messages

    - returns ``pieces``
    - returns ``notes``: what was noticed and done, for the warnings of the data set
    """
    notes: list[str] = []
    run = _Run(names, inputs, rules, notes)
    pieces = _pieces_within(run, time, _held_on(run, values), common, where)
    if not pieces:
        raise InputError(
            "only fragments between the gaps",
            expected=f"at least one piece of {SHORTEST} samples",
            got=f"{len(values)} rows, cut where some are lost or hold nothing",
            remedy="record anew, without losing rows",
        )
    return pieces, notes


def _on_change(inputs: tuple[bool, ...], values: FloatArray) -> list[int]:
    """Return the inputs that stand in fewer than half the rows, where all else stands in each: written on a change."""
    there = np.isfinite(values)
    sparse = [k for k, is_input in enumerate(inputs) if is_input and 0 < 2 * there[:, k].sum() < len(values)]
    return sparse if np.delete(there, sparse, axis=1).all() else []


def _held_on(run: _Run, values: FloatArray) -> FloatArray:
    """Return the signals with inputs that are declared held carried on from where they were written."""
    sparse = _on_change(run.inputs, values) if run.rules.intersample == "zoh" else []
    if sparse:
        values = values.copy()
        for k in sparse:
            there = np.isfinite(values[:, k])
            last = np.maximum.accumulate(np.where(there, np.arange(len(values)), -1))
            values[:, k] = np.where(last >= 0, values[last, k], np.nan)
        run.notes.append(f"{', '.join(run.names[k] for k in sparse)}: held from one reading to the next, as declared")
    return values


def _pieces_within(
    run: _Run, time: FloatArray | None, values: FloatArray, common: float | None, where: Where
) -> list[RecordPiece]:
    """Return the pieces of a run, or of a stretch of it; none where gaps leave only fragments."""
    _, inputs, rules, notes = run
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
        blank = ~np.isfinite(time) & ~np.isfinite(values).any(axis=1)
        if blank.any() and not blank.all():
            notes.append(f"{int(blank.sum())} rows hold nothing, not even a time: they are left out")
            where = _renamed(where, np.flatnonzero(~blank))
            time, values = time[~blank], values[~blank]
        _check_finite(time, where)
        end = without_tail(time, values, notes)
        time, values = time[:end], values[:end]
        if rules.gaps == "split" and (stretches := _stretches(time)):
            return _restarted(run, stretches, time, values, common, where)
        time, values, rows = complemented(time, values, notes)
        where = _renamed(where, rows)
        time, values, rows = without_duplicates(time, time, values, rules, notes)
        where = _renamed(where, rows)
        dt, index = clock_of_rows(time, rules, common, notes)
        if index is not None and not (np.diff(index) > 0).all():
            refuse_two_in_one(index, time, dt, rules, where)
            time, values, rows = without_duplicates(index, time, values, rules, notes)
            where, index = _renamed(where, rows), index[rows]
        _check_order(time if index is None else index, time, where)
        stamps = time if index is None else first_instant(time, index, dt) + dt * index.astype(np.float64)
    present: BoolArray = np.asarray(np.isfinite(values).all(axis=1), dtype=np.bool_)
    if rules.resample is not None:
        return _resampled(run, stamps, values, present, dt)
    if not present.all():
        _refuse_empty(run, stamps, values, present, where)
    jumps = _jumps(stamps, dt, inputs, rules, where)
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
    return [_uniform(stamps[rows], values[rows], _renamed(where, rows), dt, notes) for rows in kept]


def _jumps(stamps: FloatArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules, where: Where) -> BoolArray:
    """Return after which rows others are lost.

    Raises InputError if rows are, and gaps are refused.
    """
    steps = np.diff(stamps)
    jumps = np.abs(steps - dt) > 0.5 * dt
    steady = np.abs(steps - dt) < 0.5 * dt
    rough = bool(steady.any() and np.std(steps[steady]) > ROUGH * dt)
    if jumps.any() and (
        (np.diff(tracked(stamps, dt)) == 1).all() or (rough and round((stamps[-1] - stamps[0]) / dt) == len(stamps) - 1)
    ):
        jumps = np.zeros_like(jumps)  # no row is lost: the steps vary, which is said below
    if jumps.any() and rules.gaps == "refuse":
        k = int(np.argmax(jumps))
        raise InputError(
            f"time is not uniform ({int(jumps.sum())} gap{'' if jumps.sum() == 1 else 's'})",
            expected=f"a step of {dt:g} s between rows",
            got=f"{steps[k]:g} s between {where(k)} and {where(k + 1)} (t = {stamps[k]:g} s)",
            remedy=_remedy_of_jumps(stamps, jumps, dt, inputs, rules, rough=rough),
            place=where(k + 1),
        )
    return jumps


def _remedy_of_jumps(
    stamps: FloatArray, jumps: BoolArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules, *, rough: bool
) -> str:
    """Return what may be declared for steps that differ: where a split leaves fragments or no clock, a grid."""
    clock = rough and rules.sample_time is None and _is_clock(stamps, float(f"{dt:.6g}"))
    longest = np.diff(np.flatnonzero(np.concatenate(([True], jumps, [True])))).max()
    if not clock and rough:
        return _NO_CLOCK
    if longest < SHORTEST:
        return f"{_GRID}: between the gaps stand less than {SHORTEST} rows"
    rough_clock = f"sample_time = {dt:.6g} if a clock took the rows and the stamps are rough, with " if clock else ""
    return f"declare {rough_clock}{_remedy(inputs, rules, True)}, or cut the run by rows = [start, stop]"


def _stretches(time: FloatArray) -> list[npt.NDArray[np.int64]]:
    """Return the rows of each stretch in which time runs on, those that are long enough; empty where it never falls."""
    falls = np.flatnonzero(np.diff(time) < 0) + 1
    if not falls.size:
        return []
    return [rows for rows in np.split(np.arange(len(time)), falls) if rows.size >= SHORTEST]


def _restarted(
    run: _Run,
    stretches: list[npt.NDArray[np.int64]],
    time: FloatArray,
    values: FloatArray,
    common: float | None,
    where: Where,
) -> list[RecordPiece]:
    """Return the pieces of a run whose clock begins anew: what stands behind is a record of its own."""
    pieces: list[RecordPiece] = []
    lost = len(time) - sum(rows.size for rows in stretches)
    begins = ", ".join(where(int(rows[0])) for rows in stretches[:6]) + (" ..." if len(stretches) > 6 else "")
    run.notes.append(
        f"gaps: time runs back, so {len(stretches)} stretches, which begin in {begins}, are records of their own"
        + (f"; {lost} of {len(time)} rows dropped (in stretches shorter than {SHORTEST})" if lost else "")
    )
    for rows in stretches:
        near = _renamed(where, rows)
        found = _pieces_within(run, time[rows], values[rows], common, near)
        common = found[0].sample_time if found and common is None else common
        pieces += found
    return pieces


def _refuse_empty(run: _Run, time: FloatArray, values: FloatArray, present: BoolArray, where: Where) -> None:
    """Refuse empty cells that nothing is declared for, by a remedy that helps.

    Raises InputError if a signal holds nothing at all, or rows are empty and neither split nor resampled.
    """
    names, inputs, rules, _ = run
    there = np.isfinite(values)
    void = [name for name, column in zip(names, there.T, strict=True) if not column.any()]
    if void:
        raise InputError(
            f"no number in any of {len(values)} rows of {', '.join(void)}",
            expected="readings",
            got="empty cells",
            remedy="choose another column (sysid list FILE shows what they hold); formulas of a workbook hold numbers "
            "once a spreadsheet has saved them",
            place=f"signal {void[0]}",
        )
    ends = np.flatnonzero(np.diff(np.concatenate(([False], present, [False])).astype(np.int8)))
    fragments = np.diff(ends)[::2].max(initial=0) < SHORTEST
    in_turn = bool(fragments and there.sum(axis=0).min() >= SHORTEST)  # each signal alone is a record
    if rules.resample is not None or (rules.gaps == "split" and not in_turn):
        return
    row, column = (int(i) for i in np.argwhere(~there)[0])
    missing = int((~present).sum())
    remedy = f"cut the run with rows = [start, stop], or declare {_remedy(inputs, rules, inputs[column])}"
    if in_turn:
        slowest = max(float(np.median(np.diff(time[filled]))) for filled in there.T if filled.sum() > 1)
        held = [
            name for name, is_input, filled in zip(names, inputs, there.T, strict=True) if is_input and not filled.all()
        ]
        remedy = (
            f"write a dataset.toml with [resample] sample_time = {slowest:.4g}, or another: signals are filled in turn"
            + (f', and intersample = "zoh" if {held[0]} is held from one reading to the next' if held else "")
        )
    if sparse := _on_change(inputs, values):
        remedy = (
            f'declare intersample = "zoh" in a dataset.toml if {names[sparse[0]]} was written where it changes, '
            "and is held from one reading to the next"
        )
    raise InputError(
        f"nothing recorded in {missing} of {len(present)} rows",
        expected="a number in every row",
        got=f"{values[row, column]} in {where(row)} of {names[column]}",
        remedy=remedy,
        place=f"{where(row)}, signal {names[column]}",
    )


def _renamed(where: Where, rows: npt.NDArray[np.int64]) -> Where:
    """Return what names rows that were chosen from others."""
    return lambda row: where(int(rows[row]))


def _remedy(inputs: tuple[bool, ...], rules: TimeRules, lost: bool) -> str:
    """Return what may be declared for holes: a held input that is not recorded in one cannot be made up."""
    made_up = "" if lost and any(inputs) and rules.intersample in (None, "zoh") else " or [resample]"
    return f'gaps = "split"{made_up} in a dataset.toml (of a bare table: --gaps split)'


def _check_finite(time: FloatArray, where: Where) -> None:
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


def _check_order(keys: npt.NDArray[Any], time: FloatArray, where: Where) -> None:
    """Refuse time stamps (or the samples that they stand for) that do not increase."""
    back = np.diff(keys) <= 0
    if not back.any():
        return
    row = int(np.argmax(back)) + 1
    expected, got = f"more than {time[row - 1]:.9g} s in {where(row)}", f"{time[row]:.9g} s"
    twice = 'declare duplicates = "first", "last" or "mean" in a dataset.toml'
    if keys[row] == keys[row - 1] and time[row] > time[row - 1]:
        what = "two rows in one sample of the declared clock"
        expected, got = "a sample for each row", f"{time[row - 1]:.9g} s and {time[row]:.9g} s"
        remedy = f"correct sample_time, or leave it out and declare [resample]; {twice} if rows were doubled"
    elif keys[row] == keys[row - 1]:
        what = "time stands still"
        if np.mean(np.diff(time) == 0) > REPEATED:
            remedy = (
                "declare sample_time (sysid: --sample-time) if the stamps are coarser than the steps; a file for each "
                "record if rows of several stand in turn; keep the last row of each stamp if a simulation wrote two at "
                "its events"
            )
        else:
            remedy = f"{twice}, or sample_time where the stamps are coarser than the steps"
    else:
        what = "time runs back"
        stretches = _stretches(time)
        remedy = "sort the rows by their time, if it is right"
        if len(stretches) == 1 and 0 < stretches[0][0] <= FEW_FIRST:
            remedy = (
                f"remove what stands before {where(int(stretches[0][0]))} if it is no reading (factors count for the "
                "rows below them)"
            )
        elif sum(map(len, stretches)) > MOSTLY * len(time):
            become = (
                "1 stretch becomes a record" if len(stretches) == 1 else f"{len(stretches)} stretches become records"
            )
            remedy = (
                'declare gaps = "split" in a dataset.toml (of a bare table: --gaps split) if the clock begins anew '
                f"there, and {become}; sort the rows if their times are right"
            )
    raise InputError(what, expected=expected, got=got, remedy=remedy, place=where(row))


def _uniform(time: FloatArray, values: FloatArray, where: Where, dt: float, notes: list[str]) -> RecordPiece:
    """Return a piece whose time stamps lie on a grid, near enough."""
    n = len(time)
    own = (time[-1] - time[0]) / (n - 1) if n > 1 else dt
    deviation = np.abs(time - (time[0] + np.arange(n) * own)) / dt
    jitter = float(deviation.max())
    if jitter > JITTER_ACCEPTED:
        k, clock = int(np.argmax(deviation)), _shortest(own, 2.0 * jitter * dt / (n - 1))
        raise InputError(
            "time is not uniform (clock jitter)",
            expected=f"{time[0] + k * own:.9g} s in {where(k)}, within {JITTER_ACCEPTED:.0%} of {dt:g} s",
            got=f"{time[k]:.9g} s ({jitter:.0%} of a sample time off)",
            remedy=(
                f"declare sample_time = {clock:.9g} if a clock took the rows and the stamps are rough; or [resample], "
                "and intersample, if the stamps are true"
                if _is_clock(time, clock)
                else _NO_CLOCK
            ),
            place=where(k),
        )
    if jitter > JITTER_UNNOTICED:
        notes.append(f"clock jitter up to {jitter:.2%} of the sample time: taken as uniform")
    drift = abs(own / dt - 1.0) * n
    if drift > 0.1:
        notes.append(f"the clock runs {own / dt - 1.0:+.1e} off: {drift:.2g} samples over the record, taken as uniform")
    return RecordPiece(first_instant(time, np.arange(n), dt), values, dt)


def _shortest(value: float, within: float) -> float:
    """Return the number with the fewest digits that is so near.

    Examples
    --------
    >>> _shortest(0.0200034, 1e-5), _shortest(0.0123456, 1e-6)
    (0.02, 0.012346)
    """
    return next((one for digits in range(1, 9) if abs((one := float(f"{value:.{digits}g}")) - value) <= within), value)


def _is_clock(time: FloatArray, dt: float) -> bool:
    """Return True if a clock of a sample time [s] may have taken the rows: if it would be accepted where declared."""
    try:
        _, index = clock_of_rows(time, TimeRules(dt), None, [])
    except InputError:
        return False
    return index is None or bool((np.diff(index) > 0).all())


def _resampled(run: _Run, time: FloatArray, values: FloatArray, present: BoolArray, dt: float) -> list[RecordPiece]:
    """Return the pieces between long gaps, brought onto a uniform grid."""
    _, inputs, rules, notes = run
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
    whole = np.diff(tracked(time, dt))
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


def _interpolated(
    time: FloatArray, values: FloatArray, dt: float, inputs: tuple[bool, ...], rules: TimeRules
) -> RecordPiece:
    """Return one piece on a uniform grid: inputs as they are held between samples, outputs by the declared method."""
    assert rules.resample is not None
    n = int(np.floor((time[-1] - time[0]) / dt + 1e-6)) + 1
    grid = time[0] + np.arange(n) * dt
    result, between = np.empty((n, values.shape[1])), np.zeros((n, values.shape[1]), dtype=np.bool_)
    for column, is_input in enumerate(inputs):
        there = np.isfinite(values[:, column])  # an empty reading of one signal is none of the others'
        own, signal = time[there], values[there, column]
        cubic = rules.resample.method == "cubic" and not is_input
        filters = rules.resample.antialias and n > 1 and len(own) > 1 and _coarser(np.diff(own), dt)
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
    return RecordPiece(float(time[0]), result, dt, between if between.any() else None)


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
