"""How long foreign code is waited for: at first as long as anybody asks, then by what its steps took before."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any

from harness.errors import PlantError
from harness.supervision.guarded import alive

LONGEST = 10.0  # Seconds that a step, or the start of a run, may take where nothing is known of steps.
LOADING = 30.0
"""Seconds that loading may take. The largest libraries of public FMUs are loaded in one or two; a process begins then,
on a machine that may have much to do."""
LEAST = 2.0  # Seconds that any step may take: other processes may hold up the machine for so long.
SLOWER = 100.0
"""Times the mean of its slowest run that a step may take beyond that: a solver at an event takes tens of times as
long as between two."""
LONGER = "(for longer: --step-limit SECONDS)"  # What a message adds to a step that does not end.
PULSE = 0.25  # s between two looks at a step that takes long


class _Asked:
    """What the caller of a command asks for."""

    longest = LONGEST


@contextmanager
def waiting(longest: float | None) -> Iterator[None]:
    """Wait so long [s] for a step of foreign code that is run by this process itself, or as usual where None."""
    before = _Asked.longest
    _Asked.longest = before if longest is None else longest
    try:
        yield
    finally:
        _Asked.longest = before


class Patience:
    """How long a step may take.

    Examples
    --------
    >>> patience = Patience()
    >>> patience.limit()
    10.0
    >>> patience.took(1000, 0.2)
    >>> patience.limit(), patience.limit(1000)
    (2.02, 10.0)
    """

    def __init__(self, longest: float | None = None) -> None:
        self.longest = _Asked.longest if longest is None else float(longest)
        self._slowest: float | None = None

    def took(self, steps: int, seconds: float) -> None:
        """Take note of so many steps in a row."""
        if steps > 0:
            self._slowest = max(self._slowest or 0.0, seconds / steps)

    def limit(self, steps: int = 1) -> float:
        """Return how long so many steps may take [s]."""
        if self._slowest is None:
            return self.longest
        return min(self.longest, LEAST + SLOWER * steps * self._slowest)


class Aside:
    """Calls of foreign code in a thread of its own, which is left behind where one does not end.

    What is left behind gets the processor only when nobody else wants it, and ends with the process. A library that
    keeps the interpreter to itself, as it may while it is loaded, stops this clock; then whoever guards the process
    waits no longer than for loading.

    - ``name``: of what is called, for messages
    """

    def __init__(self, name: str, longest: float | None = None) -> None:
        self.patience, self._name = Patience(longest), name
        self._thread: threading.Thread | None = None
        self._process = 0

    def call(self, work: Callable[[], Any], count: Callable[[], int], where: Callable[[], str], *, loads: bool) -> Any:
        """Return what ``work`` does.

        - ``count``: of the steps that it has done
        - ``where``: what is at work, such as ``"the step from t = 1 s"``
        - ``loads``: whether it begins by loading a library

        Raises PlantError (``timeout``) if the count stands still for longer than a step may take.
        """
        if loads:
            self._promise()
        if self._thread is None or self._process != os.getpid():
            self._begin()
        self._orders.put(work)
        last, waited = count(), 0.0
        try:
            while True:
                try:
                    done, error = self._answers.get(timeout=PULSE)
                    break
                except Empty:
                    self._promise()
                    waited += PULSE
                    if (steps := count()) != last:
                        last, waited = steps, 0.0
                    elif waited > (limit := self.patience.limit()):
                        text = f"{self._name}: {where()} does not end within {limit:.3g} s {LONGER}"
                        raise PlantError(text, status="timeout") from None
        except BaseException:
            self._leave()
            raise
        alive()
        if error is not None:
            raise error
        return done

    def _promise(self) -> None:
        """Promise the next sign of life."""
        limit = max(LOADING, self.patience.longest)
        alive(limit, f"{self._name}: is not loaded within {limit:g} s {LONGER}")

    def _begin(self) -> None:
        """Start the thread, which ends when nothing can call it any more."""
        orders: SimpleQueue[Callable[[], Any] | None] = SimpleQueue()
        answers: SimpleQueue[tuple[Any, BaseException | None]] = SimpleQueue()

        def serve() -> None:
            while (work := orders.get()) is not None:
                try:
                    answer: tuple[Any, BaseException | None] = work(), None
                except BaseException as error:
                    answer = None, error
                del work  # while the thread waits, it keeps nothing of what it worked on
                answers.put(answer)
                del answer

        self._orders, self._answers, self._process = orders, answers, os.getpid()
        self._thread = threading.Thread(target=serve, daemon=True)
        self._thread.start()
        weakref.finalize(self, orders.put, None)

    def _leave(self) -> None:
        """Leave the thread behind."""
        assert self._thread is not None
        if hasattr(os, "sched_setscheduler"):
            with suppress(OSError):
                os.sched_setscheduler(self._thread.native_id or 0, os.SCHED_IDLE, os.sched_param(0))
        self._thread = None
