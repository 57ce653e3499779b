"""What is said of a record just below and above each edge, and figures that a factor or a row more would change."""

from __future__ import annotations

import re

import numpy as np
import pytest

from harness.data.conditioning.clock import TimeRules, _resolution, clock_of_rows, sample_time_of
from harness.data.conditioning.decimation import hold_means
from harness.data.conditioning.suspicion import _gain, swapped_in_and_out, swapped_runs
from harness.data.conditioning.timebase import pieces_of
from harness.data.conditioning.trends import without_trend
from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.oddities.between import _worse, mismatched
from harness.data.oddities.examine import _Look, _unwrapped
from harness.data.oddities.foretold import foretold
from harness.data.oddities.held import held_readings
from harness.data.oddities.levels import coarse_step, saturated
from harness.data.oddities.numbers import ODD
from harness.data.oddities.spikes import Spikes, spikes_of, unfelt
from harness.data.recipe.sanity import check_run
from harness.data.sections import ResampleSection
from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec, Run, Trajectory, Use

DT = 0.01
ONE = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
TWO = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("theta_dot", "rad/s")), DT)


def record(u: FloatArray, *y: FloatArray, spec: PlantSpec = ONE) -> Trajectory:
    return Trajectory(DT * np.arange(len(u), dtype=np.float64), u.reshape(-1, 1), np.column_stack(y), spec)


def smooth(n: int, rng: np.random.Generator, width: int = 40) -> FloatArray:
    """Return a slow motion of a spread of about 1."""
    window = np.hanning(width)
    return np.convolve(rng.standard_normal(n + width - 1), window / np.linalg.norm(window), mode="valid")


# ---- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.1875, 0.0625, 0.5])
def test_steps_half_as_long_again_are_no_samples_of_a_clock(step: float) -> None:
    """What is half a step off or more is left out of the mean; all figures are exact in binary."""
    time = np.cumsum(np.r_[0.0, np.full(9, 0.125), step, np.full(9, 0.125)])
    assert sample_time_of(time) == 0.125


def test_the_mean_of_steady_steps_is_their_clock() -> None:
    time = np.cumsum(np.r_[0.0, np.tile([0.1, 0.102], 20), 3.0, 0.1])
    assert sample_time_of(time) == pytest.approx((20 * 0.202 + 0.1) / 41, rel=1e-8)


@pytest.mark.parametrize("wanted", [0.1, 0.25])
def test_rows_out_of_order_keep_the_sample_time_that_was_declared(wanted: float) -> None:
    time = np.array([0.0, 0.2, 0.1])
    assert clock_of_rows(time, TimeRules(sample_time=wanted), None, []) == (wanted, None)
    assert clock_of_rows(time, TimeRules(), 0.5, []) == (0.5, None)
    for stamps in (time, np.array([0.0, 0.1, 0.1, 0.2])):
        assert clock_of_rows(stamps, TimeRules(), None, []) == (1.0, None)
        assert clock_of_rows(stamps, TimeRules(), 0.5, []) == (0.5, None)
    assert clock_of_rows(time[:1], TimeRules(sample_time=wanted), None, []) == (wanted, None)


@pytest.mark.parametrize("digits", range(10))
def test_the_resolution_of_stamps_is_told_down_to_a_nanosecond(digits: int) -> None:
    stamps = np.round([0.0, 3.1234567891, 7.9876543219], digits)
    assert _resolution(stamps) == pytest.approx(10.0**-digits, abs=0.0)
    assert _resolution(np.array([0.0, 3.1234567891, 7.9876543219])) == 0.0


USUAL = (1.0, 1.2, 1.5, 1.8, 2.0, 2.5, 3.0, 3.6, 4.0, 5.0, 6.0, 7.2, 9.0)


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("step", USUAL)
def test_days_of_this_century_at_a_usual_step(step: float, scale: float) -> None:
    for epoch in (36526.0, 45382.0, 69806.9):
        with pytest.raises(InputError, match="may count days") as refusal:
            refuse_unlikely_seconds(epoch + np.arange(200) * step * scale / 86400, "t")
        assert f"which in days are {step * scale:g} s" in refusal.value.got
        refuse_unlikely_seconds(epoch + np.arange(200) * 1.02 * step * scale / 86400, "t")
    refuse_unlikely_seconds(np.full(200, 45382.0), "t")  # a clock that stands


