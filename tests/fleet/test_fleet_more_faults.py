"""Tables of records of other countries, damaged reports, and small faults of fleets that no other test would notice."""

from __future__ import annotations

import json
from datetime import date, timedelta
from pathlib import Path

import pytest

from harness.errors import InputError
from harness.fleet import find_records, is_fleet
from harness.fleet.changes import _mean
from harness.fleet.records import FleetRecord
from harness.fleet.row import FleetRow, FoundEffect, encoded
from harness.fleet.running import FleetResult
from harness.fleet.store import FleetStore
from harness.fleet.trends import series_of, trends
from harness.fleet.work import RecordJob
from harness.scoring.acceptance import Demands


def row(day: int, size: float | None, low: float | None, high: float | None, machine: str = "A") -> FleetRow:
    effect = FoundEffect("coulomb", "q", "Fc", size, low, high, "N m", (), ("Fc",), (size,), (low,), (high,), ("N m",))
    when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(job=f"{day}", record=f"r{day}", file="", machine=machine, date=when, verdict="effects_found",
               effects=(effect,))  # fmt: skip


@pytest.mark.parametrize("sign", [",", ";", "\t"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_table_of_records_as_any_spreadsheet_writes_it(sign: str, mark: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time [s],u [N m],theta [rad]\n0,0,0\n")
    table = tmp_path / "fleet.csv"
    table.write_text(
        mark + sign.join(["file", "machine", "date"]) + "\n" + sign.join(["a.csv", "N", "2026-03-02"]) + "\n"
    )
    assert is_fleet(table)
    (found,) = find_records(table)
    assert (found.name, found.machine) == ("a", "N")
    assert found.date is not None
    assert found.date.day == 2


@pytest.mark.parametrize("content", ["", '{"verdict": "effec', "[1]", "{}", '{"verdict": "x", "errors": 3}', None])
def test_a_damaged_report_is_said_where_something_is_demanded_of_it(content: str | None, tmp_path: Path) -> None:
    path = tmp_path / "reports" / "r0" / "report.json"
    path.parent.mkdir(parents=True)
    if content is not None:
        path.write_text(content)
    result = FleetResult(tmp_path, (row(0, 0.1, 0.09, 0.11),), 1)
    assert result.checks(Demands()) == []
    with pytest.raises(InputError, match="the report of a record") as caught:
        result.checks(Demands(fail_on=("unexplained",)))
    assert "report.json" in str(caught.value)


def test_a_report_is_held_against_what_is_demanded(tmp_path: Path) -> None:
    path = tmp_path / "reports" / "r0" / "report.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"verdict": "unexplained", "errors": {"after": {}}, "explained_share": 0.97}))
    rows = (row(0, 0.1, 0.09, 0.11), replace_status(row(1, None, None, None)))
    found = FleetResult(tmp_path, rows, 2).checks(Demands(fail_on=("unexplained",), max_share=0.05))
    assert [(check.subject, check.name, check.passed) for check in found] == [
        ("r0", "verdict", False),
        ("r0", "max-share", True),
        ("r1", "answer", False),
    ]


def replace_status(one: FleetRow) -> FleetRow:
    one.status, one.reason = "crashed", "signal 11"
    return one


def test_sizes_without_a_width_are_no_measurements() -> None:
    rows = [row(k, 0.1 + 0.01 * k, 0.09 + 0.01 * k, 0.11 + 0.01 * k) for k in range(3)]
    rows += [row(3, 9.0, 9.0, 9.0), row(4, 5.0, None, 6.0), row(5, 5.0, 4.0, None)]
    (trend,) = trends(series_of(rows))  # three dates are enough
    assert trend.slope == pytest.approx(0.01)
    (series,) = series_of(rows)
    mean = _mean(series, "A")
    assert mean is not None
    assert mean[0] == pytest.approx(0.11)
    assert _mean(series, "B") is None
    (other,) = series_of([row(0, 9.0, 9.0, 9.0)])
    assert _mean(other, "A") is None
    assert trends(series_of(rows[:2])) == []


def test_the_job_of_a_record_depends_on_every_file_that_it_names(tmp_path: Path) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    (folder / "run.csv").write_text("time [s],u [V],y [V]\n0,0,0\n1,1,1\n")
    (folder / "dataset.toml").write_text(
        'name = "d"\n[signals.u]\nrole = "input"\nunit = "V"\n[signals.y]\nrole = "output"\nunit = "V"\n'
        '[[runs]]\nfile = "run.csv"\nuse = "estimation"\n'
    )
    job = RecordJob(FleetRecord("d", folder / "dataset.toml"), tmp_path, None, (), 1.0)
    before = job.job
    assert RecordJob(job.record, tmp_path, None, (), 1.0).job == before
    (folder / "run.csv").write_text("time [s],u [V],y [V]\n0,0,0\n1,1,2\n")
    assert RecordJob(job.record, tmp_path, None, (), 1.0).job != before
    assert (
        RecordJob(job.record, tmp_path, "pendulum", (), 1.0).job != RecordJob(job.record, tmp_path, None, (), 1.0).job
    )


def test_rows_are_those_that_are_finished_and_those_at_work(tmp_path: Path) -> None:
    store = FleetStore(tmp_path)
    assert store.rows() == {}
    done, late = row(0, 0.1, 0.09, 0.11), row(1, 0.2, 0.19, 0.21)
    (tmp_path / "rows.jsonl").write_bytes(encoded(done) + b"\n")
    store.shards.mkdir()
    (store.shards / "1.json").write_bytes(encoded(late))
    assert list(store.rows()) == ["0", "1"]
    assert store.rows()["1"].effects[0].size == 0.2
