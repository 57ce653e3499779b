"""The folder of a benchmark: shards while it runs, Parquet files when it is done, and what is left to do.

``bench.json`` says what was asked for; ``results.parquet`` holds the rows in the suite's order and nothing that
differs from one run to the next; ``timings.parquet`` and ``regret.parquet`` go beside it.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from harness import __version__
from harness.benchmark.row import Row, read_row
from harness.benchmark.suite import Cell, Suite, Task
from harness.errors import InputError

__all__ = ["Store"]

FORMAT = "sysid-harness/bench/1"
TIMINGS = ("data_seconds", "fit_seconds", "score_seconds")
CURVES = ("curve_steps", "curve_regret")
KEYS = ("plant", "scenario", "identifier", "seed")


@dataclass(frozen=True)
class Store:
    """The files of one benchmark in ``folder``."""

    folder: Path

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
    def probes(self) -> Path:
        """What was found about each FMU before it was scored."""
        return self.folder / "probes.json"

    def open(self, suite: Suite, pairs: Sequence[tuple[Task, Cell]], *, resume: bool) -> dict[str, Row]:
        """Make the folder ready; return the rows that it already has.

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
        _replace_text(self.manifest, json.dumps(content, indent=1))
        return found

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
        for path in sorted(self.shards.glob("*.json")) if self.shards.is_dir() else []:
            row = read_row(path)
            found[row.job] = row
        return found

    def count(self) -> int:
        """Return the number of shards."""
        return sum(1 for _ in self.shards.glob("*.json"))

    def consolidate(self, *, finished: bool) -> list[Row]:
        """Write the Parquet files from all rows in the suite's order; remove the shards if all is done."""
        import pyarrow as pa
        from pyarrow import parquet

        found = self.rows()
        order = [cell[0] for cell in self.read_manifest()["cells"]]
        rows = [found[job] for job in order if job in found]

        def write(path: Path, names: Sequence[str], chosen: Sequence[Row]) -> None:
            schema = pa.schema([(name, _arrow_type(name)) for name in names])
            records = [{name: getattr(row, name) for name in names} for row in chosen]
            scratch = path.with_suffix(".parquet-part")
            parquet.write_table(pa.Table.from_pylist(records, schema=schema), scratch, compression="zstd")
            scratch.replace(path)

        names = [name for name in Row.__struct_fields__ if name not in (*TIMINGS, *CURVES, "job")]
        write(self.timings, ("job", *KEYS, *TIMINGS), rows)
        write(self.curves, ("job", *KEYS, *CURVES), [row for row in rows if row.curve_steps])
        write(self.results, (*names, "job"), rows)
        if finished:
            shutil.rmtree(self.shards, ignore_errors=True)
        return rows

    def _from_parquet(self) -> dict[str, Row]:
        """Return the rows of the Parquet files by job."""
        from pyarrow import parquet

        records: dict[str, dict[str, Any]] = {}
        for path in (self.results, self.timings, self.curves):
            if path.exists():
                for record in parquet.read_table(path).to_pylist():
                    records.setdefault(record["job"], {}).update(record)
        return {job: msgspec.convert(record, Row) for job, record in records.items() if "status" in record}


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


def _replace_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    scratch = path.with_name(path.name + ".part")
    scratch.write_text(text + "\n", encoding="utf-8")
    scratch.replace(path)
