"""The least error that can be expected of a model of a linear plant: realised noise, and the Cramer-Rao bound.

With the true matrices in hand, the error on a held-out record has two parts. The noise of that record: what the free
run of the truth leaves, or one step ahead the innovations of its Kalman filter, so that process noise counts. And what
no unbiased estimator can do without, the error of parameters learned from the estimation records: their covariance is
at least the inverse of the Fisher information of the one-step predictions (Ljung 1999, *System Identification*, eq.
7.90 and 9.54), and the gradients of the held-out prediction carry it over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import HarnessError
from harness.scoring.control import linearise
from harness.signals import FloatArray, Trajectory

EXACT = 1e-6
"""A plant is linear if its matrices foretell its next state to this share of the state's spread: integrators are that
exact, and so small a nonlinearity adds less than any noise that a bound is asked for."""
WHITE = 5.0
"""Autocorrelations of white noise stay below this many of their standard deviations, 1/sqrt(N) (Ljung, sec. 16.6)."""
LAGS = 8  # Lags at which noise is held to be white.
SEEN = 1e-9
"""Directions of the parameters below this share of the best seen one are those of a change of state coordinates."""


@dataclass(frozen=True, eq=False)
class LinearTruth:
    """``x[k+1] = a x[k] + b u[k] + w[k]``, ``y[k] = c x[k] + d u[k] + v[k]`` with white w, v of covariance q, r.

    Parameters
    ----------
    a, b, c, d : array (nx, nx), (nx, nu), (ny, nx), (ny, nu)
        Of one sample.
    q, r : array (nx, nx), (ny, ny)
        Covariances of the noise.
    own : int
        States of the plant; any beyond them are those of coloured noise, at rest in the mean.
    start : array (nx, nx)
        Covariance of the state at the first sample, given the plant's own.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    q: FloatArray
    r: FloatArray
    own: int
    start: FloatArray


@dataclass(frozen=True)
class LeastErrors:
    """NRMSE, pooled over outputs and records as scores are.

    Parameters
    ----------
    simulation, equation : float
        The least that can be expected of an unbiased estimator: free run, one step ahead.
    known_simulation, known_equation : float
        The same of one that knows the parameters: the noise alone.
    """

    simulation: float
    equation: float
    known_simulation: float
    known_equation: float


def linear_truth(
    plant: Any, runs: Sequence[Trajectory], disturbances: Sequence[FloatArray | None]
) -> LinearTruth | None:
    """Return the equations and noise that made some records, or None where they are not linear with white noise.

    The matrices are the plant's own; that they hold, and what the noise is, is read off the true states.

    Parameters
    ----------
    plant : Plant
        It may be reset.
    runs : sequence of Trajectory
        With true states.
    disturbances : sequence of (N, nu) or None
        What was added to the inputs unseen: nothing, white, or first-order noise.
    """
    states = [run.x for run in runs]
    if any(x is None for x in states) or any(channel.kind != "real" for channel in runs[0].spec.outputs):
        return None
    if any(channel.period for channel in runs[0].spec.outputs):
        return None
    try:
        a, b, c, d = _matrices(plant)
    except HarnessError:
        return None
    residuals, sensor, hidden = [], [], []
    for run, x, given in zip(runs, states, disturbances, strict=True):
        if x is None:
            return None
        extra = np.zeros_like(run.u) if given is None else given
        residuals.append(x[1:] - x[:-1] @ a.T - (run.u + extra)[:-1] @ b.T)
        left = run.y - x @ c.T - (run.u + extra) @ d.T
        sensor.append(np.where(np.abs(left).max(axis=0) <= EXACT * np.std(run.y, axis=0), 0.0, left))
        hidden.append(extra)
    spread = np.std(np.concatenate([x for x in states if x is not None]), axis=0)
    if not (np.isfinite(spread).all() and (spread > 0).all()):
        return None
    q, r = np.zeros_like(a), _covariance(sensor)
    if any((np.abs(part) > EXACT * spread).any() for part in residuals):
        if not all(_white(part) for part in residuals):
            return None
        q = _covariance(residuals)
    if not all(_white(part) for part in sensor):
        return None
    truth = LinearTruth(a, b, c, d, q, r, len(a), np.zeros_like(a))
    return _with_disturbance(truth, hidden)


