"""Does the URDF describe this arm at all? Wrong masses or lengths look like several smaller errors together.

A payload of a third of the arm, gains of two joints that carry gravity and zeros of every joint explain a log of an arm
whose URDF has half of its masses. So where more than one such effect was found, or the arm does not fit, its inertial
parameters are fitted freely: how far they are from the URDF's is measured by the torques that both ask for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.arm.effects import GAIN
from harness.diagnosis.arm.found import JointDiagnosis
from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.wide import WideRegression, WideResult
from harness.diagnosis.policy import ArmPolicy, Policy
from harness.physics.arms.arm import ArmModel
from harness.signals import FloatArray

__all__ = ["FreeBodies", "caution", "free_bodies", "look_like_another_arm", "other_arm_reasons", "unlikely_gains"]


@dataclass(frozen=True)
class FreeBodies:
    """What inertial parameters come to that are free of the URDF.

    Attributes
    ----------
    distance : float
        Rms of the torques by which they differ from the URDF's, over the rms of these: of all judged joints together.
    share : float
        Part of the torque's variance that they and each joint's friction explain, at the joint where it is least
        (validation records, parameters from the estimation records).
    beside : float
        Rms residual over that of the effects on the whole arm that were found beside the same friction, at the joint
        where it is largest.
    own : float
        The same over that of what every joint has by itself (friction, its rotor), at the joint where it is smallest.
    """

    distance: float
    share: float
    beside: float
    own: float


def look_like_another_arm(wide: WideResult, joints: Sequence[JointDiagnosis]) -> list[str]:
    """Return the effects that were found and that wrong masses or lengths can look like, by name and place."""
    whole = [str(known.placed) for known in wide.accepted if wide.effects[str(known.placed)].of_bodies]
    gains = [
        str(known.placed) for joint in joints for known in joint.outcome.accepted if known.placed.effect.name == GAIN
    ]
    return whole + gains


def unlikely_gains(joints: Sequence[JointDiagnosis], policy: ArmPolicy) -> list[str]:
    """Return the joints' torque gains that are off by more than torque constants are, by name and place."""
    found = []
    for joint in joints:
        for known in joint.outcome.accepted:
            if known.placed.effect.name == GAIN:
                factor = joint.final.values[known.placed.name("gain")]
                if not 1 / policy.drive < factor < policy.drive:
                    found.append(str(known.placed))
    return found


def free_bodies(
    arm: ArmModel,
    runs: Mapping[str, Sequence[ArmRun]],
    joints: Sequence[JointDiagnosis],
    wide: WideResult,
    directions: Sequence[FloatArray],
    policy: ArmPolicy,
) -> FreeBodies | None:
    """Return the fit with free inertial parameters beside the friction of every joint; None where there is none.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        With the torques that the URDF's bodies need.
    joints : sequence of JointDiagnosis
        Those that were judged.
    wide : WideResult
    directions : sequence of array (10 * bodies,)
        Of the inertial parameters that this motion moves.
    policy : ArmPolicy
    """
    places = [joint.joint for joint in joints]
    regression = WideRegression(arm, runs, places, directions, policy)
    fit = RegressionForm(regression, policy).fit((), [{}], None)
    if fit is None:
        return None
    equation = regression.equation(())
    p = np.array([fit.values[name] for name in equation.system.parameter_names])
    counts = np.concatenate(regression.counts["validation"])
    sharp = {use: [run.sharp for run in parts] for use, parts in runs.items()}  # what is left, of the true motion
    true = WideRegression(arm, sharp, places, directions, policy).equation(())
    alone = WideRegression(arm, sharp, places, (), policy).equation(())
    by_joint = np.array([wide.outcome.nominal.values[name] for name in alone.system.parameter_names])

    def rms(residual: Sequence[FloatArray]) -> FloatArray:
        squares = np.sum(np.concatenate(residual) ** 2 * counts, axis=0)
        return np.asarray(np.sqrt(squares / np.maximum(counts.sum(axis=0), 1)))

    left = rms([r for r, _ in true.residual(p, "validation")])
    without = rms([r for r, _ in alone.residual(by_joint, "validation")])
    found = rms(wide.fit.detail.residual["validation"])
    bodies = np.array([name in regression.own for name in equation.system.parameter_names])
    columns = np.concatenate([part for _, part in equation.residual(p, "estimation")])
    moved = columns[:, :, bodies] @ _told(columns, p, policy)[bodies]
    rigid = np.concatenate([run.slim(run.rigid[:, places], places) for run in runs["estimation"]])
    distance = float(np.sqrt(np.sum(moved**2) / max(float(np.sum(rigid**2)), 1e-300)))
    sizes = np.array([max(joint.torque, 1e-300) for joint in joints])
    return FreeBodies(
        distance,
        1.0 - float(np.max(left / sizes)) ** 2,
        float(np.max(left / np.maximum(found, 1e-300))),
        float(np.min(left / np.maximum(without, 1e-300))),
    )


def _told(columns: FloatArray, p: FloatArray, policy: ArmPolicy) -> FloatArray:
    """Return parameters (k,) without what columns (rows, n, k) do not tell of them: the shortest that fit as well.

    A rotor and an inertia about its axis are told by their sum only, and a fit may end at any two of that sum.
    """
    stacked = columns.reshape(-1, len(p))
    size = np.linalg.norm(stacked, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, singular, directions = np.linalg.svd(stacked / size, full_matrices=False)
    told = directions[singular > policy.moved * singular[0]]
    return np.asarray(told.T @ (told @ (p * size)) / size)


def other_arm_reasons(
    free: FreeBodies, alike: Sequence[str], policy: Policy, arm_policy: ArmPolicy, *, unlikely: bool = False
) -> tuple[str, ...]:
    """Return that the URDF is another arm's, and what to do; nothing where free inertial parameters do not say so.

    They have to be far from the URDF's, and to explain every joint, as well as all that was found does, and one of them
    far better than its own friction and rotor do.

    Parameters
    ----------
    free : FreeBodies
    alike : sequence of str
        What was found and may be another arm.
    policy : Policy
    arm_policy : ArmPolicy
    unlikely : bool
        What was found cannot be: then bodies need not do as well (with wrong lengths they cannot).
    """
    far = free.distance >= arm_policy.other_arm and free.own <= arm_policy.by_itself
    as_well = free.beside <= arm_policy.as_well or unlikely
    if not far or not as_well or free.share < 1.0 - policy.misfit_nrmse**2:
        return ()
    least = np.floor(1000 * free.share) / 10
    text = (
        f"this URDF does not describe this arm: masses or lengths. Fitted freely, inertial parameters explain "
        f"{least:g} % of every joint's torque, and ask for torques that differ from the URDF's by "
        f"{100 * free.distance:.0f} % of these"
    )
    if alike:
        text += f"; {_listed(alike)} together only imitate it"
    return (text, 'check masses, centres and lengths in the URDF, or fit them with options = {inertia = "calibrated"}')


def caution(alike: Sequence[str]) -> str:
    """Return what a reader should know of several effects that were found where another arm was not shown."""
    return (
        f"{_listed(alike)} were found together: a URDF with other masses or lengths can look like that; check it "
        'before you act on the names, or fit the bodies with options = {inertia = "calibrated"} and compare'
    )


def _listed(alike: Sequence[str]) -> str:
    return ", ".join(name.replace("_", " ").replace("@", " at ") for name in alike)
