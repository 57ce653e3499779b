"""A robot whose base floats: the regressor of its whole tree, the base's six rows included, and contact Jacobians.

``W(q, v, a) p + damping v + friction sgn(v) + rotors a = S' tau + sum_c J_c' f_c``: a measured force anywhere enters
by the Jacobian of its point; forces that nobody measured are eliminated by the null space of theirs (Mistry, Schaal &
Yamane 2009, *Humanoids*, eq. 7).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.arms.arm import REST, ArmModel, load_arm
from harness.physics.arms.formats.mjcf import joint_names
from harness.physics.arms.formats.mjcf_spec import compiled, mujoco, read_spec
from harness.physics.arms.joints import MOVING, Joint
from harness.physics.arms.kinematics import joint_places
from harness.physics.arms.regressor import ArmRegressor
from harness.physics.arms.rigid_tree import Arm
from harness.signals import FloatArray

GRAVITY = np.array([0.0, 0.0, -9.81])
LOST = 1e-9  # Singular value of a contact Jacobian, relative, below which a direction of its force does no work.


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """How the frame of a floating base moves."""

    rotation: FloatArray  # (N, 3, 3): From its own axes to the world's
    acceleration: FloatArray  # (N, 3): Of its origin, in the world [m/s^2]
    # (N, 3): Angular velocity and acceleration in its own axes [rad/s, rad/s^2]
    spin: FloatArray
    turning: FloatArray

    @property
    def gravity(self) -> FloatArray:
        """Gravity minus the acceleration of the origin, in the base's own axes (N, 3)."""
        return np.asarray(np.einsum("nji,nj->ni", self.rotation, GRAVITY - self.acceleration))


