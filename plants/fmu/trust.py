"""Whether an FMU's reset and its kept states bring it back: tried once, on first use, against what it did before.

FMUs of several vendors come back from ``fmi2Reset`` with the state of the run before, with old start values, or with
the memory of their solver; some declare states that they do not keep. A second run would then differ in silence.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import HarnessError, PlantError
from harness.signals import FloatArray
from plants.fmu.engine import FmuEngine

ROWS = 50  # Samples of the first run that are repeated.
LONGEST = 2.0  # Seconds of computing after which no more samples of the first run are kept.
CONTINUED = 5  # Samples of a continuation that a kept state must repeat.
NOISE = 1e-9  # Relative difference between two fresh instances that is rounding, and no reason for a fresh process.


@dataclass(frozen=True)
class Start:
    """What a run begins from: values by variable name in the FMU's own types, and inputs (nu,) that drive it then."""

    values: Mapping[str, Any] = field(default_factory=dict)
    driven: FloatArray | None = None

    def __bool__(self) -> bool:
        return bool(self.values) or self.driven is not None


class FirstRun:
    """The beginning of an FMU's first run, kept so that the second can be held against it.

    - ``engine``: what steps the instance
    - ``values``: what the first run began from
    """

    def __init__(self, engine: FmuEngine, values: Start) -> None:
        self._engine, self.values = engine, values
        self._first = engine.y.copy()
        self._u: list[FloatArray] = []
        self._y: list[FloatArray] = []
        self._open = True
        self._spent = 0.0

    def close(self) -> None:
        """Keep no more: what comes next is no plain step."""
        self._open = False

    def step(self) -> int:
        """Step the engine and keep the sample, until there are enough."""
        if not self._open:
            return self._engine.one()
        started = time.perf_counter()
        stopped = self._engine.one()
        self._spent += time.perf_counter() - started
        if stopped:
            self._open = False
        else:
            self.keep(self._engine.u[None], self._engine.y[None])
        return stopped

    def keep(self, u: FloatArray, y: FloatArray) -> None:
        """Keep rows of inputs and what came after them."""
        room = ROWS - len(self._u)
        if not self._open:
            return
        self._u += [row.copy() for row in u[: min(room, len(y))]]
        self._y += [row.copy() for row in y[:room]]
        self._open = len(self._u) < ROWS and self._spent < LONGEST

    def way_back(self, begin: Callable[[Start], None], renew: Callable[[], None], *, once: bool) -> tuple[str, float]:
        """Return the way that brings the FMU back to its start, and the largest difference that its reset left.

        - ``begin``: ``begin(values)`` brings the instance back, sets start values and reads ``engine.y``
        - ``renew``: puts a fresh instance in the place of the present one
        - ``once``: True if the instance is not to be replaced without need: the FMU may exist only once in a process,
          or keeps states for somebody
        """
        held = self._engine.u.copy()
        if self._u:
            rows = np.array(self._u).reshape(len(self._u), -1)
            wanted: FloatArray | None = np.vstack([self._first, *self._y])
            found = self._run(begin, self.values, rows)
        elif self._engine.loop.k == 0 or once:
            return "", 0.0  # never stepped, or nothing to compare with
        else:  # stepped by a loop in C: the last input held, against a fresh instance
            rows = np.tile(held, (ROWS // 2, 1))
            found = self._run(begin, self.values, rows)
            renew()
            wanted = self._run(begin, self.values, rows)
        difference = _difference(wanted, found)
        if self._u and difference == 0.0 and self.values and not once:
            plain = self._run(begin, Start(), rows[:0])  # start values must not outlive a reset
            renew()
            difference = _difference(self._run(begin, Start(), rows[:0]), plain)
        if difference == 0.0:
            return "reset", 0.0
        renew()
        again = _difference(wanted, self._run(begin, self.values, rows))
        return "instance" if again <= NOISE else "process", difference

    def _run(self, begin: Callable[[Start], None], values: Start, rows: FloatArray) -> FloatArray | None:
        """Return the outputs from a new beginning on, as far as they come; None if it cannot begin."""
        try:
            begin(values)
            first = self._engine.y.copy()
            return np.vstack([first, self._engine.many(np.ascontiguousarray(rows))])
        except HarnessError:
            return None


def _difference(one: FloatArray | None, other: FloatArray | None) -> float:
    """Return the largest difference relative to the size of the signal; infinite where one ended before the other."""
    if one is None or other is None or one.shape != other.shape:
        return 0.0 if one is other else float("inf")
    if np.array_equal(one, other, equal_nan=True):
        return 0.0
    size = np.maximum(np.abs(np.vstack([one, other])).max(axis=0, initial=0.0), np.finfo(float).tiny)
    return float(np.nan_to_num(np.abs(one - other) / size, nan=np.inf).max())


def state_error(
    engine: FmuEngine, take: Callable[[], Any], put: Callable[[Any], None], held: FloatArray
) -> float | None:
    """Return by how much the continuation from a kept state differs from the first one; None if it cannot be told.

    - ``engine``: what steps the instance; afterwards it is where it was, if the FMU keeps its state
    - ``take, put``: take the state of the plant, and set it
    - ``held`` (nu,): input of the continuation
    """
    u, y, before = engine.u.copy(), engine.y.copy(), take()
    rows = np.tile(held, (CONTINUED, 1))
    try:
        engine.look()
        here = engine.y.copy()
        engine.loop.rollback = False  # some FMUs stand still where a way back is asked for: then these two differ
        first = engine.many(rows)
        done = len(first)
        put(before)
        engine.look()
        back = engine.y.copy()
        again = engine.many(rows[:done])
        put(before)
    except PlantError:
        return float("inf")
    finally:
        engine.error = None
        engine.u[:], engine.y[:] = u, y
    if done == 0:
        return None
    return _difference(np.vstack([here, first]), np.vstack([back, again]))
