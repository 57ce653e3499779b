"""Functions of a Koopman dictionary that are learned: those with which extended DMD predicts free runs best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray

ITERATIONS = 300  # Of the quasi-Newton search; held-out stretches end it before as a rule.
PATIENCE = 40  # Iterations without a gain on held-out stretches after which the search ends.
HELD_OUT = 5  # One stretch of so many is held out.
GAIN = 0.95  # Functions are kept where the held-out error with them is below this share of that without.
STEEPNESS = 1.5  # Of first functions over arguments of -1 .. 1.
GROWTH = (0.1, 0.3, 1.0)
"""Shares of the horizon that are searched in turn: over all of it free runs of first functions diverge."""
DIVERGED = 1e12  # Mean square error, of arguments of size 1, that stands for any free run beyond.


@dataclass(frozen=True, eq=False)
class Stretch:
    """A piece of a record: scaled arguments (n, k), fixed functions of them (n, p), scaled inputs (n, nu)."""

    arguments: FloatArray
    fixed: FloatArray
    inputs: FloatArray


@dataclass(frozen=True)
class Learned:
    """What a search found."""

    units: tuple[tuple[float, ...], ...]
    """A row ``[b, w]`` for each function ``tanh(b + w' z)``; none where they do not pay."""
    # Error of free runs over the horizon on held-out stretches, root mean square over the scaled outputs, without and
    # with the functions
    before: float
    after: float


def learned_functions(
    stretches: Sequence[Stretch], outputs: int, count: int, horizon: int, ridge: float, *, rng: np.random.Generator
) -> Learned:
    """Return functions that lower the error of free runs of the lifted model on held-out stretches.

    Extended DMD with dictionary learning (Li, Dietrich, Bollt & Kevrekidis 2017, *Chaos* 27:103111), with two changes:
    what is minimised is the error of the outputs over ``horizon`` samples in place of that of all functions over one,
    and the matrix is eliminated, that of least squares for every choice of functions (variable projection, Golub &
    Pereyra 2003, *Inverse Problems* 19:R1), so that the model fitted with them afterwards is the one that was judged.

    - ``stretches``: at least two; one of five is held out, and no window reaches from one to the next
    - ``outputs``: the first columns of the arguments, whose errors count
    - ``count``: functions
    - ``horizon``: samples
    - ``ridge``: tikhonov weight, relative to the squares of every column
    - ``rng``: draws the start
    """
    held = [one for k, one in enumerate(stretches) if k % HELD_OUT == HELD_OUT - 1] or [stretches[-1]]
    fit = [one for one in stretches if not any(one is other for other in held)]
    arguments = fit[0].arguments.shape[1]
    weights = rng.normal(size=(count, arguments)) * STEEPNESS / np.sqrt(arguments)
    units, none, after = np.hstack([rng.uniform(-1, 1, (count, 1)), weights]), np.zeros((0, arguments + 1)), np.inf
    for reach in sorted({max(1, int(horizon * share)) for share in GROWTH}):
        learn, judge = _Windows(fit, outputs, reach), _Windows(held, outputs, reach)
        units, after = _searched(learn, judge, units, ridge)
    before = judge.cost(none, learn.matrix(none, ridge))
    kept = units if np.sqrt(after) < GAIN * np.sqrt(before) else none
    return Learned(tuple(tuple(map(float, row)) for row in kept), float(np.sqrt(before)), float(np.sqrt(after)))


def _searched(learn: _Windows, judge: _Windows, start: FloatArray, ridge: float) -> tuple[FloatArray, float]:
    """Return the functions (m, k + 1) of least held-out error on a search from others, and that error."""
    from scipy.optimize import minimize

    best, lead, idle = start, judge.cost(start, learn.matrix(start, ridge)), 0

    def goal(theta: Any) -> Any:
        value, gradient = learn.cost_and_gradient(np.asarray(theta).reshape(start.shape), ridge)
        return value, gradient.ravel()

    def looked(theta: Any) -> None:
        nonlocal best, lead, idle
        units = np.asarray(theta).reshape(start.shape)
        error = judge.cost(units, learn.matrix(units, ridge))
        best, idle = (units.copy(), 0) if error < lead else (best, idle + 1)
        lead = min(lead, error)
        if idle > PATIENCE:
            raise StopIteration

    how: dict[str, Any] = {"jac": True, "method": "L-BFGS-B", "callback": looked, "options": {"maxiter": ITERATIONS}}
    minimize(goal, start.ravel(), **how)
    return best, lead


class _Windows:
    """Stretches as one table, and the windows over which free runs of a lifted model are compared."""

    def __init__(self, stretches: Sequence[Stretch], outputs: int, horizon: int) -> None:
        self.arguments = np.concatenate([one.arguments for one in stretches]).T
        self.fixed = np.concatenate([one.fixed for one in stretches]).T
        self.inputs = np.concatenate([one.inputs for one in stretches]).T
        self.outputs = outputs
        ends = np.cumsum([len(one.arguments) for one in stretches])
        firsts = np.concatenate([[0], ends[:-1]])
        self.before = np.concatenate([np.arange(a, b - 1) for a, b in zip(firsts, ends, strict=True)])
        reach = min(horizon, min(len(one.arguments) for one in stretches) - 1)
        self.rows = np.concatenate(
            [np.arange(a, b - reach, max(1, reach // 2)) for a, b in zip(firsts, ends, strict=True)]
        )
        self.reach = reach

    def lifted(self, units: FloatArray) -> FloatArray:
        """Return the lifted states (p, N)."""
        return np.vstack([self.fixed, np.tanh(units[:, 1:] @ self.arguments + units[:, :1])])

    def matrix(self, units: FloatArray, ridge: float) -> FloatArray:
        """Return the matrix [A B] (p, p + nu) of least squares."""
        return self._solved(self.lifted(units), ridge)[0]

    def cost(self, units: FloatArray, matrix: FloatArray) -> float:
        """Return the mean square error of free runs with a matrix."""
        return self._run(self.lifted(units), matrix)[0]

    def cost_and_gradient(self, units: FloatArray, ridge: float) -> tuple[float, FloatArray]:
        """Return the mean square error with the matrix of these stretches, and its gradient (m, k + 1)."""
        lifted = self.lifted(units)
        matrix, phi, inverse = self._solved(lifted, ridge)
        cost, states, misses = self._run(lifted, matrix)
        if cost >= DIVERGED:
            return cost, np.zeros_like(units)
        p, count = len(lifted), misses[0].size * self.reach
        by_matrix, by_state = np.zeros_like(matrix), np.zeros_like(states[0])
        for k in range(self.reach, 0, -1):  # the adjoint of the free run
            by_state[: self.outputs] += 2 / count * misses[k - 1]
            by_matrix += by_state @ np.vstack([states[k - 1], self.inputs[:, self.rows + k - 1]]).T
            by_state = matrix[:, :p].T @ by_state
        # of the normal equations: matrix = after phi' (phi phi' + ridge)^-1
        after, turned = lifted[:, self.before + 1], inverse @ by_matrix.T
        by_phi = turned @ after - (turned @ matrix + (turned @ matrix).T) @ phi
        by_lifted = np.zeros_like(lifted)
        by_lifted[:, self.before + 1] += turned.T @ phi
        by_lifted[:, self.before] += by_phi[:p]
        by_lifted[:, self.rows] += by_state
        own = lifted[len(self.fixed) :]
        by_sum = by_lifted[len(self.fixed) :] * (1.0 - own**2)
        return cost, np.hstack([by_sum.sum(axis=1, keepdims=True), by_sum @ self.arguments.T])

    def _solved(self, lifted: FloatArray, ridge: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return [A B], the regressors (p + nu, N) and the inverse of their squares."""
        phi = np.vstack([lifted[:, self.before], self.inputs[:, self.before]])
        squares = phi @ phi.T
        size = np.sqrt(np.maximum(np.diag(squares), 1e-300))
        weight = max(ridge, 1e-10) * np.eye(len(squares))  # in the scaled columns, whose size moves little
        inverse = np.linalg.inv(squares / np.outer(size, size) + weight) / np.outer(size, size)
        return lifted[:, self.before + 1] @ phi.T @ inverse, phi, inverse

    def _run(self, lifted: FloatArray, matrix: FloatArray) -> tuple[float, list[FloatArray], list[FloatArray]]:
        """Return the mean square error of free runs, their states (H + 1) of (p, M), and errors (H) of (ny, M)."""
        p, states, misses = len(lifted), [lifted[:, self.rows]], []
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.reach):
                driven = matrix[:, p:] @ self.inputs[:, self.rows + k]
                states.append(matrix[:, :p] @ states[-1] + driven)
                misses.append(states[-1][: self.outputs] - lifted[: self.outputs, self.rows + k + 1])
            cost = float(np.mean(np.square(misses)))
        return (cost if cost < DIVERGED else DIVERGED), states, misses
