"""One joint of an arm as a regression of its own: given the measured motion, inverse dynamics decouples the joints."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.arm.motion import ArmRun, low_passed, moving_rows
from harness.diagnosis.arm.regression import TorqueChange
from harness.diagnosis.arm.rotor import ON_LOAD, friction_of_the_load, rotor_inertia
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import ARM_POLICY, POLICY
from harness.diagnosis.records.motion import SmoothedMotion, motion_band
from harness.diagnosis.runs.equation import decimated, expressible
from harness.diagnosis.search.fit import WAVE
from harness.effects.compose import compose
from harness.effects.effect import Effect, Placed
from harness.physics.arms.arm import ArmModel
from harness.physics.compiled.system import System
from harness.signals import Channel, FloatArray

JOINT_EFFECTS = (
    "viscous_friction",
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "sublinear_friction",
    "yield_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "position_dependent_friction",
    "force_bias",
    "input_gain",
    "cogging",
    "linear_spring",
)
"""What a joint of an arm may have that a rigid body has not, and other coordinates too; its rotor comes in addition."""

WAVES, SLOWEST = 24, 2.5
"""Wave numbers of a cogging that are tried, and the lowest [1/rad]: slower ones are gravity."""
CLOCK = "clock"


@dataclass(frozen=True, eq=False)
class JointEquation:
    """The equation of torques of a joint with some effects; see :class:`harness.diagnosis.arm.regression.Equation`.

    The measured torque is filtered as the motion is, so what jumps is, too: a friction that jumps where the joint turns
    would be left over there as if it were another law. ``rows`` gives at every sample what is smooth, what jumps, and
    the derivatives of both.
    """

    system: System
    motions: Mapping[str, Sequence[SmoothedMotion]]
    rows: Callable[..., list[FloatArray]]
    hidden: int = 0

    def residual(self, p: FloatArray, use: str) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every record the residual torque (rows, 1) and its derivatives (rows, 1, np)."""
        found = []
        for motion in self.motions[use]:
            given = (motion.q, motion.v, motion.a, motion.u, np.asarray(p, dtype=float), motion.t[:, None])
            smooth, jumps, *slopes = (part.reshape(len(motion.q), -1) for part in self.rows(*given))
            moved = np.concatenate([jumps, slopes[1]], axis=1)
            if moved.any():
                moved = low_passed(moved, motion.cutoff, motion.sample_time)
            slim = decimated(np.concatenate([smooth, slopes[0]], axis=1) + moved, motion)
            found.append((slim[:, :1], slim[:, None, 1:]))
        return found


