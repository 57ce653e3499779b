"""Gradient descent on the simulation error of a transfer function, block by block of a stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from harness.protocols import Growth, Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.records import moving, real_signals
from identifiers.online.along import OnePass, RunningLevel

_LEAST = 0.02  # Least real part of the characteristic polynomial on the unit circle, relative to z^n.
_CIRCLE = 128  # Points of the unit circle on which it is held.


def acquiescent(a: FloatArray) -> FloatArray:
    """Return a stable denominator ``1 + a_1 z^-1 + ...`` in the convex set on which gradient descent goes downhill.

    On the circle its real part is at least ``_LEAST`` and larger than its imaginary part's size: the cone of Hardt, Ma
    & Recht 2018 (*JMLR* 19(29), def. 3.1), in which the idealised risk is weakly quasi-convex and which implies that
    all roots are inside (lemma 3.3). The set is convex and holds a = 0, towards which a is shrunk as far as it needs.

    Examples
    --------
    >>> acquiescent(np.array([-0.5])).tolist(), bool(acquiescent(np.array([-1.5]))[0] > -1.0)
    ([-0.5], True)
    """
    angles = np.linspace(0.0, np.pi, _CIRCLE)
    waves = np.exp(-1j * np.outer(angles, np.arange(1, len(a) + 1))) @ a
    # 1 + s Re(w) >= _LEAST and 1 + s Re(w) >= |s Im(w)| for the largest share s of a.
    needs = np.concatenate([(-waves.real) / (1.0 - _LEAST), np.abs(waves.imag) - waves.real])
    return np.asarray(a * min(1.0, 1.0 / max(float(needs.max()), 1e-300)))


class GradientState(NamedTuple):
    """What gradient descent knows: parameters, the block in work, and the filtered inputs before it.

    ``theta`` is ``[a (n,), C (n + 1, nu, ny) of u[k], u[k-1] .. through 1/a, offset (ny,)]``; ``w`` (n, nu) are the
    last inputs through 1/a, the newest first; ``block`` holds rows ``[u, y]`` of the stretch not learned from yet;
    ``inputs`` and ``outputs`` are what the burn-in told of levels and sizes, in which all of these are taken.
    """

    theta: FloatArray
    w: FloatArray
    block: tuple[FloatArray, ...]
    last: FloatArray
    seen: int
    inputs: RunningLevel
    outputs: RunningLevel
    steps: int


@dataclass(frozen=True)
class GradientDescent(OnePass):
    """Output-error transfer function learned by gradient descent from its own simulation errors.

    ``y[k+1] = sum_i C_i w[k-i] + c`` with ``w = u / (1 + a_1 z^-1 + ... + a_n z^-n)``, all poles shared. After each
    block one step down the mean squared simulation error of its last three quarters, since its start still feels what
    was before; then a is put back into a convex set of stable denominators (:func:`acquiescent`): stochastic projected
    gradient descent after Hardt, Ma & Recht 2018 (*JMLR* 19(29), algorithm 1; their block companion form for several
    inputs, sec. 6). More order than the system has helps it (theorem 5.1). Outputs are never fed back, so noise on them
    biases nothing; the price is slow convergence beside least squares.

    Parameters
    ----------
    order : int
        n.
    block : int
        Samples of a step.
    rate : float
        Step, in units of the inverse mean square of the gradients of the prediction.
    burn_in : int
        Samples that only set level and size of the signals; until then the last output is held.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> online = GradientDescent(order=2)
    >>> state, y = online.start(online.init(spec, rng=rng), np.zeros(1)), 0.0
    >>> for u in rng.normal(size=(2000, 1)):
    ...     y = 0.5 * y + u[0]
    ...     state = online.update(state, u, np.array([y]))
    >>> bool(abs(online.predict(state, np.ones(1))[0] - (0.5 * y + 1.0)) < 0.05)
    True
    """

    order: int = 6
    block: int = 20
    rate: float = 0.5
    burn_in: int = 20
    called = "gradient-descent"

    def waits(self, spec: PlantSpec) -> int:
        """Return the samples of the burn-in and a block."""
        return self.burn_in + self.block

    def fitted(self, state: Any, records: list[Trajectory]) -> LinearModel:
        """Return the model of the state after records."""
        return self.model(state, records[0].spec)

    def model(self, state: GradientState, spec: PlantSpec) -> LinearModel:
        """Return the transfer function of a state as a linear model: ``x = [w[k-1], ..., w[k-n-1]]``."""
        nu, ny, n = spec.nu, spec.ny, self.order
        den, gains, offset = self._parts(state.theta, nu, ny)
        nx, size = (n + 1) * nu, state.outputs.size
        a, b = np.eye(nx, k=-nu), np.eye(nx, nu) / state.inputs.size
        a[:nu, : n * nu] = np.kron(-den, np.eye(nu))
        c = (gains * size).transpose(2, 0, 1).reshape(ny, nx)
        none, notes = np.zeros((ny, nu)), {"steps": state.steps}
        at, level = -b @ state.inputs.level, state.outputs.level + offset * size
        return LinearModel(spec, a, b, c, none, np.zeros((nx, ny)), at, level, burn_in=n + 1, notes=notes)

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> GradientState:
        """Return the state before any data."""
        if self.order < 1 or self.block < 4 or not self.rate > 0 or self.burn_in < 1:
            raise wrong_options(
                self, "gradient-descent", "order >= 1, block >= 4, rate > 0, burn_in >= 1", "order block rate burn_in"
            )
        real_signals(spec, self.called)
        theta, w = np.zeros(self.order + (self.order + 1) * spec.nu * spec.ny + spec.ny), (self.order, spec.nu)
        none = RunningLevel.blank(spec.nu), RunningLevel.blank(spec.ny)
        return GradientState(theta, np.zeros(w), (), np.zeros(spec.ny), 0, *none, 0)

    def start(self, state: GradientState, y: FloatArray) -> GradientState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        return state._replace(w=np.zeros_like(state.w), block=(), last=np.array(y, dtype=float))

    def predict(self, state: GradientState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output during the burn-in."""
        if state.seen < self.burn_in:
            return state.last.copy()
        nu = len(u)
        a, gains, offset = self._parts(state.theta, nu, len(state.last))
        inputs = state.inputs.relative(np.array([row[:nu] for row in state.block] + [u]))
        w = _filtered(a, inputs, state.w)
        rows = np.vstack([w[::-1], state.w])[: self.order + 1]
        return np.asarray(state.outputs.level + (np.einsum("iu,iuy->y", rows, gains) + offset) * state.outputs.size)

    def update(self, state: GradientState, u: FloatArray, y: FloatArray) -> GradientState:
        """Return the state after ``u`` led to ``y``; at the end of a block a step is taken."""
        u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
        new = state._replace(last=y.copy(), seen=state.seen + 1)
        if state.seen < self.burn_in:
            return new._replace(inputs=state.inputs.heard(u), outputs=state.outputs.heard(y))
        block = (*state.block, np.concatenate([u, y]))
        return new._replace(block=block) if len(block) < self.block else self._stepped(new, np.array(block), len(u))

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the output-error fit of the same order in free runs: the best found, not exact."""
        from identifiers.linear.prediction_error import PredictionError

        spec = trajectories[0].spec
        moving(trajectories, self.called)
        fit = PredictionError(order=self.order, least_excitation=0.0)
        model = fit.fit(list(trajectories), rng=np.random.default_rng(0))
        losses, waited = [], 0
        for record in trajectories:
            x = np.asarray(model.initial_state(record), dtype=float)
            guesses = model.free_run(x[None], record.u[None])[0, 1:]
            held = max(0, min(self.burn_in - waited, len(guesses)))
            guesses[:held] = record.y[:held]
            waited += len(guesses)
            losses.append(residual(spec.outputs, record.y[1:], guesses) ** 2)
        each = np.concatenate(losses)
        details = {"burn_in": self.burn_in}
        growth = Growth("root", None, "white inputs, poles in the convex set (Hardt, Ma & Recht 2018)")
        return Hindsight(each.sum(axis=1), exact=False, details=details, per_output=each, growth=growth)

    def _stepped(self, state: GradientState, block: FloatArray, nu: int) -> GradientState:
        """Return the state after a step on a block."""
        ny = len(state.last)
        inputs, y = state.inputs.relative(block[:, :nu]), state.outputs.relative(block[:, nu:])
        a, gains, offset = self._parts(state.theta, nu, ny)
        n, first = self.order, len(block) // 4
        before, w = state.w, _filtered(a, inputs, state.w)
        whole = np.vstack([before[::-1], w])  # row n + k is w[k]
        lagged = np.stack([whole[n - i : n - i + len(w)] for i in range(n + 1)], axis=1)  # (N, n + 1, nu)
        wrong = (np.einsum("kiu,iuy->ky", lagged, gains) + offset - y)[first:]
        # d w[k] / d a_j = -(w / a)[k - j]: one more filter serves all of them.
        twice = np.vstack([np.zeros((n, nu)), _filtered(a, w, np.zeros((n, nu)))])
        shifted = np.stack([twice[n - i : n - i + len(w)] for i in range(n + 1)], axis=1)
        answer = np.vstack([np.zeros((n, ny)), np.einsum("kiu,iuy->ky", shifted, gains)])
        by_a = -np.stack([answer[n - j : n - j + len(w)] for j in range(1, n + 1)], axis=1)[first:]  # (N, n, ny)
        count = len(wrong)
        gradient = np.concatenate(
            [
                np.einsum("kjy,ky->j", by_a, wrong),
                np.einsum("kiu,ky->iuy", lagged[first:], wrong).ravel(),
                wrong.sum(axis=0),
            ]
        )
        square = float((by_a**2).sum(axis=(1, 2)).mean() + (lagged[first:] ** 2).sum(axis=(1, 2)).mean() + 1.0)
        theta = state.theta - self.rate / (square * count) * gradient
        theta[:n] = acquiescent(theta[:n])
        kept = np.vstack([_filtered(theta[:n], inputs, before)[::-1], before])[:n]
        return state._replace(theta=theta, w=kept, block=(), steps=state.steps + 1)

    def _parts(self, theta: FloatArray, nu: int, ny: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a (n,), gains (n + 1, nu, ny) and the offset (ny,)."""
        n = self.order
        return theta[:n], theta[n:-ny].reshape(n + 1, nu, ny), theta[-ny:]


def _filtered(a: FloatArray, inputs: FloatArray, before: FloatArray) -> FloatArray:
    """Return inputs (N, nu) through 1 / (1 + a_1 z^-1 + ...), with the last results (n, nu), the newest first."""
    from scipy.signal import lfilter, lfiltic

    if inputs.shape[1] == 0:
        return np.zeros_like(inputs)
    denominator = np.concatenate([[1.0], a])
    starts = np.array([lfiltic([1.0], denominator, column) for column in before.T]).T
    return np.asarray(lfilter([1.0], denominator, inputs, axis=0, zi=starts)[0])
