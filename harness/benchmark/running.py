"""The calls ``bench`` and ``table``: run a suite, keep its rows, read them back."""

from __future__ import annotations

import inspect
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from harness import registry
from harness.benchmark.page.overlays import draw_overlays
from harness.benchmark.page.report import render_html
from harness.benchmark.parts import Cell, Task
from harness.benchmark.planning import BenchPlan, plan_of, read_shard, share
from harness.benchmark.result import BenchResult
from harness.benchmark.row import Row, one_line, read_row
from harness.benchmark.store import Store
from harness.benchmark.suite import cells_of, load_suite, tasks_of
from harness.benchmark.work import CellBatch
from harness.data.whole_files import write_text
from harness.errors import HarnessError, InputError, refuse_unknown
from harness.jobs import make_engine, run_jobs, shard_file
from harness.jobs.alone import alone_in
from harness.jobs.progress import Progress
from harness.jobs.stored import reading
from harness.supervision.workers import worker_pool

LIMIT = 120.0  # s for one plant


def probe_plants(tasks: Sequence[Task], file: Path) -> None:
    """Probe every plant that can be probed and is not in the file yet; no plant is made in this process.

    - ``tasks``: their plants are probed once each
    - ``file``: JSON: plant name to ``options`` and ``result`` (None and a ``reason`` if the probe itself broke). Left
      alone, or not made, where no plant can be probed.
    """
    known: dict[str, dict[str, Any]] = {}
    if file.is_file():
        with reading(file, "delete it: the FMUs are probed again"):
            known = msgspec.json.decode(file.read_bytes(), type=dict[str, dict[str, Any]])
    parts = {task.plant.name: task.plant for task in tasks}
    new = {
        name: part
        for name, part in parts.items()
        if _probeable(part.id) and known.get(name, {}).get("options") != _plain(part.options)
    }
    if not new:
        return
    with worker_pool(1) as pool:
        waiting = {name: pool.schedule(_probe, args=[p.id, p.options], timeout=LIMIT) for name, p in new.items()}
        for name, future in waiting.items():
            entry: dict[str, Any] = {"plant": new[name].id, "options": _plain(new[name].options), "result": None}
            try:
                entry["result"] = future.result()
            except Exception as error:  # whatever an FMU does to its process is a finding
                entry["reason"] = one_line(error) if isinstance(error, HarnessError) else type(error).__name__
            known[name] = entry
    write_text(file, json.dumps(known, indent=1) + "\n")


def _probeable(plant: str) -> bool:
    """Return True if what makes the plant says that it makes one with a ``probe_tool``."""
    try:
        factory = registry.load("plants", plant)
        made = factory if inspect.isclass(factory) else inspect.signature(factory, eval_str=True).return_annotation
    except (HarnessError, NameError, TypeError, ValueError):
        return False  # the rows of this plant will tell what is wrong with it
    return getattr(made, "probe_tool", None) is not None


def _probe(plant: str, options: dict[str, Any]) -> dict[str, Any]:
    """Make a plant, and probe it with the options that it was really made with."""
    with registry.create("plants", plant, **options) as made:
        found: dict[str, Any] = registry.load("tools", made.probe_tool)(**made.options).to_dict()
    return found


def _plain(options: dict[str, Any]) -> Any:
    """Return options as they read back from JSON."""
    return json.loads(json.dumps(options, default=str))


TRACES = ("first", "all", "none")  # Seeds whose cells keep what their overlays are drawn from.


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
) -> BenchPlan:
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

    Raises InputError if the choice is none of :data:`TRACES`.
    """
    refuse_unknown("traces", traces, TRACES, remedy="choose one")
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
