"""The search for the least prediction error: Levenberg and Marquardt's method, initial states free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.algebra import column_norms, divisor
from harness.signals import FloatArray
from identifiers.linear.polynomials.holes import Misses, misses_of
from identifiers.linear.polynomials.model import OutputRecord, Polynomials

# Relative gain of the loss below which the search has arrived, and rounds after which it gives up.
_ARRIVED, _ROUNDS = 1e-9, 60
# Time constants of C and D that a record holds at least.
_MEMORIES = 5.0


@dataclass(frozen=True, eq=False)
class End:
    """Where a search ended: the model, its errors and gradients, and whether it arrived."""

    model: Polynomials
    misses: Misses
    arrived: bool

    @property
    def cost(self) -> float:
        """Sum of squares; infinite where no model is allowed."""
        return self.misses.cost if self.misses.gradients.size else np.inf


def best(ends: Sequence[End]) -> End:
    """Return the end of least cost."""
    return min(ends, key=lambda end: end.cost)


def needed(end: End, parts: Sequence[OutputRecord], offset: bool) -> End:
    """Return the end of a search with a noise model, or the same without one where its gain is chance.

    Without noise that is coloured C and D may be any common factor: at the edge of the unit circle it follows the
    record's slow chances by its free start, and foretells nothing.
    """
    none, model, orders = np.zeros(0), end.model, end.model.orders
    quiet = replace(model, orders=replace(orders, nc=0, nd=0), c=none, d=none)
    plain = search(quiet, parts, offset)
    rows, free = end.misses.rows, orders.nc + orders.nd + len(parts) * orders.start_z
    if rows * np.log(plain.cost / max(end.cost, 1e-300)) > free * np.log(rows):  # Schwarz 1978
        return end
    blank = replace(plain.model, orders=orders, c=np.zeros(orders.nc), d=np.zeros(orders.nd))
    return search(blank, parts, offset, rounds=0)


def settled_inside(coefficients: FloatArray, radius: float = 0.98) -> FloatArray:
    """Return a polynomial with its roots outside the unit circle mirrored, and none beyond the radius."""
    if not coefficients.size:
        return coefficients
    roots = np.roots(np.concatenate([[1.0], coefficients]))
    moduli = np.abs(roots)
    roots = np.where(moduli > 1.0, roots / divisor(moduli) ** 2, roots)
    moduli = np.abs(roots)
    roots = np.where(moduli > radius, roots / divisor(moduli) * radius, roots)
    return np.pad(np.real(np.poly(roots))[1:], (0, coefficients.size - roots.size))


def search(
    first: Polynomials, parts: Sequence[OutputRecord], offset: bool, radius: float = np.inf, rounds: int = _ROUNDS
) -> End:
    """Return the least sum of squares that is reached, where, errors and gradients there, and whether it has arrived.

    No model with a pole beyond the radius is taken, and no noise model that remembers the start through the record:
    with the free start it would fit the record's slow chances.

    - ``first``: where the search begins
    - ``offset``: the level is free
    - ``rounds``: 0 evaluates the start, its initial states solved for
    """
    orders = first.orders
    count, nx, nz = orders.count, orders.start_x, orders.start_z
    # An integrator is a root at 1: over a record its free run may grow by so much.
    longest = max(part.y.size for part in parts)
    furthest, forgotten = 1.0 + 1.0 / longest, max(1.0 - _MEMORIES / longest, 0.5)

    def evaluated(vector: FloatArray) -> Misses | None:
        model = Polynomials.of(vector, orders)
        states = vector[count:].reshape(len(parts), nx + nz)
        of_f, of_c, of_d = model.radii
        if of_f > furthest or max(of_c, of_d) > forgotten or model.slowest > radius:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            found = misses_of(model, [(row[:nx], row[nx:]) for row in states], parts)
        if not offset:
            found.gradients[:, count - 1] = 0.0
        return found if np.isfinite(found.cost) else None

    first = _allowed(first, furthest, forgotten)
    vector = np.concatenate([first.vector, np.zeros(len(parts) * (nx + nz))])
    now = evaluated(vector)
    if now is None:  # no start of a model that is allowed
        return End(first, Misses(np.zeros(0), np.zeros((0, 0)), 1), False)
    # The initial states are linear in the errors: solve for them first.
    if now.gradients.shape[1] > count:
        vector[count:] -= np.linalg.lstsq(now.gradients[:, count:], now.errors, rcond=1e-9)[0]
        now = evaluated(vector) or now
    damping, arrived = 1e-3, rounds == 0
    power = float(np.sum(np.concatenate([part.y for part in parts]) ** 2))
    for _ in range(rounds):
        length = column_norms(now.gradients)
        slopes = now.gradients / length
        gram, right = slopes.T @ slopes, slopes.T @ now.errors
        gained = 0.0
        while damping < 1e8:
            move = np.linalg.solve(gram + damping * np.eye(len(gram)), -right) / length
            then = evaluated(vector + move)
            if then is not None and then.cost < now.cost:
                gained = now.cost - then.cost
                vector, now = vector + move, then
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        if gained <= _ARRIVED * now.cost or now.cost <= 1e-20 * power:
            arrived = True
            break
        damping = min(damping, 1e6)
    return End(Polynomials.of(vector, orders), now, arrived)


def _allowed(first: Polynomials, furthest: float, forgotten: float) -> Polynomials:
    """Return a start that the search allows."""
    if max(first.radii[1:]) > forgotten:  # well inside: roots that meet are known to a root of rounding
        inner = 0.99 * forgotten
        first = replace(first, c=settled_inside(first.c, inner), d=settled_inside(first.d, inner))
    if first.radii[0] > furthest:
        first = replace(first, f=tuple(map(settled_inside, first.f)))
    return first
