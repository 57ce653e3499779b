"""Any model of the symbolic physics as a plant: hidden effects, process noise, fixed or adaptive integration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from harness.errors import InputError, PlantError
from harness.options import outside
from harness.signals import FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, finite, initial_values, positive, refuse_input, whole
from plants.equations.ode_engine import (
    AdaptiveEngine,
    Integrator,
    OdeEngine,
    checked_integrator,
    depends_on_time,
    needed_substeps,
    system_of,
    with_effects,
    with_noise,
    with_value,
)

if TYPE_CHECKING:
    from harness.effects import Effect
    from harness.physics.compiled.system import System


class OdePlant(BasePlant):
    """A model of :mod:`harness.physics` as a plant, its input held over every sample.

    Parameters
    ----------
    model : str, System, Mechanism or Ode
        A built-in model, ``FILE.py:FUNCTION``, or the model itself.
    parameters : mapping, optional
        Values by name; the others are the model's nominal ones.
    sample_time : float
        Seconds between samples.
    substeps : int, optional
        Runge-Kutta steps in a sample; by default from the eigenvalues at rest, at least 4. For ``"rk4"`` only.
    initial : mapping, optional
        Initial states by name; 0 otherwise (hidden states of effects: where their effect says).
    outputs : sequence, optional
        What is measured, see :meth:`harness.physics.System.with_outputs`; by default the model's outputs.
    effects : sequence of (name, at, parameters)
        Physical effects built into the plant, in order; see :mod:`harness.effects`.
    process_noise : float
        Standard deviation of a random force (N m or N; the unit of a state per second for an Ode) on every coordinate,
        drawn anew for every sample and held.
    u_limit : float
        Declared range of the inputs, which scenarios use; nothing is clipped.
    integrator : {"rk4", "dop853", "lsoda", "bdf", "radau"}
        The classical Runge-Kutta method of fixed step in compiled code, or one of SciPy's adaptive methods, started
        anew at every sample; much slower, with an error that is asked for.
    rtol, atol : float
        Relative and absolute tolerance of an adaptive integrator, see :func:`scipy.integrate.solve_ivp`.

    Attributes
    ----------
    system : System
        With the effects.
    nominal : System
        Without them: what an engineer would believe.
    true_parameters : dict
        Every parameter by name, those of effects included.
    beyond : tuple of str
        What is to be said of given parameters outside the model's bounds.

    Raises
    ------
    InputError
        If the model, a parameter, an effect or an option is unknown or out of range.

    Notes
    -----
    Steps and batches give the same bits, with or without a C compiler. Delays keep samples; a quantiser rounds what is
    returned. A pickled plant continues where it was.

    Examples
    --------
    >>> plant = OdePlant(model="pendulum", initial={"theta": 0.5})
    >>> plant.reset(rng=np.random.default_rng(0)).tolist()
    [0.5]
    >>> float(plant.step(np.array([0.1]))[0].round(5))
    0.49981
    """

    def __init__(
        self,
        *,
        model: str | Any = "pendulum",
        parameters: Mapping[str, float] | None = None,
        sample_time: float = 0.01,
        substeps: int | None = None,
        initial: Mapping[str, float] | None = None,
        outputs: Sequence[str | tuple[str, int] | tuple[str, int, str]] | None = None,
        effects: Sequence[tuple[str | Effect, str, Mapping[str, float]]] = (),
        process_noise: float = 0.0,
        u_limit: float = np.inf,
        integrator: Integrator = "rk4",
        rtol: float = 1e-8,
        atol: float = 1e-10,
    ) -> None:
        self._options = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        from harness.effects import DelayLine

        dt = positive("sample_time", sample_time)
        self._noise = positive("process_noise", process_noise, zero=True)
        limit = positive("u_limit", u_limit, infinite=True)
        if substeps is not None:
            whole("substeps", substeps)
        checked_integrator(integrator, rtol, atol, substeps)
        system = system_of(model)
        if outputs is not None:
            system = system.with_outputs(outputs)
        self.nominal = system
        self.system = with_effects(system, effects, dt)
        known = self.system.values(parameters)
        self.true_parameters = known
        self.beyond = _beyond(self.system, parameters or {})
        self.system = self.system.with_parameters({name: with_value(self.system, name, known[name]) for name in known})
        self._p = self.system.vector()
        self._initial = dict(initial or {})
        initial_values(self._initial, self.system.states, [0.0] * self.system.nx)
        inputs = tuple(replace(one, minimum=-limit, maximum=limit) for one in self.system.inputs)
        self._spec = PlantSpec(inputs, self.system.outputs, dt, self.system.states, self.system.feedthrough)
        moving, self._noises = (self.system, 0) if self._noise == 0 else with_noise(self.system)
        steps = substeps or max(4, needed_substeps(self.system, dt))
        self._simulator = moving.simulator(dt, substeps=int(steps))
        self._engine: OdeEngine | AdaptiveEngine = (
            OdeEngine(self._simulator, self._p)
            if integrator == "rk4"
            else AdaptiveEngine(self._simulator, self._p, integrator, rtol, atol)
        )
        sampled, names = self.system.sampled, self.system.parameter_names
        value = {block.parameter: float(self._p[names.index(block.parameter)]) for block in sampled}
        self._delays_in = [(b.index, DelayLine(value[b.parameter], dt)) for b in sampled if b.kind == "input_delay"]
        self._delays_out = [(b.index, DelayLine(value[b.parameter], dt)) for b in sampled if b.kind == "output_delay"]
        self._rounding = [(b.index, value[b.parameter]) for b in sampled if b.kind == "quantise"]
        self._shape, self._dt = (self._spec.nu,), dt
        # nothing between the caller and the engine: no memory, no noise, no rounding
        self._direct = not (self._delays_in or self._delays_out or self._rounding or self._noises)
        self._rng = np.random.default_rng(0)
        self._x = np.zeros(self.system.nx)
        self._k = 0
        self._y = np.zeros(self._spec.ny)
        self._timed = depends_on_time(self.system)
        self._hold: tuple[FloatArray, FloatArray, float] | None = None

    @property
    def substeps(self) -> int:
        """Runge-Kutta steps in a sample, if the step is fixed."""
        return self._simulator.substeps

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew; ``x0`` goes before the option ``initial``; returns ``y[0]`` (ny,).

        The process noise is drawn from ``rng``.

        Raises
        ------
        InputError
            If ``x0`` names an unknown state.
        """
        self._need_open()
        given = {**self._initial, **(x0 or {})}
        values = np.array(initial_values(given, self.system.states, [0.0] * self.system.nx))
        count = self.system.hidden_count
        if count:
            start = self._simulator.hidden_start(values, np.zeros(self._engine.nu), self._p)
            for row in range(count):
                name = self.system.states[self.system.nx - count + row].name
                if name not in given:
                    values[self.system.nx - count + row] = start[row]
        self._rng, self._x, self._k, self._hold = rng, values, 0, None
        for _, line in (*self._delays_in, *self._delays_out):
            line.reset()
        return self._sense(self._engine.output(values, np.zeros(self._spec.nu), 0.0), advance=True)

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,)."""
        if self._closed:
            self._need_open()
        if not (isinstance(u, np.ndarray) and u.shape == self._shape and finite(u)):
            refuse_input(u, self._spec)
        if self._direct:
            x, t = self._x, self._k * self._dt
            self._hold = x, u, t
            self._x, y = moved = self._engine.step(x, u, t)
            self._k += 1
            if not finite(moved[0]):
                self._diverged(t)
            return y
        held = u
        if self._delays_in:
            held = u.copy()
            for column, line in self._delays_in:
                held[column] = line.step(float(held[column]))
        if self._noises:
            held = np.concatenate([held, self._noise * self._rng.standard_normal(self._noises)])
        t = self._k * self._spec.sample_time
        self._hold = self._x, held, t
        self._x, y = self._engine.step(self._x, held, t)
        self._k += 1
        if self._spec.feedthrough and self._delays_in:
            y = self._engine.output(self._x, held, t)
        if not finite(self._x):
            self._diverged(t)
        return self._sense(y, advance=True)

    def _diverged(self, t: float) -> NoReturn:
        """Say that the sample from ``t`` on has no end."""
        raise PlantError(f"the state is not finite at t = {t + self._spec.sample_time:g} s", status="diverged")

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu) from the present state; row k of the result (N, ny) is what ``step`` returned.

        Where the motion diverges, the rows from there on are NaN.
        """
        return self.rollout_truth(inputs)[0]

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx) at the same instants."""
        self._need_open()
        given = checked_inputs(inputs, self._spec)
        n = given.shape[0]
        if self._delays_in or self._delays_out or self._timed or self._spec.feedthrough or n == 0:
            outputs, states = np.full((n, self._spec.ny), np.nan), np.full((n, self.system.nx), np.nan)
            for k in range(n):
                try:
                    outputs[k], states[k] = self.step(given[k]), self._x
                except PlantError:
                    break
            return outputs, states
        held = given
        if self._noises:
            held = np.hstack([given, self._noise * self._rng.standard_normal((n, self._noises))])
        # One sample more, whose input acts on nothing.
        x, y = self._engine.run(self._x, np.vstack([held, held[-1:]]), self._k * self._spec.sample_time)
        self._hold = x[-2].copy(), held[-1].copy(), (self._k + n - 1) * self._spec.sample_time
        self._x = x[-1].copy()
        self._k += n
        for column, step in self._rounding:
            y[:, column] = step * np.round(y[:, column] / step) if step else y[:, column]
        return y[1:], x[1:]

    def between(self, times: FloatArray) -> FloatArray:
        """Return the true states (M, nx) inside the last sample, from the integrator's dense output.

        Parameters
        ----------
        times : array (M,)
            Seconds since that sample began, from 0 to the sample time.

        Raises
        ------
        InputError
            If the integrator is of fixed step, a time is outside, or no step was made since the last reset.
        """
        self._need_open()
        if not isinstance(self._engine, AdaptiveEngine):
            raise InputError(
                "states between samples", expected="an adaptive integrator", got="rk4", remedy='choose "dop853"'
            )
        at, dt = np.asarray(times, dtype=float), self._spec.sample_time
        if self._hold is None or at.ndim != 1 or not ((at >= 0) & (at <= dt)).all():
            raise InputError(
                "times between samples",
                expected=f"an array (M,) within [0, {dt:g}] s, after a step",
                got="no step" if self._hold is None else f"shape {at.shape} from {at.min():g} to {at.max():g} s",
                remedy="step first, and count from the start of that step",
            )
        return self._engine.between(*self._hold, at)

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, while no time passes."""
        self._need_open()
        t = self._k * self._spec.sample_time
        held = np.array(u, dtype=float)
        for column, line in self._delays_in:
            held[column] = line.peek(float(held[column]))
        return self._sense(self._engine.output(self._x, held, t), advance=False)

    def truth(self) -> FloatArray:
        """Return the true state (nx,), hidden states of effects included."""
        self._need_open()
        return self._x.copy()

    def get_state(self) -> Any:
        """Return state, clock, delay lines and the state of the noise."""
        self._need_open()
        lines = tuple(line.get_state() for _, line in (*self._delays_in, *self._delays_out))
        noise = self._rng.bit_generator.state if self._noises else None
        return self._x.copy(), self._k, lines, noise

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._need_open()
        x, self._k, lines, noise = state
        self._hold = None
        self._x = x.copy()
        for (_, line), held in zip((*self._delays_in, *self._delays_out), lines, strict=True):
            line.set_state(held)
        if noise is not None:
            self._rng.bit_generator.state = noise

    def discrete(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A (nx, nx), B (nx, nu), C (ny, nx) of one sample, linearised at rest.

        For a linear model this is the map itself, not an approximation.
        """
        nx, nu = self.system.nx, self._spec.nu
        origin = self._engine.step(np.zeros(nx), np.zeros(self._engine.nu), 0.0)[0]
        size = 1.0 if self.system.mechanism is None or not self.system.coordinates else 1e-5

        def column(x: FloatArray, u: FloatArray) -> FloatArray:
            held = np.concatenate([u, np.zeros(self._engine.nu - nu)])
            return np.asarray((self._engine.step(size * x, size * held, 0.0)[0] - origin) / size)

        a = np.column_stack([column(one, np.zeros(nu)) for one in np.eye(nx)])
        b = np.column_stack([column(np.zeros(nx), one) for one in np.eye(nu)]) if nu else np.zeros((nx, 0))
        y0 = self._engine.output(np.zeros(nx), np.zeros(nu), 0.0)
        c = np.column_stack([(self._engine.output(size * one, np.zeros(nu), 0.0) - y0) / size for one in np.eye(nx)])
        return a, b, c

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle options and running state; compiled code and expressions are made again."""
        lines = tuple(line.get_state() for _, line in (*self._delays_in, *self._delays_out))
        return _rebuilt, (type(self), self._options), (self._x, self._k, lines, self._rng, self._closed)

    def __setstate__(self, state: Any) -> None:
        self._x, self._k, lines, self._rng, self._closed = state
        for (_, line), held in zip((*self._delays_in, *self._delays_out), lines, strict=True):
            line.set_state(held)

    def _sense(self, y: FloatArray, *, advance: bool) -> FloatArray:
        """Return what the sensors tell: late and rounded."""
        for column, line in self._delays_out:
            y[column] = line.step(float(y[column])) if advance else line.peek(float(y[column]))
        for column, step in self._rounding:
            y[column] = step * np.round(y[column] / step) if step else y[column]
        return y


def _beyond(system: System, given: Mapping[str, float]) -> tuple[str, ...]:
    """Return what is to be said of values outside the bounds that the model itself declares."""
    named = [system.parameter(name) for name in given]
    found = [outside(one.name, given[one.name], one.minimum, one.maximum, one.unit) for one in named]
    return tuple(text for text in found if text is not None)


def _rebuilt(kind: type[OdePlant], options: dict[str, Any]) -> OdePlant:
    """Make a plant again where a pickle of it is opened."""
    return kind(**options)