@dataclass(frozen=True, eq=False)
class FloatingRobot:
    """A tree of bodies on a base that floats.

    Generalized forces have 6 + n rows: force and moment on the base, in its own axes and about its origin, then the
    joints.
    """

    model: ArmModel
    """Joints, bodies and what acts at the joints; its first joint is the base, fixed to the floating frame."""
    names: tuple[str, ...]  # The bodies, in the order of the joints
    points: Mapping[str, tuple[int, FloatArray]]
    """Of every site of the file: number of the joint that carries it, and where it is in that joint's frame (3,)
    [m].
    """

    @property
    def arm(self) -> Arm:
        """The tree."""
        return self.model.arm

    @property
    def n(self) -> int:
        """Joints that move."""
        return self.arm.n

    @cached_property
    def _regressor(self) -> ArmRegressor:
        return ArmRegressor(self.arm.joints, floating=True)

    def regressor(self, base: BaseMotion, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return W (N, 6 + n, 10 * bodies), whose product with the inertial parameters is the generalized force."""
        rows = self._regressor(q, v, a, base.gravity, base.spin, base.turning)
        return rows.reshape(len(q), 6 + self.n, -1)

    def forces(self, base: BaseMotion, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the generalized forces (N, 6 + n) of a motion, with damping, friction and rotors of the file."""
        found = self.regressor(base, q, v, a) @ self.arm.parameters
        model = self.model
        found[:, 6:] += model.damping * v + model.friction * np.tanh(v / REST) + model.motor_inertia * a
        return np.asarray(found)

    def jacobian(self, point: str, q: FloatArray, offset: FloatArray | None = None) -> FloatArray:
        """Return the Jacobian (N, 6, 6 + n) of a site: its velocity, then its body's angular velocity, in base axes.

        A wrench (force, moment about the point; both in the axes of the base) adds ``J' wrench``.

        Raises InputError if there is no such site.

        - ``point``: name of a site
        - ``q`` (N, n)
        - ``offset`` (3,) or (N, 3): from the site to where the force acts, in the axes of the base [m]
        """
        if point not in self.points:
            raise InputError(
                f"contact {point!r} of {self.model.name}",
                expected=f"a site: {', '.join(self.points) or 'the file has none'}",
                got=repr(point),
                remedy="name a site, or add one to the body in the MJCF",
            )
        body, at = self.points[point]
        places, turns = joint_places(self.arm, q)
        where = places[:, body] + turns[:, body] @ at
        if offset is not None:
            where = where + offset
        found = np.zeros((len(q), 6, 6 + self.n))
        found[:, :3, :3] = found[:, 3:, 3:6] = np.eye(3)
        found[:, :3, 3:6] = -_crossed(where)
        column = {number: k for k, number in enumerate(self.model.links)}
        while body >= 0:
            joint = self.arm.joints[body]
            if joint.kind in MOVING:
                axis, place = turns[:, body] @ joint.axis, 6 + column[body]
                if joint.kind == "prismatic":
                    found[:, :3, place] = axis
                else:
                    found[:, :3, place], found[:, 3:, place] = np.cross(axis, where - places[:, body]), axis
            body = joint.parent
        return found


def eliminated(jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions of motion that no force at some contacts works on.

    - ``jacobian`` (N, c, m): of the points where unknown forces act, c of their components
    - returns ``directions`` (N, m, m): columns, orthonormal; those of no use are 0: multiply an equation from the left
      by the transpose
    - returns ``count`` (N,): how many are of use

    Examples
    --------
    >>> one = np.array([[[1.0, 1.0, 0.0]]])
    >>> directions, count = eliminated(one)
    >>> count.tolist(), bool(np.allclose(one @ directions, 0))
    ([2], True)
    """
    _, singular, right = np.linalg.svd(jacobian, full_matrices=True)
    size = right.shape[-1]
    bound = np.zeros((len(jacobian), size), dtype=bool)
    bound[:, : singular.shape[1]] = singular > LOST * np.maximum(singular[:, :1], 1e-300)
    return np.swapaxes(right, 1, 2) * ~bound[:, None, :], np.sum(~bound, axis=1)


def rotation_matrices(quaternion: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) of quaternions (N, 4), w first, of any length.

    Examples
    --------
    >>> rotation_matrices(np.array([[1.0, 0.0, 0.0, 1.0]]))[0].round(12).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1, axis=-1)).as_matrix(), dtype=np.float64)


def load_floating(path: str | Path) -> FloatingRobot:
    """Return a robot with a floating base from an MJCF: one free joint, of the body that carries all others.

    Raises InputError if it has none or several, bodies beside it have mass and move, or it cannot be read (see
    :func:`harness.physics.arms.formats.mjcf.load_mjcf`).
    """
    file = Path(path)
    built = compiled(read_spec(file, shapes=False), file)
    names = joint_names(built)
    free = [k for k in range(built.njnt) if int(built.jnt_type[k]) == int(mujoco().mjtJoint.mjJNT_FREE)]
    if len(free) != 1:
        raise InputError(
            "floating base",
            expected="one free joint",
            got=", ".join(names[k] for k in free) or "none",
            remedy="give the body of the base a <freejoint/>" if not free else "leave the other bodies out",
            file=file,
        )
    base = names[free[0]]
    model = load_arm(file, locked=[base])
    joints = list(model.arm.joints)
    root = next(k for k, joint in enumerate(joints) if joint.name == base)
    kept = [k for k in range(len(joints)) if _carried(joints, k, root)]
    if model.n != sum(joints[k].kind in MOVING for k in kept):
        raise InputError(
            "floating base",
            expected=f"all joints on the body of {base}",
            got="others beside it",
            remedy="leave the other bodies out",
            file=file,
        )
    number = {-1: -1} | {k: place for place, k in enumerate(kept)}
    tree = [replace(joints[k], parent=number.get(joints[k].parent, -1)) for k in kept]
    tree[0] = replace(tree[0], rotation=np.eye(3), offset=np.zeros(3))
    bodies = _bodies(built, names, [joint.name for joint in tree])
    points = {}
    for site in range(built.nsite):
        body = int(built.site_bodyid[site])
        if body in bodies:
            place, anchor = bodies[body]
            points[built.site(site).name or f"site {site}"] = (place, np.array(built.site_pos[site]) - anchor)
    titles = {place: built.body(body).name or f"body {body}" for body, (place, _) in bodies.items()}
    called = tuple(titles.get(place, tree[place].name) for place in range(len(tree)))
    return FloatingRobot(replace(model, arm=Arm(model.arm.name, tuple(tree))), called, points)


def _carried(joints: Sequence[Joint], number: int, root: int) -> bool:
    """Return whether a joint hangs on another one, or is it."""
    while number >= 0:
        if number == root:
            return True
        number = joints[number].parent
    return False


def _bodies(model: Any, names: Sequence[str], joints: Sequence[str]) -> dict[int, tuple[int, FloatArray]]:
    """Return for every body the place of the joint that carries it, and where that joint's frame is in the body's."""
    found = {}
    for body in range(1, model.nbody):
        count = int(model.body_jntnum[body])
        last = int(model.body_jntadr[body]) + count - 1
        title = names[last] if count else model.body(body).name or f"body {body}"
        if title in joints:
            free = count and int(model.jnt_type[last]) == int(mujoco().mjtJoint.mjJNT_FREE)
            anchor = np.array(model.jnt_pos[last]) if count and not free else np.zeros(3)
            found[body] = joints.index(title), anchor
    return found


def _crossed(vectors: FloatArray) -> FloatArray:
    """Return the matrices (N, 3, 3) of the cross product with vectors (N, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.moveaxis(np.array([[none, -z, y], [z, none, -x], [-y, x, none]]), 2, 0)
