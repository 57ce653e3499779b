"""Surrogates: what the dictionary finds in a residual of the same kind with no cause in it.

A residual of unmodelled coloured disturbance correlates with slow regressors by chance. The null of the loop is
therefore not white noise but the residual's own spectrum (Theiler et al., Physica D 58:77, 1992). The error of short
free runs is no stationary signal either: it is 0 at the start of every window and grows. There the windows themselves
are shuffled, each with a random sign, which keeps their shape and breaks what ties them to the motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

_TOGETHER = 32

ENOUGH = 10
"""Windows that can be shuffled; of fewer there are too few different surrogates."""

__all__ = [
    "ENOUGH",
    "SurrogateTest",
    "orthonormal",
    "phase_randomised",
    "scores",
    "surrogate_test",
    "surrogates",
    "window_shuffled",
]


@dataclass(frozen=True)
class SurrogateTest:
    """The global null: observed maximum over the dictionary, the maxima of the surrogates, the p-value.

    Attributes
    ----------
    observed : float
        max over effects of (R2 / k) / (1 - R2) on the residual.
    null : array (count,)
        The same of each surrogate.
    p : float
        (1 + number of surrogates at or above the observed) / (1 + count).
    by_effect : dict
        Statistic of each effect on the residual.
    p_of : dict
        p-value of each effect against the maxima (so it is corrected for the size of the dictionary).
    """

    observed: float
    null: FloatArray
    p: float
    by_effect: dict[str, float]
    p_of: dict[str, float]


def phase_randomised(series: Sequence[FloatArray], count: int, *, rng: np.random.Generator) -> FloatArray:
    """Return surrogates of a residual recorded in several runs.

    Parameters
    ----------
    series : sequence of array (N_i, ny)
        The residual of each run; phases are drawn for each run by itself, nothing crosses a seam.
    count : int
        Number of surrogates.
    rng : Generator
        Source of the phases. The outputs of one run share them, which keeps their cross-spectrum.

    Returns
    -------
    array (count, sum N_i, ny)
        Power spectrum of each run and output as in the residual, mean included.

    Examples
    --------
    >>> x = np.random.default_rng(0).standard_normal((64, 1))
    >>> s = phase_randomised([x], 3, rng=np.random.default_rng(1))
    >>> bool(np.allclose(np.abs(np.fft.rfft(s[0], axis=0)), np.abs(np.fft.rfft(x, axis=0))))
    True
    """
    parts = []
    for one in series:
        n, ny = one.shape
        spectrum = np.fft.rfft(one, axis=0)
        turns = np.exp(2j * np.pi * rng.random((count, spectrum.shape[0])))
        turns[:, 0] = 1.0
        if n % 2 == 0:
            turns[:, -1] = np.sign(turns[:, -1].real) + (turns[:, -1].real == 0)
        parts.append(np.stack([np.fft.irfft(spectrum[:, j] * turns, n, axis=1) for j in range(ny)], axis=2))
    return np.concatenate(parts, axis=1)


def window_shuffled(
    series: Sequence[FloatArray], windows: Sequence[tuple[int, int, int]], count: int, *, rng: np.random.Generator
) -> FloatArray:
    """Return surrogates of errors of free runs over windows: windows of equal length exchanged, with random signs.

    Parameters
    ----------
    series : sequence of array (N_i, ny)
        The error of each run.
    windows : sequence of (run, first, last)
        The samples ``first`` to ``last - 1`` of a run are one window.
    count : int
        Number of surrogates.
    rng : Generator
        Source of order and signs.

    Returns
    -------
    array (count, sum N_i, ny)

    Examples
    --------
    >>> x = np.arange(4.0)[:, None]
    >>> s = window_shuffled([x], [(0, 0, 2), (0, 2, 4)], 5, rng=np.random.default_rng(0))
    >>> sorted({tuple(np.abs(one[:, 0]).tolist()) for one in s})
    [(0.0, 1.0, 2.0, 3.0), (2.0, 3.0, 0.0, 1.0)]
    """
    offsets = np.concatenate([[0], np.cumsum([len(one) for one in series])])
    whole = np.concatenate(list(series))
    result = np.broadcast_to(whole, (count, *whole.shape)).copy()
    firsts: dict[int, list[int]] = {}
    for run, first, last in windows:
        firsts.setdefault(last - first, []).append(int(offsets[run]) + first)
    for length, starts in firsts.items():
        rows = np.array(starts)[:, None] + np.arange(length)
        blocks = whole[rows]
        order = np.argsort(rng.random((count, len(starts))), axis=1)
        signs = rng.choice([-1.0, 1.0], size=(count, len(starts)))
        result[:, rows] = blocks[order] * signs[:, :, None, None]
    return result


def surrogates(
    series: Sequence[FloatArray], windows: Sequence[tuple[int, int, int]], count: int, *, rng: np.random.Generator
) -> FloatArray:
    """Return surrogates (count, sum N_i, ny): shuffled windows where there are ten or more, else randomised phases."""
    if len(windows) >= ENOUGH:
        return window_shuffled(series, windows, count, rng=rng)
    return phase_randomised(series, count, rng=rng)


def orthonormal(columns: FloatArray, *, without: FloatArray | None = None, tolerance: float = 1e-6) -> FloatArray:
    """Return an orthonormal basis (N, k) of ``columns`` (N, m) after ``without`` (N, p, orthonormal) is removed.

    A column of which less than ``tolerance`` of its norm is left counts as explained and is dropped.
    """
    norms = np.linalg.norm(columns, axis=0)
    kept = columns[:, norms > 0] / norms[norms > 0]
    if without is not None and without.size:
        kept = kept - without @ (without.T @ kept)
        kept = kept - without @ (without.T @ kept)
    if kept.size == 0:
        return np.zeros((columns.shape[0], 0))
    left, values, _ = np.linalg.svd(kept, full_matrices=False)
    return left[:, values > tolerance]


def scores(
    bases: Mapping[str, FloatArray], residuals: FloatArray, power: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Return (R2 / k) / (1 - R2) of each basis on each residual.

    Parameters
    ----------
    bases : mapping of array (N, k)
        Orthonormal, the nominal Jacobian already removed.
    residuals : array (N, count)
        The nominal Jacobian already removed, unless ``power`` is given: the bases do not see it.
    power : array (count,), optional
        Sum of squares of each residual without the nominal Jacobian.
    """
    if power is None:
        power = np.sum(residuals**2, axis=0)
    seen = [(name, basis.shape[1]) for name, basis in bases.items()]
    shares: dict[str, FloatArray] = {}
    for first in range(0, len(seen), _TOGETHER):
        # many bases in one product: the residuals are the large operand and are read once
        names = seen[first : first + _TOGETHER]
        joined = np.concatenate([bases[name] for name, _ in names], axis=1)
        squares = (joined.T @ residuals) ** 2
        row = 0
        for name, k in names:
            shares[name] = squares[row : row + k].sum(axis=0)
            row += k
    result = {}
    for name, k in seen:
        if k == 0:
            result[name] = np.zeros(residuals.shape[1])
            continue
        share = np.clip(shares[name] / np.maximum(power, 1e-300), 0.0, 1 - 1e-12)
        result[name] = share / k / (1 - share)
    return result


