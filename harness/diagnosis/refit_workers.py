"""Worker processes of one diagnosis: started when there is something to do, and told the form once."""

from __future__ import annotations

import importlib
import io
import multiprocessing
import os
import pickle
import tempfile
from collections import ChainMap
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Any

import cloudpickle

from harness.diagnosis.forms import Form, placed_name
from harness.diagnosis.refit import Task, solved
from harness.effects.effect import Effect
from harness.workers import death, worker_pool

__all__ = ["RefitWorkers"]

KEPT = 2
"""Forms that a worker remembers."""
_forms: dict[str, Any] = {}


def _parts(effect: Effect) -> tuple[Any, ...]:
    """Return how an effect is rebuilt elsewhere; by value if it is defined in a script or in a function."""
    function = effect.function
    if function.__module__ == "__main__" or "<locals>" in function.__qualname__:
        return Effect, tuple(getattr(effect, one.name) for one in fields(Effect))
    return effect.__reduce__()


def _work(path: str, packed: bytes) -> dict[str, Any] | None:
    """Solve one task in a worker; None if it did not arrive whole. The form is read once."""
    try:
        if path not in _forms:
            while len(_forms) >= KEPT:
                del _forms[next(iter(_forms))]
            _forms[path] = pickle.loads(Path(path).read_bytes())
        task, seed = pickle.loads(packed)
    except Exception:  # whatever the author's own modules do where the script is not there
        return None
    return solved(_forms[path], task, seed)


def _ready() -> None:
    """Import what a refit needs."""
    importlib.import_module("harness.diagnosis.output_form")


class RefitWorkers:
    """The worker processes of one diagnosis; a context manager that ends them.

    Parameters
    ----------
    count : int
        Processes at most; with 1, or inside a daemon (which may have no children), all is done in this process.
    """

    def __init__(self, count: int) -> None:
        self.count = 1 if multiprocessing.current_process().daemon else min(count, os.cpu_count() or 1)
        self._stack = ExitStack()
        self._pool: Any = None
        self._folder: Path | None = None
        self._sent: list[tuple[Form, str | None]] = []

    def __enter__(self) -> RefitWorkers:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)
        self._pool, self._folder, self._sent = None, None, []

    def prepare(self) -> None:
        """Let the processes start while this one does something else."""
        if self.count < 2 or self._pool is not None:
            return
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="sysid-harness-")))
        self._pool = self._stack.enter_context(worker_pool(self.count))
        for _ in range(self.count):
            self._pool.schedule(_ready)

    def solved(self, form: Form, tasks: Sequence[tuple[Task, int]]) -> Generator[tuple[Task, dict[str, Any]]]:
        """Yield (task, record) of tasks and their seeds as they are finished.

        What cannot travel to another process is solved in this one. A task whose worker was lost is tried once more; if
        that one is lost too, its record says how.
        """
        self.prepare()
        file = self._file(form) if self.count > 1 else None
        packed = [] if file is None else [_packed(pair) for pair in tasks]
        if file is None or None in packed:
            for task, seed in tasks:
                yield task, solved(form, task, seed)
            return
        waiting: dict[Any, tuple[Task, int, Any]] = {}
        tried: set[str] = set()
        for (task, seed), one in zip(tasks, packed, strict=True):
            waiting[self._pool.schedule(_work, args=[file, one])] = (task, seed, one)
        try:
            while waiting:
                for future in wait(list(waiting), return_when=FIRST_COMPLETED).done:
                    task, seed, one = waiting.pop(future)
                    error = future.exception()
                    if error is None:
                        yield task, future.result() or solved(form, task, seed)
                    elif not isinstance(error, OSError):
                        raise error
                    elif task.key in tried:
                        why = f"{placed_name(task.effects)}: {death(error)}, twice"
                        yield task, {"failed": why, "lost": True}
                    else:
                        tried.add(task.key)
                        waiting[self._pool.schedule(_work, args=[file, one])] = (task, seed, one)
        finally:
            for future in waiting:
                future.cancel()

    def _file(self, form: Form) -> str | None:
        """Return the file with the form, written once; None if it cannot travel."""
        for known, path in self._sent:
            if known is form:
                return path
        assert self._folder is not None
        packed = _packed(form)
        path = None
        if packed is not None:
            path = str(self._folder / f"form-{len(self._sent)}.pickle")
            Path(path).write_bytes(packed)
        self._sent.append((form, path))
        return path


def _packed(thing: Any) -> bytes | None:
    """Return something as bytes, what is defined in a script by value; None if it cannot travel."""
    packed = io.BytesIO()
    pickler = cloudpickle.Pickler(packed)
    pickler.dispatch_table = ChainMap({Effect: _parts}, pickler.dispatch_table)
    try:
        pickler.dump(thing)
    except (pickle.PicklingError, TypeError, AttributeError, ValueError, RuntimeError):
        return None
    return packed.getvalue()
