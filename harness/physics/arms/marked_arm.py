"""Where a marker on an arm is: positions from joint readings, offsets of the joints and lengths of the links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.physics.arms.arm import ArmModel
from harness.physics.arms.joints import MOVING
from harness.physics.arms.vectorised import OnRecords
from harness.signals import Channel, FloatArray

__all__ = ["MarkedArm"]


class MarkedArm:
    """A marker on the last body of an arm, seen in the frame of the base.

    Joint i stands at its reading plus ``offset<i>``; the frame of joint j lies ``length<j>`` from that of its parent,
    in the direction that the URDF states; the marker lies ``length_marker`` from the frame of its body.

    Parameters
    ----------
    arm : ArmModel
    marker : (x, y, z)
        In the frame of the last body [m].

    Attributes
    ----------
    parameters : mapping
        Name to value as the URDF has it: offsets 0, lengths as far as they are not 0.
    units : tuple of str

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
    >>> marked.parameters
    {'offset1': 0.0, 'length_marker': 0.5}
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
        self.units = (*(channel.unit for channel in arm.positions), *("m" for _ in range(len(self.parameters) - arm.n)))

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
        unknown = sorted(set(given or {}) - set(self.parameters))
        if unknown:
            raise InputError(
                f"parameter of the marker on {self.arm.name}",
                expected=f"one of {', '.join(self.parameters)}",
                got=", ".join(unknown),
                remedy="correct the name",
            )
        return np.array(list((self.parameters | dict(given or {})).values()))

    def places(self, q: FloatArray, parameters: FloatArray | None = None) -> FloatArray:
        """Return the marker (N, 3) [m] at joint readings (N, n)."""
        return self._function(np.asarray(q, dtype=float), self.vector() if parameters is None else parameters)[0]

    def jacobians(self, q: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the marker (N, 3), and its derivatives by parameters (N, 3, k) and by readings (N, 3, n)."""
        place, own, turned = self._jacobians(np.asarray(q, dtype=float), parameters)
        n, k = self.arm.n, len(self.parameters)
        return place, own.reshape(-1, k, 3).transpose(0, 2, 1), turned.reshape(-1, n, 3).transpose(0, 2, 1)

    def __reduce__(self) -> tuple[Any, ...]:
        return MarkedArm, (self.arm, tuple(self.marker.tolist()))

    @cached_property
    def _symbols(self) -> tuple[Any, Any, Any]:
        import casadi as ca

        q, p = ca.SX.sym("q", self.arm.n), ca.SX.sym("p", len(self.parameters))
        column = {name: p[row] for row, name in enumerate(self.parameters)}
        turn, place = ca.SX.eye(3), ca.SX.zeros(3)
        index = 0
        for number, joint in enumerate(self.arm.arm.joints):
            place = place + turn @ self._stretched(column, f"length{number + 1}", joint.offset)
            turn = turn @ ca.SX(joint.rotation)
            if joint.kind not in MOVING:
                continue
            at = q[index] + p[index]
            index += 1
            if joint.kind == "prismatic":
                place = place + turn @ (ca.SX(joint.axis) * at)
                continue
            x, y, z = joint.axis
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            turn = turn @ (ca.SX.eye(3) + ca.sin(at) * ca.SX(cross) + (1 - ca.cos(at)) * ca.SX(cross @ cross))
        return q, p, place + turn @ self._stretched(column, "length_marker", self.marker)

    def _stretched(self, column: Mapping[str, Any], name: str, vector: FloatArray) -> Any:
        import casadi as ca

        return ca.SX(vector) * (column[name] / self.parameters[name]) if name in column else ca.SX(vector)

    @cached_property
    def _function(self) -> OnRecords:
        import casadi as ca

        q, p, place = self._symbols
        return OnRecords(ca.Function("marker", [q, p], [place]))

    @cached_property
    def _jacobians(self) -> OnRecords:
        import casadi as ca

        q, p, place = self._symbols
        by = [ca.densify(ca.jacobian(place, argument)) for argument in (p, q)]
        return OnRecords(ca.Function("marker_jacobians", [q, p], [place, *by]))