def resampled(step: float) -> str:
    time = 0.01 * np.arange(400, dtype=np.float64)
    values = np.column_stack([np.sin(time), np.cos(time)])
    rules = TimeRules(resample=ResampleSection(sample_time=step))
    _, notes = pieces_of(time, values, names=("u", "y"), inputs=(True, False), rules=rules)
    (note,) = [note for note in notes if "resampled" in note]
    return note


@pytest.mark.parametrize(("step", "samples"), [(0.02, 0), (0.01, 0), (0.005, 398)])
def test_samples_between_readings_are_counted(step: float, samples: int) -> None:
    found = re.search(r"(\d+) samples lie between", resampled(step))
    assert (int(found[1]) if found else 0) == pytest.approx(samples, abs=2)
    assert bool(found) == bool(samples)


def test_the_last_instant_of_a_grid_holds_what_was_last_set() -> None:
    means = hold_means(np.arange(5.0), np.array([1.0, 3.0, 5.0, 7.0, 11.0]), np.array([0.0, 2.0, 4.0]))
    assert means.tolist() == [2.0, 6.0, 11.0]


@pytest.mark.parametrize("trend", ["none", "constant"])
def test_a_single_row_and_no_column_have_a_trend(trend: str) -> None:
    assert without_trend(np.array([[3.0]]), trend).tolist() == ([[0.0]] if trend == "constant" else [[3.0]])  # type: ignore[arg-type]
    assert without_trend(np.zeros((5, 0)), trend).shape == (5, 0)  # type: ignore[arg-type]


# ---- columns and runs -----------------------------------------------------------------------------------------------


def loop(gain: float, back: float, seed: int) -> Trajectory:
    """Return a record in which each column follows the other: the output by ``gain``, the input by ``back``."""
    rng = np.random.default_rng(seed)
    u, y = np.zeros(4000), np.zeros(4000)
    for k in range(1, 4000):
        u[k] = back * y[k - 1] + rng.standard_normal()
        y[k] = gain * u[k - 1] + rng.standard_normal()
    return record(u, y)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_in_a_loop_input_and_output_follow_each_other(seed: int) -> None:
    """Said is only an input that gains from the output by a quarter, and by more than what the output gains from it."""
    closed = loop(0.65, 0.9, seed)
    forward, backward = _gain(closed.y[:, 0], closed.u[:, 0]), _gain(closed.u[:, 0], closed.y[:, 0])
    assert 0.85 * backward < forward < 1.25 < backward
    assert swapped_in_and_out(closed) == []
    driven = loop(2.0, 0.0, seed)
    assert swapped_in_and_out(driven) == []
    (said,) = swapped_in_and_out(record(driven.y[:, 0], driven.u[:, 0]))
    assert "u follows theta, and theta does not follow u" in said


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [(1.0, 1.0, True), (1.9, 1.0, True), (1.0, 0.53, True), (2.1, 1.0, False), (2.9, 1.0, False), (1.0, 2.5, False),
     (0.48, 1.0, False), (1.0, 0.4, False)],
)  # fmt: skip
def test_changed_places_are_sizes_within_a_factor_of_two(first: float, second: float, said: bool) -> None:
    """In run 0 the columns are 100 : 1, in run 1 they are 1 : 100 times these factors."""
    rng = np.random.default_rng(2)
    u, a, b = rng.standard_normal((3, 300))
    b *= np.std(a) / np.std(b)
    use: Use = "estimation"
    runs = [
        Run(record(u, 100.0 * a, b, spec=TWO), use, ""),
        Run(record(u, first * b, 100.0 * second * a, spec=TWO), use, ""),
    ]
    notes = [note for note in swapped_runs(runs) if "theta and theta_dot" in note]
    assert len(notes) == said
    assert not said or "in run 1" in notes[0]


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (180 / np.pi, "one is in degrees"), (np.pi / 180, "one is in degrees"),
        (1000.0, "a unit is wrong by 1000"), (1e-3, "wrong by 1000"), (60 / (2 * np.pi), "the rate is in rpm"),
        (2 * np.pi / 60, "the rate is in rpm"), (2 * np.pi, "in turns per second"), (0.5 / np.pi, "turns per second"),
        (60.0, "per minute"), (66.0, "per minute"), (70.0, "per minute"), (1 / 60, "minute"), (1 / 68, "per minute"),
        (-1.0, "wrong sign"),
    ],
)  # fmt: skip
def test_what_a_rate_and_its_position_contradict_each_other_by(factor: float, text: str) -> None:
    """The derivative of the position over the measured rate."""
    rng = np.random.default_rng(3)
    rate = smooth(2000, rng)
    theta = np.cumsum(np.r_[0.0, 0.5 * DT * (rate[1:] + rate[:-1])])
    with pytest.raises(InputError, match="contradict each other") as refusal:
        check_run(record(rng.standard_normal(2000), theta, rate / factor, spec=TWO), (("theta", 0), ("theta", 1)))
    assert text in refusal.value.got
    assert f"a derivative {factor:.4g} times the rate" in refusal.value.got


