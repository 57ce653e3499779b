"""The record of an estimate of one-step equations: covariance and intervals, or why there are none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from harness.algebra import divisor, orthonormal
from harness.errors import FitError
from harness.models.estimate import Estimate, RankDecision
from harness.models.whiteness import DOUBT, white
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.units import quotient
from identifiers.common.excitation import Columns
from identifiers.common.neighbours import GROUPS
from identifiers.common.records import lagged
from identifiers.common.regression import Solution

LEVEL = 0.95
LARGEST = 200
"""Coefficients beyond which no record is kept: nobody reads so many, and their covariance fills the stored model."""
CHECKED = 20_000  # Equations that the test for correlated residuals looks at: at so many it sees a correlation of 0.03.
EXACT = 1e-9  # Residuals below this share of the outputs are rounding.
DEPENDENT = 1e-10
"""Singular values of scaled columns below this share of the largest: functions that the data do not tell apart."""


def least_squares_estimate(
    records: Sequence[Trajectory], solution: Solution, lags: int, offset: bool
) -> Estimate | None:
    """Return the record of a least-squares fit; intervals only where the residuals bear them out.

    Covariance ``kron(S, (Phi' Phi)^-1)`` with S that of the residuals, Student's quantile (Ljung 1999, eq. 9.42). It
    holds for noise that enters the equations afresh at every sample. Noise on measured outputs does not: it leaves
    residuals that the ones before foretell (Breusch 1978, Aust. Econ. Papers 17:334; Godfrey 1978, Econometrica
    46:1293), and then no interval is claimed.

    - ``solution``: of ``y[k+1] = theta' [y[k], ..., u[k], ..., 1]`` over all of them
    - returns None beyond 200 coefficients
    """
    spec = records[0].spec
    theta = solution.coefficients
    p = len(theta)
    free = solution.rows - p
    if theta.size > LARGEST:
        return None
    spread = solution.scale[: spec.ny] / np.sqrt(solution.rows)
    if free < 1 or np.all(solution.residual_rms <= EXACT * spread):
        why = "as many coefficients as equations" if free < 1 else "the residuals are rounding"
        return _record(spec, lags, solution, theta, None, None, f"no interval: {why}")
    from scipy.stats import t

    inverse: FloatArray = np.linalg.pinv(solution.factor) / solution.scale[:, None]
    covariance = np.asarray(
        np.kron(_residual_covariance(records, solution, lags, offset), inverse @ inverse.T), dtype=np.float64
    )
    if (output := foretold_output(records, theta, lags, offset)) is not None:
        why = f"the residuals of {output} are correlated in time, as noise on measured outputs leaves them"
        return _record(spec, lags, solution, theta, covariance, None, f"no interval: {why}; use method iv")
    half = float(t.ppf(0.5 + LEVEL / 2, free)) * np.sqrt(np.diag(covariance))
    return _record(spec, lags, solution, theta, covariance, half, "least squares, white residuals")


def jackknife_estimate(
    records: Sequence[Trajectory],
    solution: Solution,
    theta: FloatArray,
    refit: Callable[[list[Trajectory]], FloatArray],
    groups: int = GROUPS,
) -> Estimate | None:
    """Return the record of a fit of any criterion, by leaving out one stretch of the records at a time.

    Delete-a-group jackknife (Kott 2001, J. Official Statistics 17:521): what the noise is, and how long it remembers,
    need not be known; a stretch is 5 % of the samples and none reaches across a seam.

    - ``solution``: the least-squares fit, for rank and condition
    - ``theta`` (p, ny): the fit to all records
    - ``refit``: returns theta (p, ny) of other records
    """
    from scipy.stats import t

    spec = records[0].spec
    if theta.size > LARGEST:
        return None
    total = sum(map(len, records))
    cuts = np.linspace(0, total, groups + 1).astype(int)
    found = []
    try:
        for low, high in pairwise(cuts):
            found.append(refit(_without(records, int(low), int(high))).T.ravel())
    except FitError as error:
        return _record(spec, 1, solution, theta, None, None, f"no interval: without a stretch of the records: {error}")
    away = np.array(found) - theta.T.ravel()
    covariance = (groups - 1) / groups * away.T @ away
    half = float(t.ppf(0.5 + LEVEL / 2, groups - 1)) * np.sqrt(np.diag(covariance))
    return _record(spec, 1, solution, theta, covariance, half, f"jackknife over {groups} stretches of the records")


def lifted_estimate(functions: Sequence[str], spec: PlantSpec, solution: Solution) -> Estimate | None:
    """Return the record of a linear map between functions of the outputs, driven by the inputs; no intervals.

    Functions of noisy outputs are regressors with errors that the residuals do not show, and a dictionary that is not
    closed leaves errors that are no noise: a covariance of least squares would claim too much.

    - ``functions``: names of the functions, without units
    - ``solution``: of ``z[k+1] = theta' [z[k], u[k]]``
    - returns None beyond 200 coefficients
    """
    if solution.coefficients.size > LARGEST:
        return None
    columns = [*functions, *(channel.name for channel in spec.inputs)]
    units = ["1"] * len(functions) + [quotient("1", channel.unit) for channel in spec.inputs]
    rank = int(np.sum(solution.singular_values > DEPENDENT * solution.singular_values[0]))
    return Estimate(
        tuple(f"{target} on {column}" for target in functions for column in columns),
        tuple(units * len(functions)),
        solution.coefficients.T.ravel(),
        method="no interval: functions of noisy outputs are no exact regressors, and the dictionary need not be closed",
        rank=RankDecision(rank, len(columns), rule=f"singular values above {DEPENDENT:g} of the largest"),
        condition=solution.condition,
    )


def _record(
    spec: PlantSpec,
    lags: int,
    solution: Solution,
    theta: FloatArray,
    covariance: FloatArray | None,
    half: FloatArray | None,
    method: str,
) -> Estimate:
    """Return the record; coefficients run over the regressors of the first output, then of the second."""
    columns = Columns(spec, lags).names[: len(theta)]
    sides = [c.unit for side in (spec.outputs, spec.inputs) for _ in range(lags) for c in side]
    sides = [*sides, "1"][: len(theta)]
    values = theta.T.ravel()
    return Estimate(
        tuple(f"{output.name} on {column}" for output in spec.outputs for column in columns),
        tuple(quotient(output.unit, unit) for output in spec.outputs for unit in sides),
        values,
        covariance,
        None if half is None else np.column_stack([values - half, values + half]),
        LEVEL,
        method,
        RankDecision(len(theta), len(theta), rule="inputs and states move by more than their noise"),
        solution.condition,
    )


def _rows(record: Trajectory, lags: int, offset: bool) -> FloatArray:
    """Return the regressors of a record (N - lags, p)."""
    rows = lagged(record, lags)
    return np.hstack([rows, np.ones((len(rows), 1))]) if offset else rows


def _residual_covariance(records: Sequence[Trajectory], solution: Solution, lags: int, offset: bool) -> FloatArray:
    """Return that of the residuals (ny, ny): variances over all equations, correlations over the first of them."""
    theta = solution.coefficients
    total, left = np.zeros((theta.shape[1],) * 2), CHECKED
    for record in records:
        part = record[: min(len(record), left + lags)]
        if len(part) <= lags or left <= 0:
            continue
        residual = part.y[lags:] - _rows(part, lags, offset) @ theta
        total += residual.T @ residual
        left -= len(residual)
    size = divisor(np.sqrt(np.diag(total)))
    deviation = solution.residual_rms * np.sqrt(solution.rows / (solution.rows - len(theta)))
    found: FloatArray = total / np.outer(size, size) * np.outer(deviation, deviation)
    return found


def foretold_output(
    records: Sequence[Trajectory],
    theta: FloatArray,
    lags: int,
    offset: bool,
    columns: Sequence[Sequence[int]] | None = None,
) -> str | None:
    """Return the output whose residuals those before foretell most, None where chance explains all.

    Those one sample before, beside the regressors (Breusch and Godfrey), or of more samples (:func:`white`).

    - ``records, theta, lags, offset``: as of :func:`least_squares_estimate`
    - ``columns``: regressors of each output, where not all are
    """
    from scipy.stats import chi2

    rows, before, later, left = [], [], [], CHECKED
    for record in records:
        part = record[: min(len(record), left + lags + 1)]
        if len(part) < lags + 2 or left <= 0:
            continue
        phi = _rows(part, lags, offset)
        miss = part.y[lags:] - phi @ theta
        rows.append(phi[1:])
        before.append(miss[:-1])
        later.append(miss[1:])
        left -= len(miss)
    if not rows:
        return None
    phi, past, now = map(np.concatenate, (rows, before, later))
    if len(now) <= phi.shape[1] + past.shape[1]:
        return None
    own = [phi] if columns is None else [phi[:, list(chosen)] for chosen in columns]
    power = np.sum(now**2, axis=0)
    explained = [np.sum((orthonormal(np.hstack([rows, past]), 1e-10).T @ now) ** 2, axis=0) for rows in own]
    share = (explained[0] if columns is None else np.diag(explained)) / divisor(power)
    probability = chi2.sf(len(now) * share, past.shape[1])
    worst = int(np.argmin(probability))
    names = [channel.name for channel in records[0].spec.outputs]
    if probability[worst] < DOUBT / share.size:
        return names[worst]
    return next((name for i, name in enumerate(names) if not white([now[:, i] for now in later], len(names))), None)


def _without(records: Sequence[Trajectory], low: int, high: int) -> list[Trajectory]:
    """Return the records without samples low .. high - 1, counted through all of them; a hole is a seam."""
    kept, place = [], 0
    for record in records:
        first, last = (min(max(edge - place, 0), len(record)) for edge in (low, high))
        kept += [record[part] for part in (slice(0, first), slice(last, len(record))) if part.stop - part.start >= 2]
        place += len(record)
    return kept
