"""A tree of joints on a fixed base: its inertial parameters and its inverse dynamics by recursive Newton-Euler."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from harness.physics.arms.joints import MOVING, Joint
from harness.physics.arms.regressor import ArmRegressor
from harness.signals import FloatArray


@dataclass(frozen=True, eq=False)
class Arm:
    """A tree of joints on a fixed base, parents before children.

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

    name: str  # Of the robot
    joints: tuple[Joint, ...]  # Fixed ones included

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
        Generated C, compiled at the first call: :class:`harness.physics.arms.regressor.ArmRegressor`.
        """
        return self.compiled_regressor(q, v, a, gravity)

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
    def compiled_regressor(self) -> ArmRegressor:
        """The regressor, generated and compiled when it is first used."""
        return ArmRegressor(self.joints)

    def symbolic_torques(self, parameters: Any, offsets: Any = None) -> tuple[list[Any], Any]:
        """Return the symbols (q, v, a, gravity) and the torques, linear in the inertial parameters.

        - ``parameters``: in the order of :attr:`parameters`
        - ``offsets``: where the joints sit in the frames of their parents [m]; by default as in the file

        Notes
        -----
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
            arm = turn @ (ca.SX(joint.offset) if offsets is None else offsets[3 * number : 3 * number + 3])
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


def pendulum_for_the_example() -> Arm:
    """Return a point mass of 1 kg at 0.5 m on a level hinge."""
    still = np.zeros(3)
    axis, centre = np.array([0.0, -1.0, 0.0]), np.array([0.5, 0.0, 0.0])
    joint = Joint("hinge", -1, "revolute", np.eye(3), still, axis, 1.0, centre, np.zeros((3, 3)), -3.0, 3.0, 10.0, 10.0)
    return Arm("pendulum", (joint,))


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