def surrogate_test(
    residual: Sequence[FloatArray],
    bases: Mapping[str, FloatArray],
    nominal: FloatArray,
    *,
    rng: np.random.Generator,
    count: int = 300,
    windows: Sequence[tuple[int, int, int]] = (),
) -> SurrogateTest:
    """Test whether the dictionary explains the residual better than it explains surrogates of it.

    Parameters
    ----------
    residual : sequence of array (N_i, ny)
        Weighted residual of each run (each output over its noise).
    bases : mapping of array (sum N_i * ny, k)
        Orthonormal columns of each effect without the nominal Jacobian, rows ordered as the residual (time, output).
    nominal : array (sum N_i * ny, p)
        Orthonormal basis of the nominal Jacobian.
    rng : Generator
        Source of the phases.
    count : int
        Number of surrogates.
    windows : sequence of (run, first, last), optional
        Where the residual is that of free runs over windows. If there are ten or more, they are shuffled; else the
        phases of the runs are randomised.
    """
    truth = np.concatenate([one.reshape(-1) for one in residual])[:, None]
    drawn = surrogates(residual, windows, count, rng=rng).reshape(count, -1).T

    def power(columns: FloatArray) -> FloatArray:
        whole = np.einsum("nc,nc->c", columns, columns)
        known = np.sum((nominal.T @ columns) ** 2, axis=0) if nominal.size else 0.0
        return np.asarray(np.maximum(whole - known, 0.0))

    on_truth = scores(bases, truth, power(truth))
    on_null = scores(bases, drawn, power(drawn))
    null = np.max(np.stack(list(on_null.values())), axis=0) if bases else np.zeros(count)
    by_effect = {name: float(value[0]) for name, value in on_truth.items()}
    observed = max(by_effect.values(), default=0.0)
    p_of = {name: float((1 + np.sum(null >= value)) / (1 + count)) for name, value in by_effect.items()}
    return SurrogateTest(observed, null, float((1 + np.sum(null >= observed)) / (1 + count)), by_effect, p_of)
