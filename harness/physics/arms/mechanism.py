"""An arm as a mechanism: written out in symbols where it is small, generated code where it is large."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.arm import GRAVITY, REST, ArmModel, load_arm
from harness.physics.arms.inertia import TEN, UNITS
from harness.physics.arms.joints import MOVING, Joint
from harness.physics.compiled.system import BodyTerm, Coordinate, System
from harness.physics.definition.parameters import Parameter
from harness.physics.symbolic.mechanism import Mechanism
from harness.signals import Channel

SMALL = 3
"""So many moving joints are written out in symbols: a Lagrangian of four spatial joints has thousands of terms."""
SQUARE = 1e-9
"""A frame is square to its parent if its rotation is less than this from turns of 90 degrees, which URDFs round."""


class ArmMechanism(Mechanism):
    """An arm read from a file, in the coordinates q1, q2, ... and the torques tau1, tau2, ... of its moving joints.

    Parameters are ten for every body (``m1``, ``hx1`` ... ``Izz1``, by number of its joint), damping and dry friction
    of every moving joint (``damping1``, ``friction1``), and the inertia of the rotors that the file states
    (``motor_inertia1``). Gravity pulls along -z of the base.

    Parameters
    ----------
    arm : ArmModel
    passive : sequence of str, optional
        Joints without a motor, by name. By default those that no ``<transmission>`` (or actuator of an MJCF) names, if
        the file has any.

    Attributes
    ----------
    arm : ArmModel
    symbolic : bool
        Whether the Lagrangian is written out: up to three moving joints, whose frames are square to each other. Else
        energies and forces are generated code, and base parameters are found on the regressor's columns.

    Raises
    ------
    InputError
        If a passive joint is unknown.

    Examples
    --------
    >>> from harness.physics.arms.arm import ArmModel
    >>> from harness.physics.lumps.lumped_model import lumped
    >>> from harness.physics.arms.rigid_tree import pendulum_for_the_example
    >>> hinge = pendulum_for_the_example()
    >>> zero = np.zeros(1)
    >>> arm = ArmModel("hinge", hinge, zero, zero, zero, (Channel("tau1", "N m"),), (Channel("q1", "rad"),))
    >>> lumped(ArmMechanism(arm)).names
    ('Iyy1', 'hx1', 'hz1', 'damping1', 'friction1')
    """

    def __init__(self, arm: ArmModel, *, passive: Sequence[str] | None = None) -> None:
        joints, moving = arm.arm.joints, arm.arm.moving
        idle = _passive(arm, passive)
        driven = [channel.name for channel, joint in zip(arm.inputs, moving, strict=True) if joint.name not in idle]
        inertial = [f"{name}{body + 1}" for body in range(len(joints)) for name in TEN]
        at_joints = [f"{kind}{joint + 1}" for kind in ("damping", "friction") for joint in range(arm.n)]
        at_joints += [f"motor_inertia{joint + 1}" for joint in _geared(arm)]
        positions = [channel.name for channel in arm.positions]
        units = {channel.name: channel.unit for channel in (*arm.positions, *arm.inputs)}
        super().__init__(
            arm.name,
            " ".join(positions),
            " ".join(driven),
            " ".join([*inertial, *at_joints]),
            g=-GRAVITY[2],
            units=units,
        )
        self.arm = arm
        self.symbolic = arm.n <= SMALL and all(_is_square(joint) for joint in joints)
        self.parameters(self._known(inertial, at_joints))
        by_name = {str(symbol): symbol for symbol in self.u}
        drag = dict(zip(at_joints, self.p[len(inertial) :], strict=True))
        self.Q = [
            by_name.get(channel.name, sp.Integer(0))
            - drag[f"damping{row + 1}"] * self.v[row]
            - drag[f"friction{row + 1}"] * sp.tanh(self.v[row] / sp.Float(REST))
            for row, channel in enumerate(arm.inputs)
        ]
        if self.symbolic:
            self.T, self.V = _energies(joints, self.q, self.v, self.p[: len(inertial)], sp.Rational(repr(self.g)))
            for row in _geared(arm):
                self.T += drag[f"motor_inertia{row + 1}"] * self.v[row] ** 2 / 2

    def system(self) -> System:
        """Return the equations of motion: recursive Newton-Euler, so that a large arm costs no more than its joints."""
        arm, n, nu, npar = self.arm, len(self.q), len(self.u), len(self.p)
        x, u, p, t = ca.SX.sym("x", 2 * n), ca.SX.sym("u", nu), ca.SX.sym("p", npar), ca.SX.sym("t")
        direction = ca.SX.sym("gravity", 2)
        q, v = x[:n], x[n:]
        count = 10 * len(arm.arm.joints)
        symbols, torques = arm.arm.symbolic_torques(p[:count])
        pull = self.g * ca.vertcat(direction[0], 0, direction[1])
        matrix = ca.substitute(ca.jacobian(torques, symbols[2]), symbols[0], q)
        for place, row in enumerate(_geared(arm)):
            matrix[row, row] += p[count + 2 * n + place]
        bias = ca.substitute(torques, ca.vertcat(*symbols), ca.vertcat(q, v, ca.SX.zeros(n), pull))
        damping, friction = p[count : count + n], p[count + n : count + 2 * n]
        drag = damping * v + friction * ca.tanh(v / REST)
        known = [str(symbol) for symbol in self.u]
        push = ca.SX.zeros(n)
        for row, channel in enumerate(arm.inputs):
            if channel.name in known:
                push[row] = u[known.index(channel.name)]
        bodies = []
        for number in range(len(arm.arm.joints)):
            alone = ca.SX.zeros(npar)
            alone[10 * number : 10 * number + 10] = p[10 * number : 10 * number + 10]
            moved = tuple(_movers(arm.arm.joints, number))
            bodies.append(BodyTerm(moved, ca.substitute(matrix, p, alone), ca.substitute(-bias, p, alone)))
        rates = [f"{channel.unit}/s" for channel in arm.positions]
        return System(
            name=self.name,
            inputs=tuple(channel for channel in arm.inputs if channel.name in known),
            outputs=arm.positions,
            states=(
                *arm.positions,
                *(Channel(f"{channel.name}_rate", unit) for channel, unit in zip(arm.positions, rates, strict=True)),
            ),
            parameters=self.parameter_list(),
            x=x,
            u=u,
            p=p,
            t=t,
            gravity=direction,
            mass_matrix=matrix,
            generalized_forces=push - bias - drag,
            rates=ca.SX(0, 1),
            h=q,
            coordinates=tuple(
                Coordinate(position.name, position.unit, push_on.unit, row, n + row, row)
                for row, (position, push_on) in enumerate(zip(arm.positions, arm.inputs, strict=True))
            ),
            bodies=tuple(bodies),
            mechanism=self,
        )

    def _known(self, inertial: Sequence[str], at_joints: Sequence[str]) -> dict[str, Parameter]:
        """Return unit, value and bounds of every parameter: masses, damping and friction are not negative."""
        arm, n = self.arm, self.arm.n
        geared = _geared(arm)
        values = [*arm.arm.parameters, *arm.damping, *arm.friction, *arm.motor_inertia[geared]]
        turns = [channel.unit == "rad" for channel in arm.positions]
        units = [*UNITS * len(arm.arm.joints)]
        units += ["N m s/rad" if turn else "N s/m" for turn in turns] + ["N m" if turn else "N" for turn in turns]
        units += ["kg m^2" if turns[joint] else "kg" for joint in geared]
        found = {}
        for row, (name, unit, value) in enumerate(zip((*inertial, *at_joints), units, values, strict=True)):
            positive = value > 0 and (row >= len(inertial) or row % 10 in (0, 4, 7, 9))
            found[name] = Parameter(name, unit, float(value), 0.0 if positive else -np.inf)
        assert len(found) == len(inertial) + 2 * n + len(geared)
        return found


def arm_mechanism(name: str, *, passive: Sequence[str] | None = None, locked: Sequence[str] = ()) -> ArmMechanism:
    """Return the mechanism of an arm by name (``iiwa``), URDF or MJCF file.

    Parameters
    ----------
    name : str
    passive : sequence of str, optional
        Joints without a motor; see :class:`ArmMechanism`.
    locked : sequence of str
        Joints that do not move and are not in the log.
    """
    return ArmMechanism(load_arm(name, locked=locked), passive=passive)


def _geared(arm: ArmModel) -> list[int]:
    """Return the numbers of the joints whose motor's rotor the file states."""
    return np.flatnonzero(arm.motor_inertia).tolist()


