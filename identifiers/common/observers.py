"""What models that do not measure their whole state share: a filter gain chosen on data, an initial state fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from harness.algebra import divisor
from harness.models.damped import Damping, damped_descent
from harness.protocols import Model
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.linear_model import LinearModel

Step = Callable[[FloatArray, FloatArray], FloatArray]


def alpha_beta_gains(positions: int, dt: float) -> FloatArray:
    """Return filter gains (G, 2 n, n) of positions and their rates, from slow to fast.

    The stationary Kalman filter of a mass pushed at random (Kalata 1984, IEEE Trans. AES 20:174, eq. 25):
    ``beta = 2 (2 - alpha) - 4 sqrt(1 - alpha)``.
    """
    alphas = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 0.95, 1.0])
    betas = 2 * (2 - alphas) - 4 * np.sqrt(1 - alphas)
    eye = np.eye(positions)
    return np.array([np.vstack([a * eye, b / dt * eye]) for a, b in zip(alphas, betas, strict=True)])


def riccati_gains(a: FloatArray, c: FloatArray, scale: FloatArray, noise: FloatArray) -> FloatArray:
    """Return stationary Kalman gains (G, nx, ny) of ``x+ = A x``, ``y = C x`` for growing disturbance.

    - ``a, c`` (nx, nx), (ny, nx)
    - ``scale`` (nx,): size of each state: the disturbance has this standard deviation times 1e-5 .. 1 in a step.
    - ``noise`` (ny,): size of each output: the sensor is taken for a thousandth of it
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    nx, ny = a.shape[0], c.shape[0]
    # In scaled coordinates, so that the Riccati equation is well conditioned whatever the units.
    scaled_a = a * scale / scale[:, None]
    scaled_c = c * scale / noise[:, None]
    found = [np.zeros((nx, ny))]
    for ratio in 10.0 ** np.arange(-5.0, 0.5):
        try:
            p = solve_discrete_are(scaled_a.T, scaled_c.T, ratio**2 * np.eye(nx), 1e-6 * np.eye(ny))
        except (LinAlgError, ValueError):
            continue
        gain = p @ scaled_c.T @ np.linalg.inv(scaled_c @ p @ scaled_c.T + 1e-6 * np.eye(ny))
        found.append(gain * scale[:, None] / noise)
    return np.array([gain for gain in found if np.isfinite(gain).all()])


