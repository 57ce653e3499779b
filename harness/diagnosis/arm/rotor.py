"""The motor and the gear of a joint, which no URDF has: a rotor, friction in the teeth, and a spring before the link.

The model is that of Spong 1987 (J. Dyn. Sys. Meas. Control 109:310): a link that needs tau(q, q', q'') hangs on its
rotor by a spring k and a damper d, so that ``tau(q) = k e + d e'`` and ``u = J theta'' + friction + tau(q)`` with the
twist ``e = theta - q``. Which encoder was logged decides what is known of it:

- Of the motor, theta: the link swings behind it. To first order in the twist ``M e'' + C e' + G e + d e' + k e =
  tau(theta)``, with the gradients M, C, G of the torques by acceleration, speed and position of the joint, and every
  joint needs ``M e'' + C e' + G e`` less: in proportion to the compliance where it is small, with a resonance where it
  is not.
- Of the link, q: the torque through the spring is tau(q), whatever the spring. The rotor runs ahead by the twist, and
  needs ``J e''`` more: the second derivative of the torque times J/k, behind the lag d/k of the damper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from harness.diagnosis.arm.motion import ArmRun, torque_gradient
from harness.diagnosis.policy import ARM_POLICY
from harness.effects.effect import Effect, effect, par
from harness.effects.functions import sign, tanh
from harness.physics.arms.arm import ArmModel
from harness.signals import FloatArray

ROTOR = "rotor_inertia"
ON_LOAD = "load_dependent_friction"
ROWS = 400
"""Samples on which it is asked whether bodies could do the same."""


@effect(
    "coordinate",
    [par("J", "F/a", scale="0.05 F/a", sign="+", neutral=0.0, main=True, linear=True,
         meaning="inertia of the rotor times the square of the gear ratio")],
    formula="F = -J a, a the acceleration of the joint alone, not that of the link in space",
    family=("input_gain",),
    same_as={"parameter": "on joints whose link turns about the joint's axis with the joint alone, such as the first"},
    experiment="the same path at several speeds: the torque grows with the square of the speed, and gravity stays",
)  # fmt: skip
def rotor_inertia(f: Any, s: Any, p: Any, q: Any, v: Any, a: Any) -> Any:
    """Rotor of the motor, geared up: it turns with its joint, wherever the arm carries it."""
    return -p.J * a


def friction_of_the_load(law: Effect, most: float, *, told: bool) -> Effect:
    """Return friction in proportion to the load as a gear has it, of which nobody knows which side's torque counts.

    A share mu of what the load needs (Hamon, Gautier & Garrec 2010, IROS), or of what the motor gives, or an
    efficiency: they differ by mu squared of the load both ways, which the wrong one of them makes a heavier link or a
    gain of the drive.

    Parameters
    ----------
    law : Effect
        Friction of the load as other coordinates have it.
    most : float
        Largest mu.
    told : bool
        Whether that is asked for: where the load is an inertia alone, a rotor does the same. Held at the motor's side,
        it leaves a rotor below nothing at most, and names none that is not there.
    """
    mu, width = law.parameters
    side = par("r", "1", scale="0.5" if told else "1", minimum=0.0, maximum=1.0, nuisance=True, fixed=not told,
               meaning="side whose torque counts: 0 the load's, 1 the motor's, 0.5 an efficiency")  # fmt: skip

    def passed(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
        return f / (1.0 + p.mu * sign(f) * tanh(v / p.w) + p.r * p.mu**2) - f

    return replace(
        law, parameters=(replace(mu, maximum=most), side, width), function=passed, extras=(),
        formula="F = f/(1 + mu sgn(f v) + r mu^2) - f: f = (1 + mu sgn(f v) + r mu^2) load, sgn(v) = tanh(v/w)",
    )  # fmt: skip


def in_the_bodies(arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], joint: int) -> bool:
    """Return whether inertial parameters of the bodies can do the same as the rotor of a joint, in these records.

    So it is at the first joint, and at the second one if its axis stands at a right angle to the first: they are known
    with the moment of inertia of the link about the axis only (Khalil & Dombre 2002, *Modeling, Identification and
    Control of Robots*, sec. 9.4).

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        From :func:`harness.diagnosis.arm.motion.arm_runs`.
    joint : int
        From 0.
    """
    columns, torques = [], []
    for run in runs["estimation"]:
        m = run.calm
        rows = slice(None, None, max(len(m.q) // ROWS, 1))
        columns.append(arm.arm.regressor(m.q[rows], m.v[rows], m.a[rows]))
        torque = np.zeros_like(m.q[rows])
        torque[:, joint] = m.a[rows][:, joint]
        torques.append(torque.ravel())
    x, wanted = np.concatenate(columns), np.concatenate(torques)
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    left = wanted - x @ np.linalg.lstsq(x, wanted, rcond=1e-9)[0]
    return bool(np.linalg.norm(left) < ARM_POLICY.rounded * np.linalg.norm(wanted))


MOTOR_SIDE, LINK_SIDE = "joint_elasticity", "joint_elasticity_of_link"
SPRINGS = (MOTOR_SIDE, LINK_SIDE)
"""Names of the effects: the encoder of the motor was logged, or that of the link."""


class Spring(Protocol):
    """What a spring makes of the torques along one record."""

    def starts(self) -> list[dict[str, float]]:
        """Return values of the parameters from which a fit starts."""
        ...

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return by how much more torque (N, n) the joints need, for values of the parameters."""
        ...

    @property
    def hidden(self) -> int:
        """Number k of free swings that a record may begin in."""
        ...

    def swings(self, values: FloatArray) -> FloatArray:
        """Return the torques (N, n, k) of these swings, 1 at most, for values of the parameters."""
        ...


