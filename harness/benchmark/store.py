"""The folder of a benchmark: shards while it runs, Parquet files when it is done, and what is left to do.

While it runs, a row is a JSON file until some thousand of them are batched into one Parquet file beside them; both are
readable half-way. ``bench.json`` says what was asked for; ``results.parquet`` holds the rows in the order of the suite
and nothing that
differs from one run to the next; ``timings.parquet`` and ``regret.parquet`` go beside it.
"""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from harness import __version__
from harness.benchmark.columns import FORMAT, arrow_table, columns_of_files, rows_of, write_rows
from harness.benchmark.parts import Cell, Suite, Task
from harness.benchmark.row import Row, read_row
from harness.data.whole_files import write_json
from harness.errors import InputError
from harness.jobs.manifest import read_manifest
from harness.jobs.stored import Within, read_columns, reading

BATCH = 2000  # Rows in one Parquet file of the shards: few files, and little lost in memory while one is written.


class Manifest(msgspec.Struct):
    """What ``bench.json`` says: each cell as job, plant, scenario, identifier and seed."""

    format: str
    suite: str
    cells: list[tuple[str, str, str, str, int]]
    versions: dict[str, str]
    description: str = ""
    planned: int | None = None
    order: list[str] = msgspec.field(default_factory=list)


@dataclass(frozen=True)
class Store:
    """The files of one benchmark in ``folder``."""

    folder: Path
    pending: list[str] = field(default_factory=list, compare=False, repr=False)
    """Jobs whose JSON files wait to be batched."""

    shards = Within("shards")  # Folder of the rows that are not yet in ``results.parquet``.
    results = Within("results.parquet")  # The table of results.
    timings = Within("timings.parquet")  # Seconds of each row.
    curves = Within("regret.parquet")  # Cumulative regret of the online identifiers.
    traces = Within("traces.parquet")  # What the overlays are drawn from.
    overlays = Within("overlays")  # Folder of the overlays, one picture a cell.
    manifest = Within("bench.json")  # What was asked for, and with which versions.
    report = Within("report.html")  # The page for a reader.
    log = Within("bench.log")  # One line for each row as it came.
    probes = Within("probes.json")  # What was found about each FMU before it was scored.

    def open(
        self, suite: Suite, pairs: Sequence[tuple[Task, Cell]], *, resume: bool, order: Sequence[str] = ()
    ) -> dict[str, Row]:
        """Make the folder ready; return the rows that it already has.

        ``order`` holds the jobs of the whole suite where these pairs are a share of it. Raises InputError if the folder
        has results and ``resume`` was not asked for, or has rows of other cells.
        """
        found = self.rows()
        if (found or self.manifest.exists()) and not resume:
            raise InputError(
                "the folder has results",
                expected="a new folder",
                got=f"{len(found)} rows",
                remedy="choose another with --out, or continue with --resume",
                file=self.folder,
            )
        wanted = {cell.job for _, cell in pairs}
        foreign = [row for row in found.values() if row.job not in wanted]
        if foreign:
            row = foreign[0]
            raise InputError(
                "the folder has rows of other cells",
                expected=f"only cells of suite {suite.name!r} as it is now, with the seeds asked for",
                got=f"{len(foreign)} others, e.g. {row.plant} x {row.scenario} x {row.identifier} seed {row.seed}",
                remedy="choose another folder with --out",
                file=self.folder,
            )
        self.shards.mkdir(parents=True, exist_ok=True)
        content = {
            "format": FORMAT,
            "suite": suite.name,
            "description": suite.description,
            "cells": [[cell.job, t.plant.name, t.scenario.name, cell.identifier.name, t.seed] for t, cell in pairs],
            "versions": versions(),
        }
        if order:
            content["order"] = list(order)
        write_json(self.manifest, content)
        return found

    def shares(self) -> list[Store]:
        """Return the stores of a job array that lie in this folder."""
        return [Store(path) for path in sorted(self.folder.glob("shard-*-of-*")) if (path / "bench.json").is_file()]

    def merge(self) -> None:
        """Put the shares of a job array together, in the suite's order; shares that are missing are cells not run.

        Raises InputError if the shares are of different suites.
        """
        shares = self.shares()
        if not shares:
            return
        contents = [share.read_manifest() for share in shares]
        first = contents[0]
        for share, content in zip(shares, contents, strict=True):
            if content["order"] != first["order"] or content["versions"] != first["versions"]:
                raise InputError(
                    "shares that do not belong together",
                    expected=f"the suite, seeds and versions of {shares[0].folder.name}",
                    got="others",
                    remedy="run all shares of one suite with one installation, into a new folder",
                    file=share.folder,
                )
        place = {job: k for k, job in enumerate(first["order"])}
        with reading(shares[0].manifest):
            cells = sorted((cell for content in contents for cell in content["cells"]), key=lambda cell: place[cell[0]])
        rows = {job: row for share in shares for job, row in share.rows().items()}
        planned = len(first["order"])
        whole = {key: first[key] for key in ("format", "suite", "description", "versions")}
        write_json(self.manifest, {**whole, "planned": planned, "cells": cells})
        self.write([rows[cell[0]] for cell in cells if cell[0] in rows])

    def read_manifest(self) -> dict[str, Any]:
        """Return the manifest: suite, cells and versions that were asked for.

        Raises InputError if the folder is no folder of a benchmark, or one of another format, which is then named.
        """
        return read_manifest(self.manifest, FORMAT, Manifest, what="benchmark", command="'sysid bench --out'")

    def rows(self) -> dict[str, Row]:
        """Return all rows of the folder by job: of the Parquet files, then of the shards."""
        found: dict[str, Row] = {}
        if self.results.exists():
            found.update(rows_of([path for path in self._tables() if path.exists()]))
        for path in sorted(self.shards.glob("*.parquet")) if self.shards.is_dir() else []:
            found.update(rows_of([path]))
        for path in sorted(self.shards.glob("*.json")) if self.shards.is_dir() else []:
            row = read_row(path)
            found[row.job] = row
        return found

    def finished(self, jobs: Sequence[str]) -> None:
        """Note that these rows are there and no worker will look for them; batch them when there are many."""
        self.pending.extend(jobs)
        if len(self.pending) < BATCH:
            return
        files = [path for job in self.pending if (path := self.shards / f"{job}.json").exists()]
        rows = [read_row(path) for path in files]
        if rows:
            # named by its content: a run that was killed in between writes the same file again
            write_rows(self.shards / f"{rows[0].job}.parquet", list(Row.__struct_fields__), rows)
            for path in files:
                path.unlink(missing_ok=True)
        self.pending.clear()

    def consolidate(self, *, finished: bool) -> list[Row]:
        """Write the Parquet files from all rows in the suite's order; remove the shards if all is done."""
        found = self.rows()
        if not finished and not self.waiting() and self.results.exists():
            return list(found.values())  # they lie in the suite's order already
        order = [cell[0] for cell in self.read_manifest()["cells"]]
        rows = [found[job] for job in order if job in found]
        self.write(rows)
        if finished:
            shutil.rmtree(self.shards, ignore_errors=True)
        return rows

    def waiting(self) -> bool:
        """Return True if there are rows that are not in ``results.parquet`` yet."""
        return any(self.shards.glob("*.json")) or any(self.shards.glob("*.parquet"))

    def arrow(self) -> dict[str, Any]:
        """Return results, timings, regret and traces as Arrow tables by name, with the rows that are still in shards.

        What a version before this one did not write is left out.
        """
        if self.results.exists() and not self.waiting():
            return {path.stem: read_columns(path) for path in self._tables() if path.exists()}
        rows = list(self.rows().values())
        pairs = zip(self._tables(), columns_of_files(), strict=True)
        return {path.stem: arrow_table(names, _with(rows, names)) for path, names in pairs}

    def write(self, rows: Sequence[Row]) -> None:
        """Write the tables; the results come last, so that where they are the others are too."""
        for path, names in reversed(list(zip(self._tables(), columns_of_files(), strict=True))):
            write_rows(path, names, _with(rows, names))

    def _tables(self) -> tuple[Path, Path, Path, Path]:
        """Return the Parquet files, in the order of their columns."""
        return self.results, self.timings, self.curves, self.traces


def _with(rows: Sequence[Row], names: Sequence[str]) -> Sequence[Row]:
    """Return the rows that have something in the last of these columns where it is a list that may be empty."""
    last = names[-1]
    return [row for row in rows if getattr(row, last)] if last.startswith(("curve", "trace")) else rows


def versions() -> dict[str, str]:
    """Return the versions that the results depend on."""
    found = {"sysid-harness": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "casadi", "fmpy", "pybullet", "pymunk", "control", "pyarrow"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
