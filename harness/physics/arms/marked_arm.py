"""Where a marker on an arm is, as a camera sees it: from joint readings and all that geometry may be off by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.arm import ArmModel
from harness.physics.arms.joints import MOVING
from harness.physics.arms.vectorised import OnRecords
from harness.signals import Channel, FloatArray


class MarkedArm:
    """A marker on the last body of an arm, seen in the frame of the base or of a camera that stands somewhere.

    Joint i stands at its reading plus ``offset<i>``; the frame of joint j lies ``length<j>`` from that of its parent,
    in the direction that the URDF states; the marker lies ``length_marker`` from the frame of its body.

    The axis of joint i is turned by ``tilt<i>_a`` and ``tilt<i>_b`` about two directions square to it, and lies
    ``shift<i>_a`` and ``shift<i>_b`` off along these: with its offset that is all that a joint may be off by, as in the
    product of exponentials (Park & Okamura 1994, in *Advances in Robot Kinematics*, eq. 6). ``marker_x``, ``_y``,
    ``_z`` are the marker in its body; the base stands at ``camera_x``, ``_y``, ``_z`` in the frame of the camera,
    turned by the rotation vector ``camera_rx``, ``_ry``, ``_rz``.

    Parameters
    ----------
    arm : ArmModel
    marker : (x, y, z)
        In the frame of the last body [m].

    Attributes
    ----------
    parameters : mapping
        Name to value as the URDF has it: offsets 0, lengths as far as they are not 0, no tilt, no shift, the camera at
        the base.
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

    def __init__(self, arm: ArmModel, marker: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self.arm, self.marker = arm, np.asarray(marker, dtype=float)
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
        self.parameters = {f"offset{row + 1}": 0.0 for row in range(arm.n)}
        for number, joint in enumerate(arm.arm.joints):
            if np.any(joint.offset):
                self.parameters[f"length{number + 1}"] = float(np.linalg.norm(joint.offset))
        if np.any(self.marker):
            self.parameters["length_marker"] = float(np.linalg.norm(self.marker))
        lengths = list(self.parameters.values())[arm.n :]
        self.parameters |= {f"{word}{row + 1}_{way}": 0.0 for row in range(arm.n)
                            for word in ("tilt", "shift") for way in "ab"}  # fmt: skip
        self.parameters |= {f"marker_{axis}": float(x) for axis, x in zip("xyz", self.marker, strict=True)}
        self.parameters |= {f"camera_{turn}{axis}": 0.0 for turn in ("", "r") for axis in "xyz"}
        turns = ("tilt", "camera_r")
        at_joints = dict(zip(self.parameters, (channel.unit for channel in arm.positions), strict=False))
        self.units = tuple(at_joints.get(name, "rad" if name.startswith(turns) else "m") for name in self.parameters)
        self._made: dict[tuple[tuple[int, ...], bytes], tuple[OnRecords, OnRecords]] = {}
        reach = max(sum(lengths), 1e-3)
        self.scale = np.array([
            known if name.startswith("length") else 1.0 if name.startswith(("offset", *turns)) else reach
            for name, known in self.parameters.items()
        ])  # fmt: skip

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The coordinates of the marker."""
        return tuple(Channel(f"marker_{axis}", "m") for axis in "xyz")

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
        """Return the marker (N, 3) [m] at joint readings (N, n); ``free`` numbers the parameters that will change."""
        given = self.vector() if parameters is None else parameters
        chosen, (places, _) = self._functions(given, free)
        return places(np.asarray(q, dtype=float), given[chosen])[0]

    def jacobians(
        self, q: FloatArray, parameters: FloatArray, free: Sequence[int] | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the marker (N, 3), and its derivatives by parameters (N, 3, k) and by readings (N, 3, n).

        ``free`` numbers the parameters whose derivatives are wanted; all by default.
        """
        chosen, (_, jacobians) = self._functions(parameters, free)
        place, own, turned = jacobians(np.asarray(q, dtype=float), parameters[chosen])
        n, k = self.arm.n, len(chosen)
        return place, own.reshape(-1, k, 3).transpose(0, 2, 1), turned.reshape(-1, n, 3).transpose(0, 2, 1)

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
        return MarkedArm, (self.arm, tuple(self.marker.tolist()))

    def _symbols(self, p: Any) -> tuple[Any, Any]:
        """Return symbols of the readings, and the place of the marker with parameters (k,)."""
        import casadi as ca

        q = ca.SX.sym("q", self.arm.n)
        column = {name: p[row] for row, name in enumerate(self.parameters)}
        camera = ca.vertcat(*(column[f"camera_{axis}"] for axis in "xyz"))
        turn = _turned(ca.vertcat(*(column[f"camera_r{axis}"] for axis in "xyz")))
        place, index = camera, 0
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
        marker = ca.vertcat(*(column[f"marker_{axis}"] for axis in "xyz"))
        if "length_marker" in column:
            marker = marker * (column["length_marker"] / self.parameters["length_marker"])
        return q, place + turn @ marker

    def _stretched(self, column: Mapping[str, Any], name: str, vector: FloatArray) -> Any:
        import casadi as ca

        return ca.SX(vector) * (column[name] / self.parameters[name]) if name in column else ca.SX(vector)

    def _written(self, free: Sequence[int], parameters: FloatArray) -> tuple[OnRecords, OnRecords]:
        import casadi as ca

        own = ca.SX.sym("p", len(free))
        whole = ca.SX(parameters)
        for row, number in enumerate(free):
            whole[number] = own[row]
        q, place = self._symbols(whole)
        by = [ca.densify(ca.jacobian(place, argument)) for argument in (own, q)]
        outputs = {"marker": [place], "marker_jacobians": [place, *by]}
        places, jacobians = (OnRecords(ca.Function(name, [q, own], each)) for name, each in outputs.items())
        return places, jacobians


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
