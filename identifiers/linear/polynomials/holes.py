"""Prediction errors where readings are missing: their exact likelihood, as a sum of squares."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.signals import FloatArray
from identifiers.linear.polynomials.model import OutputRecord, Polynomials, errors_and_gradients, shifted

MOST = 200
"""Missing readings of a piece: beyond so many a record is cut, for a system of equations of that size is solved."""
LONG = 50  # Readings missing in a row that end a piece: what came before is forgotten, or as good as.
LOST = 1e-9  # What is left of a column beside missing readings, relative to its length, below which nothing is.

Starts = Sequence[tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class Misses:
    """Errors (N,) and gradients (N, k) of a model whose sum of squares is least where the likelihood is largest."""

    # Rows of missing readings count for nothing, or only for what their neighbours leave of them
    errors: FloatArray
    gradients: FloatArray
    rows: int  # Readings
    scale: float = 1.0
    """The errors are the innovations times this: ``scale**2`` is the geometric mean of their variances over that of a
    record without holes."""

    @property
    def cost(self) -> float:
        """Sum of squares, infinite where it is no number."""
        found = float(self.errors @ self.errors)
        return found if np.isfinite(found) else np.inf


def misses_of(model: Polynomials, starts: Starts, parts: Sequence[OutputRecord]) -> Misses:
    """Return prediction errors and gradients over all records, missing readings integrated out.

    The errors are linear in the missing readings, ``e = e0 + E m`` with E the impulse responses of ``A D / C``. What
    normal innovations make of the readings that there are is then ``sum min_m |e0 + E m|^2 / (2 s^2) + log det(E' E) /
    2 + n log s``: the likelihood of the Kalman filter that passes over what is missing (Harvey & Pierse 1984, J. Am.
    Stat. Assoc. 79:125), s concentrated out and written as a sum of squares with the determinant's root as a factor.

    - ``starts`` sequence of (X, Z): as of :func:`identifiers.linear.polynomials.model.errors_and_gradients`
    - ``parts``: what stands in y where a reading is missing decides nothing
    """
    errors, gradients = errors_and_gradients(model, starts, parts)
    total, missing = errors.size, sum(len(part.holes) for part in parts)
    if not missing:
        return Misses(errors, gradients, total)
    orders = model.orders
    if not (orders.na or orders.nc or orders.nd):  # noise that is white on the output: a reading touches one row
        gone = np.concatenate([np.array(part.holes, dtype=int) + first for first, part in _places(parts)])
        errors[gone], gradients[gone] = 0.0, 0.0
        return Misses(errors, gradients, total - missing)
    if not np.isfinite(errors).all():
        return Misses(errors, gradients, total - missing)
    bases, filled, volume, slopes = [], [], 0.0, np.zeros(gradients.shape[1])
    for first, part in _places(parts):
        basis, triangle = _basis(model, part)
        own = errors[first : first + part.y.size]
        y = part.y.copy()
        y[list(part.holes)] -= np.linalg.solve(triangle, basis.T @ own)
        filled.append(replace(part, y=y))
        bases.append(basis)
        volume += 2.0 * float(np.sum(np.log(np.abs(np.diag(triangle)))))
        slopes[: orders.count] += _slopes(model, part, basis, triangle)
    errors, gradients = errors_and_gradients(model, starts, filled)
    for (first, part), basis in zip(_places(parts), bases, strict=True):
        rows = slice(first, first + part.y.size)
        errors[rows] -= basis @ (basis.T @ errors[rows])
        before = np.linalg.norm(gradients[rows], axis=0)
        gradients[rows] -= basis @ (basis.T @ gradients[rows])
        gradients[rows, np.linalg.norm(gradients[rows], axis=0) <= LOST * before] = 0.0
    count = total - missing
    scale = float(np.exp(min(volume / (2 * count), 300.0)))
    errors = errors * scale
    return Misses(errors, gradients * scale + np.outer(errors, slopes / (2 * count)), count, scale)


def in_pieces(part: OutputRecord, *, at_once: bool) -> list[OutputRecord]:
    """Return a record cut where too much is missing for one system of equations; whole where none is needed.

    - ``at_once``: the noise is white on the output: nothing need be solved

    Examples
    --------
    >>> u, y = np.zeros((200, 1)), np.zeros(200)
    >>> [piece.y.size for piece in in_pieces(OutputRecord(u, y, tuple(range(80, 150))), at_once=False)]
    [80, 50]
    """
    if at_once or not part.holes:
        return [part]
    missing = np.zeros(part.y.size, dtype=bool)
    missing[list(part.holes)] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(int)))
    cut = [(int(low), int(high)) for low, high in zip(edges[::2], edges[1::2], strict=True) if high - low >= LONG]
    pieces, place = [], 0
    for low, high in [*cut, (part.y.size, part.y.size)]:
        start = place
        while start < low:
            holes = start + np.flatnonzero(missing[start:low])
            stop = low if holes.size <= MOST else int(holes[MOST])
            own = tuple(int(hole) - start for hole in holes if hole < stop)
            pieces.append(OutputRecord(part.u[start:stop], part.y[start:stop], own))
            start = stop
        place = high
    return [piece for piece in pieces if piece.y.size > len(piece.holes)]


def _places(parts: Sequence[OutputRecord]) -> Iterator[tuple[int, OutputRecord]]:
    """Yield the first row of every record, and the record."""
    place = 0
    for part in parts:
        yield place, part
        place += part.y.size


def _responses(model: Polynomials, n: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the impulse responses of ``A D / C``, ``D / C``, ``A / C`` and ``A D / C^2``."""
    from scipy.signal import lfilter

    pa, pc, pd = (np.concatenate([[1.0], p]) for p in (model.a, model.c, model.d))
    pulse = np.zeros(n)
    pulse[0] = 1.0
    whole = lfilter(np.convolve(pa, pd), pc, pulse)
    return whole, lfilter(pd, pc, pulse), lfilter(pa, pc, pulse), lfilter([1.0], pc, whole)


def _basis(model: Polynomials, part: OutputRecord) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis (N, m) of what missing readings do to the errors, and its triangle (m, m)."""
    whole = _responses(model, part.y.size)[0]
    columns = np.zeros((part.y.size, len(part.holes)))
    for j, hole in enumerate(part.holes):
        columns[:, j] = shifted(whole, hole)
    basis, triangle = np.linalg.qr(columns)
    return np.asarray(basis, dtype=np.float64), np.asarray(triangle, dtype=np.float64)


def _slopes(model: Polynomials, part: OutputRecord, basis: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the derivatives (p,) of ``log det(E' E)`` = ``2 tr (E' E)^-1 E' dE``."""
    orders, n, m = model.orders, part.y.size, len(part.holes)
    found = np.zeros(orders.count)
    if not m:
        return found
    weights = np.linalg.solve(triangle, basis.T)  # (E' E)^-1 E'
    ahead = np.zeros(n)
    for j, hole in enumerate(part.holes):
        ahead[: n - hole] += weights[j, hole:]
    _, of_a, of_d, of_c = _responses(model, n)
    first_c = orders.na + sum(orders.nb)
    for begin, count, response, sign in (
        (0, orders.na, of_a, 2.0),
        (first_c, orders.nc, of_c, -2.0),
        (first_c + orders.nc, orders.nd, of_d, 2.0),
    ):
        for j in range(count):
            found[begin + j] = sign * float(ahead @ shifted(response, j + 1))
    return found
