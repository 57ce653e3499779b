"""A line above all motion that no input has: mains, as it is or aliased, or something that turns near by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter
from scipy.stats import f as f_distribution

from harness.data.oddities.foretold import foretold
from harness.data.oddities.numbers import ODD
from harness.data.oddities.pace import band_of
from harness.signals import FloatArray

_BESIDE = 25  # Bins of the spectrum about a line whose median is its level.
_NEAR = 2.0  # Bins within which two lines are one.
_TRIED = 3  # Lines that are asked, those that stand out most.
_WITHIN = np.linspace(-1.0, 1.0, 21)  # Places between bins at which a line is looked for.
_STEADY = 0.5  # Change of a line from one half of a record to the other, over its size, up to which it is one line.
_STRONG = 0.01  # Share of an input's power that a line of it must hold for a plant to answer with multiples.
_FEW, _MULTIPLES = 2, 40
"""Sources whose multiples are known one by one, and multiples that a nonlinear plant may answer with."""
_MANY = 3.0  # Times the highest of more sources up to which sums and differences of them lie everywhere.


@dataclass(frozen=True, eq=False)
class Hum:
    """A line."""

    frequency: float  # Over the sampling frequency
    sine: FloatArray  # (N,): What it adds to the readings


def hum_of(y: FloatArray, u: FloatArray) -> Hum | None:
    """Return the line that a signal holds above its motion and that no input brings; None if there is none.

    Lines are looked for where the spectrum of the signal, or of what a prediction of it misses, stands out most of what
    is beside. One counts if a sine beside the past of the signal and the inputs lowers what a linear prediction misses
    (an F test, Bonferroni over the frequencies), with one amplitude and phase from the first half of the record to the
    second, and if it is no multiple of a line of an input or of the largest line of the signal: so a nonlinear plant
    answers.

    - ``y`` (N,)
    - ``u`` (N, nu)

    Examples
    --------
    >>> rng, k = np.random.default_rng(0), np.arange(1000)
    >>> u = np.repeat(rng.standard_normal((20, 1)), 50, axis=0)
    >>> y = np.convolve(u[:, 0], 0.9 ** np.arange(80.0))[:1000] + 0.1 * rng.standard_normal(1000)
    >>> found = hum_of(y + 0.3 * np.sin(1.4 * k + 1.0), u)
    >>> round(2 * np.pi * float(found.frequency), 3), round(float(np.abs(found.sine).max()), 1), hum_of(y, u) is None
    (1.4, 0.3, True)
    """
    n = len(y)
    if n < ODD.fewest:
        return None
    told = foretold(y, u)
    stands, power = _standing_out(y)
    largest = int(np.argmax(power))
    sources = [largest] if stands[largest] > _level(n) else []
    stands = np.maximum(stands, _standing_out(told.error)[0])
    for column in u.T:
        over, held = _standing_out(column)
        sources += list(np.flatnonzero((over > _level(n)) & (held > _STRONG * held.sum())))
    lags = len(told.own)
    columns = [y[lags - i : n - i] for i in range(1, lags + 1)]
    columns += [u[lags - j : n - j, k] for j in range(lags + 1) for k in range(u.shape[1])]
    matrix = np.column_stack([*columns, np.ones(n - lags)])
    matrix = matrix - matrix.mean(axis=0) * (np.ptp(matrix, axis=0) > 0)
    size = np.linalg.norm(matrix, axis=0)
    left, values, _ = np.linalg.svd(matrix / np.where(size > 0, size, 1.0), full_matrices=False)
    left = left[:, values > 1e-11 * values[0]]
    goal = y[lags:] - y[lags:].mean()
    alone = goal - left @ (left.T @ goal)
    before = float(alone @ alone)
    for place in np.argsort(-stands)[:_TRIED]:
        if not stands[place] or place < n / (2 * lags) or _answers(float(place), sources, n):
            continue
        frequency, after = _line(place, n, lags, left, alone)
        free = n - lags - left.shape[1] - 2
        if after <= 0 or free <= 0:
            continue
        statistic = 0.5 * (before - after) / after * free
        if n * float(f_distribution.sf(statistic, 2, free)) > ODD.rate:
            continue
        sine = _added(frequency, y, u)
        smallest = 2 * ODD.smallest * float(np.subtract(*np.percentile(y, [90, 10])))
        if sine is not None and np.ptp(sine) > smallest and 2 * frequency > band_of(y - sine):
            return Hum(frequency, sine)
    return None


def _level(n: int) -> float:
    """Return how far a bin of noise stands out by chance."""
    return float(-np.log(ODD.rate / n) / np.log(2.0))


def _standing_out(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the power of each bin that is a peak over the median of those beside it, and the power of all."""
    n = len(y)
    line = np.linspace(-1.0, 1.0, n)
    basis = np.column_stack([np.ones(n), line])
    window = np.hanning(n)
    plain = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    power = np.abs(np.fft.rfft(window * plain)) ** 2
    level = median_filter(power, size=2 * _BESIDE + 1, mode="nearest")
    floor = max(1e-24 * float(power.max(initial=0.0)), float(np.finfo(float).tiny))  # of a column that stands still
    over = power / np.maximum(level, floor)
    over[: int(2 * _NEAR)] = 0.0
    peak = np.concatenate([[False], (over[1:-1] >= over[:-2]) & (over[1:-1] >= over[2:]), [False]])
    return np.where(peak, over, 0.0), power


