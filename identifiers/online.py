"""Recursive least squares: learns while it predicts, by updating a QR factorisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import FitError
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.records import lagged, real_signals

__all__ = ["RecursiveLeastSquares", "RlsState"]


@dataclass(frozen=True, eq=False)
class RlsState:
    """What recursive least squares knows: the triangle of the QR factorisation, and the past of the present record.

    ``triangle`` (p, p) and ``right`` (p, ny) satisfy ``triangle @ theta = right``; ``past`` holds the last outputs and
    inputs, newest first, and ``seen`` counts the outputs of this record.
    """

    spec: PlantSpec
    triangle: FloatArray
    right: FloatArray
    past_y: FloatArray
    past_u: FloatArray
    seen: int

    @property
    def coefficients(self) -> FloatArray:
        """Parameter estimate (p, ny)."""
        # As fast as a triangular solve for a few parameters, and without its checks.
        return np.asarray(np.linalg.solve(self.triangle, self.right), dtype=np.float64)


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares on an ARX model, as an online identifier.

    ``y[k+1] = theta' [y[k], ..., y[k-n+1], u[k], ..., u[k-n+1], 1]`` with the prior ``theta ~ N(0, I / prior)``.
    Each new row is rotated into the triangle of a QR factorisation: the update of the normal equations without squaring
    the condition number (Ljung 1999, sec. 10.1 and 11.2; Bierman 1977). Its regret grows as d n sigma^2 ln T.

    Parameters
    ----------
    order : int
        Number of past outputs and inputs.
    offset : bool
        Estimate a constant too.
    prior : float
        Weight of the prior, in rows; it makes the first predictions finite.
    forgetting : float
        Forgetting factor in (0, 1]; 1 forgets nothing. Regret is measured against a fixed predictor in any case.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> online = RecursiveLeastSquares(order=1, offset=False, prior=1e-9)
    >>> state = online.start(online.init(spec, rng=np.random.default_rng(0)), np.zeros(1))
    >>> y = 0.0
    >>> for u in (1.0, -1.0, 2.0):
    ...     y = 0.5 * y + 2.0 * u
    ...     state = online.update(state, np.array([u]), np.array([y]))
    >>> state.coefficients.ravel().round(6)
    array([0.5, 2. ])
    """

    order: int = 2
    offset: bool = True
    prior: float = 1e-6
    forgetting: float = 1.0

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> RlsState:
        """Return the state before any data."""
        if self.order < 1 or not 0 < self.forgetting <= 1 or not self.prior > 0:
            raise FitError(
                "rls: options",
                expected="order >= 1, 0 < forgetting <= 1, prior > 0",
                got=f"order={self.order}, forgetting={self.forgetting}, prior={self.prior}",
                remedy="correct the options",
            )
        real_signals(spec, "rls")
        p = self.order * (spec.ny + spec.nu) + int(self.offset)
        return RlsState(
            spec,
            np.sqrt(self.prior) * np.eye(p),
            np.zeros((p, spec.ny)),
            np.zeros((self.order, spec.ny)),
            np.zeros((self.order - 1, spec.nu)),
            0,
        )

    def start(self, state: RlsState, y: FloatArray) -> RlsState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        past = np.zeros_like(state.past_y)
        past[0] = y
        return RlsState(state.spec, state.triangle, state.right, past, np.zeros_like(state.past_u), 1)

    def predict(self, state: RlsState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output until the record is as long as the order."""
        if state.seen < self.order:
            return np.array(state.past_y[0])
        guess: FloatArray = self._row(state, u) @ state.coefficients
        return guess

    def update(self, state: RlsState, u: FloatArray, y: FloatArray) -> RlsState:
        """Return the state after ``u`` led to ``y``."""
        triangle, right = state.triangle, state.right
        if state.seen >= self.order:
            old = np.hstack([triangle, right]) * np.sqrt(self.forgetting)
            new = np.concatenate([self._row(state, u), y])
            p = triangle.shape[0]
            both = np.asarray(np.linalg.qr(np.vstack([old, new]), mode="r"))
            triangle, right = both[:p, :p], both[:p, p:]
        past_y = np.vstack([y[None], state.past_y[:-1]])
        past_u = np.vstack([u[None], state.past_u])[: self.order - 1]
        return RlsState(state.spec, triangle, right, past_y, past_u, state.seen + 1)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the batch least-squares fit with the same prior and the same first predictions.

        It minimises the summed squared error exactly but for the prior, whose weight is ``prior`` rows.
        """
        spec = trajectories[0].spec
        rows, targets = [], []
        for one in trajectories:
            if len(one) > self.order:
                block = lagged(one, self.order)
                rows.append(np.hstack([block, np.ones((len(block), 1))]) if self.offset else block)
                targets.append(one.y[self.order :])
        if not rows:
            raise FitError(
                "rls: records too short",
                expected=f"more than {self.order} samples",
                got=str(max(map(len, trajectories))),
                remedy="record longer, or lower the order",
            )
        p = rows[0].shape[1]
        phi = np.vstack([*rows, np.sqrt(self.prior) * np.eye(p)])
        theta = np.linalg.lstsq(phi, np.vstack([*targets, np.zeros((p, spec.ny))]), rcond=None)[0]
        losses: list[FloatArray] = []
        block_number = 0
        for one in trajectories:
            loss = np.sum(residual(spec.outputs, one.y[1:], one.y[:-1]) ** 2, axis=1)
            if len(one) > self.order:
                miss = residual(spec.outputs, targets[block_number], rows[block_number] @ theta)
                loss[self.order - 1 :] = np.sum(miss**2, axis=1)
                block_number += 1
            losses.append(loss)
        # The loss of an angle is taken the short way round, which is not convex.
        exact = all(channel.period is None for channel in spec.outputs)
        return Hindsight(np.concatenate(losses), exact=exact, details={"coefficients": theta.tolist()})

    def _row(self, state: RlsState, u: FloatArray) -> FloatArray:
        """Return the regressors of the next output (p,)."""
        parts = [state.past_y.ravel(), np.asarray(u, dtype=float), state.past_u.ravel()]
        if self.offset:
            parts.append(np.ones(1))
        return np.concatenate(parts)
