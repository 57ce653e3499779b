"""What a worker does: a batch of jobs, one shard for each; and the desk at which it does them.

Nothing here returns a result: rows go to files as they are ready, so whatever ends the process loses only the job
that it was working on. The file ``BATCH.at`` says which one that is; ``BATCH.watch`` is filled by the watchdog, a C
thread of the standard library that ends the process on time even if foreign code never gives the interpreter back.
"""

from __future__ import annotations

import faulthandler
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Protocol

from harness.errors import PluginError
from harness.jobs.room import raise_if_full, require_room
from harness.supervision.processes import Surroundings, end_children, ended
from harness.trust import trusting

SHARED = "shared"  # Where a worker stands while it makes what all jobs of its batch share.
HARMED = 70  # Exit status of a worker that can do no more.
WIDTH = 128  # Bytes of the name of a place, filled with blanks.


class JobBatch(Protocol):
    """Jobs that one worker does together because they share what is dear to make; it travels by pickle."""

    @property
    def title(self) -> str:
        """What the progress calls it."""
        ...

    @property
    def jobs(self) -> tuple[str, ...]:
        """Names of the jobs, each also the name of its shard: letters and digits."""
        ...

    @property
    def time_limit(self) -> float:
        """Seconds for one job; what they share may take as long again."""
        ...

    def only(self, jobs: Sequence[str]) -> JobBatch:
        """Return the batch with some of its jobs."""
        ...

    def work(self, desk: Desk) -> None:
        """Do all jobs in order; each is one shard, whatever comes of it."""
        ...

    def lost(self, job: str, status: str, reason: str, *, shared: bool) -> bytes:
        """Return the shard of a job that broke its worker (``crashed``, ``timeout``).

        ``reason`` continues a sentence about the job (``"is over its time limit of 4 s"``) or says how the worker
        ended; ``shared`` is True where it happened to what all jobs share.
        """
        ...


def shard_file(folder: Path, job: str) -> Path:
    """Return the file of a job's row."""
    return folder / f"{job}.json"


def write_shard(folder: Path, job: str, content: bytes) -> None:
    """Write the row of a job, whole or not at all; on a full disk none, as what failed there is no fault of the job.

    Raises OSError if there is no room.
    """
    require_room(folder)
    scratch = folder / f"{job}.part"
    try:
        scratch.write_bytes(content)
        scratch.replace(shard_file(folder, job))
    except OSError:
        scratch.unlink(missing_ok=True)
        raise


def described(error: BaseException) -> str:
    """Return the type of an error and its text, which foreign code may have made a fault of its own.

    Examples
    --------
    >>> described(ValueError("x")), described(KeyboardInterrupt())
    ('ValueError: x', 'KeyboardInterrupt')
    """
    name = type(error).__name__
    try:
        text = str(error)
    except BaseException:
        return name
    return f"{name}: {text}" if text else name


def _at(folder: Path, batch: JobBatch) -> Path:
    return folder / f"{batch.jobs[0]}.at"


def _watch(folder: Path, batch: JobBatch) -> Path:
    return folder / f"{batch.jobs[0]}.watch"


def last_place(folder: Path, batch: JobBatch) -> str:
    """Return the place at which a worker was lost: the name of a job, or :data:`SHARED`."""
    return _last(folder, batch)[1] or SHARED


def worker_gone(folder: Path, batch: JobBatch) -> bool:
    """Return True if the worker that had begun a batch is no more."""
    process = _last(folder, batch)[0]
    return bool(process) and ended(process)


def end_worker(folder: Path, batch: JobBatch) -> None:
    """End what a lost worker left running: the processes of its group."""
    process = _last(folder, batch)[0]
    with suppress(ProcessLookupError, PermissionError):
        if process and hasattr(os, "getpgid") and os.getpgid(0) != process:
            os.killpg(process, signal.SIGKILL)


def _last(folder: Path, batch: JobBatch) -> tuple[int, str]:
    """Return the process of the worker of a batch and where it was; 0 if none has begun."""
    at = _at(folder, batch)
    process, _, place = (at.read_text(encoding="utf-8").strip() if at.exists() else "").partition(" ")
    return int(process) if process.isdigit() else 0, place


def was_ended(folder: Path, batch: JobBatch) -> bool:
    """Return True if the watchdog ended the worker of a batch."""
    watch = _watch(folder, batch)
    return watch.exists() and watch.stat().st_size > 0


def put_away(folder: Path, batch: JobBatch) -> None:
    """Remove the marks of a worker."""
    _at(folder, batch).unlink(missing_ok=True)
    _watch(folder, batch).unlink(missing_ok=True)


class Desk:
    """Where a worker does a batch: it says where it stands, keeps the time and puts the rows away."""

    def __init__(self, batch: JobBatch, folder: Path, at: int, watch: IO[str]) -> None:
        self._batch, self._folder, self._at, self._watch = batch, folder, at, watch
        self._surroundings, self._harm = Surroundings(), ""

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Keep the time limit while what all jobs share is made."""
        with self._limited(SHARED):
            yield

    @contextmanager
    def job(self, job: str) -> Iterator[None]:
        """Keep the time limit while a job is done."""
        with self._limited(job):
            yield

    def put(self, job: str, content: bytes) -> None:
        """Write the shard of a job, whole or not at all; one that harmed its process is the last in it."""
        if self._harm:
            write_shard(self._folder, job, self._batch.lost(job, "crashed", self._harm, shared=False))
            end_children()
            os._exit(HARMED)
        write_shard(self._folder, job, content)

    def stand(self, place: str) -> None:
        """Write down where the work is."""
        os.lseek(self._at, 0, os.SEEK_SET)
        os.write(self._at, f"{os.getpid()} {place}".encode().ljust(WIDTH))  # one write: never seen half

    @contextmanager
    def _limited(self, place: str) -> Iterator[None]:
        """End the process, rows so far being safe, when the body takes longer than the limit of a job."""
        self.stand(place)
        faulthandler.dump_traceback_later(self._batch.time_limit, exit=True, file=self._watch)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            self._harm = self._surroundings.restore()


def do_batch(batch: JobBatch, folder: str | Path, trust: Sequence[str] = ()) -> None:
    """Do all jobs of a batch in this process and write their shards; ``trust`` as :func:`harness.trust.trusting`."""
    place = Path(folder)
    with _watch(place, batch).open("w") as watch, _at(place, batch).open("wb", buffering=0) as at:
        desk = Desk(batch, place, at.fileno(), watch)
        desk.stand(SHARED)
        with trusting(*trust):
            try:
                batch.work(desk)
            except BaseException as error:  # an interrupt that foreign code raised, or what does not travel by pickle
                raise_if_full(error)
                raise PluginError(described(error)) from None
    put_away(place, batch)
