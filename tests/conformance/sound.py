"""Sound parts in the manner of third parties: the checks must blame none of them.

``SOUND`` lists ten identifiers as other people would write them: fits to random subsets, stochastic training,
ensembles, finite impulse responses, wrappers of scikit-learn and SIPPY. :class:`Sound` and the parts below it are what
``faults.py`` spoils.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from harness.errors import FitError, InputError
from harness.judgement import refuse_law
from harness.protocols import Experiment, Hindsight
from harness.rng import Streams
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

Records = Sequence[Trajectory]


@dataclass(frozen=True)
class SoundModel:
    """y[k+1] = [y[k], u[k], 1] G; the state is the newest output."""

    spec: PlantSpec
    G: FloatArray

    burn_in = 1

    def initial_state(self, data: Trajectory) -> FloatArray:
        return np.array(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.array(x)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        x, u = np.broadcast_to(x, (*lead, x.shape[-1])), np.broadcast_to(u, (*lead, u.shape[-1]))
        return np.asarray(np.concatenate([x, u, np.ones((*lead, 1))], axis=-1) @ self.G)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(y)

    def to_dict(self) -> dict[str, Any]:
        sides = [[[c.name, c.unit, c.period] for c in side] for side in (self.spec.inputs, self.spec.outputs)]
        return {"kind": "test-sound", "channels": sides, "sample_time": self.spec.sample_time, "G": self.G.tolist()}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        inputs, outputs = (tuple(Channel(n, u, period=p) for n, u, p in side) for side in content["channels"])
        return cls(PlantSpec(inputs, outputs, content["sample_time"]), np.array(content["G"]))


@dataclass(frozen=True)
class Sound:
    """Least squares from one output to the next; the faults change one thing each."""

    judges = True

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        refuse_misfits(trajectories, self.same_plant, judges=self.judges)
        shown = self.seen(trajectories)
        past = np.vstack([np.hstack([t.y[:-1], t.u[:-1], np.ones((len(t) - 1, 1))]) for t in shown])
        following = np.vstack([t.y[1:] for t in shown])
        if not self.enough(past):
            raise FitError("the data", expected="an excited record", got=str(len(past)), remedy="record longer")
        G = np.linalg.lstsq(past, following, rcond=1e-10)[0]
        return self.model(replace(trajectories[0].spec, states=()), G)

    def same_plant(self, trajectories: Records) -> bool:
        return all(t.spec == trajectories[0].spec for t in trajectories)

    def seen(self, trajectories: Records) -> Records:
        return trajectories

    def enough(self, past: FloatArray) -> bool:
        return len(past) > past.shape[1] + 2 and bool(past[:, :-1].any())

    def model(self, spec: PlantSpec, G: FloatArray) -> Any:
        return SoundModel(spec, G)


def refuse_misfits(
    trajectories: Records, same: Callable[[Records], bool] | None = None, *, judges: bool = True
) -> None:
    """Refuse no records, records of two plants, and signals that are no real numbers."""
    alike = same or (lambda records: all(t.spec == records[0].spec for t in records))
    if not trajectories or not alike(trajectories):
        raise FitError("records", expected="records of one plant", got="none or others", remedy="separate them")
    spec = trajectories[0].spec
    if any(channel.kind != "real" for channel in (*spec.inputs, *spec.outputs)):
        raise FitError("signals", expected="real numbers", got="categories", remedy="choose another identifier")
    if judges:
        refuse_law(trajectories, "sound")


# ---- ten identifiers as others write them --------------------------------------------------------------------------


@dataclass(frozen=True)
class Learned:
    """A one-step map with a memory of so many samples; a third party would keep its regressor here."""

    spec: PlantSpec
    lags: int
    predict: Any  # anything with __call__(rows (M, n)) -> (M, ny)

    @property
    def burn_in(self) -> int:
        return self.lags

    def initial_state(self, data: Trajectory) -> FloatArray:
        return np.concatenate([np.tile(data.y[0], self.lags), np.tile(data.u[0], self.lags - 1)])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.array(x[..., : self.spec.ny])

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.concatenate([np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), x[..., self.spec.ny :]], axis=-1)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        ny, nu, split = self.spec.ny, self.spec.nu, self.lags * self.spec.ny
        u = np.broadcast_to(u, (*x.shape[:-1], nu))
        rows = np.concatenate([x, u], axis=-1).reshape(-1, x.shape[-1] + nu)
        # row by row: a matrix product over many rows rounds otherwise than over one
        following = np.array([self.predict(row[None])[0] for row in rows]).reshape(*x.shape[:-1], ny)
        inputs = np.concatenate([u, x[..., split:]], axis=-1)[..., : nu * (self.lags - 1)]
        return np.concatenate([following, x[..., : split - ny], inputs], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "third-party", "lags": self.lags}


def table(record: Trajectory, lags: int) -> tuple[FloatArray, FloatArray]:
    """Return regressors (newest output first, past inputs, present input) and successors of one record."""
    n = len(record) - lags
    outputs = [record.y[lags - 1 - j : lags - 1 - j + n] for j in range(lags)]
    inputs = [record.u[lags - 1 - j : lags - 1 - j + n] for j in range(lags)]
    return np.hstack([*outputs, *inputs[1:], inputs[0]]), record.y[lags:]


@dataclass(frozen=True)
class Affine:
    """rows -> [rows, 1] G."""

    G: FloatArray

    def __call__(self, rows: FloatArray) -> FloatArray:
        return np.asarray(np.column_stack([rows, np.ones(len(rows))]) @ self.G)


@dataclass(frozen=True)
class ThirdParty(ABC):
    """Makes the table of all records, one record at a time, and lets ``learn`` find the map."""

    lags: int = 2

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        refuse_misfits(trajectories)
        pairs = [table(t, self.lags) for t in trajectories if len(t) > self.lags]
        if sum(len(rows) for rows, _ in pairs) < 40 or not any(rows.any() for rows, _ in pairs):
            raise FitError("the records", expected="40 excited samples", got="fewer", remedy="record longer")
        rows, goal = np.vstack([p[0] for p in pairs]), np.vstack([p[1] for p in pairs])
        return Learned(replace(trajectories[0].spec, states=()), self.lags, self.learn(rows, goal, rng))

    @abstractmethod
    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        """Return a map from rows to goal."""


def affine(rows: FloatArray, goal: FloatArray) -> Affine:
    return Affine(np.linalg.lstsq(np.column_stack([rows, np.ones(len(rows))]), goal, rcond=1e-10)[0])


class RandomSubset(ThirdParty):
    """Least squares on a random half of the samples."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        chosen = rng.permutation(len(rows))[: len(rows) // 2]
        return affine(rows[chosen], goal[chosen])


