"""What looks wrong in a record: refused where it cannot be meant, said in words where it may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from harness.data.conditioning.suspicion import swapped_in_and_out, swapped_runs, units_between_runs
from harness.data.conditioning.timebase import SHORTEST
from harness.data.recipe.ports import Ports, rate_unit
from harness.data.recipe.si import SI_UNITS
from harness.errors import InputError
from harness.signals import Channel, FloatArray, Run, Trajectory
from harness.units import own_record, told

_FACTORS = (
    (180.0 / np.pi, "one is in degrees and the other in radians"),
    (np.pi / 180.0, "one is in degrees and the other in radians"),
    (1000.0, "a unit is wrong by 1000"),
    (1e-3, "a unit is wrong by 1000"),
    (60.0 / (2 * np.pi), "the rate is in rpm"),
    (2 * np.pi / 60.0, "the rate is in rpm"),
    (2 * np.pi, "the rate is in turns per second"),
    (0.5 / np.pi, "the rate is in turns per second"),
    (60.0, "the rate is per minute"),
    (1.0 / 60.0, "the rate is per minute"),
    (-1.0, "one has the wrong sign"),
)

COUNTED = 255.0
"""Span of whole numbers in an SI unit from which they are said to look like a converter's: all that 8 bits tell apart.
What people measure in these units they seldom round to ones."""


def check_run(
    trajectory: Trajectory,
    measured: Sequence[tuple[str, int]],
    *,
    recorded: Mapping[str, str] | None = None,
    inverse_dynamics: bool = False,
    fitted: bool = True,
    whole: bool = True,
    of: int | None = None,
) -> list[str]:
    """Return the warnings about one run, and refuse one that cannot be used.

    Raises InputError if the run has one sample, no output ever moves, or a measured rate contradicts its position.

    - ``trajectory``: any length
    - ``measured`` sequence of (port, derivative): what each output is; ``theta_rate`` in rad/s beside ``theta`` in rad
      is its derivative
    - ``recorded``: unit by channel in which the data came: warnings tell values in it
    - ``inverse_dynamics``: the model gives the inputs of a motion (an arm): where a controller holds the motion, the
      torque follows it
    - ``fitted``: False where no model is learned from the run: then it may be short, and rest
    - ``whole``: False for one of several pieces of a record, which the longest of them speaks for: in a short one
      chance may make an input follow an output
    - ``of``: rows of the table whose last third was set aside without being asked for
    """
    notes: list[str] = []
    recorded = recorded or {}
    spec, own = trajectory.spec, own_record(trajectory, recorded)
    if fitted and len(trajectory) < SHORTEST:
        rows, least = (len(trajectory), SHORTEST) if of is None else (of, 3 * SHORTEST - 2)
        raise InputError(
            f"a record of {rows} row{'s' if rows > 1 else ''}",
            expected=f"at least {least} rows{', of which the last third validates' * (of is not None)}: the smallest "
            "model has five unknowns (three parameters, two initial values), and four readings for each leave "
            "something to judge it by",
            got=str(rows),
            remedy="record longer, or check rows, discard and the export"
            if of is None
            else f"record longer, or give data that validate (--run validation=FILE): {SHORTEST} rows of either",
        )
    for values, channels in ((trajectory.u, spec.inputs), (trajectory.y, spec.outputs)):
        for column, channel in enumerate(channels):
            if channel.kind == "category":
                _refuse_other_categories(channel, values[:, column])
    still = [not np.ptp(trajectory.y[:, i]) for i in range(spec.ny)]
    if fitted and all(still):
        idle = bool(spec.nu) and not np.ptp(trajectory.u, axis=0).any()
        raise InputError(
            "the input and the outputs never move" if idle else "the outputs never move",
            expected="outputs that change",
            got=", ".join(f"{c.name} = {v:g} {c.unit}" for c, v in zip(own.spec.outputs, own.y[0], strict=True))
            + f" in all {len(trajectory)} samples",
            remedy="check the columns, the sensor and whether anything was switched on",
        )
    for i, channel in enumerate(spec.outputs):
        if still[i]:
            notes.append(f"output {channel.name} never moves ({own.y[0, i]:g} {own.spec.outputs[i].unit})")
        elif channel.kind != "category":
            notes += _out_of_range(channel, trajectory.y[:, i], recorded) + _raw(channel, trajectory.y[:, i])
    for i, channel in enumerate(spec.inputs):
        if not np.ptp(trajectory.u[:, i]):
            constant = f"{own.u[0, i]:g} {own.spec.inputs[i].unit}"
            notes.append(f"input {channel.name} is constant ({constant}): it excites nothing")
        notes += _out_of_range(channel, trajectory.u[:, i], recorded) + _raw(channel, trajectory.u[:, i])
    said, sure = _rates(trajectory, measured)
    notes += said
    for i, channel in enumerate(spec.outputs):
        _refuse_whirling(channel, trajectory.y[:, i])
    return notes if inverse_dynamics or not whole else notes + swapped_in_and_out(trajectory, besides=sure)


def _refuse_other_categories(channel: Channel, values: FloatArray) -> None:
    """Refuse numbers that are no categories of a channel."""
    wrong = (values != np.round(values)) | (values < 0) | (values > channel.maximum)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"category of {channel.name}",
            expected=f"an integer in 0 .. {channel.maximum:g}",
            got=f"{values[row]:g} in row {row} of the run",
            remedy="number the categories from 0 on, and give their number in categories",
        )


def check_runs(runs: Sequence[Run], records: Sequence[int] = ()) -> list[str]:
    """Return the warnings about runs beside each other, and refuse data that are used twice.

    Raises InputError if a validation or test run repeats data that another use already holds.

    - ``records``: of which record each run is a piece; by default each is one
    """
    seen: dict[bytes, tuple[int, Run]] = {}
    for number, run in enumerate(runs):
        key = run.trajectory.u.tobytes() + run.trajectory.y.tobytes()
        if key in seen and seen[key][1].use != run.use:
            first, other = seen[key]
            raise InputError(
                f"the {run.use} data are the {other.use} data",
                expected="data of another experiment, or other rows",
                got=f"runs {first} and {number} are equal, sample by sample",
                remedy="record a second run, or divide this one with rows = [start, stop]",
                place=f"runs[{number}]",
            )
        seen.setdefault(key, (number, run))
    return [*units_between_runs(runs, records), *swapped_runs(runs, records)]


def _refuse_whirling(channel: Channel, values: FloatArray) -> None:
    """Refuse an angle that moves by more than a turn from sample to sample: no record of a rotation can mean that."""
    if channel.unit != "rad" or len(values) < 50:
        return
    steps = np.abs(np.diff(values))
    far = steps > 1.1 * 2 * np.pi
    if np.mean(far) > 0.05:
        possible = [
            f"{unit} (steps up to {steps.max() * factor:.2g} rad then)"
            for unit, factor in (("deg", np.pi / 180), ("mrad", 1e-3))
            if np.mean(steps * factor > np.pi) <= 0.05
        ]
        units = (
            f"declare the unit that the readings have, perhaps {' or '.join(possible)}: unit in dataset.toml, or in "
            "brackets in the title of a file without one; or "
            if possible
            else ""
        )
        raise InputError(
            f"output {channel.name} moves by more than a turn between samples",
            expected="an angle in rad, sampled several times a turn",
            got=f"steps up to {float(steps.max()):.3g} rad, beyond a turn in {np.mean(far):.0%} of the samples",
            remedy=f"{units}correct the scale of {channel.name} or the sample time",
        )


def _out_of_range(channel: Channel, values: FloatArray, recorded: Mapping[str, str]) -> list[str]:
    """Say that values leave the range that the model declares."""
    low, high = float(values.min()), float(values.max())
    if channel.minimum <= low and high <= channel.maximum:
        return []
    ends = np.array([channel.minimum, channel.maximum, low, high])
    (least, most, low, high), unit = told(ends, channel.unit, recorded.get(channel.name, channel.unit), reading=True)
    return [f"{channel.name} leaves its declared range [{least:g}, {most:g}] {unit}: {low:g} to {high:g}"]


def _raw(channel: Channel, values: FloatArray) -> list[str]:
    """Say that values in an SI unit look like the counts of a converter."""
    seen = values[np.isfinite(values)]
    if channel.unit not in SI_UNITS or np.ptp(seen) <= COUNTED or (seen != np.round(seen)).any():
        return []
    return [
        f"{channel.name} holds whole numbers from {seen.min():g} to {seen.max():g}, read as {channel.unit}: if a "
        "converter counted them, declare its scale (and offset) in a dataset.toml"
    ]


def _rates(trajectory: Trajectory, measured: Sequence[tuple[str, int]]) -> tuple[list[str], set[int]]:
    """Hold a measured rate against the difference quotient of its position; return notes, and columns that agree."""
    notes: list[str] = []
    sure: set[int] = set()
    units = {port: trajectory.spec.outputs[column].unit for column, (port, order) in enumerate(measured) if not order}
    named = {
        (Ports.channel_name(port, 1), 0): (port, 1)
        for port, unit in units.items()
        if units.get(Ports.channel_name(port, 1)) == rate_unit(unit, 1)
    }
    where = {named.get(pair, pair): column for column, pair in enumerate(measured)}
    for (port, order), column in where.items():
        below = where.get((port, order - 1))
        if order == 0 or below is None or len(trajectory) < 20:
            continue
        position, rate = trajectory.y[:, below], trajectory.y[:, column]
        period = trajectory.spec.outputs[below].period
        slope, correlation = _slope(position, rate, trajectory.spec.sample_time, period)
        names = f"{trajectory.spec.outputs[below].name} and {trajectory.spec.outputs[column].name}"
        if abs(slope - 1.0) <= 0.25 and correlation > 0.8:
            sure |= {below, column}
            continue
        back, agreed = _slope(rate, position, trajectory.spec.sample_time, None)
        if agreed > max(0.9, correlation) and abs(back - 1.0) <= 0.25:
            raise InputError(
                f"{names} are swapped",
                expected="a rate that is the derivative of its position",
                got="a position that is the derivative of the rate",
                remedy="exchange their columns",
            )
        if correlation < 0.8:
            notes.append(
                f"{names}: the derivative of the position and the measured rate have little in common "
                f"(correlation {correlation:.2f})"
            )
            continue
        near = sorted((abs(slope / factor - 1.0), text) for factor, text in _FACTORS if abs(slope / factor - 1.0) < 0.2)
        if near:
            raise InputError(
                f"{names} contradict each other",
                expected="a rate equal to the derivative of its position",
                got=f"a derivative {slope:.4g} times the rate: {near[0][1]}",
                remedy="correct the unit, the scale or the sample time",
            )
        notes.append(f"{names}: the derivative of the position is {slope:.3g} times the measured rate")
    return notes, sure


def _slope(position: FloatArray, rate: FloatArray, dt: float, period: float | None) -> tuple[float, float]:
    """Return the slope of position increments against the integral of the rate, and their absolute correlation.

    Over one step noise may hide both, over too many the motion returns to where it was: the width at which they agree
    best decides.
    """
    steps = np.diff(position)
    if period is not None:
        steps = (steps + period / 2) % period - period / 2
    path = np.concatenate(([0.0], np.cumsum(steps)))
    integral = np.concatenate(([0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))))
    best = (0.0, 0.0)
    for width in (1, 2, 5, 10, 20, 50, 100):
        if len(path) < 10 * width:
            break
        moved, summed = path[width:] - path[:-width], integral[width:] - integral[:-width]
        moved, summed = moved - moved.mean(), summed - summed.mean()
        power, cross = float(summed @ summed), float(summed @ moved)
        scale = float(np.sqrt(power * (moved @ moved)))
        if scale > 0.0 and abs(cross) / scale > best[1]:
            best = (cross / power, abs(cross) / scale)
    return best
