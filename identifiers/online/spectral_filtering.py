"""Spectral filtering: online prediction of a linear system with slow real poles, without identifying it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from harness.errors import FitError
from harness.options import check_options
from harness.protocols import Growth, Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.linear_model import LinearModel
from identifiers.common.records import moving, real_signals
from identifiers.online.along import OnePass, RunningLevel


@functools.lru_cache(maxsize=16)
def wave_filters(window: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the largest eigenvalues (k,) and eigenvectors (k, L) of the Hankel matrix ``2 / ((i+j)^3 - (i+j))``.

    Impulse responses ``a^i (a - 1)`` of all real poles a in [0, 1] lie close to the span of a few of them (Hazan, Singh
    & Zhang 2017, *NeurIPS* 30, sec. 4.1 and lemma E.2: the eigenvalues fall exponentially).

    Examples
    --------
    >>> values, filters = wave_filters(50, 3)
    >>> filters.shape, bool(values[0] > 5 * values[1])
    ((3, 50), True)
    """
    from scipy.linalg import eigh

    total = np.add.outer(np.arange(1.0, window + 1), np.arange(1.0, window + 1))
    values, vectors = eigh(2.0 / (total**3 - total), subset_by_index=(window - count, window - 1))
    values, vectors = np.maximum(values[::-1], 0.0), np.ascontiguousarray(vectors[:, ::-1].T)
    values.flags.writeable = vectors.flags.writeable = False
    return values, vectors


class SpectralState(NamedTuple):
    """What spectral filtering knows.

    ``past`` (L, nu) inputs, the newest first, of which ``known`` are of this record; ``last`` (ny,) the last output;
    ``seen`` samples; ``inputs`` and ``outputs``, what the burn-in told of levels and sizes; ``weights`` (p, ny) of the
    scaled features; ``curvature`` (p, p), the inverse of their squares summed (``newton``), or (1, 1), the largest
    square norm so far (``gradient``).
    """

    past: FloatArray
    known: int
    last: FloatArray
    seen: int
    inputs: RunningLevel
    outputs: RunningLevel
    weights: FloatArray
    curvature: FloatArray