def best_gain(
    gains: FloatArray,
    step: Step,
    output: Step,
    starts: Sequence[FloatArray],
    records: Sequence[Trajectory],
    samples: int = 1500,
) -> FloatArray:
    """Return the gain (nx, ny) with the least one-step prediction error on records.

    - ``gains`` (G, nx, ny): candidates; all are run at once
    - ``step, output``: of states (G, nx) and an input (G, nu)
    - ``starts`` sequence of array (nx,): initial state of each record
    - ``samples``: use so many samples in all
    """
    channels = records[0].spec.outputs
    spread = divisor(np.concatenate([record.y for record in records]).std(axis=0))
    cost = np.zeros(len(gains))
    each = max(20, samples // len(records))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for start, record in zip(starts, records, strict=True):
            x = np.tile(start, (len(gains), 1))
            for k in range(min(len(record), each)):
                u = np.broadcast_to(record.u[k], (len(gains), record.spec.nu))
                miss = residual(channels, np.tile(record.y[k], (len(gains), 1)), output(x, u))
                if k:
                    cost += np.sum((miss / spread) ** 2, axis=1)
                x = step(x + np.einsum("gij,gj->gi", gains, miss), u)
    cost = np.where(np.isfinite(cost), cost, np.inf)
    return np.array(gains[int(np.argmin(cost))])


def fitted_start(
    run: Callable[[FloatArray, FloatArray], FloatArray],
    channels: Sequence[Channel],
    data: Trajectory,
    guess: FloatArray,
    *,
    scale: FloatArray,
    lengths: Sequence[int] = (30, 120, 400),
) -> FloatArray:
    """Return the initial state whose free run fits the start of a record best (Levenberg-Marquardt, differences).

    - ``run``: ``run(x (M, nx), u (M, N, nu)) -> y (M, N, ny)``
    - ``guess`` (nx,)
    - ``scale`` (nx,): size of each state, for differences and damping
    - ``lengths``: samples used, in turn: a short stretch first, since over a long one the error has many minima
    """
    spread = divisor(data.y.std(axis=0))
    best = np.array(guess, dtype=float)
    nx = best.size
    steps = 1e-6 * scale
    rule = Damping(least=0.0, most=1e6, rounds=8)

    def misses(states: FloatArray, count: int) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            u = np.broadcast_to(data.u[:count], (len(states), count, data.spec.nu))
            y = run(states, u)
            wrong = residual(channels, np.broadcast_to(data.y[:count], y.shape).copy(), y) / spread
        return wrong.reshape(len(states), -1)

    def cost(state: FloatArray, count: int) -> float:
        now = misses(state[None], count)[0]
        return float(now @ now)

    def linearised(state: FloatArray, count: int) -> tuple[FloatArray, FloatArray] | None:
        now, *others = misses(np.vstack([state[None], state + np.diag(steps)]), count)
        jacobian = (np.array(others) - now).T / 1e-6
        return (jacobian.T @ jacobian, jacobian.T @ now) if np.isfinite(jacobian).all() else None

    def moved(state: FloatArray, system: tuple[FloatArray, FloatArray], damping: float) -> FloatArray:
        gram, right = system
        return state + scale * np.linalg.solve(gram + damping * np.diag(np.diag(gram) + 1e-12), -right)

    for length in lengths:
        count = min(length, len(data))
        if count * data.spec.ny < nx:
            break
        best = damped_descent(best, partial(cost, count=count), partial(linearised, count=count), moved, rule)
        if count == len(data):
            break
    return best


def likeliest_start(
    residuals: Callable[[FloatArray], FloatArray], starts: Sequence[FloatArray], steps: FloatArray, rule: Damping
) -> FloatArray:
    """Return the initial state (nx,) whose residuals are least, from the best of several starts.

    - ``residuals``: of some states (M, nx) what is wrong with each, (M, N): errors over their deviation, and how far
      the states are from what is believed of them. Not finite where a run diverges.
    - ``starts`` sequence of array (nx,)
    - ``steps`` (nx,): differences by which derivatives are taken
    """

    def cost(x: FloatArray) -> float:
        value = float(np.sum(residuals(x[None]) ** 2))
        return value if np.isfinite(value) else np.inf

    def linearised(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        wrong = residuals(np.vstack([x[None], x + np.diag(steps)]))
        columns = (wrong[1:] - wrong[0]).T / steps
        return columns.T @ columns, columns.T @ wrong[0]

    def moved(x: FloatArray, system: tuple[FloatArray, FloatArray], damp: float) -> FloatArray:
        gram, right = system
        return x - np.asarray(np.linalg.solve(gram + damp * np.diag(np.diag(gram)), right))

    return min((damped_descent(start, cost, linearised, moved, rule) for start in starts), key=cost)


def run_in_steps(model: Model, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return the outputs (M, N, ny) of free runs from states x (M, nx) under inputs u (M, N, nu), all side by side."""
    outputs = np.empty((*u.shape[:2], model.spec.ny))
    for k in range(u.shape[1]):
        outputs[:, k] = model.output(x, u[:, k])
        if k + 1 < u.shape[1]:
            x = model.step(x, u[:, k])
    return outputs


def innovation_form(
    spec: PlantSpec,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    k: FloatArray,
    state_offset: FloatArray,
    output_offset: FloatArray,
    **more: Any,
) -> LinearModel:
    """Return the model of ``x+ = A x + B u + K e + a``, ``y = C x + D u + e + c``.

    A linear model corrects its state before it steps, with L where ``A L = K``. Where A cannot be inverted for that the
    innovation itself becomes a part of the state.

    Examples
    --------
    >>> spec = PlantSpec((), (Channel("y"),), 1.0)
    >>> one, none, zero = np.ones((1, 1)), np.zeros((1, 0)), np.zeros(1)
    >>> innovation_form(spec, 0.5 * one, none, one, none, 0.2 * one, zero, zero).filter_gain.tolist()
    [[0.4]]
    """
    nx, ny, nu = a.shape[0], c.shape[0], b.shape[1]
    gain: FloatArray = np.asarray(np.linalg.lstsq(a, k, rcond=1e-9)[0], dtype=np.float64)
    size = max(float(np.abs(k).max(initial=0.0)), 1e-300)
    if np.abs(a @ gain - k).max(initial=0.0) <= 1e-9 * size:
        return LinearModel(spec, a, b, c, d, gain, state_offset, output_offset, **more)
    return LinearModel(
        spec,
        np.block([[a, k], [np.zeros((ny, nx + ny))]]),
        np.vstack([b, np.zeros((ny, nu))]),
        np.hstack([c, np.zeros((ny, ny))]),
        d,
        np.vstack([np.zeros((nx, ny)), np.eye(ny)]),
        np.concatenate([state_offset, np.zeros(ny)]),
        output_offset,
        **more,
    )


def stationary_gain(a: FloatArray, c: FloatArray) -> FloatArray:
    """Return the filter gain of a stationary Kalman filter with equal noise on states and outputs.

    Shapes: ``a, c`` (nx, nx), (ny, nx).

    - returns array (nx, ny): ``L`` of ``x + L (y - C x)``; zeros where the Riccati equation has no solution

    Examples
    --------
    >>> stationary_gain(np.array([[0.5]]), np.array([[1.0]])).round(4)
    array([[0.5311]])
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    try:
        p = solve_discrete_are(a.T, c.T, np.eye(a.shape[0]), np.eye(c.shape[0]))
    except (LinAlgError, ValueError):
        return np.zeros((a.shape[0], c.shape[0]))
    gain: FloatArray = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.eye(c.shape[0]))
    return gain
