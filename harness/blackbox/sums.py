"""Normal equations of an output-error fit where every derivative costs a run: what is too far off gets none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.rollout_call import Asked, Sums
from harness.signals import FloatArray


def summed(
    run: Callable[[int], tuple[FloatArray, FloatArray]],
    slopes: Callable[[int, npt.NDArray[np.intp] | None], FloatArray],
    asked: Asked,
    *,
    nx: int,
    unknowns: int,
    floor: float = 0.0,
) -> Sums:
    """Return the sums of windows of one length.

    - ``run``: from the number of a window to its states (N, nx) and outputs (N, ny); NaN from where the plant breaks
    - ``slopes``: from the number of a window and the columns wanted (None: all) to the derivatives (N, ny, unknowns)
    - ``nx, unknowns``: states; parameters and states
    - ``floor``: error of every reading, in sigma, that is added to the costs: a fit that is exact still has one
    - returns the sums; windows beyond their limit, and all of them beyond the budget, have infinite costs and were not
      differentiated
    """
    measured, sigma, period = asked.data
    m, n, ny = measured.shape
    x, y = np.full((m, n, nx), np.nan), np.full((m, n, ny), np.nan)
    for k in range(m):
        if asked.limits is None or asked.limits[k] >= 0:
            x[k], y[k] = run(k)
    r = measured - y
    wraps = period > 0
    r[..., wraps] = (r[..., wraps] + period[wraps] / 2) % period[wraps] - period[wraps] / 2
    with np.errstate(over="ignore", invalid="ignore"):
        costs = 0.5 * (np.sum((r / sigma) ** 2, axis=(1, 2)) + n * ny * floor**2)
    costs[~np.isfinite(costs)] = np.inf
    if asked.limits is not None:
        costs[costs > asked.limits] = np.inf
    if np.sum(costs) > asked.budget:
        costs[:] = np.inf
    left = asked.budget - float(np.sum(costs)) if np.isfinite(asked.budget) else asked.budget
    gram, gradient = np.zeros((m, unknowns, unknowns)), np.zeros((m, unknowns))
    s = np.full((m, n, ny, unknowns), np.nan) if asked.sensitivities else None
    squares = np.zeros(ny)
    for k in np.flatnonzero(np.isfinite(costs)).tolist():
        by = slopes(k, None if asked.sensitivities else asked.columns)
        if not np.isfinite(by).all():
            costs[k] = np.inf
            continue
        j = (by / sigma[:, None]).reshape(-1, unknowns)
        squares += np.sum(r[k] ** 2, axis=0)
        gram[k], gradient[k] = j.T @ j, (r[k] / sigma).ravel() @ j
        if s is not None:
            s[k] = by
    states, residuals = (x, r) if asked.keep else (None, None)
    return Sums(costs, squares, gram, gradient, left, states, residuals, s)
