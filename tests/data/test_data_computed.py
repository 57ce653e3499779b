"""Figures of reading and conditioning against computations of their own, over whole ranges of what may come."""

from __future__ import annotations

import datetime
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal, stats

from harness.data.conditioning.clock import TimeRules, clock_of_rows, first_instant, sample_time_of, tracked
from harness.data.conditioning.decimation import filtered as coarser
from harness.data.conditioning.decimation import hold_means
from harness.data.conditioning.repeats import complemented, without_duplicates, without_tail
from harness.data.conditioning.suspicion import _gain, units_between_runs
from harness.data.conditioning.timebase import _between
from harness.data.conditioning.trends import filtered, without_trend
from harness.data.oddities.between import mismatched
from harness.data.oddities.foretold import foretold
from harness.data.oddities.held import held_readings, rhythm_of, runs_of_equal, step_of
from harness.data.oddities.leaps import leaps_of
from harness.data.oddities.levels import coarse_step
from harness.data.oddities.pace import band_of, trend_of
from harness.data.oddities.spikes import _sizes, alike, is_word
from harness.data.sections import FilterSection, ResampleSection
from harness.data.tables.cells import measured, numbers_of, refuse_thousands, units_below
from harness.data.tables.headers import clock_of, clock_unit, split_header
from harness.data.tables.long_form import in_long_form
from harness.data.tables.merging import in_turn, merged
from harness.data.tables.packing import most_unpacked, refuse_large
from harness.data.tables.stacked import stacked_titles
from harness.data.times.counts import dated, unwrapped
from harness.data.times.stamps import clock
from harness.data.times.written_times import ahead_of_utc, minutes_of, plain_time, span_of
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Run, Trajectory

SEEDS = st.integers(0, 10**6)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(2, 12))
def test_a_held_mean_is_the_integral_over_its_sample(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.05, 0.4, 20))
    values = rng.normal(size=20)
    grid = np.linspace(time[0], time[-1] * rng.uniform(0.5, 1.0) + time[0] * 0.1, count)
    step = grid[1] - grid[0]
    for begin, mean in zip(grid, hold_means(time, values, grid), strict=True):
        end = min(begin + step, time[-1])
        inside = time[(time > begin) & (time < end)]
        edges = np.array([begin, *inside, end])
        held = values[np.searchsorted(time, edges[:-1], side="right") - 1]
        expected = held[0] if end - begin < 1e-6 * step else np.sum(held * np.diff(edges)) / (end - begin)
        assert mean == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("q", [2, 3, 7])
