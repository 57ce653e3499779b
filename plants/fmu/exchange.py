"""Model exchange: the FMU gives derivatives and events, a solver from SUNDIALS or SciPy moves time.

The solver starts anew where the held input jumps, at events, and where somebody takes or sets the state; so the
continuation from a snapshot is the same, bit for bit. Where nothing jumps it goes on with its history: starting anew at
every sample cost a hundred times the error at a loose tolerance. State events are located by the solver, time events
and step events handled as FMI 2.0.5 sec. 3.2.1 asks for.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from ctypes import POINTER, c_double
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError, PlantError
from harness.signals import FloatArray
from plants.fmu.engine import STEP_FAILED, FmuEngine, Timing
from plants.fmu.instance import Instance
from plants.fmu.variables import FmuPort

EVENTS = 1000  # in one sample, before it counts as endless


class ExchangeEngine(FmuEngine):
    """Steps one model exchange instance; the same buffers and calls as :class:`plants.fmu.engine.FmuEngine`."""

    def __init__(
        self,
        instance: Instance,
        inputs: Sequence[FmuPort],
        outputs: Sequence[FmuPort],
        timing: Timing,
        *,
        solver: str,
        tolerance: float,
    ) -> None:
        super().__init__(instance, inputs, outputs, timing)
        if solver not in ("cvode", "rk45"):
            raise InputError("solver", expected="'cvode' or 'rk45'", got=repr(solver), remedy="choose one")
        self.native = False
        self._solver_name, self._tolerance = solver, tolerance
        self._timing = timing
        self._nx = int(instance.file.description.numberOfContinuousStates)
        self._nz = int(instance.file.description.numberOfEventIndicators)
        self._needs_completed = bool(getattr(instance.interface, "needsCompletedIntegratorStep", True))
        self._solver: Any = None
        self._next_event: float | None = None
        self._look, self._peek = self.look, self.peek
        self.one = lambda: self._guarded(self._one)
        self.look = lambda: self._guarded(self._started)
        self.peek = lambda: self._guarded(self._peeked)
        self._initialised = False
        self._held: FloatArray | None = None  # input under which the solver goes on; None: it must start anew

    def renew(self) -> None:
        """Take over a new or newly initialised instance."""
        super().renew()
        self._solver = None
        self._next_event = None
        self._initialised = False
        self._held = None

    def settle(self) -> None:
        """Forget what the solver knew: the state was set from outside."""
        self._solver = self._held = None
        self._event(self._now(), first=False)

    def touched(self) -> None:
        """Let the solver start anew: somebody took the state or changed a parameter."""
        self._held = None

    def _now(self) -> float:
        return self._timing.t0 + int(self.loop.k) * self._timing.sample_time

    def _guarded(self, job: Callable[[], int]) -> int:
        """Return what a job returns; keep what it raises for :func:`plants.fmu.stops.stopped`."""
        try:
            return job()
        except PlantError as error:
            self.error = error
        except Exception as error:
            t = self._now()
            self.error = self.instance.failure(f"the step from t = {t:g} s failed", error)
        self.loop.what = STEP_FAILED
        return STEP_FAILED

    def _started(self) -> int:
        """Settle the initial event, then read the outputs."""
        if not self._initialised:
            self._initialised = True
            self._event(self._now(), first=True)
        return self._look()

    def _peeked(self) -> int:
        """Apply the input at an event and read the outputs."""
        self._held = None
        self._enter_event_mode()
        stopped = self._peek()
        if stopped:
            return stopped
        self._update(self._now())
        return self._look()

    def _one(self) -> int:
        """Hold ``u`` for one sample."""
        fmu, t = self.instance.fmu, self._now()
        end = self._timing.t0 + (self.loop.k + 1) * self._timing.sample_time
        if self._held is None or not np.array_equal(self.u, self._held):
            self._held = None
            self._enter_event_mode()
            stopped = self._peek()
            if stopped:
                return stopped
            self._update(t)
            self._restart(t)
            self._held = self.u.copy()
        events = 0
        while t < end - 1e-12 * max(1.0, abs(end)):
            stop = end if self._next_event is None else min(end, max(self._next_event, t))
            found = False
            if stop > t:
                found, t = self._integrate(t, stop)
            fmu.setTime(t)
            step_event = self._completed()
            due = self._next_event is not None and t >= self._next_event - 1e-12 * max(1.0, abs(t))
            if found or step_event or due:
                events += 1
                if events > EVENTS:
                    raise self.instance.failure(f"{EVENTS} events in the step from t = {t:g} s", status="timeout")
                self._enter_event_mode()
                self._update(t)
                self._restart(t)
        self.loop.k += 1
        return self._look()

    def _completed(self) -> bool:
        """Tell the FMU that the solver has accepted a step."""
        if not self._needs_completed:
            return False
        fmu = self.instance.fmu
        if self.instance.version == 1:
            return bool(fmu.completedIntegratorStep())
        event, terminate = fmu.completedIntegratorStep()
        if terminate:
            raise self.instance.failure("the FMU ends the simulation", status="terminated")
        return bool(event)

    def _enter_event_mode(self) -> None:
        if self.instance.version > 1:
            self.instance.fmu.enterEventMode()

    def _event(self, t: float, *, first: bool) -> None:
        """Handle the initial event, or one after the state was set."""
        if self.instance.version == 1:
            if first:
                *_, terminate, defined, when = self.instance.fmu.initialize(
                    toleranceControlled=b"\x01", relativeTolerance=self._tolerance
                )
                self._after_event(terminate, defined, when)
            return
        if not first:
            self.instance.fmu.setTime(t)
            self._enter_event_mode()
        self._update(t)

    def _update(self, t: float) -> None:
        """Iterate the discrete states until they settle, then go on in continuous time."""
        fmu, version = self.instance.fmu, self.instance.version
        for _ in range(EVENTS):
            if version == 1:
                converged, _references, _values, terminate, defined, when = fmu.eventUpdate()
                again = not converged
            else:
                update = fmu.newDiscreteStates if version == 2 else fmu.updateDiscreteStates
                again, terminate, _nominals, _values, defined, when = update()
            self._after_event(terminate, defined, when)
            if not again:
                break
        else:
            raise self.instance.failure(f"{EVENTS} event iterations at t = {t:g} s", status="timeout")
        if version > 1:
            fmu.enterContinuousTimeMode()

    def _after_event(self, terminate: bool, defined: bool, when: float) -> None:
        if terminate:
            raise self.instance.failure("the FMU ends the simulation at an event", status="terminated")
        self._next_event = float(when) if defined else None

    def _restart(self, t: float) -> None:
        """Give the solver the present state."""
        if self._solver is None:
            make = _Cvode if self._solver_name == "cvode" else _RungeKutta
            self._solver = make(self.instance, self._nx, self._nz, t, self._timing.sample_time, self._tolerance)
        self._solver.restart(t)

    def _integrate(self, t: float, stop: float) -> tuple[bool, float]:
        """Move to ``stop`` or to the first state event; returns whether there was one, and the time reached."""
        found, reached = self._solver.step(t, stop)
        if not np.isfinite(reached):
            self.loop.what = STEP_FAILED
            raise self.instance.failure(f"the solver fails at t = {t:g} s", status="diverged")
        return found, reached


class _Solver:
    """The calls into the FMU that both solvers make."""

    def __init__(self, instance: Instance, nx: int, nz: int) -> None:
        self.fmu, self.nx, self.nz = instance.fmu, nx, nz
        three = instance.version == 3
        self.derivatives = self.fmu.getContinuousStateDerivatives if three else self.fmu.getDerivatives
        self._nominals = (
            self.fmu.getNominalContinuousStates if instance.version == 1 else self.fmu.getNominalsOfContinuousStates
        )

    def nominals(self, values: Any, n: int) -> None:
        """Fill in the sizes of the states; 0, which some tools write, is none and means 1."""
        self._nominals(values, n)
        sizes = ctypes.cast(values, POINTER(c_double))
        for i in range(n):
            sizes[i] = abs(sizes[i]) if sizes[i] != 0.0 and math.isfinite(sizes[i]) else 1.0


class _Cvode(_Solver):
    """SUNDIALS' CVODE (BDF with root finding) through fmpy."""

    def __init__(self, instance: Instance, nx: int, nz: int, t: float, dt: float, tolerance: float) -> None:
        super().__init__(instance, nx, nz)
        from fmpy.sundials import CVodeSolver

        class Held:
            """The input is held: nothing to apply."""

            def apply(self, _t: float) -> None:
                """Leave the input as it is."""

        self._cvode = CVodeSolver(
            nx=nx,
            nz=nz,
            get_x=self.fmu.getContinuousStates,
            set_x=self.fmu.setContinuousStates,
            get_dx=self.derivatives,
            get_z=self.fmu.getEventIndicators,
            get_nominals=self.nominals,
            set_time=self.fmu.setTime,
            input=Held(),
            startTime=t,
            maxStep=dt,
            relativeTolerance=tolerance,
            maxNumSteps=100_000,
        )

    def restart(self, t: float) -> None:
        """Start anew from the FMU's state."""
        self._cvode.reset(t)

    def step(self, t: float, stop: float) -> tuple[bool, float]:
        """Integrate to ``stop`` or the first root."""
        found, _roots, reached = self._cvode.step(t, stop)
        return bool(found), float(reached)