def _passive(arm: ArmModel, given: Sequence[str] | None) -> set[str]:
    """Return the names of the joints without a motor."""
    names = [joint.name for joint in arm.arm.moving]
    if given is None:
        return set(arm.idle)
    refuse_unknown("passive joint", given, names)
    return set(given)


def _movers(joints: Sequence[Joint], number: int) -> list[int]:
    """Return the numbers of the coordinates that move a body."""
    place = {row: k for k, row in enumerate(row for row, joint in enumerate(joints) if joint.kind in MOVING)}
    found = []
    while number >= 0:
        if number in place:
            found.append(place[number])
        number = joints[number].parent
    return sorted(found)


def _is_square(joint: Joint) -> bool:
    """Return True if the frame and the axis of a joint are those of its parent but for turns of 90 degrees."""
    return all(float(np.abs(part - np.round(part)).max()) < SQUARE for part in (joint.rotation, joint.axis))


def _exact(numbers: Any) -> Any:
    """Return numbers as SymPy rationals, so that what cancels, cancels."""
    return sp.Matrix(np.asarray(numbers).reshape(len(numbers), -1).tolist()).applyfunc(
        lambda value: sp.Rational(repr(round(float(value), 12)))
    )


def _energies(joints: Sequence[Joint], q: Any, v: Any, p: Any, g: Any) -> tuple[Any, Any]:
    """Return kinetic and potential energy in the ten parameters of every body, velocities in the bodies' own frames."""
    kinetic, potential = sp.Integer(0), sp.Integer(0)
    frames: list[tuple[Any, ...]] = []
    still = sp.zeros(3, 1)
    index = 0
    for number, joint in enumerate(joints):
        turn, place, spin, speed = (sp.eye(3), still, still, still) if joint.parent < 0 else frames[joint.parent]
        pose, offset, axis = (_exact(part) for part in (np.round(joint.rotation), joint.offset, np.round(joint.axis)))
        angle, rate = (q[index], v[index]) if joint.kind in MOVING else (sp.Integer(0), sp.Integer(0))
        index += joint.kind in MOVING
        if joint.kind == "prismatic":
            offset = offset + pose * axis * angle
        elif joint.kind in MOVING:
            x, y, z = axis
            cross = sp.Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            pose = pose * (sp.eye(3) + sp.sin(angle) * cross + (1 - sp.cos(angle)) * cross * cross)
        place = place + turn * offset
        turn = turn * pose
        speed = pose.T * (speed + spin.cross(offset))
        spin = pose.T * spin
        if joint.kind == "prismatic":
            speed = speed + axis * rate
        elif joint.kind in MOVING:
            spin = spin + axis * rate
        speed, spin, turn = (part.applyfunc(sp.expand) for part in (speed, spin, turn))
        frames.append((turn, place, spin, speed))
        m, hx, hy, hz, xx, xy, xz, yy, yz, zz = p[10 * number : 10 * number + 10]
        first = sp.Matrix([hx, hy, hz])
        inertia = sp.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        kinetic += m * speed.dot(speed) / 2 + speed.dot(spin.cross(first)) + spin.dot(inertia * spin) / 2
        potential += g * (m * place[2] + (turn * first)[2])
    return kinetic, potential


def arm_of(subject: Any, what: str) -> ArmModel:
    """Return the arm that a model was read from, or refuse the model.

    Raises InputError if it is no arm; ``what`` was asked of it.
    """
    mechanism = getattr(subject, "mechanism", None)
    if not isinstance(mechanism, ArmMechanism):
        raise InputError(
            f"{what} of {getattr(subject, 'name', type(subject).__name__)}",
            expected="an arm read from a URDF or MJCF, such as iiwa",
            got="another model",
            remedy="give a URDF",
        )
    return mechanism.arm
