"""The folder of a benchmark: shards while it runs, Parquet files when it is done, and what is left to do.

While it runs, a row is a JSON file until some thousand of them are batched into one Parquet file beside them; both are
readable half-way. ``bench.json`` says what was asked for; ``results.parquet`` holds the rows in the order of the suite
and nothing that
differs from one run to the next; ``timings.parquet`` and ``regret.parquet`` go beside it.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness import __version__
from harness.benchmark.row import Row, read_row
from harness.benchmark.suite import Cell, Suite, Task
from harness.errors import InputError

__all__ = ["Store"]

FORMAT = "sysid-harness/bench/1"
UNITS = {
    **{name: "1" for name in ("equation_error", "simulation_error", "noise_floor")},
    "memory_mib": "MiB",
    **{name: "see the column units, one for each output" for name in ("equation_rms", "simulation_rms")},
    **{name: "s" for name in ("horizon", "data_seconds", "fit_seconds", "score_seconds")},
    **{name: "samples" for name in ("burn_in", "samples", "held_out_samples", "curve_steps")},
}
"""Units of the columns, kept in the schema of the Parquet files."""
TIMINGS = ("data_seconds", "fit_seconds", "score_seconds", "memory_mib")
CURVES = ("curve_steps", "curve_regret")
KEYS = ("plant", "scenario", "identifier", "seed")
BATCH = 2000
"""Rows in one Parquet file of the shards: few files, and little lost in memory while one is written."""


@dataclass(frozen=True)
class Store:
    """The files of one benchmark in ``folder``."""

    folder: Path
    pending: list[str] = field(default_factory=list, compare=False, repr=False)
    """Jobs whose JSON files wait to be batched."""

    @property
    def shards(self) -> Path:
        """Folder of the rows that are not yet in ``results.parquet``."""
        return self.folder / "shards"

    @property
    def results(self) -> Path:
        """The table of results."""
        return self.folder / "results.parquet"

    @property
    def timings(self) -> Path:
        """Seconds of each row."""
        return self.folder / "timings.parquet"

    @property
    def curves(self) -> Path:
        """Cumulative regret of the online identifiers."""
        return self.folder / "regret.parquet"

    @property
    def manifest(self) -> Path:
        """What was asked for, and with which versions."""
        return self.folder / "bench.json"

    @property
    def report(self) -> Path:
        """The page for a reader."""
        return self.folder / "report.html"

    @property
    def log(self) -> Path:
        """One line for each row as it came."""
        return self.folder / "bench.log"

    @property
    def probes(self) -> Path:
        """What was found about each FMU before it was scored."""
        return self.folder / "probes.json"

    def open(
        self, suite: Suite, pairs: Sequence[tuple[Task, Cell]], *, resume: bool, order: Sequence[str] = ()
    ) -> dict[str, Row]:
        """Make the folder ready; return the rows that it already has.

        ``order`` holds the jobs of the whole suite where these pairs are a share of it.

        Raises
        ------
        InputError
            If the folder has results and ``resume`` was not asked for, or has rows of other cells.
        """
        try:
            self.shards.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                "folder for the results", expected="a folder that can be made", got=str(error), remedy="choose another"
            ) from error
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
        content = {
            "format": FORMAT,
            "suite": suite.name,
            "description": suite.description,
            "cells": [[cell.job, t.plant.name, t.scenario.name, cell.identifier.name, t.seed] for t, cell in pairs],
            "versions": versions(),
        }
        if order:
            content["order"] = list(order)
        _write_text(self.manifest, json.dumps(content, indent=1))
        return found

    def shares(self) -> list[Store]:
        """Return the stores of a job array that lie in this folder."""
        return [Store(path) for path in sorted(self.folder.glob("shard-*-of-*")) if (path / "bench.json").is_file()]

    def merge(self) -> None:
        """Put the shares of a job array together, in the suite's order; shares that are missing are cells not run.

        Raises
        ------
        InputError
            If the shares are of different suites.
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
        cells = sorted((cell for content in contents for cell in content["cells"]), key=lambda cell: place[cell[0]])
        rows = {job: row for share in shares for job, row in share.rows().items()}
        planned = len(first["order"])
        whole = {key: first[key] for key in ("format", "suite", "description", "versions")}
        _write_text(self.manifest, json.dumps({**whole, "planned": planned, "cells": cells}, indent=1))
        self.write([rows[cell[0]] for cell in cells if cell[0] in rows])

    def read_manifest(self) -> dict[str, Any]:
        """Return what was asked for.

        Raises
        ------
        InputError
            If the folder is no folder of a benchmark.
        """
        try:
            content = json.loads(self.manifest.read_text(encoding="utf-8"))
            known = content["format"] == FORMAT
        except (OSError, ValueError, KeyError, TypeError):
            known = False
        if not known:
            raise InputError(
                "no benchmark here",
                expected=f"a folder with a {self.manifest.name} of format {FORMAT}",
                got="none" if not self.manifest.exists() else "something else",
                remedy="give the folder that 'sysid bench --out' wrote",
                file=self.folder,
            )
        return dict(content)

    def rows(self) -> dict[str, Row]:
        """Return all rows of the folder by job: of the Parquet files, then of the shards."""
        found: dict[str, Row] = {}
        if self.results.exists():
            found.update(self._from_parquet())
        for path in sorted(self.shards.glob("*.parquet")) if self.shards.is_dir() else []:
            found.update(_rows_of([path]))
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
            _write_rows(self.shards / f"{rows[0].job}.parquet", list(Row.__struct_fields__), rows)
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

    def arrow(self) -> list[Any]:
        """Return results, timings and regret as Arrow tables, with the rows that are still in shards."""
        from pyarrow import parquet

        if self.results.exists() and not self.waiting():
            return [parquet.read_table(path) for path in (self.results, self.timings, self.curves)]
        rows = list(self.rows().values())
        results, timings, curves = _columns()
        return [_table(results, rows), _table(timings, rows), _table(curves, [row for row in rows if row.curve_steps])]

    def write(self, rows: Sequence[Row]) -> None:
        """Write the three tables."""
        results, timings, curves = _columns()
        _write_rows(self.timings, timings, rows)
        _write_rows(self.curves, curves, [row for row in rows if row.curve_steps])
        _write_rows(self.results, results, rows)

    def _from_parquet(self) -> dict[str, Row]:
        """Return the rows of the Parquet files by job."""
        return _rows_of([path for path in (self.results, self.timings, self.curves) if path.exists()])