@dataclass(frozen=True)
class Mean:
    """Mean of several maps."""

    members: tuple[Any, ...]

    def __call__(self, rows: FloatArray) -> FloatArray:
        return np.asarray(np.mean([member(rows) for member in self.members], axis=0))


class Bagged(ThirdParty):
    """Mean of least squares on bootstrap samples."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        draws = (rng.integers(len(rows), size=len(rows)) for _ in range(5))
        return Mean(tuple(affine(rows[d], goal[d]) for d in draws))


class StochasticGradient(ThirdParty):
    """A few epochs of normalised gradient steps in random order; stops long before it has converged."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        centre, scale = rows.mean(axis=0), rows.std(axis=0) + 1e-9
        size = goal.std(axis=0) + 1e-9
        X, Y = np.column_stack([(rows - centre) / scale, np.ones(len(rows))]), goal / size
        W = np.zeros((X.shape[1], Y.shape[1]))
        for _ in range(6):
            for k in rng.permutation(len(X)):
                W += 0.3 * np.outer(X[k], Y[k] - X[k] @ W) / (1.0 + X[k] @ X[k])
        slope = W[:-1] / scale[:, None]
        return Affine(np.vstack([slope, W[-1] - centre @ slope]) * size)


class InOrder(ThirdParty):
    """Gradient steps in the order of the records, so that their order shows in the model."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        fixed = np.random.default_rng(0)
        halves = StochasticGradient(self.lags)
        first = halves.learn(rows, goal, fixed)
        X = np.column_stack([rows, np.ones(len(rows))])
        G = first.G.copy()
        for x, y in zip(X, goal, strict=True):
            G += 0.1 * np.outer(x, y - x @ G) / (1e-9 + x @ x)
        return Affine(G)


class RandomFeatures(ThirdParty):
    """Ridge regression on random tanh features beside the linear ones."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        scale = 3.0 * rows.std(axis=0) + 1e-9
        W, b = rng.normal(size=(rows.shape[1], 20)) / scale[:, None], rng.normal(size=20)
        lifted = Lifted(W, b, np.zeros((rows.shape[1] + 21, goal.shape[1])))
        X = lifted.features(rows)
        G = np.linalg.solve(X.T @ X + 1e-8 * np.trace(X.T @ X) / len(X.T) * np.eye(X.shape[1]), X.T @ goal)
        return Lifted(W, b, G)


