"""The clock that took the rows of a record: its sample time, and the sample that each row is where stamps are rough."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np
import numpy.typing as npt

from harness.data.sections import Gaps, ResampleSection
from harness.errors import InputError
from harness.signals import FloatArray

JITTER_UNNOTICED = 1e-3  # Deviation from the grid, in sample times, that recorded time stamps have anyway (rounding).

JITTER_ACCEPTED = 2e-2
"""Up to this deviation a record counts as uniform, with a warning; beyond it is refused or resampled."""

ROUNDED = 1.1
"""Spread of rounded stamps about their clock, in units of their resolution: 1, and some for the fitted rate."""

ROUGH = 0.05
"""Spread of steps, in steps, from which those near the usual one are no sample of them all: ten times as far as that
they are cut, and unevenly about a usual step that is a little off."""

PHASED, IN_STEP = 20, 0.3
"""Rows whose mean phase is a clock's at the first of them, and the mean resultant length from which they have one: of
stamps at random it is 0.22 (1 / sqrt(20)), under jitter of 0.4 of a step either way 0.23, of 0.3 it is 0.50."""

EXPLAINED = 0.2
"""Spread of stamps about the samples of a clock, in samples, below which no other clock is looked for: miscounted rows
leave 0.29 and more."""

IN_TURN = 0.9
"""Spread of stamps about a clock of one sample a row, in samples, below which none was lost or doubled: that is 1."""

DENOMINATORS = 6
"""Digits of the denominator of a sample time that is told from rounded stamps: more than a rate in Hz ever has."""

STAMPED = 4e-16  # Part of a stamp within which a number of 64 bits holds it, twice over.

FOLLOWED = 0.05
"""Part of each stamp's deviation by which the phase of a clock follows: clocks drift by 1e-4 at most, and jitter is
averaged over twenty rows."""


@dataclass(frozen=True)
class TimeRules:
    """What the data set declares about time."""

    sample_time: float | None = None
    gaps: Gaps = "refuse"
    resample: ResampleSection | None = None
    intersample: Literal["zoh", "foh", "smooth"] | None = "zoh"
    """None where nothing is declared: held, unless it matters from when on."""
    duplicates: Literal["refuse", "first", "last", "mean"] = "refuse"


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
    found = float(steady.mean() if steady.size else steps.mean())
    if steady.size and float(steady.std()) > ROUGH * typical > 0.0:
        found = _counted(time, (found, typical, float(steps.mean())))
    # rounded stamps tell their mean step to the resolution over the rows: records of one clock then have one step
    rounding = float(np.ptp(steady)) / steady.size if steady.size else 0.0
    known = rounding if rounding * steady.size <= 2 * JITTER_UNNOTICED * typical else 0.0
    texts = (f"{found:.{digits}g}" for digits in range(1, 9))
    return next((float(text) for text in texts if abs(float(text) - found) <= known), float(f"{found:.9g}"))


def _counted(time: FloatArray, starts: tuple[float, ...]) -> float:
    """Return the sample time of rough stamps: that of the samples whose clock leaves least of them unexplained."""
    best, least = starts[0], np.inf
    for dt in starts:
        for _ in range(3):  # a rate that is nearer miscounts fewer rows
            index = tracked(time, dt)
            if index[-1] < 2:
                break
            slope, offset = np.polyfit(index, time - time[0], 1)
            left = float(np.std(time - time[0] - offset - slope * index) / slope) if slope > 0.0 else np.inf
            if left < least:
                best, least = float(slope), left
            dt = float(slope) if slope > 0.0 else dt
        if least < EXPLAINED:
            break
    return best


def clock_of_rows(
    time: FloatArray, rules: TimeRules, common: float | None, notes: list[str]
) -> tuple[float, npt.NDArray[np.int64] | None]:
    """Return the sample time [s], and the sample that each row is where a clock explains rough stamps; else None.

    A declared sample time says that a clock took the rows, whatever was stamped on them. Without one, stamps that are
    all within their own resolution of a uniform clock are that clock's, rounded.
    """
    if len(time) < 2:
        return rules.sample_time or common or 1.0, None
    wanted = None if rules.resample is not None else rules.sample_time
    if (np.diff(time) < 0).any() or (wanted is None and not np.ptp(time)):
        return wanted or common or 1.0, None  # refused by its order
    if wanted is None:
        return _rounded(time, rules, common, notes)
    n, coarse = len(time), max(_resolution(time), _tick(time))
    own = float((time[-1] - time[0]) / (n - 1))
    if np.abs(time - time[0] - np.arange(n) * own).max() <= JITTER_ACCEPTED * wanted and own > 0.5 * wanted:
        return _agreed(own, n, rules, common), None
    if coarse > wanted:
        if np.ptp(time - time[0] - np.arange(n) * wanted) > coarse + 0.5 * wanted:
            raise InputError(
                f"time stamps of {coarse:g} s that {n} samples of the declared {wanted:g} s do not explain",
                expected=f"{(n - 1) * wanted:g} s from the first to the last row, within {coarse:g} s all along",
                got=f"{time[-1] - time[0]:g} s: rows were lost or doubled, or sample_time is another",
                remedy="correct sample_time, or record finer time stamps; rename a column that tells no time",
                place="sample_time",
            )
        notes.append(
            f"the time stamps are multiples of {coarse:g} s, coarser than the declared sample time of {wanted:g} s: "
            "rows are taken as its samples one by one, and few lost ones would not show"
        )
        return wanted, np.arange(n)
    index = tracked(time, wanted)
    if rules.duplicates == "refuse" and (np.diff(index) == 0).any() and _in_turn(time, wanted):
        index = np.arange(n)
    one_by_one = bool((np.diff(index) == 1).all())  # then rounding may have made most steps too short or too long
    for measured in (*(() if one_by_one else (sample_time_of(time),)), float((time[-1] - time[0]) / max(index[-1], 1))):
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
            dt = _agreed(_simplest(time, index, float(slope), resolution), len(time), rules, common)
            notes.append(f"the time stamps are rounded to {resolution:g} s: a clock of {dt:g} s explains them all")
            return dt, index
    return _agreed(sample_time_of(time), len(time), rules, common), None


def _simplest(time: FloatArray, index: npt.NDArray[np.int64], slope: float, resolution: float) -> float:
    """Return the sample time [s] with the smallest denominator that explains stamps rounded to a resolution [s].

    Many do, and people choose whole numbers of milliseconds or of samples in a second.

    Examples
    --------
    >>> time = np.round(np.arange(100) / 300, 3)
    >>> 1 / _simplest(time, np.arange(100), 3.33309e-3, 1e-3)
    300.0
    """
    for digits in range(1, DENOMINATORS + 1):
        found = float(Fraction(slope).limit_denominator(10**digits))
        if found > 0.0 and np.ptp(time - time[0] - found * index) <= resolution + STAMPED * float(np.abs(time).max()):
            return found
    return float(f"{slope:.9g}")


def first_instant(time: FloatArray, index: npt.NDArray[np.int64], dt: float) -> float:
    """Return when the sample of the first row was taken [s]: as stamped, but for what rounding took from it.

    A clock that began at nought has samples at multiples of its sample time; where all stamps are those, rounded, the
    first one is too.

    Examples
    --------
    >>> round(first_instant(np.round(np.arange(6001, 6051) / 300, 3), np.arange(50), 1 / 300), 6)
    20.003333
    """
    resolution, at = _resolution(time), round(float(time[0]) / dt) * dt
    off = float(np.abs(time - at - index * dt).max())
    return at if off <= resolution + STAMPED * float(np.abs(time).max()) else float(time[0])


def _resolution(time: FloatArray) -> float:
    """Return the largest power of ten [s] of which all stamps are multiples; 0 where none from a second to 1 ns is.

    Examples
    --------
    >>> _resolution(np.array([0.0, 0.008, 0.017])), _resolution(np.array([0.0, 1 / 3]))
    (0.001, 0.0)
    """
    for digits in range(10):
        scaled = time * 10.0**digits
        if (np.abs(scaled - np.round(scaled)) <= 1e-6 + STAMPED * np.abs(scaled)).all():
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


def _phase(time: FloatArray, dt: float) -> float:
    """Return how far behind the first stamp its sample lies [s]: the mean phase of the first rows, if they have one.

    Reference: Mardia & Jupp (2000), *Directional Statistics*, sec. 2.2.
    """
    turns = np.exp(2j * np.pi * ((time[:PHASED] - time[0]) / dt))
    mean = complex(turns.mean())
    return float(np.angle(mean)) / (2 * np.pi) * dt if abs(mean) > IN_STEP else 0.0


def tracked(time: FloatArray, dt: float) -> npt.NDArray[np.int64]:
    """Return which sample of a clock each row is: the nearest one, the clock's phase following the stamps slowly.

    Examples
    --------
    >>> tracked(np.array([0.0, 0.08, 0.21, 0.3, 0.52]), 0.1).tolist()
    [0, 1, 2, 3, 5]
    """
    index = np.zeros(len(time), dtype=np.int64)
    edge, at = float(time[0]) + _phase(time, dt), 0
    for row, stamp in enumerate(time.tolist()[1:], start=1):
        steps = round((stamp - edge) / dt)
        edge += steps * dt
        edge += FOLLOWED * (stamp - edge)
        at += steps
        index[row] = at
    return index


def _in_turn(time: FloatArray, dt: float) -> bool:
    """Return True if all stamps, a sample each, lie within one of their clock: a lost or doubled row is one off.

    Stamps of a busy computer are late, now and then by more than half a sample.

    Examples
    --------
    >>> late = np.array([0.0, 0.1, 0.26, 0.31, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    >>> tracked(late, 0.1).tolist(), _in_turn(late, 0.1), _in_turn(np.append(np.delete(late, 3), 0.92), 0.1)
    ([0, 1, 3, 3, 4, 5, 6, 7, 8, 9], True, False)
    """
    rows = np.arange(len(time))
    slope, offset = np.polyfit(rows, time, 1)
    return bool(np.ptp(time - offset - slope * rows) < IN_TURN * dt)


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
