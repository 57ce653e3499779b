"""Time axes: uniform ones pass, the others are refused, split or resampled as declared, and it is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import made_data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.data import load_dataset
from harness.data.conditioning.clock import sample_time_of
from harness.data.sections import ResampleSection
from harness.errors import InputError

DT = 0.01
TIME = 5.0 + np.arange(200) * DT
STILL = np.column_stack([np.ones(200), np.sin(3 * TIME)])
VALUES = np.column_stack([np.repeat(np.arange(40.0), 5), np.sin(3 * TIME)])


def pieces(time: np.ndarray | None, values: np.ndarray = VALUES, **rules: object) -> tuple[list, list[str]]:
    return made_data.pieces(time, values, **rules)


def test_a_uniform_axis_passes_unchanged_and_unmentioned() -> None:
    (piece,), notes = pieces(TIME)
    assert notes == []
    assert (piece.start, piece.sample_time) == (5.0, pytest.approx(DT, rel=1e-9))
    assert np.array_equal(piece.values, VALUES)
    (piece,), notes = pieces(None, sample_time=DT)
    assert (piece.start, piece.sample_time, notes) == (0.0, DT, [])


def test_jitter_is_said_or_refused() -> None:
    noise = np.random.default_rng(0).uniform(-1, 1, 200)
    _, notes = pieces(TIME + 1e-5 * DT * noise)
    assert notes == []
    _, notes = pieces(TIME + 1e-2 * DT * noise)
    assert any("clock jitter" in note for note in notes)
    with pytest.raises(InputError, match=r"clock jitter.*\[resample\]"):
        pieces(TIME + 0.2 * DT * noise)


def test_a_gap_is_refused_split_or_bridged() -> None:
    keep = np.r_[0:80, 95:150, 153:200]
    time, values = TIME[keep], STILL[keep]
    with pytest.raises(InputError, match=r"row 80: time is not uniform \(2 gaps\).*gaps = \"split\""):
        pieces(time, values)
    parts, notes = pieces(time, values, gaps="split")
    assert [len(part.values) for part in parts] == [80, 55, 47]
    assert [part.start for part in parts] == pytest.approx([TIME[0], TIME[95], TIME[153]])
    assert np.array_equal(parts[1].values, STILL[95:150])
    assert any("3 pieces" in note for note in notes)
    with pytest.raises(InputError, match="a gap too long"):
        pieces(time, values, resample=ResampleSection())
    (whole,), notes = pieces(time, values, resample=ResampleSection(max_gap=1.0, method="cubic"))
    assert len(whole.values) == 200
    assert whole.values[:, 1] == pytest.approx(STILL[:, 1], abs=5e-4)
    assert any("182 rows" in note and "200 samples" in note for note in notes)
    parts, _ = pieces(time, values, resample=ResampleSection(), gaps="split")
    assert [len(part.values) for part in parts] == [80, 105]


def test_a_held_input_that_changed_in_a_gap_is_not_made_up() -> None:
    """The remedies that the refusal names are tried: each gives the input of every row that there is, or lines."""
    keep = np.r_[0:80, 95:150, 153:200]
    time, values = TIME[keep], VALUES[keep]
    with pytest.raises(InputError, match=r"held input changes in 2 holes.*gaps = \"split\".*intersample"):
        pieces(time, values, resample=ResampleSection(max_gap=1.0))
    for resample in (None, ResampleSection(), ResampleSection(max_gap=1.0)):
        parts, _ = pieces(time, values, gaps="split", resample=resample)
        starts = [np.argmin(np.abs(TIME - part.start)) for part in parts]
        assert [len(part.values) for part in parts] == [80, 55, 47]
        for part, start in zip(parts, starts, strict=True):
            assert np.array_equal(part.values[:, 0], VALUES[start : start + len(part.values), 0])
    (whole,), _ = pieces(time, values, intersample="foh", resample=ResampleSection(max_gap=1.0))
    assert len(whole.values) == 200


@pytest.mark.parametrize("rate", [60.0, 120.0, 240.0, 333.0, 1000 / 7])
@pytest.mark.parametrize("cut", [np.round, np.floor])
def test_stamps_rounded_to_milliseconds_are_their_clocks(rate: float, cut: Callable[..., np.ndarray]) -> None:
    n = 1200
    time = cut(np.arange(n) * 1e3 / rate) / 1e3
    values = np.column_stack([np.arange(n), np.cos(np.arange(n) * 0.1)]).astype(float)
    for rules in ({}, {"sample_time": 1 / rate}, {"resample": ResampleSection()}):
        (piece,), notes = pieces(time, values, **rules)
        assert piece.sample_time == pytest.approx(1 / rate, rel=1e-4)
        assert np.array_equal(piece.values[:, 0], values[:, 0])  # no row has moved
        assert np.abs(piece.values[:, 1] - values[:, 1]).max() < 1e-9
        assert rate == 1000 / 7 or any("rounded" in note or "declared clock" in note for note in notes)
    keep = np.r_[0:500, 503:n]
    with pytest.raises(InputError, match=r"row 500: time is not uniform \(1 gap\)"):
        pieces(time[keep], values[keep])
    for rules in ({}, {"sample_time": 1 / rate}, {"resample": ResampleSection()}):
        parts, _ = pieces(time[keep], values[keep], gaps="split", **rules)
        assert [len(part.values) for part in parts] == [500, n - 503]
        assert np.array_equal(parts[1].values[:, 0], values[503:, 0])


def test_a_declared_sample_time_counts_rows_under_rough_stamps() -> None:
    rough = TIME + 0.22 * DT * np.random.default_rng(3).uniform(-1, 1, 200)
    with pytest.raises(InputError, match=r"clock jitter.*sample_time = 0.01"):
        pieces(rough)
    (piece,), notes = pieces(rough, sample_time=DT)
    assert np.array_equal(piece.values, VALUES)
    assert any("declared clock of 0.01 s" in note for note in notes)
    keep = np.r_[0:90, 91:200]
    parts, _ = pieces(rough[keep], VALUES[keep], sample_time=DT, gaps="split")
    assert [len(part.values) for part in parts] == [90, 109]
    twice = np.sort(np.r_[np.arange(200), 60, 120])
    with pytest.raises(InputError, match="stands still"):
        pieces(rough[twice], VALUES[twice], sample_time=DT)
    (piece,), _ = pieces(rough[twice], VALUES[twice], sample_time=DT, duplicates="first")
    assert np.array_equal(piece.values, VALUES)


def test_stamps_coarser_than_the_declared_sample_time_count_rows() -> None:
    n, dt = 900, 1 / 3000
    time, values = np.round(np.arange(n) * dt, 3), np.arange(2.0 * n).reshape(n, 2)
    with pytest.raises(InputError, match=r"stands still.*sample_time"):
        pieces(time, values)
    (piece,), notes = pieces(time, values, sample_time=dt)
    assert np.array_equal(piece.values, values)
    assert any("coarser than the declared sample time" in note for note in notes)
    keep = np.r_[0:300, 320:n]
    with pytest.raises(InputError, match="rows were lost or doubled"):
        pieces(time[keep], values[keep], sample_time=dt)


def test_jitter_under_a_held_input_asks_what_the_stamps_mean() -> None:
    rough = TIME + 0.2 * DT * np.random.default_rng(4).uniform(-1, 1, 200)
    with pytest.raises(InputError, match=r'intersample: .*"zoh" if each row sets.*"foh" if a row is a reading'):
        pieces(rough, intersample=None, resample=ResampleSection())
    for declared in ("zoh", "foh"):
        values = np.column_stack([VALUES[:, 0], np.sin(3 * rough)])
        (piece,), _ = pieces(rough, values, intersample=declared, resample=ResampleSection())
        grid = piece.start + piece.sample_time * np.arange(len(piece.values))
        assert np.abs(piece.values[:, 1] - np.sin(3 * grid)).max() < 2e-3


def test_empty_rows_are_refused_split_or_bridged() -> None:
    values = VALUES.copy()
    values[50:53, 1] = np.nan
    with pytest.raises(InputError, match=r"row 50, signal y.*nan"):
        pieces(TIME, values)
    parts, _ = pieces(TIME, values, gaps="split")
    assert [len(part.values) for part in parts] == [50, 147]
    (whole,), notes = pieces(TIME, values, resample=ResampleSection(method="cubic"))
    assert whole.values[:, 1] == pytest.approx(VALUES[:, 1], abs=1e-4)
    assert any("3 empty rows" in note for note in notes)


def test_fragments_are_dropped_and_counted() -> None:
    keep = np.r_[0:80, 100:104, 120:200]
    parts, notes = pieces(TIME[keep], VALUES[keep], gaps="split")
    assert [len(part.values) for part in parts] == [80, 80]
    assert any("4 of 164 rows dropped" in note for note in notes)
    with pytest.raises(InputError, match="only fragments"):
        pieces(TIME[::20], np.where(np.arange(10)[:, None] % 2, np.nan, VALUES[::20]), gaps="split")


def test_time_that_runs_back_or_is_in_another_unit_is_refused() -> None:
    back = TIME.copy()
    back[100:] -= 0.5
    with pytest.raises(InputError, match=r"row 100: time runs back"):
        pieces(back)
    back = TIME.copy()
    back[7] = back[6]
    with pytest.raises(InputError, match="stands still"):
        pieces(back)
    with pytest.raises(InputError, match=r"sample_time: .*factor of 1000"):
        pieces(1000 * TIME, sample_time=DT)
    with pytest.raises(InputError, match="disagrees with sample_time"):
        pieces(TIME, sample_time=0.011)
    with pytest.raises(InputError, match="no time stamp"):
        pieces(np.where(np.arange(200) == 3, np.nan, TIME))


def test_a_resampled_input_keeps_its_impulse_and_is_never_seen_early() -> None:
    jitter = TIME + 0.3 * DT * np.random.default_rng(1).uniform(-1, 1, 200)
    (piece,), notes = pieces(jitter, resample=ResampleSection(sample_time=0.004))
    grid = piece.start + 0.004 * np.arange(len(piece.values))
    held = VALUES[np.searchsorted(jitter, grid + 1e-9, side="right") - 1, 0]
    ends = VALUES[np.searchsorted(jitter, grid + 0.004 - 1e-9, side="right") - 1, 0]
    steady = held == ends
    assert piece.values[steady, 0] == pytest.approx(held[steady], abs=1e-9)  # only a change within the hold is shared
    between = (held <= piece.values[:, 0] + 1e-9) & (piece.values[:, 0] <= ends + 1e-9)
    assert between.all()
    area = np.concatenate([[0.0], np.cumsum(VALUES[:-1, 0] * np.diff(jitter))])
    assert np.cumsum(piece.values[:-1, 0]) * 0.004 == pytest.approx(np.interp(grid[1:], jitter, area), abs=1e-9)
    assert any("resampled to 0.004 s" in note for note in notes)
    (piece,), notes = pieces(jitter, resample=ResampleSection(sample_time=0.05, antialias=False))
    assert any("folds back" in note for note in notes)
    (linear,), _ = pieces(jitter, resample=ResampleSection(sample_time=0.004), intersample="foh")
    assert linear.values[:, 0] == pytest.approx(np.interp(grid, jitter, VALUES[:, 0]))


def test_a_lower_rate_does_not_fold_and_is_logged() -> None:
    t = np.arange(4000) * 0.005 + 0.001 * np.random.default_rng(0).uniform(-1, 1, 4000)
    u = np.where(np.sin(0.7 * t) > 0, 1.0, -1.0)
    slow, fast = np.sin(2 * np.pi * 0.4 * t), 0.3 * np.sin(2 * np.pi * 9.0 * t)  # folds to 1 Hz at 10 samples a second
    values = np.column_stack([u, slow + fast])
    rough = {"sample_time": 0.1, "method": "cubic"}
    (plain,), told = pieces(t, values, resample=ResampleSection(**rough, antialias=False))
    (clean,), notes = pieces(t, values, resample=ResampleSection(**rough))
    grid = clean.start + 0.1 * np.arange(len(clean.values))
    expected = np.sin(2 * np.pi * 0.4 * grid)[10:-10]
    assert np.abs(plain.values[10:-10, 1] - expected).max() > 0.25
    assert np.abs(clean.values[10:-10, 1] - expected).max() < 0.01
    assert any("content above 4 Hz filtered out" in note and "mean over each hold" in note for note in notes)
    assert any("folds back" in note for note in told)
    # what is held keeps its impulse: the means add up to the integral
    impulse = np.sum(u[:-1] * np.diff(t) * (t[:-1] < grid[-1]))
    assert np.sum(clean.values[:-1, 0]) * 0.1 == pytest.approx(impulse, abs=0.01)


def test_a_lower_rate_keeps_the_relation_of_input_and_output() -> None:
    t, tau = np.arange(8000) * 0.002, 0.3
    u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 8000 // 40), 40)
    y = [0.0]
    for value in u[:-1]:
        y.append(value + (y[-1] - value) * np.exp(-0.002 / tau))
    (piece,), _ = pieces(t, np.column_stack([u, y]), resample=ResampleSection(sample_time=0.04))
    held, out = piece.values.T
    pole, gain = np.linalg.lstsq(np.column_stack([out[:-1], held[:-1]]), out[1:], rcond=None)[0]
    assert pole == pytest.approx(np.exp(-0.04 / tau), abs=0.01)
    assert gain / (1 - pole) == pytest.approx(
        1.0, abs=0.05
    )  # the filter takes the edges of y, the holds keep those of u


@given(st.floats(1e-5, 1e3), st.integers(3, 60), st.floats(-1e3, 1e3))
def test_the_sample_time_of_any_uniform_axis_is_found(dt: float, n: int, start: float) -> None:
    time = start + np.arange(n) * dt
    if np.diff(time).min() <= 0 or np.ptp(np.diff(time)) > 0.4 * dt:
        return
    tolerance = 1e-8 + 4 * np.finfo(float).eps * np.abs(time).max() / (dt * (n - 1))
    assert sample_time_of(time) == pytest.approx(dt, rel=tolerance)


def test_a_sample_time_that_is_written_once_is_no_clock(tmp_path: Path) -> None:
    rows = [f"{k % 7},{np.sin(0.1 * k):.6f},{4 if not k else ''}" for k in range(60)]
    (tmp_path / "log.csv").write_text("\n".join(["u,y,Ts", *rows]) + "\n", encoding="utf-8")
    data = load_dataset(tmp_path / "log.csv", input=["u"], output=["y"], sample_time=4.0).dataset
    assert data.spec.sample_time == 4.0
    assert sum(len(run.trajectory) for run in data) == 60
    with pytest.raises(InputError, match=r"one number of 'Ts'.*sample_time = 4 "):
        load_dataset(tmp_path / "log.csv", input=["u"], output=["y"])


@given(st.integers(2, 7), st.integers(0, 5))
def test_a_reading_counts_once_however_dense_the_grid_is(denser: int, seed: int) -> None:
    """A record at 100 Hz brought to 200 to 700 Hz has as many readings as it had; the made-up ones count as missing."""
    rough = TIME + 0.02 * DT * np.random.default_rng(seed).uniform(-1, 1, TIME.size)
    (piece,), notes = pieces(rough, STILL, resample=ResampleSection(sample_time=DT / denser), intersample="foh")
    assert piece.between is not None
    known = ~piece.between[:, 1]
    assert known.sum() == pytest.approx(TIME.size, abs=2)
    grid = piece.start + np.arange(len(piece.values)) * piece.sample_time
    for instant in grid[known][:-2]:  # the last row lies beyond the grid
        assert np.abs(rough - instant).min() <= 0.5 * DT / denser + 1e-9, "beside a row"
    assert not piece.between[:, 0].any(), "an input is known all along"
    assert any("count as missing" in note for note in notes)


def test_a_clock_that_wanders_loses_no_reading() -> None:
    rough = TIME + 0.3 * DT * np.random.default_rng(1).uniform(-1, 1, TIME.size)
    (piece,), _ = pieces(rough, STILL, resample=ResampleSection(sample_time=DT), intersample="foh")
    assert piece.between is None or piece.between[:, 1].mean() < 0.05
    (coarse,), _ = pieces(TIME, STILL, resample=ResampleSection(sample_time=2 * DT), intersample="foh")
    assert coarse.between is None


def test_what_is_brought_to_another_clock_keeps_the_resolution_of_its_readings(tmp_path: Path) -> None:
    step = 0.01
    rows = [f"{t:.6f},0,{round(np.sin(3 * t) / step) * step:.2f}" for t in TIME + 0.2 * DT * np.sin(7 * TIME)]
    (tmp_path / "log.csv").write_text("time,u,y\n" + "\n".join(rows) + "\n")
    (tmp_path / "dataset.toml").write_text(
        'name = "x"\nintersample = "foh"\n[signals.u]\nrole = "input"\nunit = "N"\n[signals.y]\nrole = "output"\n'
        'unit = "m"\n[resample]\nsample_time = 0.004\n[[runs]]\nfile = "log.csv"\nuse = "estimation"\n'
    )
    assert load_dataset(tmp_path / "dataset.toml").dataset.resolution == {"y": pytest.approx(step)}
