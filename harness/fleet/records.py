"""Which records a fleet has: a folder, a pattern, or a table of files with machine and date."""

from __future__ import annotations

import csv
import glob
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from harness import registry
from harness.data.trajectories import BESIDE
from harness.errors import InputError

COLUMNS = ("file", "machine", "date", "validation")  # Of a table of records; all but the first may be left out.
SUFFIXES = (".csv", ".parquet", ".feather", ".xlsx", ".toml")
"""What counts as a record in a folder: bare tables, and data sets that describe themselves."""
WILD = "*?["


@dataclass(frozen=True)
class FleetRecord:
    """One record of a fleet.

    Parameters
    ----------
    name : str
        Its path below what all records have in common, without ending.
    file : Path
        A ``dataset.toml``, or a table whose columns carry the names of the model's ports.
    machine : str
        Empty where nobody told.
    date : datetime, optional
        In UTC where the table gives offsets from it.
    validation : Path, optional
        File beside a bare table.
    """

    name: str
    file: Path
    machine: str = ""
    date: datetime | None = None
    validation: Path | None = None


def is_fleet(source: str | Path) -> bool:
    """Return True for what names many records: a folder, a pattern, or a CSV file with a column ``file``.

    A bare name that is a registered recording stays one, whatever folders there are.

    Examples
    --------
    >>> is_fleet("runs/*.csv"), is_fleet("emps")
    (True, False)
    """
    path = Path(source)
    if str(source) in {entry.id for entry in registry.entries("recordings")}:
        return False
    return path.is_dir() or (_is_pattern(source) and not path.exists()) or _is_table(path)


def find_records(source: str | Path) -> tuple[FleetRecord, ...]:
    """Return the records of a fleet in a fixed order: that of the table, or of the names.

    Raises
    ------
    InputError
        If there are none, a file is missing or named twice, a date cannot be read, or a column is unknown.
    """
    path = Path(source)
    if path.is_dir():
        return _named(_in_folder(path), source)
    if _is_table(path):
        return _in_table(path)
    found = [Path(name) for name in sorted(glob.glob(str(source), recursive=True)) if not name.endswith(BESIDE)]
    return _named(found, source)


def _is_pattern(source: str | Path) -> bool:
    return any(sign in str(source) for sign in WILD)


def _is_table(path: Path) -> bool:
    """Return True for a CSV file whose header has the column ``file``; a record has columns of numbers."""
    if path.suffix != ".csv" or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        first = file.readline()
    return COLUMNS[0] in [cell.strip() for cell in next(csv.reader([first], delimiter=_delimiter(first)), [])]


def _delimiter(header: str) -> str:
    """Return what separates the columns of a table of records: a comma, or what spreadsheets of other countries write.

    Examples
    --------
    >>> _delimiter("file,machine"), _delimiter("file;machine;date"), _delimiter("file")
    (',', ';', ',')
    """
    return max(",;\t", key=header.count)


def _in_folder(folder: Path) -> list[Path]:
    """Return the records of a folder: what describes itself, or else bare tables; and folders with a ``dataset.toml``.

    Tables beside a description belong to it.
    """
    if (folder / "dataset.toml").is_file():
        raise InputError(
            "folder of records",
            expected="many records",
            got="one data set",
            remedy=f"give the data set itself: {folder / 'dataset.toml'}",
            file=folder,
        )
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix in SUFFIXES]
    files = [path for path in files if path.suffix == ".toml"] or files
    tables = [path for path in files if _is_table(path)]
    if tables:
        raise InputError(
            "folder of records",
            expected="records only",
            got=f"a table of records ({tables[0].name}) among them",
            remedy=f"give the table itself: {tables[0]}",
            file=folder,
        )
    return sorted([*files, *(path for path in folder.glob("*/dataset.toml"))])