@pytest.mark.parametrize("factor", [1.0, 0.78, 1.24])
def test_a_rate_and_its_position_agree_within_a_quarter(factor: float) -> None:
    rng = np.random.default_rng(3)
    rate = smooth(2000, rng)
    theta = np.cumsum(np.r_[0.0, 0.5 * DT * (rate[1:] + rate[:-1])])
    notes = check_run(record(rng.standard_normal(2000), theta, rate / factor, spec=TWO), (("theta", 0), ("theta", 1)))
    assert not any("derivative" in note for note in notes)


@pytest.mark.parametrize(("factor", "swapped"), [(1.0, True), (1.2, True), (0.85, True), (3.0, False), (0.3, False)])
def test_position_and_rate_are_swapped_where_both_agree_then(factor: float, swapped: bool) -> None:
    rng = np.random.default_rng(4)
    rate = smooth(2000, rng)
    theta = np.cumsum(np.r_[0.0, 0.5 * DT * (rate[1:] + rate[:-1])])
    data = record(rng.standard_normal(2000), rate, theta / factor, spec=TWO)
    if swapped:
        with pytest.raises(InputError, match="theta and theta_dot are swapped"):
            check_run(data, (("theta", 0), ("theta", 1)))
    else:
        notes = check_run(data, (("theta", 0), ("theta", 1)))
        assert any("have little in common" in note for note in notes)


@pytest.mark.parametrize("largest", [20.35, 22.0, 31.8])
def test_steps_of_an_angle_are_told_in_the_unit_that_it_may_have(largest: float) -> None:
    rng = np.random.default_rng(5)
    steps = rng.uniform(-1.0, 1.0, 300)
    y = np.cumsum(np.r_[0.0, steps * largest / np.abs(steps).max()])
    with pytest.raises(InputError, match="more than a turn between samples") as refusal:
        check_run(record(rng.standard_normal(301), y), (("theta", 0),))
    for unit, factor in (("deg", np.pi / 180), ("mrad", 1e-3)):
        assert f"{unit} (steps up to {largest * factor:.2g} rad then)" in refusal.value.remedy
    far = np.mean(np.abs(np.diff(y)) > 1.1 * 2 * np.pi)
    assert f"steps up to {largest:.3g} rad, beyond a turn in {far:.0%}" in refusal.value.got


def follows(u: FloatArray, gain: float, rng: np.random.Generator) -> FloatArray:
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.9 * y[k - 1] + gain * u[k - 1] + 0.01 * rng.standard_normal()
    return y


@pytest.mark.parametrize(("rows", "said"), [(199, 0), (200, 1)])
def test_records_are_held_against_each_other_from_two_hundred_rows_on(rows: int, said: int) -> None:
    rng = np.random.default_rng(6)
    u = rng.standard_normal((2, 400))
    first = Run(record(u[0], follows(u[0], 0.1, rng)), "validation", "")
    other = record(u[1, :rows], follows(u[1, :rows], 0.2, rng))
    uses: tuple[Use, ...] = ("validation", "estimation", "test")
    assert [len(mismatched([first, Run(other, use, "")])) for use in uses] == [said, 0, 0]


