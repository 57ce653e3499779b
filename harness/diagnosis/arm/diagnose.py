"""Closing the loop on an arm: what acts on the whole arm first, then every joint on its own torque residual."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.diagnosis.arm.bodies import ArmBodies, bodies_of_arm, bodies_of_joints, unit_torques
from harness.diagnosis.arm.checks import check_torques
from harness.diagnosis.arm.found import ArmDiagnosis, JointDiagnosis
from harness.diagnosis.arm.geared import beside_the_usual, rotor_or_gain, with_rivals
from harness.diagnosis.arm.joint import JointRegression, joint_dictionary
from harness.diagnosis.arm.misfit import inertia_below_nothing, likely_mistake, misfit_reasons
from harness.diagnosis.arm.motion import ArmRun, arm_runs, standstill, white_noise
from harness.diagnosis.arm.other_arm import (
    caution,
    free_bodies,
    look_like_another_arm,
    other_arm_reasons,
    unlikely_gains,
)
from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.rotor import ROTOR, in_the_bodies
from harness.diagnosis.arm.simpler import with_simpler_laws
from harness.diagnosis.arm.wide import WideResult, wide_search
from harness.diagnosis.policy import ARM_POLICY, POLICY, ArmPolicy, Policy
from harness.diagnosis.records.prepare import checked
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.leftover import left_over
from harness.diagnosis.search.search import search
from harness.effects.effect import Effect
from harness.errors import FitError, InputError
from harness.physics.arms.arm import ArmModel
from harness.signals import Dataset, FloatArray
from harness.supervision.workers import one_thread

ROUNDS = 3
"""Times that joints are searched beside bodies, at most."""

Progress = Callable[[float, str], None]


def diagnose_arm(
    dataset: Dataset,
    arm: ArmModel,
    *,
    progress: Progress | None = None,
    dictionary: Sequence[Effect] | None = None,
    policy: Policy = POLICY,
    arm_policy: ArmPolicy = ARM_POLICY,
) -> ArmDiagnosis:
    """Find what an arm lacks, by inverse dynamics.

    Given the measured motion of all joints, the equation of each joint stands alone. So what acts on several joints
    (payload, tilt, a wrong link, a joint's zero, elasticity) is looked for first, with the friction of all joints
    taken out; then every joint is searched on its own torque residual, for up to three effects. Both searches are the
    same one, of :mod:`harness.diagnosis.search`: the likelihood of the torques, their errors coloured.

    Parameters
    ----------
    dataset : Dataset
        Torques and positions of every joint, estimation and validation runs.
    arm : ArmModel
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    dictionary : sequence of Effect, optional
        Effects to try at the joints; by default :data:`harness.diagnosis.arm.joint.JOINT_EFFECTS`.
    policy : Policy
    arm_policy : ArmPolicy
        The deciding numbers.

    Raises
    ------
    InputError
        If the data do not fit the arm, or no joint moves.
    FitError
        If the torques that the arm needs along the motion are not finite.
    """
    began = time.monotonic()

    def say(part: float, what: str) -> None:
        if progress is not None:
            progress(part, what)

    with one_thread():
        dataset = checked(dataset, arm)
        warnings = [*dataset.warnings, *arm.notes, *check_torques(dataset.runs)]
        say(0.02, "motion of the joints")
        runs = arm_runs(arm, dataset)
        still = np.where(_only_noise(arm, dataset), 1.0, standstill(runs))
        moving = _moving(arm, dataset, still, arm_policy)
        warnings += [
            f"{arm.positions[k].name} stands still for {100 * still[k]:.0f} % of the time: "
            "its torque is not judged (record it moving)"
            if still[k] > arm_policy.sticks
            else f"{arm.inputs[k].name} never changes although {arm.positions[k].name} moves: its joint is not judged"
            for k in range(arm.n)
            if k not in moving
        ]
        directions = [] if arm.inertia == "fixed" else _inertial_directions(arm, runs["estimation"])

        def whole(runs: dict[str, tuple[ArmRun, ...]], free: list[FloatArray]) -> WideResult:
            return wide_search(
                arm, runs, moving, calibrated=free, say=lambda text: say(0.15, text), policy=policy,
                arm_policy=arm_policy,
            )  # fmt: skip

        def every(runs: dict[str, tuple[ArmRun, ...]], wide: WideResult, free: bool) -> tuple[JointDiagnosis, ...]:
            calibrated = _calibrated_torques(arm, runs, directions) if free else {}
            joints = []
            for place, k in enumerate(moving):
                say(0.3 + 0.55 * place / len(moving), f"joint {k + 1}")
                joints.append(_joint(arm, k, dataset, runs, wide, calibrated, dictionary, policy, arm_policy))
            return tuple(joints)

        say(0.1, "effects on the whole arm")
        wide = whole(runs, directions)
        if directions:
            wide, joints, bodies = _with_bodies(arm, runs, moving, wide, whole, every)
        else:
            joints, bodies = every(runs, wide, False), None
        diagnosis = ArmDiagnosis(
            dataset, arm, runs, wide, joints, still, bodies=bodies, policy=policy, warnings=warnings + wide.notes
        )
        diagnosis.misfit = _misfit(diagnosis, arm_policy)
        alike = look_like_another_arm(wide, joints)
        if not diagnosis.misfit and arm.inertia == "fixed" and len(alike) >= arm_policy.several:
            diagnosis.warnings.append(caution(alike))
    diagnosis.seconds = time.monotonic() - began
    return diagnosis


def _misfit(found: ArmDiagnosis, policy: ArmPolicy) -> tuple[str, ...]:
    """Return why the arm does not fit its log and what to check, a wrong URDF included; empty if it fits."""
    reasons = misfit_reasons(found.arm, found.joints, found.policy)
    judged = [joint.joint for joint in found.joints]
    below = inertia_below_nothing(found.arm, found.runs, judged)
    mistake = likely_mistake(found.dataset, found.arm, found.runs, judged, found.policy) if reasons else ()
    if below and not mistake:
        return (*below, *reasons)
    alike = look_like_another_arm(found.wide, found.joints)
    if not mistake and found.arm.inertia == "fixed" and (reasons or alike):
        free = free_bodies(found.arm, found.runs, found.joints, found.wide, policy)
        named = [] if reasons else alike
        unlikely = len(unlikely_gains(found.joints, policy)) >= policy.several
        other = free and other_arm_reasons(free, found.arm, judged, named, found.policy, policy, unlikely=unlikely)
        if other:
            return other
    return (*reasons, *mistake)


def _with_bodies(
    arm: ArmModel,
    runs: dict[str, tuple[ArmRun, ...]],
    moving: Sequence[int],
    wide: WideResult,
    whole: Callable[[dict[str, tuple[ArmRun, ...]], list[FloatArray]], WideResult],
    every: Callable[[dict[str, tuple[ArmRun, ...]], WideResult, bool], tuple[JointDiagnosis, ...]],
) -> tuple[WideResult, tuple[JointDiagnosis, ...], ArmBodies]:
    """Return what was found beside bodies that mass can make.

    Directions of the inertial parameters stay free in the search while bodies do as well as they. Where they would have
    to be a body that no mass makes, something else is hidden in them: then the search goes on beside the bodies that
    come nearest, until what it finds leaves them alone.
    """
    bodies = bodies_of_arm(arm, runs, moving, wide)
    if not bodies.possible:
        wide = whole(bodies.runs(arm, runs), [])
        bodies = bodies_of_arm(arm, runs, moving, wide)
    names: list[str] = []
    for _ in range(ROUNDS):
        joints = every(bodies.runs(arm, runs), wide, bodies.possible)
        free = bodies.possible
        bodies = bodies_of_joints(arm, runs, {joint.joint: joint.final for joint in joints}, wide)
        now = [str(accepted.placed) for joint in joints for accepted in joint.outcome.accepted]
        if free or now == names:
            break
        names = now
    own = bodies.runs(arm, runs)
    for joint in joints:
        known = {use: [wide.torque(run)[:, joint.joint] for run in parts] for use, parts in own.items()}
        regression = JointRegression(arm, joint.joint, own, known)
        fit = RegressionForm(regression, joint.policy).fit(joint.final.effects, [joint.final.values], joint.final)
        if fit is not None:
            joint.closed = regression, fit = _on_the_true_motion(arm, own, known, (regression, fit), joint.policy)
            joint.leftover = left_over(RegressionForm(regression, joint.policy), fit)
    return wide, joints, bodies


def _only_noise(arm: ArmModel, dataset: Dataset) -> NDArray[np.bool_]:
    """Return for every joint whether its position is hardly more than noise: it stands still."""
    sizes = [
        [float(np.std(run.y[:, k])) > ARM_POLICY.sure * white_noise(run.y[:, k]) for run in dataset.estimation]
        for k in range(arm.n)
    ]
    return np.array([not any(runs) for runs in sizes])


def _moving(arm: ArmModel, dataset: Dataset, still: FloatArray, policy: ArmPolicy) -> list[int]:
    """Return the joints that can be judged: they move enough and their torque was measured. Refuse an arm without."""
    moving = [k for k in range(arm.n) if still[k] <= policy.sticks]
    if not moving:
        raise InputError(
            f"no joint of {dataset.name!r} moves",
            expected="a joint in motion for a third of the time",
            got=", ".join(
                f"{channel.name} {100 * (1 - s):.0f} %" for channel, s in zip(arm.positions, still, strict=True)
            ),
            remedy="record the arm on a path that keeps its joints moving",
        )
    told = [k for k in moving if all(np.ptp(run.u[:, k]) > 0 for run in (*dataset.estimation, *dataset.validation))]
    if not told:
        raise InputError(
            f"no torque of {dataset.name!r} changes, although joints move",
            expected="the torques that went with the motion",
            got=", ".join(
                f"{arm.inputs[k].name} = {dataset.estimation[0].u[0, k]:g} {arm.inputs[k].unit}" for k in moving
            )
            + " in every row",
            remedy="log measured or commanded torques: some simulators report 0 for the torques that a user commands",
        )
    return told


def _joint(
    arm: ArmModel,
    k: int,
    dataset: Dataset,
    runs: dict[str, tuple[ArmRun, ...]],
    wide: WideResult,
    calibrated: Mapping[str, Sequence[FloatArray]],
    dictionary: Sequence[Effect] | None,
    policy: Policy,
    arm_policy: ArmPolicy,
) -> JointDiagnosis:
    """Search one joint."""
    known = {use: [wide.torque(run)[:, k] for run in parts] for use, parts in runs.items()}
    free = _free_columns(calibrated, k) if calibrated else None
    fast = {use: [wide.fast(run, k) for run in parts] for use, parts in runs.items()}
    needed = {use: [a + b for a, b in zip(known[use], fast[use], strict=True)] for use in runs}
    regression = JointRegression(arm, k, runs, needed, free)
    form = RegressionForm(regression, arm_policy)
    nominal = form.fit((), [{}], None)
    if nominal is None:
        raise FitError(
            f"the torque of joint {k + 1}",
            expected="finite torques along the measured motion",
            got="others",
            remedy="check units and spikes of the positions",
        )
    candidates = joint_dictionary(arm, k, regression, dictionary)
    if free is not None and in_the_bodies(arm, runs, k):  # the bodies that are fitted have it
        candidates = [placed for placed in candidates if placed.effect.name != ROTOR]
    own = replace(
        policy, most=arm_policy.own, least=arm_policy.sensor, alone=arm_policy.alone, alone_z=arm_policy.alone_z
    )
    outcome = beside_the_usual(form, search(form, nominal, candidates, policy=own), candidates, own)
    outcome = with_rivals(form, with_simpler_laws(form, outcome, candidates, own), candidates, own)
    outcome = rotor_or_gain(form, outcome, candidates, own)
    factor = runs["validation"][0].motion.factor
    passed = 0.8 / factor if factor > 1 else 1.0  # of the power of white noise, by the decimation
    noise = max(run.noise[k] for run in runs["validation"]) * float(np.sqrt(passed))
    closed = _on_the_true_motion(arm, runs, known, (regression, outcome.model), arm_policy)
    left = left_over(RegressionForm(closed[0], arm_policy), closed[1], policy)
    return JointDiagnosis(k, regression, outcome, left, noise, arm_policy, closed)


def _on_the_true_motion(
    arm: ArmModel,
    runs: dict[str, tuple[ArmRun, ...]],
    known: Mapping[str, Sequence[FloatArray]],
    found: tuple[JointRegression, Fit],
    policy: ArmPolicy,
) -> tuple[JointRegression, Fit]:
    """Return a joint and its fit, its rotor on the motion that the bodies have: then the rest is what is left.

    A rotor is estimated on the calm acceleration, without noise. Of a fast torque that leaves out most of what it does.
    """
    regression, fit = found
    if fit.own or not any(placed.effect.name == ROTOR for placed in fit.effects):
        return found  # beside free inertial parameters, whose columns are calm, it stays calm
    sharp = {use: [run.sharp for run in parts] for use, parts in runs.items()}
    on_it = JointRegression(arm, regression.joint, sharp, known)
    there = RegressionForm(on_it, policy).at(fit)
    return found if there is None else (on_it, there)


def _inertial_directions(arm: ArmModel, runs: Sequence[ArmRun]) -> list[FloatArray]:
    """Return an orthonormal basis of the inertial parameters that this motion moves at all."""
    rows = slice(None, None, max(runs[0].calm.q.shape[0] // 400, 1))
    m = runs[0].calm
    _, singular, right = np.linalg.svd(arm.arm.regressor(m.q[rows], m.v[rows], m.a[rows]), full_matrices=False)
    return [row for row, value in zip(right, singular, strict=True) if value > ARM_POLICY.moved * singular[0]]


def _calibrated_torques(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], directions: Sequence[FloatArray]
) -> dict[str, list[FloatArray]]:
    """Return by use the torques (N, n, d) of all joints for every direction of the inertial parameters."""
    turn = np.stack(directions, axis=1)
    every = range(len(arm.arm.joints))
    return {use: [part @ turn for part in parts] for use, parts in unit_torques(arm, runs, every).items()}


def _free_columns(torques: Mapping[str, Sequence[FloatArray]], k: int) -> dict[str, list[FloatArray]]:
    """Return by use the torques (N, c) of one joint that calibrated inertial parameters can make, without doubles."""
    joined = np.concatenate([part[:, k] for part in torques["estimation"]])
    _, singular, right = np.linalg.svd(joined, full_matrices=False)
    kept = singular > ARM_POLICY.moved * singular[0]
    turn: Any = right[kept].T * (np.sqrt(joined.shape[0]) / singular[kept])
    return {use: [part[:, k] @ turn for part in parts] for use, parts in torques.items()}