def test_a_coarser_grid_keeps_level_and_slow_motion_in_phase_and_folds_nothing(q: int) -> None:
    time = 5.0 + 0.01 * np.arange(4000)
    grid = time[::q][: 4000 // q]
    nyquist = 0.5 / (0.01 * q)
    middle = slice(len(grid) // 4, -len(grid) // 4)
    for share, gain in ((0.0, 1.0), (0.3, 1.0), (0.7, 1.0), (1.2, 0.0), (1.9, 0.0)):
        if share * nyquist >= 50.0:
            continue
        wave = np.cos(2 * np.pi * share * nyquist * (time - 5.0))
        found = coarser(time, wave, grid, cubic=True)
        assert len(found) == len(grid)
        expected = gain * np.cos(2 * np.pi * share * nyquist * (grid - 5.0))
        assert np.abs(found - expected)[middle].max() < 0.02


@pytest.mark.parametrize("duplicates", ["first", "last", "mean"])
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_of_doubled_rows_one_counts(duplicates: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.sort(np.concatenate([np.arange(60.0), rng.choice(60, 5, replace=False)]))
    values = rng.normal(size=(65, 2))
    notes: list[str] = []
    kept, chosen, rows = without_duplicates(time, time, values, TimeRules(duplicates=duplicates), notes)
    groups = [list(own) for _, own in itertools.groupby(range(65), key=lambda k: time[k])]
    of = {"first": lambda own: values[own[0]], "last": lambda own: values[own[-1]],
          "mean": lambda own: values[own].mean(axis=0)}[duplicates]  # fmt: skip
    assert kept.tolist() == list(range(60))
    assert chosen == pytest.approx(np.array([of(own) for own in groups]))
    assert rows.tolist() == [own[-1] if duplicates == "last" else own[0] for own in groups]
    assert notes == [
        f"5 rows repeat the time stamp of the row before: the {duplicates} counts; 5 of them have other readings"
    ]
    same, _, _ = without_duplicates(time, time, values, TimeRules(), [])
    assert same is time


def test_rows_of_one_signal_each_are_put_together_by_their_stamps() -> None:
    nan = np.nan
    time = np.array([0.0, 0.0, 1.0, 2.0, 2.0])
    values = np.array([[1.0, nan], [nan, 2.0], [3.0, nan], [nan, 4.0], [5.0, nan]])
    notes: list[str] = []
    stamps, whole, rows = complemented(time, values, notes)
    assert stamps.tolist() == [0.0, 1.0, 2.0]
    assert np.array_equal(whole, [[1.0, 2.0], [3.0, nan], [5.0, 4.0]], equal_nan=True)
    assert rows.tolist() == [0, 2, 3]
    assert notes == ["5 rows of 3 instants, none with a signal twice, are put together by their stamps"]
    twice = np.array([[1.0, nan], [9.0, 2.0], *values[2:]])
    assert complemented(time, twice, [])[0] is time


@pytest.mark.parametrize("tail", [2, 3, 9])
@pytest.mark.parametrize("zeros", [True, False])
def test_rows_that_were_never_written_to_are_left_out(tail: int, zeros: bool) -> None:
    time, values = 1.0 + np.arange(30.0), np.random.default_rng(0).normal(size=(30, 2))
    time = np.concatenate([time, np.full(tail, 0.0 if zeros else time[-1])])
    values = np.vstack([values, np.zeros((tail, 2)) if zeros else np.tile(values[-1], (tail, 1))])
    found = without_tail(time, values, notes := [])
    repeats = tail if zeros else tail + 1
    assert found == (30 if repeats >= 3 else 30 + tail)
    assert bool(notes) == (repeats >= 3)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([0.001, 0.0125, 0.04, 1 / 3, 2.0]), SEEDS, st.floats(0.0, 0.2))
def test_every_row_is_the_sample_of_its_clock_whatever_was_lost(dt: float, seed: int, jitter: float) -> None:
    rng = np.random.default_rng(seed)
    index = np.sort(rng.choice(160, 150, replace=False))
    index -= index[0]
    time = 100.0 + index * dt + jitter * dt * rng.uniform(-1, 1, 150)
    assert tracked(time, dt).tolist() == index.tolist()
    steady = 3.0 + dt * np.arange(50)
    assert sample_time_of(steady) == pytest.approx(dt, rel=1e-8)
    notes: list[str] = []
    found, rows = clock_of_rows(time, TimeRules(sample_time=dt), None, notes)
    assert found == pytest.approx(dt, rel=1e-9)
    assert rows is None or rows.tolist() == index.tolist()


@pytest.mark.parametrize("rate", [30, 60, 128, 300])
def test_stamps_of_whole_milliseconds_have_their_first_sample_at_a_multiple(rate: int) -> None:
    for first in (0, 7, 1234):
        true = (first + np.arange(80)) / rate
        stamps = np.round(true, 3)
        dt, index = clock_of_rows(stamps, TimeRules(), None, notes := [])
        if index is not None:
            assert dt == pytest.approx(1 / rate, rel=1e-9)
            assert index.tolist() == list(range(80))
            assert first_instant(stamps, index, dt) == pytest.approx(true[0], abs=1e-9)
            assert notes == [f"the time stamps are rounded to 0.001 s: a clock of {dt:g} s explains them all"]
        else:  # the stamps are exact
            assert stamps == pytest.approx(true)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_an_instant_between_two_readings_is_read_by_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 5.0, 8))
    grid = time[0] + np.arange(int(time[-1] - time[0])) * 1.0
    found = _between(time, grid)
    for k, instant in enumerate(grid):
        right = min(max(int(np.searchsorted(time, instant)), 1), len(time) - 1)
        near = right if time[right] - instant <= instant - time[right - 1] else right - 1
        others = [abs(other - time[near]) for other in grid if np.argmin(np.abs(time - other)) == near]
        wide = time[right] - time[right - 1] > 1.1
        assert found[k] == (wide and abs(instant - time[near]) > min(others) + 1e-12)