@pytest.mark.parametrize("seed", range(3))
def test_how_much_one_model_errs_for_two_records(seed: int) -> None:
    """By least squares on rows that are foretold from rows of their own record; no error is an odd one."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal((2, 500, 1)), np.zeros((2, 500))
    for number, gain in enumerate((0.1, 0.14)):
        for k in range(1, 500):
            y[number, k] = 0.9 * y[number, k - 1] + gain * u[number, k - 1, 0] + rng.uniform(-0.05, 0.05)
    n = ODD.order

    def told(own: FloatArray, drive: FloatArray) -> FloatArray:
        lagged = [own[n - j : len(own) - j] for j in range(1, n + 1)]
        lagged += [drive[n - j : len(own) - j, 0] for j in range(n + 1)]
        return np.column_stack([*lagged, np.ones(len(own) - n), own[n:]])

    alone = [told(*pair) for pair in zip(y, u, strict=True)]
    apart = sum(float(np.linalg.lstsq(one[:, :-1], one[:, -1])[1][0]) for one in alone)
    centred = [told(a - a.mean(), b - b.mean(axis=0)) for a, b in zip(y, u, strict=True)]
    fitted = np.vstack([centred[0], centred[1][n:]])  # the rows at the seam are among the rows before of the next ones
    law = np.linalg.lstsq(fitted[:, :-1], fitted[:, -1])[0]
    joint = sum(float(np.sum((one[:, -1] - one[:, :-1] @ law) ** 2)) for one in centred)
    assert _worse((y[0], y[1]), (u[0], u[1])) == pytest.approx(np.sqrt(joint / apart), rel=1e-9)
    assert _worse((y[0], y[0]), (u[0], u[0])) == 1.0


# ---- readings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1.0, 0.01, 1e-5, 1e5])
@pytest.mark.parametrize(("jump", "held"), [(1.0, True), (0.5, True), (0.36, True), (0.25, False), (0.1, False)])
def test_a_held_reading_is_followed_by_what_it_missed(jump: float, held: bool, width: float) -> None:
    """A signal that moves by one a row rests for ten rows, and then moves by a part of the ten that it would have."""
    rng = np.random.default_rng(7)
    moves = np.where(np.arange(1200) % 400 < 200, 1.0, -1.0) * (1.0 + 0.01 * rng.standard_normal(1200))
    for start in rng.permutation(np.arange(30, 1100, 41))[:22] + rng.integers(0, 15, 22):
        moves[start : start + 9] = 0.0
        moves[start + 9] = np.sign(moves[start + 9] or 1.0) * 10.0 * jump
    found = held_readings(width * np.cumsum(moves), np.zeros((1200, 0)))
    assert (found is not None) == held
    if found is not None:
        assert found.every is None
        assert np.flatnonzero(~found.fresh).tolist() == np.flatnonzero(moves == 0.0).tolist()


def test_a_reading_that_hardly_moved_before_it_was_held_counts_as_any() -> None:
    """What a signal moves meanwhile is a twentieth of its typical change at least, whatever the unit."""
    rng = np.random.default_rng(8)
    moves = rng.choice([-1.0, 1.0], 1200) * rng.uniform(0.8, 1.2, 1200)
    for start in range(30, 1150, 47):
        start += int(rng.integers(0, 20))
        moves[start - 1] *= 1e-6
        moves[start : start + 4] = 0.0
    said = {
        width: held_readings(width * np.cumsum(moves), np.zeros((1200, 0))) is not None
        for width in (1.0, 1e-4, 1e-2, 10.0, 1e3)
    }
    assert set(said.values()) == {True}


@pytest.mark.parametrize("levels", [2, 3, 4, 9])
def test_readings_on_three_levels_have_a_step(levels: int) -> None:
    y = 0.25 * np.abs(np.arange(400) // 5 % (2 * levels - 2) - (levels - 1.0))
    assert np.unique(y).size == levels
    assert coarse_step(y) == (0.25 if levels > 2 else 0.0)


@pytest.mark.parametrize("late", [ODD.order + 1, ODD.order + 2, 30])
def test_a_row_counts_again_when_the_odd_one_foretells_it_no_more(late: int) -> None:
    """The only row that tells what an input does at once: from the ninth one after an odd reading on it is heard."""
    n = 400
    odd = np.zeros(n, dtype=bool)
    odd[200] = True
    u = np.zeros((n, 1))
    u[200 + late] = 1.0
    y = np.sin(0.3 * np.arange(n)) + u[:, 0]
    found = foretold(y, u, odd)
    assert found.other[0, 0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_spike_is_found_at_the_size_that_its_pattern_makes_sure(seed: int) -> None:
    """Of a random walk it spoils two predictions: ten times the moves of a row are sure, three times are not."""
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.standard_normal(600))
    for size, rows in ((10.0, [300]), (3.0, [])):
        shown = y.copy()
        shown[300] += size
        found = spikes_of(shown, np.zeros((600, 0)))
        assert found.rows.tolist() == rows
        assert np.abs(found.mended - y).max() < 3.2


@pytest.mark.parametrize(("count", "share"), [(1, 1.0), (2, 1.0), (5, 0.75), (6, 0.0), (8, 0.0)])
def test_up_to_five_odd_readings_near_each_other_are_told_apart(count: int, share: float) -> None:
    """More are a stretch, of which nothing is said: here to either side in turn, in every third row."""
    assert ODD.together == 5
    rows = 200 + 3 * np.arange(count)
    said = []
    for seed in range(8):
        y = 30 * np.sin(0.05 * np.arange(400)) + np.random.default_rng(seed).standard_normal(400)
        y[rows] += 15.0 * (-1.0) ** np.arange(count)
        said.append(spikes_of(y, np.zeros((400, 0))).rows.tolist())
    assert sum(one == rows.tolist() for one in said) >= 8 * share
    assert share or said == [[]] * 8


def glitched(size: float, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, Spikes, FloatArray]:
    """Return output, logged input, its glitches, and the output of a plant that felt none of them.

    The plant follows the mean of nine rows of its input; a glitch would show by ``size`` in each of nine outputs.
    """
    n = 3000
    u = smooth(n, rng)
    noise = 0.05 * rng.standard_normal(n)
    y = np.convolve(u, np.full(9, 1 / 9))[:n] + noise
    rows = np.sort(rng.permutation(np.arange(5, n // 30 - 2))[:count]) * 30
    logged = u.copy()
    logged[rows] += 9 * size * 0.05 * rng.choice([-1.0, 1.0], count) * (1 + 1e-4 * rng.standard_normal(count))
    return y, logged, Spikes(rows, u), noise


@pytest.mark.parametrize(("size", "low", "high"), [(2.0, 0.6, 0.8), (3.5, 1.0, 1.0), (0.5, 0.0, 0.0)])
def test_a_glitch_of_the_log_is_told_by_nine_rows_of_the_output(size: float, low: float, high: float) -> None:
    """It gains 9 size^2 / 2 with a deviation of 3 size, against 14: of 2 deviations, three in four are sure."""
    share = []
    for seed in range(6):
        y, logged, spikes, _ = glitched(size, 60, np.random.default_rng(seed))
        rows, undecided = unfelt(y[:, None], logged[:, None], 0, spikes)
        assert not set(rows) & set(undecided)
        share.append(len(rows) / 60)
    assert low <= np.mean(share) <= high


@pytest.mark.parametrize(
    ("count", "odd", "told"), [(10, 0, True), (10, 1, False), (11, 1, True), (20, 1, True), (20, 2, False)]
)
def test_rows_of_one_word_are_one_matter_where_nearly_all_go_on_as_usual(count: int, odd: int, told: bool) -> None:
    """None of them is sure by itself; together they are, if more than nine in ten of them are followed by the usual."""
    rng = np.random.default_rng(11)
    u = smooth(6000, rng)
    y = np.convolve(u, np.full(9, 1 / 9))[:6000] + 0.05 * rng.standard_normal(6000)
    calm = [row for row in range(30, 5950, 30) if abs(u[row]) < 0.15][:count]
    assert len(calm) == count
    logged = u.copy()
    logged[calm] = 0.45
    for row in calm[:odd]:
        y[row + 1 : row + 8] += 0.5 * np.tile([1.0, -1.0], 4)[:7]
    rows, undecided = unfelt(y[:, None], logged[:, None], 0, Spikes(np.array(calm), u))
    assert rows.tolist() == (calm if told else [])
    assert undecided.size == (0 if told else count - odd)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("level", [0.0, 50.0, -50.0, 1e4])
@pytest.mark.parametrize("size", [0.4, 9e3])
def test_spikes_are_found_in_any_unit_and_about_any_level(scale: float, level: float, size: float) -> None:
    truth = np.sin(0.05 * np.arange(600.0)) + 1e-3 * np.random.default_rng(6).standard_normal(600)
    y = truth.copy()
    y[[200, 340]] += size
    found = spikes_of(scale * (y + level), np.zeros((600, 0)))
    assert found.rows.tolist() == [200, 340]
    assert np.abs(found.mended / scale - level - truth).max() < 0.02


@pytest.mark.parametrize(("rows", "held"), [(99, False), (100, True), (300, True)])
def test_held_readings_are_looked_for_from_a_hundred_rows_on(rows: int, held: bool) -> None:
    y = np.repeat(np.random.default_rng(12).standard_normal(101), 3)[:rows]
    assert (held_readings(y, np.zeros((rows, 0))) is not None) == held


@pytest.mark.parametrize(("values", "held"), [(19, False), (20, True)])
def test_held_readings_take_twenty_values(values: int, held: bool) -> None:
    levels = np.random.default_rng(13).uniform(0.0, 1.0, values)
    y = np.repeat(levels[np.r_[np.arange(values), np.random.default_rng(14).integers(0, values, 200)]], 3)
    assert np.unique(y).size == values
    assert (held_readings(y, np.zeros((len(y), 0))) is not None) == held


@pytest.mark.parametrize(
    ("kind", "rows", "looked"), [("real", 100, True), ("real", 99, False), ("integer", 400, False)]
)
def test_real_inputs_of_a_hundred_rows_are_looked_at(kind: str, rows: int, looked: bool) -> None:
    rng = np.random.default_rng(15)
    u = np.round(100 * smooth(rows, rng))
    u[50] += 9000.0
    spec = PlantSpec((Channel("u", "1", kind=kind),), (Channel("theta", "rad"),), DT)  # type: ignore[arg-type]
    look = _Look(0, record(u, np.cumsum(rng.standard_normal(rows)), spec=spec))
    look.look()
    assert ("u" in [odd.channel for odd in look.oddities]) == looked


@pytest.mark.parametrize(("value", "out"), [(9e99, False), (1.2e100, True), (-1.2e100, True), (1e300, True)])
@pytest.mark.parametrize("rows", [1, 4, 5])
def test_numbers_beyond_all_are_no_readings(value: float, out: bool, rows: int) -> None:
    """The first four rows are named; an input is read as its neighbours, an output is missing there."""
    places = 10 + 2 * np.arange(rows)
    u, y = np.arange(60.0), 2.0 * np.arange(60.0)
    u[places] = y[places] = value
    look = _Look(3, record(u, y))
    look._beyond_all()
    assert look.missing[:, 0].nonzero()[0].tolist() == (places.tolist() if out else [])
    if not out:
        assert look.oddities == []
        return
    named = ", ".join(map(str, places[:4])) + (", ..." if rows > 4 else "")
    for odd, name, remark in zip(
        look.oddities, ("u", "theta"), ("read as their neighbours", "counted as missing"), strict=True
    ):
        assert (odd.run, odd.channel, odd.rows, odd.used) == (3, name, tuple(places.tolist()), True)
        assert odd.words == f"{name} reads {value:.3g} in row {named}, which no sensor does: {remark}"
    mended = look.mended()
    assert mended.u[:, 0] == pytest.approx(np.arange(60.0))
    assert mended.y[:, 0] == pytest.approx(2.0 * np.arange(60.0))


def test_a_signal_that_settles_at_its_largest_value_meets_no_rail() -> None:
    y = np.sin(0.1 * np.arange(1000.0)) + 0.001 * np.random.default_rng(2).standard_normal(1000)
    for first in (100, 300):
        y[first - 20 : first] = 2.0 - 0.001 * np.arange(20, 0, -1)
        y[first : first + 10] = 2.0
    assert saturated(ONE.outputs[0], y) == {}


@pytest.mark.parametrize(("turns", "plain"), [(0.9, True), (1.04, True), (1.07, False), (3.0, False)])
def test_an_angle_that_stays_within_a_turn_may_count_one(turns: float, plain: bool) -> None:
    """Where nine tenths and more of the readings span up to 1.05 periods the jumps of a turn are taken out."""
    y = np.where(np.arange(400) % 20 < 10, 0.0, turns * 2 * np.pi)
    found = _unwrapped(y, 2 * np.pi)
    assert (np.ptp(found) < 0.6 * 2 * np.pi) == plain
    assert plain or found is y


def test_a_rail_marks_the_rows_that_rest_there() -> None:
    y = np.minimum(np.sin(0.05 * np.arange(1500.0)) + 1e-4 * np.random.default_rng(2).standard_normal(1500), 0.8)
    look = _Look(0, record(np.random.default_rng(3).standard_normal(1500), y))
    look.look()
    (rail,) = [odd for odd in look.oddities if odd.kind == "rail"]
    assert list(rail.rows) == np.flatnonzero(y == 0.8).tolist()
    assert f"0.8 rad for {len(rail.rows)} samples" in rail.words
