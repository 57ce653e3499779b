"""The rows of a study on disk: one line of CSV as soon as it is known, so that nothing computed is lost."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.data.whole_files import whole_file, write_text
from harness.errors import InputError, unread
from harness.fingerprint import own_code
from harness.jobs import shard_file
from sysid_lab.row import COLUMNS

ROWS, CODE = "rows.csv", "code.txt"
AGAIN = ("crashed", "timeout")  # What a resumed study tries once more.


class RowStore:
    """Rows by key in ``folder/rows.csv``.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    resume : bool
        Keep what is there, but for rows that crashed or took too long: those are tried once more.
    force : bool
        Begin anew.

    Raises
    ------
    InputError
        If there are rows, and neither is wanted; if other code made them; or the file is no table of rows.
    """

    def __init__(self, folder: Path, *, resume: bool = False, force: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path, self.shards = folder / ROWS, folder / "shards"
        if self.path.exists() and not (resume or force):
            raise InputError(
                "the folder holds a study",
                expected="a new folder",
                got=f"{ROWS} with rows",
                remedy="--resume continues it, --force begins anew",
                file=folder,
            )
        self.rows: dict[str, dict[str, str]] = {}
        if self.path.exists() and resume and not force:
            self.rows = {key: row for key, row in read_rows(self.path).items() if row["status"] not in AGAIN}
        made_by = folder / CODE
        if self.path.exists() and not force and (not made_by.is_file() or made_by.read_text("utf-8") != own_code()):
            raise InputError(
                "the rows of the folder were made by other code",
                expected="one study by one state of the code",
                got="sysid-harness has changed since",
                remedy="choose a new folder, or begin anew with --force",
                file=self.path,
            )
        write_text(made_by, own_code())
        if force:
            shutil.rmtree(self.shards, ignore_errors=True)
        self.shards.mkdir(exist_ok=True)
        # Written anew: the line at which a run was killed may be half there.
        with whole_file(self.path) as scratch:
            lines = map(_line, [dict(zip(COLUMNS, COLUMNS, strict=True)), *self.rows.values()])
            scratch.write_text("".join(lines), "utf-8")
        for path in sorted(self.shards.glob("*.json")):  # of a run that ended before it had taken them
            if json.loads(path.read_bytes()).get("status") in AGAIN:
                path.unlink()
            else:
                self.take(path.stem)

    def take(self, job: str) -> bool:
        """Take over the shard of a job that has run; return False for an empty one, of a row that was not begun."""
        shard = shard_file(self.shards, job)
        row = json.loads(shard.read_bytes())
        if row:
            self.add(row)
        shard.unlink()
        return bool(row)

    def close(self) -> None:
        """Put the folder of the shards away; one that still has some stays."""
        with contextlib.suppress(OSError):
            self.shards.rmdir()

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row and see that it is on the disk."""
        text = {name: str(row.get(name, "")) for name in COLUMNS}
        with self.path.open("a", encoding="utf-8", newline="") as file:
            file.write(_line(text))
            file.flush()
            os.fsync(file.fileno())
        self.rows[text["key"]] = text


def read_rows(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a file by key; a line that is only half there is left out.

    Raises
    ------
    InputError
        If the file is not readable, or no table of a study.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "rows of a study", expected="a CSV file", got=unread(path, error), remedy="check the folder", file=path
        ) from error
    whole = text if text.endswith("\n") else text[: text.rfind("\n") + 1]
    reader = csv.DictReader(io.StringIO(whole))
    missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise InputError(
            "rows of a study",
            expected=f"the columns {', '.join(COLUMNS)}",
            got=f"no {missing[0]}",
            remedy="rows of another version: begin anew in a new folder",
            file=path,
        )
    return {row["key"]: {name: row.get(name) or "" for name in COLUMNS} for row in reader if row["key"]}


def _line(row: Mapping[str, str]) -> str:
    """Return a row as a line of CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow([row[name] for name in COLUMNS])
    return buffer.getvalue()
