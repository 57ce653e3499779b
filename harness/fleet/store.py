"""The folder of a fleet: a shard for each record while it runs, two tables when it is done, and all reports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from harness import __version__
from harness.data.whole_files import whole_file, write_text
from harness.errors import InputError
from harness.fleet.row import FleetRow, encoded, read
from harness.jobs.manifest import read_manifest
from harness.jobs.query import QueryResult, ask
from harness.jobs.stored import Within, reading

FORMAT = "sysid-harness/fleet/1"
MANIFEST, ROWS = "fleet.json", "rows.jsonl"


class FleetSettings(msgspec.Struct):
    """What decides the answers of a fleet beside its records."""

    model: str | None
    undriven: list[str]


class FleetManifest(msgspec.Struct):
    """What ``fleet.json`` says."""

    format: str
    settings: FleetSettings
    jobs: list[str]
    version: str = ""


@dataclass(frozen=True)
class FleetStore:
    """The files of one fleet in ``folder``."""

    folder: Path

    shards = Within("shards")  # Folder of the rows of a run that is not finished.
    reports = Within("reports")  # Folder of the reports, one folder a record.
    page = Within("fleet.html")  # The page for a reader.
    log = Within("fleet.log")  # One line for each row as it came.

    def open(self, jobs: Sequence[str], settings: dict[str, Any], *, resume: bool) -> dict[str, FleetRow]:
        """Make the folder ready; return the rows that it already has of these jobs.

        Raises InputError if the folder has rows and ``resume`` was not asked for, or was made with another model.
        """
        manifest = self.folder / MANIFEST
        if manifest.exists():
            old = self.manifest()
            if not resume:
                raise InputError(
                    "the folder holds a fleet",
                    expected="a new folder",
                    got=f"{len(self.rows())} rows",
                    remedy="choose another --out, or continue with --resume",
                    file=self.folder,
                )
            if old["settings"] != settings:
                raise InputError(
                    "the folder holds another fleet",
                    expected=str(old["settings"]),
                    got=str(settings),
                    remedy="choose another --out",
                    file=self.folder,
                )
        self.shards.mkdir(parents=True, exist_ok=True)
        content = {"format": FORMAT, "version": __version__, "settings": settings, "jobs": list(jobs)}
        write_text(manifest, json.dumps(content, indent=1) + "\n")
        wanted = set(jobs)
        return {job: row for job, row in self.rows().items() if job in wanted}

    def manifest(self) -> dict[str, Any]:
        """Return the manifest: records, model and options that were asked for.

        Raises InputError if the folder holds no fleet, or one of another format, which is then named.
        """
        command = "'sysid close-loop' over many records"
        return read_manifest(self.folder / MANIFEST, FORMAT, FleetManifest, what="fleet", command=command)

    def rows(self) -> dict[str, FleetRow]:
        """Return the rows by job, finished ones and those of a run that was interrupted."""
        found: dict[str, FleetRow] = {}
        kept = self.folder / ROWS
        if kept.exists():
            with reading(kept):
                found = {row.job: row for row in map(read, kept.read_bytes().splitlines())}
        for path in sorted(self.shards.glob("*.json")) if self.shards.is_dir() else []:
            row = read_shard(path)
            found[row.job] = row
        return found

    def in_order(self) -> list[FleetRow]:
        """Return the rows in the order of the records."""
        found = self.rows()
        return [found[job] for job in self.manifest()["jobs"] if job in found]

    def consolidate(self, *, finished: bool) -> list[FleetRow]:
        """Write all rows and the two tables in the order of the records; remove the shards if all is done."""
        from pyarrow import parquet

        rows = self.in_order()
        write_text(self.folder / ROWS, "".join(encoded(row).decode() + "\n" for row in rows))
        for name, table in tables(rows).items():
            with whole_file(self.folder / f"{name}.parquet") as scratch:
                parquet.write_table(table, scratch, compression="zstd")
        if finished:
            shutil.rmtree(self.shards, ignore_errors=True)
        return rows


def read_shard(path: Path) -> FleetRow:
    """Return the row of a shard.

    Raises InputError if the file is damaged.
    """
    with reading(path, "delete it and continue with --resume: that record is done again"):
        return read(path.read_bytes())


def is_fleet_folder(directory: str | Path) -> bool:
    """Return True if a folder holds a fleet."""
    return (Path(directory) / MANIFEST).is_file()


def query(directory: str | Path, sql: str | None = None, *, filters: Mapping[str, Any] | None = None) -> QueryResult:
    """Ask the rows of a fleet.

    Parameters
    ----------
    directory : path
        Folder that the closed loop over a fleet wrote or is writing.
    sql : str, optional
        DuckDB's SQL over the tables ``records`` (a row for each record) and ``effects`` (a row for each record and
        effect). Without it the answer is ``records``.
    filters : mapping, optional
        Column to value: only such rows, in every table that has the column.

    Raises
    ------
    InputError
        If the folder holds no fleet, or a filter or the query cannot be used.
    """
    return ask(tables(FleetStore(Path(directory)).in_order()), sql, filters)


def tables(rows: Sequence[FleetRow]) -> dict[str, Any]:
    """Return the rows as Arrow tables ``records`` and ``effects``."""
    import pyarrow as pa

    text, number, texts = pa.string(), pa.float64(), pa.list_(pa.string())
    about = [("record", text), ("machine", text), ("date", pa.timestamp("us"))]
    said = [("status", text), ("reason", text), ("verdict", text), ("adequacy", text), ("stand_in", pa.bool_()),
            ("explained_share", number), ("error_before", number), ("error_after", number), ("seconds", number),
            ("warnings", texts), ("file", text), ("job", text)]  # fmt: skip
    sizes = [("effect", text), ("place", text), ("parameter", text), ("size", number), ("low", number),
             ("high", number), ("unit", text), ("ties", texts), ("parameters", texts), ("values", pa.list_(number)),
             ("lows", pa.list_(number)), ("highs", pa.list_(number)), ("units", texts)]  # fmt: skip
    schemas = {"records": [*about, *said], "effects": [*about, *sizes, ("verdict", text), ("stand_in", pa.bool_())]}

    def plain(row: FleetRow, names: Sequence[tuple[str, Any]], own: Any = None) -> dict[str, Any]:
        found = {name: getattr(own if own is not None and hasattr(own, name) else row, name) for name, _ in names}
        when = None if row.date is None else datetime.fromisoformat(row.date).replace(tzinfo=None)
        return found | {"date": when}

    content = {
        "records": [plain(row, schemas["records"]) for row in rows],
        "effects": [plain(row, schemas["effects"], effect) for row in rows for effect in row.effects],
    }
    return {
        name: pa.Table.from_pylist(content[name], schema=pa.schema(fields, metadata={"format": FORMAT}))
        for name, fields in schemas.items()
    }
