"""Two honest baselines: hold the last value, and the true plant itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from harness.errors import FitError, InputError
from harness.protocols import Model, Plant
from harness.scoring import same_language
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.described import Described
from identifiers.common.records import usable


@dataclass(frozen=True, eq=False)
class HoldModel(Described):
    """Predicts that nothing changes: the state is the last output seen."""

    spec: PlantSpec
    kind = "hold"
    burn_in: ClassVar[int] = 0

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the first output (ny,)."""
        same_language(self.spec, data)
        return np.array(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the value held (..., ny)."""
        return x

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the same state (..., ny)."""
        return x

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the output just seen (..., ny)."""
        return y


@dataclass(frozen=True)
class HoldLast:
    """Baseline: the next output is the last one.

    A model that does not beat it has learned nothing.
    """

    expected_failures: ClassVar[Mapping[str, str]] = {
        "data_matter": "a baseline that learns nothing",
        "beats_trivial": "it is the trivial prediction that others must beat",
        "inputs_matter": "a baseline that knows no input",
    }

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Model:
        """Return the model that holds its last output."""
        _, spec = usable(trajectories, samples=1, what="hold", holes="kept")
        return HoldModel(spec)


@dataclass(frozen=True)
class TrueModel:
    """Baseline: the plant itself, so that what remains is noise and the unknown initial state.

    Parameters
    ----------
    plant : Plant or callable
        The plant that made the data, or a factory of it; it must declare ``"truth"`` and accept every true state as a
        named initial state.
    samples : int
        Samples at the start of a record from which the initial state is estimated.
    """

    expected_failures: ClassVar[Mapping[str, str]] = {
        "data_matter": "the plant itself learns nothing from records",
        "model_stored_and_read": "an engine is no file",
    }

    plant: Plant | Callable[[], Plant]
    samples: int = 200

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Model:
        """Return the plant as a model; the records only say which signals to expect."""
        _, spec = usable(trajectories, samples=1, what="true-model", holes="kept")
        plant = self.plant if isinstance(self.plant, Plant) else self.plant()
        if "truth" not in plant.abilities or not plant.spec.states:
            raise FitError(
                "true-model: the plant does not tell its states",
                expected="a plant with the ability 'truth'",
                got=", ".join(sorted(plant.abilities)) or "none",
                remedy="leave true-model out for this plant",
            )
        if [c.name for c in plant.spec.outputs] != [c.name for c in spec.outputs]:
            raise FitError(
                "true-model: another plant",
                expected=", ".join(c.name for c in spec.outputs),
                got=", ".join(c.name for c in plant.spec.outputs),
                remedy="give the plant that made the data",
            )
        return PlantModel(plant, self.samples)


class PlantModel:
    """A plant with known states as a model. It steps the plant's own engine, so it cannot be written to a file."""

    def __init__(self, plant: Plant, samples: int = 200) -> None:
        self.plant = plant
        self.samples = samples
        self._names = [channel.name for channel in plant.spec.states]
        self._rng = np.random.default_rng(0)

    @property
    def spec(self) -> PlantSpec:
        """Channels and sample time of the plant."""
        return self.plant.spec

    burn_in: ClassVar[int] = 0  # No samples: the initial state is estimated.

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) that explains the start of the record best (Gauss-Newton, differences in x0)."""
        from scipy.optimize import least_squares

        same_language(self.spec, data)
        start = data[: self.samples]

        def miss(x: FloatArray) -> FloatArray:
            predicted = self.free_run(x[None], start.u[None])[0]
            wrong = residual(self.spec.outputs, start.y, predicted).ravel()
            return np.where(np.isfinite(wrong), wrong, 1e6)

        guess = self._guess(start)
        found = least_squares(miss, guess, x_scale="jac", max_nfev=30)
        return np.asarray(found.x if found.cost <= 0.5 * np.sum(miss(guess) ** 2) else guess, dtype=float)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny) in the states x (..., nx)."""
        return self._each(x, u, step=False)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx)."""
        return self._each(x, u, step=True)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state with the measured ones among the states replaced (..., nx)."""
        new = np.array(x, dtype=float)
        for column, channel in enumerate(self.spec.outputs):
            if channel.name in self._names and len(self._names) == self.spec.ny:
                new[..., self._names.index(channel.name)] = y[..., column]
        return new

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        m, n = u.shape[:2]
        outputs = np.empty((m, n, self.spec.ny))
        for i in range(m):
            outputs[i, 0] = self._place(x[i])
            for k in range(1, n):
                outputs[i, k] = self.plant.step(u[i, k - 1])
        return outputs

    def to_dict(self) -> dict[str, Any]:
        """Refuse: an engine is no file."""
        raise InputError(
            "true-model cannot be written", expected="an identified model", got="a plant", remedy="save its options"
        )

    def _place(self, x: FloatArray) -> FloatArray:
        return self.plant.reset(rng=self._rng, x0=dict(zip(self._names, map(float, x), strict=True)))

    def _each(self, x: FloatArray, u: FloatArray, *, step: bool) -> FloatArray:
        states = np.asarray(x, dtype=float)
        lead = states.shape[:-1]
        inputs = np.broadcast_to(u, (*lead, self.spec.nu)).reshape(-1, self.spec.nu)
        rows = []
        for state, held in zip(states.reshape(-1, states.shape[-1]), inputs, strict=True):
            y = self._place(state)
            if step:
                self.plant.step(held)
                y = cast(Any, self.plant).truth()
            rows.append(np.array(y))
        return np.array(rows).reshape(*lead, -1)

    def _guess(self, data: Trajectory) -> FloatArray:
        """Return measured states as measured, rates of measured ones by a difference, the others 0."""
        guess = np.zeros(len(self._names))
        measured = {channel.name: column for column, channel in enumerate(self.spec.outputs)}
        few = min(len(data), 9)
        for i, channel in enumerate(self.spec.states):
            if channel.name in measured:
                guess[i] = data.y[0, measured[channel.name]]
                continue
            parents = [name for name in measured if _rate_of(channel, name)]
            if parents and few > 2:
                derivative = np.polyfit(np.arange(few), data.y[:few, measured[parents[0]]], 2)[1]
                guess[i] = derivative / self.spec.sample_time
        return guess


def _rate_of(state: Channel, output: str) -> bool:
    """Return True if a state's name says that it is the rate of an output."""
    return state.name in (f"{output}_rate", f"d{output}", f"{output}_dot", f"{output}d")
