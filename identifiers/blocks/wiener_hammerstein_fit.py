"""How a Wiener-Hammerstein model is fitted: from the best linear approximation, its poles and zeros shared out."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from harness.models.damped import Damping, damped_descent
from harness.signals import FloatArray
from identifiers.blocks.curve import Knots

RADIUS = 0.9995  # No pole may lie further out.
_PROBE, _DEGREE, _MOST = 8000, 5, 4096
"""Samples and degree of the polynomial by which ways to share out are compared, and how many of these at most."""
_RARE = 1e-3  # Share of the samples beyond either end of the knots: fewer would not tell how the curve goes on.
_KEPT = 4  # Ways that are fitted further.
BENDS = (1.0, 0.1, 0.01, 0.001)
"""Standard deviations that are believed of a bend of the curve between knots, in units of the range of its values.
Held-out samples choose; the last leaves a straight line."""
HELD = 2 / 3  # Of every record that is fitted to choose, the rest held out.
Pair = tuple[FloatArray, FloatArray]  # Input and output (N,) of a record, scaled.


@dataclass(frozen=True, eq=False)
class Blocks:
    """``x_j = B1_j/A1 u``, ``w_j = f(x_j)``, ``y = sum of B2_j/A2 w_j``; A1 and A2 begin with 1.

    One row of ``b1`` and ``b2`` is the usual model. More of them let the curve act between the samples too: ``x_j`` is
    the inner signal at one of several points of a sample interval, as a linear filter of the input tells it, so that
    what the curve makes above half the sample rate, and the back block takes away again, need not fold back.

    Parameters
    ----------
    b1, b2 : array (r, n)
        Polynomials in the delay.
    a1, a2 : array (n,)
    curve : array (count,)
        Coefficients of f over the knots.
    knots : Knots
    """

    b1: FloatArray
    a1: FloatArray
    b2: FloatArray
    a2: FloatArray
    curve: FloatArray
    knots: Knots

    def outputs(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x and w (r, N) and y (N,) from rest."""
        x = np.array([lfilter(b, self.a1, u) for b in self.b1])
        w = self.knots.values(self.curve, x)
        return x, w, np.sum([lfilter(b, self.a2, one) for b, one in zip(self.b2, w, strict=True)], axis=0)

    def stable(self) -> bool:
        """Return True if every pole is within :data:`RADIUS`."""
        return all(np.abs(np.roots(a)).max(initial=0.0) < RADIUS for a in (self.a1, self.a2))

    def gradients(self, u: FloatArray, first: int) -> tuple[FloatArray, FloatArray]:
        """Return y (N,) and its derivatives (N, p) by b1, a1, b2 from ``first`` on, a2 and the curve."""
        x, w, y = self.outputs(u)
        poles, zeros = len(self.a1) - 1, self.b1.shape[1]
        driven = list(_delayed(lfilter([1.0], self.a1, u), range(zeros)))
        front: list[FloatArray] = []
        back: list[FloatArray] = []
        shared = np.zeros((poles + len(self.curve), len(u)))
        for b, inner, outer in zip(self.b2, x, w, strict=True):
            slope = self.knots.slopes(self.curve, inner)
            moved = [slope * one for one in driven]
            moved += [-slope * one for one in _delayed(lfilter([1.0], self.a1, inner), range(1, poles + 1))]
            through = lfilter(b, self.a2, np.array(moved + list(self.knots.basis(inner).T)), axis=-1)
            front += list(through[:zeros])
            shared += through[zeros:]
            back += _delayed(lfilter([1.0], self.a2, outer), range(first, len(b)))
        back += [-one for one in _delayed(lfilter([1.0], self.a2, y), range(1, len(self.a2)))]
        return y, np.column_stack([*front, *shared[:poles], *back, *shared[poles:]])

    def moved(self, by: FloatArray, first: int) -> Blocks:
        """Return the blocks with their parameters changed."""
        points, width = self.b2.shape
        sizes = (self.b1.size, len(self.a1) - 1, points * (width - first), len(self.a2) - 1, len(self.curve))
        b1, a1, b2, a2, curve = np.split(by, np.cumsum(sizes)[:-1])
        kept = self.b2[:, first:] + b2.reshape(points, width - first)
        return Blocks(
            self.b1 + b1.reshape(self.b1.shape),
            np.concatenate([[1.0], self.a1[1:] + a1]),
            np.hstack([np.zeros((points, first)), kept]),
            np.concatenate([[1.0], self.a2[1:] + a2]),
            self.curve + curve,
            self.knots,
        )

    def between(self, points: int) -> Blocks:
        """Return blocks whose curve acts at several points of a sample interval, to descend from.

        The inner signal is interpolated linearly between a sample and the one before, and the back block takes the mean
        over the points.

        Examples
        --------
        >>> one = Blocks(np.ones((1, 1)), np.ones(1), np.ones((1, 1)), np.ones(1), np.ones(4), Knots(-1.0, 1.0, 4))
        >>> one.between(2).b1.tolist(), one.between(2).b2.tolist()
        ([[1.0, 0.0], [0.5, 0.5]], [[0.5, 0.0], [0.5, 0.0]])
        """
        parts = np.arange(points) / points
        b1 = np.array([np.convolve(self.b1[0], [1.0 - part, part]) for part in parts])
        return replace(self, b1=b1, b2=np.tile(np.append(self.b2[0], 0.0) / points, (points, 1)))


