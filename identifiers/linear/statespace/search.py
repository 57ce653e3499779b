"""The search for the largest likelihood: Levenberg and Marquardt's method, initial states solved for in every step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.algebra import column_norms
from harness.signals import FloatArray
from identifiers.common.neighbours import steps_without
from identifiers.linear.statespace.model import Errors, Piece, StateSpace, coordinates, errors_of, gradients_of

EXACT = 1e-24  # Mean square of innovations, of outputs of size 1, that counts as rounding.
MEMORIES = 5.0
"""Time constants of the noise that a piece holds at least: a slower one would follow the record's chances."""
DAMPING = (1e-13, 1e-4, 1e8)  # Least, first and largest damping, of columns of length 1.
HOPE, BEGUN = 4.0, 3  # Times what a step foretells that a search may still gain, and steps before that is believed.
LOST = 1e-9  # Responses to the start that depend on others up to this share are none of their own.


@dataclass(frozen=True)
class Freedom:
    """What of a model is free."""

    direct: int = 0  # Inputs, the first ones, that have a direct term D
    offset: bool = True  # The level of each output
    radius: float = np.inf  # Largest modulus of a pole of the plant


@dataclass(frozen=True, eq=False)
class StateSpaceEnd:
    """Where a search ended: the model, the starts of the pieces (R, n), its errors and minus the log-likelihood."""

    model: StateSpace
    starts: FloatArray
    errors: list[Errors]
    loss: float
    arrived: bool

    @property
    def rms(self) -> FloatArray:
        """Of the innovations of each output (ny,)."""
        return np.sqrt(_squares(self.errors) / np.maximum(_rows(self.errors), 1))


def loss_of(errors: Sequence[Errors], floor: float = EXACT) -> float:
    """Return minus the logarithm of the likelihood, variances concentrated out, but for a constant.

    The first innovations, as many as the noise remembers, are not known; the others stand for them too, so that noises
    of different length compare.

    - ``floor``: mean square below which innovations are rounding
    """
    readings = sum(one.read for one in errors)
    with np.errstate(over="ignore", invalid="ignore"):
        found = float(np.sum(readings / 2 * np.log(_squares(errors) / np.maximum(_rows(errors), 1) + floor)))
    return found if np.isfinite(found) else np.inf


def settled_starts(model: StateSpace, pieces: Sequence[Piece], free: Freedom) -> StateSpaceEnd:
    """Return the model with the initial states, levels, B and D that suit its A and C best: a linear problem."""
    starts = np.zeros((len(pieces), model.order))
    errors = errors_of(model, starts, pieces)
    driven = np.eye(model.a.size + model.b.size + model.c.size)[:, model.a.size : model.a.size + model.b.size]
    system = _System.of(model, errors, pieces, driven, free, noise=False)
    step, moves = system.solved(0.0)
    model, starts = model.moved(step), starts + moves
    errors = errors_of(model, starts, pieces)
    return StateSpaceEnd(model, starts, errors, loss_of(errors), False)


def search(
    first: StateSpaceEnd,
    pieces: Sequence[Piece],
    free: Freedom,
    *,
    rounds: int = 60,
    gain: float = 1e-3,
    beat: float = np.inf,
) -> StateSpaceEnd:
    """Return the largest likelihood that is reached from a start.

    - ``first``: as :func:`settled_starts` makes it
    - ``gain``: of the log-likelihood in one step, below which the search has arrived
    - ``beat``: loss that is of use: a search that its own slopes give no hope of it ends where it is
    """
    longest = max(len(piece.u) for piece in pieces)
    furthest = min(1.0 + 1.0 / longest, free.radius)
    forgotten = max(1.0 - MEMORIES / longest, 0.5)
    now, damping = first, DAMPING[1]
    for number in range(rounds):
        system = _System.of(now.model, now.errors, pieces, coordinates(now.model), free)
        if number >= BEGUN and now.loss - HOPE * system.foretold > beat:
            return now
        gained = 0.0
        while damping < DAMPING[2]:
            step, moves = system.solved(damping)
            if np.isfinite(step).all():
                model = now.model.moved(step)
                if model.radius <= furthest and model.memory <= forgotten:
                    starts = now.starts + moves
                    errors = errors_of(model, starts, pieces)
                    loss = loss_of(errors)
                    if loss < now.loss:
                        gained = now.loss - loss
                        now = StateSpaceEnd(model, starts, errors, loss, False)
                        damping = max(damping / 10, DAMPING[0])
                        break
            damping *= 10
        if gained < gain:
            return StateSpaceEnd(now.model, now.starts, now.errors, now.loss, True)
        damping = min(damping, DAMPING[2] / 1e4)
    return now