def test_a_trend_is_what_a_polynomial_takes_and_a_band_is_butterworth_s() -> None:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(size=(300, 2)), axis=0)
    t = np.arange(300.0)
    for trend, degree in (("constant", 0), ("linear", 1)):
        left = [column - np.polyval(np.polyfit(t, column, degree), t) for column in values.T]
        assert without_trend(values, trend) == pytest.approx(np.array(left).T)  # type: ignore[arg-type]
    assert without_trend(values, "none") is values
    for low, high, kind in ((None, 3.0, "lowpass"), (0.5, None, "highpass"), (0.5, 3.0, "bandpass")):
        edges = [edge for edge in (low, high) if edge is not None]
        found = filtered(values, FilterSection(low=low, high=high, order=2), 0.1)
        b, a = signal.butter(2, edges if len(edges) == 2 else edges[0], kind, fs=10.0)
        expected = signal.lfilter(b, a, values - values[0], axis=0) + (values[0] if kind == "lowpass" else 0.0)
        assert found == pytest.approx(expected, abs=1e-6)
    for low, high in ((3.0, 0.5), (5.0, None), (None, 0.0), (1.0, 1.0), (None, None)):
        with pytest.raises(InputError, match=r"half the sampling frequency \(5 Hz\)"):
            filtered(values, FilterSection(low=low, high=high), 0.1)


@pytest.mark.parametrize("ratio", [1000.0, 1e-3, 180 / np.pi, np.pi / 180])
@pytest.mark.parametrize(("off", "said"), [(1.0, True), (1.28, True), (0.72, True), (1.32, False), (0.68, False)])
def test_a_run_in_another_unit_is_said_within_a_third(ratio: float, off: float, said: bool) -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    wave = np.random.default_rng(0).normal(size=(50, 1))
    runs = [Run(Trajectory(np.arange(50.0), wave, wave * size, spec)) for size in (1.0, ratio * off)]
    found = units_between_runs(runs)
    assert len(found) == said
    if said:
        assert found[0].startswith(f"output y moves {ratio * off:.3g} times as much in run 1 as in run 0: ")
        assert ("1000" in found[0]) == (ratio in (1000.0, 1e-3))


