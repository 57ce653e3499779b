"""How far the torques of an arm's model are from those that were measured, joint by joint, along a measured motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from harness.physics.arms.arm import ArmModel
from harness.scoring import TorqueError
from harness.signals import FloatArray, Trajectory
from identifiers.mechanics.motion import motion

THINNED = 2.5  # Rows that are kept in a period of the corner: two tell what is below it, the filter is not steep.


def torque_errors(
    arm: ArmModel,
    torques: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    record: Trajectory,
    seen: Mapping[str, Any],
) -> tuple[TorqueError, ...]:
    """Return the errors of a model's torques along the measured motion of a record, by joint.

    Measured and predicted torques are low-passed alike, as they were in the fit: above its corner is noise.

    Parameters
    ----------
    arm : ArmModel
    torques : callable
        Torques (N, n) that a model needs for positions, rates and accelerations (N, n).
    record : Trajectory
    seen : mapping
        ``smoothing``, ``intersample`` and ``corner`` [Hz] of the fit.

    Raises
    ------
    FitError
        If a joint position was not measured.
    """
    from scipy import signal

    moved = motion(SimpleNamespace(coordinates=arm.positions), record, seen.get("smoothing", "auto"))
    held = moved.u if seen.get("intersample") == "smooth" else moved.mean_u
    taps, step = low_pass(float(seen.get("corner", np.inf)) * float(moved.t[1] - moved.t[0]), len(moved.t))
    miss, told = (
        signal.oaconvolve(rows, taps[:, None], mode="valid", axes=0)[::step]
        for rows in (torques(moved.q, moved.v, moved.a) - held, held)
    )
    rms, spread = np.sqrt(np.mean(miss**2, axis=0)), np.std(told, axis=0)
    return tuple(
        TorqueError(channel.name, channel.unit, float(error), float(error / size) if size > 0 else float("inf"))
        for channel, error, size in zip(arm.inputs, rms, spread, strict=True)
    )


def low_pass(corner: float, rows: int) -> tuple[FloatArray, int]:
    """Return the taps of a low pass at a corner (a share of the sample rate), and how far its output is thinned.

    Examples
    --------
    >>> taps, step = low_pass(0.02, 4000)
    >>> len(taps), step, float(taps.sum().round(6))
    (81, 20, 1.0)
    """
    from scipy import signal

    step = int(1 / (THINNED * corner)) if corner > 0 else 1
    count = 4 * step + 1
    if step < 2 or 4 * count > rows:  # nothing to take out, or a record that its ends would eat up
        return np.ones(1), 1
    return np.asarray(signal.firwin(count, corner, fs=1.0)), step
