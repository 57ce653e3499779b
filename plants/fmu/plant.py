"""FMUs as plants: co-simulation and model exchange of FMI 1.0, 2.0 and 3.0 behind the one stepping interface."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from harness.errors import PlantError
from harness.protocols import Ability
from harness.signals import FloatArray, PlantSpec
from plants.checking import checked_inputs, refuse_input
from plants.fmu.abilities import Beyond, idle
from plants.fmu.archive import FmuFile, Kind, read_fmu
from plants.fmu.engine import INPUT_NOT_FINITE, FmuEngine, NativeStep, Timing
from plants.fmu.instance import Instance
from plants.fmu.options import (
    check_event_mode,
    chosen_kind,
    complaints,
    count_substeps,
    default,
    encoded,
    out_of_bounds,
    refused,
)
from plants.fmu.stops import finish, stopped
from plants.fmu.trust import FirstRun, Start
from plants.fmu.variables import (
    FmuPort,
    channels,
    choose,
    describe,
    feeds_through,
    own_values,
    resize,
    starts,
    states_of,
)
from plants.mockups import mockup

__all__ = ["FmuPlant", "describe"]

log = logging.getLogger("plants.fmu.plant")


class FmuPlant(Beyond):
    """A functional mock-up unit as a plant.

    Parameters
    ----------
    path : path
        The ``.fmu`` file.
    sample_time : float, optional
        Seconds between samples; default: the step of the FMU's default experiment.
    inputs, outputs : sequence of str, optional
        Names of variables; default: all inputs and all outputs. Outputs may be any variable.
    parameters : mapping, optional
        Values by name, in SI: parameters and structural parameters of any type (numbers, booleans, texts, names of
        enumeration items, sequences for arrays).
    start : mapping, optional
        Start values of other variables by name, in SI: states, initial inputs.
    step : float, optional
        Communication step [s]; the sample time must be a multiple of it; default: the sample time.
    kind : {"cs", "me"}, optional
        Co-simulation or model exchange; default: co-simulation where the FMU offers it.
    solver : {"cvode", "rk45"}
        For model exchange: SUNDIALS' CVODE as shipped with fmpy, or SciPy's Runge-Kutta method.
    tolerance : float, optional
        Relative tolerance of the solver: for model exchange 1e-8 if not given, for co-simulation a hint, if not given
        that of the FMU's default experiment.
    start_time : float
        Time [s] of the first sample as the FMU sees it.
    states : sequence of str, optional
        Variables that are the true states; default: the continuous states where the description names them.
    feedthrough : bool, optional
        Whether outputs depend directly on inputs; default: as the model structure tells. Where it does not tell, no.
    event_mode, early_return : bool
        FMI 3.0 co-simulation: handle discrete inputs, time events and events met in a step here instead of inside
        the FMU; let the FMU end steps early.
    debug : bool
        Ask the FMU for debug messages (Python logger ``plants.fmu.plant``).

    Raises
    ------
    InputError
        If the file is no FMU, is unsafe to unpack, has no binary for this system, or an option does not fit it.

    Notes
    -----
    The input is held over ``[t_k, t_k + sample_time)`` and ``t_k = start_time + k sample_time`` is never accumulated.
    One instance is kept and reset between runs. ``warnings`` lists what is odd about the FMU, ``beyond`` what was given
    a value outside the bounds that the FMU declares.

    Examples
    --------
    >>> import numpy as np
    >>> from plants.mockups import mockup
    >>> with FmuPlant(mockup("pendulum"), sample_time=0.01, outputs=["theta"], parameters={"b": 0.0}) as plant:
    ...     print(plant.spec)
    ...     y = plant.reset(rng=np.random.default_rng(0), x0={"theta": 0.1})
    ...     print(plant.step(np.zeros(1)).round(4))
    u [N m] -> theta [rad] every 0.01 s
    [0.0999]
    """

    probe_tool: ClassVar[str] = "fmu-probe"  # Registered tool that tells whether a plant of this class can be trusted.
    describe = staticmethod(describe)
    mockup = staticmethod(mockup)

    def __init__(
        self,
        path: str | Path,
        *,
        sample_time: float | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        parameters: Mapping[str, Any] | None = None,
        start: Mapping[str, Any] | None = None,
        step: float | None = None,
        kind: Kind | None = None,
        solver: Literal["cvode", "rk45"] = "cvode",
        tolerance: float | None = None,
        start_time: float = 0.0,
        states: Sequence[str] | None = None,
        feedthrough: bool | None = None,
        event_mode: bool = False,
        early_return: bool = False,
        debug: bool = False,
    ) -> None:
        self._options = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        self.file: FmuFile = read_fmu(path)
        resize(self.file, parameters)
        self.kind: Kind = chosen_kind(self.file, kind)
        check_event_mode(self.file, self.kind, event_mode=event_mode, early_return=early_return)
        dt = default(self.file, "stepSize") if sample_time is None else sample_time
        if dt is None:
            raise refused(
                self.file,
                "no sample time",
                "a number of seconds",
                "none, and the FMU suggests none",
                "give sample_time=0.01 or the like (sysid: --option sample_time=0.01)",
            )
        self._tolerance = tolerance
        self._inputs = choose(self.file, inputs, "input")
        self._outputs = choose(self.file, outputs, "output")
        self._truth = states_of(self.file) if states is None else choose(self.file, states, "output")
        direct, told = feeds_through(self.file, self._inputs, self._outputs)
        direct = direct if feedthrough is None else feedthrough
        self.spec = PlantSpec(channels(self._inputs), channels(self._outputs), float(dt), channels(self._truth), direct)
        self._substeps = count_substeps(self.file, self.spec.sample_time, step)
        step_size = self.spec.sample_time / self._substeps
        told = self.tells_feedthrough = told or feedthrough is not None
        self.warnings = complaints(self.file, self.kind, step_size, self.unit_complaints, told=told)
        self._start = dict[str, Any](self.file.changed_starts)
        self._start |= encoded(self.file, parameters or {}, "parameters", ("parameter", "structuralParameter"))
        self._start.update(encoded(self.file, start or {}, "start", None))
        self.beyond = out_of_bounds(self.file, {**(parameters or {}), **(start or {})})
        self._t0 = float(start_time)
        interface = self.file.interface(self.kind)
        rollback = bool(interface.canGetAndSetFMUstate) and self.file.version > 1
        optional: dict[Ability, bool] = {"snapshots": rollback, "feedthrough": direct, "truth": bool(self._truth)}
        optional["batch-truth"] = bool(self._truth) and self.kind == "cs"
        self.abilities: frozenset[Ability] = frozenset({"batch", *(name for name, has in optional.items() if has)})
        self._instance = Instance(self.file, self.kind, event_mode=event_mode, early_return=early_return, debug=debug)
        self._finalizer = weakref.finalize(self, self._instance.close)
        try:
            self._engine = self._made_engine(self._inputs, self._outputs, solver)
            self._observer = FmuEngine(self._instance, (), self._truth, None)
        except BaseException:
            self.close()
            raise
        self._entered = Start()
        self._first: FirstRun | None = None  # the beginning of the first run, until the way back is known
        self.way_back: str | None = None  # "reset", "instance" or "process", known from the second reset on
        self._both: FmuEngine | None = None  # reads outputs and states at once; made when it is needed
        self._solver = solver
        self._shape = (self.spec.nu,)
        self._one: Callable[[], int] = idle

    def _made_engine(self, inputs: Sequence[FmuPort], outputs: Sequence[FmuPort], solver: str) -> FmuEngine:
        """Return what steps the instance."""
        timing = Timing(self._t0, self.spec.sample_time, self._substeps)
        if self.kind == "cs" and self._instance.event_mode:
            from plants.fmu.events import EventEngine

            return EventEngine(self._instance, inputs, outputs, timing)
        if self.kind == "cs":
            return FmuEngine(self._instance, inputs, outputs, timing)
        from plants.fmu.exchange import ExchangeEngine

        return ExchangeEngine(self._instance, inputs, outputs, timing, solver=solver, tolerance=self.tolerance)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Initialise the FMU anew; ``x0`` sets start values of states by name, in SI; returns ``y[0]`` (ny,).

        Raises
        ------
        InputError
            If ``x0`` names something that has no start value.
        PlantError
            If the FMU fails to initialise.
        """
        self.enter(rng=rng, x0=x0)
        return self.leave()

    def enter(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> None:
        """Begin a :meth:`reset`, which :meth:`leave` ends; between them :meth:`drive` is to be had."""
        self._check_open()
        self._one = idle
        values = dict(self._start)
        values.update(encoded(self.file, x0 or {}, "x0", None))
        if self.way_back is None and self._first is not None:
            self._find_way_back(self._first)
        self._entered = Start(values)
        self._enter(values)

    drives = True  # Whether :meth:`drive` is to be had.

    def drive(self, u: FloatArray) -> FloatArray:
        """Set inputs (nu,) while the FMU initialises (FMI 2.0.5 sec. 4.2.4); returns the outputs (ny,) that follow.

        FMI 1.0 has no such mode: where an input is to begin otherwise, a fresh instance is initialised with it.
        """
        if self.file.version > 1:
            self._entered = Start(self._entered.values, u.copy())
            self._engine.u[:] = u
            broken = self._engine.initial()
        else:
            before = self._entered.driven
            if not np.array_equal(u, self.input_starts if before is None else before):
                # After a reset some never return from a step if inputs were set first, so what it leaves is not tried.
                self._instance.resets, self.way_back = False, "process"
                self._instance.renew()
                self._enter({**self._entered.values, **own_values(self._inputs, u)})
                self._entered = Start(self._entered.values, u.copy())
            broken = self._engine.look()
        if broken:
            raise stopped(self._engine)
        return self._engine.y.copy()

    def leave(self) -> FloatArray:
        """End what :meth:`enter` began; returns ``y[0]`` (ny,)."""
        self._leave()
        if self.way_back is None:
            self._first = FirstRun(self._engine, self._entered)
            self._one = self._first.step  # of that object: a method of this one would keep the plant alive
        else:
            self._one = self._engine.one
        return self._engine.y.copy()

    def _begin(self, start: Start) -> None:
        """Initialise the FMU anew and read the outputs."""
        self._enter(start.values)
        if start.driven is not None:
            self._engine.u[:] = start.driven
            self._engine.initial()
        self._leave()

    def _enter(self, values: Mapping[str, Any]) -> None:
        """Begin to initialise the FMU, with values in its own types and units."""
        hint = default(self.file, "tolerance") if self._tolerance is None else self._tolerance
        self._instance.enter(values, self._t0, hint)
        for engine in (self._engine, self._observer, *(() if self._both is None else (self._both,))):
            engine.renew()

    def _leave(self) -> None:
        """End the initialisation and read the outputs."""
        self._instance.leave()
        for engine in (self._engine, *(() if self._both is None else (self._both,))):
            engine.loop.k = 0
        self._engine.loop.rollback = bool(self._instance.states)
        self._engine.loop.warnings = 0
        if self._engine.look():
            raise stopped(self._engine)

    def _find_way_back(self, first: FirstRun) -> None:
        """Try once whether the FMU's reset brings it back; where it does not, every run gets a fresh instance."""
        once = bool(self._instance.interface.canBeInstantiatedOnlyOncePerProcess or self._instance.states)
        if not self._instance.resets:
            self.way_back = "instance"
            return
        found, difference = first.way_back(self._begin, self._instance.renew, once=once)
        if not found:
            return
        self.way_back, self._first = found, None
        if found == "reset":
            return
        self._instance.resets = False
        text = f"reset does not bring the FMU back (a second run differs by {100 * difference:.3g} % of the signal): "
        text += "every run gets a fresh instance"
        if found == "process":
            text += ", which does not repeat the first run either: only a fresh process does, as an isolated plant has"
        self.warnings += (text,)
        log.warning("%s: %s", self.file.path.name, text)

    @property
    def needs_process(self) -> bool:
        """True where only a fresh process brings the FMU back."""
        return self.way_back == "process"

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,).

        Raises
        ------
        PlantError
            If the FMU fails (``crashed``), ends the simulation (``terminated``) or returns NaN (``diverged``).
        """
        engine = self._engine
        if u.shape != self._shape:
            refuse_input(u, self.spec)
        engine.u[:] = u
        if self._one():
            self._finish(engine)
        return engine.y.copy()

    @property
    def divides(self) -> bool:
        """Whether :meth:`step_part` is to be had: co-simulation with variable communication steps, no event mode."""
        able = bool(getattr(self.file.interface(self.kind), "canHandleVariableCommunicationStepSize", False))
        return self.kind == "cs" and able and not self._instance.event_mode

    def step_part(self, u: FloatArray, k: int, count: int) -> FloatArray:
        """Hold ``u`` (nu,) for the k-th of so many equal parts of a sample; returns the output (ny,) at its end.

        The parts of a sample are to be stepped through in order.

        Raises
        ------
        PlantError
            As :meth:`step` does.
        """
        if count == 1:
            return self.step(u)
        self._leave_record()
        loop = self._engine.loop
        h, sample = loop.h, loop.k
        loop.h, loop.k = h / count, sample * count + k
        try:
            y = self.step(u)
        finally:
            loop.h, loop.k = h, sample + (k == count - 1)
        return y

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state in one call; returns (N, ny), equal to stepping."""
        return self._rolled(self._engine, inputs)

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx); for co-simulation.

        Raises
        ------
        InputError
            If the plant does not declare ``"batch-truth"``.
        """
        if "batch-truth" not in self.abilities:
            got, remedy = f"kind {self.kind!r}, {len(self._truth)} states", "step, and ask truth() after every step"
            raise refused(self.file, "a batch with the truth", "co-simulation and known states", got, remedy)
        if self._both is None:
            self._both = self._made_engine(self._inputs, (*self._outputs, *self._truth), self._solver)
        self._both.loop.k, self._both.loop.rollback = self._engine.loop.k, self._engine.loop.rollback
        try:
            table = self._rolled(self._both, inputs)
        finally:
            self._engine.loop.k = self._both.loop.k
        return table[:, : self.spec.ny], table[:, self.spec.ny :]

    def _rolled(self, engine: FmuEngine, inputs: FloatArray) -> FloatArray:
        """Apply inputs through one of the engines, bringing interrupted steps to their end."""
        rows = np.ascontiguousarray(checked_inputs(inputs, self.spec))
        if self._one is idle:
            self._not_ready()
        outputs = engine.many(rows)
        if self._first is not None and engine is self._engine:
            self._first.keep(rows, outputs)
        self._leave_record()
        while (done := outputs.shape[0]) < rows.shape[0]:
            engine.u[:] = rows[done]
            self._finish(engine)
            row = engine.y.reshape(1, -1).copy()
            outputs = np.concatenate([outputs, row, engine.many(rows[done + 1 :])])
        self._note_warnings(engine)
        return outputs

    def native_step(self) -> NativeStep | None:
        """Return the pointers with which a loop in C steps this plant after a reset; None where Python steps it."""
        self._check_open()
        self._leave_record()
        return self._engine.native_step()

    def finish_step(self) -> None:
        """Bring a step to its end that :meth:`native_step` broke off, or raise as :meth:`step` does."""
        self._finish(self._engine)

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` (nu,) applied, while no time passes."""
        if u.shape != self._shape:
            refuse_input(u, self.spec)
        if self._one is idle:
            self._not_ready()
        self._leave_record()
        self._engine.u[:] = u
        if self._engine.peek():
            self._finish(self._engine)
        return self._engine.y.copy()

    def truth(self) -> FloatArray:
        """Return the present true states (nx,), as the FMU holds them."""
        if self._one is idle:
            self._not_ready()
        if self._observer.look():
            raise stopped(self._observer)
        return self._observer.y.copy()

    @property
    def options(self) -> dict[str, Any]:
        """What the plant was made with, by name of the option."""
        return dict(self._options)

    @property
    def tolerance(self) -> float:
        """Relative tolerance of the solver, for model exchange."""
        return 1e-8 if self._tolerance is None else float(self._tolerance)

    @property
    def unit_complaints(self) -> tuple[str, ...]:
        """What is odd about units."""
        ports = (*self._inputs, *self._outputs, *self._truth)
        return tuple(dict.fromkeys(p.complaint for p in ports if p.complaint is not None))

    @property
    def input_starts(self) -> FloatArray:
        """Values of the inputs (nu,) while the FMU initialises, in SI: those that were given, or its own."""
        return np.array(starts(self._inputs, self._start))

    @property
    def steps(self) -> int:
        """Samples since the last reset, also while a step or a rollout is under way."""
        engines = (self._engine,) if self._both is None else (self._engine, self._both)
        return max(int(engine.loop.k) for engine in engines)

    @property
    def now(self) -> float:
        """Time [s] that was reached by the last of these."""
        return self._t0 + self.steps * self.spec.sample_time

    @property
    def substeps(self) -> int:
        """Communication steps in a sample."""
        return self._substeps

    def abandon(self) -> None:
        """Leave the FMU as it is to the end of the process, as a call into it may not have come back."""
        self._one = idle
        self._finalizer.detach()

    def close(self) -> None:
        """Free the FMU and remove its temporary folder; harmless when called twice."""
        self._one = idle
        self._finalizer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a fresh plant with the same options; the running state stays behind."""
        return _rebuilt, (type(self), self._options)

    def _finish(self, engine: FmuEngine) -> None:
        """Bring an interrupted step to its end, or raise; after that only a reset helps."""
        if self._one is idle:
            self._not_ready()
        if engine.loop.what == INPUT_NOT_FINITE:
            refuse_input(engine.u, self.spec)
        try:
            finish(engine)
        except PlantError:
            self._one = idle
            self._note_warnings(engine)
            raise

    def _note_warnings(self, engine: FmuEngine) -> None:
        """Pass the number of calls that ended in a warning to the log."""
        if engine.loop.warnings:
            log.warning("%s: %d calls ended with a warning", self.file.path.name, engine.loop.warnings)
            engine.loop.warnings = 0


def _rebuilt(kind: type[FmuPlant], options: dict[str, Any]) -> FmuPlant:
    """Make a plant again where a pickle of it is opened."""
    return kind(**options)