def steps_of(end: StateSpaceEnd, pieces: Sequence[Piece], free: Freedom) -> FloatArray | None:
    """Return how the model moves (G, k) without one stretch of the records each, as for ``StateSpace.moved``."""
    directions = coordinates(end.model)
    blocks = [_weighed(end, piece, own, directions, free) for piece, own in zip(pieces, end.errors, strict=True)]
    gradients = np.concatenate([rows for rows, _ in blocks])
    moves = steps_without(gradients, np.concatenate([wrong for _, wrong in blocks]))
    if moves is None:
        return None
    q = directions.shape[1]
    return np.hstack([moves[:, :q] @ directions.T, moves[:, q:]])


@dataclass(frozen=True, eq=False)
class _System:
    """The linear equations of one step, initial states eliminated piece by piece."""

    triangle: FloatArray  # (q + 1, q + 1): Of slopes, of length 1, and innovations
    length: FloatArray  # (q,): Of the slopes before
    back: list[FloatArray]  # list of array (n, q + 1): What slopes and innovations ask of the start of each piece
    directions: FloatArray  # (m, r)

    @classmethod
    def of(
        cls,
        model: StateSpace,
        errors: Sequence[Errors],
        pieces: Sequence[Piece],
        directions: FloatArray,
        free: Freedom,
        *,
        noise: bool = True,
    ) -> _System:
        """Return the equations at a model."""
        weight = _weights(errors)
        parts, back = [], []
        for piece, own in zip(pieces, errors, strict=True):
            rows, answer = _eliminated(model, own, piece, directions, free, weight)
            if not noise:
                rows[:, rows.shape[1] - 1 - model.noise.size : -1] = 0.0
            parts.append(np.linalg.qr(rows, mode="r"))
            back.append(answer)
        triangle = np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"), dtype=np.float64)
        length = column_norms(triangle[:, :-1])
        return cls(np.column_stack([triangle[:, :-1] / length, triangle[:, -1]]), length, back, directions)

    @property
    def foretold(self) -> float:
        """What a whole step lowers the loss by where innovations are linear in the model."""
        left, values, _ = np.linalg.svd(self.triangle[:, :-1], full_matrices=False)
        seen = left[:, values > LOST * values.max(initial=0.0)].T @ self.triangle[:, -1]
        whole = float(self.triangle[:, -1] @ self.triangle[:, -1])
        return -whole / 2 * float(np.log(max(1.0 - float(seen @ seen) / max(whole, EXACT), EXACT)))

    def solved(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the step of the model and those of the starts (R, n)."""
        left, values, right = np.linalg.svd(self.triangle[:, :-1], full_matrices=False)
        seen = left.T @ self.triangle[:, -1]
        kept = values > LOST * values.max(initial=0.0)
        scale = np.where(kept, values / np.where(kept, values**2 + damping, 1.0), 0.0)
        move = -(right.T @ (scale * seen)) / self.length
        starts = np.array([-(answer[:, -1] + answer[:, :-1] @ move) for answer in self.back])
        q = self.directions.shape[1]
        return np.concatenate([self.directions @ move[:q], move[q:]]), starts


def _eliminated(
    model: StateSpace, errors: Errors, piece: Piece, directions: FloatArray, free: Freedom, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rows [slopes, innovation] of a piece at right angles to what its start does, and what they ask of it."""
    slopes, starts = gradients_of(model, errors, piece, directions, direct=free.direct, offset=free.offset)
    rows = np.concatenate([slopes, errors.innovations[:, :, None]], axis=2) * weight[:, None]
    rows, own = rows.reshape(-1, rows.shape[2]), (starts * weight[:, None]).reshape(-1, model.order)
    length = column_norms(own)
    left, values, right = np.linalg.svd(own / length, full_matrices=False)
    kept = values > LOST * values.max(initial=0.0)
    inner = left[:, kept].T @ rows
    return rows - left[:, kept] @ inner, (right[kept].T @ (inner / values[kept, None])) / length[:, None]


def _weighed(
    end: StateSpaceEnd, piece: Piece, errors: Errors, directions: FloatArray, free: Freedom
) -> tuple[FloatArray, FloatArray]:
    """Return slopes (N ny, q) and innovations (N ny,) of a piece in units of their noise, starts eliminated."""
    rows, _ = _eliminated(end.model, errors, piece, directions, free, _weights(end.errors))
    return rows[:, :-1], rows[:, -1]


def _weights(errors: Sequence[Errors]) -> FloatArray:
    """Return what every output's innovations are multiplied by (ny,)."""
    return 1.0 / np.sqrt(_squares(errors) / np.maximum(_rows(errors), 1) + EXACT)


def _squares(errors: Sequence[Errors]) -> FloatArray:
    return np.asarray(sum(np.sum(one.innovations**2, axis=0) for one in errors), dtype=np.float64)


def _rows(errors: Sequence[Errors]) -> FloatArray:
    return np.asarray(sum(one.counted.sum(axis=0) for one in errors), dtype=np.float64)
