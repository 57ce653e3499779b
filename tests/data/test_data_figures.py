"""What is said of a record, in figures that can be worked out by hand; and the edges from which it is said."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from harness.data.conditioning.decimation import filtered, hold_means
from harness.data.conditioning.suspicion import swapped_runs, units_between_runs
from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.oddities.between import mismatched
from harness.data.oddities.held import held_readings, stuck_rows
from harness.data.oddities.levels import coarse_step, saturated, stuck
from harness.data.oddities.spikes import alike, spikes_of
from harness.data.recipe.sanity import check_run
from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec, Run, Trajectory

THETA = Channel("theta", "rad")
SPEC = PlantSpec((Channel("u", "N m"),), (THETA,), 0.01)


def evenly(n: int, step: float, first: float = 0.0) -> FloatArray:
    return np.asarray(first + step * np.arange(n), dtype=np.float64)


def record(u: FloatArray, y: FloatArray, spec: PlantSpec = SPEC) -> Trajectory:
    return Trajectory(evenly(len(u), spec.sample_time), u.reshape(len(u), -1), y.reshape(len(u), -1), spec)


def ran(u: FloatArray, y: FloatArray, use: str = "estimation") -> Run:
    return Run(record(u, y), use, "")  # type: ignore[arg-type]


def slow(n: int, rng: np.random.Generator) -> FloatArray:
    return np.asarray(np.cumsum(np.convolve(rng.standard_normal(n), np.ones(9) / 9, mode="same")) * 0.01)


# ---- grids ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cubic", [False, True])
@pytest.mark.parametrize(("cycles", "gain"), [(0.5, 1.0), (2.0, 1.0), (9.0, 0.0), (14.0, 0.0), (20.0, 0.0)])
def test_what_a_coarser_grid_keeps_of_a_sine(cycles: float, gain: float, cubic: bool) -> None:
    """Of 100 Hz on 10 Hz: up to a good part of 5 Hz stays as it is, and nothing above folds into it."""
    time, grid = evenly(4001, 0.01), evenly(401, 0.1)
    found = filtered(time, np.sin(2 * np.pi * cycles * time), grid, cubic=cubic)[50:-50]
    assert found == pytest.approx(gain * np.sin(2 * np.pi * cycles * grid[50:-50]), abs=0.02)


def test_a_held_input_keeps_its_impulse() -> None:
    time = np.cumsum(np.random.default_rng(3).uniform(0.005, 0.02, 400))
    values = np.random.default_rng(4).normal(size=400)
    grid = np.arange(time[0], time[-1], 0.07)[:-1]
    means = hold_means(time, values, grid)
    fine = np.arange(grid[0], grid[-1] + 0.07, 1e-5) + 5e-6
    held = values[np.searchsorted(time, fine, side="right") - 1]
    assert means * 0.07 == pytest.approx([held[(fine > a) & (fine < a + 0.07)].sum() * 1e-5 for a in grid], abs=1e-4)


def test_steps_without_a_unit_are_shown_in_each() -> None:
    with pytest.raises(InputError, match=re.escape("1e+04 s in s, 10 s in ms, 0.01 s in us, 1e-05 s in ns")):
        refuse_unlikely_seconds(evenly(9, 1e4), "t")
    refuse_unlikely_seconds(evenly(9, 0.999), "t")
    with pytest.raises(InputError, match="states no unit"):
        refuse_unlikely_seconds(evenly(9, 1.0), "t")
    for epoch in (36525.0, 69808.0, 730485.0, 748750.0, 2451543.5, 2469808.5):  # outside of the days of this century
        refuse_unlikely_seconds(evenly(200, 1e-5 / 0.864, epoch), "t")


# ---- words, rests and steps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("value", "word"), [
    (0.0, True), (-1.0, True), (999.0, True), (-9999.0, True), (99.99, True), (1.0, False), (99.0, False),
    (998.0, False), (100.0, False), (-0.5, False),
])  # fmt: skip
def test_values_that_stand_for_nothing(value: float, word: bool) -> None:
    y = np.random.default_rng(1).normal(3.0, 0.1, 200)
    y[77] = value
    assert [found for found, _ in alike(y, np.array([77]))] == [value if word else None]


def test_odd_rows_of_one_value_are_a_word_unless_ordinary_rows_read_it_too() -> None:
    y = np.round(np.random.default_rng(1).normal(0.0, 0.3, 2000), 1)
    y[[100, 900, 1500]] = 7.25
    assert [(value, rows.tolist()) for value, rows in alike(y, np.array([100, 900, 1500]))] == [
        (7.25, [100, 900, 1500])
    ]
    y[[100, 900, 1500]] = 0.1
    assert [value for value, _ in alike(y, np.array([100, 900, 1500]))] == [None]


@pytest.mark.parametrize(("rests", "found"), [(20, True), (10, True), (9, False)])
def test_a_sensor_that_stands_still_on_its_way_from_ten_rows_on(rests: int, found: bool) -> None:
    y = slow(500, np.random.default_rng(2))
    y[200 : 200 + rests] = y[199] + 1e-6
    assert stuck_rows(y) == ([(200, rests)] if found else [])
    said = stuck(THETA, y, 0.01)
    assert len(said) == found
    if found:
        where = f"at {y[200]:g} rad for {rests} samples from sample 200 ({0.01 * rests:g} s)"
        assert f"{where} while elsewhere it does not for more than 1" in said[0]


def test_rest_before_and_after_the_motion_is_no_stuck_sensor() -> None:
    y = slow(500, np.random.default_rng(2))
    assert stuck_rows(np.r_[np.full(100, y[0]), y]) == []
    assert stuck_rows(np.r_[y, np.full(100, y[-1])]) == []


STRETCHES = [(150, 25), (400, 25), (700, 60), (900, 200)]


@pytest.mark.parametrize("friction", [2.0, 4.0, 6.0])
def test_a_joint_that_rests_at_its_turns_is_no_stuck_sensor(friction: float) -> None:
    rng, u = np.random.default_rng(3), 12.0 * np.sin(2 * np.pi * np.arange(8000) / 800)
    holds = np.repeat(friction * rng.uniform(0.6, 1.4, size=20), 400)  # dry friction is not the same at every turn
    moving = np.maximum(np.abs(u) - holds, 0.0)
    speed = np.round(np.sign(u) * moving * 20.0 + rng.normal(size=8000) * (moving > 0.0))
    assert stuck_rows(speed) == []


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_stuck_stretches_of_any_lengths_do_not_hide_each_other(noise: float) -> None:
    rng = np.random.default_rng(3)
    y = slow(1500, rng) + noise * rng.standard_normal(1500)
    for first, length in [*STRETCHES, (300, 9)]:  # the last is too short to be told, and hides none
        y[first : first + length] = y[first]
    assert stuck_rows(y) == STRETCHES
    assert "stands still in 4 places for 25 to 200 samples, first at" in stuck(THETA, y, 0.01)[0]


def test_several_rests_that_are_no_fault() -> None:
    """A coarse encoder at rest between motions, a plant that settles between steps, one that follows them at once."""
    time = np.arange(1500)
    moving = np.sin(0.02 * time) * (np.sin(0.003 * time) > 0.2)  # at rest for hundreds of rows, then off again
    for step in (0.01, 0.05, 0.3):
        assert stuck_rows(np.round(moving / step) * step) == []
    steps = np.repeat(np.random.default_rng(4).normal(size=10), 150)
    for pole in (0.0, 0.3, 0.8):
        assert stuck_rows(lfilter([1 - pole], [1, -pole], steps)) == []


def test_a_rail_is_said_with_its_rows_and_places() -> None:
    time = np.arange(2000) * 0.01
    y = np.sin(2 * np.pi * 0.5 * time)
    cut = np.minimum(y, 0.8)
    places = int((np.diff((cut == 0.8).astype(int)) == 1).sum())
    (limit, said), *more = saturated(THETA, cut).items()
    assert (limit, more) == (0.8, [])
    assert f"at its largest value 0.8 rad for {int((cut == 0.8).sum())} samples in {places} places" in said
    low = saturated(THETA, np.maximum(-y, -0.8))
    assert list(low) == [-0.8]
    assert "smallest value -0.8" in low[-0.8]
    assert saturated(THETA, y) == {}


@pytest.mark.parametrize("step", [0.01, 0.002])
def test_the_step_of_an_encoder(step: float) -> None:
    y = np.sin(0.02 * np.arange(3000.0)) * 0.1
    assert coarse_step(np.round(y / step) * step) == pytest.approx(step, rel=1e-9)
    assert coarse_step(y) == 0.0


@pytest.mark.parametrize(("every", "phase"), [(2, 0), (3, 1), (7, 4)])
def test_readings_of_a_slow_sensor_are_fresh_in_its_rhythm(every: int, phase: int) -> None:
    y = slow(900, np.random.default_rng(5))
    place = np.arange(900)
    held = y[np.maximum(place - (place - phase) % every, 0)]
    found = held_readings(held, np.zeros((900, 0)))
    assert found is not None
    assert found.every == every
    assert np.flatnonzero(found.fresh)[1:].tolist() == [k for k in range(1, 900) if k % every == phase]


@pytest.mark.parametrize("rows", [[20], [300, 304], [590]])
def test_spikes_are_put_back_to_what_their_neighbours_foretell(rows: list[int]) -> None:
    rng = np.random.default_rng(6)
    truth = np.sin(0.05 * np.arange(600.0))
    y = truth + 1e-3 * rng.standard_normal(600)
    y[rows] += 0.4
    found = spikes_of(y, np.zeros((600, 0)))
    assert found.rows.tolist() == rows
    assert np.abs(found.mended - truth).max() < 0.02
    kept = np.setdiff1d(np.arange(600), rows)
    assert (found.mended[kept] == y[kept]).all()


def test_the_last_reading_is_not_judged() -> None:
    y = np.sin(0.05 * np.arange(600.0)) + 1e-3 * np.random.default_rng(6).standard_normal(600)
    y[-1] += 0.4
    assert not spikes_of(y, np.zeros((600, 0))).rows.size


# ---- runs beside each other ------------------------------------------------------------------------------------------


def answered(u: FloatArray, gain: float, rng: np.random.Generator) -> FloatArray:
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.9 * y[k - 1] + gain * u[k - 1] + 0.01 * rng.standard_normal()
    return y


def test_runs_that_follow_two_models_are_said_with_the_factor() -> None:
    rng = np.random.default_rng(7)
    u = [rng.standard_normal(500) for _ in range(3)]
    same = [ran(x, answered(x, 0.1, rng)) for x in u]
    assert mismatched(same) == []
    (odd,) = mismatched([same[0], same[1], ran(u[2], answered(u[2], 0.12, rng))])
    assert (odd.kind, odd.run, odd.channel) == ("mismatch", 2, "theta")
    # one gain between the two: each errs by half of what they differ in, 0.01, beside the noise of 0.01
    factor = float(re.search(r"errs ([\d.]+) times", odd.words)[1])  # type: ignore[index]
    assert factor == pytest.approx(2**0.5, rel=0.06)
    assert mismatched([same[0], ran(u[2], answered(u[2], 0.12, rng), "validation")]) == []  # of another use


@pytest.mark.parametrize(("ratio", "text"), [
    (1000.0, "1000"), (1e-3, "1000"), (57.3, "degrees for radians"), (1 / 57.3, "degrees for radians"),
    (1280.0, "1000"), (720.0, "1000"), (1320.0, ""), (680.0, ""), (10.0, ""), (1.0, ""),
])  # fmt: skip
def test_a_unit_that_changes_from_run_to_run(ratio: float, text: str) -> None:
    rng = np.random.default_rng(8)
    u, y = rng.standard_normal(200), slow(200, rng)
    said = units_between_runs([ran(u, y), ran(u, ratio * y)])
    assert len(said) == bool(text)
    assert not text or (text in said[0] and f"moves {ratio:.3g} times as much in run 1 as in run 0" in said[0])
    assert units_between_runs([ran(u, y), ran(u, ratio * y)], records=[0, 0]) == []  # pieces of one record


def test_columns_that_change_places_from_run_to_run() -> None:
    rng = np.random.default_rng(9)
    spec = PlantSpec((Channel("u", "N m"),), (THETA, Channel("w", "rad/s")), 0.01)
    u, small, large = rng.standard_normal(200), 0.01 * rng.standard_normal(200), rng.standard_normal(200)
    first, second = (record(u, np.column_stack(pair), spec) for pair in ((small, large), (large, small)))
    runs = [Run(first, "estimation", ""), Run(second, "estimation", "")]
    said = [note for note in swapped_runs(runs) if "theta and w" in note]
    assert len(said) == 1
    assert "in run 1" in said[0]
    assert swapped_runs([runs[0], runs[0]]) == []


def test_an_angle_that_moves_by_turns_names_the_unit_that_it_may_have() -> None:
    rng = np.random.default_rng(10)
    y = np.cumsum(rng.uniform(-20, 20, 300))
    largest = np.abs(np.diff(y)).max()
    with pytest.raises(InputError, match=re.escape(f"deg (steps up to {largest * np.pi / 180:.2g} rad then)")):
        check_run(record(rng.standard_normal(300), y), (("theta", 0),))
    check_run(record(rng.standard_normal(49), y[:49]), (("theta", 0),))  # too short to say


def test_a_range_that_is_left_is_said_with_both_ends() -> None:
    rng = np.random.default_rng(11)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad", minimum=-0.5, maximum=0.25),), 0.01)
    y = np.clip(slow(300, rng), -0.5, 0.25)
    y[:2] = -0.5, 0.25
    assert not any(
        "declared range" in note for note in check_run(record(rng.standard_normal(300), y, spec), (("theta", 0),))
    )
    y[5] = 0.2500001
    (said,) = [
        note
        for note in check_run(record(rng.standard_normal(300), y, spec), (("theta", 0),))
        if "declared range" in note
    ]
    assert "[-0.5, 0.25] rad: -0.5 to 0.25" in said