def shared_out(b: FloatArray, f: FloatArray, records: Sequence[Pair], count: int, first: int) -> list[Blocks]:
    """Return blocks to start from: the poles and zeros of a linear model B/F shared out in the best few ways.

    Each way is judged by a polynomial between the blocks, fitted by least squares (Sjoberg & Schoukens 2012,
    *Initializing Wiener-Hammerstein models based on partitioning of the best linear approximation*, Automatica 48, with
    the curve fitted for every way instead of after a scan).

    - ``b, f``: polynomials in the delay; ``b`` without its first ``first`` coefficients, which are 0
    - ``records`` sequence of (u, y)
    - ``count``: basis functions of the curve
    - ``first``: samples by which the output lags the input at least, 0 or 1; the back block carries them
    """
    pairs = [(u[:_PROBE], y[:_PROBE]) for u, y in records]
    judged: list[tuple[float, int, Pair, Pair]] = []
    for front, back in itertools.islice(_ways(b, f, first), _MOST):
        error = _polynomial_error(front, back, pairs)
        if np.isfinite(error):
            judged.append((error, len(judged), front, back))
    judged.sort(key=lambda one: one[:2])
    return [_started(front, back, records, count) for _, _, front, back in judged[:_KEPT]]


def bend_held_out(start: Blocks, records: Sequence[Pair], first: int, rounds: int) -> float:
    """Return the one of :data:`BENDS` with which the ends of records, held out, are best foretold.

    A plant that bends elsewhere than in one curve pulls the ends of the curve, where samples are rare, to any value.
    """

    def foretold(bend: float) -> float:
        blocks, _ = descended(start, [(u[: int(HELD * len(u))], y[: int(HELD * len(u))]) for u, y in records], first,
                              rounds, bend)  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):
            wrong = [(y - blocks.outputs(u)[2])[int(HELD * len(u)) :] for u, y in records]
        if not all(np.isfinite(one).all() for one in wrong):
            return np.inf
        return float(np.mean([np.mean(_apart(one, blocks.a2) ** 2) for one in wrong]))

    return min(BENDS, key=foretold)