def least_errors(truth: LinearTruth, runs: Sequence[Trajectory], held_out: Sequence[Trajectory]) -> LeastErrors | None:
    """Return the least errors to be expected on held-out records after learning from others.

    The order of the model is known, its parameters are not, and neither is the state at which a record starts: in a
    held-out record it is the one that fits best, as models may choose it (one with more states than the truth can fit a
    little of the noise by them, and come out below). Noise is Gaussian with the covariances of the truth; what its
    colour says of the parameters is left out, as it is where the noise has a model of its own (Box-Jenkins).

    Parameters
    ----------
    truth : LinearTruth
    runs : sequence of Trajectory
        That a model is fitted to.
    held_out : sequence of Trajectory
        That it is scored on.

    Returns
    -------
    LeastErrors or None
        None without noise, and for unstable plants, whose free run outgrows any noise.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng, one = np.random.default_rng(0), np.eye(1)
    >>> truth = LinearTruth(0.8 * one, one, one, 0 * one, 0 * one, 0.01 * one, 1, 0 * one)
    >>> u, x = rng.normal(size=(400, 1)), np.zeros((400, 1))
    >>> for k in range(399):
    ...     x[k + 1] = 0.8 * x[k] + u[k]
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> data = Trajectory(np.arange(400.0), u, x + 0.1 * rng.normal(size=(400, 1)), spec, x)
    >>> found = least_errors(truth, [data[:200]], [data[200:]])
    >>> round(found.simulation / found.known_simulation, 3)  # two parameters from 200 samples
    1.004
    """
    if np.abs(np.linalg.eigvals(truth.a)).max() > 1.0 + 1e-9:
        return None
    try:
        learned = [_Linearised(truth, run) for run in runs]
        judged = [_Linearised(truth, run) for run in held_out]
    except np.linalg.LinAlgError:  # an output without noise
        return None
    root = _root_covariance(
        truth, np.vstack([_without(linearised.white_start, linearised.white_gradients) for linearised in learned])
    )
    totals, count = np.zeros(4), 0
    for linearised, run in zip(judged, held_out, strict=True):
        spread = np.std(run.y, axis=0)
        if not (spread > 0).all():
            return None
        weight = np.tile(1.0 / spread, len(run))
        free = [weight[:, None] * part for part in (linearised.start, linearised.miss, linearised.gradients @ root)]
        ahead = [
            weight[:, None] * part
            for part in (linearised.ahead_start, linearised.ahead_miss, linearised.ahead_gradients @ root)
        ]
        for column, (start, miss, excess) in enumerate((free, ahead)):
            noise = float(np.sum(_without(start, miss) ** 2))
            totals[column] += noise + float(np.sum(_without(start, excess) ** 2))
            totals[column + 2] += noise
        count += run.y.size
    if not (totals > 0).all():
        return None
    return LeastErrors(*np.sqrt(totals / count).tolist())


class _Linearised:
    """What a record leaves of the truth's free run, and how that run moves with the parameters and the first state.

    All arrays have the samples of all outputs in their rows, sample by sample; ``ahead_...`` are the same one step
    ahead (through the Kalman filter), ``white_...`` also divided by their standard deviations.
    """

    def __init__(self, truth: LinearTruth, run: Trajectory) -> None:
        own, n, ny = truth.own, len(run), run.spec.ny
        a, b, c = truth.a[:own, :own], truth.b[:own], truth.c[:, :own]
        x = np.empty((n, own))
        assert run.x is not None
        x[0] = run.x[0]
        response = np.empty((n, ny, own))  # c a^k
        response[0] = c
        for k in range(n - 1):
            x[k + 1] = a @ x[k] + b @ run.u[k]
            response[k + 1] = response[k] @ a
        miss = run.y - x @ c.T - run.u @ truth.d.T
        gradients = [*_state_gradients(response, x), *_state_gradients(response, run.u), *_output_gradients(x, ny)]
        if run.spec.feedthrough:
            gradients += _output_gradients(run.u, ny)
        columns = np.concatenate([miss[:, :, None], np.stack(gradients, axis=2), response], axis=2)
        ahead, white = _filtered(truth, columns)
        self.miss, self.gradients, self.start = _split(columns, own)
        self.ahead_miss, self.ahead_gradients, self.ahead_start = _split(ahead, own)
        _, self.white_gradients, self.white_start = _split(white, own)


def _state_gradients(response: FloatArray, signal: FloatArray) -> list[FloatArray]:
    """Return the outputs (N, ny) of a signal's parts that enter each state from the next sample on, states first."""
    from scipy.signal import fftconvolve

    n = len(signal)
    later = np.vstack([np.zeros((1, signal.shape[1])), signal[:-1]])
    return [
        fftconvolve(response[:, :, i], later[:, j : j + 1], axes=0)[:n]
        for i in range(response.shape[2])
        for j in range(signal.shape[1])
    ]


def _output_gradients(signal: FloatArray, ny: int) -> list[FloatArray]:
    """Return each part of a signal (N, n) on each output, as (N, ny)."""
    return [signal[:, j : j + 1] * np.eye(ny)[i] for i in range(ny) for j in range(signal.shape[1])]


