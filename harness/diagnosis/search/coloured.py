"""Coloured errors: a stationary autoregressive error where rows are missing, and one that is read through noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.signals import FloatArray

STEEPEST = 0.999
"""Largest partial autocorrelation: nearer to 1 an error is a drift without end."""
LONGEST = 2000
"""Rows after which an error is forgotten."""
LEAST = 1e-9
"""Smallest deviation of an error over its rms."""
_LASTS, _NOISE = (-0.5, 0.0, 0.9), (0.0, 0.5, 0.9, 0.99)
"""Partial autocorrelations that an error read through noise is begun from."""


@dataclass(frozen=True, eq=False)
class Before:
    """For every row that counts, the rows that count before it.

    Attributes
    ----------
    rows : array of int (n,)
        Those that count.
    place : array of int (n, order)
        Where in ``rows`` the last ones before each stand, the nearest first; -1 where there is none.
    lags : array of int (kinds, order)
        Different patterns of distances, 0 where there is none.
    kind : array of int (n,)
        The pattern of every row.
    """

    rows: np.ndarray
    place: np.ndarray
    lags: np.ndarray
    kind: np.ndarray

    @classmethod
    def of(cls, counts: FloatArray, order: int) -> Before:
        """Return the rows before each row that counts (N,), not 0."""
        rows = np.flatnonzero(counts)
        place = np.arange(len(rows))[:, None] - 1 - np.arange(order)
        place = np.where(place < 0, -1, place)
        lags = np.where(place < 0, 0, rows[:, None] - rows[place] if len(rows) else 0)
        lags = np.where(lags > LONGEST, 0, lags)  # all behind a gap that long are forgotten with it
        patterns, kind = np.unique(lags, axis=0, return_inverse=True)
        return cls(rows, place, patterns.reshape(-1, order), np.asarray(kind).reshape(-1))


@dataclass(frozen=True, eq=False)
class Coloured:
    """A stationary Gaussian autoregressive error.

    Attributes
    ----------
    partial : array (order,)
        Partial autocorrelations, which determine the coefficients (Barndorff-Nielsen & Schou 1973, J. Multivar. Anal.
        3:408).
    deviation : float
        Of the error.
    """

    partial: FloatArray
    deviation: float

    @property
    def coefficients(self) -> FloatArray:
        """Return the coefficients of the recursion (order,), by Levinson's.

        Examples
        --------
        >>> Coloured(np.array([0.5, 0.0]), 1.0).coefficients.tolist()
        [0.5, 0.0]
        """
        phi = np.zeros(0)
        for partial in self.partial:
            phi = np.append(phi - partial * phi[::-1], partial)
        return phi

    @property
    def memory(self) -> float:
        """Rows after which the slowest part of the error has fallen to 1/e; infinite where rounding hides the end.

        Examples
        --------
        >>> round(Coloured(np.array([0.99]), 1.0).memory)
        99
        """
        radius = float(np.max(np.abs(np.roots([1.0, *-self.coefficients])), initial=0.0))
        if radius >= 1.0:  # several poles near 1: their places are known to a fourth root of rounding
            return float("inf")
        return -1.0 / float(np.log(radius)) if radius > 0 else 0.0

    def correlation(self, most: int) -> FloatArray:
        """Return the autocorrelation up to a lag (most + 1,)."""
        order, phi = len(self.partial), self.coefficients
        rho = np.zeros(max(most, order) + 1)
        rho[0], short = 1.0, np.zeros(0)
        for k, partial in enumerate(self.partial):  # Durbin-Levinson, read backwards
            variance = float(np.prod(1.0 - self.partial[:k] ** 2))
            rho[k + 1] = partial * variance + short @ rho[k:0:-1]
            short = np.append(short - partial * short[::-1], partial)
        for k in range(order + 1, len(rho)):
            rho[k] = phi @ rho[k - order : k][::-1]
        return rho[: most + 1]

    def weights(self, before: Before) -> tuple[FloatArray, FloatArray]:
        """Return for every pattern the weights of the rows before (kinds, order), and the deviation that is left."""
        lags = before.lags
        rho = self.correlation(int(lags.max(initial=0)))
        there = lags > 0
        apart = np.abs(lags[:, :, None] - lags[:, None, :])
        both = there[:, :, None] & there[:, None, :]
        matrix = np.where(both, rho[np.minimum(apart, len(rho) - 1)], np.eye(lags.shape[1]))
        matrix = matrix + 1e-10 * np.eye(lags.shape[1])
        vector = np.where(there, rho[lags], 0.0)
        weights = np.linalg.solve(matrix, vector[..., None])[..., 0]
        left = np.maximum(1.0 - np.sum(weights * vector, axis=1), 1e-9)
        return weights, self.deviation * np.sqrt(left)

    def whitened(self, values: FloatArray, before: Before) -> FloatArray:
        """Return values (N, ...) less what the rows before say of them, over the deviation that is left (n, ...).

        Every row is taken given the ``order`` rows before it that count (Vecchia 1988, J. R. Stat. Soc. B 50:297):
        exact where none is missing, and for order 1 always.

        Examples
        --------
        >>> error = Coloured(np.array([0.8]), 2.0)
        >>> rng = np.random.default_rng(0)
        >>> e = np.zeros(20000)
        >>> for k in range(1, 20000):
        ...     e[k] = 0.8 * e[k - 1] + 1.2 * rng.standard_normal()
        >>> white = error.whitened(e, Before.of(np.ones(20000), 1))
        >>> round(float(white.std()), 1), round(float(np.corrcoef(white[1:], white[:-1])[0, 1]), 1) + 0.0
        (1.0, 0.0)
        """
        return self._both(values, before)[0]

    def _both(self, values: FloatArray, before: Before) -> tuple[FloatArray, FloatArray]:
        """Return whitened values, and the deviation (n,) that is left of every row."""
        weights, left = self.weights(before)
        chosen, left = values[before.rows], left[before.kind]
        shape = (-1, *([1] * (values.ndim - 1)))
        result = chosen.copy()
        for k in range(weights.shape[1]):
            result -= weights[before.kind, k].reshape(shape) * chosen[before.place[:, k]]
        return result / left.reshape(shape), left

    def innovations(self, values: FloatArray, before: Before) -> tuple[FloatArray, FloatArray]:
        """Return what of every row that counts the rows before it do not tell (n,), and its variance (n,)."""
        white, left = self._both(values, before)
        return white * left, left**2


def fitted_error(
    values: list[FloatArray], before: list[Before], order: int, floor: float, start: Coloured | None = None
) -> Coloured:
    """Return the likeliest autoregressive error of some records.

    Parameters
    ----------
    values : list of array (N_i,)
    before : list of Before
    order : int
    floor : float
        Smallest deviation.
    start : Coloured, optional
        Where to start from, if that is likelier than what Burg's recursion finds.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> e = np.zeros(4000)
    >>> for k in range(1, 4000):
    ...     e[k] = 0.7 * e[k - 1] + rng.standard_normal()
    >>> keep = rng.random(4000) > 0.2
    >>> error = fitted_error([e], [Before.of(keep.astype(float), 2)], 2, 1e-9)
    >>> bool(abs(error.partial[0] - 0.7) < 0.05 and abs(error.deviation - 1.4) < 0.1)
    True
    """
    from scipy.optimize import minimize

    count = sum(len(record.rows) for record in before)

    def of(z: FloatArray) -> tuple[float, float]:
        trial = Coloured(STEEPEST * np.tanh(z), 1.0)
        power, logs = 0.0, 0.0
        for error, rows in zip(values, before, strict=True):
            white, left = trial._both(error, rows)
            power += float(white @ white)
            logs += float(np.sum(np.log(left)))
        deviation = max(float(np.sqrt(power / max(count, 1))), floor)
        return 0.5 * power / deviation**2 + count * np.log(deviation) + logs, deviation

    starts = [burg(values, before, order), *([] if start is None else [start.partial])]
    z0 = min((np.arctanh(np.clip(partial / STEEPEST, -0.9999, 0.9999)) for partial in starts), key=lambda z: of(z)[0])
    descend: Any = minimize
    end = descend(
        lambda z: of(z)[0], z0, method="L-BFGS-B", bounds=[(-4.95, 4.95)] * order,
        options={"maxiter": 40, "ftol": 1e-7},
    )  # fmt: skip
    z = end.x if of(end.x)[0] <= of(z0)[0] else z0  # near a drift without end a descent may overshoot
    return Coloured(STEEPEST * np.tanh(z), of(z)[1])


def burg(values: list[FloatArray], before: list[Before], order: int) -> FloatArray:
    """Return partial autocorrelations (order,) by Burg's recursion, gaps closed (Burg 1975, thesis, Stanford).

    Examples
    --------
    >>> e = np.cos(0.1 * np.arange(500))
    >>> burg([e], [Before.of(np.ones(500), 2)], 2).round(2).tolist()
    [0.99, -1.0]
    """
    forward = [error[rows.rows] for error, rows in zip(values, before, strict=True)]
    backward, partial = [error.copy() for error in forward], np.zeros(order)
    for k in range(order):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True)]
        power = sum(float(f @ f + b @ b) for f, b in pairs)
        partial[k] = 2 * sum(float(f @ b) for f, b in pairs) / power if power > 0 else 0.0
        forward = [f - partial[k] * b for f, b in pairs]
        backward = [b - partial[k] * f for f, b in pairs]
    return partial


def coloured_likelihood(errors: Mapping[str, Sequence[tuple[FloatArray, FloatArray]]], order: int) -> dict[str, float]:
    """Return the log-likelihood of errors by use beside one that remembers, read through noise.

    What nobody modelled lasts, or wanders off, and readings of it have noise that is new with every sample: an
    integrated ARMA process (Box & Jenkins 1976, *Time Series Analysis*, sec. 4.1), half of its coefficients for either.
    An autoregression alone would need long ones for that. The process is that of the estimation records.

    Parameters
    ----------
    errors : mapping
        By use, for each record errors (N, ny), NaN where a reading is missing, and their variances.
    order : int
        Coefficients of both kinds.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> drift = np.cumsum(rng.standard_normal(3000))[:, None]
    >>> noise = 10.0 * rng.standard_normal((3000, 1))
    >>> slow, both = ({use: [(e, np.ones((3000, 1)))] for use in ("estimation", "validation")} for e in
    ...               (drift, drift + noise))
    >>> [round(coloured_likelihood(one, 4)["validation"] / 3000, 1) for one in (slow, both)]
    [-0.5, -2.8]
    """
    total = dict.fromkeys(errors, 0.0)
    for output in range(errors["estimation"][0][0].shape[1]):
        values = {use: [error[:, output] for error, _ in records] for use, records in errors.items()}
        process = Remembering.of(values["estimation"], order // 2)
        for use, records in values.items():
            total[use] += process.log_likelihood(records)
    return total


@dataclass(frozen=True, eq=False)
class Remembering:
    """An error that remembers, and may wander without end, read through noise: an integrated ARMA process.

    Attributes
    ----------
    lasts : array (order - 1,)
        Partial autocorrelations of its changes.
    noise : array (order,)
        The like of what noise makes of them.
    deviation : float
        Of its innovations.
    """

    lasts: FloatArray
    noise: FloatArray
    deviation: float = 1.0

    @classmethod
    def of(cls, records: Sequence[FloatArray], order: int) -> Remembering:
        """Return the likeliest process of some records (N_i,), NaN where nothing was read."""
        from scipy.optimize import minimize

        filled, read = _side_by_side(records)
        count = max(int(read.sum()), 1)
        floor = LEAST * float(np.sqrt(np.sum((filled * read) ** 2) / count)) + 1e-150  # its square is no 0

        def made(z: FloatArray) -> Remembering:
            process = cls(np.tanh(z[: order - 1]), np.tanh(z[order - 1 :]))
            power = float(np.sum(process._white(filled, read) ** 2))
            return replace(process, deviation=max(float(np.sqrt(power / count)), floor))

        starts = []
        for lasts, noise in product(_LASTS, _NOISE):
            partial = np.zeros(2 * order - 1)
            partial[order - 1], partial[: order - 1][:1] = noise, lasts
            starts.append(np.arctanh(partial))
        descend: Any = minimize
        steepest = float(np.arctanh(STEEPEST))
        ends = [
            descend(
                lambda z: count * np.log(made(z).deviation), z, method="L-BFGS-B",
                bounds=[(-steepest, steepest)] * len(z), options={"maxiter": 40, "ftol": 1e-6},
            ).x
            for z in sorted(starts, key=lambda z: made(z).deviation)[: EFFORT.descents]
        ]  # fmt: skip
        return min(map(made, [*starts, *ends]), key=lambda process: process.deviation)

    def log_likelihood(self, records: Sequence[FloatArray]) -> float:
        """Return the log-likelihood of some records (N_i,)."""
        filled, read = _side_by_side(records)
        power = float(np.sum(self._white(filled, read) ** 2))
        return -0.5 * power / self.deviation**2 - int(read.sum()) * float(np.log(self.deviation))

    def _white(self, filled: FloatArray, read: FloatArray) -> FloatArray:
        """Return what the rows before do not tell of every row (records, N), 0 where nothing was read.

        Before a record the error stood still, where it makes these least.
        """
        from scipy.signal import lfilter, lfilter_zi

        changes, noise = (np.append(1.0, -Coloured(one, 1.0).coefficients) for one in (self.lasts, self.noise))
        past = np.convolve(changes, (1.0, -1.0))
        white = lfilter(past, noise, filled) * read
        stood = lfilter(past, noise, np.zeros(filled.shape[1]), zi=lfilter_zi(past, noise))[0] * read
        level = np.sum(stood * white, axis=1) / np.maximum(np.sum(stood**2, axis=1), 1e-300)
        return np.asarray(white - stood * level[:, None])


def _side_by_side(records: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return records (n, N) with a line across what is missing, and 1 where something was read, else 0."""
    longest = max(map(len, records), default=1)
    filled, read = np.zeros((len(records), longest)), np.zeros((len(records), longest))
    for row, record in enumerate(records):
        there = np.isfinite(record)
        read[row, : len(record)] = there
        if there.any():
            rows = np.arange(len(record))
            filled[row, : len(record)] = record if there.all() else np.interp(rows, rows[there], record[there])
    return filled, read
