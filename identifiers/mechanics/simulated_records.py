"""Copies of records as a fitted model simulates them: how far an estimate is off, and how far it can be believed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory
from identifiers.mechanics.grey_box_model import GreyBoxModel
from identifiers.mechanics.motion import noise_level

FAITHFUL = 6.0
"""Simulated records are believed to be like the measured ones while the rms of the free run stays below the noise of
the record times 1 + 6 / sqrt(N): both are known to about 2 / sqrt(N) of themselves (the noise from an eighth of the
spectrum), so this is three standard deviations. Above it the model lacks something, and its spread says nothing about
the truth."""
SURE = 0.999  # Probability of the region of parameters within which the model must come back to the records.
SEARCHED, ROUNDS = 6, 12
"""Sets of simulated records by which the parameters are searched that give the estimate back, and steps at most."""
NEAR = 0.25
"""That search ends where every parameter is given back within this part of its standard deviation: the last step, from
all sets, is then linear."""
PIECE, SHORT = 3.0, 200
"""Length [s] of the pieces that are simulated, and their least number of samples: over longer ones an unstable plant
would go another way for the least change of a parameter, and estimates would jump with it."""
KNOWN = 2.5
"""The noise of a record of N samples is known to 2.5 / sqrt(N) of itself: the median of N / 8 exponential variables, of
which the Hann window leaves two in three independent, has a relative standard deviation of 1.44 sqrt(12 / N), its root
half of it. What noise biases is uncertain by that."""
STEPS = 2  # Steps by which the nearest parameters of that region are found.
WINDOW, LEAST = 1.0, 40  # Windows of the free run [s], and their least number of samples.


@dataclass(frozen=True, eq=False)
class SimulatedPiece:
    """A stretch of a record, and the noise (ny,) of that record."""

    record: Trajectory
    noise: FloatArray


@dataclass(frozen=True, eq=False)
class EstimateSpread:
    """How estimates scatter."""

    covariance: FloatArray  # (k, k): Of the corrected parameters
    count: int  # Sets of records simulated


@dataclass(frozen=True, eq=False)
class Corrected:
    """Parameters (k,) whose simulated records give the estimate back on average; their spread, or None and why."""

    values: FloatArray
    spread: EstimateSpread | None
    how: str


def pieces(records: Sequence[Trajectory]) -> list[SimulatedPiece]:
    """Return records in stretches that are short enough to be simulated, each as long as the others of its record."""
    found = []
    for record in records:
        longest = max(SHORT, round(PIECE / record.spec.sample_time))
        edges = np.linspace(0, len(record), max(1, len(record) // longest) + 1).round().astype(int)
        noise = _noise(record)
        found += [SimulatedPiece(record[first:last], noise) for first, last in itertools.pairwise(edges.tolist())]
    return found


def corrected(
    parts: Sequence[SimulatedPiece],
    model_of: Callable[[FloatArray], tuple[GreyBoxModel, FloatArray]],
    refit: Callable[[list[Trajectory]], FloatArray],
    count: int,
    rng: np.random.Generator,
) -> Corrected:
    """Return the parameters from which records would be simulated that give the estimate back, and their covariance.

    Indirect inference (Gourieroux, Monfort & Renault 1993, J. Appl. Econometrics 8:S85): what smoothing bends and what
    noise in the regressor shrinks happens to simulated records just as much. The scatter of the estimates over
    simulated records, through the inverse Jacobian of their mean over the parameters, is that of the parameters.

    - ``parts``: of the records that were measured
    - ``model_of``: from parameters (k,) to the model that has them, as near as physical parameters come, and the values
      reached
    - ``refit``: from records to estimates (k,)
    - ``count``: sets of simulated records
    """
    records, sizes = [part.record for part in parts], [part.noise for part in parts]
    # by noise of a level that is as uncertain as the measured one; the search itself goes by the measured one
    levels = np.exp(KNOWN / np.sqrt(sum(map(len, records))) * rng.normal(size=(count, records[0].spec.ny)))
    draws = [[rng.normal(size=record.y.shape) for record in records] for _ in range(count)]
    uncertain = [[level * part for part in unit] for level, unit in zip(levels, draws, strict=True)]

    def table(values: FloatArray, chosen: Sequence[list[FloatArray]]) -> FloatArray | None:
        """Return the estimates (sets, k) of records that these parameters simulate; None if many fail."""
        runs = _free_runs(model_of(values)[0], records, starts)
        if runs is None:
            return None
        found = []
        for unit in chosen:
            noisy = [
                Trajectory(record.t, record.u, y + size * part, record.spec)
                for record, y, size, part in zip(records, runs, sizes, unit, strict=True)
            ]
            try:
                found.append(refit(noisy))
            except HarnessError:
                continue
        return np.array(found) if len(found) >= max(4, 0.8 * len(chosen)) else None

    observed = refit(records)
    leaves = Corrected(observed, None, "no intervals: the model's free run leaves the records by more than their noise")
    try:
        model, values = model_of(observed)
        starts = [model.initial_state(record) for record in records]
        for _ in range(ROUNDS):
            tried = table(values, draws[:SEARCHED])
            if tried is None:
                return leaves
            gap = observed - tried.mean(axis=0)
            values = model_of(values + gap)[1]
            if np.all(np.abs(gap) <= NEAR * tried.std(axis=0, ddof=1)):
                break
        else:
            return Corrected(observed, None, "no intervals: no parameters were found that give the estimate back")
        all_of_them, some = table(values, uncertain), table(values, draws[:SEARCHED])
        if all_of_them is None or some is None:
            return leaves
        scatter = np.atleast_2d(np.cov(all_of_them, rowvar=False))
        jacobian = np.empty_like(scatter)
        middle = some.mean(axis=0)
        for row, step in enumerate(np.sqrt(np.diag(scatter))):
            reached = model_of(values + 2 * step * np.eye(len(values))[row])[1]
            moved = table(reached, draws[:SEARCHED])
            if moved is None:
                return leaves
            jacobian[:, row] = (moved.mean(axis=0) - middle) / (reached - values)[row]
        back = np.linalg.inv(jacobian)
        values = values + back @ (observed - all_of_them.mean(axis=0))
        covariance = back @ scatter @ back.T
        if not _comes_back(model_of, values, covariance, records, sizes):
            return leaves
    except (HarnessError, np.linalg.LinAlgError):  # parameters without a model
        return leaves
    spread = EstimateSpread(covariance, len(all_of_them))
    return Corrected(values, spread, f"scatter of {spread.count} simulated records, bias taken off")


def _noise(record: Trajectory) -> FloatArray:
    """Return the noise (ny,) of a record."""
    channels = zip(record.spec.outputs, record.y.T, strict=True)
    return np.array([noise_level(s if c.period is None else np.unwrap(s, period=c.period)) for c, s in channels])


def _free_runs(
    model: GreyBoxModel, records: Sequence[Trajectory], starts: Sequence[FloatArray]
) -> list[FloatArray] | None:
    """Return the free run (N, ny) of a model along each record; None if one leaves the range of its record."""
    found = []
    for record, start in zip(records, starts, strict=True):
        y = model.free_run(start[None], record.u[None])[0]
        # a run that leaves the range of the record by its width is none that could have been measured
        if not np.isfinite(y).all() or np.any(np.ptp(y, axis=0) >= 3 * np.ptp(record.y, axis=0)):
            return None
        found.append(y)
    return found


def _comes_back(
    model_of: Callable[[FloatArray], tuple[GreyBoxModel, FloatArray]],
    values: FloatArray,
    covariance: FloatArray,
    records: Sequence[Trajectory],
    sizes: Sequence[FloatArray],
) -> bool:
    """Return True if runs over windows of a second, starts fitted, come as near to the records as their own noise.

    For some parameters in the region that the intervals claim: found by Gauss-Newton steps, the region as a prior.
    """
    from scipy.stats import chi2

    from harness.physics import simulate_error

    model = model_of(values)[0]
    system = model.system()

    def residuals(at: FloatArray) -> list[FloatArray]:
        parameters = model_of(at)[0].parameters
        return [
            simulate_error(system, parameters, [record], horizon=max(WINDOW, LEAST * record.spec.sample_time))[0]
            for record in records
        ]

    # 1e-6 of the travel: integration, not noise
    floors = [size + 1e-6 * np.ptp(record.y, axis=0) for record, size in zip(records, sizes, strict=True)]
    root = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
    k = len(values)
    move = np.zeros(k)
    here = residuals(values)
    for _ in range(STEPS):
        pairs = list(zip(here, floors, strict=True))
        flat = np.concatenate([(miss / size).ravel() for miss, size in pairs])
        jacobian = np.empty((flat.size, k))
        for column, unit in enumerate(np.eye(k)):
            moved = residuals(values + root @ (move + unit))
            jacobian[:, column] = np.concatenate(
                [(miss / size).ravel() for miss, size in zip(moved, floors, strict=True)]
            )
        jacobian -= flat[:, None]
        if not (np.isfinite(flat).all() and np.isfinite(jacobian).all()):
            return False
        rows, known = np.vstack([jacobian, np.eye(k)]), np.concatenate([jacobian @ move - flat, np.zeros(k)])
        move = np.linalg.lstsq(rows, known, rcond=None)[0]
        here = residuals(values + root @ move)
    if move @ move > chi2.ppf(SURE, k):
        return False
    power, count, free = np.zeros(records[0].spec.ny), 0, 0.0
    for record, miss, size in zip(records, here, floors, strict=True):
        windows = max(1, round(record.duration / max(WINDOW, LEAST * record.spec.sample_time)))
        power += np.sum((miss / size) ** 2, axis=0)
        count += len(miss)
        free += max(1.0 - windows * model.simulator.nx / miss.size, 0.1) * len(miss)
    return bool(np.all(np.sqrt(power / free) <= 1 + FAITHFUL / np.sqrt(count)))