@dataclass(frozen=True, eq=False)
class Swinging:
    """Links that swing behind their motors along one record, together: each one's twist moves the others.

    Attributes
    ----------
    joints : tuple of int
        The s that give way, from 0.
    torque : array (N, s)
        That bodies need there along the motors' motion.
    mass, drag, pull : array (N, n, s)
        Gradients of all torques by the acceleration, the speed and the position of these joints.
    dt : float
        [s]
    """

    joints: tuple[int, ...]
    torque: FloatArray
    mass: FloatArray
    drag: FloatArray
    pull: FloatArray
    dt: float
    _made: dict[bytes, FloatArray] = field(default_factory=dict)

    def beside(self, other: Swinging) -> Swinging:
        """Return both as one."""

        def both(name: str) -> FloatArray:
            return np.concatenate([getattr(self, name), getattr(other, name)], axis=-1)

        joints = (*self.joints, *other.joints)
        return Swinging(joints, both("torque"), both("mass"), both("drag"), both("pull"), self.dt)

    def starts(self) -> list[dict[str, float]]:
        """Return compliances of one joint from the slowest resonance to the fastest that is tried, lightly damped."""
        inertia = max(float(np.median(self.mass[:, self.joints[0], 0])), 1e-12)
        last = min(ARM_POLICY.fastest_spring, ARM_POLICY.resolved / self.dt)
        found = []
        for frequency in np.geomspace(ARM_POLICY.slowest_spring, last, ARM_POLICY.springs):
            w = 2 * np.pi * frequency
            found.append({"compliance": 1 / (inertia * w**2), "lag": 2 * ARM_POLICY.damped / w})
        return found

    @property
    def hidden(self) -> int:
        """Number k of free swings that a record may begin in: a twist and its rate of every joint that gives way."""
        return 2 * len(self.joints)

    def twist(self, compliance: FloatArray, lag: FloatArray) -> FloatArray:
        """Return the twists (N, s, 1 + k) of springs: ``c M e'' + (lag + c C) e' + (1 + c G) e = c tau``.

        The first one begins at rest; the others are without tau, each with one of the first two twists of a joint at 1.

        Central differences; the weights of the neighbours in what is not differentiated give the discrete spring the
        frequency of the continuous one (1/12 where it is slow: Numerov's method), and keep it stable where it is fast:
        row by row, as an arm that folds has a fraction of the inertia that it has stretched out.
        """
        from scipy.linalg import solve_banded

        own, dt, s, rows = list(self.joints), self.dt, len(self.joints), len(self.torque)
        c = np.asarray(compliance)[:, None]
        inertia = c * self.mass[1:-1, own] / dt**2
        loss = (np.diag(lag) + c * self.drag[1:-1, own]) / (2 * dt)
        still, forced = np.eye(s) + c * self.pull[:, own], c[:, 0] * self.torque
        alone = np.einsum("taa->ta", inertia)
        weight = 1 / (4 * np.sin(np.minimum(1 / np.sqrt(np.maximum(alone, 1e-300)), 3.0) / 2) ** 2) - alone
        outer, middle = weight[:, :, None], 1 - 2 * weight[:, :, None]
        blocks = (
            inertia + loss + outer * still[2:],
            middle * still[1:-1] - 2 * inertia,
            inertia - loss + outer * still[:-2],
        )
        band = np.zeros((4 * s - 1, rows, s))
        band[s - 1, :2] = 1.0
        for back, block in enumerate(blocks):
            for at in range(s):
                for by in range(s):
                    band[s - 1 + back * s + at - by, 2 - back : rows - back, by] = block[:, at, by]
        first = np.linalg.solve(still[:2], forced[:2, :, None])[:, :, 0]
        later = weight * (forced[2:] + forced[:-2]) + (1 - 2 * weight) * forced[1:-1]
        wanted = np.zeros((rows * s, 1 + 2 * s))
        wanted[:, 0] = np.concatenate([first, later]).ravel()
        wanted[: 2 * s, 1:] = np.eye(2 * s)
        found = solve_banded((3 * s - 1, s - 1), band.reshape(len(band), -1), wanted, check_finite=False)
        return np.asarray(found.reshape(rows, s, -1))

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return by how much more torque (N, n) the joints need, for a compliance and a lag of each, at rest first."""
        return self._torques(values)[:, :, 0]

    def swings(self, values: FloatArray) -> FloatArray:
        """Return the torques (N, n, k) of the swings that a record may begin in, 1 at most."""
        begun = self._torques(values)[:, :, 1:]
        return np.asarray(begun / np.maximum(np.abs(begun).max(axis=(0, 1)), 1e-300))

    def _torques(self, values: FloatArray) -> FloatArray:
        key = values.tobytes()
        if key not in self._made:
            self._made.clear()
            e = self.twist(values[::2], values[1::2])
            parts = (self.mass, _second(e, self.dt)), (self.drag, np.gradient(e, self.dt, axis=0)), (self.pull, e)
            self._made[key] = -np.asarray(sum(np.einsum("tns,tsk->tnk", gradient, twist) for gradient, twist in parts))
        return self._made[key]


def swinging(arm: ArmModel, joint: int) -> Callable[[ArmRun], Swinging]:
    """Return what makes the record of a link behind a spring.

    The torque through the spring is what the bodies need along the measured motion: the measured torque holds the
    motor's friction and rotor, which no spring carries, and its noise, which is in the residual too, would always ask
    for a spring. Gradients half way to the link, once its twist is known, leave an error of third order in it.
    """
    bodies = arm.arm.parameters

    def made(run: ArmRun) -> Swinging:
        m, half, dt = run.calm, run.calm, run.motion.sample_time
        torque = arm.torques(m.q, m.v, m.a, parameters=bodies)[:, [joint]]
        if run.twist is not None:
            e = run.twist / 2
            half = replace(m, q=m.q - e, v=m.v - np.gradient(e, dt, axis=0), a=m.a - _second(e, dt))
        mass, drag, pull = (torque_gradient(arm, half, joint, of, bodies)[:, :, None] for of in (2, 1, 0))
        return Swinging((joint,), torque, mass, drag, pull, run.motion.sample_time)

    return made


@dataclass(frozen=True, eq=False)
class LeadingRotor:
    """A rotor that runs ahead of its link along one record.

    Attributes
    ----------
    bent : array (N, n)
        Second derivative of the torque that bodies need at the joint; 0 at the others.
    dt : float
        [s]
    """

    bent: FloatArray
    dt: float

    def starts(self) -> list[dict[str, float]]:
        """Return the rotor over the stiffness of the stiffest spring that is tried, lightly damped."""
        w = 2 * np.pi * ARM_POLICY.fastest_spring
        return [{"rotor_over_stiffness": w**-2.0, "lag": 2 * ARM_POLICY.damped / w}]

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return by how much more torque (N, n) the joints need, for J/k and a lag."""
        from scipy import signal

        half = 2 * float(values[1]) / self.dt  # trapezoidal rule
        behind = signal.lfilter([1.0, 1.0], [1 + half, 1 - half], self.bent, axis=0)
        return np.asarray(float(values[0]) * behind)

    @property
    def hidden(self) -> int:
        """None: the link that swings was measured."""
        return 0

    def swings(self, values: FloatArray) -> FloatArray:
        """Return no torque."""
        return np.zeros((*self.bent.shape, 0 * len(values)))


def ahead(arm: ArmModel, joint: int) -> Callable[[ArmRun], LeadingRotor]:
    """Return what makes the record of a rotor ahead of its link."""
    bodies = arm.arm.parameters

    def made(run: ArmRun) -> LeadingRotor:
        m, dt = run.calm, run.motion.sample_time
        bent = np.zeros_like(m.q)
        bent[:, joint] = _second(arm.torques(m.q, m.v, m.a, parameters=bodies)[:, joint], dt)
        return LeadingRotor(bent, dt)

    return made


def _second(values: FloatArray, dt: float) -> FloatArray:
    """Return the second derivative (N, ...), by central differences of fourth order."""
    bent = np.zeros_like(values)
    bent[1:-1] = np.diff(values, 2, axis=0)
    bent[2:-2] -= np.diff(bent[1:-1], 2, axis=0) / 12
    return bent / dt**2
