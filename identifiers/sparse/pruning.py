"""Terms of a NARX model judged by free runs: a term stays only if the simulation is worse without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray, Trajectory
from identifiers.common.library import Library
from identifiers.common.normal import NormalEquations, scaled_equations, solved
from identifiers.sparse.orthogonal import Criterion, criterion_value, helpful, lost_share

LONGEST, SAMPLES = 200, 4000
"""Samples of a free run that judges, and of all of them: long beside the lags, few enough to run for all candidates."""
_OFFERED, _EXCHANGED = 8, 3
"""Terms of the largest error reduction ratio that are tried beside those chosen, and in place of each of them."""
_ROUNDS = 40  # Changes of one term at most; it ends when none helps.
_FAR = 100.0  # A free run so many sizes away from the data has diverged.
_EXACT = 1e-13  # Mean squares below this share of an output's are rounding of normal equations, and decide nothing.


@dataclass(frozen=True, eq=False)
class ScaledWindows:
    """Stretches of scaled records that free runs are compared with."""

    # (W, T, ny), (W, T, nu)
    y: FloatArray
    u: FloatArray
    lags: int  # Measured samples that a run starts from

    @classmethod
    def of(cls, records: Sequence[Trajectory], lags: int, longest: int = LONGEST) -> ScaledWindows:
        """Return stretches of one length, spread over all records.

        Parameters
        ----------
        records : sequence of Trajectory
            Scaled.
        lags : int
        longest : int
            Samples of a stretch at most; less where most records are shorter.
        """
        length = min(longest + lags, int(np.median([len(record) for record in records])))
        starts = [(r, k) for r in records for k in range(0, len(r) - length + 1, length)]
        step = max(1, -(-len(starts) * length // SAMPLES))
        some = starts[::step]
        return cls(
            np.stack([record.y[k : k + length] for record, k in some]),
            np.stack([record.u[k : k + length] for record, k in some]),
            lags,
        )

    @property
    def samples(self) -> int:
        """How many samples are simulated."""
        return int(self.y.shape[0] * (self.y.shape[1] - self.lags))

    def errors(self, library: Library, chosen: Sequence[int], coefficients: FloatArray) -> FloatArray:
        """Return the mean squares (M, ny) of the free runs of models; infinite where one diverges.

        Parameters
        ----------
        library : Library
        chosen : sequence of int
            Functions that some model uses.
        coefficients : array (M, ny, len(chosen))
        """
        many, ny, _ = coefficients.shape
        count, length, nu = self.u.shape
        lags = self.lags
        past = [np.broadcast_to(self.y[:, lags - 1 - j].T, (many, ny, count)) for j in range(lags)]
        total = np.zeros((many, ny))
        lost = np.zeros(many, dtype=bool)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(lags - 1, length - 1):
                letters = [lag[:, i] for lag in past for i in range(ny)]
                letters += [np.broadcast_to(self.u[:, k - j, i], (many, count)) for j in range(lags) for i in range(nu)]
                values = library.rows(letters, chosen).transpose(1, 0, 2)
                new = np.matmul(coefficients, values)
                far = ~(np.abs(new) <= _FAR).all(axis=(1, 2))
                if far.any():
                    lost |= far
                    new[far] = 0.0
                total += np.sum((new - self.y[:, k + 1].T) ** 2, axis=2)
                past = [new, *past[:-1]]
        total[lost] = np.inf
        return np.asarray(total / self.samples)


def pruned(
    equations: NormalEquations,
    library: Library,
    windows: ScaledWindows,
    supports: list[list[int]],
    most: int,
    criterion: Criterion,
    white: Sequence[bool],
) -> tuple[list[list[int]], FloatArray]:
    """Return the terms of each output after exchanges that free runs ask for, and their mean squares (ny,).

    A least-squares fit of the next output hardly tells a wrong term from a right one where the last output says nearly
    all; a free run does (Piroddi & Spinelli 2003, Int. J. Control 76:1767, sec. 4). One term at a time is left out,
    added or put in the place of another, always what lowers the criterion of the mean square of the simulation most,
    until nothing does. A disturbance that the plant remembers is in a free run for long, and terms that are none would
    be added to follow it: what comes in must lower the criterion of the one-step error too. So must what goes where
    that error is white: then it is the likelihood, and sees terms that the disturbance hides from a free run. Offered
    are the terms of the largest error reduction ratios, where that paper simulates all.

    - ``supports``: terms of each output to begin with
    - ``most``: terms of an output at most; 0 changes nothing
    - ``criterion`` {"ebic", "bic", "aic"}: as of :func:`identifiers.sparse.orthogonal.criterion_value`
    - ``white``: whether the one-step errors of each output are white under the terms to begin with
    """
    supports = [list(one) for one in supports]
    cost, errors = _judged(equations, library, windows, [supports], criterion)
    best, error = cost[0], errors[0]
    for _ in range(_ROUNDS if most else 0):
        improved = False
        for output in range(len(supports)):
            trials = [
                [*supports[:output], one, *supports[output + 1 :]]
                for one in _changed(equations, output, supports[output], most, criterion, white[output])
            ]
            if not trials:
                continue
            costs, errors = _judged(equations, library, windows, trials, criterion)
            first = int(np.argmin(costs))
            if costs[first] < best or (not np.isfinite(best) and np.isfinite(costs[first])):
                best, error, supports, improved = costs[first], errors[first], trials[first], True
        if not improved:
            break
    return supports, error


def _changed(
    equations: NormalEquations, output: int, keep: list[int], most: int, criterion: Criterion, white: bool
) -> list[list[int]]:
    """Return the sets of terms that differ by one, as far as the one-step error bears them."""
    fewer = [keep[:i] + keep[i + 1 :] for i in range(len(keep))] if len(keep) > 1 else []
    offered = []
    for i in range(len(keep)):
        others = keep[:i] + keep[i + 1 :]
        offered += [[*others, j] for j in helpful(equations, output, others, _EXCHANGED) if j != keep[i]]
    if len(keep) < most:
        offered += [[*keep, j] for j in helpful(equations, output, keep, _OFFERED)]
    known = _ahead(equations, output, keep, criterion)
    asked, free = ([*fewer, *offered], []) if white else (offered, fewer)
    return free + [one for one in asked if _ahead(equations, output, one, criterion) < known]


def _ahead(equations: NormalEquations, output: int, keep: list[int], criterion: Criterion) -> float:
    """Return the criterion of the one-step error of some terms."""
    lost = lost_share(equations, output, keep)
    return criterion_value(lost, len(keep), equations.rows, len(equations.gram), criterion)


def _judged(
    equations: NormalEquations,
    library: Library,
    windows: ScaledWindows,
    trials: Sequence[list[list[int]]],
    criterion: Criterion,
) -> tuple[FloatArray, FloatArray]:
    """Return the criterion (M,) of some sets of terms, and the mean squares of their free runs (M, ny)."""
    chosen = sorted({j for trial in trials for one in trial for j in one})
    place = {j: i for i, j in enumerate(chosen)}
    gram, right, size = scaled_equations(equations)
    ny = right.shape[1]
    coefficients = np.zeros((len(trials), ny, len(chosen)))
    known: dict[tuple[int, tuple[int, ...]], FloatArray] = {}
    for number, trial in enumerate(trials):
        for output, one in enumerate(trial):
            if (output, tuple(one)) not in known:
                known[output, tuple(one)] = solved(gram[np.ix_(one, one)], right[one, output]) / size[one]
            coefficients[number, output, [place[j] for j in one]] = known[output, tuple(one)]
    errors = windows.errors(library, chosen, coefficients)
    cost = [
        sum(
            criterion_value(max(float(error), _EXACT), len(one), windows.samples, len(library), criterion)
            for error, one in zip(wrong, trial, strict=True)
        )
        if np.isfinite(wrong).all()
        else np.inf
        for wrong, trial in zip(errors, trials, strict=True)
    ]
    return np.array(cost), errors
