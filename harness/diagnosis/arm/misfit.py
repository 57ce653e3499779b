"""Does the arm fit its log at all? If not, which likely mistake would explain it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.arm.found import JointDiagnosis
from harness.diagnosis.arm.motion import ArmRun, arm_runs, moving_rows
from harness.diagnosis.arm.wide_regression import OWN, own_columns, turning_level
from harness.diagnosis.policy import ARM_POLICY, Policy
from harness.diagnosis.records.columns_check import DEGREE
from harness.physics.arms.arm import ArmModel
from harness.signals import Dataset, FloatArray

NONE = (0.0, 0.0, 0.0)
"""No gravity."""

MANY = 20.0
"""Times the torque from which on a residual is not given in percent of it."""
SHOWN = 3
"""Joints that are named one by one."""
UNITS = {1e3: "N mm and not N m", 1e-3: "kN m and not N m", 1e2: "N cm and not N m", 9.80665: "kgf m and not N m"}
"""Factors between a torque and what a log may hold."""
G = 9.81
GRAVITIES = {
    "whether the torques are those beyond gravity's compensation": (0.0, 0.0, 0.0),
    "whether the base hangs upside down": (0.0, 0.0, G),
    "whether the base is turned by 90 degrees (its x axis down)": (G, 0.0, 0.0),
    "whether the base is turned by 90 degrees (its x axis up)": (-G, 0.0, 0.0),
    "whether the base is turned by 90 degrees (its y axis down)": (0.0, G, 0.0),
    "whether the base is turned by 90 degrees (its y axis up)": (0.0, -G, 0.0),
}
"""Gravity in the frame of the base [m/s^2] where an arm is not mounted upright, or a log is without its torque."""
SLOW = 10
"""Samples of the filtered residual that are taken for one: it is coloured, and only a rough figure is asked for."""


def misfit_reasons(arm: ArmModel, joints: Sequence[JointDiagnosis], policy: Policy) -> tuple[str, ...]:
    """Return why an arm does not fit its log; empty if it fits.

    Parameters
    ----------
    arm : ArmModel
    joints : sequence of JointDiagnosis
        With all effects that were accepted.
    policy : Policy
    """
    bad = sorted((joint for joint in joints if not joint.share <= policy.misfit_nrmse), key=lambda joint: -joint.share)
    reasons = [_left(arm, joint) for joint in bad[:SHOWN]]
    if len(bad) > SHOWN:
        reasons.append(f"so it is at {len(bad) - SHOWN} more joints")
    return tuple(reasons)


def _left(arm: ArmModel, joint: JointDiagnosis) -> str:
    """Say what the model leaves of a joint's torque: in percent, or as a torque where that is out of all proportion."""
    name, unit = arm.positions[joint.joint].name, arm.inputs[joint.joint].unit
    if joint.share > MANY:
        left = joint.left("validation")
        return f"at {name} the model is off by {left:.3g} {unit}, and the torque changes by {joint.torque:.3g} {unit}"
    return f"at {name} what the model leaves is {100 * joint.share:.0f} % as large as all that the torque does"


def likely_mistake(
    dataset: Dataset, arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], joints: Sequence[int], policy: Policy
) -> tuple[str, ...]:
    """Return what to check: the mistake whose repair makes the log much likelier, if there is one.

    Parameters
    ----------
    dataset : Dataset
    arm : ArmModel
    runs : mapping
        Motions by use.
    joints : sequence of int
        Those that were judged.
    policy : Policy
    """
    estimation = runs["estimation"]
    base, _ = _explained([(run, run.motion.u) for run in estimation], joints)
    best, words = base + policy.misfit_gain, ""
    for text, pairs in _mistakes(dataset, arm, estimation, joints):
        value, left = _explained(pairs, joints)
        if value > best and left <= policy.misfit_nrmse**2:  # torques that belong to no motion are mended by nothing
            best, words = value, text
    return (f"check {words}: with that corrected the model fits far better",) if words else ()


def _mistakes(
    dataset: Dataset, arm: ArmModel, runs: Sequence[ArmRun], joints: Sequence[int]
) -> Iterator[tuple[str, list[tuple[ArmRun, FloatArray]]]]:
    """Yield likely mistakes: words, and the records with the torques without it."""
    yield from _torque_mistakes(arm, runs, joints)
    yield from _position_mistakes(dataset, arm)
    for text, gravity in GRAVITIES.items():
        needed = [arm.torques(run.motion.q, run.motion.v, run.motion.a, gravity) for run in runs]
        plain = [arm.torques(run.motion.q, run.motion.v, run.motion.a) for run in runs]
        yield (
            text,
            [
                (replace(run, rigid=run.rigid - without + with_), run.motion.u)
                for run, without, with_ in zip(runs, plain, needed, strict=True)
            ],
        )