def _rows_of(paths: Sequence[Path]) -> dict[str, Row]:
    """Return the rows whose columns lie in these Parquet files, by job; columns of other versions are left out."""
    from pyarrow import parquet

    known = set(Row.__struct_fields__)
    found: dict[str, Row] = {}
    for path in paths:
        table = parquet.read_table(path)
        names = [name for name in table.column_names if name in known]
        columns = [table.column(name).to_pylist() for name in names]
        jobs = columns[names.index("job")]
        if "status" in names:
            found.update(
                (job, Row(**dict(zip(names, values, strict=True))))
                for job, values in zip(jobs, zip(*columns, strict=True), strict=True)
            )
            continue
        for name, column in zip(names, columns, strict=True):
            for job, value in zip(jobs, column, strict=True):
                if job in found:
                    setattr(found[job], name, value)
    return found


def _columns() -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the columns of results, timings and curves."""
    scores = [name for name in Row.__struct_fields__ if name not in (*TIMINGS, *CURVES, "job")]
    return (*scores, "job"), ("job", *KEYS, *TIMINGS), ("job", *KEYS, *CURVES)


def _table(names: Sequence[str], rows: Sequence[Row]) -> Any:
    """Return some fields of rows as an Arrow table; units go into the schema."""
    import pyarrow as pa

    fields = [
        pa.field(name, _arrow_type(name), metadata={"unit": UNITS[name]} if name in UNITS else None) for name in names
    ]
    columns = [pa.array([getattr(row, one.name) for row in rows], type=one.type) for one in fields]
    return pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata={"format": FORMAT}))


def _write_rows(path: Path, names: Sequence[str], rows: Sequence[Row]) -> None:
    """Write some fields of rows to a Parquet file, whole or not at all."""
    from pyarrow import parquet

    scratch = path.with_suffix(".parquet-part")
    parquet.write_table(_table(names, rows), scratch, compression="zstd")
    scratch.replace(path)


def versions() -> dict[str, str]:
    """Return the versions that the results depend on."""
    found = {"sysid-harness": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "casadi", "fmpy", "pybullet", "pymunk", "control", "pyarrow"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _arrow_type(name: str) -> Any:
    """Return the column type of a field of Row."""
    import pyarrow as pa

    hint = str(Row.__annotations__[name])
    if hint.startswith("list"):
        inner = pa.string() if "str" in hint else pa.int64() if "int" in hint else pa.float64()
        return pa.list_(inner)
    for word, made in (("str", pa.string()), ("bool", pa.bool_()), ("int", pa.int64())):
        if hint.startswith(word):
            return made
    return pa.float64()


def _write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    scratch = path.with_name(path.name + ".part")
    scratch.write_text(text + "\n", encoding="utf-8")
    scratch.replace(path)
