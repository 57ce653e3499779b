"""The rotor of a joint's motor: its inertia behind the gear, which no body of a URDF has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.policy import ARM_POLICY
from harness.effects.effect import effect, par
from harness.physics.arms.arm import ArmModel

__all__ = ["ROTOR", "in_the_bodies", "rotor_inertia"]

ROTOR = "rotor_inertia"
ROWS = 400
"""Samples on which it is asked whether bodies could do the same."""


@effect(
    "coordinate",
    [par("J", "F/a", scale="0.05 F/a", sign="+", neutral=0.0, main=True, linear=True,
         meaning="inertia of the rotor times the square of the gear ratio")],
    formula="F = -J a, a the acceleration of the joint alone, not that of the link in space",
    family=("input_gain",),
    same_as={"parameter": "on joints whose link turns about the joint's axis with the joint alone, such as the first"},
    experiment="the same path at several speeds: the torque grows with the square of the speed, and gravity stays",
)  # fmt: skip
def rotor_inertia(f: Any, s: Any, p: Any, q: Any, v: Any, a: Any) -> Any:
    """Rotor of the motor, geared up: it turns with its joint, wherever the arm carries it."""
    return -p.J * a


def in_the_bodies(arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], joint: int) -> bool:
    """Return whether inertial parameters of the bodies can do the same as the rotor of a joint, in these records.

    So it is at the first joint, and at the second one if its axis stands at a right angle to the first: they are known
    with the moment of inertia of the link about the axis only (Khalil & Dombre 2002, *Modeling, Identification and
    Control of Robots*, sec. 9.4).

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        From :func:`harness.diagnosis.arm.motion.arm_runs`.
    joint : int
        From 0.
    """
    columns, torques = [], []
    for run in runs["estimation"]:
        m = run.calm
        rows = slice(None, None, max(len(m.q) // ROWS, 1))
        columns.append(arm.arm.regressor(m.q[rows], m.v[rows], m.a[rows]))
        torque = np.zeros_like(m.q[rows])
        torque[:, joint] = m.a[rows][:, joint]
        torques.append(torque.ravel())
    x, wanted = np.concatenate(columns), np.concatenate(torques)
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    left = wanted - x @ np.linalg.lstsq(x, wanted, rcond=1e-9)[0]
    return bool(np.linalg.norm(left) < ARM_POLICY.rounded * np.linalg.norm(wanted))
