"""Where tasks run: on this machine's cores, or on a dask cluster whose workers each use the local engine."""

from __future__ import annotations

import math
import multiprocessing
import os
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec

from harness.benchmark.row import blank, write_row
from harness.benchmark.suite import Task
from harness.benchmark.work import AT_DATA, do_task, position_file, watch_file
from harness.errors import InputError
from harness.workers import death, worker_pool

__all__ = ["DaskEngine", "Engine", "LocalEngine", "make_engine"]

POLL = 0.5  # s between signs of life while nothing finishes
AHEAD = 4  # tasks for each worker that the pool holds: enough that no worker waits, few enough that looking is cheap
BUNDLE = 20  # tasks that travel to a cluster together, at most: one pool of processes serves them all
SHARES = 8  # bundles for each cluster worker, at least, so that all end at about the same time

Moved = Callable[[str, Sequence[str]], None]
"""Called with a title and the jobs whose rows have been added."""


class Engine(Protocol):
    """Something that runs tasks; every row ends up as a shard in the folder."""

    def run(self, tasks: Sequence[Task], shards: Path, moved: Moved) -> None:
        """Run all tasks; ``moved`` is called with a title, and the jobs whose rows have been added."""
        ...


def make_engine(engine: str, workers: int | None = None) -> Engine:
    """Return the engine that a text names.

    Parameters
    ----------
    engine : str
        ``"local"`` or ``"dask://HOST:PORT"``.
    workers : int, optional
        Processes of the local engine; by default one for each core that this process may use.

    Raises
    ------
    InputError
        If the text names no engine, or dask is not installed.

    Examples
    --------
    >>> make_engine("local", workers=2)
    LocalEngine(workers=2)
    """
    if workers is not None and workers < 1:
        raise InputError("workers", expected="at least 1", got=str(workers), remedy="correct the number")
    if engine == "local":
        return LocalEngine(workers or len(os.sched_getaffinity(0)))
    scheme, _, address = engine.partition("://")
    if scheme != "dask" or ":" not in address:
        raise InputError(
            "engine", expected="local or dask://HOST:PORT", got=repr(engine), remedy="correct it", place="engine"
        )
    return DaskEngine(address)


@dataclass(frozen=True)
class LocalEngine:
    """A pool of processes on this machine.

    A worker that dies or is ended by its watchdog loses the cell it was at, which becomes a row with a status; the
    other cells of its task are run again by a fresh worker.
    """

    workers: int

    def run(self, tasks: Sequence[Task], shards: Path, moved: Moved) -> None:
        """Run all tasks; see :class:`Engine`."""
        with worker_pool(min(self.workers, len(tasks))) as pool:
            self._drain(pool, deque(tasks), shards, moved)

    def _drain(self, pool: Any, tasks: deque[Task], shards: Path, moved: Moved) -> None:
        """Keep a few tasks for each worker in the pool, and put back what is left of one whose worker was lost.

        Waiting and the pool's own bookkeeping look at every task that is scheduled, so scheduling all of them at once
        costs the square of their number.
        """
        waiting: dict[Any, Task] = {}

        def schedule(task: Task) -> None:
            # the watchdog inside the worker keeps the limit of each cell; this one is for a worker that is stopped
            backstop = math.ceil((len(task.cells) + 1) * (task.time_limit + 10))
            waiting[pool.schedule(do_task, args=[task, str(shards)], timeout=backstop)] = task

        while tasks or waiting:
            while tasks and len(waiting) < AHEAD * self.workers:
                schedule(tasks.popleft())
            done, _ = wait(list(waiting), timeout=POLL, return_when=FIRST_COMPLETED)
            if not done:
                moved("", ())
            for future in done:
                task = waiting.pop(future)
                error = future.exception()
                rest = _after_loss(task, shards, error) if error is not None else None
                left = {cell.job for cell in rest.cells} if rest is not None else set()
                moved(task.title, [cell.job for cell in task.cells if cell.job not in left])
                if rest is not None:
                    tasks.appendleft(rest)


