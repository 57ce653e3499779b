"""The run of a study: rows in worker processes that stay alive, each row stored as it comes, then the tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.errors import InputError
from harness.study.plan import BASES, PLANTS, Task, plan
from harness.study.records import SAMPLES
from harness.study.row import do_row
from harness.study.store import RowStore
from harness.workers import death, worker_pool

__all__ = ["PICTURE", "SUMMARY", "StudyResult", "study"]

SUMMARY, PICTURE = "study.md", "confusion.png"
LIMIT = 900.0
"""Seconds after which a row is given up."""
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
    from harness.study.tables import summary

    if seeds not in BASES:
        raise InputError("seeds", expected=" or ".join(BASES), got=repr(seeds), remedy="correct it")
    for name, value in (("workers", workers), ("cells", cells), ("alarms", alarms), ("samples", samples)):
        if value < 1:
            raise InputError(name, expected="at least 1", got=str(value), remedy="raise it")
    if budget is not None and not budget > 0:
        raise InputError("budget", expected="minutes above 0", got=str(budget), remedy="raise it")
    base = BASES[seeds]
    tasks = plan(which, base=base, plants=plants, records=records, cells=cells, alarms=alarms)
    folder = Path(out)
    store = RowStore(folder, resume=resume, force=force)
    began = time.monotonic()
    end = None if budget is None else began + 60 * budget

    def told(task: Task | None) -> None:
        if progress is not None:
            done = sum(one.key in store.rows for one in tasks)
            progress(done, len(tasks), "" if task is None else task.key)

    def save() -> str:
        text = summary(store.rows.values(), seeds=seeds, planned=len(tasks), keys={one.key for one in tasks})
        scratch = folder / (SUMMARY + ".part")
        scratch.write_text(text, encoding="utf-8")
        scratch.replace(folder / SUMMARY)
        return text

    told(None)
    try:
        left = [one for one in tasks if one.key not in store.rows]
        _pooled(left, workers, store, end, told, samples)
    finally:
        text = save()
    from harness.study.picture import confusion_picture

    rows = list(store.rows.values())
    confusion_picture(rows, folder / PICTURE)
    return StudyResult(folder, rows, text, len(tasks), sum(one.key in store.rows for one in tasks))


def _pooled(
    tasks: Sequence[Task],
    workers: int,
    store: RowStore,
    end: float | None,
    told: Callable[[Task | None], None],
    samples: int,
) -> None:
    """Run tasks in a pool of processes; store each row as it comes."""
    if not tasks:
        return
    waiting: dict[Any, Task] = {}
    queue = iter(tasks)
    with worker_pool(min(workers, len(tasks))) as pool:
        more = True
        while more or waiting:
            # No more than one waits: what is begun is finished, so the budget ends within a row's time.
            while more and len(waiting) < workers:
                task = next(queue, None)
                more = task is not None and (end is None or time.monotonic() < end)
                if task is not None and more:
                    waiting[pool.schedule(do_row, args=[task], kwargs={"samples": samples}, timeout=LIMIT)] = task
            finished, _ = wait(list(waiting), timeout=1.0, return_when=FIRST_COMPLETED)
            for future in finished:
                task = waiting.pop(future)
                store.add(_result(future, task))
                told(task)


def _result(future: Any, task: Task) -> dict[str, Any]:
    """Return the row of a finished task; a worker that died or was ended is a row with its reason."""
    error = future.exception()
    if error is None:
        row: dict[str, Any] = future.result()
        return row
    late = isinstance(error, TimeoutError)
    return {
        **task.columns(),
        "status": "timeout" if late else "crashed",
        "reason": f"took longer than {LIMIT:g} s" if late else death(error),
    }
