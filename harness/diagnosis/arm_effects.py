"""Effects that act on several joints of an arm: payload, tilted base, wrong link, joint zero, elasticity, gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.arm_motion import ArmRun
from harness.physics.arm import ArmModel
from harness.signals import FloatArray

__all__ = ["GAIN", "Wide", "wide_effects"]

STEP = 1e-4
GAIN = "input_gain"


@dataclass(frozen=True, eq=False)
class Wide:
    """An effect on several joints.

    Attributes
    ----------
    name, at : str
    parameters : tuple of (name, unit, meaning)
        The first one decides.
    sign : {1, 0}
        1 if only a positive first parameter is physical.
    columns : callable
        ``ArmRun -> (N, n, k)``: torque that the joints need more, for a parameter of 1.
    summary, formula, experiment : str
        For the report.
    nests : tuple of str
        Names of special cases of it at the same place.
    """

    name: str
    at: str
    parameters: tuple[tuple[str, str, str], ...]
    columns: Callable[[ArmRun], FloatArray]
    sign: int = 0
    summary: str = ""
    formula: str = ""
    experiment: str = ""
    nests: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.name}@{self.at}"


def wide_effects(arm: ArmModel) -> list[Wide]:
    """Return the effects on several joints that are looked for."""
    found: list[Wide] = []
    tip = arm.links[-1]
    frame = arm.arm.joints[tip].name

    def body(row: int, offset: int) -> Callable[[ArmRun], FloatArray]:
        unit = np.zeros(10 * len(arm.arm.joints))
        unit[10 * row + offset] = 1.0
        return lambda run: arm.torques(run.calm.q, run.calm.v, run.calm.a, parameters=unit)[:, :, None]

    mass = ("m", "kg", "mass at the end of the arm")
    moments = tuple(
        (f"m{axis}", "kg m", f"mass times its distance along {axis} of the last link's frame") for axis in "xyz"
    )
    load = [body(tip, k) for k in range(4)]
    heavier = "the same motion with a known mass in addition: the scale of the torque tells a payload from a gain"
    found.append(
        Wide("payload", "flange", (mass,), load[0], 1, "A point mass at the end of the arm.",
             f"tau = ID(q, v, a) + m ID_unit mass at {frame}", heavier)
    )  # fmt: skip
    found.append(
        Wide("payload_off_centre", "flange", (mass, *moments),
             lambda run: np.concatenate([one(run) for one in load], axis=2), 1,
             "A mass at the end of the arm, its centre beside the frame of the last link.",
             f"tau = ID(q, v, a) + m ID_unit mass at {frame} + (m c) ID_unit moment", heavier, ("payload",))
    )  # fmt: skip
    turning = ("turn the base, or mount it on a level plate: a tilt moves with the base, an encoder's zero does not",)

    def tilted(run: ArmRun) -> FloatArray:
        still = np.zeros_like(run.calm.q)
        return np.stack(
            [arm.torques(run.calm.q, still, still, one) for one in ((9.81, 0.0, 0.0), (0.0, 9.81, 0.0))], axis=2
        )

    found.append(
        Wide("gravity_tilt", "base", (("x", "rad", "tilt of gravity towards x of the base"),
                                      ("y", "rad", "tilt of gravity towards y of the base")),
             tilted, 0, "The base does not stand upright.", "gravity = 9.81 (x, y, -1)", turning[0])
    )  # fmt: skip
    for k, channel in enumerate(arm.positions):
        found.append(
            Wide("sensor_offset", channel.name, (("offset", channel.unit, "reading minus true position"),),
                 _zero(arm, k), 0, "The zero of the position sensor is wrong.",
                 f"{channel.name} = true position + offset", turning[0])
        )  # fmt: skip
        found.append(
            Wide("joint_elasticity", channel.name,
                 (("compliance", f"{channel.unit}/({arm.inputs[k].unit})", "1/stiffness between motor and link"),),
                 _elastic(arm, k), 1, "The joint gives way under its torque; motor side measured.",
                 f"{channel.name} of the link = {channel.name} - compliance * {arm.inputs[k].name}",
                 "fast excitation (to half of the resonance sqrt(k/J)), or a position sensor on the link")
        )  # fmt: skip
    for number in arm.links:
        joint = arm.arm.joints[number]
        if joint.mass > 0:
            found.append(
                Wide("link_mass", f"link of {joint.name}", (("scale", "1", "relative error of mass and inertia"),),
                     _link(arm, number), 0, "The URDF gives this link the wrong mass and inertia.",
                     "mass and inertia of the link times (1 + scale)", heavier)
            )  # fmt: skip
    for k, channel in enumerate(arm.inputs):
        found.append(
            Wide(GAIN, channel.name, (("gain", "1", "relative error of the torque"),), _gain(k), 0,
                 "The torque of one joint is wrong by a factor.", "left to the search on the joint", heavier)
        )  # fmt: skip
    return found


def _zero(arm: ArmModel, k: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a wrong joint zero: minus the slope of the torques over that joint's position."""

    def columns(run: ArmRun) -> FloatArray:
        m, step = run.calm, np.zeros(arm.n)
        step[k] = STEP
        high, low = arm.torques(m.q + step, m.v, m.a), arm.torques(m.q - step, m.v, m.a)
        return np.asarray(-(high - low)[:, :, None] / (2 * STEP))

    return columns


def _elastic(arm: ArmModel, k: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a joint's compliance: the link lags the motor by compliance times torque.

    The torque through the spring is what the link needs, so the torques of the motion are those at
    q - c tau, v - c tau', a - c tau'' of the joint (Spong, J. Dyn. Sys. Meas. Control 109 (1987) 310), to first order
    in c; smooth nominal torques stand for tau, because derivatives of measured ones are noise.
    """

    def columns(run: ArmRun) -> FloatArray:
        m = run.calm
        tau, first, second = run.calm.u[:, k], run.first[:, k], run.second[:, k]
        step = STEP / max(float(np.abs(tau).max()), 1e-9)
        parts = []
        for sign in (1.0, -1.0):
            q, v, a = m.q.copy(), m.v.copy(), m.a.copy()
            q[:, k] += sign * step * tau
            v[:, k] += sign * step * first
            a[:, k] += sign * step * second
            parts.append(arm.torques(q, v, a))
        return np.asarray(-(parts[0] - parts[1])[:, :, None] / (2 * step))

    return columns


def _gain(k: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a wrong torque gain."""

    def columns(run: ArmRun) -> FloatArray:
        result = np.zeros((*run.calm.u.shape, 1))
        result[:, k, 0] = run.calm.u[:, k]
        return result

    return columns


def _link(arm: ArmModel, number: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of one link's mass and inertia."""
    own = np.zeros_like(arm.arm.parameters)
    own[10 * number : 10 * number + 10] = arm.arm.parameters[10 * number : 10 * number + 10]
    return lambda run: arm.torques(run.calm.q, run.calm.v, run.calm.a, parameters=own)[:, :, None]