def _after_loss(task: Task, shards: Path, error: BaseException) -> Task | None:
    """Write the row of the cell at which a worker was lost; return the task of the cells that are still to do."""
    at, watch = position_file(shards, task), watch_file(shards, task)
    place = at.read_text(encoding="utf-8") if at.exists() else AT_DATA
    late = isinstance(error, TimeoutError) or (watch.exists() and watch.stat().st_size > 0)
    status = "timeout" if late else "crashed"
    reason = f"over its time limit of {task.time_limit:g} s" if late else death(error)
    left = [cell for cell in task.cells if not (shards / f"{cell.job}.json").exists()]
    lost = [cell for cell in left if place in (AT_DATA, cell.job)] or left[:1]
    for cell in lost:
        what = "no data: the plant or scenario is" if place == AT_DATA else f"{cell.identifier.name} is"
        text = f"{what} {reason}" if late else reason if place != AT_DATA else f"no data: {reason}"
        write_row(blank(task, cell, status=status, reason=text), shards)
    at.unlink(missing_ok=True)
    watch.unlink(missing_ok=True)
    rest = tuple(cell for cell in left if cell not in lost)
    return msgspec.structs.replace(task, cells=rest) if rest else None


@dataclass(frozen=True)
class DaskEngine:
    """A dask cluster: each of its tasks carries some of ours and runs them through the local engine where it lands.

    A cluster worker that dies loses nothing: the scheduler gives its bundle to another.
    """

    address: str

    def run(self, tasks: Sequence[Task], shards: Path, moved: Moved) -> None:
        """Run all tasks; see :class:`Engine`."""
        try:
            import distributed
        except ImportError as error:
            raise InputError(
                "engine dask",
                expected="the package distributed",
                got="it is not installed",
                remedy="pip install 'sysid-harness[cluster]'",
            ) from error
        connect: Any = distributed.Client
        completed: Any = distributed.as_completed
        try:
            client = connect(self.address, timeout="5s", set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise InputError(
                "engine dask",
                expected=f"a scheduler at {self.address}",
                got=f"{type(error).__name__}: {error}",
                remedy="start one with 'dask scheduler' or correct the address",
            ) from error
        with client:
            workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
            size = max(1, min(BUNDLE, len(tasks) // (SHARES * workers)))
            bundles = [tuple(tasks[k : k + size]) for k in range(0, len(tasks), size)]
            futures = {client.submit(run_elsewhere, bundle, pure=False, retries=1): bundle for bundle in bundles}
            try:
                for future in completed(list(futures), loop=client.loop):
                    bundle = futures.pop(future)
                    lost = future.exception()
                    if lost is None:
                        for name, content in future.result().items():
                            scratch = shards / f"{name}.part"
                            scratch.write_bytes(content)
                            scratch.replace(shards / name)
                    else:
                        reason = f"the cluster lost the task: {type(lost).__name__}: {lost}"
                        for task in bundle:
                            for cell in task.cells:
                                write_row(blank(task, cell, status="crashed", reason=reason), shards)
                    moved(bundle[-1].title, [cell.job for task in bundle for cell in task.cells])
                    future.release()  # the rows are here: the cluster need not keep them
            except BaseException:
                client.cancel(list(futures))
                raise


def run_elsewhere(tasks: tuple[Task, ...]) -> dict[str, bytes]:
    """Run tasks through the local engine on a worker of a cluster; returns their shards by file name."""
    process = multiprocessing.current_process()
    configuration = getattr(process, "_config", {})
    daemon = configuration.get("daemon", False)
    configuration["daemon"] = False  # cluster workers are daemons by default, and daemons may not have children
    try:
        with tempfile.TemporaryDirectory(prefix="sysid-harness-") as folder:
            LocalEngine(1).run(tasks, Path(folder), lambda title, jobs: None)
            return {path.name: path.read_bytes() for path in Path(folder).glob("*.json")}
    finally:
        configuration["daemon"] = daemon
