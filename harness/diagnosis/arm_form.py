"""One joint of an arm as a residual of its own: given the measured motion, inverse dynamics decouples the joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.diagnosis.arm_motion import CALM, ArmRun, moving_rows
from harness.diagnosis.descent import Bar
from harness.diagnosis.noise import fourth_difference
from harness.diagnosis.records.motion import Motion, motion_band
from harness.diagnosis.runs.equation import Equations, Form, expressible
from harness.diagnosis.runs.equation_form import EquationForm
from harness.effects.compose import compose
from harness.effects.effect import Effect, Placed
from harness.errors import FitError
from harness.physics.arm import ArmModel
from harness.signals import Channel, FloatArray

__all__ = ["JOINT_EFFECTS", "JointForm", "joint_dictionary", "joint_system"]

JOINT_EFFECTS = (
    "viscous_friction",
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "position_dependent_friction",
    "force_bias",
    "input_gain",
    "cogging",
    "linear_spring",
)
"""What a joint of an arm may have that a rigid body has not."""

ON_TORQUE = ("input_gain", "load_dependent_friction")


@dataclass(frozen=True, eq=False)
class _JointEquations(Equations):
    """The equations of one joint; rows in which it stands still are 0."""

    def residual(
        self, motion: Motion, p: FloatArray, form: Form = "strong", columns: Sequence[int] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return residual and derivative; see :meth:`Equations.residual`."""
        r, j = super().residual(motion, p, form, columns)
        moving = moving_rows(motion)
        return r * moving, j * moving[:, :, None]


class JointForm(EquationForm):
    """Torque residual of one joint: what the rigid bodies need there, plus effects, minus the measured torque.

    Parameters
    ----------
    arm : ArmModel
    joint : int
        Which one, from 0.
    runs : mapping
        Records by use.
    known : mapping
        By use, for each record the torque (N,) that is needed at this joint by all that is known: the rigid bodies,
        what the URDF states, effects on the whole arm.
    free : mapping, optional
        By use, for each record columns (N, c) with free coefficients: inertial parameters that are calibrated.

    Notes
    -----
    The nominal joint has one parameter of its own: ``clock``, by how long its torque is recorded too late.
    """

    def __init__(
        self,
        arm: ArmModel,
        joint: int,
        runs: Mapping[str, Sequence[ArmRun]],
        known: Mapping[str, Sequence[FloatArray]],
        free: Mapping[str, Sequence[FloatArray]] | None = None,
    ) -> None:
        self.joint = joint
        count = 0 if free is None else free["estimation"][0].shape[1]
        self.nominal = joint_system(arm, joint, count)
        self.shape = "strong"
        self.motions = {}
        pick = slice(joint, joint + 1)
        for use, parts in runs.items():
            made = []
            for number, run in enumerate(parts):
                m = run.motion
                # effects see the calm torque: a factor on the measured one would lower the residual by its noise
                torque = run.calm.u[:, pick]
                columns = [torque, known[use][number][:, None] + torque - m.u[:, pick], -run.first[:, pick]]
                if free is not None:
                    columns.append(free[use][number])
                own = np.concatenate(columns, axis=1)
                made.append(_thinned(replace(m, q=m.q[:, pick], v=m.v[:, pick], a=m.a[:, pick], u=own)))
            self.motions[use] = tuple(made)
        first = self.motions["estimation"][0]
        self.sample_time = first.sample_time
        self.sizes = _sizes(self.nominal, first)
        one = self.nominal.coordinates[0]
        self.columns = ((one.name, one.force_unit),)
        self.weights = np.ones(1)
        self.floors = (None,)
        self._equations = {}

    def judges(self, placed: Placed) -> bool:
        """Return True for forces without a state, and for the torque gain: inertia is known on an absolute scale."""
        return expressible(placed) or placed.effect.name == "input_gain"

    def solve(
        self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], *, seed: int, bar: Bar | None = None
    ) -> dict[str, Any]:
        """Fit; see :class:`harness.diagnosis.runs.fitted.Form`.

        Raises
        ------
        FitError
            If the residual of a trial is not finite.
        """
        try:
            return super().solve(effects, starts, seed=seed, bar=bar)
        except ValueError as error:
            raise FitError(
                "joint residual", expected="finite numbers", got=str(error), remedy="another start, or another effect"
            ) from error

    def equations(self, effects: Sequence[Placed]) -> Equations:
        """Return the equation form with effects, made once; inputs beyond the torque are known columns."""
        key = tuple(str(one) for one in effects)
        if key not in self._equations:
            system = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
            self._equations[key] = _joint_equations(system, self.nominal.np)
        return self._equations[key]


