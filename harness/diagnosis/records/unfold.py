"""Sensors that hide the sign: what the output was before they did, as a start for fits that no descent could reach.

A linear screen never sees such a sensor and no descent finds it, because the sign of the model is lost with that of
the data. So the output is unfolded first, and the refit also starts from a fit to the unfolded output.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.tracked_signs import BEAM, SignPath, fourth_difference, tracked
from harness.signals import FloatArray, Trajectory

HIDING = ("sensor_rectification",)
"""Effects on an output that hide its sign."""
PERIODS = np.geomspace(6.0, 120.0, 16)  # samples
DAMPING = (0.03, 0.08, 0.15, 0.3, 0.6, 0.9)
SLOW = np.geomspace(1.5, 60.0, 6)  # samples
TRIES = 8
_TURNS = 15
_LONGEST = 3000
"""Samples of a record up to which signs are looked for where its motion cannot be followed."""


@dataclass(frozen=True)
class Unfolding:
    """Signs of an output."""

    signs: tuple[FloatArray, ...]  # tuple of array (N_i,): Of every record
    chance: float
    """How likely an output that keeps its sign looks so: one half for each turn at zero, or, where the motion could be
    followed, how much less likely it is that it only turns there."""


_known: dict[tuple[int, int], list[Unfolding]] = {}
"""Of the records seen last: every refit of one diagnosis asks for the same."""


def unfoldings(runs: Sequence[Trajectory], column: int, *, most: int = 3) -> list[Unfolding]:
    """Return the likeliest signs of an output that never changes its sign, best first.

    - ``column``: which output
    - returns none if the output changes its sign, or never turns near zero

    Notes
    -----
    Where the sampling is fine enough the motion is followed through its zeros, see
    :func:`harness.diagnosis.records.tracked_signs.tracked`; there are two answers then: nobody knows the first sign.
    Of several paths through the zeros those are taken that answer the input alike in all records.
    Elsewhere, over a grid of poles (a real one and a complex pair) the free run of a linear model is linear in
    everything else, so the signs follow by turns with a least-squares fit, from several starts: error reduction by
    alternating projections (Fienup 1982, *Phase retrieval algorithms*, section II), here with a sign as the phase.
    This needs an input: a free swing of little damping is not unfolded by it.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1)
    >>> t = np.arange(300) * 0.1
    >>> u = np.sign(np.sin(0.9 * t) + np.sin(2.3 * t))
    >>> y = np.zeros(300)
    >>> for k in range(299):
    ...     y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
    >>> def run(y):
    ...     return Trajectory(t, u[:, None], y[:, None], spec)
    >>> found = unfoldings([run(np.abs(y))], 0)[0]
    >>> bool(abs(np.mean(found.signs[0] * np.sign(y))) > 0.9), unfoldings([run(y)], 0)
    (True, [])
    """
    key = column, hash(tuple(part.tobytes() for run in runs for part in (run.u, run.y[:, column])))
    if key not in _known:
        if len(_known) > 8:
            _known.clear()
        _known[key] = _unfolded(runs, column)
    return _known[key][:most]


def _unfolded(runs: Sequence[Trajectory], column: int) -> list[Unfolding]:
    """Return the likeliest signs, three at most."""
    whole = [np.asarray(run.y[:, column], dtype=float) for run in runs]
    size = float(np.sqrt(np.mean(np.concatenate(whole) ** 2)))
    if size == 0 or any(y.min() < -max(1e-3 * size, 5 * fourth_difference(y)) for y in whole):
        return []
    if not any(_low_turns(y, DATA_POLICY.near_zero * size) for y in whole):
        return []
    paths = [followed(y) for y in whole]
    if all(paths) and any(first.gain > 0 for first, *_ in paths):
        return _both_ways(runs, column, paths)
    if max(map(len, whole)) > _LONGEST:
        return []
    # records of different amplitude count alike
    weight = np.concatenate([np.full(len(y), 1.0 / max(np.sqrt(np.mean(y**2)), 1e-12 * size)) for y in whole])
    z = np.concatenate(whole) * weight
    rng = np.random.default_rng(0)
    tried: list[tuple[float, FloatArray]] = []
    for period in PERIODS:
        for damping in DAMPING:
            for slow in SLOW:
                columns = _responses(runs, 2 * np.pi / period, damping, slow) * weight[:, None]
                basis = np.linalg.qr(columns)[0]
                guess = rng.standard_normal((basis.shape[1], TRIES))
                signs = np.where(basis @ guess >= 0, 1.0, -1.0)
                for _ in range(_TURNS):
                    model = basis @ (basis.T @ (signs * z[:, None]))
                    following = np.where(model >= 0, 1.0, -1.0)
                    if np.array_equal(following, signs):
                        break
                    signs = following
                errors = np.sqrt(np.mean((np.abs(model) - z[:, None]) ** 2, axis=0))
                best = int(np.argmin(errors))
                tried.append((float(errors[best]), signs[:, best]))
    tried.sort(key=lambda trial: trial[0])
    cuts = np.cumsum([len(y) for y in whole])[:-1]
    likeliest = [tuple(np.split(signs, cuts)) for _, signs in tried[:3]]
    return [Unfolding(signs, 2.0 ** -min(_turns(signs), 1000)) for signs in likeliest]


def _turns(signs: Sequence[FloatArray]) -> int:
    """Return how often signs change."""
    return sum(int(np.count_nonzero(np.diff(part))) for part in signs)


def followed(y: FloatArray) -> tuple[SignPath, ...]:
    """Return the paths of an output (N,) that could be followed through its zeros, likeliest first, made once."""
    return _followed(y.tobytes())


@functools.lru_cache(maxsize=32)
def _followed(y: bytes) -> tuple[SignPath, ...]:
    return tracked(np.frombuffer(y))


def _both_ways(runs: Sequence[Trajectory], column: int, paths: Sequence[Sequence[SignPath]]) -> list[Unfolding]:
    """Return the signs of followed records and their opposite; all are turned to answer the input alike.

    Of their paths and senses the likeliest are taken, by the motion itself and by one ARX model of all records.
    """
    chosen = [_Choice((), 0.0, np.zeros((0, 0)), 0)]
    for number, (run, ways) in enumerate(zip(runs, paths, strict=True)):
        more = [
            choice.beside(sense * path.signs, path.gain, _regression(run, column, sense * path.signs))
            for path in ways
            for sense in ((1.0, -1.0) if number else (1.0,))
            for choice in chosen
        ]
        chosen = sorted(more, key=lambda choice: -choice.log_likelihood)[:BEAM]
    best = chosen[0]
    chance = float(np.exp(-min(best.gain, 700.0)))
    return [Unfolding(tuple(sense * part for part in best.signs), chance) for sense in (1.0, -1.0)]


@dataclass(frozen=True, eq=False)
class _Choice:
    """Signs of some records, how much likelier their motion makes them, and the products of their regression."""

    signs: tuple[FloatArray, ...]
    gain: float
    products: FloatArray
    samples: int

    def beside(self, signs: FloatArray, gain: float, regression: FloatArray) -> _Choice:
        """Return the choice with those of one more record."""
        products = regression.T @ regression + (self.products if self.samples else 0.0)
        return _Choice((*self.signs, signs), self.gain + gain, products, self.samples + len(regression))

    @property
    def log_likelihood(self) -> float:
        """Of the paths, and of the outputs under an ARX model with the noise that fits them best."""
        size = np.sqrt(np.maximum(np.diag(self.products), 1e-300))  # in any unit
        scaled = self.products / np.outer(size, size)
        told = scaled[:-1, -1] @ np.linalg.pinv(scaled[:-1, :-1], hermitian=True) @ scaled[:-1, -1]
        left = self.products[-1, -1] * (1.0 - told)
        return self.gain - 0.5 * self.samples * float(np.log(max(left, 1e-300)))


def _regression(run: Trajectory, column: int, signs: FloatArray) -> FloatArray:
    """Return regressors (4 outputs and 4 of each input before) of an ARX model of an unfolded record, and its output.

    Outputs before the last one enter by their differences, which are small beside it: their products stay exact.
    """
    y, n = np.asarray(run.y[: len(signs), column]) * signs, len(signs)
    past = [np.diff(y, order)[3 - order : n - 1 - order] for order in range(4)]
    past += [run.u[4 - lag : n - lag, port] for lag in range(1, 5) for port in range(run.u.shape[1])]
    return np.column_stack([*past, y[4:] - past[0]])


def _low_turns(y: FloatArray, level: float) -> int:
    """Return how often a record falls to a minimum below a level and rises again; where it stands still is no turn.

    Examples
    --------
    >>> _low_turns(np.array([0.0, 0.0, 0.0, 1.0, 2.0]), 0.5), _low_turns(np.array([2.0, 0.1, 0.1, 1.0]), 0.5)
    (0, 1)
    """
    moved = y[np.flatnonzero(np.diff(y, prepend=np.nan) != 0.0)]
    inside = (moved[1:-1] < moved[:-2]) & (moved[1:-1] < moved[2:]) & (moved[1:-1] < level)
    return int(np.count_nonzero(inside))


def _responses(records: Sequence[Trajectory], frequency: float, damping: float, slow: float) -> FloatArray:
    """Return what a linear model with these poles can do (N, k): by each input, by each initial state, a constant."""
    from scipy.signal import lfilter

    decay, pole = np.exp(-damping * frequency), np.exp(-1.0 / slow)
    pair = [1.0, -2 * decay * np.cos(frequency), decay * decay]
    total, nu = sum(len(run) for run in records), records[0].u.shape[1]
    forced = np.zeros((total, 3 * nu))
    free = np.zeros((total, 3 * len(records)))
    row = 0
    for number, run in enumerate(records):
        rows, k = slice(row, row + len(run)), np.arange(len(run))
        for j in range(nu):
            late = np.r_[0.0, run.u[:-1, j]]
            swing = lfilter([1.0], pair, late)
            parts = (lfilter([1.0], [1.0, -pole], late), swing, np.r_[0.0, swing[:-1]])
            forced[rows, 3 * j : 3 * j + 3] = np.column_stack(parts)
        fade = decay**k
        free[rows, 3 * number : 3 * number + 3] = np.column_stack(
            [pole**k, fade * np.cos(frequency * k), fade * np.sin(frequency * k)]
        )
        row += len(run)
    size = np.sqrt(np.mean(forced**2, axis=0))
    return np.column_stack([forced[:, size > 0] / size[size > 0], free, np.ones(total)])
