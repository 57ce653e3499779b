"""The equations of motion of a record of a robot whose base floats, linear in its inertial parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from harness.errors import FitError
from harness.physics.arms.arm import REST
from harness.physics.arms.floating import BaseMotion, FloatingRobot, eliminated, rotation_matrices
from harness.physics.arms.inertia import TEN, UNITS
from harness.signals import FloatArray, Trajectory
from identifiers.mechanics.motion import Motion, Smoothing, motion

PLACE, TURN, SPIN = (
    tuple(f"base_{axis}" for axis in axes) for axes in (("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("wx", "wy", "wz"))
)


@dataclass(frozen=True, eq=False)
class Rows:
    """The equations of motion of a record, one for each sample and free direction of motion.

    Attributes
    ----------
    matrix : array (M, k)
        Inertial parameters of all bodies, ten each, then damping, dry friction and rotors of the joints.
    target : array (M,)
        Generalized forces that were measured.
    sample : array of int (M,)
        To which sample each row belongs.
    kind : array of int (M,)
        To which generalized coordinate; 0 for all where forces were eliminated, which mixes them.
    names, units : tuple of str
        Of the columns.
    """

    matrix: FloatArray
    target: FloatArray
    sample: NDArray[np.intp]
    kind: NDArray[np.intp]
    names: tuple[str, ...]
    units: tuple[str, ...]


def channels_of(robot: FloatingRobot, contacts: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of the channels that a record must have, and of those that are used where it has them."""
    joints = [channel.name for channel in robot.model.positions]
    rates = [*(f"{name}_rate" for name in (*PLACE, *joints)), *SPIN]
    forces = [f"{site}_force_{axis}" for site in contacts for axis in "xyz"]
    return [*PLACE, *TURN, *joints], [*rates, *(f"tau{k + 1}" for k in range(robot.n)), *forces]


def rows_of(
    robot: FloatingRobot,
    record: Trajectory,
    contacts: Sequence[str],
    hidden: Sequence[str],
    *,
    radius: float = 0.0,
    smoothing: Smoothing = "auto",
    forces: bool = True,
) -> Rows:
    """Return the equations of motion of a record.

    Raises FitError if the record lacks a signal.

    - ``contacts``: sites at which something may touch
    - ``hidden``: contacts whose forces are eliminated; those of the others are read from the record
    - ``radius``: of the balls around them [m]
    - ``smoothing``: see :func:`identifiers.mechanics.motion.motion`
    - ``forces``: False leaves out what was measured: the columns alone, of all directions
    """
    moved = floating_motion(robot, record, smoothing)
    q, v, a, n = moved.q, moved.v, moved.a, robot.n
    torques = [f"tau{k + 1}" for k in range(n)]
    known = [site for site in contacts if site not in hidden]
    others = measured(record, [*torques, *(f"{site}_force_{axis}" for site in known for axis in "xyz")])
    joints = np.zeros((len(q), 6 + n, 3 * n))
    for kind, column in enumerate((v, np.tanh(v / REST), a)):
        joints[:, 6 + np.arange(n), kind * n + np.arange(n)] = column
    matrix = np.concatenate([robot.regressor(moved.base, q, v, a), joints], axis=2)
    target = np.zeros((len(q), 6 + n))
    below = moved.below(radius)
    if forces:
        for k, name in enumerate(torques):
            target[:, 6 + k] = others[name][moved.rows] if name in others else 0.0
        for site in known:
            force = moved.in_base(np.stack([others[f"{site}_force_{axis}"][moved.rows] for axis in "xyz"], axis=1))
            target += np.einsum("nci,nc->ni", robot.jacobian(site, q, below)[:, :3], force)
    keep: NDArray[np.bool_] = np.ones(target.shape, dtype=bool)
    if hidden:
        jacobian = np.concatenate([robot.jacobian(site, q, below)[:, :3] for site in hidden], axis=1)
        directions, _ = eliminated(jacobian)
        matrix = np.swapaxes(directions, 1, 2) @ matrix
        target = np.einsum("nij,ni->nj", directions, target)
        keep = np.any(directions, axis=1)
    inertial = [(f"{ten} {body}", unit) for body in robot.names for ten, unit in zip(TEN, UNITS, strict=True)]
    turns = [channel.unit == "rad" for channel in robot.model.positions]
    drag = [(f"{kind}{k + 1}", units[not turn]) for kind, units in (
        ("damping", ("N m s/rad", "N s/m")), ("friction", ("N m", "N")), ("motor_inertia", ("kg m^2", "kg"))
    ) for k, turn in enumerate(turns)]  # fmt: skip
    titles, units = zip(*inertial, *drag, strict=True)
    sample = np.broadcast_to(np.arange(len(q))[:, None], target.shape)
    told_of = np.broadcast_to(np.zeros(6 + n, dtype=np.intp) if hidden else np.arange(6 + n), target.shape)
    return Rows(matrix[keep], target[keep], sample[keep], told_of[keep], titles, units)