def _torque_mistakes(
    arm: ArmModel, runs: Sequence[ArmRun], joints: Sequence[int]
) -> Iterator[tuple[str, list[tuple[ArmRun, FloatArray]]]]:
    """Yield likely mistakes in the torques: words, and the records with the torques without it."""
    names = [channel.name for channel in arm.inputs]

    def with_columns(order: Sequence[int], signs: FloatArray) -> list[tuple[ArmRun, FloatArray]]:
        return [(run, run.motion.u[:, order] * signs) for run in runs]

    same = list(range(arm.n))
    yield "the sign of all torques", with_columns(same, -np.ones(arm.n))
    for k in joints:
        yield f"the sign of {names[k]}", with_columns(same, np.where(np.arange(arm.n) == k, -1.0, 1.0))
    for a, b in itertools.combinations(range(arm.n), 2):
        order = list(same)
        order[a], order[b] = b, a
        yield f"whether {names[a]} and {names[b]} are exchanged", with_columns(order, np.ones(arm.n))
    torque = np.concatenate([run.motion.u for run in runs])[:, joints]
    rigid = np.concatenate([run.rigid for run in runs])[:, joints]
    factor = float(np.median(torque.std(axis=0) / np.maximum(rigid.std(axis=0), 1e-12)))
    units = [unit for unit in UNITS if unit / ARM_POLICY.unit_within < factor < unit * ARM_POLICY.unit_within]
    for unit in units:
        yield f"whether the torques are in {UNITS[unit]}", with_columns(same, np.full(arm.n, 1 / unit))
    if not units and not 1 / ARM_POLICY.unit_within < factor < ARM_POLICY.unit_within:
        scale = float(np.sum(torque * rigid) / max(np.sum(rigid**2), 1e-300))
        if scale > 0:
            yield (
                f"whether all torques are {scale:.2g} times what they should be, or all masses {1 / scale:.2g} times",
                with_columns(same, np.full(arm.n, 1 / scale)),
            )


def _position_mistakes(dataset: Dataset, arm: ArmModel) -> Iterator[tuple[str, list[tuple[ArmRun, FloatArray]]]]:
    """Yield the same of the positions."""
    names = [channel.name for channel in arm.outputs]
    cases: list[tuple[str, int | None, float]] = [
        (f"the sign of {arm.positions[k].name}", k, -1.0) for k in range(arm.n)
    ]
    if all(channel.unit == "rad" for channel in arm.positions):
        cases.append(("whether the positions are in degrees", None, DEGREE))
    for text, k, factor in cases:
        of_joint = [arm.positions[k].name, f"{arm.positions[k].name}_rate"] if k is not None else names
        scale = np.array([factor if name in of_joint else 1.0 for name in names])
        changed = tuple(
            replace(run, trajectory=replace(run.trajectory, y=run.trajectory.y * scale)) for run in dataset.runs
        )
        made = arm_runs(arm, replace(dataset, runs=changed))["estimation"]
        yield text, [(run, run.motion.u) for run in made]


def _explained(pairs: Sequence[tuple[ArmRun, FloatArray]], joints: Sequence[int]) -> tuple[float, float]:
    """Return how well rigid bodies and each joint's friction explain the torques.

    Returns
    -------
    log_likelihood : float
        Of the torques over their own size, so that units do not count; errors taken as white from ten samples on.
    left : float
        Share of the variance that is left, that of the worst joint: a repair that leaves one joint wrong is none.
    """
    total, shares = 0.0, []
    for k in joints:
        parts = []
        for run, torque in pairs:
            own = own_columns(run, turning_level(run))[:, k, len(OWN) * k : len(OWN) * k + 3]
            columns = np.concatenate([(torque - run.rigid)[:, [k]], torque[:, [k]], own], axis=1)
            keep = moving_rows(run.motion)[:, k] > 0
            parts.append(run.slim(columns[:, None, :], [k])[keep, 0])
        x = np.concatenate(parts)
        left = x[:, 0] - x[:, 2:] @ np.linalg.lstsq(x[:, 2:], x[:, 0], rcond=1e-10)[0]
        shares.append(float(np.mean(left**2)) / max(float(np.var(x[:, 1])), 1e-300))
        total -= 0.5 * len(x) / SLOW * float(np.log(max(shares[-1], 1e-300)))
    return total, float(np.max(shares))


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
