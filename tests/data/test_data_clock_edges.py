"""Rows that are left out, put together, cut or refused, to either side of every edge; and what is said, in figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harness.data.conditioning.clock import TimeRules, sample_time_of
from harness.data.conditioning.repeats import (
    REPEATED,
    UNUSED,
    complemented,
    refuse_two_in_one,
    without_duplicates,
    without_tail,
)
from harness.data.conditioning.timebase import FEW_FIRST, SHORTEST, RecordPiece, pieces_of
from harness.data.oddities.examine import _reads, _th
from harness.data.oddities.held import rhythm_of
from harness.data.oddities.leaps import leaps_of
from harness.data.oddities.levels import saturated
from harness.data.oddities.pace import trend_of
from harness.data.sections import ResampleSection
from harness.errors import InputError
from harness.signals import Channel, FloatArray

STEP = 0.125  # exact in binary, and so are its multiples
THETA = Channel("theta", "rad")


def pieces(time: FloatArray, values: FloatArray | None = None, **rules: Any) -> tuple[list[RecordPiece], list[str]]:
    rows = np.arange(len(time), dtype=np.float64)
    table = np.column_stack([rows % 7, rows]) if values is None else values
    return pieces_of(time, table, names=("u", "y"), inputs=(True, False), rules=TimeRules(**rules))


def refusal(time: FloatArray, values: FloatArray | None = None, **rules: Any) -> InputError:
    with pytest.raises(InputError) as refused:
        pieces(time, values, **rules)
    return refused.value


def even(rows: int) -> FloatArray:
    return STEP * np.arange(rows, dtype=np.float64)


# ---- rows that repeat -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("begin", [1, 2, 3, 40])
@pytest.mark.parametrize("tail", [1, 2, 3, 4, 30])
@pytest.mark.parametrize("zeros", [True, False])
def test_space_that_was_never_written_to_is_three_rows_or_more(begin: int, tail: int, zeros: bool) -> None:
    """Behind two rows at least; a last row that is repeated stays once, zeros whose clock stands back do not."""
    assert UNUSED == 3
    notes: list[str] = []
    time, values = even(begin) + STEP, np.arange(2.0 * begin).reshape(begin, 2)
    last = (0.0, [0.0, 0.0]) if zeros else (time[-1] + STEP, [9.0, 9.0])
    time, values = np.r_[time, np.full(tail, last[0])], np.vstack([values, np.tile(last[1], (tail, 1))])
    kept = begin + (0 if zeros else 1) if tail >= 3 and begin >= 2 else begin + tail
    assert without_tail(time, values, notes) == kept
    lost = begin + tail - kept
    assert notes == (
        [f"the last {lost} rows repeat one row and its stamp: nothing was written there, they are left out"]
        if lost
        else []
    )


@pytest.mark.parametrize(("twice", "kept"), [(0, 202), (2, 202), (3, 206)])
def test_a_clock_that_stands_elsewhere_too_is_coarse(twice: int, kept: int) -> None:
    """A hundredth of the stamps may repeat."""
    time = even(201)
    time[10 : 10 + 2 * twice : 2] = time[9 : 9 + 2 * twice : 2]
    values = np.arange(206.0)[:, None]
    values[201:] = 7.0
    assert without_tail(np.r_[time, np.full(5, 99.0)], values, []) == kept


def test_rows_of_single_signals_are_put_together() -> None:
    nan, notes = np.nan, list[str]()
    time = np.repeat(even(3), [2, 1, 2])
    values = np.array([[1, nan], [nan, 2], [3, nan], [nan, 4], [5, nan]])
    stamps, whole, rows = complemented(time, values, notes)
    assert (stamps.tolist(), rows.tolist()) == (even(3).tolist(), [0, 2, 3])
    assert whole == pytest.approx(np.array([[1, 2], [3, nan], [5, 4]]), nan_ok=True)
    assert notes == ["5 rows of 3 instants, none with a signal twice, are put together by their stamps"]
    values[4, 1] = 6.0  # the last signal twice
    assert complemented(time, values, notes)[0] is time


@pytest.mark.parametrize(("which", "value"), [("first", 10.0), ("last", 20.0), ("mean", 15.0)])
@pytest.mark.parametrize(("twice", "refused"), [(1, False), (10, False), (11, True)])
def test_a_tenth_of_the_rows_may_repeat_a_stamp(which: str, value: float, twice: int, refused: bool) -> None:
    assert REPEATED == 0.1
    time = even(101)
    time[1 : 1 + 2 * twice : 2] = time[0 : 2 * twice : 2]
    values = np.zeros((101, 1))
    values[0 : 2 * twice : 2], values[1 : 1 + 2 * twice : 2] = 10.0, 20.0
    rules, notes = TimeRules(duplicates=which), list[str]()  # type: ignore[arg-type]
    if refused:
        with pytest.raises(InputError, match=f"{twice} of 101 rows repeat the time stamp") as said:
            without_duplicates(time, time, values, rules, notes)
        assert f"{101 - twice} time stamps for 101 rows" in said.value.got
        return
    stamps, chosen, rows = without_duplicates(time, time, values, rules, notes)
    assert (len(stamps), len(chosen)) == (101 - twice,) * 2
    assert chosen[:twice, 0].tolist() == [value] * twice
    assert rows[0] == (which == "last")
    assert notes == [
        f"{twice} rows repeat the time stamp of the row before: the {which} counts; {twice} of them have other readings"
    ]


@pytest.mark.parametrize(("apart", "refused"), [(0.0, False), (0.25, False), (0.375, True)])
def test_a_doubled_row_has_its_stamp_within_a_quarter_of_a_sample(apart: float, refused: bool) -> None:
    time = np.array([0.0, 1.0, 1.0 + apart, 2.0]) * STEP
    index = np.array([0, 1, 1, 2])
    refuse_two_in_one(index, time, STEP, TimeRules(), "row {}".format)  # is refused as any stamp that stands
    refuse_two_in_one(np.arange(4), time, STEP, TimeRules(duplicates="first"), "row {}".format)
    if refused:
        with pytest.raises(InputError, match="two rows in one sample") as said:
            refuse_two_in_one(index, time, STEP, TimeRules(duplicates="first"), "row {}".format)
        assert said.value.got == f"{apart * STEP:.3g} s between row 1 and row 2"
        assert said.value.place == "row 2"
    else:
        refuse_two_in_one(index, time, STEP, TimeRules(duplicates="first"), "row {}".format)


# ---- pieces ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [0.55, 0.7])
def test_rows_that_are_stamped_late_are_one_sample_each(late: float) -> None:
    """By more than half a sample, now and then: nothing is lost. A lost row and a doubled one are not that."""
    time = even(200)
    time[[40, 90, 150]] += late * STEP
    (piece,), notes = pieces(time, sample_time=STEP)
    assert piece.values[:, 1].tolist() == list(range(200))
    assert f"up to {100 * late:.2g} % of a sample off" in notes[0]
    swapped = np.insert(np.delete(even(200), 60), 120, even(200)[120] + 0.1 * STEP)
    assert "two rows in one sample" in str(refusal(swapped, sample_time=STEP))


@pytest.mark.parametrize(("rows", "kept"), [(5, False), (19, False), (20, True), (21, True)])
def test_a_piece_between_gaps_has_twenty_rows(rows: int, kept: bool) -> None:
    assert SHORTEST == 20
    time = np.r_[even(40), 10.0 + even(rows), 30.0 + even(30)]
    found, notes = pieces(time, gaps="split")
    assert [len(piece.values) for piece in found] == ([40, rows, 30] if kept else [40, 30])
    assert [piece.start for piece in found] == ([0.0, 10.0, 30.0] if kept else [0.0, 30.0])
    lost = 0 if kept else rows
    assert f"{lost} of {70 + rows} rows dropped" in notes[0]
    assert ("3 pieces of 40" if kept else "2 pieces of 40, 30 samples") in notes[0]


@pytest.mark.parametrize("rows", [2, 5, 19, 20])
def test_a_run_without_gaps_stays_whole(rows: int) -> None:
    (piece,), notes = pieces(even(rows))
    assert (len(piece.values), piece.sample_time, notes) == (rows, STEP, [])


@pytest.mark.parametrize(("rows", "kept"), [(19, False), (20, True)])
def test_a_clock_that_begins_anew_begins_a_record_of_twenty_rows(rows: int, kept: bool) -> None:
    found, notes = pieces(np.r_[even(40), even(rows), even(30)], gaps="split")
    assert [len(piece.values) for piece in found] == ([40, rows, 30] if kept else [40, 30])
    begins = "row 0, row 40, row 60" if kept else "row 0, row 59"
    assert f"{3 if kept else 2} stretches, which begin in {begins}, are records of their own" in notes[0]
    assert ("rows dropped" in notes[0]) != kept
    assert kept or f"19 of {70 + rows} rows dropped" in notes[0]


@pytest.mark.parametrize(("first", "removed"), [(1, True), (2, True), (3, False), (10, False)])
def test_one_or_two_rows_before_a_record_may_be_no_readings(first: int, removed: bool) -> None:
    assert FEW_FIRST == 2
    said = refusal(np.r_[50.0 + even(first), even(40)])
    assert (said.what, said.place) == ("time runs back", f"row {first}")
    assert (f"remove what stands before row {first} if" in said.remedy) == removed
    assert ("1 stretch becomes a record" in said.remedy) != removed


@pytest.mark.parametrize(("rows", "anew"), [(30, True), (19, False)])
def test_stretches_that_are_most_of_the_rows_are_records(rows: int, anew: bool) -> None:
    said = refusal(np.concatenate([even(rows)] * 4))
    assert ("4 stretches become records" in said.remedy) == anew
    assert ("sort the rows" in said.remedy) is True


@pytest.mark.parametrize(("twice", "coarse"), [(10, False), (11, True)])
def test_more_than_a_tenth_of_stamps_that_stand_are_coarse(twice: int, coarse: bool) -> None:
    time = np.cumsum(np.r_[0.0, np.tile([0.0, STEP], twice), np.full(100 - 2 * twice, STEP)])
    said = refusal(time)
    assert said.what == "time stands still"
    assert ("a file for each record" in said.remedy) == coarse


@pytest.mark.parametrize(("off", "noted", "refused"), [
    (0.0005, False, False), (0.0015, True, False), (0.015, True, False), (0.019, True, False), (0.03, True, True),
])  # fmt: skip
def test_jitter_from_a_thousandth_is_said_and_from_a_fiftieth_refused(off: float, noted: bool, refused: bool) -> None:
    time = even(101)
    time[50] += off * STEP
    if refused:
        said = refusal(time)
        assert said.what == "time is not uniform (clock jitter)"
        assert f"({off:.0%} of a sample time off)" in said.got
        assert said.place == "row 50"
        return
    _, notes = pieces(time)
    assert notes == ([f"clock jitter up to {off:.2%} of the sample time: taken as uniform"] if noted else [])


@pytest.mark.parametrize(
    ("hole", "said"), [(1.5, "time is not uniform (clock jitter)"), (2.0, "(1 gap)"), (4, "(1 gap)")]
)
def test_a_gap_is_longer_than_a_step_and_a_half(hole: float, said: str) -> None:
    time = np.cumsum(np.r_[0.0, np.full(50, STEP), hole * STEP, np.full(50, STEP)])
    found = refusal(time)
    assert said in found.what
    if "gap" in said:
        assert f"{hole * STEP:g} s between row 50 and row 51 (t = {50 * STEP:g} s)" in found.got


@pytest.mark.parametrize(("hole", "refused"), [(0.375, False), (0.5, False), (0.625, True), (0.875, True)])
def test_holes_are_bridged_up_to_the_gap_that_was_declared(hole: float, refused: bool) -> None:
    time = np.cumsum(np.r_[0.0, np.full(50, STEP), hole, np.full(50, STEP)])
    rules: dict[str, Any] = {"resample": ResampleSection(max_gap=0.5), "intersample": "foh"}
    if refused:
        said = refusal(time, **rules)
        assert (said.what, said.got) == ("a gap too long to interpolate", f"{hole:g} s after t = {50 * STEP:g} s")
        found, _ = pieces(time, gaps="split", **rules)
        assert [len(piece.values) for piece in found] == [51, 51]
    else:
        ((piece,), _) = pieces(time, **rules)
        assert len(piece.values) == 101 + round(hole / STEP)


@pytest.mark.parametrize("every", [2, 5])
def test_signals_that_are_filled_in_turn_are_resampled_at_the_slowest(every: int) -> None:
    rows = 40 * every
    values = np.full((rows, 2), np.nan)
    values[::2, 0], values[1::every, 1] = 1.0, np.arange(len(values[1::every]))
    values[::2, 1] = np.nan
    said = refusal(even(rows), values)
    assert said.what.startswith("nothing recorded in")
    filled = [np.flatnonzero(np.isfinite(column)) for column in values.T]
    slowest = max(float(np.median(np.diff(rows))) for rows in filled) * STEP
    assert f"[resample] sample_time = {slowest:.4g}, or another" in said.remedy
    assert 'intersample = "zoh" if u is held' in said.remedy


@pytest.mark.parametrize("dt", [0.001, 0.01, 1.0, 10.0])
def test_rough_stamps_of_a_clock_with_lost_rows_give_its_sample_time(dt: float) -> None:
    """Whatever the unit: the mean of the steps near the usual one would be off by what is cut."""
    rng = np.random.default_rng(3)
    kept = np.sort(rng.permutation(2000)[:1900])
    time = dt * (kept + rng.uniform(-0.25, 0.25, 1900))
    assert sample_time_of(time) == pytest.approx(dt, rel=2e-4)


@pytest.mark.parametrize(("dt", "noted"), [(0.41234, True), (0.21234, True), (0.61234, False)])
def test_stamps_are_rounded_where_that_is_more_than_jitter_that_nobody_notices(dt: float, noted: bool) -> None:
    """To a millisecond: 2.4 thousandths of a sample are said, 1.6 are not."""
    found, notes = pieces(np.round(dt * np.arange(400), 3))
    assert found[0].sample_time == pytest.approx(dt, rel=1e-5)
    assert any(f"rounded to 0.001 s: a clock of {dt:g} s" in note for note in notes) == noted


# ---- oddities -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off", "every"), [(0, 5), (2, 5), (3, None)])
def test_a_rhythm_may_miss_two_beats_in_a_hundred(off: int, every: int | None) -> None:
    places = 5 * np.arange(1, 101)
    places[10 : 10 + 10 * off : 10] += 1
    moves = np.zeros(510)
    moves[places] = np.random.default_rng(1).uniform(1, 2, 100)
    assert rhythm_of(np.cumsum(moves)) == every


@pytest.mark.parametrize(("changes", "every"), [(19, None), (20, 5), (21, 5)])
def test_twenty_changes_make_a_rhythm(changes: int, every: int | None) -> None:
    assert rhythm_of(np.repeat(np.random.default_rng(1).normal(size=changes + 1), 5)) == every


def test_the_slowest_rhythm_is_fifty_rows() -> None:
    values = np.random.default_rng(1).normal(size=40)
    assert [rhythm_of(np.repeat(values, every)) for every in (2, 49, 50, 53)] == [2, 49, 50, None]


@pytest.mark.parametrize(
    ("rests", "found"), [((5, 3), True), ((5, 2), False), ((4, 4), False), ((8,), True), ((7,), False)]
)
def test_a_rail_is_eight_rows_and_five_of_them_together(rests: tuple[int, ...], found: bool) -> None:
    y = np.sin(0.1 * np.arange(1000.0)) + 0.001 * np.random.default_rng(2).standard_normal(1000)
    for number, rest in enumerate(rests):
        first = 100 + 126 * number
        rise = 0.5 + 0.3 * np.arange(6)
        y[first - 6 : first] = rise - 0.001
        y[first : first + rest] = 2.5
    said = saturated(THETA, y)
    assert list(said) == ([2.5] if found else [])
    if found:
        assert f"largest value 2.5 rad for {sum(rests)} samples in {len(rests)} places" in said[2.5]


@pytest.mark.parametrize(("size", "found"), [(0.0, False), (0.3, False), (0.5, True), (-0.5, True)])
def test_a_leap_is_told_with_its_row_and_size(size: float, found: bool) -> None:
    """The largest step of the motion is 0.1: four times as much is a leap."""
    y = np.sin(0.1 * np.arange(400.0)) + 1e-4 * np.random.default_rng(4).standard_normal(400)
    y[157:] += size
    rows, sizes = leaps_of(y)
    assert rows.tolist() == ([157] if found else [])
    assert not found or sizes[0] == pytest.approx(size, abs=0.02)


@pytest.mark.parametrize(("slope", "drifts"), [(0.98, False), (1.02, True)])
def test_a_trend_is_half_of_the_motion(slope: float, drifts: bool) -> None:
    line = np.linspace(-1.0, 1.0, 1001)
    wave = np.cos(2 * np.pi * 10 * np.linspace(0, 1, 1001))  # even: no line in it
    y = slope * line / np.std(line) + wave / np.std(wave)
    assert bool(trend_of(y, np.zeros((1001, 0)))) == drifts
    assert not drifts or trend_of(y, np.zeros((1001, 0))) == pytest.approx(slope**2 / (1 + slope**2), abs=2e-3)
    assert trend_of(y, line[:, None]) == 0.0
    assert trend_of(y, np.ones((1001, 1))) == 0.0


def test_ordinals() -> None:
    assert [_th(k) for k in (2, 3, 4, 5, 11, 12, 13, 14, 22, 23, 24, 32, 50)] == (
        ["2nd", "3rd", "4th", "5th", "11th", "12th", "13th", "14th", "22nd", "23rd", "24th", "32nd", "50th"]
    )


def test_odd_readings_are_told_with_their_rows_sizes_and_units() -> None:
    t = 0.5 * np.arange(99.0)
    one, rows = np.array([7]), np.arange(3, 50, 4)
    assert _reads(THETA, False, one, np.array([2.5]), np.array([0.125]), t) == (
        "theta reads 2.5 rad in row 7 (t = 3.5 s), where its neighbours predict 0.125 rad"
    )
    assert _reads(Channel("n", "1"), True, one, np.array([9999.0]), np.array([0.125]), t) == (
        "n reads 9999 in row 7, where its neighbours predict 0.125"
    )
    read, told = np.linspace(1.0, 2.0, 12), np.linspace(0.5, 0.25, 12)
    for count in (2, 12):
        said = _reads(THETA, False, rows[:count], read[:count], told[:count], t)
        assert f"theta has {count} spikes of up to {max(read[:count] - told[:count]):.3g} rad (rows 3, 7" in said
        assert (", ...)" in said) == (count == 12)
        word = _reads(THETA, True, rows[:count], np.full(count, 1.5), told[:count], t)
        assert word.startswith(f"theta reads 1.5 rad in {count} rows (3, 7")


@pytest.mark.parametrize("rate", [30, 48, 60, 75, 120, 144, 300])
@pytest.mark.parametrize("rows", [60, 100, 700])
@pytest.mark.parametrize("begin", [0, 6001])
def test_stamps_of_whole_milliseconds_tell_the_rate_and_where_each_sample_was(rate: int, rows: int, begin: int) -> None:
    instants = np.arange(begin, begin + rows) / rate
    found, _ = pieces(np.round(instants, 3))
    declared, _ = pieces(np.round(instants, 3), sample_time=1 / rate)
    for one in (*found, *declared):
        assert len(one.values) == rows
        assert one.sample_time == pytest.approx(1 / rate, rel=1e-12)
        assert one.start == pytest.approx(instants[0], abs=1e-9)


def test_a_clock_that_no_whole_number_describes_keeps_the_rate_that_its_stamps_show() -> None:
    found, _ = pieces(np.round(np.arange(3000) / 81.317, 3))
    assert found[0].sample_time == pytest.approx(1 / 81.317, rel=1e-6)


def test_a_clock_whose_stamps_are_no_multiples_of_it_begins_as_stamped() -> None:
    found, _ = pieces(np.round(0.0017 + np.arange(80) / 120, 3), sample_time=1 / 120)
    assert found[0].start == 0.002


@pytest.mark.parametrize(("rate", "resolution"), [(75, 0.01), (60, 0.01), (150, 0.005), (800, 0.001), (7.5, 0.1)])
def test_stamps_of_which_most_steps_are_too_short_are_the_declared_clock(rate: float, resolution: float) -> None:
    """At 75 Hz and 10 ms two of three steps are 10 ms; the declared rate explains them all."""
    time = np.round(np.arange(200) / rate / resolution) * resolution
    found, _ = pieces(time, sample_time=1 / rate)
    assert [(len(one.values), one.sample_time) for one in found] == [(200, pytest.approx(1 / rate, rel=1e-12))]
    with pytest.raises(InputError, match=r"disagrees with sample_time|explain"):
        pieces(time, sample_time=1.25 / rate)