def test_what_the_past_of_another_signal_explains() -> None:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=2000), np.zeros(2000)
    for k in range(1999):
        y[k + 1] = 0.8 * y[k] + u[k] + 0.5 * rng.normal()
    lags = range(1, 7)

    def error(goal: Any, *others: Any) -> float:
        table = np.column_stack([other[6 - lag : 2000 - lag] for other in others for lag in lags])
        return float(np.linalg.norm(goal[6:] - table @ np.linalg.lstsq(table, goal[6:])[0]))

    one, other = (y - y.mean()) / y.std(), (u - u.mean()) / u.std()
    assert _gain(y, u) == pytest.approx(error(one, one) / error(one, one, other), rel=1e-6)
    assert _gain(u, y) == pytest.approx(error(other, other) / error(other, other, one), rel=1e-6)
    assert _gain(np.ones(200), u[:200]) == _gain(u[:200], np.ones(200)) == 1.0


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=1, max_size=40))
def test_stretches_of_equal_samples(values: list[int]) -> None:
    starts, lengths = runs_of_equal(np.array(values, dtype=float))
    groups = [len(list(own)) for _, own in itertools.groupby(values)]
    assert lengths.tolist() == groups
    assert starts.tolist() == [0, *np.cumsum(groups)[:-1].tolist()]


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([1e-6, 0.25, 3.0, 2 * np.pi / 4096]), SEEDS)
def test_the_step_of_readings_is_that_of_their_encoder(step: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    y = step * np.round(np.cumsum(rng.integers(-3, 4, 300)))
    assert step_of(y) == pytest.approx(step)
    assert coarse_step(y) in (0.0, pytest.approx(step))
    assert step_of(rng.normal(size=300)) == 0.0
    every = int(rng.integers(2, 20))
    held = np.repeat(rng.normal(size=40), every)
    assert rhythm_of(held) == every
    found = held_readings(np.repeat(np.cumsum(rng.normal(size=60)), every), np.zeros((60 * every, 0)))
    assert found is not None
    assert found.every == every
    assert np.flatnonzero(found.fresh).tolist() == list(range(0, 60 * every, every))


def test_a_line_is_the_share_of_variance_that_it_explains() -> None:
    t = np.arange(400.0)
    for slope in (0.0, 0.01, 0.05, 1.0):
        y = slope * t + 3 * np.sin(t)
        share = np.corrcoef(t, y)[0, 1] ** 2
        assert trend_of(y, np.zeros((400, 0))) == (pytest.approx(share) if share >= 0.5 else 0.0)
    line = 0.1 * t
    noise = (-1.0) ** t
    assert trend_of(line, noise[:, None]) > 0.9
    assert trend_of(line, np.column_stack([noise, -line + 7.0])) == 0.0
    assert trend_of(line, np.ones((400, 1))) == 0.0  # what integrates a constant


@pytest.mark.parametrize("share", [0.02, 0.1, 0.4])
def test_the_band_of_a_motion_holds_all_but_a_hundredth_of_it(share: float) -> None:
    rng = np.random.default_rng(0)
    b, a = signal.butter(8, share)
    y = signal.lfilter(b, a, rng.normal(size=20_000))
    assert band_of(y) == pytest.approx(share, rel=0.15, abs=0.004)
    assert band_of(y + 0.05 * y.std() * rng.normal(size=20_000)) == pytest.approx(share, rel=0.2, abs=0.004)
    assert band_of(np.zeros(300)) == 0.0


def test_a_prediction_is_the_least_squares_of_its_past_and_its_inputs() -> None:
    rng = np.random.default_rng(0)
    n = 800
    u, y = rng.normal(size=(n, 1)), np.zeros(n)
    for k in range(2, n):
        y[k] = 1.5 * y[k - 1] - 0.8 * y[k - 2] + 0.4 * u[k, 0] + 0.2 * u[k - 1, 0] + 0.05 * rng.normal()
    found = foretold(5.0 + y, u)
    order = len(found.own)
    assert order == 8
    table = np.column_stack(
        [*(y[order - i : n - i] for i in range(1, order + 1)), *(u[order - j : n - j, 0] for j in range(order + 1)),
         np.ones(n - order)]
    )  # fmt: skip
    theta = np.linalg.lstsq(table, y[order:])[0]
    assert found.own == pytest.approx(theta[:order], abs=0.02)
    assert found.other[:, 0] == pytest.approx(theta[order:-1], abs=0.02)
    assert found.error[order:] == pytest.approx(y[order:] - table @ theta, abs=0.03)
    assert (found.error[:order] == 0).all()
    assert np.median(found.scale) == pytest.approx(0.05, rel=0.15)
    assert found.pattern.tolist() == [1.0, *(-found.own).tolist()]
    change = rng.normal(size=(n, 1))
    answer = [sum(found.other[j, 0] * change[k - j, 0] for j in range(order + 1) if k >= j) for k in range(30)]
    assert found.answer(change)[:30] == pytest.approx(answer)
    size, sure = _sizes(found)
    for row in (50, 400, n - 3):
        seen = found.error[row : row + order + 1]
        pattern = found.pattern[: len(seen)]
        expected = pattern @ seen / (found.pattern @ found.pattern)
        assert size[row] == pytest.approx(expected)
        assert sure[row] == pytest.approx(abs(expected) * np.linalg.norm(found.pattern) / found.scale[row])
    assert (size[:order] == 0).all()
    assert size[-1] == 0


def test_a_value_that_odd_rows_share_is_a_word_where_chance_would_not_have_it() -> None:
    rng = np.random.default_rng(0)
    y = rng.integers(0, 50, 400) + 0.5
    for count in (2, 3, 4, 5):
        rows = np.array([10, 20, 30, 40, 50])
        y[rows] = [7.5] * count + [100.25 + k for k in range(5 - count)]
        others = np.delete(y, rows)
        values, often = np.unique(others, return_counts=True)
        chance = len(values) * stats.binom.sf(count - 1, 5, often[values == 7.5][0] / len(others))
        groups = {value: own.tolist() for value, own in alike(y, rows)}
        assert (7.5 in groups) == (chance < 0.01)
        assert sorted(itertools.chain(*groups.values())) == rows.tolist()
    assert [is_word(value) for value in (0.0, -1.0, 999.0, -9999.0, 99.9, 99.0, 1.0, 990.0)] == [
        True, True, True, True, True, False, False, False
    ]  # fmt: skip


@pytest.mark.parametrize("size", [0.0, 0.02, 0.3])
def test_a_leap_is_the_difference_of_two_parabolas_at_the_row_before_which_it_is(size: float) -> None:
    t = np.arange(300.0)
    y = np.sin(0.03 * t) + 1e-3 * np.random.default_rng(0).normal(size=300)
    y[140:] += size
    rows, sizes = leaps_of(y)
    place = np.arange(8) - 7.5
    there = np.polyval(np.polyfit(place, y[132:140], 2), 0.0), np.polyval(np.polyfit(-place[::-1], y[140:148], 2), 0.0)
    if size == 0.3:
        assert rows.tolist() == [140]
        assert sizes[0] == pytest.approx(there[1] - there[0])
    else:
        assert rows.size == 0
    assert leaps_of(y, step=0.2)[0].size == 0
    assert leaps_of(y[:99])[0].size == 0


def test_two_records_of_two_models_are_told_by_chows_test() -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)

    def record(pole: float, seed: int) -> Run:
        rng = np.random.default_rng(seed)
        u, y = rng.normal(size=(600, 1)), np.zeros((600, 1))
        for k in range(599):
            y[k + 1] = pole * y[k] + u[k] + 0.1 * rng.normal()
        return Run(Trajectory(np.arange(600.0), u, y, spec))

    assert mismatched([record(0.5, 1), record(0.5, 2)]) == []
    (found,) = mismatched([record(0.5, 1), record(0.5, 3), record(0.8, 2)])
    assert (found.run, found.channel, found.kind) == (2, "y", "mismatch")
    assert found.words.startswith("y does not move as in run 0: one linear model for both errs ")


