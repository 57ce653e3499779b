"""Impulse responses that are expected to die away: least squares with a prior whose decay the data choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray, Trajectory
from identifiers.common.normal import NormalEquations
from identifiers.common.scaling import sizes
from identifiers.linear.impulse.kernels import kernel_root
from identifiers.linear.markov import normal_equations

LARGEST = 600
"""Unknowns of one output (lags times inputs) up to which the prior is tried: an eigenvalue problem each time."""
_DECAYS = 14
"""Decays that are tried: 1 - decay from half a sample of the window's length to 0.6, evenly in its logarithm."""
_WEIGHTS = np.geomspace(1e-4, 1e5, 46)
"""Variances of the prior that are tried, relative to the mean square of the plain estimate."""
_DRAWS = 20  # Draws from what the data leave open: their largest is exceeded by chance once in twenty fits.


@dataclass(frozen=True, eq=False)
class Decaying:
    """An impulse response, and what the data leave open about it."""

    response: FloatArray  # (length, ny, nu)
    level: FloatArray  # (ny,)
    decay: float  # Of the prior's variance, from sample to sample
    draws: FloatArray  # (20, length, ny, nu): Errors that the response may have, drawn from the posterior
    prior: Prior


@dataclass(frozen=True, eq=False)
class Prior:
    """The prior that the data chose, in coordinates in which it and all rows of the data are diagonal."""

    back: FloatArray  # (count, count): From those coordinates to lags times inputs, scaled
    weight: FloatArray  # (ny,)
    unit: FloatArray  # (count,): Sizes of the inputs
    noise: FloatArray  # (ny,)

    def coefficients(self, sums: NormalEquations, *, offset: bool) -> FloatArray:
        """Return the coefficients (count, ny) under this prior that other rows give."""
        gram, right, _ = _without_constant(sums, self.unit.size, offset)
        inner = self.back.T @ (gram / np.outer(self.unit, self.unit)) @ self.back
        seen = self.back.T @ (right / self.unit[:, None] / self.noise)
        found = [
            np.linalg.solve(inner + np.eye(len(inner)) / weight, seen[:, column])
            for column, weight in enumerate(self.weight)
        ]
        theta: FloatArray = self.back @ np.column_stack(found) / self.unit[:, None] * self.noise
        return theta


def decaying_response(
    trajectories: Sequence[Trajectory], length: int, plain: FloatArray, rms: FloatArray, *, offset: bool
) -> Decaying:
    """Return Markov parameters under a prior that they decay and are smooth, as far as the data bear it out.

    Least squares leaves as noise whatever the input hardly excites (a PRBS that holds each level two samples: the
    highest frequency), and a realization takes that noise for a state, often one that grows. Here the response of every
    input to every output is a Gaussian process of covariance ``c d^max(i, j)``, or ``c d^i`` on the diagonal alone (the
    kernels TC and DI of Chen, Ohlsson & Ljung 2012, Automatica 48:1525); decay d, weight c and which of the two
    maximise the likelihood of the data. With little noise, or rich inputs, the answer is that of least squares.

    - ``length``: number of Markov parameters, the direct term included
    - ``plain`` (length, ny, nu): the least-squares estimate
    - ``rms`` (ny,): its residual, not 0
    - ``offset``: fit a constant output too
    """
    nu, ny = trajectories[0].spec.nu, trajectories[0].spec.ny
    sums = normal_equations(trajectories, length, offset=offset)
    count = length * nu
    gram, right, shift = _without_constant(sums, count, offset)
    unit = np.tile(sizes([record.u for record in trajectories]), length)
    noise = rms * np.sqrt(sums.rows / max(sums.rows - count, 1))
    gram, right = gram / np.outer(unit, unit), right / unit[:, None] / noise
    mean_square = np.mean((plain * unit[:nu] / noise[:, None]) ** 2, axis=(0, 2))
    weights = _WEIGHTS[:, None] * np.where(mean_square > 0, mean_square, 1.0)  # (W, ny)
    best = None
    for decay in 1.0 - np.geomspace(0.5 / length, 0.6, _DECAYS):
        for smooth in (True, False):
            half = np.kron(kernel_root("tc" if smooth else "dc", length, float(decay)), np.eye(nu))
            values, vectors = np.linalg.eigh(half.T @ gram @ half)
            values = np.clip(values, 0.0, None)
            seen = vectors.T @ (half.T @ right)  # (count, ny)
            grown = 1.0 + weights[:, None] * values[:, None]  # (W, count, ny)
            lost = np.log(grown).sum(axis=1) - np.sum(seen**2 * weights[:, None] / grown, axis=1)  # (W, ny)
            total = float(lost.min(axis=0).sum())
            if best is None or total < best[0]:
                chosen = weights[np.argmin(lost, axis=0), np.arange(ny)]
                best = (total, float(decay), half @ vectors, values, seen, chosen)
    assert best is not None
    _, decay, back, values, seen, weight = best
    grown = 1.0 + weight * values[:, None]
    theta = back @ (seen * weight / grown) / unit[:, None] * noise
    # The draws are part of the algorithm, not of the data: always the same.
    chance = np.random.default_rng(0).normal(size=(_DRAWS, count, 1)) * np.sqrt(weight / grown)
    drawn = back @ chance / unit[:, None] * noise
    level = sums.right[-1] / sums.gram[-1, -1] - shift[:, 0] @ theta if offset else np.zeros(ny)
    return Decaying(
        theta.reshape(length, nu, ny).transpose(0, 2, 1),
        level,
        decay,
        drawn.reshape(_DRAWS, length, nu, ny).transpose(0, 1, 3, 2),
        Prior(back, weight, unit, noise),
    )


def _without_constant(sums: NormalEquations, count: int, offset: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Gram matrix and right-hand side with the constant solved for, and its share in each column (count, 1)."""
    gram, right = sums.gram, sums.right
    if not offset:
        return gram, right, np.zeros((count, 1))
    shift = gram[:count, -1:] / gram[-1, -1]
    return gram[:count, :count] - shift * gram[-1, :count], right[:count] - shift * sums.right[-1], shift
