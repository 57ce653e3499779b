"""Signs of an output whose sensor lost them, by following the motion through its zeros.

Where a record is sampled often beside its motion, a smooth path goes through zero and the folded one turns there with a
kink, so the signs follow without any model of the plant.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.signals import FloatArray

BEAM = 16
"""Paths that are followed side by side."""
LONGEST = 10_000
"""Samples of a record that are followed."""


@dataclass(frozen=True)
class SignPath:
    """Signs along a folded record.

    Attributes
    ----------
    signs : array (N,)
        1 at the first sample.
    gain : float
        By how much it is likelier than a path that never changes its sign (natural logarithm); 0 if it is that one.
    """

    signs: FloatArray
    gain: float


def tracked(y: FloatArray) -> tuple[SignPath, ...]:
    """Return the signs of a folded record, likeliest first; empty where following it decides nothing.

    - ``y`` (N,): readings at equal distances in time that never change their sign
    - returns more than one path if the record does not tell: where the motion lingers at zero, another path explains it
      nearly as well. Empty if a path that never changes its sign does so.

    Notes
    -----
    The path is a random walk of the acceleration (Bar-Shalom, Li and Kirubarajan 2001, *Estimation with applications to
    tracking and navigation*, eq. 6.2.3-6), read with a sign that is not known. Every sample asks a Kalman filter both
    signs, and the likeliest paths are kept. The filter's gain is the same for all of them. Of several intensities of
    the walk that of the largest likelihood counts.

    Examples
    --------
    >>> t = 0.01 * np.arange(3000)
    >>> y = np.sin(2.0 * t) + 0.4 * np.cos(5.1 * t)
    >>> folded = np.abs(y) + 1e-3 * np.random.default_rng(0).normal(size=3000)
    >>> path = tracked(folded)[0]
    >>> bool(np.all((path.signs == np.sign(y))[np.abs(y) > 5e-3])), tracked(2.0 + y)[0].gain
    (True, 0.0)
    """
    record = np.asarray(y, dtype=float)[:LONGEST]
    size = float(np.sqrt(np.mean(record**2))) if len(record) else 0.0
    if len(record) < 50 or size == 0.0:
        return ()
    noise = max(fourth_difference(record), 1e-6 * size)
    scaled = record / noise
    # the intensity of the likeliest walk, by decades
    best, walk = _followed(scaled, 1e-2), 1e-2
    for step in (10.0, 0.1):
        while 1e-8 < walk * step < 1e8:
            other = _followed(scaled, walk * step)
            if other[0][0] <= best[0][0]:
                break
            best, walk = other, walk * step
    likely, signs = best[0]
    turns = np.count_nonzero(np.diff(signs))
    straight = likely if turns == 0 else _followed(scaled, walk, folds=False)[0][0]
    if likely - straight < DATA_POLICY.turn * turns:
        return ()
    paths = [SignPath(signs, float(likely - straight))]
    for rival, others in best[1:]:
        if likely - rival < DATA_POLICY.rival and all(np.mean(others != path.signs) > 0.01 for path in paths):
            paths.append(SignPath(others, float(rival - straight)))
    return tuple(paths)


def _gains(walk: float, count: int) -> Iterator[tuple[float, FloatArray, FloatArray]]:
    """Yield variance of the innovation, gain (3,) and standard deviations (3,) of every sample; the noise is 1."""
    covariance = np.diag([1.0, 1e6, 1e6])
    step = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    added = walk * np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
    variance, settled = np.inf, False
    for sample in range(count):
        if not settled:
            if sample:
                covariance = step @ covariance @ step.T + added
            before, variance = variance, float(covariance[0, 0] + 1.0)
            gain = covariance[:, 0] / variance
            covariance = covariance - np.outer(gain, covariance[0])
            covariance = (covariance + covariance.T) / 2
            spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            settled = sample > 300 and abs(variance - before) < 1e-9 * variance
        yield variance, gain, spread


def _followed(y: FloatArray, walk: float, *, folds: bool = True) -> list[tuple[float, FloatArray]]:
    """Return up to three paths as log likelihood and signs (N,), best first."""
    n = len(y)
    mean, score = np.array([[y[0], 0.0, 0.0]]), np.zeros(1)
    parent = np.zeros((n, BEAM), dtype=int)
    place = np.zeros((n, BEAM))
    place[0] = y[0]
    for sample, (variance, gain, spread) in enumerate(_gains(walk, n)):
        if sample == 0:
            continue
        ahead = np.column_stack([mean[:, 0] + mean[:, 1] + mean[:, 2] / 2, mean[:, 1] + mean[:, 2], mean[:, 2]])
        missed = y[sample] - ahead[:, 0]
        if folds:
            missed = np.concatenate([missed, -y[sample] - ahead[:, 0]])
            ahead, score = np.concatenate([ahead, ahead]), np.concatenate([score, score])
        score = score - 0.5 * missed * missed / variance - 0.5 * np.log(variance)
        order = np.argsort(-score, kind="stable")
        order = order[score[order] > score[order[0]] - DATA_POLICY.hopeless]
        moved = ahead[order] + missed[order, None] * gain
        kept = _apart(moved, spread)
        chosen, mean = order[kept], moved[kept]
        score = score[chosen]
        count = len(chosen)
        parent[sample, :count] = chosen % (len(ahead) // 2 if folds else len(ahead))
        place[sample, :count] = mean[:, 0]
    paths = []
    for path in range(min(3, len(score))):
        signs, at = np.ones(n), path
        for sample in range(n - 1, 0, -1):
            signs[sample] = 1.0 if place[sample, at] >= 0 else -1.0
            at = parent[sample, at]
        paths.append((float(score[path]), signs))
    return paths


def _apart(states: FloatArray, spread: FloatArray) -> list[int]:
    """Return the first of all states (k, 3) that are nearly the same, at most as many as are followed."""
    kept = [0]
    for row in range(1, len(states)):
        if len(kept) == BEAM:
            break
        if np.all(np.any(np.abs(states[kept] - states[row]) > DATA_POLICY.same * spread, axis=1)):
            kept.append(row)
    return kept


def fourth_difference(y: FloatArray) -> float:
    """Return the standard deviation of white noise in an oversampled signal (N,), from its fourth difference.

    1.4826 MAD / sqrt(70) (the squares of 1, -4, 6, -4, 1 sum to 70), never below quantisation / sqrt(12).

    Examples
    --------
    >>> y = np.sin(np.arange(5000) * 0.01) + 0.01 * np.random.default_rng(0).standard_normal(5000)
    >>> round(fourth_difference(y), 3)
    0.01
    """
    d = np.diff(np.asarray(y, dtype=float), 4)
    if d.size == 0:
        return float("nan")
    spread = 1.4826 * float(np.median(np.abs(d - np.median(d)))) / float(np.sqrt(70.0))
    return max(spread, _quantum(y) / float(np.sqrt(12.0)))


def _quantum(y: FloatArray) -> float:
    """Return the step of a quantised signal; 0 if its values do not sit on a grid of few steps."""
    values = np.unique(np.asarray(y, dtype=float))
    if values.size < 2 or values.size > 0.5 * y.size:
        return 0.0
    steps = np.diff(values)
    return float(np.median(steps[steps > 1e-9 * np.ptp(values)])) if np.ptp(values) > 0 else 0.0
