"""Recursive least squares: learns while it predicts, by updating a QR factorisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.errors import FitError
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.records import lagged, moving, real_signals

__all__ = ["RecursiveLeastSquares", "RlsState"]


@dataclass(frozen=True, eq=False, slots=True)
class RlsState:
    """What recursive least squares knows.

    ``triangle`` (p, p + ny) holds ``[R z]`` with ``R theta = z``; ``row`` (p,) the regressors of the next output but
    for the input to come: past outputs newest first, inputs newest first (the first of them still to come), a constant.
    ``seen`` counts the outputs of this record, ``rows`` the equations so far.
    """

    spec: PlantSpec
    triangle: FloatArray
    row: FloatArray
    seen: int
    rows: int

    @property
    def coefficients(self) -> FloatArray:
        """Parameter estimate (p, ny); of least norm while the equations do not determine it."""
        p = self.row.size
        r, z = self.triangle[:, :p], self.triangle[:, p:]
        if self.rows < p:
            return np.asarray(np.linalg.lstsq(r, z, rcond=None)[0], dtype=np.float64)
        return np.asarray(np.linalg.solve(r, z), dtype=np.float64)


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Recursive least squares on an ARX model, as an online identifier.

    ``y[k+1] = theta' [y[k], ..., y[k-n+1], u[k], ..., u[k-n+1], 1]``. Each new row is rotated into the triangle of a QR
    factorisation: the update of the normal equations without squaring the condition number (Ljung 1999, sec. 10.1 and
    11.2; Bierman 1977). Its regret grows as d n sigma^2 ln T.

    Parameters
    ----------
    order : int
        Number of past outputs and inputs.
    offset : bool
        Estimate a constant too.
    prior : float
        Weight of the prior ``theta = 0``, in rows of the size of those seen in the burn-in, so that no unit decides.
    forgetting : float
        Forgetting factor in (0, 1]; 1 forgets nothing. Regret is measured against a fixed predictor in any case.
    burn_in : int, optional
        Equations that are learned from before the first prediction is made by them; until then the last output is held,
        by the identifier and by the predictor that it is compared with. By default twice the number of parameters:
        with fewer the excess error of least squares has no finite mean.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> online = RecursiveLeastSquares(order=1, offset=False, burn_in=2)
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
    prior: float = 1e-9
    forgetting: float = 1.0
    burn_in: int | None = None

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> RlsState:
        """Return the state before any data."""
        if (
            self.order < 1
            or not 0 < self.forgetting <= 1
            or not self.prior > 0
            or (self.burn_in is not None and self.burn_in < 1)
        ):
            raise FitError(
                "rls: options",
                expected="order >= 1, 0 < forgetting <= 1, prior > 0, burn_in >= 1",
                got=f"order={self.order}, forgetting={self.forgetting}, prior={self.prior}, burn_in={self.burn_in}",
                remedy="correct the options",
            )
        real_signals(spec, "rls")
        p = self._parameters(spec)
        return RlsState(spec, np.zeros((p, p + spec.ny)), np.zeros(p), 0, 0)

    def start(self, state: RlsState, y: FloatArray) -> RlsState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        row = np.zeros_like(state.row)
        row[: state.spec.ny] = y
        if self.offset:
            row[-1] = 1.0
        return replace(state, row=row, seen=1)

    def predict(self, state: RlsState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output during the burn-in and the first lags."""
        if state.seen < self.order or state.rows < self._burn_in(state.spec):
            return state.row[: state.spec.ny].copy()
        guess: FloatArray = self._with_input(state, u) @ state.coefficients
        return guess

    def update(self, state: RlsState, u: FloatArray, y: FloatArray) -> RlsState:
        """Return the state after ``u`` led to ``y``."""
        row = self._with_input(state, u)
        triangle, rows = state.triangle, state.rows
        if state.seen >= self.order:
            old = triangle if self.forgetting == 1.0 else triangle * np.sqrt(self.forgetting)
            triangle = np.asarray(np.linalg.qr(np.vstack([old, np.concatenate([row, y])]), mode="r"))[: row.size]
            rows += 1
            if rows == self._burn_in(state.spec):
                triangle = self._regularised(triangle, rows, state.spec.ny)
        ny, nu = state.spec.ny, state.spec.nu
        past = self.order * ny
        following = row.copy()
        following[ny:past] = row[: past - ny]
        following[:ny] = y
        following[past + nu : past + self.order * nu] = row[past : past + (self.order - 1) * nu]
        return RlsState(state.spec, triangle, following, state.seen + 1, rows)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the batch least-squares fit with the same prior and the same held predictions.

        It minimises the summed squared error over the samples after the burn-in exactly but for the prior. The details
        state prior and burn-in, and hold the batch estimate from all rows.
        """
        spec = trajectories[0].spec
        moving(trajectories, "rls")
        long = [one for one in trajectories if len(one) > self.order]
        if not long:
            raise FitError(
                "rls: records too short",
                expected=f"more than {self.order} samples",
                got=str(max(map(len, trajectories))),
                remedy="record longer, or lower the order",
            )
        blocks = [lagged(one, self.order) for one in long]
        if self.offset:
            blocks = [np.hstack([block, np.ones((len(block), 1))]) for block in blocks]
        rows, targets = np.concatenate(blocks), np.concatenate([one.y[self.order :] for one in long])
        burn_in, p = self._burn_in(spec), rows.shape[1]
        typical = np.sqrt(np.mean(rows[:burn_in] ** 2, axis=0))
        prior = np.sqrt(self.prior) * np.diag(np.where(typical > 0, typical, 1.0))
        whole, counted = (
            np.linalg.lstsq(np.vstack([rows[skip:], prior]), np.vstack([targets[skip:], np.zeros((p, spec.ny))]))[0]
            for skip in (0, min(burn_in, len(rows)))
        )
        missed = residual(spec.outputs, targets, rows @ counted) ** 2
        missed[:burn_in] = (
            np.concatenate([residual(spec.outputs, one.y[self.order :], one.y[self.order - 1 : -1]) for one in long])[
                :burn_in
            ]
            ** 2
        )
        losses: list[FloatArray] = []
        place = 0
        for one in trajectories:
            loss = residual(spec.outputs, one.y[1:], one.y[:-1]) ** 2
            if len(one) > self.order:
                count = len(one) - self.order
                loss[self.order - 1 :] = missed[place : place + count]
                place += count
            losses.append(loss)
        each = np.concatenate(losses)
        # The loss of an angle is taken the short way round, which is not convex.
        exact = all(channel.period is None for channel in spec.outputs)
        details = {"coefficients": whole.tolist(), "prior": self.prior, "burn_in": burn_in + self.order - 1}
        return Hindsight(each.sum(axis=1), exact=exact, details=details, per_output=each)

    def _parameters(self, spec: PlantSpec) -> int:
        """Return the number of parameters of each output."""
        return self.order * (spec.ny + spec.nu) + int(self.offset)

    def _burn_in(self, spec: PlantSpec) -> int:
        """Return how many equations are waited for."""
        return 2 * self._parameters(spec) if self.burn_in is None else max(self.burn_in, self._parameters(spec))

    def _with_input(self, state: RlsState, u: FloatArray) -> FloatArray:
        """Return the regressors of the next output (p,)."""
        row = state.row.copy()
        first = self.order * state.spec.ny
        row[first : first + state.spec.nu] = u
        return row

    def _regularised(self, triangle: FloatArray, rows: int, ny: int) -> FloatArray:
        """Return the triangle with the prior in it."""
        p = triangle.shape[0]
        typical = np.linalg.norm(triangle[:, :p], axis=0) / np.sqrt(rows)
        typical = np.where(typical > 0, typical, 1.0)
        prior = np.hstack([np.sqrt(self.prior) * np.diag(typical), np.zeros((p, ny))])
        return np.asarray(np.linalg.qr(np.vstack([triangle, prior]), mode="r"))[:p]
