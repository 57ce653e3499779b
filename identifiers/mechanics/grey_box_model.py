"""Grey-box model: a physical system with fitted parameters, sampled, as a model that predicts and is stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from harness.errors import InputError, as_described
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.common.observers import best_gain, riccati_gains, run_in_steps, stationary_gain
from identifiers.mechanics.physical import Recipe, recipe_for
from identifiers.mechanics.starting import StartBelief

if TYPE_CHECKING:
    from harness.physics import Simulator, System


@dataclass(frozen=True, eq=False)
class GreyBoxModel:
    """A physical model with its parameters.

    The state is that of the system, then the clock [s], then what delays remember: past inputs and past outputs.

    Parameters
    ----------
    spec : PlantSpec
    recipe : Recipe
        Model, measured outputs, effects.
    parameters : dict
        A value for each parameter of the system.
    filter_gain : array (nx, ny), optional
        How a seen output corrects the system's state. By default a measured coordinate moves half way to its
        measurement and its rate by 0.15 of the miss in a sample, the same wherever the plant stands.
    intersample : {"zoh", "foh", "smooth"}
    substeps : int, optional
        Runge-Kutta steps in a sample; by default from the system's eigenvalues.
    notes : dict
    belief : StartBelief, optional
        What is believed of the state at the start of a record; without, its first outputs alone tell it.
    """

    spec: PlantSpec
    recipe: Recipe
    parameters: dict[str, float]
    filter_gain: FloatArray | None = None
    intersample: Literal["zoh", "foh", "smooth"] = "zoh"
    substeps: int | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    belief: StartBelief | None = None

    def __post_init__(self) -> None:
        if self.filter_gain is None:
            return
        gain = np.array(self.filter_gain, dtype=float)
        if gain.ndim != 2 or gain.shape[1] != self.spec.ny:
            raise InputError(
                "filter_gain of a grey box",
                expected=f"shape (nx, {self.spec.ny})",
                got=str(gain.shape),
                remedy="give one column for each output",
            )
        gain.flags.writeable = False
        object.__setattr__(self, "filter_gain", gain)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}

    def with_parameters(self, parameters: Mapping[str, float]) -> GreyBoxModel:
        """Return the model with other parameters; what was compiled is shared."""
        other = replace(self, parameters=dict(parameters))
        other.__dict__.update(_system=self._system, simulator=self.simulator)
        return other

    def system(self) -> System:
        """Return the continuous-time system, effects included."""
        return self._system

    @cached_property
    def _system(self) -> System:
        return self.recipe.system(self.spec)

    @cached_property
    def _gain(self) -> FloatArray:
        if self.filter_gain is None:
            return default_gain(self)
        if self.filter_gain.shape[0] != self._system.nx:
            raise InputError(
                "filter_gain of a grey box",
                expected=f"{self._system.nx} rows, one for each state",
                got=str(self.filter_gain.shape[0]),
                remedy="leave it out",
            )
        return self.filter_gain

    @cached_property
    def simulator(self) -> Simulator:
        """The system, sampled."""
        from harness.physics.compiled.simulator import default_substeps

        dt = self.spec.sample_time
        steps = self.substeps or default_substeps(self._system, dt, self._values)
        return self._system.simulator(dt, intersample=self.intersample, substeps=steps)

    @cached_property
    def _values(self) -> FloatArray:
        return self._system.vector(self.parameters)

    @cached_property
    def _memory(self) -> tuple[int, int]:
        """How many past inputs and past outputs the delays need."""
        blocks, dt = self.simulator.sampled, self.spec.sample_time

        def samples(delays: Sequence[float]) -> int:
            return int(np.ceil(max(delays, default=0.0) / dt)) + 1 if delays else 0

        before = samples([self._values[column] for _, column in blocks.input_delays])
        after = samples([self._values[column] for kind, _, column in blocks.output_blocks if kind != "quantise"])
        return before, after

    burn_in: ClassVar[int] = 0  # No samples: the initial state is estimated.

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) whose free run fits the record best, over short stretches first."""
        from harness.physics.compiled.windows import Windows, data_states
        from harness.physics.fitting.levenberg import minimise_states

        same_language(self.spec, data)
        record, dt = self._translated(data.measured()), self.spec.sample_time
        states, known = data_states(self.simulator, record, self._values)
        found = states[0]
        starts = [found] if self.belief is None else self.belief.guesses(found, known)
        spread = np.maximum(np.std(data.y, axis=0), 1e-12)
        least = 5 if self.belief is not None else max(5, self.simulator.nx + 1)
        for seconds in (25 * dt, 1.0, 4.0, None):
            count = len(record) if seconds is None else min(len(record), round(seconds / dt))
            if count * self.spec.ny < least or (seconds is not None and count < 5):
                continue
            if self.belief is not None:
                better = self.belief.likeliest(self.simulator, self._values, record[:count], starts)
            else:
                windows = Windows(self.simulator, [record[:count]], None, spread)
                better = minimise_states(windows, self._values, found[None])[0]
            if np.isfinite(better).all():
                found, starts = better, [better]
            if count == len(record):
                break
        return self._whole(found, float(data.t[0]), data.u[:1], data)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""
        state, clock, inputs, past = self._parts(x, u)
        raw = self._raw(state, clock, inputs)
        after = self._memory[1]
        if self.simulator.sampled.output_blocks:
            seen = np.concatenate([past.reshape(len(raw), after, self.spec.ny), raw[:, None]], axis=1)
            p = np.broadcast_to(self._values, (len(raw), self._values.size))
            raw = self.simulator.sampled.outputs(seen, None, p)[0][:, -1]
        return raw.reshape(*np.shape(x)[:-1], self.spec.ny)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        state, clock, inputs, past = self._parts(x, u)
        m, nu = len(state), self.spec.nu
        before, after = self._memory
        values = np.ascontiguousarray(np.broadcast_to(self._values, (m, self._values.size)))
        whole = np.concatenate([inputs, inputs[:, -1:]], axis=1)
        held = np.ascontiguousarray(self.simulator.seen(whole, values, False)[0][:, before * self.simulator.pieces :])
        moved = self.simulator.windows(
            values, np.ascontiguousarray(state), held, None, np.ascontiguousarray(clock), sensitivities=False
        )[0][:, 1]
        parts = [moved, clock[:, None] + self.spec.sample_time]
        if before:
            parts.append(inputs[:, 1:].reshape(m, before * nu))
        if after:
            parts += [past[:, self.spec.ny :], self._raw(state, clock, inputs)]
        return np.concatenate(parts, axis=1).reshape(np.shape(x))

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after an output was seen."""
        x = np.asarray(x, dtype=float)
        miss = residual(self.spec.outputs, np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), self.output(x, u))
        new = x.copy()
        new[..., : self.simulator.nx] += miss @ self._gain.T
        return new

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        before, _ = self._memory
        state, clock, inputs, _ = self._parts(x, u[:, 0])
        if self.simulator.sampled.output_blocks:
            return run_in_steps(self, x, u)
        values = np.ascontiguousarray(np.broadcast_to(self._values, (len(state), self._values.size)))
        whole = np.concatenate([inputs[:, :before], u], axis=1)
        seen = np.ascontiguousarray(self.simulator.seen(whole, values, False)[0][:, before * self.simulator.pieces :])
        y: FloatArray = self.simulator.windows(
            values, np.ascontiguousarray(state), seen, None, np.ascontiguousarray(clock), sensitivities=False
        )[1]
        return y

    # ---- parts of the state --------------------------------------------------------------------------------------

    def _parts(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return system states (M, n), clocks (M,), past and present inputs (M, before + 1, nu), past outputs."""
        x = np.asarray(x, dtype=float)
        flat = x.reshape(-1, x.shape[-1])
        now = np.broadcast_to(u, (*x.shape[:-1], self.spec.nu)).reshape(len(flat), 1, self.spec.nu)
        n, (before, _), nu = self.simulator.nx, self._memory, self.spec.nu
        history = flat[:, n + 1 : n + 1 + before * nu].reshape(len(flat), before, nu)
        return flat[:, :n], flat[:, n], np.concatenate([history, now], axis=1), flat[:, n + 1 + before * nu :]

    def _seen(self, inputs: FloatArray) -> FloatArray:
        """Return the inputs (M, nu) that the equations see now."""
        values = np.broadcast_to(self._values, (len(inputs), self._values.size))
        return self.simulator.seen(inputs, values, False)[0][:, -1]

    def _raw(self, state: FloatArray, clock: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return the outputs (M, ny) before sampled blocks of the sensors."""
        seen = self._seen(inputs)
        if not self.simulator.sampled.output_blocks:
            values = np.ascontiguousarray(np.broadcast_to(self._values, (len(state), self._values.size)))
            start, times = np.ascontiguousarray(state), np.ascontiguousarray(clock)
            y: FloatArray = self.simulator.windows(values, start, seen[:, None], None, times, sensitivities=False)[1]
            return y[:, 0]
        many = self.simulator.functions.output.map(len(state))
        raw: FloatArray = many(state.T, seen.T, np.tile(self._values[:, None], len(state)), clock).full().T
        return raw

    def _whole(self, state: FloatArray, clock: float, first: FloatArray, data: Trajectory) -> FloatArray:
        """Return the state with the memory of delays: the input was held before, the outputs went on as they begin."""
        before, after = self._memory
        parts = [state, np.array([clock]), np.tile(first[0], before)]
        if after:
            x = np.concatenate([*parts, np.zeros(after * self.spec.ny)])[None]
            ahead = []
            for k in range(min(3, len(data))):
                ahead.append(self._raw(*self._parts(x, data.u[k])[:3])[0])
                x = self.step(x, data.u[k])
            y = [*ahead, ahead[-1], ahead[-1]][:3]
            difference, bend = (y[1] - y[0], y[2] - 2 * y[1] + y[0]) if len(ahead) == 3 else (0.0 * y[0], 0.0 * y[0])
            back = np.arange(after, 0, -1)[:, None]
            parts.append((y[0] - back * difference + 0.5 * back * (back + 1) * bend).ravel())
        return np.concatenate(parts)

    def _translated(self, data: Trajectory) -> Trajectory:
        """Return the record under the periods of this model's spec."""
        return Trajectory(data.t, data.u, data.y, self.spec)

    # ---- storage -------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "grey-box",
            "spec": spec_to_dict(self.spec),
            **self.recipe.to_dict(),
            "parameters": self.parameters,
            "filter_gain": None if self.filter_gain is None else self.filter_gain.tolist(),
            "intersample": self.intersample,
            "substeps": self.substeps,
            "belief": None if self.belief is None else self.belief.to_dict(),
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> GreyBoxModel:
        """Return the model of a description."""
        with as_described("a grey-box model"):
            spec = spec_from_dict(content["spec"])
            effects = tuple(f"{name}@{at}" for name, at in content.get("effects", []))
            recipe = recipe_for(
                spec, "grey box", model=str(content["model"]), options=content.get("options", {}), effects=effects
            )
            if content.get("unnamed_forces"):
                from harness.physics.fitting.residual_force import ResidualForce

                recipe = recipe.with_unnamed([ResidualForce.from_dict(force) for force in content["unnamed_forces"]])
            gain, steps = content.get("filter_gain"), content.get("substeps")
            return cls(
                spec,
                recipe,
                {str(name): float(value) for name, value in content["parameters"].items()},
                None if gain is None else np.array(gain, dtype=float).reshape(-1, spec.ny),
                content.get("intersample", "zoh"),
                None if steps is None else int(steps),
                dict(content.get("notes", {})),
                None if content.get("belief") is None else StartBelief.from_dict(content["belief"]),
            )


def default_gain(model: GreyBoxModel) -> FloatArray:
    """Return the gain (nx, ny) of an alpha-beta filter; of a Kalman filter at rest without coordinates."""
    system, n = model.system(), model.simulator.nx
    before, after = model._memory
    x = np.zeros((n, n + 1 + before * model.spec.nu + after * model.spec.ny))
    step = np.zeros_like(x)
    step[:, :n] = 1e-6 * np.eye(n)
    u = np.zeros((n, model.spec.nu))
    c = (model.output(x + step, u) - model.output(x - step, u)).T / 2e-6
    if not np.isfinite(c).all():
        return np.zeros((n, model.spec.ny))
    if not system.coordinates:
        a = (model.step(x + step, u) - model.step(x - step, u))[:, :n].T / 2e-6
        return stationary_gain(a, c) if np.isfinite(a).all() else np.zeros((n, model.spec.ny))
    back = np.asarray(np.linalg.pinv(c), dtype=np.float64)
    gain: FloatArray = 0.5 * back
    for coordinate in system.coordinates:
        if not np.any(c[:, coordinate.v]):
            gain[coordinate.v] = 0.15 / model.spec.sample_time * back[coordinate.q]
    return gain


def tuned_gain(model: GreyBoxModel, records: Sequence[Trajectory]) -> FloatArray:
    """Return the filter gain (nx, ny) with the least one-step error on records.

    Candidates are stationary Kalman gains of the model linearised at the middle of the first record, for disturbances
    of growing size.
    """
    n, records = model.simulator.nx, list(records)[:3]
    starts = [model.initial_state(record[: min(len(record), 400)]) for record in records]
    part = records[0][: min(len(records[0]), 400)]
    x, states = starts[0], []
    for k in range(len(part)):
        states.append(x)
        x = model.step(x, part.u[k])
    path = np.array([state for state in states if np.isfinite(state).all()])
    size = np.maximum(path[:, :n].std(axis=0), 1e-6 + 1e-3 * np.abs(path[:, :n]).max(axis=0))
    middle, held = path[len(path) // 2], part.u[len(path) // 2]
    moves = np.zeros((n, middle.size))
    moves[:, :n] = np.diag(1e-5 * size)
    u = np.broadcast_to(held, (n, held.size))
    a = (model.step(middle + moves, u) - model.step(middle - moves, u))[:, :n].T / (2e-5 * size)
    c = (model.output(middle + moves, u) - model.output(middle - moves, u)).T / (2e-5 * size)
    if not (np.isfinite(a).all() and np.isfinite(c).all()):
        return np.zeros((n, model.spec.ny))
    spread = np.maximum(np.std(np.concatenate([record.y for record in records]), axis=0), 1e-9)
    gains = np.concatenate([riccati_gains(a, c, size, spread), default_gain(model)[None]])
    whole = np.zeros((len(gains), middle.size, model.spec.ny))
    whole[:, :n] = gains
    return best_gain(whole, model.step, model.output, starts, records)[:n]
