"""The motor and the gear of a joint: a rotor behind the gear, and friction in its teeth, which no URDF has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.policy import ARM_POLICY
from harness.effects.effect import Effect, effect, par
from harness.effects.functions import sign, tanh
from harness.physics.arms.arm import ArmModel

__all__ = ["ON_LOAD", "ROTOR", "friction_of_the_load", "in_the_bodies", "rotor_inertia"]

ROTOR = "rotor_inertia"
ON_LOAD = "load_dependent_friction"
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


def friction_of_the_load(law: Effect, most: float, *, told: bool) -> Effect:
    """Return friction in proportion to the load as a gear has it, of which nobody knows which side's torque counts.

    A share mu of what the load needs (Hamon, Gautier & Garrec 2010, IROS), or of what the motor gives, or an
    efficiency: they differ by mu squared of the load both ways, which the wrong one of them makes a heavier link or a
    gain of the drive.

    Parameters
    ----------
    law : Effect
        Friction of the load as other coordinates have it.
    most : float
        Largest mu.
    told : bool
        Whether that is asked for: where the load is an inertia alone, a rotor does the same. Held at the motor's side,
        it leaves a rotor below nothing at most, and names none that is not there.
    """
    mu, width = law.parameters
    side = par("r", "1", scale="0.5" if told else "1", minimum=0.0, maximum=1.0, nuisance=True, fixed=not told,
               meaning="side whose torque counts: 0 the load's, 1 the motor's, 0.5 an efficiency")  # fmt: skip

    def passed(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
        return f / (1.0 + p.mu * sign(f) * tanh(v / p.w) + p.r * p.mu**2) - f

    return replace(
        law, parameters=(replace(mu, maximum=most), side, width), function=passed, extras=(),
        formula="F = f/(1 + mu sgn(f v) + r mu^2) - f: f = (1 + mu sgn(f v) + r mu^2) load, sgn(v) = tanh(v/w)",
    )  # fmt: skip


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
