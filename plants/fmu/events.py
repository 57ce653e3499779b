"""FMI 3.0 co-simulation in event mode: discrete inputs, time events and events met in a step are handled here.

Continuous inputs are set in step mode, discrete ones in event mode and only when they change; no step goes beyond the
next time event that the FMU has announced; a step that ends early is continued (FMI 3.0 sec. 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.errors import PlantError
from plants.fmu.engine import (
    FINE,
    GET_FAILED,
    INPUT_NOT_FINITE,
    SET_FAILED,
    STEP_FAILED,
    FmuEngine,
    SlowLoop,
    Timing,
    grouped,
)
from plants.fmu.instance import Instance
from plants.fmu.variables import FmuPort

EVENTS = 1000  # in one sample, before it counts as endless


class EventEngine(FmuEngine):
    """Steps one instance in event mode; the same buffers and calls as :class:`plants.fmu.engine.FmuEngine`."""

    def __init__(
        self, instance: Instance, inputs: Sequence[FmuPort], outputs: Sequence[FmuPort], timing: Timing
    ) -> None:
        super().__init__(instance, inputs, outputs, timing)
        self.native = False
        self._timing = timing
        self._slow = SlowLoop(self)
        kinds = grouped(inputs, apart=True)
        self._discrete = [number for number, (ports, _) in enumerate(kinds) if _discrete(ports)]
        self._continuous = [number for number in range(len(kinds)) if number not in self._discrete]
        # what the FMU holds is asked of itself: after a snapshot was set, nothing kept here would be right
        self._held = [(n, self._slow.opened(self._group(kinds[n][0], "Get", kinds[n][1]))) for n in self._discrete]
        self.one = lambda: self._guarded(advance=True)
        self.peek = lambda: self._guarded(advance=False)

    def _guarded(self, *, advance: bool) -> int:
        """Hold ``u`` for one sample, or for no time; keep what is raised for :func:`plants.fmu.stops.stopped`."""
        loop = self.loop
        loop.what = FINE
        if not np.isfinite(self.u).all():
            loop.what = INPUT_NOT_FINITE
            return INPUT_NOT_FINITE
        try:
            self._apply()
            if advance:
                self._advance()
        except PlantError as error:
            self.error = error
        except Exception as error:
            self.error = self.instance.failure("the step failed", error)
        if self.error is not None:
            loop.what = STEP_FAILED
            return STEP_FAILED
        if self.look() != FINE:
            return int(loop.what)
        loop.k += int(advance)
        return FINE

    def _apply(self) -> None:
        """Set the inputs, each kind in its mode."""
        self._set(self._continuous)
        if self._changed():
            self.instance.fmu.enterEventMode()
            self._set(self._discrete)
            self.instance.handle_events()

    def _changed(self) -> bool:
        """Return True if the FMU holds other discrete inputs than those wanted."""
        for number, (call, arguments, values, *_) in self._held:
            self.loop.status = call(self.loop.component, *arguments)
            if self.loop.status > 1:
                self.loop.what = GET_FAILED
                raise self.instance.failure("discrete inputs cannot be read")
            _, _, _, scale, offset, columns, code = self._slow.in_groups[number]
            if not np.array_equal(values, self._slow.raw(columns, scale, offset, code)):
                return True
        return False

    def _set(self, groups: Sequence[int]) -> None:
        """Set some groups of inputs."""
        if self._slow.set(groups) != FINE:
            self.loop.what = SET_FAILED
            raise self.instance.failure("inputs cannot be set")

    def _advance(self) -> None:
        """Step through one sample, from event to event."""
        loop, instance = self.loop, self.instance
        events = 0
        for sub in range(loop.substeps):
            t = loop.t0 + (loop.k * loop.substeps + sub) * loop.h
            end = loop.t0 + (loop.k * loop.substeps + sub + 1) * loop.h
            small = 1e-9 * loop.h
            while t < end - small:
                due = instance.next_event
                stop = end if due is None or due >= end - small else max(due, t)
                if stop > t:
                    status = self._slow.do_step(t, stop - t)
                    t = self._reached(status, t, stop)
                if loop.event or (due is not None and t >= due - small):
                    loop.event = False
                    events += 1
                    if events > EVENTS:
                        raise instance.failure(f"{EVENTS} events in the step to t = {end:g} s", status="timeout")
                    instance.enter_events()

    def _reached(self, status: int, t: float, stop: float) -> float:
        """Return the time that a step has reached, or raise."""
        loop, instance = self.loop, self.instance
        loop.status = status
        if status > 1 or status < 0:
            if status == 4:
                instance.dead = True
            raise instance.failure(f"the step failed in the step from t = {t:g} s (status {status})")
        loop.warnings += status == 1
        if loop.terminate:
            raise instance.failure(f"the FMU ends the simulation at t = {loop.last:g} s", status="terminated")
        if not loop.early:
            return stop
        reached = float(loop.last)
        if not (reached > t or loop.event):
            raise instance.failure(f"the step from t = {t:g} s does not end", status="timeout")
        return min(max(reached, t), stop)


def _discrete(ports: Sequence[FmuPort]) -> bool:
    """Return True if a group of inputs may change in event mode only."""
    return bool(ports[0].variable.variability == "discrete")
