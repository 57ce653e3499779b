"""The calls ``bench`` and ``table``: run a suite, keep its rows, read them back."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from harness.benchmark.engines import make_engine
from harness.benchmark.planning import Plan, plan_of, read_shard, share
from harness.benchmark.probes import probe_plants
from harness.benchmark.progress import Progress
from harness.benchmark.row import Row
from harness.benchmark.store import Store
from harness.benchmark.suite import Cell, Task, cells_of, load_suite, tasks_of
from harness.errors import InputError

if TYPE_CHECKING:
    from rich.console import Group

    from harness.benchmark.tables import Summary

__all__ = ["BenchResult", "bench", "plan", "table"]


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
        """The HTML page, where a folder was given."""
        return None if self.folder is None else Store(self.folder).report

    @property
    def ok(self) -> int:
        """Number of rows with status ``ok``."""
        return sum(row.status == "ok" for row in self.rows)

    def summary(self) -> list[Summary]:
        """Return median, quartiles and counts of each plant x scenario x identifier."""
        return self._summary

    @cached_property
    def _summary(self) -> list[Summary]:
        from harness.benchmark.tables import summarise

        return summarise(self.rows, self.cells)

    def table(self) -> Group:
        """Return the table for a terminal (rich)."""
        from harness.benchmark.tables import rich_table

        return rich_table(self)

    def render(self, form: str) -> str:
        """Return the table as ``"markdown"``, ``"latex"`` or ``"csv"``."""
        from harness.benchmark.exports import render

        return render(self, form)

    def query(self, sql: str) -> list[dict[str, Any]]:
        """Return the records of a DuckDB query over the tables ``results``, ``timings`` and ``regret``.

        Raises
        ------
        InputError
            If the benchmark has no folder, or DuckDB refuses the query.
        """
        from harness.benchmark.query import query

        if self.folder is None:
            raise InputError("query", expected="a benchmark in a folder", got="none", remedy="give bench(out=...)")
        return query(self.folder, sql).records()

    def to_records(self) -> list[dict[str, Any]]:
        """Return the rows as plain dictionaries, ready for JSON."""
        return [msgspec.to_builtins(row) for row in self.rows]

    def __str__(self) -> str:
        return f"suite {self.suite}: {self.ok} ok of {len(self.rows)} run, {self.planned} planned"


def bench(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    seeds: tuple[int, int] | Sequence[int] | None = None,
    engine: str = "local",
    resume: bool = False,
    shard: str | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> BenchResult:
    """Run a suite of plants x scenarios x identifiers x seeds.

    Rows are kept as they finish: a run that is interrupted is continued with ``resume``. A cell that fails is a row
    with its status and reason. The results are the same for any number of workers and either engine.

    Parameters
    ----------
    suite : str or path
        Name of a registered suite, or a TOML file.
    out : path, optional
        Folder for ``results.parquet``, ``timings.parquet``, ``regret.parquet``, ``report.html`` and, where there
        are FMUs, ``probes.json``; without it the rows are only returned.
    workers : int, optional
        Processes; by default one for each core.
    seeds : (first, last) or sequence of int, optional
        A pair means all seeds from the first to the last, both included; it replaces the seeds of the suite.
    engine : str
        ``"local"`` or ``"dask://HOST:PORT"``.
    resume : bool
        Continue in a folder that has rows of this suite.
    shard : str, optional
        ``"i/n"``: run the i-th of n shares, in the folder ``shard-i-of-n`` of ``out``; :func:`table` puts the shares
        of a job array together.
    progress : callable, optional
        Called as ``progress(rows_done, rows, what)``; the text has counts by status, rate and time left.

    Returns
    -------
    BenchResult

    Raises
    ------
    InputError
        If the suite, the folder or an option cannot be used.
    KeyboardInterrupt
        If the user interrupts; what was finished is kept.
    """
    read = load_suite(suite)
    everything = tasks_of(read, _seed_list(seeds))
    part = read_shard(shard)
    tasks = share(everything, part)
    made = make_engine(engine, workers)
    if part is not None:
        if out is None:
            raise InputError("a share of a suite", expected="a folder", got="none", remedy="give --out", place="shard")
        order = [cell.job for _, cell in cells_of(everything)]
        store = Store(Path(out) / f"shard-{part[0]}-of-{part[1]}")
        return _run(read, tasks, made, store, resume=resume, progress=progress, report=False, order=order)
    if out is None:
        with tempfile.TemporaryDirectory(prefix="sysid-bench-") as scratch:
            result = _run(read, tasks, made, Store(Path(scratch)), resume=False, progress=progress, report=False)
        return replace(result, folder=None)
    return _run(read, tasks, made, Store(Path(out)), resume=resume, progress=progress, report=True)


def plan(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    seeds: tuple[int, int] | Sequence[int] | None = None,
    shard: str | None = None,
) -> Plan:
    """Return what :func:`bench` with the same arguments would run, and how long it would take; nothing is written.

    Raises
    ------
    InputError
        If the suite or an option cannot be used.
    """
    part = read_shard(shard)
    tasks = share(tasks_of(load_suite(suite), _seed_list(seeds)), part)
    folder = None if out is None else Path(out) / (f"shard-{part[0]}-of-{part[1]}" if part else "")
    store = Store(folder) if folder is not None else Store(Path())
    jobs = {cell.job for task in tasks for cell in task.cells}
    done = jobs & set(store.rows()) if folder is not None and store.manifest.is_file() else set()
    processes = make_engine("local", workers)
    return plan_of(tasks, done, store.timings, getattr(processes, "workers", 1))


def table(directory: str | Path) -> BenchResult:
    """Read a stored benchmark back and render its report anew.

    Parameters
    ----------
    directory : path
        Folder that ``bench`` wrote; one that was interrupted is read as far as it got.

    Raises
    ------
    InputError
        If the folder holds no benchmark.
    """
    store = Store(Path(directory))
    if store.shares():
        store.merge()
        result = _result(store, list(store.rows().values()))
    else:
        store.read_manifest()
        result = _result(store, store.consolidate(finished=False))
    _write_report(result, store)
    return result


def _run(
    suite: Any,
    tasks: Sequence[Task],
    engine: Any,
    store: Store,
    *,
    resume: bool,
    progress: Callable[[int, int, str], None] | None,
    report: bool,
    order: Sequence[str] = (),
) -> BenchResult:
    """Run what is missing in the store and write its files."""
    pairs = cells_of(tasks)
    found = store.open(suite, pairs, resume=resume, order=order)
    todo = [task for task in (_missing(task, found) for task in tasks) if task is not None]
    moved = Progress(store, len(pairs), len(found), progress)

    if progress is not None:
        progress(len(found), len(pairs), suite.name)
    finished = False
    try:
        if report:
            probe_plants(todo, store.probes)
        if todo:
            engine.run(todo, store.shards, moved)
        finished = True
    finally:
        rows = store.consolidate(finished=finished)
    result = _result(store, rows)
    if report:
        _write_report(result, store)
    return result


def _missing(task: Task, found: dict[str, Row]) -> Task | None:
    """Return the task with the cells that have no row yet."""
    left: tuple[Cell, ...] = tuple(cell for cell in task.cells if cell.job not in found)
    return msgspec.structs.replace(task, cells=left) if left else None


def _result(store: Store, rows: Sequence[Row]) -> BenchResult:
    """Return what a folder holds."""
    content = store.read_manifest()
    cells = tuple(dict.fromkeys((str(c[1]), str(c[2]), str(c[3])) for c in content["cells"]))
    return BenchResult(
        suite=content["suite"],
        rows=tuple(rows),
        planned=content.get("planned", len(content["cells"])),
        folder=store.folder,
        versions=content["versions"],
        cells=cells,
        description=content["description"],
    )


def _write_report(result: BenchResult, store: Store) -> None:
    """Write the HTML page."""
    from harness.benchmark.report import render_html

    scratch = store.report.with_name("report.part")
    scratch.write_text(render_html(result), encoding="utf-8")
    scratch.replace(store.report)


def _seed_list(seeds: tuple[int, int] | Sequence[int] | None) -> list[int] | None:
    """Return the seeds of a pair (first, last) or of a list."""
    if seeds is None:
        return None
    numbers = [int(seed) for seed in seeds]
    if isinstance(seeds, tuple) and len(numbers) == 2:
        numbers = list(range(numbers[0], numbers[1] + 1))
    if not numbers or min(numbers) < 0:
        raise InputError(
            "seeds",
            expected="(first, last) with 0 <= first <= last, or a list",
            got=repr(seeds),
            remedy="correct it",
            place="seeds",
        )
    return list(dict.fromkeys(numbers))
