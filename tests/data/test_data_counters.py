"""Clocks written as whole numbers: counters that begin anew, digits of a date, seconds with a fraction beside them."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.data import load_dataset
from harness.data.recipe.contents import contents_of
from harness.data.tables.headers import clock_of, fraction_of
from harness.data.tables.table import Table
from harness.data.times.counts import dated, unwrapped
from harness.errors import InputError
from harness.signals import Dataset

N, DT = 120, 0.01
RNG = np.random.default_rng(48)
TORQUE = np.round(RNG.normal(size=N), 5)
ANGLE = np.round(np.cumsum(np.cumsum(TORQUE)) * 1e-3, 6)
NAMED = {"input": "u", "output": "theta"}


def log(folder: Path, title: str, stamps: list[str]) -> Path:
    rows = [f"{t},{u},{y}" for t, u, y in zip(stamps, TORQUE, ANGLE, strict=True)]
    (folder / "log.csv").write_text("\n".join([f"{title},u [N m],theta [rad]", *rows]) + "\n")
    return folder / "log.csv"


def right(data: Dataset) -> None:
    assert data.spec.sample_time == pytest.approx(DT, rel=1e-6)
    assert np.concatenate([run.trajectory.u[:, 0] for run in data]) == pytest.approx(TORQUE)
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]) == pytest.approx(ANGLE)


@given(
    st.sampled_from([16, 24, 32]), st.integers(3, 900), st.integers(10, 90), st.integers(1, 3),
    st.booleans(), st.integers(0, 1),
)  # fmt: skip
def test_a_counter_that_was_full_goes_on(bits: int, step: int, at: int, times: int, signed: bool, jitter: int) -> None:
    period = 2**bits
    step = min(step, period // 50)
    n = at + (times - 1) * (period // step) + 10 if bits == 16 and step > 300 else at + 10
    meant = period - step * at + step * np.arange(n) + jitter * (np.arange(n) % 2) + 1
    shown = (meant % period).astype(float)
    if signed:
        shown = np.where(shown >= period // 2, shown - period, shown)
        if not (np.diff(shown) < 0).any():
            return
    found, used, count = unwrapped(shown)
    falls = int((np.diff(shown) < 0).sum())
    if (shown[1:][np.diff(shown) < 0] == shown[0]).any():  # as a second record would begin
        assert count == 0
        return
    assert (used, count) == (period, falls)
    assert np.array_equal(np.diff(found), np.diff(meant))


@given(st.integers(20, 3000), st.integers(20, 3000), st.sampled_from([1.0, 2.0, 10.0, 1e3, 1e4]), st.integers(0, 50))
def test_a_second_record_is_no_full_counter(first: int, second: int, step: float, start: int) -> None:
    stamps = start * step + step * np.concatenate([np.arange(first), np.arange(second)])
    assert unwrapped(stamps)[2] == 0
    shuffled = stamps[::-1]
    assert unwrapped(shuffled)[2] == 0


@pytest.mark.parametrize(
    ("title", "per_second", "period"),
    [("time [ms]", 1e3, 2**16), ("t_us", 1e6, 2**32), ("Zeit (µs)", 1e6, 2**24), ("time [s]", 1.0, 2**32 / 1e6)],
)
def test_a_log_of_a_microcontroller_is_read_over_the_end_of_its_counter(
    title: str, per_second: float, period: float, tmp_path: Path
) -> None:
    counts = (period + (np.arange(N) * DT - 0.5) * per_second) % period
    path = log(tmp_path, title, [f"{count:.6f}".rstrip("0").rstrip(".") for count in counts])
    data = load_dataset(path, model="pendulum").dataset
    right(data)
    assert any("begins anew" in note and "(1x)" in note for note in data.warnings)
    found = contents_of(path)  # as it is shown, so it is read
    assert (found.sample_time, found.unsteady) == (pytest.approx(DT), 0)
    assert any("begins anew" in note for note in found.notes)


@given(
    st.datetimes(datetime.datetime(1990, 1, 1), datetime.datetime(2089, 12, 31)),
    st.sampled_from(["", ".3", "3", ",6", "6"]),
)
def test_digits_of_a_date_are_read_to_the_last(begin: datetime.datetime, form: str) -> None:
    begin = begin.replace(microsecond=0)
    digits = int(form[-1:] or 0)
    stamps = [begin + datetime.timedelta(seconds=k) for k in range(3)]
    cells = [f"{stamp:%Y%m%d%H%M%S}" + form[:-1] + "250000"[:digits] for stamp in stamps]
    found = dated(cells)
    assert found is not None
    fraction = ".250000"[: digits + 1] if digits else ""
    assert found == [f"{stamp:%Y%m%dT%H%M%S}{fraction}" for stamp in stamps]


def test_numbers_that_are_no_date_stay_numbers() -> None:
    for cell in ("1709640000000", "1709640000000000", "1709640000000000000", "20241301000000", "20240101250000", ""):
        assert dated([cell]) is None
    assert dated([]) is None


def test_a_log_with_digits_for_its_time_passes_a_new_year(tmp_path: Path) -> None:
    stamps = [datetime.datetime(2024, 12, 31, 23, 59, 59, 500000) + k * datetime.timedelta(milliseconds=10)
              for k in range(N)]  # fmt: skip
    for form in ("%Y%m%d%H%M%S.%f", "%Y%m%d%H%M%S%f"):
        right(load_dataset(log(tmp_path, "time", [stamp.strftime(form) for stamp in stamps]), model="pendulum").dataset)


@pytest.mark.parametrize(
    ("whole", "part", "unit"),
    [("secs", "nsecs", 1e9), ("header.stamp.sec", "header.stamp.nanosec", 1e9), ("sec", "usec", 1e6)],
)
def test_seconds_and_their_fraction_are_one_clock(whole: str, part: str, unit: float, tmp_path: Path) -> None:
    at = 1_709_640_000_000 + 10 * np.arange(N)  # ms
    path = log(tmp_path, f"{whole},{part}", [f"{ms // 1000},{round(ms % 1000 * unit / 1000)}" for ms in at.tolist()])
    data = load_dataset(path, model="pendulum").dataset
    right(data)
    assert any("their fraction" in note for note in data.warnings)
    wrong = log(tmp_path, f"{whole},{part}", [f"{ms / 1000:.2f},{ms % 1000}" for ms in at.tolist()])
    with pytest.raises(InputError, match="whole seconds, and a fraction"):
        load_dataset(wrong, model="pendulum")


def test_two_times_are_no_time_and_its_fraction() -> None:
    assert fraction_of("secs", ["secs", "other.nsecs"]) is None
    assert fraction_of("nsecs", ["secs", "nsecs"]) is None
    with pytest.raises(InputError, match="may be the time"):
        clock_of(["stamp.sec", "time.nsec"])


def test_a_field_of_a_selector_says_its_unit(tmp_path: Path) -> None:
    """Steps below one without a unit would be seconds: at 10 kHz a time in ms would be read 1000 times too slow."""
    import scipy.io

    for field, unit in (("time_ms", 1e3), ("t_us", 1e6), ("time", 1.0)):
        scipy.io.savemat(
            tmp_path / "log.mat", {"log": {field: np.arange(N) * 1e-4 * unit, "u": TORQUE, "theta": ANGLE}}
        )
        column = {"time": f"log.{field}", "u": "log.u", "theta": "log.theta"}
        data = load_dataset(tmp_path / "log.mat", input="u", output="theta", column=column).dataset
        assert data.spec.sample_time == pytest.approx(1e-4)


def test_a_declared_unit_of_time_against_the_title_is_said(tmp_path: Path) -> None:
    path = log(tmp_path, "time [s]", [f"{k * 10}" for k in range(N)])
    data = load_dataset(path, model="pendulum", unit={"time": "ms"}).dataset
    right(data)
    assert any("'time [s]' says s; ms, as declared, counts" in note for note in data.warnings)
    data = load_dataset(log(tmp_path, "time [msec]", [f"{k * 10}" for k in range(N)]), model="pendulum",
                        unit={"time": "ms"}).dataset  # fmt: skip
    assert not any("as declared" in note for note in data.warnings)


@pytest.mark.parametrize(
    ("title", "written"),
    [
        ("MESS_DATUM", "%Y%m%d%H%M"), ("MESS_DATUM", "%Y%m%d%H"), ("timestamp", "%Y%m%d%H%M%S"), ("row", "%Y%m%d%H%M"),
        ("Time", "%b %d %H:%M:%S"), ("Zeit", "%d.%m. %H:%M:%S"),
    ],
)  # fmt: skip
def test_dates_in_digits_alone_and_without_a_year_are_the_clock(tmp_path: Path, title: str, written: str) -> None:
    """As weather services, system logs and cyclers write them."""
    begin = datetime.datetime(2024, 4, 29, 22)
    stamps = [(begin + datetime.timedelta(hours=k)).strftime(written) for k in range(80)]
    rows = "".join(f"{stamp};{k % 7};{k % 5}\n" for k, stamp in enumerate(stamps))
    (path := tmp_path / "log.csv").write_text(f"{title};u;y\n{rows}", encoding="utf-8")
    table = Table(path)
    assert table.clock() == title
    assert table.read_time(title)[0] == pytest.approx(3600.0 * np.arange(80))


def test_a_counter_is_no_date_though_it_begins_like_one(tmp_path: Path) -> None:
    rows = "".join(f"{2024050100 + k},{k % 5}\n" for k in range(80))
    (path := tmp_path / "log.csv").write_text(f"serial,y\n{rows}", encoding="utf-8")
    assert Table(path).clock() is None


def test_a_leap_day_without_its_year_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"Feb {day} 12:00:00,{day}\n" for day in (27, 28, 29))
    (path := tmp_path / "log.csv").write_text(f"Time,y\n{rows}", encoding="utf-8")
    with pytest.raises(InputError, match="Time"):
        Table(path).read_time("Time")