def _named(files: Sequence[Path], source: str | Path) -> tuple[FleetRecord, ...]:
    """Return records named by their paths."""
    if not files:
        raise InputError(
            "records of a fleet",
            expected=f"files that end in {', '.join(SUFFIXES)}, or folders with a dataset.toml",
            got="none",
            remedy="correct the folder or the pattern (in quotes, so that the shell leaves it alone)",
            file=str(source),
        )
    common = Path(*_common([path.parent.parts for path in files]))
    records = []
    for path in files:
        below = path.relative_to(common)
        records.append(FleetRecord(str(below.parent if below.name == "dataset.toml" else below.with_suffix("")), path))
    return _different(records, source)


def _common(parts: Sequence[tuple[str, ...]]) -> list[str]:
    """Return what paths begin with; one level less where a record is the folder itself."""
    first = list(parts[0])
    while any(list(other[: len(first)]) != first for other in parts):
        first.pop()
    return first[:-1] if len(set(parts)) == 1 and len(parts) == 1 and first else first


def _in_table(path: Path) -> tuple[FleetRecord, ...]:
    """Return the records of a table; files are relative to it."""
    with _csv_text(path), path.open(encoding="utf-8-sig", newline="") as file:
        header = file.readline()
        file.seek(0)
        reader = csv.DictReader(file, skipinitialspace=True, delimiter=_delimiter(header))
        names = [name.strip() for name in reader.fieldnames or ()]
        unknown = [name for name in names if name not in COLUMNS]
        if unknown:
            raise InputError(
                "table of records", expected=f"the columns {', '.join(COLUMNS)}", got=repr(unknown[0]),
                remedy="remove or rename it", file=path,
            )  # fmt: skip
        reader.fieldnames = names
        rows = [(number, {key: (value or "").strip() for key, value in row.items() if key}) for number, row in
                enumerate(reader, start=2)]  # fmt: skip
    records = []
    for number, row in rows:
        file_name = path.parent / row["file"]
        held = path.parent / row["validation"] if row.get("validation") else None
        for wanted in (file_name, held):
            if wanted is not None and not wanted.is_file():
                raise InputError(
                    "record of a fleet", expected="a file", got="no file", remedy="correct the table",
                    file=path, place=f"row {number}: {wanted}",
                )  # fmt: skip
        date = _date(row["date"], path, number) if row.get("date") else None
        name = Path(row["file"])
        name = name.parent if name.name == "dataset.toml" else name.with_suffix("")
        records.append(FleetRecord(str(name), file_name, row.get("machine", ""), date, held))
    if not records:
        raise InputError("table of records", expected="rows", got="none", remedy="fill it", file=path)
    kinds = {record.date.tzinfo is not None for record in records if record.date is not None}
    if len(kinds) > 1:
        raise InputError(
            "dates of a fleet", expected="all with an offset from UTC, or none", got="both",
            remedy="write all dates the same way", file=path,
        )  # fmt: skip
    return _different(records, path)


@contextmanager
def _csv_text(path: Path) -> Iterator[None]:
    """Say of a table that it is no text in UTF-8, or no CSV."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise InputError(
            "table of records", expected="text in UTF-8", got=f"the byte 0x{error.object[error.start]:02x}",
            remedy="save it as CSV UTF-8", file=path,
        ) from error  # fmt: skip
    except csv.Error as error:
        raise InputError(
            "table of records", expected="a CSV file", got=str(error), remedy="save it as CSV UTF-8", file=path
        ) from error


def _date(text: str, path: Path, number: int) -> datetime:
    """Return a date in ISO 8601; one with an offset in UTC."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            "date of a record", expected="ISO 8601, such as 2026-03-01 or 2026-03-01T14:30:00", got=repr(text),
            remedy="write it so", file=path, place=f"row {number}",
        ) from error  # fmt: skip
    return found.astimezone(UTC) if found.tzinfo is not None else found


def _different(records: Sequence[FleetRecord], source: str | Path) -> tuple[FleetRecord, ...]:
    """Refuse two records of one name."""
    seen: set[str] = set()
    for record in records:
        if record.name in seen:
            raise InputError(
                "two records with one name", expected="every record once", got=record.name,
                remedy="rename one, or take it out", file=str(source),
            )  # fmt: skip
        seen.add(record.name)
    return tuple(records)
