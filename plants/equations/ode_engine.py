"""What is behind an ODE plant: the system with effects and noise, and one sample at a time in compiled code."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.signals import Channel, FloatArray
from plants.checking import positive

if TYPE_CHECKING:
    from harness.effects import Effect
    from harness.physics import System

Integrator = Literal["rk4", "dop853", "lsoda", "bdf", "radau"]
METHODS: dict[str, Any] = {"dop853": "DOP853", "lsoda": "LSODA", "bdf": "BDF", "radau": "Radau"}


def checked_integrator(integrator: str, rtol: float, atol: float, substeps: int | None) -> None:
    """Refuse options that do not fit each other.

    Raises InputError if the method is unknown, a tolerance is not positive, or substeps are asked of an adaptive
    method.
    """
    positive("rtol", rtol)
    positive("atol", atol)
    refuse_unknown("option integrator", integrator, ("rk4", *METHODS), remedy="choose one")
    if integrator != "rk4" and substeps is not None:
        raise InputError(
            "option substeps",
            expected="none with an adaptive integrator",
            got=repr(substeps),
            remedy="use rtol and atol, or integrator rk4",
        )


class AdaptiveEngine:
    """One sample at a time by :func:`scipy.integrate.solve_ivp`.

    Time counts from the start of each sample, so that a step gives the same bits wherever it stands in a run.
    """

    def __init__(self, simulator: Any, p: FloatArray, integrator: str, rtol: float, atol: float) -> None:
        self.simulator, self.p = simulator, p
        self.nu, self.nx, self.ny = simulator.spec.nu, simulator.nx, simulator.spec.ny
        self._method, self._rtol, self._atol = METHODS[integrator], float(rtol), float(atol)

    def _solved(self, x: FloatArray, u: FloatArray, t: float, *, dense: bool) -> Any:
        """Return SciPy's solution over one sample."""
        from scipy.integrate import solve_ivp

        rates = self.simulator.derivative
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # a method that gives up is told by its status
            return solve_ivp(
                lambda s, z: rates(z, u, self.p, t + s),
                (0.0, self.simulator.dt),
                x,
                method=self._method,
                rtol=self._rtol,
                atol=self._atol,
                dense_output=dense,
            )

    def step(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return the state and the output one sample later; NaN where the method gives up."""
        if not np.isfinite(x).all():
            return np.full(self.nx, np.nan), np.full(self.ny, np.nan)
        solved = self._solved(x, u, t, dense=False)
        new = solved.y[:, -1].copy() if solved.success else np.full(self.nx, np.nan)
        return new, self.output(new, u, t + self.simulator.dt)

    def run(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return states (N, nx) and outputs (N, ny) from a state; row 0 is the state itself."""
        n = u.shape[0]
        xs, ys = np.empty((n, self.nx)), np.empty((n, self.ny))
        xs[0], ys[0] = x, self.output(x, u[0], t)
        for k in range(1, n):
            xs[k], ys[k] = self.step(xs[k - 1], u[k - 1], t + (k - 1) * self.simulator.dt)
        return xs, ys

    def output(self, x: FloatArray, u: FloatArray, t: float) -> FloatArray:
        """Return the output in a state."""
        full = np.concatenate([u, np.zeros(self.nu - len(u))]) if len(u) < self.nu else u
        return np.array(self.simulator.output(x, full, self.p, t))

    def between(self, x: FloatArray, u: FloatArray, t: float, times: FloatArray) -> FloatArray:
        """Return the states (M, nx) at times inside the sample that starts in a state."""
        path: FloatArray = self._solved(x, u, t, dense=True).sol(times).T
        return path


class OdeEngine:
    """One sample at a time through the compiled rollout, buffers allocated once; CasADi where there is no compiler."""

    def __init__(self, simulator: Any, p: FloatArray) -> None:
        from harness.physics.compiled.compilation import compiles

        self.simulator, self.p = simulator, np.ascontiguousarray(p)
        self.nu, self.nx, self.ny = simulator.spec.nu, simulator.nx, simulator.spec.ny
        self._library = simulator.library() if compiles() else None
        if self._library is not None:
            self._x0, self._u, self._t = np.zeros((1, self.nx)), np.zeros((1, 2, self.nu)), np.zeros(1)
            self._xs, self._ys = np.zeros((1, 2, self.nx)), np.zeros((1, 2, self.ny))
            self._call = self._made(self._x0, self._u, self._t, self._xs, self._ys)
            # what one sample takes, moves and leaves, made once and looked up as one
            self._sample = self._x0[0], self._u[0], self._t, self._call, self._xs[0, 1].copy, self._ys[0, 1].copy

    def _made(self, x0: FloatArray, u: FloatArray, t: FloatArray, xs: FloatArray, ys: FloatArray) -> Callable[[], None]:
        """Return the roll-out from and into these arrays."""
        from harness.physics.compiled.rollout_call import repeated_rollout

        one = self.simulator
        assert self._library is not None
        return repeated_rollout(self._library, one.dt, one.substeps, p=self.p[None], x0=x0, u=u, t0=t, x=xs, y=ys)

    def step(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return the state and the output one sample later (the output under the same input)."""
        if self._library is None:
            new = self.simulator.step(x, u, self.p, t)
            return new, self.simulator.output(new, u, self.p, t + self.simulator.dt)
        source, held, clock, call, new_state, output = self._sample
        source[...], held[...], clock[0] = x, u, t
        call()
        return new_state(), output()

    def run(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return states (N, nx) and outputs (N, ny) from a state; row 0 is the state itself."""
        n = u.shape[0]
        if self._library is None:
            states = self.simulator.states(self.p, x, u, t0=t)
            return states, self.simulator.rollout(self.p, x, u, t0=t)
        xs, ys = np.empty((1, n, self.nx)), np.empty((1, n, self.ny))
        self._made(np.array(x, dtype=float)[None], np.array(u, dtype=float)[None], np.array([t]), xs, ys)()
        return xs[0], ys[0]

    def output(self, x: FloatArray, u: FloatArray, t: float) -> FloatArray:
        """Return the output in a state."""
        full = np.concatenate([u, np.zeros(self.nu - len(u))]) if len(u) < self.nu else u
        return np.array(self.simulator.output(x, full, self.p, t))


def system_of(model: Any) -> System:
    """Return the System of whatever was given as the model."""
    from harness.physics import Mechanism, Ode, System, load_model

    if isinstance(model, str):
        return load_model(model)
    if isinstance(model, Mechanism | Ode):
        return model.system()
    if isinstance(model, System):
        return model
    raise InputError(
        "option model",
        expected="a name, a Mechanism, an Ode or a System",
        got=type(model).__name__,
        remedy="give one of these",
    )


def with_effects(system: System, effects: Sequence[tuple[str | Effect, str, Mapping[str, float]]], dt: float) -> System:
    """Return the system with effects built in, sizes of the data taken as 1."""
    if not effects:
        return system
    from harness.effects import Placed, compose, find

    placed = []
    for item in effects:
        if len(item) != 3:
            raise InputError(
                "option effects",
                expected="(name, at, parameters) for each",
                got=repr(item),
                remedy='write for example ("coulomb_friction", "theta", {"Fc": 0.05})',
            )
        name, at, values = item
        placed.append(Placed(find(name), at, {key: float(value) for key, value in dict(values).items()}))
    return compose(system, placed, sizes={"": {"dt": dt}})


def with_value(system: System, name: str, value: float) -> Any:
    """Return the parameter with this value, its bounds widened if they exclude it."""
    one = system.parameter(name)
    return replace(one, value=value, minimum=min(one.minimum, value), maximum=max(one.maximum, value))


def with_noise(system: System) -> tuple[System, int]:
    """Return the system with one more input for every coordinate (or state): the process noise."""
    import casadi as ca

    n = len(system.coordinates)
    count = n or system.nx - system.hidden_count
    noise = ca.SX.sym("noise", count)
    forces, rates = system.generalized_forces, system.rates
    if n:
        forces = forces + noise
    else:
        rates = rates + ca.vertcat(noise, ca.SX.zeros(system.nx - count))
    channels = tuple(Channel(f"noise_{k + 1}") for k in range(count))
    grown = replace(
        system,
        inputs=(*system.inputs, *channels),
        u=ca.vertcat(system.u, noise),
        generalized_forces=forces,
        rates=rates,
    )
    return grown, count


def needed_substeps(system: System, dt: float) -> int:
    """Return the number of Runge-Kutta steps of a sample, from the eigenvalues at rest and in contact."""
    from harness.effects import recommended_substeps
    from harness.physics.compiled.simulator import default_substeps

    return max(recommended_substeps(system, None, dt), default_substeps(system, dt))


def depends_on_time(system: System) -> bool:
    """Return True if time itself stands in the equations."""
    import casadi as ca

    return bool(ca.depends_on(ca.vertcat(system.f, system.upright(system.h)), system.t))
