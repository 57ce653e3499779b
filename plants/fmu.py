"""FMUs as plants: co-simulation and model exchange of FMI 1.0, 2.0 and 3.0 behind the one stepping interface."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, Self

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Ability
from harness.signals import FloatArray, PlantSpec
from plants.checking import checked_inputs, refuse_input
from plants.fmu_archive import FmuFile, Kind, read_fmu
from plants.fmu_engine import INPUT_NOT_FINITE, Engine, Timing
from plants.fmu_instance import Instance, Snapshot
from plants.fmu_stops import finish, stopped
from plants.fmu_values import encode
from plants.fmu_variables import Port, channels, choose, describe, feeds_through, port, starts, states_of, unknown

__all__ = ["FmuPlant", "describe"]

log = logging.getLogger("plants.fmu")


class FmuPlant:
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
        FMI 3.0 co-simulation: handle events at communication points here; let the FMU end steps early.
    debug : bool
        Ask the FMU for debug messages (Python logger ``plants.fmu``).

    Raises
    ------
    InputError
        If the file is no FMU, is unsafe to unpack, has no binary for this system, or an option does not fit it.

    Notes
    -----
    The input is held over ``[t_k, t_k + sample_time)`` and ``t_k = start_time + k sample_time`` is never accumulated.
    One instance is kept and reset between runs. ``warnings`` lists what is odd about the FMU.

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

    describe = staticmethod(describe)

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
        self.kind: Kind = self._chosen_kind(kind)
        dt = self._default("stepSize") if sample_time is None else sample_time
        if dt is None:
            raise self._refused(
                "no sample time", "a number of seconds", "none, and the FMU suggests none", "sample_time"
            )
        self._tolerance = tolerance
        self._inputs = choose(self.file, inputs, "input")
        self._outputs = choose(self.file, outputs, "output")
        self._truth = states_of(self.file) if states is None else choose(self.file, states, "output")
        direct, told = feeds_through(self.file, self._inputs, self._outputs)
        direct = direct if feedthrough is None else feedthrough
        self.spec = PlantSpec(channels(self._inputs), channels(self._outputs), float(dt), channels(self._truth), direct)
        self._substeps = self._count_substeps(step)
        self.warnings = self._complaints(told or feedthrough is not None)
        self._start = self._encoded({**(parameters or {})}, "parameters", ("parameter", "structuralParameter"))
        self._start.update(self._encoded({**(start or {})}, "start", None))
        self._t0 = float(start_time)
        interface = self.file.interface(self.kind)
        rollback = bool(interface.canGetAndSetFMUstate) and self.file.version > 1
        optional: dict[Ability, bool] = {"snapshots": rollback, "feedthrough": direct, "truth": bool(self._truth)}
        self.abilities: frozenset[Ability] = frozenset({"batch", *(name for name, has in optional.items() if has)})
        self._instance = Instance(self.file, self.kind, event_mode=event_mode, early_return=early_return, debug=debug)
        self._finalizer = weakref.finalize(self, self._instance.close)
        try:
            self._engine = self._made_engine(self._inputs, self._outputs, rollback, solver)
            self._observer = Engine(self._instance, (), self._truth, None, rollback=rollback)
        except BaseException:
            self.close()
            raise
        self._shape = (self.spec.nu,)
        self._one: Callable[[], int] = _idle

    def _made_engine(self, inputs: Sequence[Port], outputs: Sequence[Port], rollback: bool, solver: str) -> Engine:
        """Return what steps the instance."""
        timing = Timing(self._t0, self.spec.sample_time, self._substeps)
        if self.kind == "cs":
            return Engine(self._instance, inputs, outputs, timing, rollback=rollback)
        from plants.fmu_exchange import ExchangeEngine

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
        self._check_open()
        self._one = _idle
        values = dict(self._start)
        values.update(self._encoded(dict(x0 or {}), "x0", None))
        hint = self._default("tolerance") if self._tolerance is None else self._tolerance
        self._instance.initialise(values, self._t0, hint)
        for engine in (self._engine, self._observer):
            engine.renew()
        self._engine.loop.k = 0
        self._engine.loop.warnings = 0
        if self._engine.look():
            raise stopped(self._engine)
        self._one = self._engine.one
        return self._engine.y.copy()

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
            self._finish()
        return engine.y.copy()

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state in one call; returns (N, ny), equal to stepping."""
        rows = np.ascontiguousarray(checked_inputs(inputs, self.spec))
        if self._one is _idle:
            self._not_ready()
        outputs = self._engine.many(rows)
        while (done := outputs.shape[0]) < rows.shape[0]:
            self._engine.u[:] = rows[done]
            self._finish()
            row = self._engine.y.reshape(1, -1).copy()
            outputs = np.concatenate([outputs, row, self._engine.many(rows[done + 1 :])])
        self._note_warnings()
        return outputs

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` (nu,) applied, while no time passes."""
        if u.shape != self._shape:
            refuse_input(u, self.spec)
        if self._one is _idle:
            self._not_ready()
        self._engine.u[:] = u
        if self._engine.peek():
            self._finish()
        return self._engine.y.copy()

    def truth(self) -> FloatArray:
        """Return the present true states (nx,), as the FMU holds them."""
        if self._one is _idle:
            self._not_ready()
        if self._observer.look():
            raise stopped(self._observer)
        return self._observer.y.copy()

    def get_state(self) -> Snapshot:
        """Return a state of the FMU that stays valid until the plant is closed."""
        if "snapshots" not in self.abilities or self._one is _idle:
            self._not_ready("a snapshot")
        taken = self._instance.take()
        taken.k = self._engine.loop.k
        return taken

    def set_state(self, state: Snapshot) -> None:
        """Go back to a state that :meth:`get_state` of this plant returned."""
        if "snapshots" not in self.abilities or self._one is _idle:
            self._not_ready("a snapshot")
        self._instance.put(state)
        self._engine.loop.k = state.k
        self._engine.settle()

    def set_parameter(self, name: str, value: Any) -> None:
        """Set a tunable parameter (SI) while the plant runs; it is kept for later resets.

        Raises
        ------
        InputError
            If the FMU has no such parameter, or it is fixed and the plant runs (use ``parameters`` instead).
        """
        self._check_open()
        encoded = self._encoded({name: value}, "parameters", ("parameter",))
        variability = next(v.variability for v in self.file.description.modelVariables if v.name == name)
        if self._one is not _idle:
            if variability != "tunable":
                raise self._refused("a fixed parameter", "a tunable one", repr(name), "reset first", name)
            self._instance.set_now(name, encoded[name])
        self._start.update(encoded)

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
        """Start values of the inputs (nu,), in SI."""
        return np.array(starts(self._inputs))

    @property
    def substeps(self) -> int:
        """Communication steps in a sample."""
        return self._substeps

    def close(self) -> None:
        """Free the FMU and remove its temporary folder; harmless when called twice."""
        self._one = _idle
        self._finalizer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a fresh plant with the same options; the running state stays behind."""
        return _rebuilt, (type(self), self._options)

    def _finish(self) -> None:
        """Bring an interrupted step to its end, or raise; after that only a reset helps."""
        if self._one is _idle:
            self._not_ready()
        if self._engine.loop.what == INPUT_NOT_FINITE:
            refuse_input(self._engine.u, self.spec)
        try:
            finish(self._engine)
        except PlantError:
            self._one = _idle
            self._note_warnings()
            raise

    def _note_warnings(self) -> None:
        """Pass the number of calls that ended in a warning to the log."""
        if self._engine.loop.warnings:
            log.warning("%s: %d calls ended with a warning", self.file.path.name, self._engine.loop.warnings)
            self._engine.loop.warnings = 0

    def _not_ready(self, what: str = "a step") -> NoReturn:
        self._check_open()
        raise self._refused(f"{what} of a plant that does not run", "a reset before", "none", "call reset first")

    def _check_open(self) -> None:
        if not self._finalizer.alive:
            raise self._refused("a closed plant", "an open one", "a closed one", "make a new one")

    def _refused(self, what: str, expected: str, got: str, remedy: str, place: str | None = None) -> InputError:
        return InputError(what, expected=expected, got=got, remedy=remedy, file=self.file.path, place=place)

    def _chosen_kind(self, kind: Kind | None) -> Kind:
        if kind is None:
            return self.file.kinds[0]
        if kind not in self.file.kinds:
            raise self._refused("kind", f"one of {', '.join(self.file.kinds)}", repr(kind), "choose another", "kind")
        return kind

    def _default(self, name: str) -> float | None:
        """Return a number of the FMU's default experiment."""
        text = getattr(self.file.description.defaultExperiment, name, None)
        return None if text is None else float(text)

    def _count_substeps(self, step: float | None) -> int:
        """Return how many communication steps make a sample."""
        if step is None:
            return 1
        ratio = self.spec.sample_time / step if step > 0 else 0.0
        if not (ratio >= 1 - 1e-9 and abs(ratio - round(ratio)) < 1e-6 * ratio):
            expected = f"a divisor of the sample time {self.spec.sample_time:g} s"
            raise self._refused("step", expected, f"{step!r} s", "choose sample_time / n", "step")
        return round(ratio)

    def _complaints(self, told: bool) -> tuple[str, ...]:
        """Return what a user should know about the FMU, and log it."""
        found = [*self.file.problems, *self.unit_complaints]
        if not told:
            found.append("outputs do not tell what they depend on: taken as without direct feedthrough")
        fixed = getattr(self.file.interface(self.kind), "fixedInternalStepSize", None)
        if fixed:
            ratio = self.spec.sample_time / self._substeps / float(fixed)
            if abs(ratio - round(ratio)) > 1e-6 * max(ratio, 1.0) or round(ratio) < 1:
                found.append(f"the communication step is no multiple of the FMU's internal step {float(fixed):g} s")
        for text in found:
            log.info("%s: %s", self.file.path.name, text)
        return tuple(found)

    def _encoded(self, values: Mapping[str, Any], what: str, causalities: Sequence[str] | None) -> dict[str, Any]:
        """Return values as the FMU's own types and units; unknown or unsettable names are refused."""
        variables = {v.name: v for v in self.file.description.modelVariables}
        if causalities is None:
            known = [n for n, v in variables.items() if _has_start(v, self.file.version)]
            if what == "x0":
                known = [n for n in known if variables[n].causality in ("output", "local")]
        else:
            known = [n for n, v in variables.items() if v.causality in causalities and v.variability != "constant"]
        encoded = {}
        for name, value in values.items():
            if name not in known:
                raise unknown(self.file, what, name, known)
            variable = variables[name]
            real = variable.type in ("Real", "Float64", "Float32")
            one = port(self.file, variable) if real else None
            scale, offset = (1.0, 0.0) if one is None else (one.scale, one.offset)
            encoded[name] = encode(self.file, variable, value, scale, offset)
        return encoded


def _idle() -> int:
    """Stand in for the step of a plant that does not run (a method of its own would keep the plant alive)."""
    return -1


def _has_start(variable: Any, version: int) -> bool:
    """Return True if a variable can be set before the initialisation."""
    if variable.causality in ("independent", "calculatedParameter") or variable.variability == "constant":
        return False
    if version == 1:
        return variable.start is not None
    return variable.causality == "input" or variable.initial in ("exact", "approx")


def _rebuilt(kind: type[FmuPlant], options: dict[str, Any]) -> FmuPlant:
    """Make a plant again where a pickle of it is opened."""
    return kind(**options)


def __getattr__(name: str) -> Any:
    """Find our own FMUs and the probe here too (their modules import this one)."""
    if name.endswith("_fmu"):
        from plants import fmu_mockups

        return getattr(fmu_mockups, name)
    if name == "probe":
        from plants.fmu_probe import probe

        return probe
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
