"""Along a filter pass: the smoothed states, and what a small force or sensor error does to the innovations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.filter_kernels import smoother_kernels
from harness.physics.compiled.kalman_pass import Filtered
from harness.signals import FloatArray


@dataclass(frozen=True, eq=False)
class SmoothedStates:
    """States given the whole record, and their standard deviations, (K, nx)."""

    x: FloatArray
    deviation: FloatArray


def smoothed(passed: Filtered) -> SmoothedStates:
    """Return the states given all outputs of a record, by the modified Bryson-Frazier recursion.

    It runs backwards on the innovations and inverts no covariance: at a high sample rate that is nearly singular
    (Bierman 1973, Automatica 9:503, eqs. 12-17).

    - ``passed``: with its path
    """
    path = passed.path
    assert path is not None
    n, nx = path.x_before.shape
    x, variance = np.empty((n, nx)), np.empty((n, nx))
    compiled = smoother_kernels(nx, passed.e.shape[1])
    if compiled is not None:
        given = (passed.e, passed.s, path.transition, path.gain, path.row, path.x_before, path.p_before)
        compiled.smooth(n, [np.ascontiguousarray(array) for array in given], [x, variance])
        return SmoothedStates(x, np.sqrt(np.maximum(variance, 0.0)))
    known = np.isfinite(passed.e)
    e, s = np.where(known, passed.e, 0.0), passed.s
    adjoint, information = np.zeros(nx), np.zeros((nx, nx))
    for k in range(n - 1, -1, -1):
        if k + 1 < n:
            f = path.transition[k]
            adjoint, information = f.T @ adjoint, f.T @ information @ f
        for o in range(e.shape[1] - 1, -1, -1):
            if not known[k, o]:
                continue
            c, keep = path.row[k, o], -np.outer(path.gain[k, o], path.row[k, o])
            keep.flat[:: nx + 1] += 1.0
            adjoint = keep.T @ adjoint - c * (e[k, o] / s[k, o])
            information = keep.T @ information @ keep + np.outer(c, c) / s[k, o]
        p = path.p_before[k]
        x[k] = path.x_before[k] - p @ adjoint
        variance[k] = np.diag(p) - np.einsum("ij,jk,ki->i", p, information, p)
    return SmoothedStates(x, np.sqrt(np.maximum(variance, 0.0)))


def innovation_response(
    passed: Filtered,
    forces: FloatArray | None,
    readings: FloatArray | None,
    *,
    rates_over: float | None = None,
    held: npt.NDArray[np.bool_] | None = None,
) -> FloatArray:
    """Return what small forces and sensor errors do to the innovations, gains held fixed.

    - ``passed``: with its path
    - ``forces`` (K, nl, m): added to the latent forces at every sample, m cases side by side
    - ``rates_over``: the sample time [s], where ``forces`` are added to the rates of the first states instead
    - ``readings`` (K, ny, m): added to what the model says that the sensors read
    - ``held`` (m,): cases whose force is that of the sample until the next one, as that of a held input is; others
      change linearly
    - returns array (K, ny, m)
    """
    path = passed.path
    assert path is not None
    given = forces if forces is not None else readings
    assert given is not None
    n, nx = path.x_after.shape
    ny, m = path.gain.shape[1], given.shape[2]
    nl = 0 if forces is None else forces.shape[1]
    response, state = np.empty((n, ny, m)), np.zeros((nx, m))
    push = np.zeros((n, nx, nl))
    if forces is not None:
        if rates_over is None:
            push[:, : nx - nl] = path.transition[:, : nx - nl, nx - nl :]
        else:  # the mean of a push at the beginning of a sample and one at its end
            push = 0.5 * rates_over * (path.transition[:, :, :nl] + np.eye(nx)[:, :nl])
        mean = forces.copy()
        mean[:-1] += forces[1:]
        mean[-1] += forces[-1]
        mean *= 0.5
        if held is not None and held.any():
            mean[..., held] = forces[..., held]
        forces = mean
    compiled = smoother_kernels(nx, ny)
    if compiled is not None:
        response = np.zeros((n, ny, m)) if readings is None else np.negative(readings)
        given_path = [np.ascontiguousarray(array) for array in (path.transition, path.gain, path.row)]
        pushes = [None, None] if forces is None else [np.ascontiguousarray(array) for array in (push, forces)]
        compiled.respond(n, m, given_path, [*pushes, np.empty((2, nx, m))], response)
        return response
    for k in range(n):
        for o in range(ny):
            change = -(path.row[k, o] @ state)
            if readings is not None:
                change -= readings[k, o]
            state += path.gain[k, o][:, None] * change
            response[k, o] = change
        state = path.transition[k] @ state
        if forces is not None:
            state += push[k] @ forces[k]
    return response
