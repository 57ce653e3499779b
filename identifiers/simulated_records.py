"""Copies of records as a fitted model simulates them: instruments, and how far an estimate can be believed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory
from identifiers.grey_box_model import GreyBoxModel
from identifiers.motion import noise_level

__all__ = ["Spread", "simulated", "spread_of"]

FAITHFUL = 6.0
"""Simulated records are believed to be like the measured ones while the rms of the free run stays below the noise of
the record times 1 + 6 / sqrt(N): both are known to about 2 / sqrt(N) of themselves (the noise from an eighth of the
spectrum), so this is three standard deviations. Above it the model lacks something or is biased, and its spread says
nothing about the truth."""
REMAINDER = 0.3
"""The bias is taken off to first order; what is left is about bias^2 / value. Above this part of the standard deviation
no interval is claimed: at 0.3 a 95 % interval still holds 94 %."""
WINDOW, LEAST = 1.0, 40
"""Windows of the free run [s], and their least number of samples."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Estimates from simulated records.

    Attributes
    ----------
    bias : array (k,)
        Their mean minus the values that simulated them.
    covariance : array (k, k)
    count : int
        Records simulated, times the sets of records.
    """

    bias: FloatArray
    covariance: FloatArray
    count: int


def simulated(model: GreyBoxModel, records: Sequence[Trajectory]) -> list[tuple[FloatArray, FloatArray]] | None:
    """Return the free run (N, ny) of a model along each record, and the noise (ny,) of that record.

    None if runs over windows of a second, whose starts are fitted, do not stay as near to the record as its own noise,
    or if the whole free run diverges.

    Parameters
    ----------
    model : GreyBoxModel
    records : sequence of Trajectory
    """
    from harness.physics import simulate_error

    found = []
    for record in records:
        dt = record.spec.sample_time
        try:
            rest = simulate_error(model.system(), model.parameters, [record], horizon=max(WINDOW, LEAST * dt))[0]
            x = model.initial_state(record)
        except HarnessError:
            return None
        y = model.free_run(x[None], record.u[None])[0]
        travel = np.ptp(record.y, axis=0)
        # a run that leaves the range of the record by its width is none that could have been measured
        if not (np.isfinite(rest).all() and np.isfinite(y).all() and np.all(np.ptp(y, axis=0) < 3 * travel)):
            return None
        windows = max(1, round(record.duration / max(WINDOW, LEAST * dt)))
        freedom = max(1.0 - windows * model.simulator.nx / rest.size, 0.1)
        size = np.sqrt(np.mean(rest**2, axis=0) / freedom)
        channels = list(zip(record.spec.outputs, record.y.T, strict=True))
        own = np.array([noise_level(s if c.period is None else np.unwrap(s, period=c.period)) for c, s in channels])
        # 1e-6 of the travel: integration, not noise
        if np.any(size > (1 + FAITHFUL / np.sqrt(len(record))) * own + 1e-6 * travel):
            return None
        found.append((y, own))
    return found


def spread_of(
    records: Sequence[Trajectory],
    runs: Sequence[tuple[FloatArray, FloatArray]],
    values: FloatArray,
    refit: Callable[[list[Trajectory]], FloatArray],
    count: int,
    rng: np.random.Generator,
) -> Spread | None:
    """Return how estimates scatter over records that the model simulates with noise as large as the measured one's.

    The parametric bootstrap (Efron & Tibshirani 1993, *An Introduction to the Bootstrap*, sec. 6.5).

    Parameters
    ----------
    records : sequence of Trajectory
        Measured.
    runs : sequence
        Of :func:`simulated`.
    values : array (k,)
        That the model simulates with.
    refit : callable
        From records to estimates (k,).
    count : int
        Sets of simulated records.
    rng : numpy.random.Generator

    Returns
    -------
    Spread or None
        None if a fifth of the refits fail, or the bias is too large to be taken off.
    """
    found = []
    for _ in range(count):
        noisy = []
        for record, (y, size) in zip(records, runs, strict=True):
            noisy.append(Trajectory(record.t, record.u, y + size * rng.normal(size=y.shape), record.spec))
        try:
            found.append(refit(noisy))
        except HarnessError:
            continue
    if len(found) < max(4, 0.8 * count):
        return None
    table = np.array(found)
    covariance = np.atleast_2d(np.cov(table, rowvar=False))
    bias = table.mean(axis=0) - values
    # the mean of so many is uncertain itself
    certain = np.maximum(np.abs(bias) - 2 * np.sqrt(np.diag(covariance) / len(found)), 0.0)
    if np.any(certain**2 > REMAINDER * np.sqrt(np.diag(covariance)) * np.abs(values)):
        return None
    return Spread(bias, covariance, len(found))
