"""What a benchmark gives back: its rows, what was asked for, and where the files are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from harness.benchmark.query import query
from harness.benchmark.row import Row
from harness.benchmark.store import Store
from harness.benchmark.summary import Summary, summarise
from harness.errors import InputError


@dataclass(frozen=True, eq=False)
class BenchResult:
    """A finished (or partly finished) benchmark.

    Parameters
    ----------
    suite : str
        Its name.
    rows : tuple of Row
        In the suite's order.
    planned : int
        Number of cells that were asked for.
    folder : Path, optional
        Where the files are; None if nothing was kept.
    versions : dict
        Of the packages that the results depend on.
    cells : tuple
        The cells asked for, as (plant, scenario, identifier), seeds apart.
    description : str
        Of the suite.
    """

    suite: str
    rows: tuple[Row, ...]
    planned: int
    folder: Path | None
    versions: dict[str, str]
    cells: tuple[tuple[str, str, str], ...]
    description: str = ""

    @property
    def report(self) -> Path | None:
        """The HTML page, where a folder was given and it is not that of a share of a job array."""
        page = None if self.folder is None else Store(self.folder).report
        return page if page is not None and page.is_file() else None

    @property
    def ok(self) -> int:
        """Number of rows with status ``ok``."""
        return sum(row.status == "ok" for row in self.rows)

    def summary(self) -> list[Summary]:
        """Return median, quartiles and counts of each plant x scenario x identifier."""
        return self._summary

    @cached_property
    def _summary(self) -> list[Summary]:
        return summarise(self.rows, self.cells)

    def query(self, sql: str) -> list[dict[str, Any]]:
        """Return the records of a DuckDB query over the tables ``results``, ``timings`` and ``regret``.

        Raises
        ------
        InputError
            If the benchmark has no folder, or DuckDB refuses the query.
        """
        if self.folder is None:
            raise InputError("query", expected="a benchmark in a folder", got="none", remedy="give bench(out=...)")
        return query(self.folder, sql).records()

    def to_records(self) -> list[dict[str, Any]]:
        """Return the rows as plain dictionaries, ready for JSON."""
        return [msgspec.to_builtins(row) for row in self.rows]

    def __str__(self) -> str:
        return f"suite {self.suite}: {self.ok} ok of {len(self.rows)} run, {self.planned} planned"
