"""Models of one order after the other, each the best of several starts, and the order that Schwarz's rule prefers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.signals import FloatArray
from identifiers.linear.statespace.model import Piece, StateSpace, errors_of
from identifiers.linear.statespace.noise import MOST, noise_of
from identifiers.linear.statespace.search import Freedom, StateSpaceEnd, loss_of, search, settled_starts
from identifiers.linear.statespace.starts import filtered_model, long_models, reduced, without_each_mode

ORDERS = 10  # Largest order that is tried.
ASKED = 6  # Orders that are tried in any case: a plant may need two states more before the next one helps.
BEYOND = 4  # Orders beyond the best that end the ladder.
STARTS = 2  # Starts of an order that are followed: those of the largest likelihood before any search.
ROUGH, FINE = 1e-2, 1e-3
"""Gain of the log-likelihood in a step that ends a search: before the colour of the noise is known, and after."""
ROUNDS = 40  # Steps of a search of the ladder.
SLACK = 10.0
"""Log-likelihood that an order may gain over the larger ones, which may have ended in lesser maxima: with none of it
one of 40 data sets erred three times as much, with 5 none did."""
ROUNDING = 1e-14  # Mean square of innovations, of outputs of size 1, below which no order is better than another.


@dataclass(frozen=True, eq=False)
class Rung:
    """A model of some order, and what Schwarz's rule says of it (1978, Ann. Statist. 6:461): less is better.

    An initial state counts for one: what it lowers the loss by is chance, and no more becomes known of it in a longer
    record.
    """

    end: StateSpaceEnd
    judged: float


def ladder(
    pieces: Sequence[Piece],
    free: Freedom,
    orders: Sequence[int],
    *,
    noise: int = MOST,
    seen: Sequence[Piece] | None = None,
    rival: float = np.inf,
) -> dict[int, Rung]:
    """Return the models of some orders.

    Upwards each begins from reductions of long one-step models, then downwards from a larger one without one of its
    modes, whichever the likelihood misses least (what a reduction by size leaves out may be what the plant does, and
    what it keeps what the noise did), and from regressions on signals that its own poles, or those of the next smaller
    order, have filtered; what has the larger likelihood stays.

    - ``pieces``: outputs and inputs of size 1
    - ``noise``: length of the noise's autoregression, at most; 0 keeps it white
    - ``seen``: where the inputs of the pieces are inputs and outputs, the pieces with inputs alone: what is found is
      then the predictor of a model in innovation form
    - ``rival``: what Schwarz's rule says of the best model so far: searches that cannot come below end early
    """
    climb = _Climb(pieces, free, noise, rival)
    direct = free.direct > 0
    models = long_models(pieces if seen is None else seen, direct, predictor=seen is not None)
    longest = [reduced(model, orders) for model in models]
    for n in orders:
        climb.try_all(n, [one[n] for one in longest if n in one], STARTS)
        best = climb.best
        if len(orders) > 1 and n >= ASKED and best is not None and best <= n - BEYOND:
            break
    for n in sorted(climb.found, reverse=True):
        if not climb.hopeful(n):
            continue
        larger = [climb.found[m].end.model for m in (n + 1, n + 2) if m in climb.found]
        starts = [one for model in larger for one in without_each_mode(model) if one.order == n]
        for near in (n, n - 1) if seen is None else ():
            if near in climb.found and (again := filtered_model(climb.found[near].end.model, pieces, direct, n)):
                starts += reduced(again, [n]).values()
        climb.try_all(n, starts, STARTS)
    return climb.found


def finished(rung: Rung, pieces: Sequence[Piece], free: Freedom, *, gain: float = 1e-6, rival: float = np.inf) -> Rung:
    """Return the end of a search to the last digits, over pieces that may be more than the ladder saw.

    - ``gain``: as of :func:`identifiers.linear.statespace.search.search`
    - ``rival``: as of :func:`ladder`
    """
    first = settled_starts(rung.end.model, pieces, free)
    end = search(first, pieces, free, gain=gain, beat=rival - _price(first, pieces, free))
    return Rung(end, _judged(end, pieces, free))


def _judged(end: StateSpaceEnd, pieces: Sequence[Piece], free: Freedom) -> float:
    """Return what Schwarz's rule says."""
    return loss_of(end.errors, ROUNDING) + _price(end, pieces, free)


