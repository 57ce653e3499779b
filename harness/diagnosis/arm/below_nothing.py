"""A joint whose torque asks for an inertia below nothing: no plant has one, and what imitates it is no answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.policy import ARM_POLICY
from harness.physics.arms.arm import ArmModel
from harness.signals import FloatArray

__all__ = ["apparent_inertia", "inertia_below_nothing"]

NONE = (0.0, 0.0, 0.0)
"""No gravity."""


def inertia_below_nothing(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], moving: Sequence[int]
) -> tuple[str, ...]:
    """Return a sentence for every joint whose torque asks for an inertia below nothing, in all uses.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        Motions by use.
    moving : sequence of int
        Joints that are judged.
    """
    found = []
    for joint in moving:
        told = [apparent_inertia(arm, runs[use], joint) for use in ("estimation", "validation")]
        if all(value < -ARM_POLICY.below * deviation for value, deviation in told):
            drive, position = arm.inputs[joint], arm.positions[joint]
            found.append(
                f"the torque {drive.name} asks for an inertia of {told[0][0]:.3g} {drive.unit} s^2/{position.unit} at "
                f"{position.name}, below nothing: no plant has it, and what imitates it is no answer; check the signs "
                f"of {drive.name} and {position.name}, their clocks, and whether the torque is that of this joint"
            )
    return tuple(found)


def apparent_inertia(arm: ArmModel, runs: Sequence[ArmRun], joint: int) -> tuple[float, float]:
    """Return the inertia of a joint that its torque asks for, as a mean over its motion, and its standard error.

    Least squares of one joint's torque on five columns: the URDF's inertial torques and its gravity, each by a factor,
    the joint's own acceleration, viscous and dry friction. Bodies that are a little wrong change the factors; freeing
    them one by one would let what the filter takes from the acceleration decide. The errors of a filtered torque have
    as many independent values as twice its band times its length.

    Returns
    -------
    inertia, deviation : float
        In units of the torque over the acceleration; the deviation is infinite where the motion does not tell.
    """
    columns, torques, wanted, independent = [], [], [], 0.0
    for run in runs:
        calm, dt = run.calm, run.motion.sample_time
        rows = slice(None, None, max(len(calm.q) * len(runs) // ARM_POLICY.rows, 1))
        q, v, a = calm.q[rows], calm.v[rows], calm.a[rows]
        unit = np.zeros_like(a)
        unit[:, joint] = 1.0
        still = 0.0 * v
        inertial = arm.torques(q, v, a, NONE)[:, joint]
        gravity = arm.torques(q, still, still)[:, joint]
        own = a[:, joint], v[:, joint], _sign(v[:, joint])
        columns.append(np.column_stack([inertial, gravity, *own]))
        torques.append(calm.u[rows, joint])
        wanted.append(np.array([arm.torques(q, still, unit, NONE)[:, joint].mean(), 0.0, 1.0, 0.0, 0.0]))
        independent += min(2.0 * run.corner * len(calm.q) * dt, len(q))
    x, u = np.concatenate(columns), np.concatenate(torques)
    size = np.linalg.norm(x, axis=0)
    size[size == 0.0] = 1.0
    left, singular, right = np.linalg.svd(x / size, full_matrices=False)
    keep = singular > ARM_POLICY.told * singular[0]
    direction = np.mean(wanted, axis=0) / size
    told = right[keep] @ direction
    if np.linalg.norm(direction - right[keep].T @ told) > ARM_POLICY.untold * np.linalg.norm(direction):
        return 0.0, np.inf
    spread = max(independent - keep.sum(), 1.0)
    along = left[:, keep].T @ u
    rest = u - left[:, keep] @ along
    variance = float(rest @ rest) / spread  # of a mean over as many values as are independent
    return float(told @ (along / singular[keep])), float(np.sqrt(variance) * np.linalg.norm(told / singular[keep]))


def _sign(v: FloatArray) -> FloatArray:
    """Return the sign of a speed (N,), smoothed where it turns."""
    return np.tanh(v / (ARM_POLICY.turning * float(np.sqrt(np.mean(v**2))) + 1e-300))