@pytest.mark.parametrize("cubic", [False, True])
def test_signals_with_clocks_of_their_own_meet_on_one_grid(cubic: bool) -> None:
    sensor, command = 1.0 + 0.5 * np.arange(60), np.array([0.2, 3.3, 9.1])
    values = np.sin(0.3 * sensor)
    keep = (sensor < 10.0) | (sensor > 13.0)
    rules = TimeRules(resample=ResampleSection(sample_time=0.5, method="cubic" if cubic else "linear", max_gap=2.0))
    notes: list[str] = []
    grid, table = merged(
        [command, sensor[keep] + 0.1], [np.array([1.0, -1.0, 4.0]), values[keep]], names=["u", "y"],
        inputs=[True, False], rules=rules, notes=notes,
    )  # fmt: skip
    assert grid == pytest.approx(1.1 + 0.5 * np.arange(60))
    for begin, mean in zip(grid, table[:, 0], strict=True):
        spans = [(0.2, 3.3, 1.0), (3.3, 9.1, -1.0), (9.1, 99.0, 4.0)]
        area = sum(max(min(last, begin + 0.5) - max(first, begin), 0.0) * level for first, last, level in spans)
        assert mean == pytest.approx(area / 0.5)
    silent = (grid > 9.6 + 1e-6) & (grid < 13.6 - 1e-6)
    assert np.isnan(table[silent, 1]).all()
    assert table[~silent, 1] == pytest.approx(np.sin(0.3 * (grid[~silent] - 0.1)), abs=1e-9)
    assert notes == [
        f"put on one grid of 0.5 s, 60 samples from 1.1 s: u held from the stamps on, y interpolated "
        f"({'cubic' if cubic else 'linear'}); their own clocks: u every 4.45 s, y every 0.5 s"
    ]
    for clocks, says in (
        ([command, np.array([1.0, 1.0, 2.0])], "message 1"),
        ([command, command + 50.0], "do not overlap"),
    ):
        with pytest.raises(InputError, match=says):
            merged(clocks, [command, command], names=["u", "y"], inputs=[False, False], rules=rules, notes=[])
    there = np.array([[1.0, np.nan], [np.nan, 2.0], [3.0, np.nan]])
    found = in_turn(np.arange(3.0), there)
    assert found is not None
    assert [one.tolist() for one in (*found[0], *found[1])] == [[0.0, 2.0], [1.0], [1.0, 3.0], [2.0]]
    assert in_turn(np.arange(3.0), np.ones((3, 2))) is None


