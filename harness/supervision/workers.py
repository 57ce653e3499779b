"""Pools of worker processes: each begins afresh, with one thread, quiet, and without the caller's main script.

No worker is ever forked: the copy of a process with threads may wait for ever for a lock whose holder was not copied,
and libraries of data frames, of logs and of progress bars start threads that nobody sees.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import Pipe, spawn
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from harness.errors import HarnessError
from harness.supervision.processes import adopt_orphans

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[Any]:
    """Give a pool of processes, and wait for its end; an exception ends it at once.

    - ``workers``: processes at most; they start when there is something to do

    Yields
    ------
    pebble.ProcessPool
        A task that is lost with its worker has a future with an exception; see :func:`death`.

    Examples
    --------
    >>> import math
    >>> with worker_pool(1) as pool:
    ...     pool.schedule(math.sqrt, args=[9.0]).result()
    3.0
    """
    from pebble import ProcessPool

    pool: Any = ProcessPool(max_workers=max(1, workers), initializer=_quiet, context=_Fresh())
    try:
        yield pool
        pool.close()
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.join()


def fresh_process(target: Callable[..., None], *arguments: Any) -> tuple[Connection, SpawnProcess]:
    """Start ``target(connection, *arguments)`` in a process of its own; returns our end of the line, and the process.

    Unlike a worker of a pool it may have processes of its own.
    """
    ours, theirs = Pipe()
    process = _FreshProcess(target=target, args=(theirs, *arguments))
    process.start()
    theirs.close()
    return ours, process


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Keep linear algebra of this process to one thread.

    On small matrices more of them wait for each other, for long where the other cores are busy.

    Examples
    --------
    >>> import numpy
    >>> from threadpoolctl import threadpool_info
    >>> with one_thread():
    ...     {library["num_threads"] for library in threadpool_info()}
    {1}
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield


def cores() -> int:
    """Return the processors that this process may use; all of them where the system does not say (macOS, Windows).

    Examples
    --------
    >>> cores() >= 1
    True
    """
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1


def death(error: BaseException) -> str:
    """Return the end of a worker in words, from the exception of the future that it left behind.

    Examples
    --------
    >>> from pebble import ProcessExpired
    >>> death(ProcessExpired("lost", code=-11))
    'the worker died: SIGSEGV'
    """
    code = getattr(error, "exitcode", None)
    if isinstance(code, int) and code < 0:
        with contextlib.suppress(ValueError):
            return f"the worker died: {signal.Signals(-code).name}"
    if isinstance(code, int):
        return f"the worker ended itself with exit status {code}"
    return f"the worker was lost: {error if isinstance(error, HarnessError) else f'{type(error).__name__}: {error}'}"


def _quiet() -> None:
    """Prepare a worker: Ctrl-C is the parent's business, and the chatter of engines goes nowhere."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # what it starts ends with it
    adopt_orphans()
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:  # of a group of its own, it is not ended with the caller's
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


class _FreshProcess(SpawnProcess):
    """A process that knows nothing of the caller's main script.

    The start of an ordinary one runs that script again, which would start everything anew where it asks for workers
    outside ``if __name__ == "__main__"``. What workers need of it must travel by value.
    """

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with _starting():
            return SpawnProcess._Popen(process_obj)


class _Fresh(SpawnContext):
    """Starts fresh processes."""

    Process = _FreshProcess


_one_at_a_time = threading.RLock()


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """While this thread starts a process, leave the main script out and give it one thread for linear algebra.

    Nothing of the caller is touched: other threads may start processes of their own, with all they need.
    """
    me = threading.get_ident()

    def without_main(name: str) -> dict[str, Any]:
        data = dict(usual(name))
        if threading.get_ident() == me:
            for key in ("init_main_from_name", "init_main_from_path"):
                data.pop(key, None)
        return data

    with _one_at_a_time:
        before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
        usual = spawn.get_preparation_data
        spawn.get_preparation_data = without_main
        for name in THREAD_VARIABLES:
            os.environ.setdefault(name, "1")
        try:
            yield
        finally:
            spawn.get_preparation_data = usual
            for name, old in before.items():
                if old is None:
                    os.environ.pop(name, None)
