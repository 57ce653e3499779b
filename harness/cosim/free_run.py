"""A plant run as it is: nothing is excited, inputs rest at their start values, time is that of its own experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Batch, Feedthrough, Plant
from harness.signals import FloatArray, Trajectory

SAMPLES = 500  # Samples of a run whose file suggests no step.
LENGTH = 1.0  # Seconds of a run whose file suggests no end.
MOST = 5_000_000  # Samples beyond which a run must be asked for with a step of its own.


@dataclass(frozen=True)
class Window:
    """From when to when, and how finely, a run is recorded [s]; ``notes`` tell what nobody asked for."""

    first: float
    end: float
    step: float
    count: int
    notes: tuple[str, ...]

    @property
    def instants(self) -> FloatArray:
        """Sample instants (count,), not accumulated."""
        times: FloatArray = self.first + self.step * np.arange(self.count, dtype=np.float64)
        return times


@dataclass(frozen=True)
class CoupledRun:
    """What a run brought."""

    trajectory: Trajectory  # Up to the end, or up to where the plant ended it; its time column is the plant's own
    notes: tuple[str, ...]  # What was taken where the file suggests nothing, and what is odd
    ended: PlantError | None  # Why the run is shorter than asked for
    beyond: tuple[str, ...] = ()  # Parameters that were given values outside their bounds
    moved: float = 0.0
    """Share of its range by which a tolerance 100 times smaller moves an output; 0 where that was not tried."""

    @property
    def start(self) -> float:
        """Time [s] of the first sample."""
        return float(self.trajectory.t[0])


def window(
    suggested: Mapping[str, float | None],
    *,
    start: float | None,
    stop: float | None,
    step: float | None,
    file: str | Path,
    who: str,
) -> Window:
    """Return the window of a run.

    Raises InputError if nothing lies between start and end, or too many samples do.

    - ``suggested``: ``startTime``, ``stopTime``, ``stepSize`` [s] of the file's own experiment, and
      ``fixedInternalStepSize`` [s] of what runs; None where it has none
    - ``start, stop, step``: as asked for; they go before what is suggested. Where neither says anything: 0, one second
      after the start, and a 500th of the run.
    - ``file``: for messages
    - ``who``: for messages: what suggests, ``"the FMU"``

    Examples
    --------
    >>> window({"stopTime": 2.0}, start=None, stop=None, step=0.3, file="x.fmu", who="the FMU").notes
    ('the last sample is at t = 1.8 s: the end, 2 s, is no multiple of the step 0.3 s after the start',)
    """
    notes: list[str] = []
    first = _given(start, suggested.get("startTime")) or 0.0
    end = _given(stop, suggested.get("stopTime"))
    if end is not None and np.isposinf(end):
        notes.append(f"{who} suggests to run for ever")
        end = None
    if end is None:
        end = first + LENGTH
        notes.append(f"{who} suggests no end: {LENGTH:g} s are run (--stop)")
    if not (np.isfinite(first) and np.isfinite(end) and end > first):
        raise InputError(
            "the end of the run",
            expected=f"after the start, {first:g} s",
            got=f"{end:g} s",
            remedy="give --stop",
            file=file,
        )
    dt = _given(step, suggested.get("stepSize"))
    if dt is None or (step is None and not (np.isfinite(dt) and dt > 0)):
        dt = float(f"{(end - first) / SAMPLES:.6g}")
        inner = suggested.get("fixedInternalStepSize")
        words = f"a {SAMPLES}th of the run"
        if inner is not None and 0 < inner < end - first:
            dt = inner * max(1, round(dt / inner))
            words = f"a multiple of the step inside it, {inner:g} s"
        notes.append(f"{who} suggests no step: {dt:g} s, {words} (--step)")
    count = int(np.floor((end - first) / dt + 1e-9)) + 1 if np.isfinite(dt) and dt > 0 else 0
    if not 2 <= count <= MOST:
        raise InputError(
            "the step",
            expected=f"2 to {MOST} samples between {first:g} and {end:g} s",
            got=f"{dt:g} s, which makes {count}",
            remedy="give --step",
            file=file,
        )
    last = first + (count - 1) * dt
    if abs(end - last) > 1e-6 * dt:
        notes.append(
            f"the last sample is at t = {last:g} s: the end, {end:g} s, is no multiple of the step {dt:g} s after the "
            "start"
        )
    return Window(float(first), float(end), float(dt), count, tuple(notes))


def hold(
    plant: Plant, u: FloatArray, count: int, progress: Callable[[int, int], None] | None = None
) -> tuple[FloatArray, PlantError | None]:
    """Return the outputs (n, ny) under a constant input (nu,) from reset on, and what ended them before ``count``."""
    rows = [plant.reset(rng=np.random.default_rng(0))]  # what runs as it is draws nothing
    through = "feedthrough" in plant.abilities
    if not through and "batch" in plant.abilities:
        try:
            rest = cast(Batch, plant).rollout(np.tile(u, (count - 1, 1)))
            return np.vstack([rows[0], rest]), None
        except PlantError:  # once more, step by step, to keep what comes before the end
            rows = [plant.reset(rng=np.random.default_rng(0))]
    try:
        if through:
            rows[0] = cast(Feedthrough, plant).output(u)
        for k in range(1, count):
            rows.append(plant.step(u))
            if progress is not None and k % 256 == 0:
                progress(k, count)
    except PlantError as error:
        return np.array(rows, dtype=np.float64), error
    return np.array(rows, dtype=np.float64), None


def free_run(
    plant: Plant, u: FloatArray, span: Window, progress: Callable[[int, int], None] | None = None
) -> CoupledRun:
    """Run a plant under a constant input (nu,) through a window, as far as it goes."""
    rows, ended = hold(plant, u, span.count, progress)
    notes = list(span.notes)
    if ended is not None:
        at = span.first + (len(rows) - 1) * span.step
        kept = f"{len(rows)} of {span.count} samples are kept"
        notes.append(f"the run ends at t = {at:g} s of {span.end:g} s ({kept}): {ended}")
    held: FloatArray = np.tile(np.asarray(u, dtype=np.float64), (len(rows), 1))
    record = Trajectory(span.instants[: len(rows)], held, rows, plant.spec)
    return CoupledRun(record, tuple(notes), ended, tuple(getattr(plant, "beyond", ())))


def _given(*values: float | None) -> float | None:
    """Return the first value that is given."""
    return next((value for value in values if value is not None), None)