STYLES = {"plain": "{}", "comma": "{:.3f}", "german": "{:,.2f}", "english": "{:,.2f}", "swiss": "{:,.1f}"}


@pytest.mark.parametrize("style", STYLES)
@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(-1e7, 1e7), min_size=3, max_size=12))
def test_numbers_are_read_as_every_country_writes_them(style: str, values: list[float]) -> None:
    digits = {"comma": 3, "german": 2, "english": 2, "swiss": 1}.get(style)
    numbers = [value if digits is None else round(value, digits) for value in [*values, 1234567.5]]
    cells = [STYLES[style].format(number) for number in numbers]
    swap = {"comma": {".": ","}, "german": {",": ".", ".": ","}, "swiss": {",": "'"}}.get(style, {})
    cells = ["".join(swap.get(sign, sign) for sign in cell) for cell in cells]
    cells.insert(1, "n/a")
    found = numbers_of(cells, str)
    assert np.isnan(found[1])
    assert np.delete(found, 1) == pytest.approx(numbers, abs=1e-9)


def test_points_that_may_stand_between_thousands_are_refused_from_three_on() -> None:
    for cells, refused in (
        (["1.234", "5.678", "9.012", "12"], True), (["1.234", "5.678", "12"], False),
        (["1.234", "5.678", "9.012"], False), (["1.234", "5.678", "9.01", "12"], False),
        (["1.234", "5.678", "9.012", "1234"], False), (["1.234", "5.678", "9.012", "", "nan"], False),
    ):  # fmt: skip
        if refused:
            with pytest.raises(InputError, match="two readings"):
                refuse_thousands(cells, str)
        else:
            refuse_thousands(cells, str)
    with pytest.raises(InputError, match="two readings"):
        refuse_thousands(["1.234", "5.678", "9.012"], str, commas=True)


def test_cells_with_units_are_brought_to_one() -> None:
    found = measured(["1 kV", "2.5 V", "", "-3 mV"], "u", str, notes := [])
    assert found is not None
    assert found[0] == pytest.approx([1.0, 2.5e-3, np.nan, -3e-6], nan_ok=True)
    assert found[1] == "kV"
    assert notes == ["u: units stand in the cells (kV, V, mV): they are read in kV"]
    assert measured(["1 kV", "2"], "u", str) is None
    assert measured(["1 kV", "2 m"], "u", str) is None
    with pytest.raises(InputError, match="'A' in the title, 'V' in its cells"):
        measured(["1 V"], "u [A]", str)
    assert units_below(["t", "u"], ["s", ""]) == ["t [s]", "u"]
    assert units_below(["t", "u"], ["1", "1"]) is None
    assert units_below(["t [s]", "u"], ["s", "V"]) == ["t [s]", "u [V]"]
    assert units_below(["t"], ["s", "V"]) is None
    with pytest.raises(InputError, match="'s' in the title, 'ms' in the row below"):
        units_below(["t [s]", "u"], ["ms", "V"])


