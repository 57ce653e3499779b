"""Bounds on responses and on what is realised from them, given the inputs of the record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.models.spread import Matrices, Spread, gains
from harness.signals import FloatArray, Trajectory
from identifiers.common.normal import NormalEquations
from identifiers.linear.markov import normal_equations, sums_without

_FREQUENCIES = 64  # Points of the half circle on which gains are taken.
_DRAWS = 1000
_PIECES = 256  # Samples of a segment of a spectrum.


@dataclass(frozen=True, eq=False)
class Responses:
    """Least squares of so many lags: how wrong it may be at worst, and how wrong it is."""

    markov: FloatArray  # (L, ny, nu): ``markov[0]`` is that of the same sample
    # On the largest gain over all frequencies of the error: bound, and 95 % of what leaving out stretches shows
    gain: float
    measured_gain: float
    # On the largest singular value of [G_0 G_1 ... G_L-1]: bound, and measured.
    block: float
    measured_block: float
    rows: int  # Windows


@dataclass(frozen=True, eq=False)
class LagsKnown:
    """How well the inputs of a record tell the lags of a response, whatever their spectrum.

    Given the inputs the error ``(P' P)^-1 P' v`` of least squares is Gaussian with a covariance of at most ``S (P'
    P)^-1``, S the largest spectral density of what the inputs do not explain. The norm of such a matrix exceeds
    ``sqrt(ny) + sqrt(columns) + t`` times its scale with probability ``exp(-t^2 / 2)`` (Davidson & Szarek 2001, theorem
    II.13). So the rate ``sqrt(L / N)`` of Oymak & Ozay 2019, *ACC*, theorem 3.1, has its constants from the record; no
    input need be white.
    """

    inverse: FloatArray  # (L, nu, L, nu): of P' P without the means
    least: float  # The least eigenvalue of P' P

    @classmethod
    def of(cls, sums: NormalEquations, length: int, nu: int) -> LagsKnown | None:
        """Return it from equations of lags and a constant; none where the inputs do not excite so many lags."""
        gram = sums.gram[:-1, :-1] - np.outer(sums.gram[:-1, -1], sums.gram[-1, :-1]) / sums.gram[-1, -1]
        size = np.sqrt(np.clip(np.diag(gram), 1e-300, None))  # the units of the inputs decide nothing
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        if values[0] <= 1e-10 * values[-1]:
            return None
        inverse = (vectors / values) @ vectors.T / np.outer(size, size)
        return cls(inverse.reshape(length, nu, length, nu), 1.0 / float(np.linalg.eigvalsh(inverse)[-1]))

    def density(self, rest: FloatArray, records: int) -> float:
        """Return the largest spectral density of what the inputs of one of several records do not explain (N, ny)."""
        from scipy.signal import welch

        taken = self.inverse.shape[0] * self.inverse.shape[1] / records
        lost = len(rest) / max(len(rest) - taken, 1.0)  # what the fit took of the noise
        return float(lost * welch(rest, nperseg=min(_PIECES, len(rest)), axis=0)[1].max() / 2.0)

    def gain_bound(self, density: float, ny: int, confidence: float) -> float:
        """Return the bound on the largest gain over all frequencies of the error."""
        length, nu = self.inverse.shape[:2]
        waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, _FREQUENCIES), np.arange(length)))
        through = np.einsum("fl,lamb,fm->fab", waves.conj(), self.inverse, waves, optimize=True)
        scale = float(np.sqrt(density * np.linalg.eigvalsh(through)[:, -1].max()))
        # a complex Gaussian matrix: real and imaginary part each half of it
        t = np.sqrt(2.0 * np.log(_FREQUENCIES / (1.0 - confidence)))
        return float(scale * (np.sqrt(ny) + np.sqrt(nu) + t))


def responses(
    records: Sequence[Trajectory], length: int, confidence: float, rng: np.random.Generator
) -> Responses | None:
    """Return bounds on Markov parameters by least squares, in open loop.

    What :class:`LagsKnown` says of these inputs, and what leaving out stretches shows.

    - ``length``: L; the response must have died away by then
    - ``rng``: for draws of the measured error
    - returns None where the inputs do not excite so many lags

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=(2000, 1))
    >>> y = np.convolve(u[:, 0], 0.5 ** np.arange(10))[:2000, None] + 0.1 * rng.normal(size=(2000, 1))
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> found = responses([Trajectory(np.arange(2000.0), u, y, spec)], 12, 0.95, rng)
    >>> 1.0 < found.gain / found.measured_gain < 4.0
    True
    """
    from scipy.signal import fftconvolve

    spec = records[0].spec
    ny, nu = spec.ny, spec.nu
    records = [record for record in records if len(record) > length]
    sums = normal_equations(records, length, offset=True) if records else None
    if sums is None or sums.rows < 2 * length * nu:
        return None
    known = LagsKnown.of(sums, length, nu)
    if known is None:
        return None
    theta = np.linalg.lstsq(sums.gram, sums.right, rcond=None)[0]
    markov, level = theta[:-1].reshape(length, nu, ny).transpose(0, 2, 1), theta[-1]
    density = 0.0
    for record in records:
        rest = record.y - level
        for j in range(nu):
            rest = rest - fftconvolve(record.u[:, j : j + 1], markov[:, :, j], axes=0)[: len(record)]
        density = max(density, known.density(rest[length - 1 :], len(records)))
    waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, _FREQUENCIES), np.arange(length)))
    gain = known.gain_bound(density, ny, confidence)
    t = np.sqrt(2.0 * np.log(1.0 / (1.0 - confidence)))
    block = float(np.sqrt(density / known.least)) * (np.sqrt(ny) + np.sqrt(length * nu) + t)
    near = []
    for part in sums_without(records, length, offset=True):
        other = np.linalg.lstsq(part.gram, part.right, rcond=None)[0]
        near.append(other[:-1].reshape(length, nu, ny).transpose(0, 2, 1) - markov)
    away = np.array(near) if near else np.zeros((0, length, ny, nu))
    factor = (len(near) - 1) / max(len(near), 1)

    def of_gain(drawn: FloatArray) -> float:
        return float(np.linalg.norm(np.einsum("fl,lyu->fyu", waves, drawn), ord=2, axis=(1, 2)).max())

    def of_block(drawn: FloatArray) -> float:
        return float(np.linalg.norm(drawn.transpose(1, 0, 2).reshape(ny, -1), ord=2))

    measured = [_drawn_quantile(away, factor, of, confidence, rng) for of in (of_gain, of_block)]
    return Responses(np.asarray(markov, dtype=np.float64), gain, measured[0], block, measured[1], sums.rows)


def norm_of_spread(matrices: Matrices, spread: Spread, confidence: float, rng: np.random.Generator) -> float:
    """Return what the largest gain over all frequencies of a model's error stays below, by its neighbours."""
    frequency = np.linspace(0.0, 0.5, _FREQUENCIES)
    middle = gains(matrices, frequency, 1.0)
    away = np.array([gains(one, frequency, 1.0) - middle for one in spread.models])

    def of(drawn: FloatArray) -> float:
        return float(np.linalg.norm(drawn, ord=2, axis=(1, 2)).max())

    return _drawn_quantile(away, spread.factor, of, confidence, rng)


