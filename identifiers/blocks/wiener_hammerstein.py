"""Wiener-Hammerstein: linear dynamics, a static curve, linear dynamics, with Wiener and Hammerstein as ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.signal import lfilter, ss2tf

from harness.errors import FitError, InputError
from harness.judgement import refuse_undetermined
from harness.models.damped import Damping
from harness.models.determined import KEY
from harness.models.distributions import NormalMixture, normal
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.blocks.curve import Knots
from identifiers.blocks.wiener_hammerstein_fit import BENDS, Blocks, bend_held_out, descended, shared_out
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.named import wrong_options
from identifiers.common.observers import likeliest_start
from identifiers.common.records import moving, real_signals, usable
from identifiers.linear.prediction_error import PredictionError

_SEEN = 1000
"""Samples from which an initial state is estimated at most; the blocks have long forgotten what was before."""
_EARLY = 20000  # Samples by which the ways to share out are fitted before the best of them learns from all.
STRAIGHT = (
    "held-out samples are foretold best by a straight line in place of the curve: the plant is linear, or bends "
    "elsewhere (a spring in its loop): try narx or polynomial-state-space"
)
_TABLES = ("b1", "a1", "b2", "a2", "curve")


@dataclass(frozen=True, eq=False)
class WienerHammersteinModel:
    """``x_j = B1_j/A1 u``, ``w_j = f(x_j)``, ``y = sum of B2_j/A2 w_j`` in scaled signals, of one input and one output.

    The state holds the past values of ``u/A1``, the last first, and the state of the back block in transposed direct
    form, each as long as its longer polynomial less one. Outputs correct nothing: the model is fitted to free runs.

    Parameters
    ----------
    spec : PlantSpec
    blocks : Blocks
    scale : array (4,)
        Mean and size of the input, mean and size of the output.
    state_mean, state_size : array (nx,)
        Of the states in the estimation data: what is believed of an initial state.
    std : array (1,)
        Of the free-run error in the estimation data, in the output's unit.
    """

    spec: PlantSpec
    blocks: Blocks
    scale: FloatArray
    state_mean: FloatArray
    state_size: FloatArray
    std: FloatArray
    notes: dict[str, Any] = field(default_factory=dict)
    burn_in: ClassVar[int] = 0  # None: the initial state is estimated from the record.

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the likeliest state (nx,), by the states of the estimation data and the first samples of the record.

        Of several starts (the mean state, rest under the first input and its mirror image) the best end is taken: a
        curve that loses the sign has two.
        """
        same_language(self.spec, data)
        u, y = data.u[:_SEEN], data.y[:_SEEN]
        size = np.where(self.state_size > 0, self.state_size, 1.0)
        level = max(float(self.std[0]), 1e-9 * float(self.scale[3]))

        def residuals(states: FloatArray) -> FloatArray:
            """Return what is wrong (M, N + nx) with some states (M, nx)."""
            runs = self.free_run(states, np.broadcast_to(u, (len(states), *u.shape)))[..., 0]
            return np.hstack([(runs - y[:, 0]) / level, (states - self.state_mean) / size])

        rest = self._rest(float(u[0, 0]))
        starts = (self.state_mean, rest, 2.0 * self.state_mean - rest)
        return likeliest_start(residuals, starts, 1e-5 * size, Damping(rounds=20))

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., 1)."""
        return np.asarray(self._inside(x, u)[2][..., None] * self.scale[3] + self.scale[2])

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., 1), with the error of free runs."""
        return normal(self.output(x, u), self.std, self.spec.outputs)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        driven, w, y = self._inside(x, u)
        front, back = self._states(np.asarray(x, dtype=float))
        shape = driven.shape
        ahead = np.concatenate([driven[..., None], np.broadcast_to(front, (*shape, front.shape[-1]))], -1)
        return np.concatenate([ahead[..., : front.shape[-1]], _next(back, self.blocks.b2, self.blocks.a2, w, y)], -1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the same state (..., nx)."""
        return x

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, 1) from states x (M, nx) under inputs u (M, N, 1)."""
        b = self.blocks
        v = (u[..., 0] - self.scale[0]) / self.scale[1]
        front, back = self._states(np.asarray(x, dtype=float))
        poles, past = len(b.a1) - 1, front.shape[-1]
        # what past values of u/A1 leave in the filter 1/A1, in transposed direct form (Oppenheim & Schafer 2010, 6.3.4)
        left = [-(front[..., : poles - m] @ b.a1[m + 1 :]) for m in range(poles)]
        with np.errstate(over="ignore", invalid="ignore"):
            driven = lfilter([1.0], b.a1, v, axis=-1, zi=np.stack(left, -1))[0] if poles else v
            whole = np.concatenate([np.broadcast_to(front[..., ::-1], (*v.shape[:-1], past)), driven], axis=-1)
            y = np.zeros(v.shape)
            for row, (first, second) in enumerate(zip(b.b1, b.b2, strict=True)):
                w = b.knots.values(b.curve, lfilter(first, [1.0], whole, axis=-1)[..., past:])
                start = back if row == 0 else np.zeros_like(back)
                y = y + (lfilter(second, b.a2, w, axis=-1, zi=start)[0] if back.shape[-1] else second[0] * w)
        return np.asarray(y[..., None] * self.scale[3] + self.scale[2])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        knots = self.blocks.knots
        return {
            "kind": "wiener-hammerstein",
            "spec": spec_to_dict(self.spec),
            **{name: getattr(self.blocks, name).tolist() for name in _TABLES},
            "knots": [knots.low, knots.high, knots.count],
            **{name: getattr(self, name).tolist() for name in ("scale", "state_mean", "state_size", "std")},
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> WienerHammersteinModel:
        """Return the model of a description."""
        tables = {name: np.array(content[name], dtype=float) for name in _TABLES}
        if tables["b1"].ndim != 2:
            raise InputError(
                "a wiener-hammerstein model",
                expected="a row of coefficients for each point of a sample interval",
                got="one list of them, as an earlier version wrote it, with states that mean something else",
                remedy="fit it again (sysid identify)",
            )
        low, high, count = content["knots"]
        own = {name: np.array(content[name], dtype=float) for name in ("scale", "state_mean", "state_size", "std")}
        blocks = Blocks(**tables, knots=Knots(float(low), float(high), int(count)))
        return cls(spec_from_dict(content["spec"]), blocks, **own, notes=dict(content.get("notes", {})))

    def _states(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the states of both filters."""
        cut = _memory(self.blocks.b1, self.blocks.a1)
        return x[..., :cut], x[..., cut:]

    def _inside(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the newest value of u/A1 (...), the outputs of the curve (..., r) and the scaled output (...)."""
        b = self.blocks
        front, back = self._states(np.asarray(x, dtype=float))
        v = (np.asarray(u)[..., 0] - self.scale[0]) / self.scale[1]
        driven = v - front[..., : len(b.a1) - 1] @ b.a1[1:]
        inner = driven[..., None] * b.b1[:, 0] + front[..., : b.b1.shape[1] - 1] @ b.b1[:, 1:].T
        w = b.knots.values(b.curve, inner)
        return driven, w, w @ b.b2[:, 0] + (back[..., 0] if back.shape[-1] else 0.0)

    def _rest(self, u: float) -> FloatArray:
        """Return the state at rest under a constant input."""
        b = self.blocks
        driven = (u - self.scale[0]) / self.scale[1] / b.a1.sum()
        w = b.knots.values(b.curve, driven * b.b1.sum(axis=1))
        y = np.asarray(w @ b.b2.sum(axis=1) / b.a2.sum())
        back = np.zeros(_memory(b.b2, b.a2))
        for _ in range(len(back)):
            back = _next(back, b.b2, b.a2, w, y)
        return np.concatenate([np.full(_memory(b.b1, b.a1), driven), back])


def _memory(b: FloatArray, a: FloatArray) -> int:
    """Return the number of states of a filter."""
    return max(int(b.shape[1]), len(a)) - 1


def _next(state: FloatArray, b: FloatArray, a: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return the next state (..., n) of filters b (r, ...) of inputs u (..., r) with one output, in transposed form."""
    size = state.shape[-1]
    ahead = np.concatenate(
        [np.broadcast_to(state[..., 1:], (*y.shape, max(size - 1, 0))), np.zeros((*y.shape, min(size, 1)))], -1
    )
    zeros, poles = np.pad(b[:, 1:], ((0, 0), (0, size + 1 - b.shape[1]))), np.pad(a[1:], (0, size + 1 - len(a)))
    return np.asarray(ahead + u @ zeros - poles * y[..., None])


@dataclass(frozen=True)
class WienerHammerstein(Excited):
    """Wiener-Hammerstein model of one input and one output, fitted to free runs.

    A linear output-error model is the start; its poles and zeros are shared out between the two blocks in all ways, and
    the ways that leave least go on by Levenberg and Marquardt's method with exact gradients. Without poles on one side
    it is a Hammerstein or a Wiener model. How freely the curve may bend is chosen on the last third of every record;
    a warning comes where a straight line is best there.

    Parameters
    ----------
    order : int
        Poles of both blocks together.
    knots : int
        Basis functions of the curve, at least 4.
    direct : bool
        The input acts on the output of the same sample.
    between : int
        Points of a sample interval at which the curve acts. 1 is the usual model; 2 and more, each with zeros of its
        own in both blocks, serve where a sharp curve makes frequencies above half the sample rate.
    rounds : int
        Of the descent on all of the data.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=3000)
    >>> y = lfilter([0.0, 0.5], [1.0, -0.5], np.tanh(lfilter([1.0], [1.0, -0.7], u)))
    >>> data = Trajectory(np.arange(3000.0), u[:, None], y[:, None], spec)
    >>> model = WienerHammerstein(order=2, knots=10).fit([data], rng=rng)
    >>> bool(model.std[0] < 0.01 * y.std())
    True
    """

    order: int = 4
    knots: int = 12
    direct: bool = False
    between: int = 1
    rounds: int = 60
    expected_failures: ClassVar[Mapping[str, str]] = {
        "beats_trivial": "systems of the survey with one input and one output bend in a loop, where it has no curve",
    }

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> WienerHammersteinModel:
        """Return the model; where the records determine the linear model that it starts from stands in its notes."""
        what = "wiener-hammerstein"
        if self.order < 1 or self.knots < 4 or self.between < 1:
            raise wrong_options(
                self, what, "order at least 1, knots at least 4, at least 1 point between", "order knots between"
            )
        records, spec = usable(trajectories, samples=10 * (self.order + self.knots), what=what)
        real_signals(spec, what)
        if (spec.nu, spec.ny) != (1, 1):
            raise FitError(
                f"{what}: signals", expected="one input, one output", got=f"{spec.nu} and {spec.ny}",
                remedy="choose one of each, or use neural-output-error",
            )  # fmt: skip
        moving(records, what)
        refuse_undetermined(records, what, self.least_excitation)
        u, y = (np.concatenate([getattr(one, name)[:, 0] for one in records]) for name in "uy")
        scale = np.array([u.mean(), u.std(), y.mean(), y.std()])
        pairs = [((one.u[:, 0] - scale[0]) / scale[1], (one.y[:, 0] - scale[2]) / scale[3]) for one in records]
        blocks, error, told = self._descended(records, pairs)
        states = _states_in(blocks, pairs)
        notes = {"order": self.order, "front": len(blocks.a1) - 1, "back": len(blocks.a2) - 1, **told}
        return WienerHammersteinModel(
            spec, blocks, scale, states.mean(axis=0), states.std(axis=0), np.array([error * scale[3]]), notes=notes
        )

    def _descended(
        self, records: Sequence[Trajectory], pairs: list[tuple[FloatArray, FloatArray]]
    ) -> tuple[Blocks, float, dict[str, Any]]:
        """Return the blocks with the least free-run error, that error in scaled units, and what the start says."""
        first = 0 if self.direct else 1
        early = [(u[:_EARLY], y[:_EARLY]) for u, y in pairs]
        b, f, told = self._linear(records, early)
        starts = shared_out(b, f, early, self.knots, first)
        ends = [descended(start, early, first, 20, BENDS[0]) for start in starts]
        ends = [end for end in ends if np.isfinite(end[1])]
        if not ends:
            raise FitError(
                "wiener-hammerstein: no start", expected="a stable linear model", got="none",
                remedy="lower the order, or excite the plant more",
            )  # fmt: skip
        way = min(ends, key=lambda end: end[1])[0]
        bend = bend_held_out(way, early, first, 20)
        if bend == BENDS[-1]:
            told["warning"] = "; ".join([*([told["warning"]] if "warning" in told else []), STRAIGHT])
        best, error = descended(way, pairs, first, self.rounds, bend)
        if self.between == 1:
            return best, error, told
        finer, least = descended(best.between(self.between), pairs, first, self.rounds, bend)
        return (finer, least, told) if least < error else (best, error, told)

    def _linear(
        self, records: Sequence[Trajectory], pairs: Sequence[tuple[FloatArray, FloatArray]]
    ) -> tuple[FloatArray, FloatArray, dict[str, Any]]:
        """Return B and F of the output-error model to start from, B without a leading delay, and its notes on data."""
        excited = self.least_excitation
        learner = PredictionError(
            order=self.order, delay=0 if self.direct else 1, least_excitation=excited, stable=True
        )
        known = zip(records, pairs, strict=True)
        scaled = [Trajectory(one.t[: len(u)], u[:, None], y[:, None], one.spec) for one, (u, y) in known]
        model = learner.fit(scaled, rng=np.random.default_rng(0))  # it draws nothing
        b, f = ss2tf(model.a_matrix, model.b_matrix, model.c_matrix, model.d_matrix)
        told = {name: model.notes[name] for name in ("warning", KEY) if name in model.notes}
        return b[0, 0 if self.direct else 1 :], f, told


def _states_in(blocks: Blocks, pairs: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return the states (N, nx) of both filters along the records, from rest."""
    found = []
    past, behind = _memory(blocks.b1, blocks.a1), _memory(blocks.b2, blocks.a2)
    for u, _ in pairs:
        _, w, y = blocks.outputs(u)
        driven = lfilter([1.0], blocks.a1, u)
        front = [np.concatenate([np.zeros(k), driven])[: len(u)] for k in range(1, past + 1)]
        found.append(np.column_stack([*front, _along(blocks.b2, blocks.a2, w, y, behind)]))
    return np.vstack(found)


def _along(b: FloatArray, a: FloatArray, u: FloatArray, y: FloatArray, size: int) -> FloatArray:
    """Return the states (N, n) of filters b (r, ...) in transposed direct form along inputs u (r, N) and one output."""
    states = np.zeros((len(y), size))
    after = np.zeros(len(y))
    for k in reversed(range(size)):
        feed = b[:, k + 1] @ u if k + 1 < b.shape[1] else np.zeros(len(y))
        feed = feed - (a[k + 1] if k + 1 < len(a) else 0.0) * y
        states[1:, k] = feed[:-1] + after[:-1]
        after = states[:, k]
    return states