def test_a_packed_file_may_unpack_to_two_hundred_times_its_size_and_no_more_than_two_gib(tmp_path: Any) -> None:
    for packed in (0, 1000, 1_000_000, 10_000_000, 100_000_000):
        assert most_unpacked(packed) == min(2 * 1024**3, 200 * packed + 16 * 1024**2)
    refuse_large(tmp_path, 2 * 1024**3)
    with pytest.raises(InputError, match="at most 2048 MiB unpacked, got 2050 MiB"):
        refuse_large(tmp_path, 2 * 1024**3 + 2 * 1024**2)


@settings(max_examples=25, deadline=None)
@given(st.dates(datetime.date(1971, 1, 1), datetime.date(2090, 12, 31)), st.times())
def test_a_date_means_the_same_in_every_form(day: datetime.date, when: datetime.time) -> None:
    when = when.replace(microsecond=0)
    year, week, weekday = day.isocalendar()
    number = day.timetuple().tm_yday
    iso = f"{day:%Y-%m-%d} {when:%H:%M:%S}"
    forms = [
        f"{year}-W{week:02d}-{weekday} {when:%H:%M:%S}", f"{day.year}-{number:03d} {when:%H:%M:%S}",
        f"{day.year}-{day.month}-{day.day} {when:%H:%M:%S}",
    ]  # fmt: skip
    for text in forms:
        assert plain_time(text) == iso
    assert span_of(f"{number} days {when:%H:%M:%S}.250000") == pytest.approx(
        86400 * number + 3600 * when.hour + 60 * when.minute + when.second + 0.25
    )
    assert span_of(f"-1 days +{when:%H:%M:%S}") == pytest.approx(
        -86400 + 3600 * when.hour + 60 * when.minute + when.second
    )
    assert minutes_of(f"{when.minute:02d}:{when.second:02d}.5") == 60 * when.minute + when.second + 0.5
    assert dated([f"{day:%Y%m%d}{when:%H%M%S}.5"]) in (None, [f"{day:%Y%m%d}T{when:%H%M%S}.5"])


def test_stamps_are_seconds_from_the_first_over_midnight_and_over_a_year() -> None:
    for cells, seconds in (
        (["2023-12-31 23:59:59.5", "2024-01-01 00:00:00", "2024-01-01 00:00:01.25"], [0.0, 0.5, 1.75]),
        (["31.12.2023 23:59:00", "01.01.2024 00:01:00"], [0.0, 120.0]),
        (["2024-02-28T12:00:00Z", "2024-03-01T12:00:00Z"], [0.0, 2 * 86400.0]),
        (["11:59:59 AM", "12:00:01 PM", "01:00:00 PM"], [0.0, 2.0, 3601.0]),
        (["23:59:58", "23:59:59", "00:00:01"], [0.0, 1.0, 3.0]),
        (["2024-01-01T00:00:00+02:00", "2024-01-01T00:00:00+01:00"], [0.0, 3600.0]),
    ):
        found = clock(cells, [], str)
        assert found is not None
        assert found - found[0] == pytest.approx(seconds)
    assert ahead_of_utc(["+02:30", "-01:15", "Z"], np.zeros(3, dtype=np.int64), dated=False).tolist() == [
        9000,
        -4500,
        0,
    ]


@pytest.mark.parametrize("bits", [8, 16, 20, 32])
def test_a_counter_goes_on_where_it_was_full(bits: int) -> None:
    true = 200.0 + 7.0 * np.arange(120)
    begin = 2.0**bits - 400.0 if bits > 8 else 0.0
    counts = (begin + true) % 2.0**bits
    stamps, period, times = unwrapped(counts)
    assert (stamps - stamps[0]).tolist() == (true - true[0]).tolist()
    assert (period, times) == (2.0**bits, int(np.sum(np.diff(counts) < 0)))
    half = (43100.0 + 5.0 * np.arange(60)) % 43200.0
    assert np.diff(unwrapped(half, of_day=True)[0]).tolist() == [5.0] * 59


