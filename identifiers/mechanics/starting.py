"""What a fit knows of where a record begins: how its states lie, and how the errors of its free run hang together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cholesky, solve_triangular, toeplitz

from harness.models.damped import Damping, damped_descent
from harness.physics.compiled.windows import Windows
from harness.signals import FloatArray, Trajectory, residual
from identifiers.common.described import Described

if TYPE_CHECKING:
    from harness.physics import OutputErrorFit, Simulator

_WIDER = 2.0
"""A record may begin where the runs of the estimation data seldom are: their deviations count so many times."""

_FREE = 0.05
"""Share of each state's own deviation that no relation to the other states narrows down: relations that a few records
showed are not laws."""

_STILL = 1e-100  # Deviation of a state that does not move; its square is no number any more.
_LAGS = 500  # Samples up to which errors of a run hang together here; over longer stretches they count as white.
_ROWS = 100  # Samples of such a stretch, at most, that are compared: evenly spread, they tell as much as all of them.
_EXACT = 1e-9  # Least error, in deviations of the output: what rounding leaves.

_SINGULAR = 1e-12
"""Share of the squares of the errors that is white at least, so that smooth ones have an inverse in floating point."""

_DRAWS = 6
"""States from which the likeliest is looked for besides: where outputs do not tell a state, the nearest minimum need
not be the deepest (behind a sensor that hides the sign there are two)."""

_POOR = 3.0  # A start that leaves so many times the squares that are usual may be a wrong minimum.

_ROUNDS = Damping(rounds=40, enough=1e-8)


@dataclass(frozen=True, eq=False)
class StartBelief(Described):
    """The normal distribution of a system's states in the estimation data, and that of the errors of its free run.

    A force that the model lacks bends a run a little: twenty samples then fit best with a bristle, a flow or another
    hidden state far from where it ever is. As these errors are no white noise but hang together as they did in the
    estimation data, such a bend is no surprise, and what the outputs do not show is where it usually is when the rest
    is as they say (generalised least squares; Bar-Shalom, Li & Kirubarajan 2001, *Estimation with Applications to
    Tracking and Navigation*, sec. 3.4).
    """

    mean: FloatArray  # (nx,)
    precision: FloatArray  # (nx, nx): Inverse of the covariance
    errors: FloatArray  # (k, ny): Autocovariance of the errors of a free run, by samples between them

    @classmethod
    def of(cls, simulator: Simulator, records: Sequence[Trajectory], fit: OutputErrorFit) -> StartBelief | None:
        """Return what the free runs of a fit say; None where one diverges."""
        values = simulator.system.vector(fit.parameters)
        outputs = np.maximum(np.std(np.vstack([one.y for one in records]), axis=0), 1e-12)
        windows = Windows(simulator, records, fit.horizon, outputs)
        found = windows.evaluate(values, np.array(fit.x0).reshape(len(windows), simulator.nx), keep=True)
        if not np.isfinite(found.cost):
            return None
        states, wrong = np.vstack(found.states), found.residuals
        size = states.std(axis=0)
        moves = size > _STILL
        precision = np.zeros((len(size), len(size)))
        if moves.any():
            alike = np.corrcoef(states[:, moves].T).reshape(int(moves.sum()), -1)
            inverse = np.linalg.inv(alike + _FREE**2 * np.eye(len(alike)))
            precision[np.ix_(moves, moves)] = inverse / (_WIDER**2 * np.outer(size[moves], size[moves]))
        total = sum(map(len, wrong))
        lags = range(min(_LAGS, max(map(len, wrong))))
        # Over all samples and not over those of a lag: only so is it the covariance of anything.
        errors = np.array([sum(_lagged(one, k) for one in wrong) / total for k in lags])
        errors[0] += _SINGULAR * errors[0] + (_EXACT * outputs) ** 2
        return cls(states.mean(axis=0), precision, errors)

    def likeliest(
        self, simulator: Simulator, values: FloatArray, record: Trajectory, starts: Sequence[FloatArray]
    ) -> FloatArray:
        """Return the likeliest state (nx,) at the first sample of a record, near one of some guesses."""
        near = len(record) <= len(self.errors)
        rows = np.arange(0, len(record), -(-len(record) // _ROWS) if near else 1)
        white = np.sqrt(self.errors[0])
        roots = [cholesky(toeplitz(column[rows]), lower=True) for column in self.errors.T] if near else []
        u, by_delays = simulator.seen(record.u[None], values[None], True)

        def whitened(part: FloatArray) -> FloatArray:
            """Return rows (n, ny, k) of which none says anything of the others."""
            if not near:
                return np.asarray((part / white[:, None]).reshape(-1, part.shape[2]))
            pairs = zip(roots, part.transpose(1, 0, 2), strict=True)
            return np.vstack([solve_triangular(one, column, lower=True, check_finite=False) for one, column in pairs])

        def missed(x: FloatArray, sensitivities: bool) -> tuple[FloatArray, FloatArray | None]:
            given = values[None], np.ascontiguousarray(x)[None], u, by_delays, np.array(record.t[:1])
            _, y, s = simulator.windows(*given, sensitivities=sensitivities)
            miss = residual(record.spec.outputs, record.y, y[0])[rows]
            slopes = None if s is None else whitened(s[0][rows][:, :, len(values) :])
            return whitened(miss[:, :, None])[:, 0], slopes

        def cost(x: FloatArray) -> float:
            away = x - self.mean
            total = float(np.sum(missed(x, False)[0] ** 2) + away @ self.precision @ away)
            return total if np.isfinite(total) else np.inf

        def linearised(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            miss, slopes = missed(x, True)
            if slopes is None or not (np.isfinite(miss).all() and np.isfinite(slopes).all()):
                return None
            return slopes.T @ slopes + self.precision, slopes.T @ miss - self.precision @ (x - self.mean)

        def moved(x: FloatArray, system: tuple[FloatArray, FloatArray], damping: float) -> FloatArray:
            gram, right = system
            size = np.sqrt(np.maximum(np.diag(gram), 1e-200))
            scaled = gram / np.outer(size, size) + (damping + 1e-11) * np.eye(len(size))
            return x + np.asarray(np.linalg.solve(scaled, right / size)) / size

        def least(starts: Sequence[FloatArray]) -> FloatArray:
            return min((damped_descent(start, cost, linearised, moved, _ROUNDS) for start in starts), key=cost)

        found = least(starts)
        usual = len(rows) * len(white)
        return found if cost(found) <= _POOR * usual else least([found, *self.draws()])

    def guesses(self, x: FloatArray, known: Sequence[bool]) -> list[FloatArray]:
        """Return states (nx,) from which to look for the likeliest: with unknown entries where they usually are."""
        moves = np.diag(self.precision) > 0
        hidden = ~np.array(known, dtype=bool) & moves
        if not hidden.any():
            return [x]
        rest = moves & ~hidden
        likely = x.copy()
        own, across = self.precision[np.ix_(hidden, hidden)], self.precision[np.ix_(hidden, rest)]
        likely[hidden] = self.mean[hidden] - np.linalg.solve(own, across @ (x - self.mean)[rest])
        return [likely, x, *self.draws()]

    def draws(self) -> FloatArray:
        """Return some states (6, nx) as the estimation data had them, the same every time."""
        moves = np.diag(self.precision) > 0
        root = np.linalg.cholesky(np.linalg.inv(self.precision[np.ix_(moves, moves)]))
        draws = np.tile(self.mean, (_DRAWS, 1))
        draws[:, moves] += np.random.default_rng(0).normal(size=(_DRAWS, int(moves.sum()))) @ root.T
        return draws


def _lagged(errors: FloatArray, lag: int) -> FloatArray:
    """Return the sum of products (ny,) of errors (N, ny) that are so many samples apart; 0 in a shorter run."""
    return np.asarray(np.sum(errors[lag:] * errors[: max(len(errors) - lag, 0)], axis=0))
