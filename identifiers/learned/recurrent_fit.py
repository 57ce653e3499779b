"""Levenberg and Marquardt's method for the free run of a small recurrent network, with initial states as unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.models.damped import Damping, damped_descent
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.scaling import centred
from identifiers.learned.recurrent_pass import Integrating, RecurrentLayout
from identifiers.linear.n4sid import Subspace

Mask = npt.NDArray[np.bool_]
Linear = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Point = tuple[FloatArray, FloatArray]  # Weights (p,) and the initial state of every record (R, nx).
_HELD_OUT = 0.2  # Share of every record, its end, that is held out.
_PATIENCE = 25  # Iterations without a better held-out error after which a start is pruned.
_ENOUGH = 1e-6  # Relative fall of the cost in an iteration below which a minimum counts as reached.

_STATE_PRECISION = 1e-4
"""Cost of the squares of initial states: they are in the size of the outputs, and the data are to say where."""

_LINEAR_SHARE = 0.1  # Share of the ridge for the linear part, which holds gains and time constants.
_TRIALS = 12  # Times that the damping is raised, fourfold each, before an iteration is abandoned.


class Recurrence(Protocol):
    """Functions of the next state and of the output whose coefficients stand in one vector (p,)."""

    @property
    def nx(self) -> int:
        """States."""

    @property
    def count(self) -> int:
        """Coefficients."""

    def step(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx)."""

    def output(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""

    def jacobians(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (nx, nx) of the next state and (ny, nx) of the output by the state."""

    def run(
        self, theta: FloatArray, start: FloatArray, u: FloatArray, *, sensitivities: bool, native: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the outputs (N, ny) of a free run, and their derivatives (N, ny, p + nx) by coefficients and start."""

    def states(self, theta: FloatArray, start: FloatArray, u: FloatArray) -> FloatArray:
        """Return the states (N, nx) of a free run."""

    def to_dict(self) -> list[int] | dict[str, Any]:
        """Return its sizes, JSON-ready."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One record: scaled inputs u (N, nu), outputs y (N, ny) in their units, and the scaling (mean, size) of both.

    ``held_out`` is the share of it, its end, that is not learned from; 0 for none.
    """

    channels: Sequence[Channel]
    u: FloatArray
    y: FloatArray
    y_mean: FloatArray
    y_std: FloatArray
    u_scale: tuple[FloatArray, FloatArray] = (np.zeros(1), np.ones(1))
    held_out: float = _HELD_OUT

    @classmethod
    def scaled(cls, records: Sequence[Trajectory], held_out: float = _HELD_OUT) -> list[Problem]:
        """Return the records with inputs and outputs about their common mean, in their common size."""
        inputs = centred([record.u for record in records])
        y_mean, y_std = centred([record.y for record in records])
        return [
            cls(record.spec.outputs, (record.u - inputs[0]) / inputs[1], record.y, y_mean, y_std, inputs, held_out)
            for record in records
        ]

    @property
    def cut(self) -> int:
        """Samples learned from; the others are held out."""
        return len(self.u) - int(self.held_out * len(self.u))

    @property
    def scaled_y(self) -> FloatArray:
        """Outputs (N, ny) about their mean, in their size."""
        return (self.y - self.y_mean) / self.y_std

    def increments(self, size: Sequence[float]) -> Problem:
        """Return the record of what is summed to its outputs: their increments in a sample, of some size each."""
        steps = np.diff(self.scaled_y, axis=0, append=self.scaled_y[-1:]) / np.array(size)
        return replace(self, y=steps, y_mean=np.zeros_like(self.y_mean), y_std=np.ones_like(self.y_std))

    def errors(self, scaled: FloatArray) -> FloatArray:
        """Return predicted minus measured (N, ny), wrapped on periodic channels, in scaled units."""
        predicted = self.y_mean + self.y_std * scaled
        return -residual(self.channels, self.y, predicted) / self.y_std

    def states(self, layout: Recurrence, theta: FloatArray, start: FloatArray) -> FloatArray:
        """Return the states (N, nx) of the free run."""
        states = layout.states(theta, start, self.u)
        return states[np.isfinite(states).all(axis=1)]


@dataclass(frozen=True, eq=False)
class FittedStart:
    """Where one start ended: weights (p,), initial states (R, nx), held-out and estimation rms in scaled units."""

    theta: FloatArray
    starts: FloatArray
    held_out: float
    error: float


def descend(
    layout: RecurrentLayout | Integrating,
    problems: Sequence[Problem],
    rng: np.random.Generator,
    ridge: float,
    iterations: int,
    *,
    direct: bool,
    lags: bool,
) -> FittedStart:
    """Return the state with the least held-out error on one descent from a random start.

    - ``ridge``: cost of the squares of the weights
    - ``direct``: let outputs depend on the inputs of the same instant
    - ``lags``: begin at a cascade of lags; else at a subspace model, where there is one
    """
    begun, levels = list(problems), np.zeros((len(problems), 0))
    if isinstance(layout, Integrating):
        network = layout.inner
        begun, levels = [one.increments(layout.size) for one in begun], np.array([one.scaled_y[0] for one in begun])
    else:
        network = layout
    theta, start = _begin(network, begun, rng, lags)
    free, weight = _free(network, direct), _ridge(network, ridge)
    theta[~free] = 0.0
    starts = np.tile(start, (len(problems), 1))
    if layout is not network:  # errors of sums pile up: from where the increments are right the way is short
        found = descend_from(network, begun, theta, starts, weight, free, iterations)
        theta, starts = found.theta, found.starts
    return descend_from(layout, problems, theta, np.hstack([starts, levels]), weight, free, iterations)


def descend_from(
    layout: Recurrence,
    problems: Sequence[Problem],
    theta: FloatArray,
    starts: FloatArray,
    weight: FloatArray,
    free: Mask,
    iterations: int,
) -> FittedStart:
    """Return the state with the least held-out error on the descent from given coefficients.

    - ``problems``: where none of them holds anything out, the least error counts
    - ``theta`` (p,)
    - ``starts`` (R, nx): initial states
    - ``weight`` (p,): cost of the square of each coefficient
    - ``free`` array of bool (p,): which coefficients are fitted
    """
    best, since = FittedStart(theta, starts, np.inf, np.inf), 0

    def cost(point: Point) -> float:
        return _cost(layout, problems, *point, weight)[0]

    def linearised(point: Point) -> System | None:
        nonlocal best, since
        gram, gradient, corner, bridge, side, held_out, error = _normal(layout, problems, *point, weight)
        if held_out < best.held_out:
            best, since = FittedStart(*point, held_out, error), 0
        elif (since := since + 1) > _PATIENCE:
            return None
        return gram, gradient, corner, bridge, side

    def moved(point: Point, system: System, damping: float) -> Point:
        try:
            d_theta, d_starts = _solve(*system, free, damping)
        except np.linalg.LinAlgError:  # sums so large that nothing is left of the damping: a step that leads nowhere
            return np.full_like(point[0], np.nan), point[1]
        return point[0] - d_theta, point[1] - d_starts

    if not np.isfinite(cost((theta, starts))):
        return best
    rule = Damping(start=1.0, growth=4.0, fall=0.3, least=1e-7, most=np.inf, trials=_TRIALS, enough=_ENOUGH,
                   rounds=iterations)  # fmt: skip
    end = damped_descent((theta, starts), cost, linearised, moved, rule)
    _, held_out, error = _cost(layout, problems, *end, weight)
    return FittedStart(*end, held_out, error) if held_out < best.held_out else best


def fit_start(
    layout: Recurrence, theta: FloatArray, problem: Problem, mean: FloatArray, std: FloatArray, error: float
) -> FloatArray:
    """Return the likeliest initial state (nx,) of a record under a normal belief of mean and std.

    - ``layout, theta``: the model
    - ``problem``: the first samples of the record
    - ``mean, std`` (nx,)
    - ``error``: standard deviation of the errors of a free run, in scaled units
    """
    precision = (max(error, 1e-6) / std) ** 2

    def cost(state: FloatArray) -> float:
        y, _ = layout.run(theta, state, problem.u, sensitivities=False)
        miss = problem.errors(y)
        total = float(np.sum(miss**2) + np.sum(precision * (state - mean) ** 2))
        return total if np.isfinite(total) else np.inf

    def linearised(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        y, table = layout.run(theta, x, problem.u, sensitivities=True)
        assert table is not None
        jacobian = table[..., layout.count :].reshape(-1, layout.nx)
        miss = problem.errors(y).ravel()
        if not np.isfinite(miss).all():
            return None
        return jacobian.T @ jacobian + np.diag(precision), jacobian.T @ miss + precision * (x - mean)

    def moved(x: FloatArray, system: tuple[FloatArray, FloatArray], damping: float) -> FloatArray:
        gram, right = system
        try:
            return x - np.linalg.solve(gram + damping * np.diag(np.diag(gram)), right)
        except np.linalg.LinAlgError:
            return np.full_like(x, np.nan)

    rule = Damping(start=1e-2, growth=4.0, fall=0.3, least=1e-9, most=np.inf, trials=_TRIALS, enough=_ENOUGH, rounds=40)
    return damped_descent(np.array(mean, dtype=float), cost, linearised, moved, rule)


def _begin(
    layout: RecurrentLayout, problems: Sequence[Problem], rng: np.random.Generator, lags: bool
) -> tuple[FloatArray, FloatArray]:
    """Return weights whose linear part is a cascade of lags or a subspace model, and an initial state."""
    nx, nu, ny = layout.nx, layout.nu, layout.ny
    a, b, c, start = cascade(problems, nx, rng)
    if not lags:
        found = subspace_start(problems, nx, rng)
        if found is not None:
            a, b, c, start = found[0], found[1], found[2], np.zeros(nx)
    theta = np.empty(layout.count)
    t = layout.tables(theta)
    t["A"][:] = np.vstack([a.T - np.eye(nx), b.T, np.zeros((1, nx))])
    t["C"][:] = np.vstack([c.T, np.zeros((nu + 1, ny))])
    for first, second in (("W1", "W2"), ("V1", "V2")):
        t[first][:] = 0.7 * rng.normal(size=t[first].shape)
        t[second][:] = 0.01 * rng.normal(size=t[second].shape)
    return theta, start


def cascade(problems: Sequence[Problem], nx: int, rng: np.random.Generator) -> Linear:
    """Return A, B, C of a cascade of lags with random time constants that ends in all outputs, and a state (nx,)."""
    longest = max(len(problem.u) for problem in problems)
    # Time constants from some samples to a tenth of the longest record: what the data can show.
    rate = np.exp(rng.uniform(np.log(min(1.0, 10.0 / longest)), np.log(0.3), nx))
    b, c = np.zeros((nx, problems[0].u.shape[1])), np.zeros((problems[0].y.shape[1], nx))
    b[0], c[:, -1] = rate[0], 1.0
    start = np.full(nx, float(np.mean(problems[0].scaled_y[0])))
    return np.diag(1.0 - rate) + np.diag(rate[1:], -1), b, c, start


def subspace_start(
    problems: Sequence[Problem], nx: int, rng: np.random.Generator, *, direct: bool = False
) -> Linear | None:
    """Return A, B, C, D of a stable subspace model with states of size 1; None where there is none."""
    nu, ny = problems[0].u.shape[1], problems[0].y.shape[1]
    channels = tuple(Channel(f"{kind}{i}") for kind, count in (("u", nu), ("y", ny)) for i in range(count))
    spec = PlantSpec(channels[:nu], channels[nu:], 1.0, feedthrough=direct)
    records = [
        Trajectory(
            np.arange(float(problem.cut)),
            problem.u[: problem.cut],
            problem.scaled_y[: problem.cut],
            spec,
        )
        for problem in problems
    ]
    try:
        model = Subspace(order=nx, stable=True, direct=direct).fit(records, rng=rng)
    except FitError:
        return None  # too short, or too little moves, for a subspace: the cascade serves
    a, b, c = model.a_matrix[:nx, :nx], model.b_matrix[:nx], model.c_matrix[:, :nx]
    x, squares = np.zeros(nx), np.zeros(nx)
    for u in records[0].u:
        x = a @ x + b @ u
        squares += x**2
    size = np.sqrt(squares / len(records[0]))
    if not (np.isfinite(size).all() and (size > 0).all()):
        return None
    return a * size / size[:, None], b / size[:, None], c * size, model.d_matrix


def _free(layout: RecurrentLayout, direct: bool) -> Mask:
    """Return which weights are fitted (p,): those from inputs to outputs only where there is a direct term."""
    free = np.ones(layout.count)
    if not direct:
        tables = layout.tables(free)
        for name in ("C", "V1"):
            tables[name][layout.nx : layout.nx + layout.nu] = 0.0
    return free > 0


def _ridge(layout: RecurrentLayout, ridge: float) -> FloatArray:
    """Return the cost of the square of each weight (p,)."""
    weight = np.full(layout.count, ridge)
    tables = layout.tables(weight)
    for name in ("A", "C"):
        tables[name][:] *= _LINEAR_SHARE
    return weight


def _cost(
    layout: Recurrence, problems: Sequence[Problem], theta: FloatArray, starts: FloatArray, weight: FloatArray
) -> tuple[float, float, float]:
    """Return the cost, the held-out rms and the estimation rms of free runs; infinite where one diverges."""
    runs = [
        layout.run(theta, x, problem.u, sensitivities=False)[0] for problem, x in zip(problems, starts, strict=True)
    ]
    return _sums(problems, runs, theta, starts, weight)


def _sums(
    problems: Sequence[Problem],
    runs: Sequence[FloatArray],
    theta: FloatArray,
    starts: FloatArray,
    weight: FloatArray,
) -> tuple[float, float, float]:
    if not all(np.isfinite(run).all() for run in runs):
        return np.inf, np.inf, np.inf
    errors = [problem.errors(run) for problem, run in zip(problems, runs, strict=True)]
    learned = np.concatenate([miss[: problem.cut] for problem, miss in zip(problems, errors, strict=True)])
    held = np.concatenate([miss[problem.cut :] for problem, miss in zip(problems, errors, strict=True)])
    held = held if len(held) else learned
    cost = float(np.sum(learned**2) + np.sum(weight * theta**2) + _STATE_PRECISION * np.sum(starts**2))
    return cost, float(np.sqrt(np.mean(held**2))), float(np.sqrt(np.mean(learned**2)))


System = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
Normal = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float, float]


def _normal(
    layout: Recurrence, problems: Sequence[Problem], theta: FloatArray, starts: FloatArray, weight: FloatArray
) -> Normal:
    """Return the normal equations: of the weights (p, p), of each initial state (R, nx, nx), and between them."""
    p, nx = layout.count, layout.nx
    gram, gradient = np.diag(weight), weight * theta
    corner = np.tile(_STATE_PRECISION * np.eye(nx), (len(problems), 1, 1))
    bridge, side = np.empty((len(problems), p, nx)), _STATE_PRECISION * starts
    runs = []
    for number, (problem, x) in enumerate(zip(problems, starts, strict=True)):
        y, table = layout.run(theta, x, problem.u, sensitivities=True)
        assert table is not None
        runs.append(y)
        rows = table[: problem.cut].reshape(-1, p + nx)
        miss = problem.errors(y)[: problem.cut].ravel()
        square, right = rows.T @ rows, rows.T @ miss
        gram += square[:p, :p]
        gradient = gradient + right[:p]
        corner[number] += square[p:, p:]
        bridge[number] = square[:p, p:]
        side[number] += right[p:]
    _, held_out, error = _sums(problems, runs, theta, starts, weight)
    return gram, gradient, corner, bridge, side, held_out, error


def _solve(
    gram: FloatArray,
    gradient: FloatArray,
    corner: FloatArray,
    bridge: FloatArray,
    side: FloatArray,
    free: Mask,
    damping: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the damped step of the weights (p,) and of the initial states (R, nx), states eliminated first."""
    index = np.flatnonzero(free)
    eye = damping * np.eye(corner.shape[1])
    left = gram[np.ix_(index, index)] + damping * np.eye(len(index))
    right = gradient[index].copy()
    turned = []
    for own, between, end in zip(corner, bridge[:, index], side, strict=True):
        both = np.linalg.solve(own + eye, np.column_stack([between.T, end]))
        turned.append(both)
        left -= between @ both[:, :-1]
        right -= between @ both[:, -1]
    d_theta = np.zeros_like(gradient)
    d_theta[index] = np.linalg.solve(left, right)
    d_starts = np.array([both[:, -1] - both[:, :-1] @ d_theta[index] for both in turned])
    return d_theta, d_starts
