"""A designed experiment as a scenario: the arm tracks the reference that conditions its inertial parameters best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, PlantSpec
from scenarios.arm_models import arm_of, damping_of
from scenarios.closed_loop import ArmComputedTorque, InverseDynamics
from scenarios.design import (
    Criterion,
    Design,
    JointLimits,
    Regressor,
    design_reference,
    identifiable_columns,
    volume_of,
)

if TYPE_CHECKING:
    from harness.physics.arms.rigid_tree import Arm


@dataclass(frozen=True, kw_only=True)
class ArmDesigned(ArmComputedTorque):
    """Arm that follows, under computed torque, a periodic reference designed for its identification.

    The condition number of the inertial regressor over the columns that can be identified, each of unit length, is
    lowered within the limits of position, rate, torque and height. It starts at the reference's first posture, where
    the plant has states of the positions' names. Amplitude, band and lines do not count; other options:
    ``ArmComputedTorque``.

    Parameters
    ----------
    period : float
        Of the reference [s].
    harmonics : int
        Of each joint.
    rate : float
        Limit of the joints' rates [rad/s], where the URDF has no lower one.
    margin : float
        Part of the URDF's ranges of position and torque that is used.
    lowest : float, optional
        Height over the base [m] that no joint may go below (a table).
    parameters : sequence of str
        Parameters to be known best, in place of the condition number: one, or a pair that is to be told apart, such as
        ``("damping1", "friction1")``. Of the body that joint k moves ``mk``, ``hxk`` to ``hzk`` and ``Ixxk`` to
        ``Izzk``, of the joint ``dampingk`` and ``frictionk``. The volume of their confidence ellipsoid is lowered, all
        others unknown.
    starts, steps : int
        Random references to choose from, and steps of the search.
    """

    period: float = 10.0
    harmonics: int = 5
    rate: float = 1.5
    margin: float = 0.95
    lowest: float | None = None
    parameters: Sequence[str] = ()
    starts: int = 20
    steps: int = 2000

    def design(self, spec: PlantSpec, *, rng: np.random.Generator) -> Design:
        """Return the designed reference and its condition number."""
        from harness.physics.arms.kinematics import joint_places

        arm = arm_of(self.urdf, spec)
        low, high = (np.array([getattr(joint, end) for joint in arm.moving]) for end in ("lower", "upper"))
        bounded = np.isfinite(high - low)
        low, high = np.where(bounded, low, -np.pi), np.where(bounded, high, np.pi)
        half = 0.5 * (1 - self.margin) * (high - low)
        limits = JointLimits(
            low + half, high - half, np.minimum([joint.velocity or np.inf for joint in arm.moving], self.rate)
        )
        # declared by the plant where it says so, else by the URDF; 0 in a URDF states none
        declared = np.array([min(channel.maximum, -channel.minimum) for channel in spec.inputs])
        stated = np.array([joint.effort if joint.effort > 0 else np.inf for joint in arm.moving])
        effort = self.margin * np.minimum(declared, stated)

        def violation(q: FloatArray, v: FloatArray, a: FloatArray) -> float:
            torque = (arm.regressor(q, v, a) @ arm.parameters).reshape(len(q), -1)
            worst = float(np.max(np.abs(torque) / effort - 1.0))
            if self.lowest is not None:
                worst = max(worst, float(self.lowest - joint_places(arm, q)[0][:, 1:, 2].min()))
            return max(worst, 0.0)

        regressor, criterion = self._wanted(arm, limits, rng) if self.parameters else (arm.regressor, None)
        return design_reference(
            regressor,
            limits,
            period=self.period,
            harmonics=self.harmonics,
            starts=self.starts,
            steps=self.steps,
            violation=violation,
            criterion=criterion,
            rng=rng,
        )

    def _wanted(self, arm: Arm, limits: JointLimits, rng: np.random.Generator) -> tuple[Regressor, Criterion]:
        """Return the regressor with friction, and the criterion of the parameters that are to be known best.

        Raises InputError if a parameter is unknown, or no motion tells it from the others.
        """
        from harness.physics.arms.inertia import TEN

        joints = range(1, arm.n + 1)
        names = [f"{name}{k}" for k in joints for name in TEN]
        names += [f"{kind}{k}" for kind in ("damping", "friction") for k in joints]
        wrong = sorted(set(self.parameters) - set(names))
        if wrong:
            raise InputError(
                "option parameters",
                expected=f"names such as m{arm.n}, hx{arm.n}, Izz{arm.n}, damping1, friction1",
                got=", ".join(wrong),
                remedy="correct them",
            )

        def regressor(q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
            own = np.eye(arm.n)[None]
            friction = np.concatenate([own * v[:, :, None], own * np.sign(v)[:, :, None]], axis=2)
            return np.hstack([arm.regressor(q, v, a), friction.reshape(-1, 2 * arm.n)])

        chosen = [names.index(name) for name in self.parameters]
        q, v, a = (rng.uniform(-1, 1, size=(200, arm.n)) for _ in range(3))
        W = regressor(limits.low + (limits.high - limits.low) * (q + 1) / 2, limits.rate * v, limits.rate * a)
        others = np.delete(np.arange(W.shape[1]), chosen)
        kept = [*chosen, *others[identifiable_columns(W[:, others])]]
        places = range(len(chosen))
        if not np.isfinite(volume_of(W[:, kept], places)):
            raise InputError(
                "option parameters",
                expected="parameters that a motion can tell from all others",
                got=", ".join(self.parameters),
                remedy="choose others; a base parameter stands for those that only act together",
            )
        return regressor, lambda W: volume_of(W[:, kept], places)

    def model(self, spec: PlantSpec) -> InverseDynamics:
        """Return the inverse dynamics of the controller, with the damping that the URDF states: wrists are light."""
        rigid = super().model(spec)
        if self.inverse_dynamics is not None:
            return rigid
        damping = damping_of(self.urdf, spec)
        return lambda q, v, a: rigid(q, v, a) + damping * v

    def _planned(
        self, n: int, spec: PlantSpec, positions: list[int], *, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return position, rate and acceleration about the first posture, (3, n, joints), and that posture."""
        if self.period <= 0 or self.harmonics < 1 or not 0 < self.margin <= 1 or self.rate <= 0 or self.fade <= 0:
            raise InputError(
                "designed reference",
                expected="period, harmonics, rate and fade above 0, margin in (0, 1]",
                got=f"period {self.period}, harmonics {self.harmonics}, rate {self.rate}, margin {self.margin}",
                remedy="correct the options",
            )
        reference = self.design(spec, rng=rng).reference
        t: FloatArray = np.arange(n, dtype=np.float64) * spec.sample_time
        moves = np.stack(reference.at(t))
        first = moves[0, 0].copy()
        moves[0] -= first
        return self.faded(t, moves), first