@dataclass(frozen=True, eq=False)
class FloatingMotion:
    """The motion of a record: of the base, of the joints (N, n), and to which of its rows the instants belong."""

    base: BaseMotion
    velocity: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray
    rows: NDArray[np.intp]

    def in_base(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (N, 3) of the world in the axes of the base."""
        return np.asarray(np.einsum("nji,nj->ni", self.base.rotation, vectors))

    def below(self, radius: float) -> FloatArray:
        """Return from the centre of a ball to its lowest point (N, 3), in the axes of the base."""
        return -radius * self.base.rotation[:, 2]


def floating_motion(robot: FloatingRobot, record: Trajectory, smoothing: Smoothing) -> FloatingMotion:
    """Return the motion of a record; refuse one without the base or a joint."""
    channels = [channel.name for channel in record.spec.outputs]
    positions = [channel.name for channel in robot.model.positions]
    missing = [name for name in (*PLACE, *TURN, *positions) if name not in channels]
    if missing:
        raise FitError(
            f"motion of {robot.model.name}",
            expected="position and quaternion of the base (base_x, ..., base_qz), and every joint",
            got=f"{', '.join(missing)} missing",
            remedy="record it, or rename the columns",
        )
    spins = [name for name in SPIN if name in channels]
    wanted = [*PLACE, *TURN, *(spins if len(spins) == 3 else []), *positions]
    names = SimpleNamespace(coordinates=[SimpleNamespace(name=name) for name in wanted])
    moved = motion(names, record, smoothing)
    q, v, a = (part[:, len(wanted) - robot.n :] for part in (moved.q, moved.v, moved.a))
    base = _base(moved, len(spins) == 3)
    return FloatingMotion(base, moved.v[:, :3], q, v, a, np.searchsorted(record.t, moved.t))


def _base(moved: Motion, measured: bool) -> BaseMotion:
    """Return the motion of the base; its spin by the quaternion where no gyroscope was read."""
    turn = moved.q[:, 3:7]
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    if measured:
        spin, turning = moved.q[:, 7:10], moved.v[:, 7:10]
    else:  # w = 2 q* q', in the axes of the body; q* q'' holds half its rate, and what its length does
        spin, turning = (2 * _imaginary(turn, part[:, 3:7]) / size**2 for part in (moved.v, moved.a))
    return BaseMotion(rotation_matrices(turn), moved.a[:, :3], spin, turning)


def _imaginary(q: FloatArray, p: FloatArray) -> FloatArray:
    """Return the vector part (N, 3) of conj(q) p."""
    return np.asarray(q[:, :1] * p[:, 1:] - p[:, :1] * q[:, 1:] - np.cross(q[:, 1:], p[:, 1:]))


def measured(record: Trajectory, wanted: Sequence[str], *, torques: bool = True) -> dict[str, FloatArray]:
    """Return signals by name: outputs, or inputs as they are in the middle of two samples; refuse missing forces."""
    found = {channel.name: record.y[:, k] for k, channel in enumerate(record.spec.outputs)}
    held = np.vstack([record.u[:1], 0.5 * (record.u[1:] + record.u[:-1])])
    found |= {channel.name: held[:, k] for k, channel in enumerate(record.spec.inputs)}
    missing = [name for name in wanted if name not in found and not name.startswith("tau")]
    if missing or (torques and not any(name.startswith("tau") for name in wanted if name in found)):
        raise FitError(
            "forces of the record",
            expected="tau1, ... and SITE_force_x, _y, _z of every contact that is measured",
            got=f"{', '.join(missing) or 'no torque'} missing",
            remedy="rename the columns, or name the contact in unmeasured",
        )
    return {name: found[name] for name in wanted if name in found}
