"""Ellipsoids that a disturbed nonlinear loop cannot leave: found by linear programs, certified by Taylor models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from harness.signals import FloatArray
from identifiers.control.taylor_models import bounded

_POINTS = 1000  # Points of the boundary that a step looks at, beside those that were worst so far.
_ROWS, _KEPT, _POOL = 300, 200, 1500  # Points that enter a linear program, that are remembered of a step, and in all.

_STEPS, _LARGEST, _LEAST = 300, 0.3, 1e-3
"""Linear programs at most; largest and least relative change of the ellipsoid in one."""

_TRIES = 6  # Halvings of a step that is worse than foretold, and steps in a row that may fail.
_FAR = 100.0  # Penalty of an ellipsoid that reaches beyond what it may, relative to the logarithm of the disturbance.
_INSIDE = 0.95  # Squared distance of the start from the centre, in that of the boundary.
_FINEST = 1e-5  # Half width of a cell that is not halved any more: V' is 0 there for all that can be told.
_ASKED = 50  # Random points at which a symmetry is asked for.
_BATCH, _FIRST = 4096, 8  # Cells that are bounded together, and in how many parts each edge of a face is cut at first.


@dataclass(frozen=True, eq=False)
class Loop:
    """``x' = f(x, u)``, ``u = -K (x + d e)``: a feedback that reads the state with an error d in the direction e."""

    # Symbols (nx,), (nu,) of departures from the target, and f (nx,), affine in u
    x: Any
    u: Any
    rate: Any
    gain: FloatArray  # (nu, nx)
    error: FloatArray  # (nx,)

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.x.numel())

    @cached_property
    def slopes(self) -> Any:
        """The rate and its slopes by x and d, as a CasADi function of x and d."""
        import casadi as ca

        d = ca.SX.sym("d")
        closed = ca.substitute(self.rate, self.u, -ca.DM(self.gain) @ (self.x + d * ca.DM(self.error)))
        parts = [ca.densify(ca.jacobian(closed, one)) for one in (self.x, d)]
        return ca.Function("slopes", [self.x, d], [ca.densify(closed), *parts], {"cse": True})

    def at(self, points: FloatArray, d: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the rate (n, nx) and its slopes (n, nx, nx), (n, nx) at points (n, nx)."""
        n, nx = points.shape
        values, by_x, by_d = self.slopes.map(n)(points.T, np.full((1, n), d))
        return values.full().T, by_x.full().reshape(nx, n, nx).transpose(1, 0, 2), by_d.full().T

    @cached_property
    def odd(self) -> bool:
        """Whether f(-x, -u) = -f(x, u), as of a mechanism that is symmetric about its target: asked at random points.

        Analytic functions that agree at random points agree but with probability 0; rounding hides 1e-9 of their size.
        """
        import casadi as ca

        f = ca.Function("f", [self.x, self.u], [self.rate])
        points = np.random.default_rng(0).normal(size=(_ASKED, self.nx + int(self.u.numel())))
        there, mirrored = (
            f.map(_ASKED)(sign * points[:, : self.nx].T, sign * points[:, self.nx :].T).full() for sign in (1.0, -1.0)
        )
        return bool(np.abs(there + mirrored).max() <= 1e-9 * np.abs(there).max())

    @cached_property
    def face(self) -> Any:
        """V' on a face of the cube about the unit ball, as a CasADi function.

        Of w (nx - 1), the face (nx, nx), L (nx, nx), M = inv(L') (nx, nx), the centre, and the input at the centre and
        its change with z, -K M: written so, the large entries of K cancel before anything is bounded.
        """
        import casadi as ca

        nx, nu = self.nx, int(self.u.numel())
        w, turn = ca.SX.sym("w", nx - 1), ca.SX.sym("turn", nx, nx)
        lower, back, centre = ca.SX.sym("L", nx, nx), ca.SX.sym("M", nx, nx), ca.SX.sym("c", nx)
        hold, change = ca.SX.sym("u0", nu), ca.SX.sym("k", nu, nx)
        z = turn @ ca.vertcat(1, w) / ca.sqrt(1 + ca.sumsqr(w))
        rate = ca.Function("f", [self.x, self.u], [self.rate])(centre + back @ z, hold + change @ z)
        falls = 2 * ca.dot(z, lower.T @ rate)
        return ca.Function("falls", [w, turn, lower, back, centre, hold, change], [falls], {"cse": True})


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """``|L'(x - c)| <= 1``, which no disturbance d between two numbers makes x leave."""

    lower: FloatArray  # (nx, nx): L, triangular
    centre: FloatArray  # (nx,)
    # Least and largest d
    low: float
    high: float

    @property
    def half_widths(self) -> FloatArray:
        """Largest departure of each state from the centre (nx,)."""
        return np.asarray(np.sqrt(np.sum(np.linalg.inv(self.lower) ** 2, axis=0)))


def widened(
    loop: Loop, first: Ellipsoid, *, moving: bool, margin: float, within: FloatArray, rng: np.random.Generator
) -> Ellipsoid:
    """Return an ellipsoid through whose boundary no flow leads out, for disturbances as large as can be found.

    A sequence of linear programs: shape, centre and disturbance are changed a little so that ``V' <= -margin`` holds
    on points of the boundary, to first order, while the disturbance grows. Whether it holds between the points is not
    known (:func:`certified`).

    - ``first``: where to begin; about the target, which it must go on to contain
    - ``moving``: whether the centre may move: for a disturbance of one sign, constant. Else d has both signs, and may
      change.
    - ``margin``: relative to V = 1 on the boundary [1/s]
    - ``within`` (nx,): largest departure of each state from the target; infinite where it may be any
    """
    from scipy.optimize import linprog

    nx = loop.nx
    upper = np.triu_indices(nx)
    count = len(upper[0])
    now, reach, failed = first, 0.1, 0
    pool = np.zeros((0, nx))
    for _ in range(_STEPS):
        points = np.vstack([_sphere(nx, _POINTS, rng), pool])
        falls, slopes, where = _boundary(loop, now, points)
        worst = np.argsort(-falls)[:_ROWS]
        pool = np.unique(np.vstack([where[worst[:_KEPT]], pool])[:_POOL], axis=0)
        start = -now.lower.T @ now.centre
        contain = np.concatenate(
            [2 * start[upper[0]] * start[upper[1]] * np.where(upper[0] == upper[1], 1.0, 2.0), -2 * start, [0.0]]
        )
        worth = _worth(now, falls, within, margin)
        better: Ellipsoid | None = None
        for _ in range(_TRIES):
            shift = reach if moving else 0.0
            found = linprog(
                np.r_[np.zeros(count + nx), -1.0 / now.high, 100.0],
                A_ub=np.vstack([np.hstack([slopes[worst], -np.ones((len(worst), 1))]), np.append(contain, -1.0)]),
                b_ub=np.append(-margin - falls[worst], _INSIDE - start @ start),
                bounds=[(-reach, reach)] * count + [(-shift, shift)] * nx
                + [(-reach * now.high, 2 * reach * now.high), (0, None)],
            )  # fmt: skip
            if found.status == 0:
                new = _changed(now, np.asarray(found.x, dtype=np.float64), upper)
                seen = _boundary(loop, new, np.vstack([_sphere(nx, _POINTS // 3, rng), points]))[0]
                if _worth(new, seen, within, margin) < worth - 1e-5:
                    better = new
                    break
            reach *= 0.5
        if better is None:
            failed, reach = failed + 1, 0.05
            if failed == _TRIES:
                break
            continue
        failed, now, reach = 0, better, min(1.5 * reach, _LARGEST)
        if reach < _LEAST:
            break
    return now


@dataclass(frozen=True)
class Certificate:
    """What intervals prove of an ellipsoid."""

    holds: bool  # Whether ``V' < 0`` on all of its boundary
    cells: int  # Pieces of the boundary that were looked at


def certified(loop: Loop, ellipsoid: Ellipsoid, *, most: int = 2_000_000) -> Certificate:
    """Return whether no flow leads out of an ellipsoid: a proof, but for the assumption that sines are exact to 64 ulp.

    Every face of the cube about the unit ball is cut into cells; over each V' is enclosed by a quadratic Taylor model.
    Cells that do not show ``V' < 0`` are halved where it changes most. As V' is affine in d, its ends are enough.

    - ``most``: cells after which it gives up: not certified
    """
    nx = loop.nx
    back: FloatArray = np.asarray(np.linalg.inv(ellipsoid.lower.T), dtype=np.float64)
    # An inverse is not exact: the ellipsoid that is meant is the one of M; its L is known but for an error.
    known = [_inverse(back), _exact(back), _exact(ellipsoid.centre)]
    # Where f is odd, the two ends of d see each other's faces in the mirror.
    mirrored = loop.odd and ellipsoid.low == -ellipsoid.high and not ellipsoid.centre.any()
    seen = 0
    for d in sorted({ellipsoid.low, ellipsoid.high}):
        there, size = ellipsoid.centre + d * loop.error, np.abs(ellipsoid.centre) + np.abs(d * loop.error)
        pushed = [_product(-loop.gain, there[:, None], size[:, None]), _product(-loop.gain, back, np.abs(back))]
        for axis in range(nx):
            for sign in (1.0,) if mirrored else (1.0, -1.0):
                turn = np.zeros((nx, nx))
                turn[axis, 0] = sign
                turn[[k for k in range(nx) if k != axis], range(1, nx)] = 1.0
                middle, half = _grid(nx - 1)
                while len(middle):
                    take, middle = middle[-_BATCH:], middle[:-_BATCH]
                    wide, half = half[-_BATCH:], half[:-_BATCH]
                    seen += len(take)
                    if wide.min() < _FINEST:
                        return Certificate(False, seen)
                    with np.errstate(over="ignore", invalid="ignore"):  # what a large cell has no bound of is undecided
                        found = bounded(loop.face, take, wide, _exact(turn), *known, *pushed)
                    if seen > most or np.any(found.constant - found.error >= 0):
                        return Certificate(False, seen)
                    undecided = ~(found.most() < 0)
                    if undecided.any():
                        change = np.abs(found.slope) + np.abs(found.bend).sum(axis=2)
                        # where the remainder is what is large, no slope says which edge makes it so: the longest
                        told = found.error < change.sum(axis=1)
                        axes = np.argmax(np.where(told[:, None], change, wide), axis=1)
                        two = _halved(take[undecided], wide[undecided], axes[undecided])
                        middle, half = np.vstack([middle, two[0]]), np.vstack([half, two[1]])
    return Certificate(True, seen)


def _grid(dimension: int) -> tuple[FloatArray, FloatArray]:
    """Return middles and half widths of the cells that cut a face at first."""
    edges = (np.arange(_FIRST) + 0.5) * 2 / _FIRST - 1
    middle = np.stack(np.meshgrid(*[edges] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    return middle, np.full_like(middle, 1.0 / _FIRST)


def _halved(middle: FloatArray, half: FloatArray, axis: Any) -> tuple[FloatArray, FloatArray]:
    rows = np.arange(len(middle))
    half = half.copy()
    half[rows, axis] *= 0.5
    step = np.zeros_like(middle)
    step[rows, axis] = half[rows, axis]
    return np.vstack([middle - step, middle + step]), np.vstack([half, half])


def _exact(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return numbers by columns, and that they are not off."""
    column = np.asarray(values, dtype=float).ravel(order="F")
    return column, np.zeros_like(column)


def _product(left: FloatArray, right: FloatArray, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a product of matrices, and what rounding can do to factors of this size."""
    off = 4 * len(right) * np.finfo(float).eps * np.abs(left) @ size
    return np.ravel(left @ right, order="F"), np.ravel(off, order="F")


def _inverse(back: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L = inv(M)' and how far each entry may be off: Neumann's series of the residual."""
    near, n = np.linalg.inv(back), len(back)
    rounding = 4 * n * np.finfo(float).eps * np.abs(near) @ np.abs(back)
    miss = float((np.abs(np.eye(n) - near @ back) + rounding).sum(axis=1).max())
    off = miss / (1.0 - miss) * float(np.abs(near).sum(axis=0).max()) if miss < 1 else np.inf
    return np.asarray(near.T.ravel(order="F"), dtype=np.float64), np.full(n * n, off)


def _sphere(nx: int, count: int, rng: np.random.Generator) -> FloatArray:
    z = rng.normal(size=(count, nx))
    return np.asarray(z / np.linalg.norm(z, axis=1)[:, None])


def _worth(one: Ellipsoid, falls: FloatArray, within: FloatArray, margin: float) -> float:
    """Return what is to be small: minus the logarithm of the disturbance, and penalties."""
    start = one.lower.T @ one.centre
    far = float(np.max((np.abs(one.centre) + one.half_widths) / within))
    wrong = max(float(falls.max()) + margin, 0.0) + max(float(start @ start) - _INSIDE, 0.0)
    return float(-np.log(one.high) + 2 * wrong + _FAR * max(far - 1.0, 0.0))


def _changed(one: Ellipsoid, by: FloatArray, upper: Sequence[Any]) -> Ellipsoid:
    nx = len(one.centre)
    count = len(upper[0])
    shape = np.zeros((nx, nx))
    shape[upper[0], upper[1]] = by[:count]
    shape = shape + shape.T - np.diag(np.diag(shape))
    turned = (np.eye(nx) + shape) @ one.lower.T
    centre = one.centre + np.linalg.solve(one.lower.T, by[count : count + nx])
    high = one.high + float(by[count + nx])
    return replace(
        one, lower=np.asarray(np.linalg.cholesky(turned.T @ turned), dtype=np.float64), centre=centre, high=high,
        low=high if one.low > 0 else -high,
    )  # fmt: skip


def _boundary(loop: Loop, one: Ellipsoid, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return V' at points of the boundary for both ends of d, its slopes by shape, centre and d, and the points."""
    nx = loop.nx
    upper = np.triu_indices(nx)
    back = np.linalg.inv(one.lower.T)
    places = one.centre + points @ back.T
    falls, slopes = [], []
    for end in sorted({one.low, one.high}):
        values, by_x, by_d = loop.at(places, end)
        seen = values @ one.lower
        falls.append(2 * np.sum(points * seen, axis=1))
        moved = 2 * np.einsum("ni,nij->nj", points @ one.lower.T, by_x) @ back
        shape = 2 * points[:, :, None] * seen[:, None, :] - moved[:, :, None] * points[:, None, :]
        shape = shape + np.swapaxes(shape, 1, 2)
        flat = shape[:, upper[0], upper[1]] * np.where(upper[0] == upper[1], 0.5, 1.0)
        size = 2 * np.sign(end) * np.sum(points * (by_d @ one.lower), axis=1)
        slopes.append(np.hstack([flat, moved, size[:, None]]))
    return np.concatenate(falls), np.concatenate(slopes), np.vstack([points] * len(falls))