def test_titles_say_their_clock_and_their_units() -> None:
    assert clock_of(["Time", "Zeit (ms)", "u"]) == "Time"
    assert clock_of(["Time [s]", "time [s]"]) == "time [s]"
    assert clock_of(["T", "timestamp"]) == "T"
    assert clock_of(["u", "Timestamp", "y"]) == "Timestamp"
    assert clock_of(["u", "ms"]) == "ms"
    assert clock_of(["X_Value [s]", "u"]) == "X_Value [s]"
    assert clock_of(["time", "u"], ["time"]) is None
    with pytest.raises(InputError, match="2 columns may be the time"):
        clock_of(["Zeit", "Uhrzeit"])
    assert [clock_unit(title) for title in ("time 12", "Zeit [min]", "t (us)")] == [None, "min", "us"]
    for title in ("time 123", "time [V]", "t ms us", "time ticks"):
        with pytest.raises(InputError):
            clock_unit(title)
    assert [split_header(title) for title in ("a [1]", "a [2]", "a []", "u/[V]", "a (x)")] == [
        ("a", "1"), ("a [2]", None), ("a", "1"), ("u", "V"), ("a (x)", None)
    ]  # fmt: skip


def test_headers_of_several_rows() -> None:
    body = ["0", "1", "2"]
    assert stacked_titles([["a", "b", "c"], body]) is None
    assert stacked_titles([["", "arm", "leg"], ["t", "p", "v"], ["s", "m", "m/s"], body]) == (
        ["t [s]", "p [m]", "v [m/s]"], 3
    )  # fmt: skip
    assert stacked_titles([["", "arm", "leg"], ["t", "p", "p"], body]) == (["t", "arm.p", "leg.p"], 2)
    assert stacked_titles([["", "arm", "leg"], ["t", "p", "p"], ["x", "y", "word"], ["1", "word", "z"]]) is None
    assert stacked_titles([["a", "b", "c"], ["d", "e", "f"], body]) is None  # nobody can say which are the names
    assert stacked_titles([["a"], ["b"], ["0"]]) is None
    assert stacked_titles([["", "arm", "leg"], ["t", "p", "v"], ["0", "1", ""]]) == (["t", "p", "v"], 2)


@pytest.mark.parametrize("count", [2, 6, 7])
@pytest.mark.parametrize("aligned", [True, False])
def test_a_table_of_names_and_values_has_a_column_for_each_name(count: int, aligned: bool) -> None:
    names = [f"s{k}" for k in range(count)]
    rows = [
        (t + (0.0 if aligned else 0.01 * k), name, 10.0 * k + t)
        for t in np.arange(25.0)
        for k, name in enumerate(names)
    ]
    cells = {"name": [row[1] for row in rows], "value": [str(row[2]) for row in rows],
             "time": [f"{row[0]} s" for row in rows], "unit": [f"u{row[1]}" for row in rows]}  # fmt: skip
    source = SimpleNamespace(
        titles=["time", "name", "value", "unit"], notes=["before"], where=lambda row: f"line {row + 2}",
        texts=lambda title, most=None: cells[title][:most],
    )  # fmt: skip
    found = in_long_form(source)
    assert found is not None
    assert found.titles == ["time", *names]
    stamps = found.values("time")
    assert len(stamps) == (25 if aligned else 25 * count)
    for k, name in enumerate(names):
        column = found.values(name)
        there = np.isfinite(column)
        assert column[there] == pytest.approx(10.0 * k + np.arange(25.0))
        assert stamps[there] == pytest.approx(np.arange(25.0) + (0.0 if aligned else 0.01 * k))
        assert found.unit(name) == f"u{name}"
    assert found.unit("time") == "s"
    assert found.where(1) == (f"line {count + 2}" if aligned else "line 3")
    shown = ", ".join(names[:6]) + (" ..." if count > 6 else "")
    assert found.notes == [
        "before",
        "time: units stand in the cells (s)",
        f"'name' names the signal of each row, 'value' its reading: {shown} are columns",
    ]
    assert (
        in_long_form(SimpleNamespace(**{**vars(source), "texts": lambda title, most=None: ["a"] * 19 + ["b"] * 30}))
        is None
    )
    assert in_long_form(SimpleNamespace(**{**vars(source), "texts": lambda title, most=None: ["a"] * 60})) is None