class _RungeKutta(_Solver):
    """SciPy's RK45; roots of the event indicators by bisection on its interpolant."""

    def __init__(self, instance: Instance, nx: int, nz: int, t: float, dt: float, tolerance: float) -> None:
        super().__init__(instance, nx, nz)
        self.tolerance, self.dt = tolerance, dt
        self.x = np.zeros(nx)
        self._dx = np.zeros(nx)
        self._z = np.zeros(nz)
        self._scale = np.ones(nx)
        self._last_step: float | None = None

    def restart(self, t: float) -> None:
        """Read the FMU's state."""
        if self.nx:
            self.fmu.getContinuousStates(_pointer(self.x), self.nx)
            self.nominals(_pointer(self._scale), self.nx)

    def _rates(self, t: float, x: FloatArray) -> FloatArray:
        self._place(t, x)
        self.derivatives(_pointer(self._dx), self.nx)
        return self._dx.copy()

    def _place(self, t: float, x: FloatArray) -> None:
        self.fmu.setTime(t)
        if self.nx:
            self.fmu.setContinuousStates(_pointer(np.ascontiguousarray(x)), self.nx)

    def _signs(self, t: float, x: FloatArray) -> npt.NDArray[np.bool_]:
        self._place(t, x)
        if self.nz:
            self.fmu.getEventIndicators(_pointer(self._z), self.nz)
        return np.asarray(self._z > 0.0)

    def step(self, t: float, stop: float) -> tuple[bool, float]:
        """Integrate to ``stop`` or the first sign change of an indicator."""
        from scipy.integrate import RK45

        before = self._signs(t, self.x)
        if not self.nx:
            return bool((self._signs(stop, self.x) != before).any()), stop
        absolute: Any = self.tolerance * np.abs(self._scale)  # one for each state
        solver = RK45(self._rates, t, self.x, stop, rtol=max(self.tolerance, 1e-12), atol=absolute)
        while solver.status == "running":
            if solver.step() is not None:  # the step size became too small
                return False, float("nan")
            if self.nz and (self._signs(solver.t, solver.y) != before).any():
                path = solver.dense_output()
                low, high = solver.t_old, solver.t
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if not low < middle < high:
                        break
                    if (self._signs(middle, path(middle)) != before).any():
                        high = middle
                    else:
                        low = middle
                self.x = np.asarray(path(high), dtype=float)
                self._place(high, self.x)
                return True, float(high)
        self.x = np.asarray(solver.y, dtype=float)
        self._place(stop, self.x)
        return False, stop


def _pointer(values: FloatArray) -> Any:
    """Return a C pointer to the numbers of an array."""
    return ctypes.cast(values.ctypes.data, POINTER(c_double))