@dataclass(frozen=True)
class Lifted:
    """rows -> [rows, 1, tanh(rows W + b)] G."""

    W: FloatArray
    b: FloatArray
    G: FloatArray

    def features(self, rows: FloatArray) -> FloatArray:
        return np.column_stack([rows, np.ones(len(rows)), np.tanh(rows @ self.W + self.b)])

    def __call__(self, rows: FloatArray) -> FloatArray:
        return np.asarray(self.features(rows) @ self.G)


@dataclass(frozen=True)
class Scikit:
    """A fitted estimator of scikit-learn."""

    estimator: Any
    ny: int

    def __call__(self, rows: FloatArray) -> FloatArray:
        return np.asarray(self.estimator.predict(rows), dtype=float).reshape(len(rows), self.ny)


class ScikitRidge(ThirdParty):
    """Wraps a pipeline of StandardScaler and Ridge."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        from sklearn.linear_model import Ridge
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        return Scikit(make_pipeline(StandardScaler(), Ridge(1e-3)).fit(rows, goal), goal.shape[1])


class ScikitTree(ThirdParty):
    """Wraps ExtraTreeRegressor, with a random state drawn from rng."""

    def learn(self, rows: FloatArray, goal: FloatArray, rng: np.random.Generator) -> Any:
        from sklearn.tree import ExtraTreeRegressor

        state = int(rng.integers(2**31))
        return Scikit(ExtraTreeRegressor(random_state=state).fit(rows, goal), goal.shape[1])


@dataclass(frozen=True)
class FiniteImpulseResponse:
    """The last m inputs and nothing else: no output enters, not even at the start."""

    m: int = 40

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        refuse_misfits(trajectories)
        spec = trajectories[0].spec
        rows, goal = [], []
        for t in trajectories:
            for k in range(self.m, len(t)):
                rows.append(np.concatenate([t.u[k - self.m : k].ravel(), [1.0]]))
                goal.append(t.y[k])
        if len(rows) < self.m * spec.nu + 2 or not np.any(np.array(rows)[:, :-1]):
            raise FitError("the records", expected="more samples", got=str(len(rows)), remedy="record longer")
        G = np.linalg.lstsq(np.array(rows), np.array(goal), rcond=1e-8)[0]
        return ImpulseModel(replace(spec, states=()), self.m, G)


@dataclass(frozen=True)
class ImpulseModel:
    """State: the last m inputs, oldest first."""

    spec: PlantSpec
    burn_in: int
    G: FloatArray

    def initial_state(self, data: Trajectory) -> FloatArray:
        return np.zeros(self.burn_in * self.spec.nu)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        ones = np.ones((*x.shape[:-1], 1))
        return np.asarray(np.concatenate([x, ones], axis=-1) @ self.G)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        u = np.broadcast_to(u, (*x.shape[:-1], self.spec.nu))
        return np.concatenate([x[..., self.spec.nu :], u], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(x)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "third-party-fir", "m": self.burn_in, "G": self.G.tolist()}


@dataclass(frozen=True)
class Sippy:
    """Wraps N4SID of SIPPY, and says that it takes one record."""

    expected_failures: ClassVar[Mapping[str, str]] = {"all_records_used": "SIPPY takes one record: the longest"}

    order: int = 3

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        import contextlib
        import io
        import warnings

        from sippy_unipi import system_identification

        refuse_misfits(trajectories)
        spec = trajectories[0].spec
        longest = max(trajectories, key=lambda t: (len(t), float(np.abs(t.u).sum())))
        if len(longest) < 60 or not longest.u.any():
            raise FitError("the record", expected="60 excited samples", got=str(len(longest)), remedy="record longer")
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                found = system_identification(
                    longest.y.T, longest.u.T, "N4SID", tsample=spec.sample_time, SS_fixed_order=self.order
                )
            parts = [np.asarray(getattr(found, name), dtype=float) for name in ("A", "B", "C")]
        except Exception as error:
            raise FitError("SIPPY", expected="a model", got=type(error).__name__, remedy="record more") from error
        if not all(np.isfinite(part).all() for part in parts):
            raise FitError("SIPPY", expected="finite matrices", got="others", remedy="record more")
        return StateSpace(replace(spec, states=()), *parts)


@dataclass(frozen=True)
class StateSpace:
    """x+ = A x + B u, y = C x; the start is fitted to the first samples, and outputs correct nothing."""

    spec: PlantSpec
    A: FloatArray
    B: FloatArray
    C: FloatArray

    burn_in = 20

    def initial_state(self, data: Trajectory) -> FloatArray:
        n = min(len(data), 40)
        x, forced, rows, power = np.zeros(len(self.A)), [], [], np.eye(len(self.A))
        for k in range(n):
            forced.append(self.C @ x)
            rows.append(self.C @ power)
            x, power = self.A @ x + self.B @ data.u[k], self.A @ power
        return np.linalg.lstsq(np.vstack(rows), (data.y[:n] - np.array(forced)).ravel(), rcond=1e-8)[0]

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.einsum("ij,...j->...i", self.C, x)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.einsum("ij,...j->...i", self.A, x) + np.einsum("ij,...j->...i", self.B, u)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        return np.array(x)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "third-party-sippy", "A": self.A.tolist()}


@dataclass(frozen=True)
class PerRecord:
    """Fits every record by itself and averages the coefficients by their lengths."""

    lags: int = 2

    def fit(self, trajectories: Records, *, rng: np.random.Generator) -> Any:
        refuse_misfits(trajectories)
        tables = [table(t, self.lags) for t in trajectories if len(t) > self.lags + 8]
        tables = [(rows, goal) for rows, goal in tables if rows.any()]
        if sum(len(rows) for rows, _ in tables) < 40:
            raise FitError("the records", expected="40 excited samples", got="fewer", remedy="record longer")
        weights = np.array([len(rows) for rows, _ in tables], dtype=float)
        maps = np.array([affine(rows, goal).G for rows, goal in tables])
        G = np.tensordot(weights / weights.sum(), maps, axes=1)
        return Learned(replace(trajectories[0].spec, states=()), self.lags, Affine(G))


SOUND = (
    RandomSubset, Bagged, StochasticGradient, InOrder, RandomFeatures, ScikitRidge, ScikitTree,
    FiniteImpulseResponse, Sippy, PerRecord,
)  # fmt: skip


# ---- an online identifier, a plant and a scenario ------------------------------------------------------------------


class SoundOnline:
    """Recursive least squares in information form, from one output to the next."""

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> Any:
        n = spec.ny + spec.nu + 1
        return (np.zeros(spec.ny), np.zeros((n, n)), np.zeros((n, spec.ny)))

    def start(self, state: Any, y: FloatArray) -> Any:
        return (np.array(y), state[1], state[2])

    def predict(self, state: Any, u: FloatArray) -> FloatArray:
        y, information, target = state
        row = np.concatenate([y, u, [1.0]])
        return np.asarray(row @ np.linalg.solve(information + 1e-6 * np.eye(len(row)), target))

    def update(self, state: Any, u: FloatArray, y: FloatArray) -> Any:
        row = np.concatenate([state[0], u, [1.0]])
        return (np.array(y), state[1] + np.outer(row, row), state[2] + np.outer(row, y))

    def hindsight(self, trajectories: Records) -> Hindsight:
        rows = np.vstack([np.hstack([t.y[:-1], t.u[:-1], np.ones((len(t) - 1, 1))]) for t in trajectories])
        goal = np.vstack([t.y[1:] for t in trajectories])
        best = np.linalg.lstsq(rows, goal, rcond=None)[0]
        return Hindsight(((goal - rows @ best) ** 2).sum(axis=1), True)


class Lag:
    """x+ = 0.9 x + 0.1 u with process noise from rng, y = x."""

    spec = PlantSpec((Channel("u", "V", -1.0, 1.0),), (Channel("x", "V"),), 0.1, (Channel("x", "V"),))
    abilities: frozenset[Any] = frozenset({"truth"})
    x: float

    def __init__(self) -> None:
        self.x, self.noise = 0.0, np.random.default_rng(0)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        unknown = set(x0 or {}) - {"x"}
        if unknown:
            raise InputError("unknown state", expected="x", got=str(unknown), remedy="correct it")
        self.x, self.noise = float((x0 or {}).get("x", 0.0)), rng
        return np.array([self.x])

    def step(self, u: FloatArray) -> FloatArray:
        u = np.asarray(u, dtype=float)
        if u.shape != (1,) or not np.isfinite(u).all():
            raise InputError("input", expected="one finite number", got=str(u), remedy="correct it")
        self.x = 0.9 * self.x + 0.1 * float(u[0]) + 0.01 * float(self.noise.normal())
        return np.array([self.x])

    def truth(self) -> FloatArray:
        return np.array([self.x])

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Noise:
    """White excitation with sensor noise."""

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        if any(channel.kind != "real" for channel in spec.inputs):
            raise InputError("plant", expected="real inputs", got="others", remedy="choose another")
        low = np.array([max(channel.minimum, -1.0) for channel in spec.inputs])
        rng = streams(f"{role}/excitation")
        noise = streams(f"{role}/noise").normal(size=(100, spec.ny))
        return Experiment(rng.uniform(low, -low, size=(100, spec.nu)), measure=lambda k, y: y + 0.01 * noise[k])