def _thinned(motion: Motion) -> Motion:
    """Return a motion with an odd number of samples in each, four in one decimated sample: torques are means."""
    step = max((motion.factor // 4 - 1) | 1, 1) if motion.factor >= 8 else 1
    if step == 1:
        return motion
    rows = motion.q.shape[0] // step
    pick = slice(step // 2, (rows - 1) * step + step // 2 + 1, step)
    edge = -(-motion.inside.start // step)
    return Motion(
        motion.t[pick],
        motion.q[pick],
        motion.v[pick],
        motion.a[pick],
        motion.u[: rows * step].reshape(rows, step, -1).mean(axis=1),
        slice(edge, rows - edge),
        motion.factor // step,
        motion.sample_time * step,
    )


def joint_system(arm: ArmModel, joint: int, free: int = 0) -> Any:
    """Return one joint as a system: its torque, its clock, and factors of ``free`` known columns."""
    import casadi as ca

    from harness.physics.parameters import Parameter
    from harness.physics.system import Coordinate, System

    drive, position = arm.inputs[joint], arm.positions[joint]
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 1 + free)
    inertia = (Parameter(f"inertia{k + 1}", "1", 0.0) for k in range(free))
    return System(
        name=f"joint {joint + 1} of {arm.name}",
        inputs=(drive,),
        outputs=(position,),
        states=(position, Channel(f"{position.name}_rate", f"{position.unit}/s")),
        parameters=(Parameter("clock", "s", 0.0), *inertia),
        x=x,
        u=u,
        p=p,
        t=ca.SX.sym("t"),
        gravity=ca.SX.sym("gravity", 2),
        mass_matrix=ca.SX(1, 1),
        generalized_forces=ca.vertcat(u),
        rates=ca.SX(0, 1),
        h=x[0],
        coordinates=(Coordinate(position.name, position.unit, drive.unit, 0, 1, 0),),
    )


def joint_dictionary(
    arm: ArmModel, joint: int, form: JointForm, run: ArmRun, dictionary: Sequence[Effect] | None = None
) -> tuple[list[Placed], list[str]]:
    """Return the effects at a joint that can be judged, and the names of those that drown in the noise of the torque.

    Where the URDF states a damping, viscous friction may also be too large in the model: then its sign is free.
    An effect that acts on the torque itself (its gain, friction in proportion to it) needs a torque 20 times above its
    noise: otherwise the noise, which is in the residual too, takes part in the fit.
    """
    from harness.effects import builtin, place_all

    effects = [builtin()[name] for name in JOINT_EFFECTS] if dictionary is None else list(dictionary)
    if arm.damping[joint] > 0:
        effects = [_either_sign(one) if one.name == "viscous_friction" else one for one in effects]
    torque = run.calm.u[:, joint]
    dt = run.motion.sample_time
    corner = CALM * motion_band(run.motion.q[:, joint], dt)[0]
    noise = fourth_difference(run.motion.u[:, joint]) * float(np.sqrt(min(4 * corner * dt, 1.0)))
    placed = [one for one in place_all(form.nominal, effects) if form.judges(one)]
    drowned = [one for one in placed if one.effect.name in ON_TORQUE and noise > 0.05 * float(np.std(torque))]
    return [one for one in placed if one not in drowned], [str(one) for one in drowned]


def _either_sign(effect: Effect) -> Effect:
    """Return an effect whose main parameter may have both signs."""
    return replace(effect, parameters=tuple(replace(one, sign="any") for one in effect.parameters))


def _joint_equations(system: Any, free: int) -> Equations:
    """Return torque needed minus torque given, with its derivatives."""
    import casadi as ca

    q, v, a, t = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("a"), ca.SX.sym("t")
    u, p = ca.SX.sym("u", 2 + free), system.p
    swap_from = ca.vertcat(system.x, system.u, system.gravity, system.t)
    swap_to = ca.vertcat(q, v, u[0], ca.DM([0.0, -1.0]), t)
    matrix, force, drive = (
        ca.substitute(ca.SX(one), swap_from, swap_to)
        for one in (system.mass_matrix, system.generalized_forces, system.input_forces)
    )
    left_over = matrix @ a - force + u[1] + ca.dot(p[:free], u[2:])
    jacobian = ca.jacobian(left_over, p)
    strong = ca.Function("strong", [q, v, a, u, p, t], [left_over, jacobian])
    none = ca.SX.zeros(1, p.numel())
    weak = ca.Function("weak", [q, v, u, p, t], [ca.SX(0), force, none, none])
    return _JointEquations(system, strong, weak, ca.Function("drive", [q, v, u, p, t], [drive]))


def _sizes(system: Any, motion: Motion) -> dict[str, dict[str, float]]:
    """Return the rms sizes at the ports of a joint, for start values of effects.

    The force is what is unsteady of the torque: a constant weight says nothing about friction.
    """

    def rms(x: FloatArray) -> float:
        return float(np.sqrt(np.mean(x**2)))

    dt, rows = motion.sample_time, motion.q.shape[0]
    torque = motion.u[:, 0]
    common = {"dt": dt, "T": rows * dt}
    sizes = {
        **common,
        "F": float(np.std(torque)),
        "u": rms(torque),
        "q": rms(motion.q[:, 0]),
        "v": rms(motion.v[:, 0]),
        "a": rms(motion.a[:, 0]),
        "y": rms(motion.q[:, 0]),
    }
    return {system.inputs[0].name: sizes, system.outputs[0].name: sizes, "base": dict(common)}
