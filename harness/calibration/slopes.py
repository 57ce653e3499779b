"""Derivatives of free runs out of an FMU's own directional derivatives, instead of one run for every column.

Along a run the sensitivity S of the states obeys ``S' = f_x S + f_p`` (Hairer, Norsett & Wanner 1993, *Solving Ordinary
Differential Equations I*, sec. I.14, eq. 14.8); f_x, f_p and those of the outputs are what an FMU tells (FMI 2.0.5
sec. 2.1.9). Some FMUs tell zeros for parameters: every column is first held against differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.errors import HarnessError
from harness.signals import FloatArray

LOOK = 60  # Samples over which an FMU's own derivatives are held against differences of runs.
AGREES = 0.03
"""Largest disagreement, over the largest derivative: differences of runs see the steps of the solver inside."""


class OwnSlopes:
    """Derivatives by those columns of (p, x0) for which an FMU's own agree with differences.

    - ``plant``: with ``rollout_partials``
    - ``begin``: ``begin(p, x0)`` resets the plant with these values
    - ``keys``: the plant's names of the parameters and states by which is derived, in the order of the columns
    - ``derivatives``: the plant's states, and the variables that are their derivatives
    """

    def __init__(
        self,
        plant: Any,
        begin: Callable[[FloatArray, FloatArray], object],
        keys: Sequence[str],
        derivatives: Mapping[str, str],
        outputs: Sequence[str],
    ) -> None:
        self._plant, self._begin, self._keys = plant, begin, list(keys)
        self._derivatives, self._outputs = dict(derivatives), list(outputs)
        self.trusted: frozenset[int] = frozenset()

    def try_out(
        self, p: FloatArray, x0: FloatArray, rows: FloatArray, differences: Callable[[int, int], FloatArray]
    ) -> None:
        """Trust the columns that agree with ``differences(column, samples)`` (K, ny) over the first samples."""
        agreed = set()
        for k in range(len(self._keys)):
            try:
                own = self(p, x0, rows[:LOOK], [k])[..., 0]
            except HarnessError:  # it tells no derivative by this one
                continue
            told = differences(k, min(LOOK, len(rows)))
            size = np.abs(told).max(axis=0)
            if np.isfinite(told).all() and size.any() and (np.abs(own - told) <= AGREES * size.max()).all():
                agreed.add(k)
        self.trusted = frozenset(agreed)

    def __call__(self, p: FloatArray, x0: FloatArray, rows: FloatArray, columns: Sequence[int]) -> FloatArray:
        """Return the derivatives (N, ny, len(columns)) along a run with these inputs (N, nu)."""
        states = list(self._derivatives)
        wanted = [self._keys[k] for k in columns]
        knowns = [*states, *(name for name in wanted if name not in states)]
        self._begin(p, x0)
        read = [name for name in self._outputs if name not in states]  # one that is a state says so by itself
        partials = self._plant.rollout_partials(rows[:-1], [*self._derivatives.values(), *read], knowns)
        told = np.zeros((*partials.shape[:2], len(states) + len(self._outputs), len(knowns)))
        told[..., : len(states), :] = partials[..., : len(states), :]
        for row, name in enumerate(self._outputs, len(states)):
            if name in states:
                told[..., row, states.index(name)] = 1.0
            else:
                told[..., row, :] = partials[..., len(states) + read.index(name), :]
        start = np.zeros((len(states), len(wanted)))
        forced = np.zeros((len(knowns) - len(states), len(wanted)))
        for column, name in enumerate(wanted):
            if name in states:
                start[states.index(name), column] = 1.0
            else:
                forced[knowns.index(name) - len(states), column] = 1.0
        return sensitivities(told, len(states), self._plant.spec.sample_time, start, forced)


def sensitivities(told: FloatArray, nx: int, dt: float, start: FloatArray, forced: FloatArray) -> FloatArray:
    """Return the derivatives of the outputs along a run.

    - ``told`` (N - 1, 2, nx + ny, nx + k): partial derivatives of (x', y) by (x, p) at the beginning and at the end of
      every sample
    - ``dt``: [s]
    - ``start`` (nx, c): dx(0) by the columns
    - ``forced`` (k, c): dp by the columns
    - returns array (N, ny, c)

    Examples
    --------
    >>> told = np.tile(np.array([[-2.0, 1.0], [1.0, 0.0]]), (10, 2, 1, 1))  # x' = -2 x + p, y = x
    >>> float(sensitivities(told, 1, 0.1, np.zeros((1, 1)), np.ones((1, 1)))[-1, 0, 0].round(6))
    0.432332
    """
    from scipy.linalg import expm

    count = told.shape[-1]
    middle = np.zeros((len(told), count, count))
    middle[:, :nx] = 0.5 * dt * (told[:, 0, :nx] + told[:, 1, :nx])
    moved = expm(middle)[:, :nx]
    s = np.vstack([start, forced])
    found = np.empty((len(told) + 1, told.shape[2] - nx, start.shape[1]))
    found[0] = told[0, 0, nx:] @ s
    for k in range(len(told)):
        s[:nx] = moved[k] @ s
        found[k + 1] = told[k, 1, nx:] @ s
    return found
