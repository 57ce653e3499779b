"""Does the URDF describe this arm at all? Wrong masses or lengths look like several smaller errors together.

A payload of a third of the arm, gains of two joints that carry gravity and zeros of every joint explain a log of an arm
whose URDF has half of its masses. So the inertial parameters are fitted freely: how far they are from the URDF's is
measured by the torques that both ask for. With wrong lengths no bodies explain the torques, as what hangs on a joint
pulls at another arm than the file says: so the places of the joints are let go as well. Two of these are asked besides
as one number: a factor on all masses, which gears with much friction hide among a payload and a link.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.arm.effects import GAIN
from harness.diagnosis.arm.found import JointDiagnosis
from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.arm.regression import RegressionForm, TorqueRegression, regression_detail
from harness.diagnosis.arm.rotor import SPRINGS
from harness.diagnosis.arm.wide import WideResult
from harness.diagnosis.arm.wide_regression import WideRegression
from harness.diagnosis.policy import ARM_POLICY, ArmPolicy, Policy
from harness.diagnosis.records.motion import SmoothedMotion
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.table import value
from harness.models.damped import Damping, damped_descent
from harness.physics.arms.arm import GRAVITY, ArmModel
from harness.signals import FloatArray

MASSES = "inertia1"
"""Name of the one direction of the inertial parameters in which they are free: their own, a factor on all of them."""
DESCENT = Damping(start=1e-2, enough=1e-4, rounds=30)
"""Of the fit: what a cost falls by less than 0.01 % tells nothing more."""


@dataclass(frozen=True)
class FreeBodies:
    """What inertial parameters come to that are free of the URDF.

    Attributes
    ----------
    distance : float
        Rms of the torques by which they differ from the URDF's, over the rms of these: of all judged joints together.
    share : array (n,)
        Part of the torque's variance that they and the joint's friction explain (validation records, parameters from
        the estimation records).
    beside : array (n,)
        Rms residual over that of the effects on the whole arm that were found beside the same friction.
    own : array (n,)
        The same over that of what every joint has by itself (friction, its rotor).
    factor : float
        On all masses of the URDF, where that alone is fitted beside what joints have by themselves.
    gained : float
        By how much that is likelier than all that was found on the whole arm.
    """

    distance: float
    share: FloatArray
    beside: FloatArray
    own: FloatArray
    factor: float
    gained: float


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
    springs = any(known.placed.effect.name in SPRINGS for known in wide.accepted)  # told on another motion
    regression = WideRegression(arm, runs, places, (), policy)
    freed = runs_of_another_arm(arm, runs, regression.equation(()).columns["estimation"], places)
    fit = RegressionForm(WideRegression(arm, freed, places, (), policy), policy).fit((), [{}], None)
    scaled = RegressionForm(WideRegression(arm, runs, places, (arm.arm.parameters,), policy), policy).fit(
        (), [{}], None
    )
    if fit is None or scaled is None:
        return None

    def left_by(runs: Mapping[str, Sequence[ArmRun]], fit: Fit) -> FloatArray:
        """Return the rms residual (n,) on the true motion of the validation records."""
        sharp = {use: [run.sharp for run in parts] for use, parts in runs.items()}
        there = RegressionForm(WideRegression(arm, sharp, places, (), policy), policy).at(fit)
        assert there is not None  # finite along the calm motion
        return _rms(regression_detail(there).residual["validation"], regression)

    left, without = left_by(freed, fit), left_by(runs, wide.outcome.nominal)
    judged = wide.outcome.form  # with springs along other rows
    assert isinstance(judged, RegressionForm)
    found = _rms(regression_detail(wide.fit).residual["validation"], judged.regression)
    rigid, moved = (
        np.concatenate([run.slim(torque[:, places], places) for run, torque in each])
        for each in (
            [(run, run.rigid) for run in runs["estimation"]],
            [(new, new.rigid - run.rigid) for run, new in zip(runs["estimation"], freed["estimation"], strict=True)],
        )
    )
    sizes = np.array([max(joint.torque, 1e-300) for joint in joints])
    return FreeBodies(
        float(np.sqrt(np.sum(moved**2) / max(float(np.sum(rigid**2)), 1e-300))),
        1.0 - (left / sizes) ** 2,
        left / np.maximum(found, 1e-300),
        left / np.maximum(without, 1e-300),
        1.0 + scaled.values[MASSES],
        value(scaled) - value(wide.fit) if not springs else -np.inf,
    )


def _rms(residual: Sequence[FloatArray], regression: TorqueRegression) -> FloatArray:
    """Return the rms (n,) of residual torques along the rows of the validation records that count."""
    counts = np.concatenate(regression.counts["validation"])
    return np.asarray(
        np.sqrt(np.sum(np.concatenate(residual) ** 2 * counts, axis=0) / np.maximum(counts.sum(axis=0), 1))
    )


def other_arm_reasons(
    free: FreeBodies,
    arm: ArmModel,
    joints: Sequence[int],
    alike: Sequence[str],
    policy: Policy,
    arm_policy: ArmPolicy,
    *,
    unlikely: bool = False,
) -> tuple[str, ...]:
    """Return that the URDF is another arm's, and what to do; nothing where free inertial parameters do not say so.

    They have to be far from the URDF's, and to mend some joints far beyond their own friction and rotors, which they
    then explain: the others, of wrists with friction alone, say nothing of bodies. And they explain some joint far
    better than all that was found, while no other is lost, or one factor on all masses does as well as that: what names
    a few links and leaves as little is the shorter answer.

    Parameters
    ----------
    free : FreeBodies
    arm : ArmModel
    joints : sequence of int
        Those that were judged.
    alike : sequence of str
        What was found and may be another arm.
    policy : Policy
    arm_policy : ArmPolicy
    unlikely : bool
        What was found cannot be: then it need not leave more than bodies do.
    """
    told = free.own <= arm_policy.by_itself
    if free.distance < arm_policy.other_arm or not told.any():
        return ()
    least = float(np.min(free.share[told]))
    drives = 1 / arm_policy.drive < free.factor < arm_policy.drive
    shorter = free.gained >= (policy.evidence if not alike else -policy.tie) and len(alike) != 1 and not drives
    better = np.min(free.beside) <= arm_policy.far_better and np.max(free.beside) <= arm_policy.as_well
    if not (better or unlikely or shorter) or least < 1.0 - policy.misfit_nrmse**2:
        return ()
    where = [arm.positions[joint].name for joint, mended in zip(joints, told, strict=True) if mended]
    text = (
        f"this URDF does not describe this arm: masses or lengths of what {', '.join(where)} carry. Fitted freely, "
        f"inertial parameters explain {np.floor(1000 * least) / 10:g} % of the torque of each of these joints, and ask "
        f"for torques that differ from the URDF's by {100 * free.distance:.0f} % of these"
    )
    if shorter:
        text += f"; {free.factor:.2g} times all masses of the URDF, or torques {1 / free.factor:.2g} times, do as well"
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


def runs_of_another_arm(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], own: Sequence[FloatArray], joints: Sequence[int]
) -> dict[str, tuple[ArmRun, ...]]:
    """Return the records with the torques that the arm needs whose masses and lengths fit them best.

    Inertial parameters (10 a body) and the places of the joints (3 each) are free, with standard deviations of the
    largest body and the longest link of the file: so what the motion does not tell stays as the file says, and what a
    joint's own friction and rotor explain as well is left to these.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        Records by use; the fit is to ``"estimation"``.
    own : sequence of array (rows, n, k)
        What every joint could do by itself, decimated, one an estimation record.
    joints : sequence of int
        The n joints that are judged.
    """
    import casadi as ca

    bodies, k = len(arm.arm.parameters), own[0].shape[2]
    start = np.concatenate([arm.arm.parameters, *(joint.offset for joint in arm.arm.joints)])
    free = ca.SX.sym("free", len(start))
    arguments, torques = arm.arm.symbolic_torques(free[:bodies], free[bodies:])
    needs = ca.Function("needs", [*arguments, free], [torques])
    gradient_of = ca.Function("gradient", [*arguments, free], [ca.jacobian(torques, free)])

    def motion(m: SmoothedMotion) -> list[FloatArray]:
        return [*(np.ascontiguousarray(part.T) for part in (m.q, m.v, m.a)), np.array(GRAVITY)]

    def needed(m: SmoothedMotion, at: FloatArray) -> FloatArray:
        return np.array(needs(*motion(m), at)).T

    records = runs["estimation"]
    targets = [run.slim((run.motion.u - run.rigid + needed(run.calm, start))[:, joints], joints) for run in records]
    spread = np.concatenate([np.full(k, np.inf), _spread(arm)])

    def residual(point: FloatArray) -> FloatArray:
        """Return the residual (rows, n) of all records."""
        made = [run.slim(needed(run.calm, point[k:])[:, joints], joints) for run in records]
        return np.concatenate([c @ point[:k] + t - y for c, t, y in zip(own, made, targets, strict=True)])

    def gradient(point: FloatArray) -> FloatArray:
        """Return its gradient (rows, n, k + bodies + places)."""
        parts = []
        for run, columns in zip(records, own, strict=True):
            flat = np.array(gradient_of(*motion(run.calm), point[k:]))
            whole = flat.reshape(arm.n, -1, len(start)).transpose(1, 0, 2)
            parts.append(np.concatenate([columns, run.slim(whole[:, joints], joints)], axis=2))
        return np.concatenate(parts)

    def fitted(point: FloatArray, noise: FloatArray) -> FloatArray:
        def cost(point: FloatArray) -> float:
            return float(np.sum((residual(point) / noise) ** 2) + np.sum(((point - begin) / spread) ** 2))

        def linearised(point: FloatArray) -> tuple[FloatArray, FloatArray]:
            rows = (gradient(point) / noise[:, None]).reshape(-1, len(point))
            gram = rows.T @ rows + np.diag(spread**-2.0)
            return gram, rows.T @ (residual(point) / noise).ravel() + (point - begin) / spread**2

        def moved(point: FloatArray, system: tuple[FloatArray, FloatArray], size: float) -> FloatArray:
            gram, side = system
            scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
            normal = gram / np.outer(scale, scale) + size * np.eye(len(point))
            return np.asarray(point - np.linalg.solve(normal, side / scale) / scale)

        return damped_descent(point, cost, linearised, moved, DESCENT)

    begin = np.concatenate([np.zeros(k), start])
    point, size = begin, np.sqrt(np.mean(np.concatenate(targets) ** 2, axis=0))
    for _ in range(ARM_POLICY.reweighed):
        point = fitted(point, np.maximum(size, 1e-300))
        size = np.sqrt(np.mean(residual(point) ** 2, axis=0))

    def carried(run: ArmRun) -> ArmRun:
        return replace(run, rigid=run.rigid + needed(run.motion, point[k:]) - needed(run.motion, start))

    return {use: tuple(carried(run) for run in each) for use, each in runs.items()}


def _spread(arm: ArmModel) -> FloatArray:
    """Return the standard deviation of inertial parameters and places of joints of another arm of about this size."""
    joints = arm.arm.joints
    mass = max(joint.mass for joint in joints)
    length = max(float(np.linalg.norm(vector)) for joint in joints for vector in (joint.offset, joint.centre))
    one = np.repeat([mass, mass * length, mass * length**2], [1, 3, 6])
    return np.concatenate([np.tile(one, len(joints)), np.full(3 * len(joints), length)])
