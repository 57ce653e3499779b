"""Free runs of an FMU or a system over records, with derivatives, as the fits of :mod:`harness.physics` ask for them.

A plant that breaks at some parameters gives NaN there: the search turns back, and the plant starts anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from harness.blackbox.recent import Recent
from harness.blackbox.sums import summed
from harness.calibration.slopes import OwnSlopes
from harness.errors import HarnessError, InputError, refuse_unknown
from harness.physics.compiled.rollout_call import Asked, Given, Sums
from harness.physics.compiled.sampled import BySample, SampledBlocks
from harness.physics.definition.dimensions import Dimensions
from harness.physics.definition.parameters import Parameter
from harness.protocols import Feedthrough, Plant
from harness.signals import Channel, FloatArray, PlantSpec
from harness.supervision.guarded import alive

STEP = 1e-3  # Relative step of one-sided differences: a smaller one would see the steps of the solver inside.
CENTRAL = 3e-3  # Relative step of central differences, whose error is its square.
EXACT = 1e-4
"""Error, in standard deviations of the sensor, that counts as none: without it records that a model repeats to the last
digit would never be fitted well enough."""
KEPT = 32  # Runs that are kept: one of each record at a point and at the one before it.


class Preset(Protocol):
    """A plant whose parameters and start values can be set for the resets to come."""

    def preset(self, values: Mapping[str, Any]) -> None:
        """Set values by name, in SI."""


@dataclass(frozen=True, eq=False)
class FreeModel(Dimensions):
    """A model with free parameters and the states whose starts are estimated in every record."""

    name: str
    # Of the records
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    states: tuple[Channel, ...]  # Named as the plant names them
    parameters: tuple[Parameter, ...]
    keys: Mapping[str, str]  # How the plant calls the parameters
    sampled: tuple[()] = ()
    nominal: None = field(default=None)

    def parameter(self, name: str) -> Parameter:
        """Return one parameter."""
        return next(one for one in self.parameters if one.name == name)


class RecordSimulator(BySample):
    """Simulates records with given parameters (p) and start values of states (x0).

    Parameters
    ----------
    model : FreeModel
    plant : Plant
        With ``preset``; its inputs and outputs hold those of the model by name.
    held : mapping
        Values of inputs that no record brings, by name, in SI.
    """

    def __init__(self, model: FreeModel, plant: Plant, held: Mapping[str, float]) -> None:
        self.system, self._plant = model, plant
        self.dt, self.nx, self.np = plant.spec.sample_time, model.nx, model.np
        self.parameter_names = model.parameter_names
        self.spec = PlantSpec(model.inputs, model.outputs, self.dt, model.states)
        self.sampled = SampledBlocks(cast(Any, model), self.dt)
        self.central = False
        self.count = 0
        self._outputs = [_place(plant.spec.outputs, channel, "output") for channel in model.outputs]
        self._inputs = [_place(plant.spec.inputs, channel, "input") for channel in model.inputs]
        self._rest = np.array([held.get(channel.name, 0.0) for channel in plant.spec.inputs], dtype=float)
        self._memory: Recent[bytes, FloatArray] = Recent(KEPT)
        self._derived: Recent[bytes, tuple[frozenset[int], FloatArray]] = Recent(KEPT)
        self.broken: HarnessError | None = None
        self.own: OwnSlopes | None = None
        """Where it is set, the columns that it is trusted with cost no runs of their own."""

    def run(self, p: FloatArray, x0: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (N, ny) of one free run; NaN from where the plant breaks."""
        key = _key(p, x0, u)
        if key in self._memory:
            return self._memory[key]
        start = {channel.name: float(value) for channel, value in zip(self.system.states, x0, strict=True)}
        y = self._memory[key] = self.simulate(p, start, u)
        return y

    def simulate(self, p: FloatArray, start: Mapping[str, float], u: FloatArray) -> FloatArray:
        """Return the same with the starts of any states, by the plant's names; nothing is remembered."""
        model, plant, n = self.system, self._plant, u.shape[0]
        y = np.full((n, model.ny), np.nan)
        if not (np.isfinite(p).all() and np.isfinite(list(start.values())).all()):
            return y
        rows = self.rows(u)
        try:
            first = self._reset(p, start)
            if plant.spec.feedthrough:
                for k in range(n):
                    y[k] = cast(Feedthrough, plant).output(rows[k])[self._outputs]
                    if k < n - 1:
                        plant.step(rows[k])
                return y
            y[0] = first[self._outputs]
            if "batch" in plant.abilities:
                y[1:] = cast(Any, plant).rollout(np.ascontiguousarray(rows[:-1]))[:, self._outputs]
            else:
                for k in range(n - 1):
                    y[k + 1] = plant.step(rows[k])[self._outputs]
        except InputError:
            raise
        except HarnessError as error:
            self.broken = error
        return y

    def rows(self, u: FloatArray) -> FloatArray:
        """Return all inputs of the plant (N, nu), those that no record brings held."""
        rows = np.tile(self._rest, (u.shape[0], 1))
        rows[:, self._inputs] = u
        return rows

    def begin(self, p: FloatArray, x0: FloatArray) -> None:
        """Reset the plant with these parameters and starts."""
        self._reset(p, {channel.name: float(value) for channel, value in zip(self.system.states, x0, strict=True)})

    def _reset(self, p: FloatArray, start: Mapping[str, float]) -> FloatArray:
        """Return the first outputs of the plant with these parameters and starts."""
        self.count += 1
        alive()
        cast(Preset, self._plant).preset(
            {self.system.keys[name]: float(value) for name, value in zip(self.parameter_names, p, strict=True)}
        )
        return self._plant.reset(
            rng=np.random.default_rng(0), x0=dict(start) or None
        )  # what is calibrated draws nothing

    def differences(self, k: int, p: FloatArray, x0: FloatArray, u: FloatArray) -> FloatArray:
        """Return the derivative (N, ny) by one column of (p, x0) as differences of runs tell it."""
        y = self.run(p, x0, u)
        return self._by_parameter(k, p, x0, u, y) if k < self.np else self._by_state(k - self.np, p, x0, u, y)

    def windows(
        self,
        p: FloatArray,
        x0: FloatArray,
        u: FloatArray,
        *_: FloatArray | None,
        sensitivities: bool = True,
        columns: npt.NDArray[np.intp] | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return states (NaN: unknown), outputs (M, N, ny), derivatives (M, N, ny, np + nx) by (p, x0).

        No input is delayed, and time begins with every record: what is said of these is passed over.
        """
        m, n = u.shape[:2]
        x, y = np.full((m, n, self.nx), np.nan), np.empty((m, n, self.system.ny))
        s = np.zeros((m, n, self.system.ny, self.np + self.nx)) if sensitivities else None
        for k in range(m):
            y[k] = self.run(p[k], x0[k], u[k])
            if s is not None and np.isfinite(y[k]).all():
                s[k] = self._derivatives(p[k], x0[k], u[k], y[k], columns)
        return x, y, s

    def sums(self, given: Given, asked: Asked) -> Sums:
        """Return the normal equations of records; what costs too much is not differentiated, for that is the work."""
        p, x0, u, _, _ = given
        return summed(
            lambda k: (np.full((u.shape[1], self.nx), np.nan), self.run(p[k], x0[k], u[k])),
            lambda k, chosen: self._derivatives(p[k], x0[k], u[k], self.run(p[k], x0[k], u[k]), chosen),
            asked,
            nx=self.nx,
            unknowns=self.np + self.nx,
            floor=EXACT,
        )

    def _derivatives(
        self, p: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray, columns: Sequence[int] | Any
    ) -> FloatArray:
        """Return the derivatives (N, ny, np + nx) by the columns asked for; the others are 0."""
        wanted = frozenset(range(self.np + self.nx) if columns is None else map(int, columns))
        key = _key(p, x0, u) + bytes([self.central])
        known, s = self._derived.get(key, (frozenset[int](), np.zeros((*y.shape, self.np + self.nx))))
        lacking = wanted - known
        told = sorted(lacking & self.own.trusted) if self.own is not None else []
        if told and self.own is not None:
            try:
                s[..., told] = self.own(p, x0, self.rows(u), told)
                lacking -= set(told)
            except HarnessError:  # at this place it does not
                pass
        for k in sorted(lacking):
            s[..., k] = self.differences(k, p, x0, u)
        self._derived[key] = (known | wanted, s)
        if wanted >= known:
            return s
        only = np.zeros_like(s)
        only[..., sorted(wanted)] = s[..., sorted(wanted)]
        return only

    def _by_parameter(self, k: int, p: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the derivative by a parameter; one-sided at a bound, shorter where the plant breaks."""
        parameter = self.system.parameters[k]
        size = max(abs(p[k]), 1e-3 * abs(parameter.value), 1e-9)

        def moved(step: float) -> FloatArray | None:
            end = p[k] + step
            if not parameter.minimum < end < parameter.maximum:
                return None
            there = p.copy()
            there[k] = end
            found = self.run(there, x0, u)
            return found if np.isfinite(found).all() else None

        if self.central:
            up, down = moved(CENTRAL * size), moved(-CENTRAL * size)
            if up is not None and down is not None:
                return np.asarray((up - down) / (2 * CENTRAL * size))
        for h in (STEP * size, 1e-3 * STEP * size):
            for step in (h, -h):
                if (found := moved(step)) is not None:
                    return np.asarray((found - y) / step)
        return np.full_like(y, np.nan)

    def _by_state(self, k: int, p: FloatArray, x0: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the derivative by the start of a state."""
        h = STEP * max(abs(x0[k]), float(np.abs(y).max(initial=0.0)), 1e-3)

        def moved(step: float) -> FloatArray:
            begun = x0.copy()
            begun[k] += step
            return self.run(p, begun, u)

        if self.central:
            return np.asarray((moved(h) - moved(-h)) / (2 * h))
        found = moved(h)
        if not np.isfinite(found).all():
            return np.asarray((y - moved(-h)) / h)
        return np.asarray((found - y) / h)


def _key(p: FloatArray, x0: FloatArray, u: FloatArray) -> bytes:
    """Return what tells a run from others; a run without inputs has a length, too."""
    return b"".join([p.tobytes(), x0.tobytes(), len(u).to_bytes(8, "little"), u.tobytes()])


def _place(channels: Sequence[Channel], wanted: Channel, what: str) -> int:
    """Return where a channel stands among those of the plant."""
    names = [channel.name for channel in channels]
    refuse_unknown(f"{what} of the records", wanted.name, names, remedy="name the columns after the model's variables")
    return names.index(wanted.name)
