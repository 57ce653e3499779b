"""An arm with identified parameters as a model that predicts: forward dynamics of rigid bodies and joint friction."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from harness.algebra import runge_kutta
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.described import Described

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel
    from harness.scoring import TorqueError

STEPS = 2  # Runge-Kutta steps in a sample.
START = 12  # Samples at the start of a record whose cubic gives the rates there, where none are measured.


@dataclass(frozen=True, eq=False)
class ArmDynamics(Described):
    """``M(q) a = tau - bias(q, v) - damping v - friction sgn(v)``, with reflected inertia on the diagonal of M.

    The state is joint positions, then rates.

    Parameters
    ----------
    spec : PlantSpec
        Torques in, every joint position out, rates if they are measured.
    model : str
        ``iiwa`` or a URDF file: joints and geometry.
    inertial : array (10 * bodies,)
    damping, friction, motor_inertia : array (n,)
    notes : dict
    """

    spec: PlantSpec
    model: str
    inertial: FloatArray
    damping: FloatArray
    friction: FloatArray
    motor_inertia: FloatArray
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "arm"
    burn_in: ClassVar[int] = 0  # No samples: the initial state is read off the record.

    @cached_property
    def arm(self) -> ArmModel:
        """Joints and geometry."""
        from harness.physics.arms.arm import load_arm

        return load_arm(self.model)

    @cached_property
    def columns(self) -> tuple[list[int], list[int | None]]:
        """Which output is the position of each joint, and which its rate."""
        names = [channel.name for channel in self.spec.outputs]
        positions = [names.index(position.name) for position in self.arm.positions]
        rates = [
            next(
                (names.index(f"{position.name}{s}") for s in ("_rate", "_dot") if f"{position.name}{s}" in names), None
            )
            for position in self.arm.positions
        ]
        return positions, rates

    def torques(self, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the torques (N, n) that go with a motion (N, n), friction included."""
        from harness.physics.arms.arm import REST

        rigid = self.arm.torques(q, v, a, parameters=self.inertial)
        return np.asarray(rigid + self.damping * v + self.friction * np.tanh(v / REST) + self.motor_inertia * a)

    def torque_errors(self, record: Trajectory) -> tuple[TorqueError, ...]:
        """Return the errors of the torques along the measured motion of a record, joint by joint, filtered as the fit.

        Raises
        ------
        InputError
            If the record has other channels.
        """
        from identifiers.mechanics.arms.torque_errors import torque_errors

        same_language(self.spec, record)
        return torque_errors(self.arm, self.torques, record, self.notes.get("torques_seen", {}))

    def to_urdf(self) -> str:
        """Return the URDF with these bodies, damping, friction and rotors."""
        from harness.physics.arms.urdf_write import urdf_with

        return urdf_with(
            self.arm, self.inertial, damping=self.damping, friction=self.friction, motor_inertia=self.motor_inertia
        )

    def to_mjcf(self) -> str:
        """Return the MJCF with these bodies, damping, friction and rotors."""
        from harness.physics.arms.mjcf_write import mjcf_with

        return mjcf_with(
            self.arm, self.inertial, damping=self.damping, friction=self.friction, motor_inertia=self.motor_inertia
        )

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (2 n,) at the start, rates from a cubic through the first samples where none is measured."""
        same_language(self.spec, data)
        positions, rates = self.columns
        count = min(START, len(data))
        t = data.t[:count] - data.t[0]
        powers = np.vander(t, min(4, count), increasing=True)
        q, v = [], []
        for position, rate in zip(positions, rates, strict=True):
            period = self.spec.outputs[position].period
            signal = data.y[:count, position]
            fit = np.linalg.lstsq(powers, signal if period is None else np.unwrap(signal, period=period), rcond=None)[0]
            q.append(fit[0])
            second = np.linalg.lstsq(powers, data.y[:count, rate], rcond=None)[0][0] if rate is not None else None
            v.append(second if second is not None else (fit[1] if count > 1 else 0.0))
        return np.array([*q, *v], dtype=float)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""
        positions, rates = self.columns
        n = len(positions)
        y = np.empty((*np.shape(x)[:-1], self.spec.ny))
        for joint, (position, rate) in enumerate(zip(positions, rates, strict=True)):
            y[..., position] = np.asarray(x)[..., joint]
            if rate is not None:
                y[..., rate] = np.asarray(x)[..., n + joint]
        return y

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., 2 n)."""
        x = np.asarray(x, dtype=float)
        flat = x.reshape(-1, x.shape[-1])
        held = np.broadcast_to(u, (*x.shape[:-1], self.spec.nu)).reshape(-1, self.spec.nu)
        found: FloatArray = self._step.map(len(flat))(flat.T, held.T).full().T
        return found.reshape(x.shape)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state after an output was seen: positions move half way, measured rates too."""
        x = np.asarray(x, dtype=float)
        miss = residual(self.spec.outputs, np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), self.output(x, u))
        positions, rates = self.columns
        new, n = x.copy(), len(positions)
        for joint, (position, rate) in enumerate(zip(positions, rates, strict=True)):
            new[..., joint] += 0.5 * miss[..., position]
            # the gain of an alpha-beta filter where the rate is not measured
            gain = 0.15 / self.spec.sample_time * miss[..., position] if rate is None else 0.5 * miss[..., rate]
            new[..., n + joint] += gain
        return new

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}

    @cached_property
    def _step(self) -> Any:
        """Return one sample of RK4 as a CasADi function of (x, u)."""
        import casadi as ca

        from harness.physics.arms.arm import GRAVITY, REST
        from harness.physics.definition.linear_solve import solve_symmetric

        n, dt = self.arm.n, self.spec.sample_time
        arguments, torques = self.arm.arm.symbolic_torques(ca.SX(self.inertial))
        q, v, a, gravity = arguments
        u = ca.SX.sym("u", n)
        mass = ca.jacobian(torques, a) + ca.diag(ca.SX(self.motor_inertia))
        still = ca.substitute(ca.substitute(torques, a, ca.SX.zeros(n)), gravity, ca.DM(GRAVITY))
        drag = ca.SX(self.damping) * v + ca.SX(self.friction) * ca.tanh(v / REST)
        force = u - still - drag
        rates = ca.vertcat(v, solve_symmetric(mass, force))
        derivative = ca.Function("derivative", [ca.vertcat(q, v), u], [rates], {"cse": True})
        x, held, h = ca.MX.sym("x", 2 * n), ca.MX.sym("u", n), dt / STEPS
        now = x
        for _ in range(STEPS):
            now = runge_kutta(lambda state: derivative(state, held), now, h)
        return ca.Function("step", [x, held], [now])
