"""Inputs of a motion from a linear model along it: by least squares, by Riccati recursion, within limits by ADMM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray
from identifiers.linear.iterative import TimeVarying

_ITERATIONS = 4000  # Iterations of ADMM at most; some hundreds are usual.
_CLOSE = 1e-7  # ADMM stops where both residuals are below this, relative to the largest input.
_REVIEWED = 50  # Iterations between two looks at the penalty.
_BALANCED = 10.0  # The penalty is changed where one residual is so many times the other (Boyd et al. 2011, sec. 3.4.1).


@dataclass(frozen=True, eq=False)
class Limits:
    """What an actuator can do, as departures from the input at the operating point."""

    # (nu,): Least and largest input, in its unit; infinite where there is no limit
    low: FloatArray
    high: FloatArray
    change: FloatArray  # (nu,): Largest change from one sample to the next, in its unit

    @property
    def any(self) -> bool:
        """Whether anything is limited."""
        return bool(np.isfinite(np.concatenate([self.low, self.high, self.change])).any())

    def next(self, before: FloatArray, wanted: FloatArray) -> FloatArray:
        """Return the input (nu,) that the actuator gives after ``before`` where ``wanted`` is asked."""
        found = np.clip(np.clip(wanted, before - self.change, before + self.change), self.low, self.high)
        return np.asarray(found, dtype=np.float64)


def within(inputs: FloatArray, limits: Limits) -> FloatArray:
    """Return what the actuator makes of inputs (N, nu), from rest.

    Examples
    --------
    >>> limits = Limits(np.array([-1.0]), np.array([1.0]), np.array([0.6]))
    >>> within(np.array([[2.0], [2.0], [0.0]]), limits)[:, 0].tolist()
    [0.6, 1.0, 0.4]
    """
    found = np.empty_like(inputs)
    before = np.zeros(inputs.shape[1])
    for k, wanted in enumerate(inputs):
        before = found[k] = limits.next(before, wanted)
    return found


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """``sum (y - y*)' q (y - y*) + u' r u`` of a run of N samples."""

    reference: FloatArray  # (N, ny)
    q: FloatArray  # (ny,)
    r: FloatArray  # (nu,): Diagonals of the weights

    def cost(self, y: FloatArray, u: FloatArray) -> float:
        """Return the cost of outputs (N, ny) and inputs (N, nu); infinite where an output is not finite."""
        if not np.isfinite(y).all():
            return float("inf")
        return float(np.sum(self.q * (y - self.reference) ** 2) + np.sum(self.r * u**2))

    def normal(self, moves: Moves, y: FloatArray, u: FloatArray, proximity: float) -> tuple[FloatArray, FloatArray]:
        """Return H (M, M) and g (M,) of the cost ``v'Hv / 2 - g'v`` of a change v (M,) about outputs and inputs.

        ``proximity`` times the mean curvature holds v back at 0.
        """
        seen, pushed = moves.outputs.T * np.tile(self.q, len(y)), moves.inputs.T * np.tile(self.r, len(u))
        curvature = seen @ moves.outputs + pushed @ moves.inputs
        damping = proximity * float(np.trace(curvature)) / len(curvature)
        return curvature + damping * np.eye(len(curvature)), seen @ (self.reference - y).ravel() - pushed @ u.ravel()


@dataclass(frozen=True, eq=False)
class Moves:
    """What a change of the feed-forward does under feedback, so that nothing grows without bound."""

    # (N ny, M), (N nu, M): To all outputs and to all inputs; M = N nu
    outputs: FloatArray
    inputs: FloatArray

    @classmethod
    def of(cls, model: TimeVarying, gains: FloatArray) -> Moves:
        """Return those of a model along a motion (without feedthrough) under ``du = -gains[k] dx + v``."""
        n, ny, _ = model.c_matrices.shape
        nu = gains.shape[1]
        inside = model.a_matrices - model.b_matrices @ gains
        direct = np.concatenate([np.zeros((n, ny, nu)), np.repeat(np.eye(nu)[None], n, axis=0)], axis=1)
        both = TimeVarying(inside, model.b_matrices, np.concatenate([model.c_matrices, -gains], axis=1), direct)
        lifted = both.lifted().reshape(n, ny + nu, -1)
        return cls(lifted[:, :ny].reshape(n * ny, -1), lifted[:, ny:].reshape(n * nu, -1))


def limited_change(
    h: FloatArray, g: FloatArray, moves: FloatArray, u: FloatArray, limits: Limits
) -> tuple[FloatArray, int]:
    """Return the change v (M,) that minimises ``v'Hv / 2 - g'v`` while inputs keep limits, and the iterations.

    The alternating direction method of multipliers (Boyd et al. 2011, *Foundations and Trends in Machine Learning*
    3:1, sec. 3.1.1 and 5.2): one part is the quadratic cost, the other the limits on the inputs and on their changes,
    which meet in ``z = [w; D w]``, ``w = u + moves v``. The first is a linear solve, the second a clip.

    - ``h, g`` (M, M), (M,): H positive definite
    - ``moves`` (N nu, M): what v does to the inputs
    - ``u`` (N, nu): inputs that are changed

    Examples
    --------
    >>> limits = Limits(np.array([-1.0]), np.array([1.0]), np.array([0.5]))
    >>> limited_change(np.eye(3), np.array([0.2, 2.0, 2.0]), np.eye(3), np.zeros((3, 1)), limits)[0].round(4).tolist()
    [0.5, 1.0, 1.0]
    """
    n, nu = u.shape
    changes = np.eye(n * nu) - np.eye(n * nu, k=-nu)
    rows = [np.tile(limits.high, n) < np.inf, np.tile(limits.change, n) < np.inf]
    both = np.vstack([np.eye(n * nu)[rows[0]], changes[rows[1]]])
    low = np.concatenate([np.tile(limits.low, n)[rows[0]], np.tile(-limits.change, n)[rows[1]]])
    high = np.concatenate([np.tile(limits.high, n)[rows[0]], np.tile(limits.change, n)[rows[1]]])
    here, both = both @ u.ravel(), both @ moves
    v = np.linalg.solve(h, g)
    z = np.clip(here + both @ v, low, high)
    dual: FloatArray = np.zeros(len(z))
    coupling = both.T @ both
    penalty = float(np.trace(h) / max(float(np.trace(coupling)), 1e-300))
    inverse = np.linalg.inv(h + penalty * coupling)
    done = 0
    while done < _ITERATIONS and len(z):
        done += 1
        v = inverse @ (g + penalty * both.T @ (z - dual - here))
        there = here + both @ v
        before, z = z, np.clip(there + dual, low, high)
        dual = dual + there - z
        scale = max(float(np.abs(z).max()), 1e-12)
        apart = float(np.abs(there - z).max()) / scale
        moving = float(np.abs(z - before).max()) / scale
        if max(apart, moving) < _CLOSE:
            break
        if done % _REVIEWED == 0 and max(apart, moving) > _BALANCED * min(apart, moving):
            factor = 2.0 if apart > moving else 0.5
            penalty, dual = penalty * factor, dual / factor
            inverse = np.linalg.inv(h + penalty * coupling)
    return np.asarray(v), done


@dataclass(frozen=True, eq=False)
class RiccatiRecursion:
    """``du[k] = -gains[k] dx[k] + forward[k]`` of a Riccati recursion along a motion."""

    gains: FloatArray
    forward: FloatArray


def riccati(
    model: TimeVarying, cost: QuadraticCost, y: FloatArray, u: FloatArray, proximity: float
) -> RiccatiRecursion:
    """Return the feedback (N, nu, nx) and the feed-forward (N, nu) of least cost about a measured motion.

    The backward pass of iterative LQR (Li & Todorov 2004, *ICINCO*, sec. 3): ``dx+ = A[k] dx + B[k] du``, ``dy = C[k]
    dx``, the cost quadratic in what departs from the measured motion.

    - ``model``: without feedthrough
    - ``y, u`` (N, ny), (N, nu): of the motion
    - ``proximity``: what changes of an input cost more, relative to the mean curvature by it
    """
    n, nu = u.shape
    nx = model.a_matrices.shape[1]
    c = model.c_matrices
    hessian, slope = np.zeros((nx, nx)), np.zeros(nx)
    gains, forward = np.zeros((n, nu, nx)), np.zeros((n, nu))
    stiff = 0.0
    for turn in (0, 1):  # the first finds the mean curvature, which the second holds back with
        hessian, slope, total = np.zeros((nx, nx)), np.zeros(nx), 0.0
        for k in range(n - 1, -1, -1):
            a, b = model.a_matrices[k], model.b_matrices[k]
            quu = np.diag(cost.r) + b.T @ hessian @ b
            total += float(np.trace(quu)) / (n * nu)
            quu = quu + stiff * np.eye(nu)
            qux = b.T @ hessian @ a
            qu = cost.r * u[k] + b.T @ slope
            gains[k], forward[k] = np.linalg.solve(quu, qux), -np.linalg.solve(quu, qu)
            slope = c[k].T @ (cost.q * (y[k] - cost.reference[k])) + a.T @ slope - gains[k].T @ qu
            hessian = c[k].T @ (cost.q[:, None] * c[k]) + a.T @ hessian @ a - gains[k].T @ qux
            hessian = 0.5 * (hessian + hessian.T)
        stiff = proximity * total
        if turn == 0 and proximity == 0:
            break
    return RiccatiRecursion(gains, forward)
