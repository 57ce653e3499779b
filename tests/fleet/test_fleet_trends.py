"""What is new, and what grows: judged on rows whose truth is known."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from harness.fleet.page import LONG, fleet_page, size_limits, written
from harness.fleet.row import FleetRow, FoundEffect
from harness.fleet.store import tables
from harness.fleet.trends import new_effects, series_of, trends
from harness.jobs.query import ask


def found(name: str, size: float, half: float = 0.01, ties: tuple[str, ...] = ()) -> FoundEffect:
    effect, _, at = name.partition("@")
    return FoundEffect(effect, at, "Fc", size, size - half, size + half, "N m", ties, ("Fc",), (size,), (size - half,),
                 (size + half,), ("N m",))  # fmt: skip


def row(day: int, *effects: FoundEffect, machine: str = "A", status: str = "ok") -> FleetRow:
    when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(job=f"{machine}{day}", record=f"{machine}-{day}", file="", machine=machine, date=when,
                    status=status, effects=effects)  # fmt: skip


def test_an_effect_is_new_once_and_not_in_the_first_record() -> None:
    rows = [row(2, found("coulomb@q", 0.1)), row(0), row(1, found("coulomb@q", 0.1)), row(3, found("backlash@q", 1.0))]
    rows += [row(0, found("coulomb@q", 0.1), machine="B"), row(1, found("coulomb@q", 0.1), machine="B")]
    assert [(new.row.record, new.effect.name, new.before) for new in new_effects(rows)] == [
        ("A-1", "coulomb@q", ()),
        ("A-3", "backlash@q", ("coulomb@q",)),
    ]


def test_a_size_has_as_many_digits_as_its_interval_needs() -> None:
    assert written(found("coulomb@q", 0.1)) == "Fc 0.1 [0.09, 0.11] N m"
    near_one = replace(found("gain@q", 1.00001, half=2e-6), parameter="gain", unit="1")
    text = written(near_one)
    assert text.startswith("gain 1.00001 [1.0000")
    low, high = text.split("[")[1].rstrip("]").split(", ")
    assert float(low) < 1.00001 < float(high)


def test_a_record_that_says_nothing_does_not_press_the_others_into_a_line() -> None:
    effects = [found("coulomb@q", size, half=0.001) for size in np.linspace(0.1, 0.2, 30)]
    low, high = size_limits([*effects, found("coulomb@q", 0.15, half=40.0)])
    assert low < 0.099 < 0.201 < high
    assert high - low < 0.3
    same = [found("coulomb@q", 0.1, half=0.01)] * 3
    assert size_limits(same) == pytest.approx((0.089, 0.111))
    assert size_limits([replace(found("coulomb@q", 1.0), size=None)]) == (0.0, 1.0)


def test_many_records_are_counted_by_machine_and_folded() -> None:
    many = [row(k, found("coulomb@q", 0.1)) for k in range(LONG)] + [row(k, machine="B") for k in range(3)]
    page = fleet_page(many, planned=len(many), model="m", reports="reports")
    assert f"<details><summary>all {len(many)} records" in page
    assert "details::details-content { content-visibility: visible" in page[page.index("@media print") :], (
        "on paper all"
    )
    assert f"{LONG} coulomb@q" in page
    few = fleet_page(many[:5], planned=5, model="m", reports="reports")
    assert "<details>" not in few


def test_effects_are_asked_by_name_and_place() -> None:
    answer = ask(tables([row(0, found("coulomb@q", 0.1))]), "select effect, place, size from effects")
    assert answer.records() == [{"effect": "coulomb", "place": "q", "size": 0.1}]


def test_another_name_of_a_tie_is_not_new_and_failures_say_nothing() -> None:
    tied = found("coulomb@q", 0.1, ties=("stribeck@q",))
    rows = [row(0, tied), row(1, status="crashed"), row(2, found("stribeck@q", 0.1))]
    assert new_effects(rows) == []


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.002, -0.002]))
def test_the_slope_is_found_where_there_is_one(seed: int, slope: float) -> None:
    rng = np.random.default_rng(seed)
    days = np.sort(rng.choice(200, size=25, replace=False))
    rows = [row(int(day), found("coulomb@q", 0.1 + slope * day + 0.005 * rng.standard_normal())) for day in days]
    (trend,) = trends(series_of(rows))
    assert trend.records == 25
    # the stated interval is 1.96 x 0.0051 wide on each side: five standard errors never fail in these draws
    half = trend.high - trend.slope
    assert trend.slope == pytest.approx(slope, abs=3 * half)
    if slope:
        assert trend.word == ("grows" if slope > 0 else "shrinks")


def test_more_scatter_than_the_intervals_say_widens_the_slope() -> None:
    rng = np.random.default_rng(0)
    scatter = 0.05 * rng.standard_normal(20)
    wide, narrow = (
        trends(series_of([row(7 * k, found("coulomb@q", 0.1 + scatter[k], half)) for k in range(20)]))[0]
        for half in (0.1, 0.001)
    )
    assert narrow.high - narrow.low == pytest.approx(wide.high - wide.low, rel=0.5)
    assert narrow.word == "no trend"


def test_two_records_have_no_trend() -> None:
    assert trends(series_of([row(0, found("coulomb@q", 0.1)), row(1, found("coulomb@q", 0.2))])) == []
