"""Edges of fleets: what names many records, which rows are done again, which records count, what is no trend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import pytest

from harness.fleet import close_fleet, find_records, is_fleet, running
from harness.fleet.row import FleetRow, FoundEffect, encoded
from harness.fleet.trends import new_effects, series_of, trends

NORMAL = 1.959963984540054


def row(day: int | None, size: float | None, deviation: float = 0.01, *, status: str = "ok") -> FleetRow:
    low, high = (None, None) if size is None else (size - NORMAL * deviation, size + NORMAL * deviation)
    found = FoundEffect("coulomb", "q", "Fc", size, low, high, "N m", (), ("Fc",), (size,), (low,), (high,), ("N m",))
    when = None if day is None else (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    effects = () if size is None else (found,)
    return FleetRow(job=f"A{day}", record=f"A-{day}", file="", machine="A", date=when, effects=effects, status=status)


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [(1e-9, 1.0, "grows"), (0.0, 1.0, "no trend"), (-1.0, 1.0, "no trend"), (-1.0, 0.0, "no trend"),
     (-1.0, -1e-9, "shrinks"), (0.0, 0.0, "no trend")],
)  # fmt: skip
def test_an_interval_that_holds_zero_is_no_trend(low: float, high: float, word: str) -> None:
    (found,) = trends(series_of([row(day, 0.1 + 0.01 * day) for day in range(4)]))
    assert replace(found, low=low, high=high).word == word


@pytest.mark.parametrize("silent", [row(0, None, status="refused"), row(0, None, status="failed"), row(None, None)])
def test_a_record_without_answer_or_date_is_not_the_first_of_its_machine(silent: FleetRow) -> None:
    """What the first dated answer shows was there; what a later one adds is new."""
    assert new_effects([silent, row(1, 0.1), row(2, 0.1)]) == []
    (found,) = new_effects([silent, row(1, None), row(2, 0.1)])
    assert (found.machine, found.row.record, found.effect.name) == ("A", "A-2", "coulomb@q")
    assert new_effects([row(1, None), row(None, 0.1)]) == []  # nobody knows when


def test_what_names_many_records(tmp_path: Path) -> None:
    record, table = tmp_path / "a[1].csv", tmp_path / "fleet.csv"
    record.write_text("time [s],u,y\n0,1,2\n")
    table.write_text("machine,file\none,a[1].csv\n")
    named = {tmp_path: True, tmp_path / "*.csv": True, tmp_path / "b[1].csv": True, table: True,
             record: False, tmp_path / "missing.csv": False, tmp_path / "missing": False}  # fmt: skip
    assert {path: is_fleet(path) for path in named} == named
    assert {path: is_fleet(str(path)) for path in named} == named


def test_only_records_without_a_row_are_done_when_a_fleet_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "records"
    folder.mkdir()
    for name in ("a", "b", "c"):
        (folder / f"{name}.csv").write_text(f"time [s],u,y\n0,1,{ord(name)}\n")
    done: list[list[str]] = []

    def stand_in(todo: Sequence[Any], shards: Path, **options: Any) -> None:
        done.append([batch.record.name for batch in todo])
        for batch in todo[:2]:
            answer = FleetRow(job=batch.job, record=batch.record.name, file=str(batch.record.file), status="refused")
            (shards / f"{batch.job}.json").write_bytes(encoded(answer))

    monkeypatch.setattr(running, "run_jobs", stand_in)
    moved: list[tuple[int, int]] = []
    for resume in (False, True, True):
        close_fleet(
            folder,
            out=tmp_path / "out",
            resume=resume,
            progress=lambda rows, of, what: moved.append((rows, of)),
        )
    assert done == [["a", "b", "c"], ["c"], []]
    assert moved == [(0, 3), (2, 3), (3, 3)]
    (folder / "b.csv").write_text("time [s],u,y\n0,1,7\n")
    close_fleet(folder, out=tmp_path / "out", resume=True)
    assert done[3:] == [["b"]]
    assert [one.name for one in find_records(folder)] == ["a", "b", "c"]
