"""Recursive least squares: learns while it predicts, by updating a QR factorisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from harness.errors import FitError
from harness.protocols import Growth, Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.common.linear_model import LinearModel
from identifiers.common.named import wrong_options
from identifiers.common.one_step_estimate import DEPENDENT, least_squares_estimate
from identifiers.common.records import lagged, moving, real_signals, usable
from identifiers.linear.arx import lag_model, one_step, solution_notes
from identifiers.online.along import OnePass
from identifiers.online.rls_pass import RlsLayout, learn, run


class RlsState(NamedTuple):
    """What recursive least squares knows: the memory (size,) of its recursion, and where things stand in it."""

    layout: RlsLayout
    memory: FloatArray

    @property
    def rows(self) -> int:
        """Equations so far."""
        return int(self.memory[1])

    @property
    def coefficients(self) -> FloatArray:
        """Parameter estimate (p, ny); of least norm while the equations do not determine it."""
        p = self.layout.p
        triangle = self.layout.triangle(self.memory)
        if self.rows < p:
            return np.asarray(np.linalg.lstsq(triangle[:, :p], triangle[:, p:], rcond=None)[0], dtype=np.float64)
        return np.asarray(np.linalg.solve(triangle[:, :p], triangle[:, p:]), dtype=np.float64)


@dataclass(frozen=True)
class RecursiveLeastSquares(OnePass):
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
    called = "rls"

    def fitted(self, state: RlsState, records: list[Trajectory]) -> LinearModel:
        """Return the ARX model of the state after records: without forgetting, that of the batch.

        Raises
        ------
        FitError
            If the records, taken together, do not determine the coefficients.
        """
        what = self.called
        records, spec = usable(records, samples=self.order + 1, what=what)
        solution = one_step(records, self.order, self.offset, self.prior, what)
        refuse_feedback(solution, Columns(spec, self.order), self.least_excitation, what, ridge=self.prior)
        notes = {"order": self.order, **solution_notes(solution)}
        told_apart = solution.singular_values[-1] > DEPENDENT * solution.singular_values[0]
        estimate = None
        if self.forgetting == 1 and told_apart:
            estimate = least_squares_estimate(records, solution, self.order, self.offset)
        notes |= {} if estimate is None else {"estimate": estimate.to_dict()}
        return lag_model(spec, state.coefficients, self.order, self.offset, notes)

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> RlsState:
        """Return the state before any data."""
        if (
            self.order < 1
            or not 0 < self.forgetting <= 1
            or not self.prior > 0
            or (self.burn_in is not None and self.burn_in < 1)
        ):
            raise wrong_options(
                self,
                "rls",
                "order >= 1, 0 < forgetting <= 1, prior > 0, burn_in >= 1",
                "order forgetting prior burn_in",
            )
        real_signals(spec, "rls")
        burn_in = self._burn_in(spec)
        layout = RlsLayout(self.order, spec.ny, spec.nu, self.offset, burn_in, self.forgetting, self.prior)
        return RlsState(layout, layout.blank())

    def start(self, state: RlsState, y: FloatArray) -> RlsState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        layout, memory = state.layout, state.memory.copy()
        row = layout.row(memory)
        row[:] = 0.0
        row[: layout.ny] = y
        if self.offset:
            row[-1] = 1.0
        memory[0] = 1.0
        none = np.empty((0, layout.ny))
        run(layout, memory, np.empty((0, layout.nu)), none, none)
        return RlsState(layout, memory)

    def predict(self, state: RlsState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output during the burn-in and the first lags."""
        layout, memory = state
        free, gain, shape = layout.ahead
        guess: FloatArray = memory[free] + np.dot(u, memory[gain].reshape(shape))
        return guess

    def update(self, state: RlsState, u: FloatArray, y: FloatArray) -> RlsState:
        """Return the state after ``u`` led to ``y``."""
        layout, memory = state
        memory = memory.copy()
        inputs, outputs = layout.sample
        memory[inputs], memory[outputs] = u, y
        learn(layout, memory)
        return RlsState(layout, memory)

    def track(self, state: RlsState, u: FloatArray, y: FloatArray) -> tuple[FloatArray, RlsState]:
        """Return what :meth:`predict` and :meth:`update` in turn give over samples of one record, much faster.

        Parameters
        ----------
        state : RlsState
        u, y : array (n, nu), (n, ny)
            Inputs, and the outputs that they led to.

        Returns
        -------
        (predictions (n, ny), state)
        """
        memory, guesses = state.memory.copy(), np.empty((len(y), state.layout.ny))
        inputs, outputs = (np.ascontiguousarray(part, dtype=np.float64) for part in (u, y))
        run(state.layout, memory, inputs, outputs, guesses)
        return guesses, RlsState(state.layout, memory)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the batch least-squares fit with the same prior and the same held predictions.

        It minimises the summed squared error over the samples after the burn-in exactly but for the prior. The details
        state prior and burn-in, and hold the batch estimate from all rows.
        """
        spec = trajectories[0].spec
        moving(trajectories, "rls")
        long = [record for record in trajectories if len(record) > self.order]
        if not long:
            raise FitError(
                "rls: records too short",
                expected=f"more than {self.order} samples",
                got=str(max(map(len, trajectories))),
                remedy="record longer, or lower the order",
            )
        blocks = [lagged(record, self.order) for record in long]
        if self.offset:
            blocks = [np.hstack([block, np.ones((len(block), 1))]) for block in blocks]
        rows, targets = np.concatenate(blocks), np.concatenate([record.y[self.order :] for record in long])
        burn_in, p = self._burn_in(spec), rows.shape[1]
        typical = np.sqrt(np.mean(rows[:burn_in] ** 2, axis=0))
        prior = np.sqrt(self.prior) * np.diag(np.where(typical > 0, typical, 1.0))
        whole, counted = (
            np.linalg.lstsq(np.vstack([rows[skip:], prior]), np.vstack([targets[skip:], np.zeros((p, spec.ny))]))[0]
            for skip in (0, min(burn_in, len(rows)))
        )
        missed = residual(spec.outputs, targets, rows @ counted) ** 2
        missed[:burn_in] = (
            np.concatenate(
                [residual(spec.outputs, record.y[self.order :], record.y[self.order - 1 : -1]) for record in long]
            )[:burn_in]
            ** 2
        )
        losses: list[FloatArray] = []
        place = 0
        for record in trajectories:
            loss = residual(spec.outputs, record.y[1:], record.y[:-1]) ** 2
            if len(record) > self.order:
                count = len(record) - self.order
                loss[self.order - 1 :] = missed[place : place + count]
                place += count
            losses.append(loss)
        each = np.concatenate(losses)
        # The loss of an angle is taken the short way round, which is not convex.
        exact = all(channel.period is None for channel in spec.outputs)
        details = {"coefficients": whole.tolist(), "prior": self.prior, "burn_in": burn_in + self.order - 1}
        growth = Growth.of_least_squares(p, self.forgetting)
        return Hindsight(each.sum(axis=1), exact=exact, details=details, per_output=each, growth=growth)

    def waits(self, spec: PlantSpec) -> int:
        """Return the number of parameters of each output: so many equations determine them."""
        return self.order * (spec.ny + spec.nu) + int(self.offset)

    def _burn_in(self, spec: PlantSpec) -> int:
        """Return how many equations are waited for."""
        return 2 * self.waits(spec) if self.burn_in is None else max(self.burn_in, self.waits(spec))
