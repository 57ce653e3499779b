"""What a run would do: its cells, its share of a job array, and how long it will take."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from harness.benchmark.parts import Task
from harness.benchmark.suite import cells_of
from harness.errors import InputError
from harness.jobs.progress import duration
from harness.jobs.stored import read_columns, reading

Shared = TypeVar("Shared")


@dataclass(frozen=True)
class BenchPlan:
    """What would run."""

    cells: dict[tuple[str, str, str], int]  # (plant, scenario, identifier) to the number of cells that are still to do
    found: int  # Cells that the folder already has
    seconds: float | None
    """Estimated wall time, from the times of the rows that the folder, or one beside it, has of these kinds; None where
    none has any."""
    known: int  # Cells whose kind has been timed; the others are taken to last as long as the mean of these
    limit: float  # Wall time [s] if every cell took its whole time limit
    declared: float | None = None  # Wall time [s] by the mean that the suite declares, where it does

    @property
    def todo(self) -> int:
        """Number of cells that would run."""
        return sum(self.cells.values())

    def __str__(self) -> str:
        head = f"{self.todo} cells to run, {self.found} already there"
        if not self.todo:
            return head
        if self.seconds is None and self.declared is not None:
            return f"{head}; about {duration(self.declared)}, by the mean time of a cell that the suite states"
        if self.seconds is None:
            return f"{head}; time unknown until some have run, at most {duration(self.limit)}"
        return f"{head}; about {duration(self.seconds)}, from the times of {self.known} like them"


def read_shard(text: str | None) -> tuple[int, int] | None:
    """Read ``i/n``: the i-th of n shares, counted from 1.

    Raises InputError if it is not 1 <= i <= n.

    Examples
    --------
    >>> read_shard("2/8")
    (2, 8)
    """
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text)
    pair = None if found is None else (int(found[1]), int(found[2]))
    if pair is None or not 1 <= pair[0] <= pair[1]:
        raise InputError(
            "share of a job array",
            expected="i/n with 1 <= i <= n",
            got=repr(text),
            remedy="write e.g. --shard 1/8",
            place="--shard",
        )
    return pair


def share(tasks: Sequence[Shared], shard: tuple[int, int] | None) -> tuple[Shared, ...]:
    """Return every n-th task from the i-th on: neighbours are alike, so the shares take about the same time."""
    return tuple(tasks) if shard is None else tuple(tasks[shard[0] - 1 :: shard[1]])


def plan_of(
    tasks: Sequence[Task], done: set[str], timings: Sequence[Path], workers: int, declared: float | None = None
) -> BenchPlan:
    """Return the plan of these tasks: cells to run, cells that are done, and the time that they take.

    - ``done``: jobs that have their rows
    - ``timings``: files ``timings.parquet``, of the folder and of others; the first that has timed a kind of cell
      counts
    - ``workers``: processes among which the time is divided
    - ``declared``: mean seconds of a cell that the suite states
    """
    pairs = [(task, cell) for task, cell in cells_of(tasks) if cell.job not in done]
    cells = Counter((task.plant.name, task.scenario.name, cell.identifier.name) for task, cell in pairs)
    times: dict[tuple[str, str, str], float] = {}
    for path in timings:
        times = _times(path) | times
    known = sum(count for names, count in cells.items() if names in times)
    seconds = None
    if known:
        timed = sum(count * times[names] for names, count in cells.items() if names in times)
        seconds = timed / known * sum(cells.values()) / workers
    limit = sum(task.time_limit for task, _ in pairs) / workers
    stated = None if declared is None else declared * sum(cells.values()) / workers
    return BenchPlan(dict(cells), len(done), seconds, known, limit, stated)


def _times(timings: Path) -> dict[tuple[str, str, str], float]:
    """Return the mean seconds of a cell by plant, scenario and identifier; data are shared by a task's cells."""
    if not timings.is_file():
        return {}
    table = read_columns(timings).to_pydict()
    with reading(timings):
        keys = list(zip(table["plant"], table["scenario"], table["identifier"], strict=True))
        sharing = Counter(zip(table["plant"], table["scenario"], table["seed"], strict=True))
        values: dict[tuple[str, str, str], list[float]] = {}
        for k, key in enumerate(keys):
            data = table["data_seconds"][k] / sharing[key[0], key[1], table["seed"][k]]
            values.setdefault(key, []).append(data + table["fit_seconds"][k] + table["score_seconds"][k])
        return {key: float(np.mean(found)) for key, found in values.items()}
