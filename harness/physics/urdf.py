"""A robot read from a URDF file: its joints, its bodies, and its inverse dynamics by recursive Newton-Euler."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

__all__ = ["Arm", "Joint", "load_urdf", "pose_of", "vector_of"]

MOVING = {"revolute", "continuous", "prismatic"}


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint with the body that hangs on it.

    Parameters
    ----------
    name : str
        Of the joint.
    parent : int
        Index of the joint that carries this one; -1 is the base.
    kind : {"revolute", "continuous", "prismatic", "fixed"}
        A continuous joint is a revolute one without limits.
    rotation, offset : arrays (3, 3) and (3,)
        Pose of the joint's frame in the frame of its parent at joint position 0 [m].
    axis : array (3,)
        Unit vector in the joint's own frame.
    mass, centre, inertia : float [kg], array (3,) [m], array (3, 3) [kg m^2]
        Of the body; the inertia is about its centre of mass, in the axes of the joint's frame.
    lower, upper, effort, velocity : float
        Limits of position [rad or m], force [N m or N] and rate; infinite where the file states none.
    """

    name: str
    parent: int
    kind: str
    rotation: FloatArray
    offset: FloatArray
    axis: FloatArray
    mass: float
    centre: FloatArray
    inertia: FloatArray
    lower: float
    upper: float
    effort: float
    velocity: float


@dataclass(frozen=True, eq=False)
class Arm:
    """A tree of joints on a fixed base, parents before children.

    Parameters
    ----------
    name : str
        Of the robot.
    joints : tuple of Joint
        Fixed ones included.

    Examples
    --------
    The torque that holds a pendulum (1 kg at 0.5 m) level is m g l:

    >>> still = np.zeros(1)
    >>> identity, zero = np.eye(3), np.zeros(3)
    >>> pendulum = Arm("pendulum", (Joint("hinge", -1, "revolute", identity, zero, np.array([0.0, -1.0, 0.0]),
    ...     1.0, np.array([0.5, 0.0, 0.0]), np.zeros((3, 3)), -3.0, 3.0, 10.0, 10.0),))
    >>> pendulum.inverse_dynamics(still, still, still).round(4).tolist()
    [4.905]
    """

    name: str
    joints: tuple[Joint, ...]

    @property
    def moving(self) -> tuple[Joint, ...]:
        """The joints that move, in the order of q."""
        return tuple(joint for joint in self.joints if joint.kind in MOVING)

    @property
    def n(self) -> int:
        """Degrees of freedom."""
        return len(self.moving)

    def inverse_dynamics(
        self, q: FloatArray, v: FloatArray, a: FloatArray, gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    ) -> FloatArray:
        """Return the joint torques or forces (n,) that go with a motion, without friction.

        Parameters
        ----------
        q, v, a : array (n,)
            Joint position, rate and acceleration.
        gravity : (x, y, z)
            m/s^2 in the frame of the base.
        """
        result = self._function(np.asarray(q), np.asarray(v), np.asarray(a), np.asarray(gravity))
        return np.asarray(result, dtype=float).ravel()

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the joint-space mass matrix (n, n): one column an acceleration, without gravity."""
        still, none = np.zeros(self.n), (0.0, 0.0, 0.0)
        return np.column_stack([self.inverse_dynamics(q, still, unit, none) for unit in np.eye(self.n)])

    def regressor(
        self, q: FloatArray, v: FloatArray, a: FloatArray, gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    ) -> FloatArray:
        """Return W (N * n, 10 * bodies) with ``torque = W @ parameters``, the n torques of a sample together.

        Parameters
        ----------
        q, v, a : array (N, n)
            Joint positions, rates and accelerations.
        gravity : (x, y, z)
            m/s^2 in the frame of the base.

        Notes
        -----
        Generated C, compiled at the first call: :class:`harness.physics.arm_regressor.ArmRegressor`.
        """
        return np.asarray(self._regressor(q, v, a, gravity))

    @property
    def parameters(self) -> FloatArray:
        """Inertial parameters (10 * bodies,): m, m c (3) and the inertia xx xy xz yy yz zz about the joint's frame."""
        upper = np.triu_indices(3)
        rows = []
        for joint in self.joints:
            c = joint.centre
            about_frame = joint.inertia + joint.mass * (c @ c * np.eye(3) - np.outer(c, c))
            rows.append(np.concatenate([[joint.mass], joint.mass * c, about_frame[upper]]))
        return np.concatenate(rows)

    @cached_property
    def _function(self) -> Any:
        """Return the inverse dynamics as a CasADi function of (q, v, a, gravity)."""
        import casadi as ca

        arguments, torques = self.symbolic_torques(ca.SX(self.parameters))
        return ca.Function("inverse_dynamics", arguments, [torques])

    @cached_property
    def _regressor(self) -> Any:
        """Return the compiled regressor."""
        from harness.physics.arm_regressor import ArmRegressor

        return ArmRegressor(self)

    def symbolic_torques(self, parameters: Any) -> tuple[list[Any], Any]:
        """Return the symbols (q, v, a, gravity) and the torques, linear in the inertial parameters.

        Recursive Newton-Euler in the axes of the base (Luh, Walker & Paul, J. Dyn. Sys. Meas. Control 102 (1980) 69),
        moments about the joints' frames, so that mass, first moments and inertia enter linearly.
        """
        import casadi as ca

        q, v, a, gravity = (ca.SX.sym(name, size) for name, size in zip("qvag", (*[self.n] * 3, 3), strict=True))
        zero = ca.SX.zeros(3)
        base = (ca.SX.eye(3), zero, zero, zero, -gravity)
        outward: list[tuple[Any, ...]] = []
        forces: list[tuple[Any, Any]] = []
        axes: list[Any] = []
        index = 0
        for number, joint in enumerate(self.joints):
            turn, place, rate, turning, acceleration = base if joint.parent < 0 else outward[joint.parent]
            own = turn @ ca.SX(joint.rotation)
            arm = turn @ ca.SX(joint.offset)
            axis = own @ ca.SX(joint.axis)
            axes.append(axis)
            acceleration = acceleration + ca.cross(turning, arm) + ca.cross(rate, ca.cross(rate, arm))
            if joint.kind == "prismatic":
                slide = axis * q[index]
                arm = arm + slide
                acceleration = (
                    acceleration
                    + ca.cross(turning, slide)
                    + ca.cross(rate, ca.cross(rate, slide))
                    + 2 * ca.cross(rate, axis * v[index])
                    + axis * a[index]
                )
            elif joint.kind != "fixed":
                own = own @ _rotation_about(joint.axis, q[index])
                turning = turning + axis * a[index] + ca.cross(rate, axis * v[index])
                rate = rate + axis * v[index]
            index += joint.kind in MOVING
            outward.append((own, place + arm, rate, turning, acceleration))
            mass, first, inertia = _body_symbols(parameters[10 * number : 10 * number + 10])
            first, inertia = own @ first, own @ inertia @ own.T
            force = mass * acceleration + ca.cross(turning, first) + ca.cross(rate, ca.cross(rate, first))
            moment = inertia @ turning + ca.cross(rate, inertia @ rate) + ca.cross(first, acceleration)
            forces.append((force, moment))
        torques = [ca.SX(0)] * self.n
        for number in reversed(range(len(self.joints))):
            joint = self.joints[number]
            force, moment = forces[number]
            if joint.kind in MOVING:
                index -= 1
                torques[index] = ca.dot(axes[number], force if joint.kind == "prismatic" else moment)
            if joint.parent >= 0:
                arm = outward[number][1] - outward[joint.parent][1]
                above = forces[joint.parent]
                forces[joint.parent] = (above[0] + force, above[1] + moment + ca.cross(arm, force))
        return [q, v, a, gravity], ca.vertcat(*torques)


