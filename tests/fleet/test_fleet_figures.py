"""Figures of fleets against those worked out by hand: how unlikely a change is, how odd a machine, how sure a trend."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.stats import norm, t

from harness.errors import InputError
from harness.fleet import find_records
from harness.fleet.changes import changes, odd_machines
from harness.fleet.row import FleetRow, FoundEffect, encoded
from harness.fleet.running import close_fleet
from harness.fleet.store import FleetStore
from harness.fleet.trends import series_of, trends

NORMAL = 1.959963984540054
OURS = {"model": "pendulum", "undriven": []}


def row(day: int | None, size: float, deviation: float | None, machine: str = "A", *, name: str = "") -> FleetRow:
    low, high = (None, None) if deviation is None else (size - NORMAL * deviation, size + NORMAL * deviation)
    found = FoundEffect("coulomb", "q", "Fc", size, low, high, "N m", (), ("Fc",), (size,), (low,), (high,), ("N m",))
    when = None if day is None else (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(job=f"{machine}{day}{name}", record=f"{machine}-{day}", file="", machine=machine, date=when,
               effects=(found,))  # fmt: skip


def test_a_step_between_three_dates_by_the_normal_distribution() -> None:
    """Two places, three shapes, two sides; the error of a mean is that of its weights."""
    (found,) = changes([row(0, 0.1, 0.01), row(1, 0.2, 0.02), row(9, 0.2, 0.01)])
    after = 1 / np.sqrt(1 / 0.02**2 + 1 / 0.01**2)
    assert found.p == pytest.approx(3 * 2 * 2 * norm.sf(0.1 / np.hypot(0.01, after)), rel=1e-4)
    assert (found.shape, found.row.record) == ("step", "A-1")
    assert (found.before, found.after) == (pytest.approx(0.1), pytest.approx(0.2))


def test_a_drift_over_uneven_dates() -> None:
    days = np.array([0, 1, 5])
    (found,) = changes([row(int(day), 0.1 + 0.02 * day, 0.01) for day in days])
    z = 0.02 * np.sqrt(((days - days.mean()) ** 2).sum()) / 0.01
    assert (found.shape, found.before, found.after) == ("drift", pytest.approx(0.1), pytest.approx(0.2))
    assert found.p == pytest.approx(3 * 2 * norm.sf(z), rel=1e-4)


@pytest.mark.parametrize("sizes", [(0.05, 0.07, 0.09, 0.11, 0.13), (0.05, 0.05, 0.05, 0.12, 0.12)])
def test_what_grows_steadily_is_a_drift_and_no_scatter(sizes: tuple[float, ...]) -> None:
    """Neighbours that differ because the size grows were taken for scatter: "no size changes"."""
    (found,) = changes([row(k, size, 0.001) for k, size in enumerate(sizes)])
    assert (found.shape, found.before, found.after) == (
        "step" if sizes[1] == sizes[0] else "drift", pytest.approx(sizes[0]), pytest.approx(sizes[-1]),
    )  # fmt: skip


@pytest.mark.parametrize("scatter", [1.0, 2.0])
def test_sizes_that_only_scatter_hardly_ever_change(scatter: float) -> None:
    rng = np.random.default_rng(7)
    draws = [0.1 + 0.01 * scatter * rng.normal(size=int(rng.integers(4, 12))) for _ in range(300)]
    said = sum(bool(changes([row(k, float(size), 0.01) for k, size in enumerate(sizes)])) for sizes in draws)
    assert said <= 6  # 3 expected at one in a hundred


def test_how_odd_a_machine_is() -> None:
    """Over the error of its mean and the scatter of the machines, times what was tried."""
    sizes = {"A": 0.100, "B": 0.101, "C": 0.099, "D": 0.1005, "E": 0.160}
    (found,) = odd_machines([row(0, size, 0.0002, machine) for machine, size in sizes.items()])
    between = 1.4826 * 0.0005
    tried = 5 * (1 + 1)  # machines, the size and having it
    assert (found.machine, found.effect) == ("E", "coulomb@q")
    assert found.p == pytest.approx(2 * t.sf((0.160 - 0.1005) / np.hypot(0.0002, between), 4) * tried, rel=1e-3)


def test_a_machine_whose_own_records_scatter_is_less_odd() -> None:
    sizes = {"A": [0.100] * 2, "B": [0.101] * 2, "C": [0.099] * 2, "D": [0.1005] * 2, "E": [0.27, 0.29]}
    rows = [row(k, size, 0.001, machine) for machine, own in sizes.items() for k, size in enumerate(own)]
    (found,) = [odd for odd in odd_machines(rows) if "others 0" in odd.what]
    error = 0.001 / np.sqrt(2) * np.sqrt(2 * 0.01**2 / 0.001**2)
    spread = np.hypot(error, max(1.4826 * 0.0005, 0.001 / np.sqrt(2)))
    assert found.p == pytest.approx(2 * t.sf((0.28 - 0.1005) / spread, 4) * 10, rel=1e-3)


def test_the_interval_of_a_trend() -> None:
    days = np.array([0.0, 2.0, 3.0, 7.0])
    undated = [row(None, 0.9, 0.01), row(4, 0.9, None)]  # neither has a date and an interval
    (found,) = trends(series_of([*(row(int(day), 0.1 + 0.01 * day, 0.02) for day in days), *undated]))
    half = t.ppf(0.975, 2) * 0.02 / np.sqrt(((days - days.mean()) ** 2).sum())
    assert (found.slope, found.high - found.slope) == (pytest.approx(0.01), pytest.approx(half, rel=1e-4))
    assert found.low == pytest.approx(found.slope - half, rel=1e-4)
    bent = [row(int(day), size, 0.001) for day, size in zip(days, (0.1, 0.2, 0.1, 0.2), strict=True)]
    (found,) = trends(series_of(bent))
    slope, level = np.polyfit(days, [0.1, 0.2, 0.1, 0.2], 1)
    left = np.array([0.1, 0.2, 0.1, 0.2]) - level - slope * days
    half = t.ppf(0.975, 2) * np.sqrt((left**2).sum() / 2) / np.sqrt(((days - days.mean()) ** 2).sum())
    assert (found.slope, found.high - found.slope) == (pytest.approx(slope), pytest.approx(half, rel=1e-4))


def test_three_records_of_one_day_have_no_trend() -> None:
    assert trends(series_of([row(3, 0.1 + 0.01 * k, 0.02, name=str(k)) for k in range(3)])) == []


def test_a_fleet_is_continued_with_its_own_settings_only(tmp_path: Path) -> None:
    store = FleetStore(tmp_path)
    assert store.open(["a", "b"], OURS, resume=False) == {}
    for name in ("a", "b"):
        (store.shards / f"{name}.json").write_bytes(encoded(row(0, 0.1, 0.01, name)))
    with pytest.raises(InputError, match="the folder holds a fleet"):
        store.open(["a"], OURS, resume=False)
    with pytest.raises(InputError, match="the folder holds another fleet"):
        store.open(["a"], {**OURS, "model": "cart-pole"}, resume=True)
    assert list(store.open(["b0", "c"], OURS, resume=True)) == ["b0"]  # of what is asked for now


def test_a_pattern_names_records_below_what_they_share(tmp_path: Path) -> None:
    for name in ("x/one.csv", "x/y/two.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("time [s],u,y\n")
    assert [record.name for record in find_records(tmp_path / "**" / "*.csv")] == ["one", "y/two"]
    (single,) = find_records(str(tmp_path / "x" / "o*.csv"))
    assert single.name == "x/one"


def test_no_time_is_no_time_limit(tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("time [s],u,y\n")
    for limit in (0, -1.0, float("nan")):
        with pytest.raises(InputError, match="seconds above 0"):
            close_fleet(tmp_path, out=tmp_path / "out", time_limit=limit)


def test_records_without_a_date_or_a_width_say_nothing_of_changes() -> None:
    """The change of the others is found as if they were not there."""
    dated = [row(0, 0.1, 0.01), row(1, 0.2, 0.02), row(9, 0.2, 0.01)]
    (alone,) = changes(dated)
    for silent in (row(None, 0.9, 0.01), row(5, 0.9, None), row(5, 0.9, 0.0), row(None, 0.9, None)):
        (found,) = changes([*dated, silent])
        assert (found.shape, found.row.record, found.p) == (alone.shape, alone.row.record, alone.p)


def test_records_of_one_day_drift_by_the_hour() -> None:
    sizes = [0.1, 0.12, 0.14]
    rows = [msgspec.structs.replace(row(0, size, 0.002, name=str(k)), date=f"2026-01-01T{8 + k:02d}:00:00")
            for k, size in enumerate(sizes)]  # fmt: skip
    (found,) = changes(rows)
    assert (found.shape, found.before, found.after) == ("drift", pytest.approx(0.1), pytest.approx(0.14))


def test_of_four_records_one_may_stand_out_and_of_three_none() -> None:
    four = changes([row(k, size, wide) for k, (size, wide) in enumerate(
        [(0.1, 0.002), (1.0, 0.002), (0.1, 0.9), (0.1, 0.002)])])  # fmt: skip
    assert [(found.shape, found.row.record) for found in four] == [("outlier", "A-1")]
    three = changes([row(k, size, 0.002) for k, size in enumerate([0.1, 0.2, 0.1])])
    assert "outlier" not in [found.shape for found in three]
