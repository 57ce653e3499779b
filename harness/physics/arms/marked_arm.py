"""What a camera sees of an arm that carries a marker, or the camera: from readings and geometry that may be off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.arm import ArmModel, load_arm
from harness.physics.arms.joints import MOVING, Joint
from harness.physics.arms.rigid_tree import Arm
from harness.physics.arms.vectorised import OnRecords
from harness.signals import Channel, FloatArray

Eye = Literal["room", "hand"]
HAND, REPORTED = "hand", "reported hand"  # The model of a hand whose controller reports its pose, and its name.


class MarkedArm:
    """A marker on the last body of an arm that a camera sees; or a camera on that body, which sees a target.

    Joint i stands at its reading plus ``offset<i>``; the frame of joint j lies ``length<j>`` from that of its parent,
    in the direction that the URDF states; the marker lies ``length_marker`` from the frame of its body.

    The axis of joint i is turned by ``tilt<i>_a`` and ``tilt<i>_b`` about two directions square to it, and lies
    ``shift<i>_a`` and ``shift<i>_b`` off along these: with its offset that is all that a joint may be off by, as in the
    product of exponentials (Park & Okamura 1994, in *Advances in Robot Kinematics*, eq. 6). ``marker_x``, ``_y``,
    ``_z`` are the marker in its body; the base stands at ``camera_x``, ``_y``, ``_z`` in the frame of the camera,
    turned by the rotation vector ``camera_rx``, ``_ry``, ``_rz``. With ``pose`` the marker is turned in its body by
    ``marker_rx``, ``_ry``, ``_rz``. With ``eye="hand"`` ``camera_...`` is the pose of the camera in the last body, and
    ``target_...`` that of the target in the frame of the base.

    Parameters
    ----------
    arm : ArmModel
    marker : (x, y, z)
        In the frame of the last body [m]: of the marker, or of the camera with ``eye="hand"``.
    pose : bool
        Whether the camera tells the orientation of what it sees too: the x and the y axis of the marker or target in
        the frame of the camera (the first two columns of its rotation matrix, which never jump).
    eye : {"room", "hand"}
        Where the camera is.

    Attributes
    ----------
    parameters : mapping
        Name to value as the URDF has it: offsets 0, lengths as far as they are not 0, no tilt, no shift, the camera or
        the target at the base.
    units : tuple of str
    scale : array (k,)
        A radian, or the reach of the arm [m]: lengths have their own.

    Raises
    ------
    InputError
        If the arm branches, so that there is no last body.

    Examples
    --------
    >>> from harness.physics.arms.rigid_tree import pendulum_for_the_example
    >>> zero = np.zeros(1)
    >>> arm = ArmModel("hinge", pendulum_for_the_example(), zero, zero, zero, (Channel("tau1", "N m"),),
    ...     (Channel("q1", "rad"),))
    >>> marked = MarkedArm(arm, (0.5, 0.0, 0.0))
    >>> list(marked.parameters)[:6]
    ['offset1', 'length_marker', 'tilt1_a', 'tilt1_b', 'shift1_a', 'shift1_b']
    >>> marked.places(np.array([[np.pi / 2]])).round(6).tolist()
    [[0.0, 0.0, 0.5]]
    """

    def __init__(
        self, arm: ArmModel, marker: Sequence[float] = (0.0, 0.0, 0.0), *, pose: bool = False, eye: Eye = "room"
    ) -> None:
        self.arm, self.marker, self.pose, self.eye = arm, np.asarray(marker, dtype=float), pose, eye
        if eye not in ("room", "hand"):
            raise InputError("option eye", expected="room or hand", got=repr(eye), remedy="say where the camera is")
        self.carried, self.standing = ("marker", "camera") if eye == "room" else ("camera", "target")
        if self.marker.shape != (3,) or not np.isfinite(self.marker).all():
            raise InputError("marker", expected="three numbers [m]", got=repr(marker), remedy="give (x, y, z)")
        parents = [joint.parent for joint in arm.arm.joints]
        if parents != list(range(-1, len(parents) - 1)):
            raise InputError(
                f"marker on {arm.name}",
                expected="a chain of joints, so that there is a last body",
                got="an arm that branches",
                remedy="cut the URDF to the chain that carries the marker",
            )
        self.parameters = self._known()
        lengths = [known for name, known in self.parameters.items() if name.startswith("length")]
        turns = ("tilt", f"{self.carried}_r", f"{self.standing}_r")
        at_joints = dict(zip(self.parameters, (channel.unit for channel in arm.positions), strict=False))
        self.units = tuple(at_joints.get(name, "rad" if name.startswith(turns) else "m") for name in self.parameters)
        self._made: dict[tuple[tuple[int, ...], bytes], tuple[OnRecords, OnRecords]] = {}
        slides = any(joint.kind == "prismatic" for joint in arm.arm.moving)
        reach = 1.0 if slides else max(sum(lengths), 1e-3)  # how far a slide goes no length tells
        self.scale = np.array([
            known if name.startswith("length") else 1.0 if name.startswith(("offset", *turns)) else reach
            for name, known in self.parameters.items()
        ])  # fmt: skip

    def _known(self) -> dict[str, float]:
        """Return every parameter as the URDF has it."""
        known = {f"offset{row + 1}": 0.0 for row in range(self.arm.n)}
        for number, joint in enumerate(self.arm.arm.joints):
            if np.any(joint.offset):
                known[f"length{number + 1}"] = float(np.linalg.norm(joint.offset))
        if np.any(self.marker) and self.eye == "room":
            known["length_marker"] = float(np.linalg.norm(self.marker))
        known |= {f"{word}{row + 1}_{way}": 0.0 for row in range(self.arm.n)
                  for word in ("tilt", "shift") for way in "ab"}  # fmt: skip
        known |= {f"{self.carried}_{axis}": float(x) for axis, x in zip("xyz", self.marker, strict=True)}
        if self.pose or self.eye == "hand":
            known |= {f"{self.carried}_r{axis}": 0.0 for axis in "xyz"}
        known |= {f"{self.standing}_{axis}": 0.0 for axis in "xyz"}
        if self.pose or self.eye == "room":
            known |= {f"{self.standing}_r{axis}": 0.0 for axis in "xyz"}
        return known

    @property
    def reported(self) -> bool:
        """Whether the readings are the pose of the hand, so that no joint is known."""
        return self.arm.arm.name == REPORTED

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What the camera sees: the place [m], and with ``pose`` the x and the y axis, each (x, y, z)."""
        seen = "marker" if self.eye == "room" else "target"
        axes = [Channel(f"{seen}_{which}{axis}", "1") for which in "xy" for axis in "xyz"]
        return (*(Channel(f"{seen}_{axis}", "m") for axis in "xyz"), *(axes if self.pose else ()))

    def vector(self, given: Mapping[str, float] | None = None) -> FloatArray:
        """Return the parameters (k,), those in ``given`` replaced.

        Raises
        ------
        InputError
            If a name is unknown.
        """
        refuse_unknown(f"parameter of the marker on {self.arm.name}", given or (), self.parameters)
        return np.array(list((self.parameters | dict(given or {})).values()))

    def places(
        self, q: FloatArray, parameters: FloatArray | None = None, free: Sequence[int] | None = None
    ) -> FloatArray:
        """Return what is seen (N, 3 or 9) at readings (N, n); ``free`` numbers the parameters that will change."""
        given = self.vector() if parameters is None else parameters
        chosen, (places, _) = self._functions(given, free)
        return places(np.asarray(q, dtype=float), given[chosen])[0]

    def jacobians(
        self, q: FloatArray, parameters: FloatArray, free: Sequence[int] | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what is seen (N, 3 or 9), and its derivatives by parameters (N, d, k) and by readings (N, d, n).

        d = 3 or, with the orientation, 6: the place, and the rotation vector by which a small change turns it, in the
        frame of the camera. ``free`` numbers the parameters whose derivatives are wanted; all by default.
        """
        chosen, (_, jacobians) = self._functions(parameters, free)
        place, own, turned = jacobians(np.asarray(q, dtype=float), parameters[chosen])
        n, k, d = self.arm.n, len(chosen), 6 if self.pose else 3
        return place, own.reshape(-1, k, d).transpose(0, 2, 1), turned.reshape(-1, n, d).transpose(0, 2, 1)

    def errors(self, seen: FloatArray, said: FloatArray) -> FloatArray:
        """Return by how much what was seen differs from what is said (N, d), in the sense of :meth:`jacobians`."""
        if not self.pose:
            return seen - said
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(turns_of(seen)) * Rotation.from_matrix(turns_of(said)).inv()
        return np.hstack([seen[:, :3] - said[:, :3], turn.as_rotvec()])

    def frames(self, parameters: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the pose (3, 3), (3,) of every joint's frame in that of its parent at reading 0, offsets included."""
        from scipy.spatial.transform import Rotation

        own, found, index = dict(zip(self.parameters, parameters.tolist(), strict=True)), [], 0
        for number, joint in enumerate(self.arm.arm.joints):
            name = f"length{number + 1}"
            place, turn = joint.offset * (own[name] / self.parameters[name] if name in own else 1.0), joint.rotation
            if joint.kind in MOVING:
                index += 1
                tilt, shift = (
                    _across(joint.axis) @ [own[f"{word}{index}_{way}"] for way in "ab"] for word in ("tilt", "shift")
                )
                place, turn = place + turn @ shift, turn @ Rotation.from_rotvec(tilt).as_matrix()
                if joint.kind == "prismatic":
                    place = place + turn @ (joint.axis * own[f"offset{index}"])
                else:
                    turn = turn @ Rotation.from_rotvec(joint.axis * own[f"offset{index}"]).as_matrix()
            found.append((turn, place))
        return found

    def _functions(
        self, parameters: FloatArray, free: Sequence[int] | None
    ) -> tuple[list[int], tuple[OnRecords, OnRecords]]:
        """Return which parameters are arguments, and the place and its derivatives as functions of them.

        What does not change is written in as numbers: most of it is 0 and falls out.
        """
        chosen = list(range(len(self.parameters)) if free is None else free)
        key = tuple(chosen), np.delete(parameters, chosen).tobytes()
        if key not in self._made:
            self._made[key] = self._written(chosen, parameters)
        return chosen, self._made[key]

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, (self.arm, tuple(self.marker.tolist()), self.pose, self.eye)

    def _symbols(self, p: Any) -> tuple[Any, Any, Any]:
        """Return symbols of the readings, place and orientation of what is seen with parameters (k,)."""
        import casadi as ca

        q = ca.SX.sym("q", self.arm.n)
        column = {name: p[row] for row, name in enumerate(self.parameters)}
        standing, carried = (
            (
                ca.vertcat(*(column[f"{word}_{axis}"] for axis in "xyz")),
                _turned(ca.vertcat(*(column.get(f"{word}_r{axis}", 0.0) for axis in "xyz"))),
            )
            for word in (self.standing, self.carried)
        )
        (place, turn), index = standing if self.eye == "room" else (ca.SX.zeros(3), ca.SX.eye(3)), 0
        for number, joint in enumerate(self.arm.arm.joints):
            place = place + turn @ self._stretched(column, f"length{number + 1}", joint.offset)
            turn = turn @ ca.SX(joint.rotation)
            if joint.kind not in MOVING:
                continue
            across = _across(joint.axis)
            tilt, shift = (
                ca.SX(across) @ ca.vertcat(*(column[f"{word}{index + 1}_{way}"] for way in "ab"))
                for word in ("tilt", "shift")
            )
            place, turn = place + turn @ shift, turn @ _turned(tilt)
            at = q[index] + p[index]
            index += 1
            if joint.kind == "prismatic":
                place = place + turn @ (ca.SX(joint.axis) * at)
                continue
            x, y, z = joint.axis
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            turn = turn @ (ca.SX.eye(3) + ca.sin(at) * ca.SX(cross) + (1 - ca.cos(at)) * ca.SX(cross @ cross))
        marker = carried[0]
        if "length_marker" in column:
            marker = marker * (column["length_marker"] / self.parameters["length_marker"])
        place, turn = place + turn @ marker, turn @ carried[1]
        return (q, place, turn) if self.eye == "room" else (q, turn.T @ (standing[0] - place), turn.T @ standing[1])

    def _stretched(self, column: Mapping[str, Any], name: str, vector: FloatArray) -> Any:
        import casadi as ca

        return ca.SX(vector) * (column[name] / self.parameters[name]) if name in column else ca.SX(vector)

    def _written(self, free: Sequence[int], parameters: FloatArray) -> tuple[OnRecords, OnRecords]:
        import casadi as ca

        own = ca.SX.sym("p", len(free))
        whole = ca.SX(parameters)
        for row, number in enumerate(free):
            whole[number] = own[row]
        q, place, turn = self._symbols(whole)
        by = [ca.jacobian(place, argument) for argument in (own, q)]
        if self.pose:  # a column c that turns by w changes by w x c, and the c x (w x c) of the three sum to 2 w
            columns = [turn[:, k] for k in range(3)]
            by = [
                ca.vertcat(one, 0.5 * sum(ca.skew(c) @ ca.jacobian(c, argument) for c in columns))
                for one, argument in zip(by, (own, q), strict=True)
            ]
            place = ca.vertcat(place, *columns[:2])
        outputs = {"marker": [place], "marker_jacobians": [place, *map(ca.densify, by)]}
        places, jacobians = (OnRecords(ca.Function(name, [q, own], each)) for name, each in outputs.items())
        return places, jacobians


def marked_arm(model: str, marker: Sequence[float], *, pose: bool = False, eye: Eye = "room") -> MarkedArm:
    """Return the arm of a model, or the hand whose pose is reported (:data:`HAND`), with its marker or camera."""
    return MarkedArm(reported_hand() if model == HAND else load_arm(model), marker, pose=pose, eye=eye)


def reported_hand() -> ArmModel:
    """Return a hand whose readings are its pose in the frame of the base: a chain of three slides and three turns.

    R = Rz(yaw) Ry(pitch) Rx(roll), as a URDF has it.
    """
    turn, zero, names = np.eye(3), np.zeros(3), ("x", "y", "z", "yaw", "pitch", "roll")
    ends = (-np.inf, np.inf, np.inf, np.inf)
    joints = tuple(
        Joint(name, number - 1, "prismatic" if number < 3 else "continuous", turn, zero, np.eye(3)[axis], 0.0, zero,
              np.zeros((3, 3)), *ends)
        for number, (name, axis) in enumerate(zip(names, (0, 1, 2, 2, 1, 0), strict=True))
    )  # fmt: skip
    units = ["m"] * 3 + ["rad"] * 3
    readings = tuple(Channel(f"hand_{name}", unit) for name, unit in zip(names, units, strict=True))
    nothing = np.zeros(6)
    forces = tuple(Channel(f"force_{name}", unit) for name, unit in zip(names, ["N"] * 3 + ["N m"] * 3, strict=True))
    return ArmModel(HAND, Arm(REPORTED, joints), nothing, nothing, nothing, forces, readings)


def turns_of(seen: FloatArray) -> FloatArray:
    """Return the rotation matrices (N, 3, 3) next to the axes that were seen (N, 9)."""
    x, y = seen[:, 3:6], seen[:, 6:9]
    left, _, right = np.linalg.svd(np.stack([x, y, np.cross(x, y)], axis=2))
    return np.asarray(left @ right)


def _remade(arm: ArmModel, marker: tuple[float, ...], pose: bool, eye: Eye) -> MarkedArm:
    return MarkedArm(arm, marker, pose=pose, eye=eye)


def _across(axis: FloatArray) -> FloatArray:
    """Return two unit vectors square to an axis and to each other (3, 2)."""
    return np.asarray(np.linalg.svd(np.asarray(axis, dtype=float)[None])[2][1:].T)


def _turned(vector: Any) -> Any:
    """Return the rotation of a rotation vector (Rodrigues)."""
    import casadi as ca

    square = ca.dot(vector, vector) + 1e-24
    angle = ca.sqrt(square)
    cross = ca.skew(vector)
    return ca.SX.eye(3) + ca.sin(angle) / angle * cross + (1 - ca.cos(angle)) / square * (cross @ cross)
