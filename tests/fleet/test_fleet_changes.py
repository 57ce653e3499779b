"""A change between dates is found whatever its shape, and a machine that is not as the others; chance is not named."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np
import pytest
from msgspec.structs import replace

from harness.fleet.changes import changes, odd_machines
from harness.fleet.page import fleet_page
from harness.fleet.row import FleetRow, FoundEffect


def row(day: int, size: float | None, deviation: float, machine: str = "A") -> FleetRow:
    low, high = (size - 1.96 * deviation, size + 1.96 * deviation) if size is not None else (0.0, 0.0)
    effects = () if size is None else (
        FoundEffect("coulomb", "q", "Fc", size, low, high, "N m", (), ("Fc",), (size,), (low,), (high,), ("N m",)),
    )  # fmt: skip
    when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(
        job=f"{machine}{day}", record=f"{machine}-{day}", file="", machine=machine, date=when, effects=effects
    )


def fleet(levels: dict[str, np.ndarray], seed: int, *, excess: float = 1.0, deviation: float = 0.01) -> list[FleetRow]:
    rng = np.random.default_rng(seed)
    return [
        row(k, float(level + excess * deviation * rng.standard_normal()), deviation, machine)
        for machine, own in levels.items()
        for k, level in enumerate(own)
    ]


STEP = np.where(np.arange(10) < 6, 0.10, 0.20)
DRIFT = np.linspace(0.10, 0.25, 10)
OUTLIER = np.where(np.arange(10) == 4, 0.25, 0.10)


@pytest.mark.parametrize(
    ("levels", "shape", "place"), [(STEP, "step", 6), (DRIFT, "drift", 9), (OUTLIER, "outlier", 4)]
)
@pytest.mark.parametrize("excess", [1.0, 2.0])
def test_a_change_is_found_whatever_its_shape(levels: np.ndarray, shape: str, place: int, excess: float) -> None:
    found = [changes(fleet({"A": levels, "B": np.full(10, 0.1)}, seed, excess=excess)) for seed in range(20)]
    right = [len(own) == 1 and (own[0].machine, own[0].shape, own[0].row.record) == ("A", shape, f"A-{place}")
             for own in found]  # fmt: skip
    assert sum(right) >= (17 if excess == 1.0 else 8)  # the scatter is told from nine differences
    assert all(own[0].after > own[0].before for own in found if own)


@pytest.mark.parametrize("count", [2, 3])
def test_a_change_between_two_or_three_dates_is_told_from_the_intervals(count: int) -> None:
    rows = fleet({"A": np.array([0.1, 0.2, 0.2][:count])}, 0)
    (found,) = changes(rows)
    assert (found.shape, found.row.record) == ("step", "A-1")
    assert "steps from 0.1" in str(found)


@pytest.mark.parametrize("excess", [1.0, 4.0])
def test_chance_is_named_as_rarely_as_is_said(excess: float) -> None:
    # scatter four times that of the intervals is no change
    level = {name: np.full(8, 0.1) for name in "ABCDE"}
    alarms = sum(
        bool(changes(rows) or odd_machines(rows)) for rows in (fleet(level, s, excess=excess) for s in range(60))
    )
    assert alarms <= 5


def test_a_machine_that_is_not_as_the_others_stands_out() -> None:
    levels = {name: np.full(5, 0.3 if name == "C" else 0.1) for name in "ABCDEF"}
    assert [odd.machine for odd in odd_machines(fleet(levels, 1))] == ["C"]
    alone = [row(k, 0.1 if name == "E" else None, 0.01, name) for name in "ABCDEF" for k in range(6)]
    (odd,) = odd_machines(alone)
    assert (odd.machine, odd.what) == ("E", "in 6 of 6 records, of the others in 0 of 30")


@pytest.mark.parametrize("count", [3, 4])
def test_from_four_on_one_stands_out(count: int) -> None:
    names = "ABCD"[:count]
    odd = odd_machines(fleet({name: np.full(5, 9.0 if name == "A" else 0.1) for name in names}, 1))
    assert [one.machine for one in odd] == (["A"] if count == 4 else [])  # of three, two may agree by chance


def test_a_machine_is_as_sure_as_the_intervals_of_its_records() -> None:
    near = {name: np.full(5, 0.17 if name == "C" else 0.1) for name in "ABCDEFGH"}
    assert [odd.machine for odd in odd_machines(fleet(near, 2))] == ["C"]  # sixteen standard errors of a mean of five
    assert not odd_machines(fleet(near, 2, deviation=0.1))  # less than two


@pytest.mark.parametrize(("unit", "shown"), [("N m", " to 0.2007 N m at A-6 "), ("1", " to 0.2007 at A-6 ")])
def test_a_change_is_told_with_its_unit(unit: str, shown: str) -> None:
    rows = [
        replace(one, effects=tuple(replace(e, unit=unit, units=(unit,)) for e in one.effects))
        for one in fleet({"A": STEP}, 0)
    ]
    (found,) = changes(rows)
    assert "Fc on A steps from 0.1" in str(found)
    assert shown in str(found)


def test_what_is_new_lists_changes() -> None:
    page = fleet_page(fleet({"A": STEP}, 0), planned=10, model="m", reports="reports")
    assert "Sizes that change between dates" in page
    assert ">step<" in page