def _answers(place: float, sources: list[int], n: int) -> bool:
    """Return True where a bin is a multiple of a source, aliased or not, or among those that many of them make."""
    if len(sources) > _FEW:
        return place <= _MANY * max(sources) + _NEAR
    multiples = np.outer([one for one in sources if one > 0], np.arange(1, _MULTIPLES + 1))
    folded = np.abs((multiples + 0.5 * n) % n - 0.5 * n)
    return bool((np.abs(folded - place) <= _NEAR).any())


def _line(place: int, n: int, lags: int, left: FloatArray, alone: FloatArray) -> tuple[float, float]:
    """Return the frequency about a bin whose sine lowers a sum of squares most, and that sum."""
    frequencies = (place + _WITHIN) / n
    turn = 2 * np.pi * np.outer(np.arange(lags, n), frequencies)
    cosine, sine = np.cos(turn), np.sin(turn)
    known, other = left.T @ cosine, left.T @ sine  # what the regressors tell of them is no line of its own
    first, second = (
        np.sum(cosine**2, axis=0) - np.sum(known**2, axis=0),
        np.sum(sine**2, axis=0) - np.sum(other**2, axis=0),
    )
    both = np.sum(cosine * sine, axis=0) - np.sum(known * other, axis=0)
    a, b = alone @ cosine, alone @ sine
    volume = np.maximum(first * second - both**2, 1e-9 * len(turn) ** 2)
    lower = (second * a**2 - 2 * both * a * b + first * b**2) / volume
    best = int(np.argmax(lower))
    return float(frequencies[best]), float(alone @ alone - lower[best])


def _pair(frequency: float, k: npt.NDArray[Any]) -> FloatArray:
    """Return cosine and sine (n, 2)."""
    turn = 2 * np.pi * frequency * k
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _added(frequency: float, y: FloatArray, u: FloatArray) -> FloatArray | None:
    """Return what a line adds to a signal (N,); None where its two halves do not agree.

    The line is what the signal holds at this frequency beside what a linear answer to the inputs does.
    """
    n = len(y)
    k = np.arange(n)
    pair = _pair(frequency, k)
    clean = y
    for _ in range(3):  # the prediction is fitted to what is left, in which the line does not bend it
        told = foretold(clean, u)
        lags = len(told.own)
        filtered = np.column_stack([np.convolve(column, told.pattern)[:n] for column in pair.T])[lags:]
        whole = (told.error + np.convolve(y - clean, told.pattern)[:n])[lags:]
        half = len(whole) // 2
        size = np.linalg.lstsq(filtered, whole, rcond=None)[0]
        parts = [
            np.linalg.lstsq(filtered[part], whole[part], rcond=None)[0] for part in (slice(0, half), slice(half, None))
        ]
        clean = y - pair @ size
    return pair @ size if np.linalg.norm(parts[0] - parts[1]) <= _STEADY * np.linalg.norm(size) else None
