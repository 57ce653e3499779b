"""Levenberg-Marquardt for output-error fits: few common parameters, many windows with a state of their own each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.windows import Evaluation, Windows
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.definition.model_equations import Equations

# Smallest value of a parameter on a logarithmic scale, relative to where it started.
_TINY = 1e-12
_LARGEST_LOG_STEP = 2.0
# Relative decrease of the cost at which a minimum counts as reached.
_DECREASE = 1e-7
# A minimum counts as reached without a trial where a step promises less than this part of that decrease.
_PROMISE = 0.1
# Relative decrease of the cost that a step must promise to be tried.
_NOTHING = 1e-10
# A simulation is pruned at so many times the cost from which a step starts; rounding is far below.
_MORE = 1 + 1e-9


@dataclass(eq=False)
class Minimised:
    """Where a minimisation ended; its normal equations are those of the free parameters and the states."""

    p: FloatArray
    x0: FloatArray
    evaluation: Evaluation
    converged: bool
    iterations: int
    message: str
    states_free: bool = True


def log_scaled(system: Equations) -> npt.NDArray[np.bool_]:
    """Return which parameters are fitted through their logarithm (np,)."""
    return np.array([parameter.positive for parameter in system.parameters], dtype=bool)


@np.errstate(over="ignore", invalid="ignore")  # far off, sums of squares leave all numbers: no step is taken there
def eliminated(
    gram: FloatArray, gradient: FloatArray, count: int, damping: float, states_free: bool
) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray] | None]:
    """Return the normal equations of the parameters with the states of the windows eliminated.

    - ``gram, gradient`` (W, ns, ns), (W, ns): J'J and J'r of each window by (p, x0)
    - ``count``: number of parameters
    - ``damping``: Marquardt's lambda, for the states
    - returns matrix (np, np), right-hand side (np,) and ``back`` = (C^-1 B' (W, nx, np), C^-1 g (W, nx)), so that
      dx0 = back[1] - back[0] dp
    """
    a, g = gram[:, :count, :count].sum(axis=0), gradient[:, :count].sum(axis=0)
    nx = gram.shape[1] - count
    if not states_free or nx == 0:
        return a, g, None
    c, b = gram[:, count:, count:].copy(), gram[:, :count, count:]
    rows = np.arange(nx)
    diagonal = c[:, rows, rows]
    c[:, rows, rows] += damping * diagonal + 1e-11 * diagonal.max(axis=1, keepdims=True) + 1e-200
    # Scaled to a unit diagonal: states of very different size (angle, rate, micrometre) keep their digits.
    size = np.sqrt(c[:, rows, rows])
    scaled = c / (size[:, :, None] * size[:, None, :])
    right = np.concatenate([b.transpose(0, 2, 1), gradient[:, count:, None]], axis=2) / size[:, :, None]
    solved = np.linalg.solve(scaled, right) / size[:, :, None]
    by_p, by_r = solved[:, :, :count], solved[:, :, count]
    a = a - np.einsum("wij,wjk->ik", b, by_p)
    g = g - np.einsum("wij,wj->i", b, by_r)
    return a, g, (by_p, by_r)


def minimise(
    windows: Windows,
    p: FloatArray,
    x0: FloatArray,
    free: npt.NDArray[np.bool_],
    max_iterations: int,
    *,
    states_free: bool = True,
    decrease: float = _DECREASE,
) -> Minimised:
    """Minimise the cost over the free parameters and the initial states.

    - ``p`` (np,): start
    - ``x0`` (W, nx): start
    - ``free`` array of bool (np,)
    - ``states_free``: False keeps x0
    - ``decrease``: relative decrease of the cost at which a minimum counts as reached
    - returns a solution with an infinite cost if the start diverges
    """
    system = windows.simulator.system
    logarithmic = log_scaled(system)
    low = np.array([parameter.minimum for parameter in system.parameters])
    high = np.array([parameter.maximum for parameter in system.parameters])
    floor = _TINY * np.maximum(np.abs([parameter.value for parameter in system.parameters]), 1e-3)
    p = np.where(logarithmic, np.maximum(p, np.maximum(low, floor)), p)
    columns = np.flatnonzero(np.concatenate([free, np.ones(windows.simulator.nx, dtype=bool)]))
    now = windows.trial(p, x0, columns=columns, keep=True)
    if not np.isfinite(now.cost):
        return Minimised(p, x0, now, False, 0, "the simulation diverges at the start", states_free)
    damping, growth = 1e-3, 4.0
    count = p.shape[0]
    small = 0
    for iteration in range(1, max_iterations + 1):
        scale = np.where(logarithmic, p, 1.0)
        by = np.concatenate([scale, np.ones(windows.simulator.nx)])
        gram = now.gram * (by[:, None] * by[None, :])
        gradient = now.gradient * by
        accepted, expected = False, np.inf  # where no step can be computed, nothing says that the cost is flat
        for _ in range(12):
            a, g, back = eliminated(gram, gradient, count, damping, states_free)
            step = _step(a, g, free, p, low, high, scale, logarithmic, damping)
            if step is None:
                damping *= growth
                continue
            trial = np.where(logarithmic, p * np.exp(np.where(logarithmic, step, 0.0)), p + step)
            trial = np.clip(trial, np.maximum(low, np.where(logarithmic, floor, -np.inf)), high)
            moved = trial - p
            moved[logarithmic] = np.log(trial[logarithmic] / p[logarithmic])
            change = np.zeros_like(x0) if back is None else back[1] - back[0] @ moved
            expected = float(moved @ gradient[:, :count].sum(axis=0) + np.sum(change * gradient[:, count:]))
            expected -= 0.5 * _quadratic(gram, moved, change)
            if 0 <= expected <= _PROMISE * decrease * now.cost and damping < 1.0:
                return Minimised(p, x0, now, True, iteration, f"converged in {iteration} iterations", states_free)
            # What costs more is rejected, whatever else the simulation would have told.
            then = windows.trial(trial, x0 + change, columns=columns, budget=now.cost * _MORE, keep=True)
            gain = now.cost - then.cost
            if np.isfinite(then.cost) and gain >= 0:
                accepted = True
                ratio = gain / expected if expected > 0 else 1.0
                damping = max(damping * max(1 / 10, 1 - (2 * ratio - 1) ** 3), 1e-12)
                growth = 4.0
                break
            if np.isfinite(then.cost) and abs(gain) <= 1e-12 * now.cost:
                return Minimised(p, x0, now, True, iteration, f"converged in {iteration} iterations", states_free)
            damping *= growth
            growth *= 2.0
            if damping > 1e14:
                break
        if not accepted:
            flat = expected <= 1e-6 * now.cost
            words = "converged" if flat else "no step decreases the cost any more"
            return Minimised(p, x0, now, flat, iteration, f"{words} in {iteration} iterations", states_free)
        relative = gain / max(now.cost, 1e-300)
        p, x0, now = trial, x0 + change, then
        small = small + 1 if relative < decrease * 100 and damping < 1e3 else 0
        if (relative < decrease and damping < 1.0) or small >= 8:
            return Minimised(p, x0, now, True, iteration, f"converged in {iteration} iterations", states_free)
    words = f"not converged in {max_iterations} iterations"
    return Minimised(p, x0, now, False, max_iterations, words, states_free)


def minimise_states(
    windows: Windows, p: FloatArray, x0: FloatArray, max_iterations: int = 25, *, decrease: float = _DECREASE
) -> FloatArray:
    """Return the initial states (W, nx) that fit each window best, parameters held; every window by itself.

    A window is done once a step lowers its cost by less than ``decrease`` of it.
    """
    nx, count = windows.simulator.nx, p.shape[0]
    if nx == 0:
        return x0
    x0 = x0.copy()
    columns = np.arange(count, count + nx)
    now = windows.trial(p, x0, columns=columns)
    # A window that diverges from where the data put it may do better from rest.
    broken = ~np.isfinite(now.costs)
    if broken.any():
        x0[broken] = 0.0
        now = windows.trial(p, x0, columns=columns)
    damping = np.full(len(windows), 1e-3)
    active = np.isfinite(now.costs)
    rows = np.arange(nx)
    for _ in range(max_iterations):
        if not active.any():
            break
        c = now.gram[:, count:, count:].copy()
        g = now.gradient[:, count:]
        c[~active], g = np.eye(nx), np.where(active[:, None], g, 0.0)
        diagonal = np.maximum(c[:, rows, rows], 1e-12 * c[:, rows, rows].max(axis=1, keepdims=True) + 1e-200)
        c[:, rows, rows] += damping[:, None] * diagonal + 1e-11 * diagonal
        size = np.sqrt(c[:, rows, rows])
        solved = np.linalg.solve(c / (size[:, :, None] * size[:, None, :]), (g / size)[:, :, None])[:, :, 0] / size
        # What a step cannot improve by the last digits of the cost is not worth a simulation.
        active = active & (0.5 * np.einsum("wi,wi->w", g, solved) > _NOTHING * now.costs)
        if not active.any():
            break
        limits = np.where(active, now.costs, -1.0)
        then = windows.trial(p, x0 + solved, columns=columns, limits=limits)
        better = active & (then.costs < now.costs)
        gain = np.where(better, now.costs - np.where(np.isfinite(then.costs), then.costs, 0.0), 0.0)
        done = better & (gain <= decrease * now.costs)
        x0[better] += solved[better]
        now = _chosen(now, then, better)
        damping = np.where(better, damping / 10, damping * 10)
        active = active & ~done & (damping < 1e8)
    return x0


def _chosen(old: Evaluation, new: Evaluation, which: npt.NDArray[np.bool_]) -> Evaluation:
    """Return the evaluation with some windows of the new one."""
    costs = np.where(which, new.costs, old.costs)
    gram = np.where(which[:, None, None], new.gram, old.gram)
    gradient = np.where(which[:, None], new.gradient, old.gradient)
    return Evaluation(float(np.sum(costs)), costs, gram, gradient, new.squares)


def _step(
    a: FloatArray,
    g: FloatArray,
    free: npt.NDArray[np.bool_],
    p: FloatArray,
    low: FloatArray,
    high: FloatArray,
    scale: FloatArray,
    logarithmic: npt.NDArray[np.bool_],
    damping: float,
) -> FloatArray | None:
    """Return the damped step (np,) of the free parameters that do not push against a bound."""
    step = np.zeros_like(p)
    bound = ((p <= low) & (g < 0)) | ((p >= high) & (g > 0))
    use = free & ~bound
    if not use.any():
        return step
    part = a[np.ix_(use, use)]
    diagonal = np.diag(part)
    largest = diagonal.max(initial=0.0)
    if not np.isfinite(largest):
        return None
    size = np.sqrt(np.maximum(diagonal, 1e-14 * largest + 1e-200))
    scaled = part / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += damping + 1e-13
    try:
        found = np.linalg.solve(scaled, g[use] / size) / size
    except np.linalg.LinAlgError:
        return None
    long = logarithmic[use] & (np.abs(found) > _LARGEST_LOG_STEP)
    if long.any():
        # What the data hardly tell (the width of a sign) wants long steps. It goes as far as it may and the others
        # follow it; shortening the whole step would hold back all of them.
        found[long] = np.sign(found[long]) * _LARGEST_LOG_STEP
        others = ~long
        right = (g[use] - part[:, long] @ found[long]) / size
        if others.any():
            found[others] = np.linalg.solve(scaled[np.ix_(others, others)], right[others]) / size[others]
        found = np.where(logarithmic[use], np.clip(found, -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP), found)
    step[use] = found
    return step


def _quadratic(gram: FloatArray, dp: FloatArray, dx: FloatArray) -> float:
    """Return d' J'J d summed over the windows."""
    count = dp.shape[0]
    total = dp @ gram[:, :count, :count].sum(axis=0) @ dp
    total += 2 * np.einsum("i,wij,wj->", dp, gram[:, :count, count:], dx)
    total += np.einsum("wi,wij,wj->", dx, gram[:, count:, count:], dx)
    return float(total)