def realisation_bound(markov: FloatArray, order: int, block: float) -> tuple[float, float]:
    """Return how wrong A of a balanced realisation may be, and the share of the condition under which that is known.

    With H of T x (T + 1) blocks of ``G_1, G_2, ...``, L its best approximation of rank n, and an error of at most e of
    [G]: ``|L - L'| <= 2 sqrt(T) e``; if that is at most half of the least singular value s of L, then up to a rotation
    ``|A - A'|_F <= 14 sqrt(n) / s (sqrt(|L - L'| / s) |H+| + sqrt(T) e)``, H+ the shifted matrix (Oymak & Ozay 2019,
    *ACC*, lemma 4.2 and theorem 4.3).

    - ``markov`` (L, ny, nu): with the direct term
    - ``block``: bound on the error of [G_0 G_1 ...]

    - returns ``bound``: infinite where the condition fails
    - returns ``share``: ``|L - L'|`` over s / 2: above 1 the theorem says nothing, and a record that many times as
      long, squared, would make it speak

    Examples
    --------
    >>> markov = np.concatenate([[0.0], 0.5 ** np.arange(20)])[:, None, None]
    >>> bound, share = realisation_bound(markov, 1, 1e-6)
    >>> bool(bound < 0.1), bool(share < 1)
    (True, True)
    >>> realisation_bound(markov, 1, 1.0)[0]
    inf
    """
    length, _, nu = markov.shape
    half = (length - 1) // 2
    whole = np.block([[markov[1 + i + j] for j in range(half + 1)] for i in range(length - 1 - half)])
    first, later = whole[:, : half * nu], whole[:, nu:]
    values = np.linalg.svd(first, compute_uv=False)
    if order > values.size or not values[order - 1] > 0:
        return float("inf"), float("inf")
    least = float(values[order - 1])
    root = np.sqrt(min(half, length - 1 - half))
    wrong = 2.0 * root * block
    share = wrong / (least / 2.0)
    if share > 1.0:
        return float("inf"), float(share)
    size = float(np.linalg.norm(later, ord=2))
    return float(14.0 * np.sqrt(order) / least * (np.sqrt(wrong / least) * size + root * block)), float(share)


def realisation_spread(
    markov: FloatArray,
    near: Sequence[FloatArray],
    order: int,
    factor: float,
    confidence: float,
    rng: np.random.Generator,
) -> float:
    """Return what the Frobenius norm of the error of A stays below, up to a rotation, by responses near the estimate.

    - ``markov, near`` array (L, ny, nu), and others
    - ``factor``: of the covariance of what is near
    """
    from identifiers.linear.ho_kalman import realize

    a, b, c, _ = realize(markov[1:], order=order)
    away = []
    for one in near:
        other, into, out, _ = realize(one[1:], order=order)
        left, _, right = np.linalg.svd(np.vstack([c, b.T]).T @ np.vstack([out, into.T]))
        turn = left @ right
        away.append(turn @ other @ turn.T - a)
    return _drawn_quantile(np.array(away), factor, lambda drawn: float(np.linalg.norm(drawn)), confidence, rng)


def _drawn_quantile(
    away: FloatArray, factor: float, of: Callable[[Any], float], confidence: float, rng: np.random.Generator
) -> float:
    """Return the quantile of a norm over draws of an error whose covariance is that of neighbours (G, ...)."""
    count = len(away)
    if count < 2:
        return float("nan")
    weights = rng.standard_normal((_DRAWS, count)) * np.sqrt(factor)
    weights *= np.sqrt((count - 1) / rng.chisquare(count - 1, _DRAWS))[:, None]
    sizes = [of(np.tensordot(row, away, axes=1)) for row in weights]
    return float(np.quantile(sizes, confidence))
