"""Where batches run: on this machine's cores, or on a dask cluster whose workers each use the local engine."""

from __future__ import annotations

import math
import multiprocessing
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pebble import ProcessExpired

from harness.errors import InputError, PluginError
from harness.jobs.batch import (
    SHARED,
    JobBatch,
    do_batch,
    end_worker,
    last_place,
    put_away,
    shard_file,
    was_ended,
    worker_gone,
    write_shard,
)
from harness.jobs.room import full_disk, raise_if_full, stop_if_full
from harness.supervision.workers import cores, death, worker_pool
from harness.trust import trusted, trusting

POLL = 0.5  # s between signs of life while nothing finishes
AHEAD = 4  # batches for each worker that the pool holds: enough that no worker waits, few enough that looking is cheap
BREAKS = 3  # times that a pool may break in a row with nothing done: whatever breaks it then is no job
BUNDLE = 20  # batches that travel to a cluster together, at most: one pool of processes serves them all
SHARES = 8  # bundles for each cluster worker, at least, so that all end at about the same time

Moved = Callable[[str, Sequence[str]], None]  # Called with a title and the jobs whose rows have been added.


class JobEngine(Protocol):
    """Something that runs batches; every row ends up as a shard in the folder."""

    def run(self, batches: Sequence[JobBatch], shards: Path, moved: Moved) -> None:
        """Run all batches; ``moved`` is called with a title, and the jobs whose rows have been added."""
        ...


def run_jobs(
    batches: Sequence[JobBatch],
    shards: Path,
    *,
    engine: str | JobEngine = "local",
    workers: int | None = None,
    moved: Moved | None = None,
) -> None:
    """Run batches of jobs until each job has its shard: a crash, a hang or a kill is a row too.

    Parameters
    ----------
    batches : sequence of Batch
        No two jobs may have one name.
    shards : Path
        Folder that is there; ``JOB.json`` is the row of a job, written as soon as it is known.
    engine : str or Engine
        ``"local"``, ``"dask://HOST:PORT"``, or what :func:`make_engine` made of it.
    workers : int, optional
        Processes of the local engine; by default one for each core.
    moved : callable, optional
        Called as ``moved(title, jobs)`` with the jobs whose rows have been added, and with none as a sign of life.

    Raises
    ------
    InputError
        If the text names no engine, the cluster cannot be reached, or the disk is full: the jobs at which that was seen
        have no shard.
    """
    made = make_engine(engine, workers) if isinstance(engine, str) else engine
    try:
        made.run(batches, shards, moved or (lambda title, jobs: None))
    except OSError as error:
        stop_if_full(error)
        raise


def make_engine(engine: str, workers: int | None = None) -> JobEngine:
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
        return LocalEngine(workers or cores())
    scheme, _, address = engine.partition("://")
    if scheme != "dask" or ":" not in address:
        raise InputError(
            "engine", expected="local or dask://HOST:PORT", got=repr(engine), remedy="correct it", place="engine"
        )
    return DaskEngine(address)


@dataclass(frozen=True)
class LocalEngine:
    """A pool of processes on this machine.

    A worker that dies or is ended by its watchdog loses the job it was at, which becomes a row with a status; the
    other jobs of its batch are run again by a fresh worker.
    """

    workers: int

    def run(self, batches: Sequence[JobBatch], shards: Path, moved: Moved) -> None:
        """Run all batches; see :class:`JobEngine`."""
        if not batches:
            return
        left, breaks = deque(batches), 0
        while left:
            before = sum(len(batch.jobs) for batch in left)
            with worker_pool(min(self.workers, len(left))) as pool:
                self._drain(pool, left, shards, moved)
            breaks = breaks + 1 if sum(len(batch.jobs) for batch in left) == before else 0
            if breaks > BREAKS:
                raise PluginError(f"the pool of workers broke {breaks} times and nothing was done")

    def _drain(self, pool: Any, batches: deque[JobBatch], shards: Path, moved: Moved) -> None:
        """Do the batches, or as many as a pool does before it breaks: what is left stays among them.

        Keep a few batches for each worker in the pool, and put back what is left of one whose worker was lost.

        Waiting and the pool's own bookkeeping look at every task that is scheduled, so scheduling all of them at once
        costs the square of their number.
        """
        waiting: dict[Any, JobBatch] = {}
        gone: set[Any] = set()  # whose worker ended without a word, as a status of 0 is none to the pool

        def schedule(batch: JobBatch) -> None:
            # the watchdog inside the worker keeps the limit of each job; this one is for a worker that is stopped
            put_away(shards, batch)  # marks of a run that was interrupted tell of no worker of this one
            backstop = math.ceil((len(batch.jobs) + 1) * (batch.time_limit + 10))
            waiting[pool.schedule(do_batch, args=[batch, str(shards), trusted()], timeout=backstop)] = batch

        while batches or waiting:
            while batches and len(waiting) < AHEAD * self.workers:
                schedule(batches.popleft())
            done, _ = wait(list(waiting), timeout=POLL, return_when=FIRST_COMPLETED)
            if not done:
                moved("", ())
                quiet = {future for future, batch in waiting.items() if worker_gone(shards, batch)}
                done = {future for future in quiet & gone if not future.done()}  # twice: the pool may tell how
                gone = quiet
            if broken := any(isinstance(_error(future), BrokenProcessPool) for future in done):
                done = set(waiting)
            for future in done:
                batch = waiting.pop(future)
                error = _error(future) or (None if future.done() else _Left())
                if error is not None and full_disk(error) is not None:
                    raise error
                future.cancel()
                rest = _rest(batch, shards, error, broken=broken)
                left = set(rest.jobs) if rest is not None else set()
                moved(batch.title, [job for job in batch.jobs if job not in left])
                if rest is not None:
                    batches.appendleft(rest)
            if broken:
                return


