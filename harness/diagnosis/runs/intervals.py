"""95 % intervals of fitted parameters that hold where the residual is coloured.

An unmodelled force shakes a plant at its own resonance: the residual then rings for as long as the plant does, and the
parameters and initial states fitted to it have taken a good part of that ringing away. Both make the usual interval too
narrow: by blocks shorter than the ringing, and by residuals that are smaller than the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from harness.diagnosis.policy import RUN_POLICY
from harness.signals import FloatArray

SCALES = (2, 8, 32, 128)
"""Samples whose means show whether a residual is white."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    def to_dict(self, unit: str) -> dict[str, Any]:
        """Return the entry of ``report.json``; figures that do not exist are None."""

        def known(x: float) -> float | None:
            return float(x) if np.isfinite(x) else None

        return {"value": known(self.value), "low": known(self.low), "high": known(self.high), "unit": unit}


def block_interval(
    values: FloatArray,
    jacobian: Sequence[FloatArray],
    residual: Sequence[FloatArray],
    *,
    starts: Sequence[FloatArray] = (),
    blocks: int = RUN_POLICY.interval_blocks,
    adapt: bool = True,
) -> tuple[Interval, ...]:
    """Return 95 % intervals that stay honest where the residual is coloured.

    The covariance is the delete-one-block jackknife of the linearised fit (CR3: Bell & McCaffrey, Survey Methodology
    28:169, 2002): (J'J)^-1 (sum_b g_b g_b') (J'J)^-1 with g_b = J_b' (I - H_bb)^-1 r_b, where H is the projector on
    what parameters and initial states can do; never smaller than the Gauss-Newton covariance. Student's t has one
    degree of freedom less than there are blocks. A block is at least ten correlation times of the residual long
    (:func:`correlation_samples`), a twentieth of the data at least and a quarter at most, and no block joins parts of
    two windows. Few blocks may agree by chance: an interval is never narrower than with twentieths.

    - ``values`` (p,): the estimates
    - ``jacobian`` sequence of array (N_i, ny, p): weighted derivatives of the outputs, initial states projected out
    - ``residual`` sequence of array (N_i, ny): weighted residuals
    - ``starts`` sequence of array (L_w * ny, k_w): for each window, in the order of the rows, an orthonormal basis of
      what its initial state can do; without it every record is one window, of which the initial state is known
    - ``blocks``: largest number of blocks
    - ``adapt``: False keeps this number of blocks, however long the residual stays correlated

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> j, r = np.ones((2000, 1, 1)), rng.standard_normal((2000, 1))
    >>> r = r - r.mean()
    >>> found = block_interval(np.array([0.0]), [j], [r])[0]
    >>> bool(0.03 < found.high < 0.07)  # the 95 % half width of a mean is 0.044
    True
    """
    from scipy import special

    p = values.size
    j = np.concatenate([part.reshape(-1, p) for part in jacobian])
    r = np.concatenate([part.reshape(-1) for part in residual])
    ny = residual[0].shape[1]
    scale = np.linalg.norm(j, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    left, singular, right = np.linalg.svd(j / scale, full_matrices=False)
    alive = singular > 1e-9 * singular.max(initial=1e-300)
    basis = left[:, alive]
    back = right[alive].T / singular[alive]  # from the orthonormal directions to the parameters
    lengths = [len(start) // ny for start in starts] or [len(part) for part in residual]
    most = r.size // ny / (RUN_POLICY.correlation_times * correlation_samples(residual))
    plain = np.sum(back**2, axis=1) * float(r @ r) / max(r.size - p, 1)
    half = np.zeros(p)
    for wanted in {blocks, int(np.clip(most, min(RUN_POLICY.fewest_blocks, blocks), blocks)) if adapt else blocks}:
        scores = [
            _score(basis[a * ny : b * ny], None if start is None else start[c * ny : d * ny], r[a * ny : b * ny])
            for a, b, start, c, d in _blocks(lengths, starts, wanted)
        ]
        free = max(len(scores) - 1, 1)
        robust = np.sum((np.array(scores) @ back.T) ** 2, axis=0) * free / len(scores)
        half = np.maximum(half, special.stdtrit(free, 0.975) * np.sqrt(np.maximum(robust, plain)) / scale)
    # a direction the data do not move has no interval
    unseen = np.sum(right[~alive] ** 2, axis=0) > 1e-6 if (~alive).any() else np.zeros(p, dtype=bool)
    half = np.where(unseen | (np.linalg.norm(j, axis=0) == 0), np.inf, half)
    return tuple(Interval(float(v), float(v - h), float(v + h)) for v, h in zip(values, half, strict=True))


def correlation_samples(residual: Sequence[FloatArray]) -> float:
    """Return for how many samples a residual stays correlated: 1 + 2 sum_k rho_k^2, the time that errors of size have.

    Slow parts may hide below white noise, so the same sum is also taken of means over 2, 8, 32, 128 samples, wherever
    these means vary more than those of independent samples do (variance ratio: Lo & MacKinlay, Rev. Financ. Stud.
    1:41, 1988). The largest one counts; 1 for a white residual.

    - ``residual`` sequence of array (N_i, ny): records are not joined

    Examples
    --------
    >>> correlation_samples([np.random.default_rng(0).standard_normal((5000, 1))])
    1.0
    >>> bool(correlation_samples([np.sin(np.arange(5000) * 0.1)[:, None]]) > 1000)
    True
    """
    from scipy import special

    longest = 1.0
    for scale in SCALES:
        means = [part[: len(part) // scale * scale].reshape(-1, scale, part.shape[1]).mean(axis=1) for part in residual]
        count = sum(len(mean) for mean in means)
        if count < RUN_POLICY.means:
            break
        for column in range(residual[0].shape[1]):
            power = float(np.mean(np.concatenate([part[:, column] ** 2 for part in residual])))
            parts = [mean[:, column] for mean in means]
            size = float(np.mean(np.concatenate(parts) ** 2))
            white = 2 * special.gammaincinv(count / 2, 1 - RUN_POLICY.white_level)  # a quantile of chi-square
            if power > 0 and scale * size / power > white / count:
                longest = max([longest, *(scale * _squared(part) for part in parts if len(part) >= RUN_POLICY.means)])
    return longest


def _squared(series: FloatArray) -> float:
    """Return 1 + 2 sum of squared autocorrelations over half the length, what chance adds taken off."""
    n = len(series)
    spectrum = np.abs(np.fft.rfft(series, 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2 + 1]
    if not rho[0] > 0:
        return 1.0
    return max(1.0 + 2.0 * float(np.sum((rho[1:] / rho[0]) ** 2 - 1.0 / n)), 1.0)


def _blocks(
    lengths: Sequence[int], starts: Sequence[FloatArray], wanted: int
) -> list[tuple[int, int, FloatArray | None, int, int]]:
    """Return blocks of about equal length: first and last row, and the basis of their window with the rows in it.

    Long windows are cut, short ones put together; whole windows need no basis, for their initial states know nothing
    of the others.
    """
    size = max(sum(lengths) / wanted, 1.0)
    blocks: list[tuple[int, int, FloatArray | None, int, int]] = []
    begin = first = 0
    for number, length in enumerate(lengths):
        end = begin + length
        parts = max(round(length / size), 1)
        if parts > 1:
            if first < begin:
                blocks.append((first, begin, None, 0, 0))
            cuts = np.linspace(0, length, parts + 1).astype(int)
            start = starts[number] if number < len(starts) else None
            blocks += [(begin + a, begin + b, start, int(a), int(b)) for a, b in pairwise(cuts)]
            first = end
        elif end - first >= 0.75 * size or number + 1 == len(lengths):
            blocks.append((first, end, None, 0, 0))
            first = end
        begin = end
    return blocks


def _score(basis: FloatArray, start: FloatArray | None, r: FloatArray) -> FloatArray:
    """Return J_b' (I - H_bb)^-1 r_b in orthonormal directions of the parameters."""
    both = basis if start is None else np.hstack([basis, start])
    size, turn = np.linalg.eigh(np.eye(both.shape[1]) - both.T @ both)
    corrected = turn @ ((turn.T @ (both.T @ r)) / np.maximum(size, RUN_POLICY.determined))
    return np.asarray(corrected[: basis.shape[1]])
