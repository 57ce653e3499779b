"""Signals that have clocks of their own, put on one grid by a declared rule."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.data.conditioning.clock import TimeRules
from harness.data.conditioning.decimation import filtered, hold_means
from harness.data.sections import ResampleSection
from harness.errors import InputError
from harness.signals import FloatArray


def merged(
    clocks: Sequence[FloatArray],
    signals: Sequence[FloatArray],
    *,
    names: Sequence[str],
    inputs: Sequence[bool],
    rules: TimeRules,
    notes: list[str],
) -> tuple[FloatArray, FloatArray]:
    """Return the common grid (N,) and the signals on it (N, m): NaN where a sensor was silent too long.

    A command is held from its stamp until the next one, its mean over each sample counting; a reading is interpolated
    as ``[resample]`` says, and filtered before where the grid is coarser. The grid begins with the last signal to begin
    and ends with the first to end; a command holds on to the end.

    Raises InputError if no grid is declared, stamps run back, or the signals do not overlap.

    - ``clocks, signals`` sequence of array: stamps [s] from one origin, and values, of each signal
    - ``inputs``: which signals are commands
    - ``rules``: with the sample time of ``resample``, or of the record
    - ``notes``: what was done is added
    """
    rates = {name: _step(clock) for name, clock in zip(names, clocks, strict=True)}
    shown = ", ".join(f"{name} every {step:.4g} s" for name, step in list(rates.items())[:8])
    section = rules.resample or ResampleSection()
    dt = section.sample_time or rules.sample_time
    if dt is None:
        raise InputError(
            "signals with clocks of their own",
            expected="[resample] with sample_time, the grid on which they are put together",
            got=shown,
            remedy=f"declare [resample] sample_time = {max(rates.values()):.4g} or another (sysid: --sample-time): "
            'inputs are held from their stamps on, outputs interpolated (method = "linear" or "cubic")',
            place="resample",
        )
    for name, clock in zip(names, clocks, strict=True):
        if (np.diff(clock) <= 0).any():
            row = int(np.argmax(np.diff(clock) <= 0)) + 1
            raise InputError(
                f"the stamps of {name} do not increase",
                expected=f"more than {clock[row - 1]:.9g} s in its message {row}",
                got=f"{clock[row]:.9g} s",
                remedy="sort the messages, or record them by one node",
                place=name,
            )
    begin, n = grid_of(clocks, inputs, dt)
    if n < 2:
        raise InputError(
            "signals that do not overlap in time",
            expected="one stretch in which all are recorded",
            got=f"the last begins at {begin:.6g} s, the first ends at {begin + (n - 1) * dt:.6g} s",
            remedy="choose other topics, or a bag that holds them together",
        )
    grid: FloatArray = begin + np.arange(n, dtype=np.float64) * dt
    table = np.empty((n, len(signals)))
    for column, (clock, values) in enumerate(zip(clocks, signals, strict=True)):
        if inputs[column] and rules.intersample in (None, "zoh"):
            ends = np.append(clock, max(clock[-1], grid[-1] + dt))
            table[:, column] = hold_means(ends, np.append(values, values[-1]), grid)
            continue
        table[:, column] = _reading(
            clock, values, grid, dt, cubic=section.method == "cubic", antialias=section.antialias
        )
        silent = np.diff(clock) > (section.max_gap or 5 * max(dt, rates[names[column]])) * (1 + 1e-9)
        for k in np.flatnonzero(silent):
            table[(grid > clock[k] + 1e-9) & (grid < clock[k + 1] - 1e-9), column] = np.nan
    held = [name for name, is_input in zip(names, inputs, strict=True) if is_input]
    read = [name for name, is_input in zip(names, inputs, strict=True) if not is_input]
    notes.append(
        f"put on one grid of {dt:g} s, {n} samples from {begin:.6g} s: {', '.join(held) or 'no input'} held from the "
        f"stamps on, {', '.join(read)} interpolated ({section.method}); their own clocks: {shown}"
    )
    return grid, table


def grid_of(clocks: Sequence[FloatArray], inputs: Sequence[bool], dt: float) -> tuple[float, int]:
    """Return the first instant [s] and the number of samples of the grid that signals of several clocks share.

    Examples
    --------
    >>> grid_of([np.array([0.0, 0.5, 1.0]), np.array([0.2, 0.6, 1.4])], [True, False], 0.4)
    (0.2, 4)
    """
    begin = max(clock[0] for clock in clocks)
    sensors = [clock[-1] for clock, is_input in zip(clocks, inputs, strict=True) if not is_input]
    end = min(sensors) if sensors else min(clock[-1] for clock in clocks)
    return float(begin), int(np.floor((end - begin) / dt + 1e-6)) + 1


def one_clock(clocks: Sequence[FloatArray]) -> bool:
    """Return True if all stamps are the same.

    Examples
    --------
    >>> one_clock([np.arange(3.0), np.arange(3.0)]), one_clock([np.arange(3.0), np.arange(4.0)])
    (True, False)
    """
    return all(np.array_equal(clock, clocks[0]) for clock in clocks)


def in_turn(time: FloatArray, values: FloatArray) -> tuple[list[FloatArray], list[FloatArray]] | None:
    """Return the stamps and the readings of each signal where no row holds them all; None elsewhere."""
    there = np.isfinite(values)
    if not np.isfinite(time).all() or there.all(axis=1).any() or not there.any(axis=0).all():
        return None
    return [time[filled] for filled in there.T], [
        column[filled] for column, filled in zip(values.T, there.T, strict=True)
    ]


def _step(clock: FloatArray) -> float:
    """Return the usual step of a clock."""
    return float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0


def _reading(
    clock: FloatArray, values: FloatArray, grid: FloatArray, dt: float, *, cubic: bool, antialias: bool
) -> FloatArray:
    """Return a sensor's readings on a grid."""
    if antialias and len(grid) > 1 and dt > 1.5 * _step(clock):
        return filtered(clock, values, grid, cubic=cubic)
    if cubic:
        from scipy.interpolate import CubicSpline

        result: FloatArray = CubicSpline(clock, values)(grid)
        return result
    return np.interp(grid, clock, values)
