"""Along a filter pass: the smoothed states, and what a small force or sensor error does to the innovations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.physics.kalman_pass import Filtered
from harness.signals import FloatArray

__all__ = ["Smoothed", "innovation_response", "smoothed"]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """States given the whole record, and their standard deviations, (K, nx)."""

    x: FloatArray
    deviation: FloatArray


def smoothed(passed: Filtered) -> Smoothed:
    """Return the states given all outputs of a record (Rauch, Tung & Striebel 1965, eq. 3.30).

    Parameters
    ----------
    passed : Filtered
        With its path.
    """
    path = passed.path
    assert path is not None
    n = len(path.x_after)
    size = np.sqrt(np.maximum(np.einsum("kii->ki", path.p_before), 1e-300))
    scaled = path.p_before / (size[:, :, None] * size[:, None, :])
    inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) / (size[:, :, None] * size[:, None, :])
    gain = path.p_after[:-1] @ np.swapaxes(path.transition[:-1], 1, 2) @ inverse[1:]
    x, variance = path.x_after.copy(), path.p_after.copy()
    for k in range(n - 2, -1, -1):
        x[k] += gain[k] @ (x[k + 1] - path.x_before[k + 1])
        variance[k] += gain[k] @ (variance[k + 1] - path.p_before[k + 1]) @ gain[k].T
    return Smoothed(x, np.sqrt(np.maximum(np.einsum("kii->ki", variance), 0.0)))


def innovation_response(passed: Filtered, forces: FloatArray | None, readings: FloatArray | None) -> FloatArray:
    """Return what small forces and sensor errors do to the innovations, gains held fixed.

    Parameters
    ----------
    passed : Filtered
        With its path.
    forces : array (K, nl, m) or None
        Added to the latent forces at every sample, m cases side by side.
    readings : array (K, ny, m) or None
        Added to what the model says that the sensors read.

    Returns
    -------
    array (K, ny, m)
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
        push[:, : nx - nl] = path.transition[:, : nx - nl, nx - nl :]
        forces = 0.5 * (forces + np.concatenate([forces[1:], forces[-1:]]))
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
