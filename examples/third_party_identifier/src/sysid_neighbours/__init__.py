"""Local linear models from the nearest neighbours in the recorded past: a plug-in for sysid-harness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from harness.errors import FitError, InputError
from harness.judgement import refuse_law
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

__all__ = ["NeighbourModel", "Neighbours"]


@dataclass(frozen=True)
class Neighbours:
    """Predict the next output from the recorded situations most like the present one.

    A situation is the last ``lags`` outputs and the inputs since then. Around the present situation a linear map is
    fitted to the ``neighbours`` nearest recorded ones, weighted by distance (locally weighted regression: Atkeson,
    Moore & Schaal, Artificial Intelligence Review 11:11, 1997, section 3).

    Parameters
    ----------
    lags : int
        Outputs (and inputs) of the past that make up a situation.
    neighbours : int
        How many recorded situations a prediction rests on.
    most : int
        At most so many situations are kept, evenly spaced over the records.

    Examples
    --------
    >>> from harness.testing import LinearSystem, simulate_linear
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0, (Channel("x"),))
    >>> system = LinearSystem(np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), spec)
    >>> record = simulate_linear(system, 200, rng=np.random.default_rng(0))
    >>> model = Neighbours(lags=1).fit([record], rng=np.random.default_rng(0))
    >>> x = model.initial_state(record[:1])
    >>> bool(np.allclose(model.output(model.step(x, record.u[0]), record.u[1]), record.y[1]))
    True
    """

    lags: int = 2
    neighbours: int = 30
    most: int = 3000

    def __post_init__(self) -> None:
        if min(self.lags, self.neighbours) < 1 or self.most < self.neighbours:
            raise InputError(
                "options of neighbours",
                expected="lags >= 1, neighbours >= 1, most >= neighbours",
                got=f"lags {self.lags}, neighbours {self.neighbours}, most {self.most}",
                remedy="correct them",
            )

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> NeighbourModel:
        """Return a model; refuses data of several plants, categories, and less than three situations a neighbour."""
        if not trajectories:
            raise FitError("no records", expected="at least one", got="none", remedy="record something")
        spec = trajectories[0].spec
        if any(record.spec != spec for record in trajectories):
            raise FitError("records of different plants", expected=str(spec), got="another", remedy="separate them")
        if any(channel.kind != "real" for channel in (*spec.inputs, *spec.outputs)):
            raise FitError("categories", expected="real signals", got="others", remedy="choose mdp-counting")
        refuse_law(trajectories, "neighbours")
        # one record at a time: no situation reaches across a seam
        pairs = [_situations(record, self.lags) for record in trajectories if len(record) > self.lags]
        situations = np.vstack([past for past, _ in pairs]) if pairs else np.empty((0, 1))
        if len(situations) < max(3 * self.neighbours, situations.shape[1] + 2):
            raise FitError(
                "too few samples",
                expected=f"at least {3 * self.neighbours} situations",
                got=str(len(situations)),
                remedy="record longer, or ask for fewer neighbours",
            )
        successors = np.vstack([following for _, following in pairs])
        keep = np.unique(np.linspace(0, len(situations) - 1, min(self.most, len(situations))).round().astype(int))
        scale = situations.std(axis=0)
        return NeighbourModel(
            PlantSpec(spec.inputs, spec.outputs, spec.sample_time),
            self.lags,
            self.neighbours,
            situations[keep],
            successors[keep],
            np.where(scale > 0, scale, 1.0),
        )


@dataclass(frozen=True, eq=False)
class NeighbourModel:
    """What :class:`Neighbours` learned; its state holds the last outputs (newest first) and the inputs between them."""

    spec: PlantSpec
    lags: int
    neighbours: int
    situations: FloatArray
    successors: FloatArray
    scale: FloatArray

    @property
    def burn_in(self) -> int:
        """Samples that fill the state."""
        return self.lags

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state at the first sample: the first output, as if it had stood still before."""
        past_inputs = np.tile(data.u[0] if self.spec.nu else np.empty(0), self.lags - 1)
        return np.concatenate([np.tile(data.y[0], self.lags), past_inputs])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the newest output of the state."""
        return np.array(x[..., : self.spec.ny], dtype=float)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state with the newest output replaced by the measured one."""
        return np.concatenate([np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), x[..., self.spec.ny :]], axis=-1)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state."""
        x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        ny, nu, outputs = self.spec.ny, self.spec.nu, self.lags * self.spec.ny
        situation = np.concatenate([x, u], axis=-1)
        rows = situation.reshape(-1, situation.shape[-1])
        following = np.array([self._predict(row) for row in rows]).reshape(*x.shape[:-1], ny)
        inputs = np.concatenate([u, x[..., outputs:]], axis=-1)[..., : nu * (self.lags - 1)]
        return np.concatenate([following, x[..., : outputs - ny], inputs], axis=-1)

    def _predict(self, situation: FloatArray) -> FloatArray:
        """Return the output that follows one situation."""
        if not np.isfinite(situation).all():
            return np.full(self.spec.ny, np.nan)
        distance = np.sqrt((((self.situations - situation) / self.scale) ** 2).sum(axis=1))
        near = np.argpartition(distance, self.neighbours - 1)[: self.neighbours]
        near = near[np.argsort(distance[near], kind="stable")]
        weight = np.sqrt(np.maximum(1.0 - (distance[near] / (1.5 * distance[near].max() + 1e-300)) ** 2, 1e-3))
        moved = (self.situations[near] - situation) / self.scale
        regressors = np.column_stack([np.ones(len(near)), moved]) * weight[:, None]
        solution = np.linalg.lstsq(regressors, self.successors[near] * weight[:, None], rcond=1e-8)[0]
        return np.asarray(solution[0])

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON has it."""
        return {
            "kind": "neighbours",
            "inputs": [[c.name, c.unit] for c in self.spec.inputs],
            "outputs": [[c.name, c.unit, c.period] for c in self.spec.outputs],
            "sample_time": self.spec.sample_time,
            "lags": self.lags,
            "neighbours": self.neighbours,
            "situations": self.situations.tolist(),
            "successors": self.successors.tolist(),
            "scale": self.scale.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Return the model of its JSON form."""
        spec = PlantSpec(
            tuple(Channel(name, unit) for name, unit in content["inputs"]),
            tuple(Channel(name, unit, period=period) for name, unit, period in content["outputs"]),
            content["sample_time"],
        )
        arrays = [np.array(content[name]) for name in ("situations", "successors", "scale")]
        return cls(spec, content["lags"], content["neighbours"], *arrays)


def _situations(record: Trajectory, lags: int) -> tuple[FloatArray, FloatArray]:
    """Return the situations (M, lags ny + lags nu) of one record and the outputs (M, ny) that followed."""
    n = len(record) - lags
    outputs = [record.y[lags - 1 - lag : lags - 1 - lag + n] for lag in range(lags)]
    inputs = [record.u[lags - 1 - lag : lags - 1 - lag + n] for lag in range(lags)]
    # the state keeps past inputs only; the present one comes last, as step() appends it
    return np.hstack([*outputs, *inputs[1:], inputs[0]]), record.y[lags:]