def descended(start: Blocks, records: Sequence[Pair], first: int, rounds: int, bend: float) -> tuple[Blocks, float]:
    """Return the blocks from which no damped step lowers the free-run error, and its root mean square.

    Bends of the curve are believed to be small beforehand (``bend``, of :data:`BENDS`; Eilers & Marx 1996,
    *Statistical Science* 11:89): without that its ends follow the noise of a few samples.
    """

    def errors(blocks: Blocks) -> float:
        if not blocks.stable():
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            parts = [np.mean(_settled(y - blocks.outputs(u)[2], blocks.a2) ** 2) for u, y in records]
        cost = float(np.mean(parts))
        return cost if np.isfinite(cost) else np.inf

    weights = _bends(start, records, errors(start), bend)

    def cost(blocks: Blocks) -> float:
        return errors(blocks) + float(blocks.curve @ weights @ blocks.curve)

    def normal(blocks: Blocks) -> tuple[FloatArray, FloatArray] | None:
        parts = []
        for u, y in records:
            modelled, columns = blocks.gradients(u, first)
            own = slice(columns.shape[1] - len(blocks.curve) - len(blocks.a2) + 1, columns.shape[1] - len(blocks.curve))
            columns[:, own] += _free_slopes(blocks.a2, y - modelled)
            rows = _settled(columns, blocks.a2)
            parts.append((rows.T @ rows / len(rows), rows.T @ _settled(y - modelled, blocks.a2) / len(rows)))
        gram, right = (np.mean(part, axis=0) for part in zip(*parts, strict=True))
        gram[-len(weights) :, -len(weights) :] += weights
        right[-len(weights) :] -= weights @ blocks.curve
        return gram, right

    def step(blocks: Blocks, system: tuple[FloatArray, FloatArray], damp: float) -> Blocks:
        gram, right = system
        size = np.diag(gram)
        ridge = np.diag(damp * np.maximum(size, 1e-12 * size.max()))
        return blocks.moved(np.asarray(np.linalg.solve(gram + ridge, right), dtype=np.float64), first)

    found = damped_descent(start, cost, normal, step, Damping(start=1e-4, enough=1e-8, rounds=rounds, most=1e8))
    return found, float(np.sqrt(errors(found)))


def _bends(blocks: Blocks, records: Sequence[Pair], error: float, bend: float) -> FloatArray:
    """Return the matrix (count, count) of the cost of bends beside a mean square error, for blocks with that error."""
    inner = np.concatenate([blocks.outputs(u)[1].ravel() for u, _ in records])
    low, high = np.quantile(inner, [0.05, 0.95])
    second = np.diff(np.eye(len(blocks.curve)), 2, axis=0) / max(bend * float(high - low), 1e-12)
    count = sum(len(u) - _start(len(u)) for u, _ in records)
    return np.asarray(second.T @ second * (error / count if np.isfinite(error) else 0.0))


def _settled(values: FloatArray, poles: FloatArray) -> FloatArray:
    """Return what comes after the start of a record, less the free response of the back block to a state unknown then.

    The curve would make that response otherwise, by what it does to the few largest inputs of the start.
    """
    return _apart(values[_start(len(values)) :], poles)


def _apart(values: FloatArray, poles: FloatArray) -> FloatArray:
    """Return values less the free response of 1/A that is in them."""
    basis = np.linalg.qr(_free(poles, len(values)))[0]
    return np.asarray(values - basis @ (basis.T @ values))