class JointRegression:
    """Residual torque of one joint: what the rigid bodies need there, plus effects, minus the measured torque.

    See :class:`harness.diagnosis.arm.regression.TorqueRegression`.

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
    The nominal joint has one parameter of its own: ``clock``, by how long its torque is recorded too late;
    ``latest`` [s] is how far its first-order column can say that, beyond it is a column that explains something else.
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
        first = runs["estimation"][0].motion
        band = motion_band(first.q[:, joint], first.sample_time)[0]
        self.latest = max(ARM_POLICY.rows_late * first.sample_time, ARM_POLICY.late / (2 * np.pi * band))
        self.nominal = joint_system(arm, joint, count)
        self.own = frozenset(name for name in self.nominal.parameter_names if name != CLOCK)
        self.motions: dict[str, tuple[SmoothedMotion, ...]] = {}
        pick = slice(joint, joint + 1)
        for use, parts in runs.items():
            made = []
            for number, run in enumerate(parts):
                m = run.motion
                # what depends on the torque sees what the bodies need, as calm: the noise of the measured one is in the
                # residual too, and its size is that of friction where friction is most of it
                needed = known[use][number][:, None]
                columns = [run.calm.u[:, pick], m.u[:, pick], needed, run.calmed(needed), -run.first[:, pick]]
                if free is not None:
                    columns.append(free[use][number])
                own = np.concatenate(columns, axis=1)
                # and the calm acceleration, whose noise is in what the bodies need as well
                assert m.counts is not None
                counts = m.counts[:, pick]
                made.append(replace(m, q=m.q[:, pick], v=m.v[:, pick], a=run.calm.a[:, pick], u=own, counts=counts))
            self.motions[use] = tuple(made)
        self.counts = {use: [moving_rows(motion) for motion in parts] for use, parts in self.motions.items()}
        self.sizes = _sizes(self.nominal, self.motions["estimation"][0])
        self.size = np.sqrt(np.mean(np.concatenate(self.torque("estimation")) ** 2, keepdims=True))
        self._equations: dict[tuple[str, ...], JointEquation] = {}

    def equation(self, effects: Sequence[Placed]) -> JointEquation:
        """Return the equation with effects, made once; inputs beyond the torque are known columns."""
        key = tuple(str(placed) for placed in effects)
        if key not in self._equations:
            system = compose(self.nominal, list(effects), sizes=self.sizes) if effects else self.nominal
            self._equations[key] = JointEquation(system, self.motions, _residual_rows(system, self.nominal.np))
        return self._equations[key]

    def changes(self, values: Mapping[str, float], candidates: Sequence[Placed]) -> list[TorqueChange]:
        """Return what each candidate would change, at several choices of the parameters in which it is not linear."""
        changes = []
        for placed in candidates:
            equation = self.equation((placed,))
            linear = tuple(
                parameter.name for parameter in placed.effect.parameters if parameter.linear and not parameter.fixed
            )
            phase = placed.effect.parameter_of("phase")
            for given in self.choices(placed):
                turns = [given]
                if phase is not None:  # sin(a + phi) = cos(phi) sin(a) + sin(phi) cos(a)
                    turns = [{**given, phase.name: angle} for angle in (0.0, 0.5 * np.pi)]
                parts = [self._columns(equation, values, placed, linear, turn) for turn in turns]
                torque = {
                    use: [np.concatenate([part[use][k] for part in parts], axis=2) for k in range(len(parts[0][use]))]
                    for use in parts[0]
                }
                names = (linear or ("effect",)) if phase is None else WAVE
                known = {name: value for name, value in given.items() if phase is None or name != phase.name}
                if all(np.isfinite(part).all() for use in torque.values() for part in use):
                    changes.append(TorqueChange(placed, known, names, torque, "linear" if phase is None else "wave"))
        return changes

    def choices(self, placed: Placed) -> list[dict[str, float]]:
        """Return choices of the parameters in which an effect is not linear."""
        at = self.sizes.get(placed.at, {})
        free = [parameter for parameter in placed.effect.parameters if not (parameter.linear or parameter.fixed)]
        grids: list[Sequence[float]] = []
        wave_number = placed.effect.parameter_of("wave number")
        for parameter in free:
            if wave_number is not None:
                grids.append(self._waves(parameter.minimum, parameter.maximum) if parameter is wave_number else (0.0,))
            else:
                grids.append(parameter.starts(at))
        most = EFFORT.choices if wave_number is None else WAVES
        names = [parameter.name for parameter in free]
        return [dict(zip(names, choice, strict=True)) for choice in itertools.islice(itertools.product(*grids), most)]

    def _waves(self, minimum: float, maximum: float) -> tuple[float, ...]:
        """Return wave numbers of a torque that repeats along the joint, close enough that none is missed."""
        q = np.concatenate([motion.q[:, 0] for motion in self.motions["estimation"]])
        low, high = np.quantile(q, [0.02, 0.98])
        step, least = np.pi / max(float(high - low), 1e-9), max(minimum, SLOWEST)
        return tuple(float(wave) for wave in np.arange(least, min(maximum, least + WAVES * step), step))

    def _columns(
        self, equation: JointEquation, values: Mapping[str, float], placed: Placed, linear: Sequence[str],
        given: Mapping[str, float],
    ) -> dict[str, list[FloatArray]]:  # fmt: skip
        """Return the derivatives (rows, 1, k) by the linear parameters, the effect being neutral, by use and record."""
        system = equation.system
        neutral = {name: placed.effect.parameter(name).neutral or 0.0 for name in linear}
        own = {placed.name(key): value for key, value in {**given, **neutral}.items()}
        known = {name: values[name] for name in self.nominal.parameter_names}
        p = np.array([{**system.values(), **known, **own}[name] for name in system.parameter_names])
        uses = ("estimation", "validation")
        if not linear:  # the whole effect counts this many times
            force = {use: self.force(dict(zip(system.parameter_names, p, strict=True)), (placed,), use) for use in uses}
            return {use: [-part[:, :, None] for part in parts] for use, parts in force.items()}
        index = [system.parameter_names.index(placed.name(name)) for name in linear]
        return {use: [j[:, :, index] for _, j in equation.residual(p, use)] for use in uses}

    def free_torques(self) -> list[TorqueChange]:
        """Return piecewise linear torques over position, speed and torque, and over position with each other."""
        name = self.nominal.coordinates[0].name
        axes = {
            name: {use: [motion.q[:, 0] for motion in parts] for use, parts in self.motions.items()},
            f"{name}_rate": {use: [motion.v[:, 0] for motion in parts] for use, parts in self.motions.items()},
            self.nominal.inputs[0].name: {
                use: [motion.u[:, 3] for motion in parts] for use, parts in self.motions.items()
            },
        }
        first, *others = axes
        changes = []
        for group in [*((axis,) for axis in axes), *((first, other) for other in others)]:
            counts = (EFFORT.knots,) if len(group) == 1 else EFFORT.joint_knots
            knots = [
                np.unique(np.quantile(np.concatenate(axes[axis]["estimation"]), np.linspace(0.01, 0.99, count)))
                for axis, count in zip(group, counts, strict=True)
            ]
            if any(len(at) < 3 for at in knots):
                continue
            torque: dict[str, list[FloatArray]] = {}
            for use, motions in self.motions.items():
                torque[use] = []
                for number, motion in enumerate(motions):
                    hats = [
                        np.stack([np.interp(axes[axis][use][number], at, row) for row in np.eye(len(at))], axis=1)
                        for axis, at in zip(group, knots, strict=True)
                    ]
                    both = np.einsum("ni,nj->nij", hats[0], hats[-1]).reshape(len(hats[0]), -1)
                    free = low_passed(hats[0] if len(hats) == 1 else both, motion.cutoff, motion.sample_time)
                    torque[use].append(-decimated(free, motion)[:, None, :])
            grid = itertools.product(*knots)
            labels = [", ".join(f"{n} {v:.3g}" for n, v in zip(group, at, strict=True)) for at in grid]
            changes.append(TorqueChange(None, {}, (f"{name} over {' and '.join(group)}", *labels), torque))
        return changes

    def torque(self, use: str) -> list[FloatArray]:
        """Return the calm torque (rows,) of every record, decimated as the residual is."""
        return [decimated(motion.u[:, :1], replace(motion, counts=None))[:, 0] for motion in self.motions[use]]

    def force(self, values: Mapping[str, float], effects: Sequence[Placed], use: str) -> list[FloatArray]:
        """Return the torque (rows, 1) that effects exert, decimated as the residual is, for every record."""
        both = []
        for equation in (self.equation(()), self.equation(tuple(effects))):
            p = np.array([values[name] for name in equation.system.parameter_names])
            both.append([r for r, _ in equation.residual(p, use)])
        return [without - full for without, full in zip(*both, strict=True)]


def joint_system(arm: ArmModel, joint: int, free: int = 0) -> System:
    """Return one joint as a system: its torque, its clock, and factors of ``free`` known columns."""
    import casadi as ca

    from harness.physics.compiled.system import Coordinate, System
    from harness.physics.definition.parameters import Parameter

    drive, position = arm.inputs[joint], arm.positions[joint]
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 1 + free)
    inertia = (Parameter(f"inertia{k + 1}", "1", 0.0) for k in range(free))
    return System(
        name=f"joint {joint + 1} of {arm.name}",
        inputs=(drive,),
        outputs=(position,),
        states=(position, Channel(f"{position.name}_rate", f"{position.unit}/s")),
        parameters=(Parameter(CLOCK, "s", 0.0), *inertia),
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
    arm: ArmModel, joint: int, regression: JointRegression, dictionary: Sequence[Effect] | None = None
) -> list[Placed]:
    """Return the effects at a joint that can be judged.

    Where the URDF states a damping, viscous friction may also be too large in the model: then its sign is free.
    """
    from harness.effects import builtin, place_all

    usual = [*(builtin()[name] for name in JOINT_EFFECTS), rotor_inertia]
    effects = usual if dictionary is None else list(dictionary)
    told = not _inertia_alone(regression)
    effects = [_of_this_unit(effect, told) for effect in effects]
    if arm.damping[joint] > 0:
        effects = [_either_sign(effect) if effect.name == "viscous_friction" else effect for effect in effects]
    # where inertia is known on an absolute scale, a factor on the torque shows; beside free inertia it is that inertia
    return [
        candidate
        for candidate in place_all(regression.nominal, effects)
        if expressible(candidate) or (candidate.effect.name == "input_gain" and not regression.own)
    ]


def _either_sign(effect: Effect) -> Effect:
    """Return an effect whose main parameter may have both signs."""
    return replace(effect, parameters=tuple(replace(parameter, sign="any") for parameter in effect.parameters))


def _inertia_alone(regression: JointRegression) -> bool:
    """Return whether all but a little of what the bodies need at a joint goes with its own acceleration."""
    motion = regression.motions["estimation"][0]
    a, load = motion.a[motion.inside, 0], motion.u[motion.inside, 3]
    left = load - a * (a @ load) / max(float(a @ a), 1e-300)
    return bool(np.linalg.norm(left) < POLICY.clear * np.linalg.norm(load))


def _of_this_unit(effect: Effect, told: bool) -> Effect:
    """Return a factor on the torque within what a torque constant may be off: beyond, it is another unit or gear.

    So is a friction in proportion to the torque that lets pass less; ``told`` says whether its side is asked for.
    """
    low, high = 1 / ARM_POLICY.gain, ARM_POLICY.gain
    if effect.name == ON_LOAD:
        return friction_of_the_load(effect, 1 - low, told=told)
    if effect.name != "input_gain":
        return effect
    (gain,) = effect.parameters
    return replace(effect, parameters=(replace(gain, minimum=low, maximum=high),))


def _residual_rows(system: System, free: int) -> Callable[..., list[FloatArray]]:
    """Return the torque that the joint asks of its input minus the measured one, with its derivatives.

    What is in proportion to the torque (its gain, friction of a gear) is so to what the bodies need, and what passes
    divides that; the gain divides the other forces of the joint too. The other way round, a torque that does not pass
    would make every residual small: it would explain itself, and does at a light joint, where all of it is friction.
    """
    import casadi as ca

    from harness.physics.arms.vectorised import OnRecords

    q, v, a, t = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("a"), ca.SX.sym("t")
    u, p, torque = ca.SX.sym("u", 4 + free), system.p, ca.SX.sym("torque")
    swap_from = ca.vertcat(system.x, system.u, system.gravity, system.t)
    swap_to = ca.vertcat(q, v, torque, ca.DM([0.0, -1.0]), t)
    matrix, force = (
        ca.substitute(ca.SX(term), swap_from, swap_to) for term in (system.mass_matrix, system.generalized_forces)
    )
    passes = ca.jacobian(force, torque)
    gain = ca.substitute(passes, v, 0)  # no friction at rest
    bodies = u[3] + sum(p[k] * u[4 + k] for k in range(1, free))
    measured, rough, clock = u[1], u[2] - u[3], p[0] * u[4]
    own = (matrix @ a - force + passes * torque) / gain
    jumping = ca.substitute(own, a, 0)
    parts = bodies / gain + own - jumping + rough + clock - measured, bodies / passes - bodies / gain + jumping
    smooth, jumps = (ca.substitute(part, torque, bodies) for part in parts)
    slopes = [ca.jacobian(part, p) for part in (smooth, jumps)]
    return OnRecords(ca.Function("rows", [q, v, a, u, p, t], [smooth, jumps, *slopes]))


def _sizes(system: System, motion: SmoothedMotion) -> dict[str, dict[str, float]]:
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
