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
from harness.diagnosis.arm.geometry import runs_of_another_arm
from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.arm.regression import RegressionForm, regression_detail
from harness.diagnosis.arm.wide import WideResult
from harness.diagnosis.arm.wide_regression import WideRegression
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
    beside, better : float
        Rms residual over that of the effects on the whole arm that were found beside the same friction, at the joint
        where it is largest, and where it is smallest.
    own : float
        The same over that of what every joint has by itself (friction, its rotor), at the joint where it is smallest.
    """

    distance: float
    share: float
    beside: float
    better: float
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
    policy: ArmPolicy,
) -> FreeBodies | None:
    """Return the fit with free inertial parameters and lengths beside every joint's friction; None if there is none.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        With the torques that the URDF's bodies need.
    joints : sequence of JointDiagnosis
        Those that were judged.
    wide : WideResult
    policy : ArmPolicy
    """
    places = [joint.joint for joint in joints]
    regression = WideRegression(arm, runs, places, (), policy)
    freed = runs_of_another_arm(arm, runs, regression.equation(()).columns["estimation"], places)
    fit = RegressionForm(WideRegression(arm, freed, places, (), policy), policy).fit((), [{}], None)
    if fit is None:
        return None
    counts = np.concatenate(regression.counts["validation"])

    def left_by(runs: Mapping[str, Sequence[ArmRun]], values: Mapping[str, float]) -> FloatArray:
        """Return the rms residual (n,) on the true motion of the validation records."""
        sharp = {use: [run.sharp for run in parts] for use, parts in runs.items()}
        equation = WideRegression(arm, sharp, places, (), policy).equation(())
        p = np.array([values[name] for name in equation.system.parameter_names])
        return rms([r for r, _ in equation.residual(p, "validation")])

    def rms(residual: Sequence[FloatArray]) -> FloatArray:
        squares = np.sum(np.concatenate(residual) ** 2 * counts, axis=0)
        return np.asarray(np.sqrt(squares / np.maximum(counts.sum(axis=0), 1)))

    left, without = left_by(freed, fit.values), left_by(runs, wide.outcome.nominal.values)
    found = rms(regression_detail(wide.fit).residual["validation"])
    rigid, moved = (
        np.concatenate([run.slim(torque[:, places], places) for run, torque in each])
        for each in (
            [(run, run.rigid) for run in runs["estimation"]],
            [(new, new.rigid - run.rigid) for run, new in zip(runs["estimation"], freed["estimation"], strict=True)],
        )
    )
    distance = float(np.sqrt(np.sum(moved**2) / max(float(np.sum(rigid**2)), 1e-300)))
    sizes = np.array([max(joint.torque, 1e-300) for joint in joints])
    return FreeBodies(
        distance,
        1.0 - float(np.max(left / sizes)) ** 2,
        float(np.max(left / np.maximum(found, 1e-300))),
        float(np.min(left / np.maximum(found, 1e-300))),
        float(np.min(left / np.maximum(without, 1e-300))),
    )


def other_arm_reasons(
    free: FreeBodies, alike: Sequence[str], policy: Policy, arm_policy: ArmPolicy, *, unlikely: bool = False
) -> tuple[str, ...]:
    """Return that the URDF is another arm's, and what to do; nothing where free inertial parameters do not say so.

    They have to be far from the URDF's, and to explain every joint, one of them far better than its own friction and
    rotor do, and far better than all that was found does while no other is lost. What names a few links and leaves as
    little is the shorter answer.

    Parameters
    ----------
    free : FreeBodies
    alike : sequence of str
        What was found and may be another arm.
    policy : Policy
    arm_policy : ArmPolicy
    unlikely : bool
        What was found cannot be: then it need not leave more than bodies do.
    """
    far = free.distance >= arm_policy.other_arm and free.own <= arm_policy.by_itself
    better = (free.better <= arm_policy.far_better and free.beside <= arm_policy.as_well) or unlikely
    if not far or not better or free.share < 1.0 - policy.misfit_nrmse**2:
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