def load_urdf(path: str | Path) -> Arm:
    """Read a robot with a fixed base.

    Parameters
    ----------
    path : path
        URDF file; meshes are not looked at.

    Returns
    -------
    Arm
        Joints in the order of a depth-first walk, children in the order of the file (the order of Bullet).

    Raises
    ------
    InputError
        If the file cannot be read, is no URDF, has a joint of another kind, or is no tree.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such URDF", expected="a file", got="no file", remedy="check the path", file=file)
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise InputError("not XML", expected="a URDF file", got=str(error), remedy="repair it", file=file) from error
    bodies = {link.get("name", ""): _body(link, file) for link in root.findall("link")}
    if root.tag != "robot" or not bodies:
        raise InputError(
            "not a URDF", expected="a <robot> with links", got=f"<{root.tag}>", remedy="check the file", file=file
        )
    elements = root.findall("joint")
    children = {_end(element, "child", bodies, file) for element in elements}
    roots = [name for name in bodies if name not in children]
    if len(roots) != 1 or len(children) != len(elements):
        raise InputError(
            "not a tree",
            expected="one base link, one parent for each other link",
            got=f"{len(roots)} base links, {len(elements)} joints to {len(children)} links",
            remedy="repair the joints",
            file=file,
        )
    joints: list[Joint] = []

    def walk(link: str, index: int) -> None:
        for element in elements:
            if _end(element, "parent", bodies, file) == link:
                child = _end(element, "child", bodies, file)
                joints.append(_joint(element, index, bodies[child], file))
                walk(child, len(joints) - 1)

    walk(roots[0], -1)
    return Arm(root.get("name", file.stem), tuple(joints))


def _end(element: ElementTree.Element, end: str, bodies: dict[str, Any], file: Path) -> str:
    """Return the link that a joint names as its parent or child."""
    found = element.find(end)
    name = "" if found is None else found.get("link", "")
    if name not in bodies:
        raise InputError(
            f"{end} of joint {element.get('name')!r}",
            expected="a link of the file",
            got=repr(name),
            remedy="correct the name",
            file=file,
            place=f"joint {element.get('name')}",
        )
    return name


def _joint(element: ElementTree.Element, parent: int, body: tuple[float, FloatArray, FloatArray], file: Path) -> Joint:
    """Return the joint of an element."""
    kind, name = element.get("type", ""), element.get("name", "")
    place = f"joint {name}"
    if kind not in MOVING | {"fixed"}:
        raise InputError(
            "kind of joint",
            expected=f"one of {', '.join(sorted(MOVING))}, fixed",
            got=repr(kind),
            remedy="split it into such joints",
            file=file,
            place=place,
        )
    rotation, offset = pose_of(element.find("origin"), file, place)
    axis = vector_of(None if kind == "fixed" else element.find("axis"), "xyz", (1.0, 0.0, 0.0), file, place)
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError(
            "axis", expected="a direction", got="a zero vector", remedy="correct it", file=file, place=place
        )
    limit = element.find("limit")
    bounded = limit is not None and kind in ("revolute", "prismatic")
    return Joint(
        name,
        parent,
        kind,
        rotation,
        offset,
        axis / length,
        *body,
        lower=_number(limit, "lower", 0.0, file, place) if bounded else -math.inf,
        upper=_number(limit, "upper", 0.0, file, place) if bounded else math.inf,
        effort=_number(limit, "effort", math.inf, file, place),
        velocity=_number(limit, "velocity", math.inf, file, place),
    )


def _body(link: ElementTree.Element, file: Path) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass and inertia about it of a link; zeros where it has none."""
    place = f"link {link.get('name')}"
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    rotation, centre = pose_of(inertial.find("origin"), file, place)
    mass = _number(inertial.find("mass"), "value", 0.0, file, place)
    element = inertial.find("inertia")
    xx, xy, xz, yy, yz, zz = (_number(element, f"i{n}", 0.0, file, place) for n in ("xx", "xy", "xz", "yy", "yz", "zz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, centre, rotation @ inertia @ rotation.T


def pose_of(origin: ElementTree.Element | None, file: Path, place: str) -> tuple[FloatArray, FloatArray]:
    """Return rotation matrix and position of an ``origin`` (rpy: about fixed x, then y, then z)."""
    roll, pitch, yaw = vector_of(origin, "rpy", (0.0, 0.0, 0.0), file, place)
    cr, sr, cp, sp, cy, sy = (f(x) for x in (roll, pitch, yaw) for f in (math.cos, math.sin))
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation, vector_of(origin, "xyz", (0.0, 0.0, 0.0), file, place)


def vector_of(
    element: ElementTree.Element | None, key: str, default: tuple[float, float, float], file: Path, place: str
) -> FloatArray:
    """Return three numbers of an attribute."""
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise InputError(key, expected="three numbers", got=repr(text), remedy="correct it", file=file, place=place)
    return np.array(values)


def _number(element: ElementTree.Element | None, key: str, default: float, file: Path, place: str) -> float:
    """Return a number of an attribute."""
    text = None if element is None else element.get(key)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError as error:
        raise InputError(
            key, expected="a number", got=repr(text), remedy="correct it", file=file, place=place
        ) from error


def _body_symbols(p: Any) -> tuple[Any, Any, Any]:
    """Return mass, first moment and inertia of ten parameters."""
    import casadi as ca

    rows = [ca.horzcat(p[4], p[5], p[6]), ca.horzcat(p[5], p[7], p[8]), ca.horzcat(p[6], p[8], p[9])]
    return p[0], p[1:4], ca.vertcat(*rows)


def _rotation_about(axis: FloatArray, angle: Any) -> Any:
    """Return the rotation matrix about a unit axis (Rodrigues), symbolic in the angle."""
    import casadi as ca

    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return ca.SX.eye(3) + ca.sin(angle) * ca.SX(cross) + (1 - ca.cos(angle)) * ca.SX(cross @ cross)
