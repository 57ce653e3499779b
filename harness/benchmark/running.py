"""The calls ``bench`` and ``table``: run a suite, keep its rows, read them back."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from harness.benchmark.page.overlays import draw_overlays
from harness.benchmark.page.report import render_html
from harness.benchmark.parts import Cell, Task
from harness.benchmark.planning import Plan, plan_of, read_shard, share
from harness.benchmark.probes import probe_plants
from harness.benchmark.result import BenchResult
from harness.benchmark.row import Row, read_row
from harness.benchmark.store import Store
from harness.benchmark.suite import cells_of, load_suite, tasks_of
from harness.benchmark.work import CellBatch
from harness.data.whole_files import write_text
from harness.errors import InputError
from harness.jobs import make_engine, run_jobs, shard_file
from harness.jobs.alone import alone_in
from harness.jobs.progress import Progress

TRACES = ("first", "all", "none")
"""Seeds whose cells keep what their overlays are drawn from."""


def bench(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    seeds: tuple[int, int] | Sequence[int] | None = None,
    engine: str = "local",
    resume: bool = False,
    shard: str | None = None,
    traces: str = "first",
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
        Folder for ``results.parquet``, ``timings.parquet``, ``regret.parquet``, ``traces.parquet``, ``report.html``
        with its ``overlays`` and, where there are FMUs, ``probes.json``; without it the rows are only returned.
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
    traces : {"first", "all", "none"}
        Seeds whose cells keep their first held-out record, measured and simulated, for an overlay: the first seed of
        each plant and scenario, all, or none.
    progress : callable, optional
        Called as ``progress(rows_done, rows, what)``; the text has counts by status, rate and time left.

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
    made = make_engine(engine, workers)
    batches = share(_batches(everything, traces), part)
    if part is not None:
        if out is None:
            raise InputError("a share of a suite", expected="a folder", got="none", remedy="give --out", place="shard")
        order = [cell.job for _, cell in cells_of(everything)]
        store = Store(Path(out) / f"shard-{part[0]}-of-{part[1]}")
        return _run(read, batches, made, store, resume=resume, progress=progress, report=False, order=order)
    if out is None:
        with tempfile.TemporaryDirectory(prefix="sysid-bench-") as scratch:
            result = _run(read, batches, made, Store(Path(scratch)), resume=False, progress=progress, report=False)
        return replace(result, folder=None)
    return _run(read, batches, made, Store(Path(out)), resume=resume, progress=progress, report=True)


def plan(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    seeds: tuple[int, int] | Sequence[int] | None = None,
    shard: str | None = None,
) -> Plan:
    """Return the cells that :func:`bench` with these arguments would run, and their time; nothing is written.

    Raises
    ------
    InputError
        If the suite or an option cannot be used.
    """
    part = read_shard(shard)
    read = load_suite(suite)
    tasks = share(tasks_of(read, _seed_list(seeds)), part)
    folder = None if out is None else Path(out) / (f"shard-{part[0]}-of-{part[1]}" if part else "")
    store = Store(folder) if folder is not None else Store(Path())
    jobs = {cell.job for task in tasks for cell in task.cells}
    done = jobs & set(store.rows()) if folder is not None and store.manifest.is_file() else set()
    processes = make_engine("local", workers)
    beside = sorted(folder.absolute().parent.glob(f"*/{store.timings.name}")) if folder is not None else []
    return plan_of(tasks, done, [store.timings, *beside], getattr(processes, "workers", 1), read.cell_seconds)


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
    batches: Sequence[CellBatch],
    engine: Any,
    store: Store,
    *,
    resume: bool,
    progress: Callable[[int, int, str], None] | None,
    report: bool,
    order: Sequence[str] = (),
) -> BenchResult:
    """Run what is missing in the store and write its files."""
    with alone_in(store.folder):
        pairs = cells_of([batch.task for batch in batches])
        found = store.open(suite, pairs, resume=resume, order=order)
        todo = list(_missing(batches, found))
        counted = Progress(store.log, len(pairs), len(found), progress)

        def moved(title: str, jobs: Sequence[str]) -> None:
            rows = [read_row(shard_file(store.shards, job)) for job in jobs]
            counted(title, [(row.status, _logged(row)) for row in rows])
            store.finished(jobs)

        if progress is not None:
            progress(len(found), len(pairs), suite.name)
        try:
            if report:
                probe_plants([batch.task for batch in todo], store.probes)
            run_jobs(todo, store.shards, engine=engine, moved=moved)
        except BaseException:
            with suppress(OSError, InputError):  # what ended the run is what is said
                store.consolidate(finished=False)
            raise
        rows = store.consolidate(finished=True)
        result = _result(store, rows)
        if report:
            _write_report(result, store)
    return result


def _batches(tasks: Sequence[Task], traces: str) -> list[CellBatch]:
    """Return the tasks as batches of jobs; those of the chosen seeds keep traces.

    Raises
    ------
    InputError
        If the choice is none of :data:`TRACES`.
    """
    if traces not in TRACES:
        raise InputError("traces", expected=", ".join(TRACES), got=repr(traces), remedy="choose one", place="traces")
    first: dict[tuple[str, str], int] = {}
    for task in tasks:
        first.setdefault((task.plant.name, task.scenario.name), task.seed)

    def kept(task: Task) -> bool:
        return traces == "all" or (traces == "first" and first[task.plant.name, task.scenario.name] == task.seed)

    return [CellBatch(task, trace=kept(task)) for task in tasks]


def _missing(batches: Sequence[CellBatch], found: dict[str, Row]) -> Iterator[CellBatch]:
    """Yield the batches with the cells that have no row yet."""
    for batch in batches:
        left: tuple[Cell, ...] = tuple(cell for cell in batch.task.cells if cell.job not in found)
        if left:
            yield CellBatch(msgspec.structs.replace(batch.task, cells=left), trace=batch.trace)


def _logged(row: Row) -> str:
    """Return what the log says of a row."""
    seconds = row.fit_seconds + row.score_seconds
    why = f": {row.reason}" if row.reason else ""
    return f"{row.plant} x {row.scenario} x {row.identifier} seed {row.seed} {seconds:.2f} s{why}"


def _result(store: Store, rows: Sequence[Row]) -> BenchResult:
    """Return what a folder holds."""
    content = store.read_manifest()
    cells = tuple(dict.fromkeys((c[1], c[2], c[3]) for c in content["cells"]))
    return BenchResult(
        suite=content["suite"],
        rows=tuple(rows),
        planned=content["planned"] or len(content["cells"]),
        folder=store.folder,
        versions=content["versions"],
        cells=cells,
        description=content["description"],
    )


def _write_report(result: BenchResult, store: Store) -> None:
    """Draw the overlays that are new, and write the HTML page that links to them."""
    overlays = draw_overlays(result.rows, store.overlays)
    write_text(store.report, render_html(result, overlays))


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
