"""Coordinates, rates and accelerations of a mechanism from what was measured of it, within one record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics import System

__all__ = ["Motion", "Smoothing", "motion"]

Smoothing = Literal["auto", "local", "spline", "kalman", "forward"]
# Leave-one-out errors below this fraction of the signal's travel are the cubics' own, not noise.
_CLEAN = 1e-6


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of one record, away from its ends.

    Attributes
    ----------
    t : array (N,)
    q, v, a : array (N, n)
        Coordinates, rates, accelerations.
    u, mean_u : array (N, nu)
        Input held from each instant on, and its mean over the samples before and after.
    width : int
        Samples that the smoothing spans (1: none).
    """

    t: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray
    u: FloatArray
    mean_u: FloatArray
    width: int


def motion(system: System, record: Trajectory, smoothing: Smoothing = "auto") -> Motion:
    """Return the motion of a mechanism from a record of positions, with rates where they are measured too.

    Parameters
    ----------
    system : harness.physics.System
        Its coordinates are wanted.
    record : Trajectory
        Outputs named after the coordinates, rates ``NAME_rate`` or ``NAME_dot``.
    smoothing : {"auto", "local", "spline", "kalman", "forward"}

    Raises
    ------
    FitError
        If a coordinate is not measured.
    """
    columns = {channel.name: i for i, channel in enumerate(record.spec.outputs)}
    names = [one.name for one in system.coordinates]
    missing = [name for name in names if name not in columns]
    if missing:
        raise FitError(
            "lumped parameters need every coordinate measured",
            expected=", ".join(names),
            got=", ".join(columns),
            remedy=f"measure {', '.join(missing)}, or use output-error",
        )
    dt, n = record.spec.sample_time, len(record)
    q, v, a = np.empty((n, len(names))), np.empty((n, len(names))), np.empty((n, len(names)))
    width = 1
    for i, name in enumerate(names):
        position = _unwrapped(record, columns[name])
        rate = next((columns[f"{name}{s}"] for s in ("_rate", "_dot") if f"{name}{s}" in columns), None)
        q[:, i], first, second, own = _derivatives(position, dt, smoothing)
        if rate is None:
            v[:, i], a[:, i] = first, second
        else:
            v[:, i], a[:, i], _, own = _derivatives(record.y[:, rate], dt, smoothing)
        width = max(width, own)
    mean_u = np.vstack([record.u[:1], 0.5 * (record.u[1:] + record.u[:-1])])
    edge = 1 if smoothing == "forward" else max(width // 2, 2)
    inner = slice(0, n - edge) if smoothing == "forward" else slice(edge, n - edge)
    if n <= 3 * edge + 12:
        inner = slice(0, n - 1)
    return Motion(record.t[inner], q[inner], v[inner], a[inner], record.u[inner], mean_u[inner], width)


def _unwrapped(record: Trajectory, column: int) -> FloatArray:
    period = record.spec.outputs[column].period
    signal = record.y[:, column]
    return np.asarray(signal if period is None else np.unwrap(signal, period=period), dtype=float)


def _derivatives(signal: FloatArray, dt: float, smoothing: Smoothing) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Return the signal, its first and second derivative, and the samples that the smoothing spans."""
    if smoothing == "forward":
        rate = np.append(np.diff(signal), 0.0) / dt
        return signal, rate, np.append(np.diff(rate), 0.0) / dt, 1
    if smoothing == "kalman":
        from identifiers.kalman import rts

        return (*rts(signal, dt), 9)
    from harness.physics.smoothing import smooth

    if smoothing in ("auto", "local"):
        found = smooth(signal, dt)
        travel = float(np.ptp(signal)) or 1.0
        if smoothing == "local" or found.width > 5 or found.error > _CLEAN * travel:
            return found.value, found.rate, found.acceleration, found.width
    from scipy.interpolate import make_interp_spline

    t = np.arange(signal.size) * dt
    # A held input makes the acceleration jump at every sample: cubic pieces between them, not higher ones.
    spline = make_interp_spline(t, signal, k=3 if signal.size < 6 else 5)
    return signal, spline.derivative()(t), spline.derivative(2)(t), 1
