"""Which records a fleet has, and what is refused with which words."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from harness.errors import InputError
from harness.fleet import find_records, is_fleet


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("time [s],u [N m],theta [rad]\n0,0,0\n")


def test_a_folder_a_pattern_and_a_table_name_the_same_records(tmp_path: Path) -> None:
    touch(tmp_path / "runs" / "a.csv", tmp_path / "runs" / "b.csv")
    table = tmp_path / "fleet.csv"
    table.write_text("file, machine, date\nruns/b.csv, north, 2026-03-02\nruns/a.csv,,\n")
    for source in (tmp_path / "runs", f"{tmp_path}/runs/*.csv"):
        assert is_fleet(source)
        assert [(record.name, record.machine, record.date) for record in find_records(source)] == [
            ("a", "", None),
            ("b", "", None),
        ]
    assert is_fleet(table)
    first, second = find_records(table)
    assert (first.name, first.machine, first.date) == ("runs/b", "north", datetime(2026, 3, 2))
    assert first.file.samefile(tmp_path / "runs" / "b.csv")
    assert (second.machine, second.date) == ("", None)


def test_one_record_is_no_fleet(tmp_path: Path) -> None:
    touch(tmp_path / "a.csv")
    assert not is_fleet(tmp_path / "a.csv")
    assert not is_fleet("emps")


def test_tables_beside_descriptions_belong_to_them(tmp_path: Path) -> None:
    touch(tmp_path / "a.csv", tmp_path / "a.toml", tmp_path / "deep" / "dataset.toml", tmp_path / "deep" / "x.csv")
    assert [record.name for record in find_records(tmp_path)] == ["a", "deep"]
    touch(tmp_path / "dataset.toml")
    with pytest.raises(InputError, match="one data set"):
        find_records(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("file,operator\na.csv,me\n", "operator"),
        ("file\nmissing.csv\n", "row 2"),
        ("file,date\na.csv,1.3.2026\n", "ISO 8601"),
        ("file\na.csv\na.csv\n", "two records"),
        ("file\n", "rows"),
        ("file,date\na.csv,2026-01-01T00:00:00+01:00\nb.csv,2026-01-02\n", "offset"),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, text: str, says: str) -> None:
    touch(tmp_path / "a.csv", tmp_path / "b.csv")
    table = tmp_path / "fleet.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=says):
        find_records(table)


def test_dates_with_an_offset_are_kept_in_utc(tmp_path: Path) -> None:
    touch(tmp_path / "a.csv")
    table = tmp_path / "fleet.csv"
    table.write_text("file,date\na.csv,2026-01-01T00:30:00+01:00\n")
    assert find_records(table)[0].date == datetime(2025, 12, 31, 23, 30, tzinfo=UTC)


def test_an_empty_folder_and_a_table_in_a_folder_are_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got none"):
        find_records(tmp_path)
    touch(tmp_path / "a.csv")
    (tmp_path / "fleet.csv").write_text("file\na.csv\n")
    with pytest.raises(InputError, match="give the table itself"):
        find_records(tmp_path)