def _price(end: StateSpaceEnd, pieces: Sequence[Piece], free: Freedom) -> float:
    """Return what Schwarz's rule asks of a model for its parameters."""
    count = end.model.free(direct=free.direct, offset=free.offset)
    rows = sum(piece.y.size if piece.read is None else int(piece.read.sum()) for piece in pieces)
    rows = max(rows // pieces[0].y.shape[1], 2)
    return count / 2 * float(np.log(rows)) + end.starts.size


class _Climb:
    """The best model of every order so far."""

    def __init__(self, pieces: Sequence[Piece], free: Freedom, noise: int, rival: float) -> None:
        self.pieces, self.free, self.noise, self.rival = pieces, free, noise, rival
        self.found: dict[int, Rung] = {}

    @property
    def best(self) -> int | None:
        """Order that is judged best."""
        return min(self.found, key=lambda n: self.found[n].judged) if self.found else None

    @property
    def least(self) -> float:
        """What is to be beaten."""
        return min([self.rival, *(one.judged for one in self.found.values())])

    def hopeful(self, n: int) -> bool:
        """Return False where an order can be no better than the best: larger ones, which hold it, leave too much."""
        end, none = self.found[n].end, np.zeros((self.pieces[0].y.shape[1], 0))
        plain = replace(end, model=replace(end.model, noise=none))
        losses = [loss_of(one.end.errors, ROUNDING) for order, one in self.found.items() if order >= n]
        return min(losses) + _price(plain, self.pieces, self.free) <= self.least + SLACK

    def _fine(self, end: StateSpaceEnd) -> StateSpaceEnd:
        """Return the end of a search whose noise has its colour."""
        beat = self.least - _price(end, self.pieces, self.free)
        return search(end, self.pieces, self.free, rounds=ROUNDS, gain=FINE, beat=beat)

    def try_all(self, n: int, starts: Sequence[StateSpace], most: int) -> None:
        """Follow the most likely of the starts, and keep the end that is judged best."""
        firsts = [settled_starts(_inside(start), self.pieces, self.free) for start in starts]
        for first in sorted(firsts, key=lambda end: end.loss)[:most]:
            rung = self._followed(first)
            if np.isfinite(rung.judged) and (n not in self.found or rung.judged < self.found[n].judged):
                self.found[n] = rung

    def _followed(self, first: StateSpaceEnd) -> Rung:
        """Return where the search from a start ends, the noise coloured as what is left says."""
        if not self.noise:
            end = self._fine(first)
            return Rung(end, _judged(end, self.pieces, self.free))
        end = search(first, self.pieces, self.free, rounds=ROUNDS, gain=ROUGH)
        for _ in range(3):
            noise = noise_of(end.errors, self.pieces, self.noise)
            if noise.shape == end.model.noise.shape:
                break
            end = self._fine(self._coloured(end, noise))
        else:
            noise = end.model.noise
        if not end.model.noise.shape[1]:
            end = self._fine(end)
        return Rung(end, _judged(end, self.pieces, self.free))

    def _coloured(self, end: StateSpaceEnd, noise: FloatArray) -> StateSpaceEnd:
        """Return the same plant with another noise."""
        model = replace(end.model, noise=noise)
        errors = errors_of(model, end.starts, self.pieces)
        return StateSpaceEnd(model, end.starts, errors, loss_of(errors), False)


def _inside(model: StateSpace, radius: float = 0.998) -> StateSpace:
    """Return a start whose poles lie inside the unit circle."""
    own = model.radius
    return model if own <= radius else replace(model, a=model.a * (radius / own))
