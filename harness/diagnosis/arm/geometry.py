"""Another arm of about this size: masses and the places of the joints fitted to a log, beside friction of every joint.

With wrong lengths no bodies explain the torques: what hangs on a joint pulls at another arm than the file says. So
whoever asks whether a URDF is another arm's has to let the places of its joints go as well as its masses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.arm.motion import ArmRun
from harness.diagnosis.policy import ARM_POLICY
from harness.diagnosis.records.motion import Motion
from harness.models.damped import Damping, damped_descent
from harness.physics.arms.arm import GRAVITY, ArmModel
from harness.signals import FloatArray

__all__ = ["runs_of_another_arm"]

DESCENT = Damping(start=1e-2, enough=1e-4, rounds=30)
"""Of the fit: what a cost falls by less than 0.01 % tells nothing more."""


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

    def motion(m: Motion) -> list[FloatArray]:
        return [*(np.ascontiguousarray(part.T) for part in (m.q, m.v, m.a)), np.array(GRAVITY)]

    def needed(m: Motion, at: FloatArray) -> FloatArray:
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
