"""Refits of models with effects: from the store, in this process, or in worker processes.

Every refit depends on its own name and seed only, so the number of workers and the order change nothing. Finished ones
are kept in a store.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.forms import Fitted, Form, placed_name
from harness.diagnosis.refit import Task, solved
from harness.diagnosis.refit_workers import RefitWorkers
from harness.diagnosis.store import Store
from harness.rng import stream

__all__ = ["Refitter"]


@dataclass
class Refitter:
    """Solves tasks: from the store, in this process, or in workers.

    Parameters
    ----------
    form : Form
    store : Store
    seed : int
        Together with a task's effects it keys the random numbers of the refit.
    workers : RefitWorkers, optional
        Processes that help where there is more than one task; by default all is done in this process.
    progress : callable, optional
        Called with the name of each finished refit.
    """

    form: Form
    store: Store
    seed: int = 0
    workers: RefitWorkers | None = None
    progress: Callable[[str], None] | None = None

    def solve(self, tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """Return the record of every task, in order; each is stored as soon as it is there.

        One whose worker was lost is not: it is tried again when the diagnosis is resumed.
        """
        records: dict[str, dict[str, Any]] = {}
        missing: dict[str, Task] = {}
        for task in tasks:
            known = self.store.get(task.key)
            if known is not None:
                records[task.key] = known
            else:
                missing.setdefault(task.key, task)
        with closing(self._solved(list(missing.values()))) as finished:
            for task, record in finished:
                records[task.key] = record
                self.store.put(task.key, record, lasting="lost" not in record)
                if self.progress is not None:
                    self.progress(placed_name(task.effects))
        return [records[task.key] for task in tasks]

    def prepare(self) -> None:
        """Let workers start, if there are any: tasks are about to come."""
        if self.workers is not None:
            self.workers.prepare()

    def fit(self, task: Task) -> Fitted | None:
        """Solve and evaluate one task; None if the refit failed."""
        return self.evaluate(task, self.solve([task])[0])

    def evaluate(self, task: Task, record: Mapping[str, Any]) -> Fitted | None:
        """Return the residuals of a record; None if the refit failed or its simulation breaks down."""
        if "failed" in record:
            return None
        try:
            with np.errstate(all="ignore"):
                return self.form.evaluate(task.effects, record)
        except np.linalg.LinAlgError:
            return None

    def _key(self, task: Task) -> int:
        """Return the seed of a task: its own, whatever the order."""
        return int(stream("diagnosis", placed_name(task.effects), self.seed).integers(2**31))

    def _solved(self, tasks: Sequence[Task]) -> Generator[tuple[Task, dict[str, Any]]]:
        """Yield (task, record) as they are finished."""
        keyed = [(task, self._key(task)) for task in tasks]
        if self.workers is not None and len(keyed) > 1:
            yield from self.workers.solved(self.form, keyed)
        else:
            for task, key in keyed:
                yield task, solved(self.form, task, key)
