"""Weighted least squares on the equations of several coordinates, and motions that a model simulates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from harness.algebra import column_norms
from harness.signals import FloatArray
from identifiers.common.row_solvers import whitening
from identifiers.mechanics.motion import Motion

if TYPE_CHECKING:
    from harness.physics import System

# Simulated motions of this length [s] give instruments: short enough for unstable plants.
_INSTRUMENT_WINDOW = 2.0


def instants(rows: FloatArray, n: int) -> FloatArray:
    """Return rows (N n, k) as (N, n, k)."""
    return rows.reshape(-1, n, rows.shape[1])


def weighted(
    phi: FloatArray, target: FloatArray, kept: FloatArray, n: int, *, plain: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return generalised least squares in the determined directions, and the whitening (n, n) of the coordinates.

    With ``plain`` the equations of all coordinates weigh alike, whatever their units, and nothing is whitened.
    """
    size = column_norms(phi)
    white, theta = np.eye(n), np.zeros(phi.shape[1])
    floor = 1e-9 * (float(np.sqrt(np.mean(target**2))) or 1.0)
    last = 2 if n > 1 and not plain else 0
    for number in range(last + 1):
        rows = (white @ instants(phi / size, n)).reshape(phi.shape) @ kept
        known = (white @ instants(target[:, None], n)).reshape(-1)
        theta = kept @ np.linalg.lstsq(rows, known, rcond=None)[0] / size
        if number < last:
            residual = (target - phi @ theta).reshape(-1, n)
            white = whitening(np.vstack([residual, floor * np.sqrt(len(residual)) * np.eye(n)]))
    return theta, white


def simulated_motion(system: System, parameters: Mapping[str, float], moved: Motion, dt: float) -> Motion:
    """Return a motion that the model simulates along the inputs of another, in windows that start on it."""
    n, count = len(system.coordinates), len(moved.t)
    simulator, p = system.simulator(dt), system.vector(dict(parameters))
    length = max(5, min(count, round(_INSTRUMENT_WINDOW / dt)))
    x = np.hstack([moved.q, moved.v])
    for first in range(0, count, length):
        part = slice(first, min(first + length, count))
        x[part] = simulator.states(p, x[first], moved.u[part], t0=moved.t[first])
    derivative = system.simulator(dt).functions.derivative.map(count)
    # what a differentiator sees at a sample: the mean of the accelerations before and after the input jumps
    a = derivative(x.T, moved.mean_u.T, np.tile(p[:, None], count), moved.t).full().T[:, n : 2 * n]
    return replace(moved, q=x[:, :n], v=x[:, n:], a=a)
