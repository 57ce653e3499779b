"""Small faults of fleets that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.fleet.records import find_records
from harness.fleet.row import FleetRow, FoundEffect, fill
from harness.fleet.running import _absolute
from harness.fleet.trends import series_of, trends


def interval(parameter: str, value: float, low: float | None, high: float | None) -> dict[str, dict[str, Any]]:
    return {parameter: {"value": value, "low": low, "high": high, "unit": "N m"}}


@pytest.mark.parametrize(
    ("ends", "main"),
    [((None, None), "Fc"), ((0.2, None), "Fc"), ((None, 0.4), "Fc"), ((0.2, 0.4), "w")],
)
def test_the_size_of_an_effect_is_its_first_parameter_with_both_ends(
    ends: tuple[float | None, float | None], main: str
) -> None:
    parameters = interval("Fc", 0.1, None, None) | interval("w", 0.3, *ends)
    tie = [{"name": "coulomb", "at": "q"}, {"name": "dahl", "at": "q"}]
    report = {
        "verdict": "effects_found",
        "errors": {
            "before": {"simulation_error": {"validation": {"q": {"nrmse": 0.2}, "x": {"nrmse": 0.7}, "y": {}}}},
            "after": {},
        },
        "effects": [{"name": "coulomb", "at": "q", "parameters": parameters}],
        "tie_sets": [tie],
    }
    row = FleetRow(job="a", record="a", file="", machine="", date=None)
    fill(row, report)
    assert (row.error_before, row.error_after, row.stand_in) == (0.7, None, None)
    (found,) = row.effects
    assert (found.parameter, found.ties, found.parameters) == (main, ("dahl@q",), ("Fc", "w"))
    assert (found.values, found.lows, found.highs) == ((0.1, 0.3), (None, ends[0]), (None, ends[1]))


def test_a_slope_is_as_sure_as_the_intervals_that_it_rests_on() -> None:
    sizes, half = [0.10, 0.10, 0.13, 0.13], 0.01
    rows = []
    for day, size in enumerate(sizes):
        effect = FoundEffect("coulomb", "q", "Fc", size, size - half, size + half, "N m", (), ("Fc",), (size,),
                       (size - half,), (size + half,), ("N m",))  # fmt: skip
        when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
        rows.append(FleetRow(job=f"{day}", record=f"{day}", file="", machine="", date=when, effects=(effect,)))
    (trend,) = trends(series_of(rows))
    day = np.arange(4.0)
    slope = float((day - 1.5) @ sizes) / 5.0
    deviation = half / 1.959964
    left = np.array(sizes) - np.mean(sizes) - slope * (day - 1.5)
    birge = max(1.0, np.sqrt(np.sum(left**2) / deviation**2 / 2))
    assert trend.slope == pytest.approx(slope)
    assert trend.high - trend.slope == pytest.approx(4.30265 * birge * deviation / np.sqrt(5.0), rel=1e-5)


def test_descriptions_in_a_folder_leave_out_its_tables_and_what_is_no_record(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv", "notes.txt"):
        (tmp_path / name).write_text("time [s],u [N m]\n0,1\n")
    (tmp_path / "folder.csv").mkdir()
    assert [one.name for one in find_records(tmp_path)] == ["a", "b"]
    (tmp_path / "c.toml").write_text("")
    assert [one.file.name for one in find_records(tmp_path)] == ["c.toml"]


def test_a_model_in_a_file_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("")
    (tmp_path / "mine.fmu").write_text("")
    assert _absolute("mine.py:law") == f"{tmp_path / 'mine.py'}:law"
    assert _absolute("mine.fmu") == str(tmp_path / "mine.fmu")
    assert (_absolute("pendulum"), _absolute("gone.py:law"), _absolute(None)) == ("pendulum", "gone.py:law", None)
