"""The run of a study: each record a job, each row stored as it comes, then the tables."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.data.whole_files import write_text
from harness.errors import InputError
from harness.jobs import Desk, make_engine, run_jobs
from harness.jobs.alone import alone_in
from sysid_lab.plan import BASES, PLANTS, Task, plan
from sysid_lab.records import SAMPLES
from sysid_lab.row import do_row
from sysid_lab.store import RowStore

SUMMARY, PICTURE = "study.md", "confusion.png"
LIMIT = 900.0  # Seconds after which a row is abandoned.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class StudyResult:
    """What :func:`study` returns.

    Attributes
    ----------
    folder : Path
        With ``rows.csv``, ``study.md`` and ``confusion.png``.
    rows : list of dict
        All rows of the folder, as text.
    text : str
        The content of ``study.md``.
    planned, done : int
        Tasks of this call, and how many of them have a row.
    """

    folder: Path
    rows: list[dict[str, str]]
    text: str
    planned: int
    done: int

    def __str__(self) -> str:
        return self.text


def study(
    which: str = "all",
    *,
    out: str | Path,
    seeds: str = "tuning",
    records: int | None = None,
    plants: Sequence[str] = PLANTS,
    workers: int = 2,
    cells: int = 4,
    alarms: int = 400,
    budget: float | None = None,
    samples: int = SAMPLES,
    engine: str = "local",
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> StudyResult:
    """Run a study of the closed loop on simulated truths, and write its tables.

    Parameters
    ----------
    which : str
        ``confusion`` (every effect and none, two at once, laws outside the dictionary), ``false-alarms``, ``coverage``
        (the same records with nothing missing), ``cost`` or ``all``.
    out : path
        Folder for ``rows.csv``, ``study.md`` and ``confusion.png``.
    seeds : {"tuning", "judged"}
        Judged records are never used while thresholds are chosen.
    records : int, optional
        Only the first so many records of the plan, which is ordered so that any first part is balanced.
    plants : sequence of str
        ``pendulum``, ``cart-pole``.
    workers : int
        Processes; each diagnosis runs in one.
    cells : int
        Records of each effect, out of the eight cells noise x size x disturbance.
    alarms : int
        Records with nothing missing of each class.
    budget : float, optional
        Minutes after which no more rows are begun.
    samples : int
        Of one record at 250 Hz; shorter ones than 20 s are for a quick look, not for the figures.
    engine : str
        ``"local"`` or ``"dask://HOST:PORT"``.
    resume : bool
        Keep the rows of the folder and do the others.
    force : bool
        Begin anew.
    progress : callable, optional
        Called as ``progress(done, planned, what)``.

    Returns
    -------
    StudyResult

    Raises
    ------
    InputError
        If a word is unknown, or the folder holds a study and neither ``resume`` nor ``force`` is given.
    """
    from sysid_lab.pages.tables import summary

    if seeds not in BASES:
        raise InputError("seeds", expected=" or ".join(BASES), got=repr(seeds), remedy="correct it")
    for name, value in (("workers", workers), ("cells", cells), ("alarms", alarms), ("samples", samples)):
        if value < 1:
            raise InputError(name, expected="at least 1", got=str(value), remedy="raise it")
    if budget is not None and not budget > 0:
        raise InputError("budget", expected="minutes above 0", got=str(budget), remedy="raise it")
    made = make_engine(engine, workers)
    base = BASES[seeds]
    tasks = plan(which, base=base, plants=plants, records=records, cells=cells, alarms=alarms)
    folder = Path(out)
    with alone_in(folder):
        store = RowStore(folder, resume=resume, force=force)
        end = None if budget is None else time.time() + 60 * budget

        def told(task: Task | None) -> None:
            if progress is not None:
                done = sum(planned.key in store.rows for planned in tasks)
                progress(done, len(tasks), "" if task is None else task.key)

        def save() -> str:
            text = summary(store.rows.values(), seeds=seeds, planned=len(tasks), keys={task.key for task in tasks})
            write_text(folder / SUMMARY, text)
            return text

        def moved(title: str, jobs: Sequence[str]) -> None:
            for job in jobs:
                if store.take(job):
                    told(by_job[job])

        left = [StudyJob(task, samples, end) for task in tasks if task.key not in store.rows]
        by_job = {own.jobs[0]: own.task for own in left}
        told(None)
        try:
            run_jobs([own for own in left if own.task.study != "cost"], store.shards, engine=made, moved=moved)
            # what is timed runs alone
            run_jobs([own for own in left if own.task.study == "cost"], store.shards, workers=1, moved=moved)
        finally:
            store.close()
            text = save()
        from sysid_lab.pages.picture import confusion_picture

        rows = list(store.rows.values())
        confusion_picture(rows, folder / PICTURE)
        return StudyResult(folder, rows, text, len(tasks), sum(task.key in store.rows for task in tasks))


@dataclass(frozen=True)
class StudyJob:
    """One row of a study as a batch of one job; see :class:`harness.jobs.JobBatch`.

    Parameters
    ----------
    task : Task
    samples : int
        Of one record.
    end : float, optional
        Instant (``time.time()``) from which on no row is begun: the job then leaves an empty shard.
    """

    task: Task
    samples: int
    end: float | None

    @property
    def title(self) -> str:
        """What the progress calls it."""
        return self.task.key

    @property
    def jobs(self) -> tuple[str, ...]:
        """The one job: a hash of the key."""
        return (hashlib.sha256(self.task.key.encode()).hexdigest()[:20],)

    @property
    def time_limit(self) -> float:
        """Seconds for the row."""
        return LIMIT

    def only(self, jobs: Sequence[str]) -> StudyJob:
        """Return the batch: it has one job only."""
        return self

    def lost(self, job: str, status: str, reason: str, *, shared: bool) -> bytes:
        """Return the row of a record that broke its worker."""
        row = self.task.columns() | {
            "status": status,
            "reason": f"the diagnosis {reason}" if status == "timeout" else reason,
        }
        return json.dumps(row).encode()

    def work(self, desk: Desk) -> None:
        """Do the row, unless the time is up."""
        (job,) = self.jobs
        if self.end is not None and time.time() > self.end:
            desk.put(job, json.dumps({}).encode())
            return
        with desk.job(job):
            row = do_row(self.task, samples=self.samples)
        desk.put(job, json.dumps(row).encode())