def _start(count: int) -> int:
    """Return how many samples of a record its unknown state spoils: the front block's, which bends, is left out."""
    return min(count // 8, 1000)


def _free(poles: FloatArray, count: int) -> FloatArray:
    """Return the free responses (count, n) of 1/A."""
    impulse = np.zeros(count)
    impulse[:1] = 1.0
    return np.column_stack([np.zeros((count, 0)), *_delayed(lfilter([1.0], poles, impulse), range(len(poles) - 1))])


def _free_slopes(poles: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the derivatives (N, n) by the coefficients of A of the free response that is in errors (N,)."""
    first = _start(len(errors))
    free = _free(poles, len(errors) - first)
    response = free @ np.linalg.lstsq(free, errors[first:])[0]
    found = np.zeros((len(errors), free.shape[1]))
    for k, column in enumerate(_delayed(lfilter([1.0], poles, response), range(1, len(poles)))):
        found[first:, k] = -column
    return found


def _delayed(values: FloatArray, delays: Sequence[int]) -> Iterator[FloatArray]:
    """Yield a signal delayed by some samples."""
    for delay in delays:
        yield np.concatenate([np.zeros(delay), values[: len(values) - delay]])


def _ways(b: FloatArray, f: FloatArray, first: int) -> Iterator[tuple[Pair, Pair]]:
    """Yield front (b, a) and back (b, a) for every way to share out, neither with more zeros than poles.

    Equal real poles of two blocks show in a linear model as a complex pair, so pairs are taken apart as well.
    """
    roots, zeros = np.roots(f), _groups(np.roots(b))
    roots = roots * np.minimum(RADIUS**2 / np.maximum(np.abs(roots), 1e-300), 1.0)
    apart = np.clip(np.real(roots) + np.imag(roots), -(RADIUS**2), RADIUS**2)
    yield from _shares(_groups(roots), zeros, first)
    if np.any(np.imag(roots)):
        yield from _shares(_groups(apart), zeros, first)


def _shares(poles: list[list[complex]], zeros: list[list[complex]], first: int) -> Iterator[tuple[Pair, Pair]]:
    """Yield the ways to share out groups of poles and zeros."""
    for chosen in itertools.product((False, True), repeat=len(poles)):
        a1, a2 = _polynomial(poles, chosen), _polynomial(poles, [not one for one in chosen])
        for of_zeros in itertools.product((False, True), repeat=len(zeros)):
            b1, b2 = _polynomial(zeros, of_zeros), _polynomial(zeros, [not one for one in of_zeros])
            if len(b1) <= len(a1) and len(b2) + first <= max(len(a2), 1 + first):
                yield (b1, a1), (np.concatenate([np.zeros(first), b2]), a2)


def _groups(roots: Any) -> list[list[complex]]:
    """Return real roots alone and complex ones with their conjugates."""
    found: list[list[complex]] = []
    for root in sorted(map(complex, roots), key=lambda one: (one.real, abs(one.imag))):
        if abs(root.imag) < 1e-9 * max(abs(root), 1e-9):
            found.append([root.real])
        elif root.imag > 0:
            found.append([root, root.conjugate()])
    return found


def _polynomial(groups: Sequence[Sequence[complex]], chosen: Sequence[bool]) -> FloatArray:
    """Return the polynomial in the delay with some groups of roots."""
    roots = [root for group, take in zip(groups, chosen, strict=True) if take for root in group]
    return np.real(np.poly(roots)) if roots else np.ones(1)


def _polynomial_error(front: Pair, back: Pair, records: Sequence[Pair]) -> float:
    """Return the relative error of a polynomial between two blocks."""
    total = []
    for u, y in records:
        x = lfilter(*front, u)
        size = float(x.std())
        if not (np.isfinite(size) and size > 0.0):
            return np.inf
        powers = np.power.outer(np.clip(x / size, -8.0, 8.0), np.arange(_DEGREE + 1)).T
        columns = _settled(lfilter(*back, powers, axis=-1).T, back[1])
        if not np.isfinite(columns).all():
            return np.inf
        goal = _settled(y, back[1])
        wrong = goal - columns @ np.linalg.lstsq(columns, goal)[0]
        total.append(float(np.mean(wrong**2)))
    return float(np.mean(total))


def _started(front: Pair, back: Pair, records: Sequence[Pair], count: int) -> Blocks:
    """Return blocks whose inner signal has unit size, with the curve of least squares over their knots."""
    inner = np.concatenate([lfilter(*front, u) for u, _ in records])
    size = float(inner.std())
    low, high = np.quantile(inner, [_RARE, 1.0 - _RARE]) / size
    knots = Knots(float(low), float(high), count)
    blocks = Blocks(front[0][None] / size, front[1], back[0][None], back[1], np.zeros(count), knots)
    gram, right = np.zeros((count, count)), np.zeros(count)
    for u, y in records:
        columns = _settled(lfilter(*back, knots.basis(lfilter(blocks.b1[0], blocks.a1, u)), axis=0), blocks.a2)
        gram += columns.T @ columns / len(columns)
        right += columns.T @ _settled(y, blocks.a2) / len(columns)
    ridge = 1e-8 * np.trace(gram) / count * np.eye(count)
    started = replace(blocks, curve=np.linalg.solve(gram + ridge, right))
    variance = float(np.mean([np.mean(_settled(y, blocks.a2) ** 2) for _, y in records]))
    bends = len(records) * _bends(started, records, variance, BENDS[0])
    return replace(blocks, curve=np.linalg.solve(gram + ridge + bends, right))