@dataclass(frozen=True)
class SpectralFiltering(OnePass):
    """Predict from inputs convolved with fixed filters, linearly: a convex problem whatever the system's poles.

    ``y[k+1] = M [sigma_j^(1/4) (phi_j * u)[k-1], u[k-1], u[k], y[k], 1]`` with the filters of :func:`wave_filters`
    (Hazan, Singh & Zhang 2017, algorithm 1). M follows the gradient of each loss, as there, or online Newton steps,
    whose regret grows as ln T (Hazan, Agarwal & Kale 2007, *Machine Learning* 69, sec. 3).

    Parameters
    ----------
    filters : int
        Number of filters k.
    window : int
        Samples that they reach back, L.
    update_by : {"newton", "gradient"}
    rate : float
        Of ``gradient``: step in units of the largest square norm of the features, divided by the root of the number of
        samples.
    prior : float
        Of ``newton``: weight of M = 0, in samples of unit size.
    burn_in : int
        Samples that only set level and size of the signals, so that neither decides; until then the last output is
        held.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> online = SpectralFiltering(filters=5, window=50)
    >>> state, y = online.start(online.init(spec, rng=rng), np.zeros(1)), 0.0
    >>> for u in rng.normal(size=(300, 1)):
    ...     y = 0.95 * y + u[0]
    ...     state = online.update(state, u, np.array([y]))
    >>> bool(abs(online.predict(state, np.ones(1))[0] - (0.95 * y + 1.0)) < 0.05)
    True
    """

    filters: int = 15
    window: int = 100
    update_by: Literal["newton", "gradient"] = "newton"
    rate: float = 1.0
    prior: float = 1e-3
    burn_in: int = 20
    called = "spectral-filtering"

    def waits(self, spec: PlantSpec) -> int:
        """Return the samples of the burn-in, and one for each feature."""
        return self.burn_in + self._count(spec)

    def fitted(self, state: Any, records: list[Trajectory]) -> LinearModel:
        """Return the model of the state after records."""
        return self.model(state, records[0].spec)

    def model(self, state: SpectralState, spec: PlantSpec) -> LinearModel:
        """Return the predictor of a state as a linear model: ``x = [y[k], u[k-1], ..., u[k-L]]``."""
        nu, ny, length = spec.nu, spec.ny, self.window
        by, size = state.inputs.size[:, None], state.outputs.size[:, None]
        values, filters = wave_filters(length, self.filters)
        weights = state.weights * size.T
        waves = weights[: self.filters * nu].reshape(self.filters, nu, ny)
        reach = np.einsum("j,jl,juy->luy", values**0.25, filters, waves) / by
        near, now, last, constant = np.split(weights[self.filters * nu :], np.cumsum([nu, nu, ny]))
        reach[0] += near / by
        nx = ny + length * nu
        a, b, c = np.zeros((nx, nx)), np.zeros((nx, nu)), np.eye(ny, nx)
        a[:ny, :ny] = (last / size).T
        a[:ny, ny:] = reach.reshape(length * nu, ny).T
        b[:ny] = (now / by).T
        b[ny : ny + nu] = np.eye(nu)
        a[ny + nu :, ny : nx - nu] = np.eye((length - 1) * nu)
        offset, at, level = np.zeros(nx), state.inputs.level, state.outputs.level
        offset[:ny] = level + constant[0] - a[:ny] @ np.concatenate([level, np.tile(at, length)]) - b[:ny] @ at
        gain = c.T.copy()
        return LinearModel(spec, a, b, c, np.zeros((ny, nu)), gain, offset, np.zeros(ny), burn_in=length + 1)

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> SpectralState:
        """Return the state before any data."""
        bounds = {"filters": f">= 1, <= {self.window}", "rate": "> 0", "prior": "> 0", "burn_in": ">= 1"}
        check_options(self, self.called, **bounds)
        real_signals(spec, self.called)
        p = self._count(spec)
        curvature = np.eye(p) / self.prior if self.update_by == "newton" else np.zeros((1, 1))
        return SpectralState(
            np.zeros((self.window, spec.nu)),
            0,
            np.zeros(spec.ny),
            0,
            RunningLevel.blank(spec.nu),
            RunningLevel.blank(spec.ny),
            np.zeros((p, spec.ny)),
            curvature,
        )

    def start(self, state: SpectralState, y: FloatArray) -> SpectralState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        return state._replace(known=0, last=np.array(y, dtype=float))

    def predict(self, state: SpectralState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output during the burn-in."""
        if state.seen < self.burn_in:
            return state.last.copy()
        guess: FloatArray = self._features(state, u) @ state.weights
        return state.outputs.level + guess * state.outputs.size

    def update(self, state: SpectralState, u: FloatArray, y: FloatArray) -> SpectralState:
        """Return the state after ``u`` led to ``y``."""
        u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
        weights, curvature = state.weights, state.curvature
        if state.seen >= self.burn_in:
            x = self._features(state, u)
            wrong = state.outputs.relative(y) - x @ weights
            if self.update_by == "newton":
                gain = curvature @ x
                gain /= 1.0 + x @ gain
                curvature = curvature - np.outer(gain, x @ curvature)
                weights = weights + np.outer(gain, wrong)
            else:
                curvature = np.maximum(curvature, x @ x)
                step = self.rate / (curvature[0, 0] * np.sqrt(state.seen - self.burn_in + 1.0))
                weights = weights + step * np.outer(x, wrong)
        return self._moved(state, u, y)._replace(weights=weights, curvature=curvature)

    def _moved(self, state: SpectralState, u: FloatArray, y: FloatArray) -> SpectralState:
        """Return the state a sample on, nothing learned but, in the burn-in, level and size."""
        if state.seen < self.burn_in:
            state = state._replace(inputs=state.inputs.heard(u), outputs=state.outputs.heard(y))
        past = np.vstack([u[None], state.past[:-1]])
        return state._replace(past=past, known=state.known + 1, last=y.copy(), seen=state.seen + 1)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the best fixed M (least squares), with the same held predictions in the burn-in."""
        spec = trajectories[0].spec
        moving(trajectories, self.called)
        state = self.init(spec, rng=np.random.default_rng(0))
        rows, held = [], []
        for record in trajectories:
            state = self.start(state, record.y[0])
            for u, y in zip(record.u[:-1], record.y[1:], strict=True):
                rows.append(self._features(state, u))
                held.append(state.last)
                state = self._moved(state, u, y)
        targets = np.concatenate([record.y[1:] for record in trajectories])
        guesses = np.array(held)
        late = slice(self.burn_in, None)
        if len(targets) <= self.burn_in:
            raise FitError(
                "spectral-filtering: nothing predicted",
                expected=f"more than {self.burn_in} samples",
                got=str(len(targets)),
                remedy="record longer, or lower burn_in",
            )
        x, level = np.array(rows)[late], state.outputs.level
        guesses[late] = level + x @ np.linalg.lstsq(x, targets[late] - level, rcond=1e-13)[0]
        each = residual(spec.outputs, targets, guesses) ** 2
        exact = all(channel.period is None for channel in spec.outputs)
        growth = Growth("root", None, "any bounded stream (Hazan, Singh & Zhang 2017)")
        if self.update_by == "newton":
            growth = Growth.of_least_squares(float(np.linalg.matrix_rank(x)))
        details = {"burn_in": self.burn_in}
        return Hindsight(each.sum(axis=1), exact=exact, details=details, per_output=each, growth=growth)

    def _count(self, spec: PlantSpec) -> int:
        """Return the number of features."""
        return (self.filters + 2) * spec.nu + spec.ny + 1

    def _features(self, state: SpectralState, u: FloatArray) -> FloatArray:
        """Return the scaled features (p,) of the next output; inputs before the record count as their level."""
        values, filters = wave_filters(self.window, self.filters)
        past = state.inputs.relative(state.past)
        past[state.known :] = 0.0
        waves = (values**0.25)[:, None] * (filters @ past)
        return np.concatenate(
            [waves.ravel(), past[0], state.inputs.relative(u), state.outputs.relative(state.last), np.ones(1)]
        )
