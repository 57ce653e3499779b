"""A designed experiment as a scenario: the arm tracks the reference that conditions its inertial parameters best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray, PlantSpec
from scenarios.arm_models import arm_of, damping_of
from scenarios.closed_loop import ArmComputedTorque, InverseDynamics
from scenarios.design import Design, JointLimits, design_reference

__all__ = ["ArmDesigned"]


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
    starts, steps : int
        Random references to choose from, and steps of the search.
    """

    period: float = 10.0
    harmonics: int = 5
    rate: float = 1.5
    margin: float = 0.95
    lowest: float | None = None
    starts: int = 20
    steps: int = 2000

    def design(self, spec: PlantSpec, *, rng: np.random.Generator) -> Design:
        """Return the designed reference and its condition number."""
        from harness.physics.arm_kinematics import joint_places

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

        return design_reference(
            arm.regressor,
            limits,
            period=self.period,
            harmonics=self.harmonics,
            starts=self.starts,
            steps=self.steps,
            violation=violation,
            rng=rng,
        )

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
