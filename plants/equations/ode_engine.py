"""What is behind an ODE plant: the system with effects and noise, and one sample at a time in compiled code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import InputError
from harness.signals import Channel, FloatArray

if TYPE_CHECKING:
    from harness.effects import Effect
    from harness.physics import System


class Engine:
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