def _error(future: Any) -> BaseException | None:
    """Return what a finished future ended with; None of one that went well or is still waiting."""
    return future.exception() if future.done() and not future.cancelled() else None


def _rest(batch: JobBatch, shards: Path, error: BaseException | None, *, broken: bool) -> JobBatch | None:
    """Return the jobs of a batch that are still to do; in a broken pool the end of a worker may not be its own."""
    if broken and (error is None or isinstance(error, _Left | BrokenProcessPool)):
        return _undone(batch, shards)
    return _after_loss(batch, shards, error) if error is not None else None


def _undone(batch: JobBatch, shards: Path) -> JobBatch | None:
    """Return the jobs of a batch that have no shard; None if all have one."""
    end_worker(shards, batch)
    put_away(shards, batch)
    left = [job for job in batch.jobs if not shard_file(shards, job).exists()]
    return batch.only(left) if left else None


class _Left(Exception):
    """A worker ended itself with status 0."""

    exitcode = 0


def _after_loss(batch: JobBatch, shards: Path, error: BaseException) -> JobBatch | None:
    """Write the row of the job at which a worker was lost; return the batch of the jobs that are still to do."""
    place = last_place(shards, batch)
    late = isinstance(error, TimeoutError) or was_ended(shards, batch)
    status = "timeout" if late else "crashed"
    reason = f"is over its time limit of {batch.time_limit:g} s" if late else death(error)
    if late or isinstance(error, ProcessExpired | BrokenProcessPool | _Left):
        end_worker(shards, batch)  # after any other error it lives, and does another batch by now
    if not late:
        raise_if_full(error)
    left = [job for job in batch.jobs if not shard_file(shards, job).exists()]
    told = place != SHARED and shard_file(shards, place).exists()  # its row says what it did to the worker
    lost = [job for job in left if place in (SHARED, job)] or ([] if told else left[:1])
    for job in lost:
        write_shard(shards, job, batch.lost(job, status, reason, shared=place == SHARED))
    put_away(shards, batch)
    rest = [job for job in left if job not in lost]
    return batch.only(rest) if rest else None


@dataclass(frozen=True)
class DaskEngine:
    """A dask cluster: each of its tasks carries some of ours and runs them through the local engine where it lands.

    A cluster worker that dies loses nothing: the scheduler gives its bundle to another.
    """

    address: str

    def run(self, batches: Sequence[JobBatch], shards: Path, moved: Moved) -> None:
        """Run all batches; see :class:`JobEngine`."""
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
            size = max(1, min(BUNDLE, len(batches) // (SHARES * workers)))
            bundles = [tuple(batches[k : k + size]) for k in range(0, len(batches), size)]
            futures = {
                client.submit(run_elsewhere, bundle, trusted(), pure=False, retries=1): bundle for bundle in bundles
            }
            try:
                for future in completed(list(futures), loop=client.loop):
                    bundle = futures.pop(future)
                    lost = future.exception()
                    if lost is not None and full_disk(lost) is not None:
                        raise lost
                    if lost is None:
                        for job, content in future.result().items():
                            write_shard(shards, job, content)
                    else:
                        reason = f"the cluster lost the task: {type(lost).__name__}: {lost}"
                        for batch in bundle:
                            for job in batch.jobs:
                                write_shard(shards, job, batch.lost(job, "crashed", reason, shared=False))
                    moved(bundle[-1].title, [job for batch in bundle for job in batch.jobs])
                    future.release()  # the rows are here: the cluster need not keep them
            except BaseException:
                client.cancel(list(futures))
                raise


def run_elsewhere(batches: tuple[JobBatch, ...], trust: Sequence[str] = ()) -> dict[str, bytes]:
    """Run batches through the local engine on a worker of a cluster; returns their shards by job."""
    process = multiprocessing.current_process()
    configuration = getattr(process, "_config", {})
    daemon = configuration.get("daemon", False)
    configuration["daemon"] = False  # cluster workers are daemons by default, and daemons may not have children
    try:
        with tempfile.TemporaryDirectory(prefix="sysid-harness-") as folder, trusting(*trust):
            LocalEngine(1).run(batches, Path(folder), lambda title, jobs: None)
            return {path.stem: path.read_bytes() for path in Path(folder).glob("*.json")}
    finally:
        configuration["daemon"] = daemon