def _filtered(truth: LinearTruth, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return columns (N, ny, m) as innovations of the Kalman filter, and these divided by their deviations."""
    ahead, white = np.empty_like(columns), np.empty_like(columns)
    p, x = truth.start, np.zeros((len(truth.a), columns.shape[2]))
    gain, root, settled = np.zeros((len(truth.a), len(truth.c))), np.eye(len(truth.c)), False
    for k, row in enumerate(columns):
        if not settled:
            s = truth.c @ p @ truth.c.T + truth.r
            root = np.linalg.inv(np.linalg.cholesky(s))
            gain = truth.a @ p @ truth.c.T @ root.T @ root
            later = truth.a @ p @ truth.a.T - gain @ s @ gain.T + truth.q
            settled = bool(np.abs(later - p).max() <= 1e-12 * np.abs(later).max())
            p = 0.5 * (later + later.T)
        ahead[k] = row - truth.c @ x
        white[k] = root @ ahead[k]
        x = truth.a @ x + gain @ ahead[k]
    return ahead, white


def _split(columns: FloatArray, own: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return errors and their gradients by parameters and by the first state, samples of all outputs in the rows."""
    flat = columns.reshape(-1, columns.shape[2])
    return flat[:, :1], flat[:, 1:-own], flat[:, -own:]


def _without(start: FloatArray, columns: FloatArray) -> FloatArray:
    """Return what is left of columns when the first state is chosen best for each."""
    u, sizes, _ = np.linalg.svd(start, full_matrices=False)
    basis = u[:, sizes > SEEN * sizes[0]]
    return np.asarray(columns - basis @ (basis.T @ columns))


def _root_covariance(truth: LinearTruth, information: FloatArray) -> FloatArray:
    """Return L with L L^T the least covariance of the parameters, in the directions that change the model at all.

    Many matrices make one model: of the nx (nx + nu + ny) entries of a, b, c a change of coordinates takes nx^2 away
    (Ljung, sec. 4.3 and appendix 4A).
    """
    size = np.linalg.norm(information, axis=0)
    size[size == 0] = 1.0
    _, values, directions = np.linalg.svd(information / size, full_matrices=False)
    kept = min(int(np.sum(values > SEEN * values[0])), information.shape[1] - truth.own**2)
    return np.asarray(directions[:kept].T / values[:kept] / size[:, None])


def _matrices(plant: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a, b, c, d of one sample, about rest."""
    if hasattr(plant, "discrete") and not plant.spec.feedthrough:
        a, b, c = plant.discrete()
        return a, b, c, np.zeros((len(c), b.shape[1]))
    found = linearise(plant)
    return found.a_matrix, found.b_matrix, found.c_matrix, found.d_matrix


def _with_disturbance(truth: LinearTruth, hidden: Sequence[FloatArray]) -> LinearTruth | None:
    """Return the truth with noise that enters like the inputs; first-order noise gets a state of its own."""
    level = _covariance(hidden)
    if not level.any():
        return truth
    if truth.d.any():
        return None
    if all(_white(part) for part in hidden):
        return LinearTruth(
            truth.a, truth.b, truth.c, truth.d, truth.q + truth.b @ level @ truth.b.T, truth.r, truth.own, truth.start
        )
    nu, nx, ny = truth.b.shape[1], len(truth.a), len(truth.c)
    moving = np.diag(level) > 0
    later, now = np.vstack([part[1:] for part in hidden]), np.vstack([part[:-1] for part in hidden])
    pole = np.zeros(nu)
    pole[moving] = np.sum(later * now, axis=0)[moving] / np.sum(now**2, axis=0)[moving]
    if not all(_white(part[1:] - pole * part[:-1]) for part in hidden):
        return None
    a = np.block([[truth.a, truth.b], [np.zeros((nu, nx)), np.diag(pole)]])
    own, noise, start = np.zeros_like(a), np.diag((1 - pole**2) * np.diag(level)), np.zeros_like(a)
    own[:nx, :nx], own[nx:, nx:], start[nx:, nx:] = truth.q, noise, np.diag(np.diag(level))
    return LinearTruth(
        a,
        np.vstack([truth.b, np.zeros((nu, nu))]),
        np.hstack([truth.c, np.zeros((ny, nu))]),
        truth.d,
        own,
        truth.r,
        nx,
        start,
    )


def _covariance(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the covariance (n, n) of noise of zero mean over all records."""
    noise = np.concatenate(parts)
    return np.asarray(noise.T @ noise / len(noise))


def _white(noise: FloatArray) -> bool:
    """Return True if the noise (N, n) has no mean and no memory, or does not exist."""
    n = len(noise)
    if n <= LAGS:
        return False
    for column in noise.T:
        power = float(column @ column)
        if power == 0.0:
            continue
        memory = [abs(float(column[lag:] @ column[:-lag])) / power for lag in range(1, LAGS + 1)]
        if max(*memory, abs(float(column.mean())) * np.sqrt(n / power)) > WHITE / np.sqrt(n):
            return False
    return True
