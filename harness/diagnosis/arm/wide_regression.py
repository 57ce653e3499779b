"""The torques of all joints of an arm as one linear regression: what joints have by themselves, and what is wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.arm.effects import Wide, together, torques_of, wide_effects
from harness.diagnosis.arm.motion import STEP, ArmRun, moving_rows
from harness.diagnosis.arm.regression import USES, TorqueChange
from harness.diagnosis.arm.rotor import Spring, Swinging
from harness.diagnosis.policy import ARM_POLICY, ArmPolicy
from harness.diagnosis.search.fit import Fit
from harness.effects.effect import Placed
from harness.physics.arms.arm import ArmModel
from harness.physics.definition.parameters import Parameter
from harness.signals import FloatArray

ROTOR = "rotor"
OWN = ("dry", "viscous", "constant", "load", "clock", ROTOR)
"""Columns of each joint in :func:`own_columns`."""
FRICTION = ("dry", "load")
FADED = 1e-6
"""Size of a swing of size 1 below which it has faded before the first row that is kept."""


@dataclass(frozen=True, eq=False)
class LinearRegressors:
    """What has the parameters of a linear regression."""

    parameters: tuple[Parameter, ...]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Their names, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    def parameter(self, name: str) -> Parameter:
        """Return one by name."""
        return self.parameters[self.parameter_names.index(name)]

    def values(self) -> dict[str, float]:
        """Return where a fit starts."""
        return {parameter.name: parameter.value for parameter in self.parameters}

    def vector(self) -> FloatArray:
        """Return the same as an array."""
        return np.array([parameter.value for parameter in self.parameters])


@dataclass(frozen=True, eq=False)
class LinearEquation:
    """Columns times parameters minus the torque; see :class:`harness.diagnosis.arm.regression.Equation`.

    ``bent`` gives beside the places of some parameters the torques that are not in proportion to them.
    """

    system: LinearRegressors
    target: Mapping[str, Sequence[FloatArray]]
    columns: Mapping[str, Sequence[FloatArray]]
    bent: Sequence[tuple[Sequence[int], Bent]] = ()

    def residual(self, p: FloatArray, use: str) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every record the residual torque (rows, n) and the columns (rows, n, np)."""
        found = []
        for number, (x, y) in enumerate(zip(self.columns[use], self.target[use], strict=True)):
            residual, slopes = x @ p - y, x.copy() if self.bent else x
            for places, bent in self.bent:
                values = p[list(places)]
                torque = bent.torque(values, use, number)
                residual = residual + torque
                for k, (place, value) in enumerate(zip(places, values, strict=True)):
                    moved = values.copy()
                    moved[k] = value * (1 + STEP)
                    slopes[:, :, place] = (bent.torque(moved, use, number) - torque) / (value * STEP)
            for places, bent in self.bent:
                if not bent.made[use][number].hidden:
                    continue
                residual, slopes = without_swings(residual, slopes, bent.swings(p[list(places)], use, number))
            found.append((residual, slopes))
        return found

    @property
    def hidden(self) -> int:
        """See :class:`harness.diagnosis.arm.regression.Equation`."""
        return sum(spring.hidden for _, bent in self.bent for spring in bent.made["estimation"])


def without_swings(residual: FloatArray, slopes: FloatArray, swings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a residual (rows, n) and its derivatives (rows, n, p) without what free swings (rows, n, k) explain.

    A record may begin in the middle of a swing. One that has faded before the first row explains nothing.
    """
    columns = swings.reshape(-1, swings.shape[2])
    size = np.linalg.norm(columns, axis=0)
    alive = size > FADED
    if not alive.any():
        return residual, slopes
    basis, _ = np.linalg.qr(columns[:, alive] / size[alive])
    both = np.concatenate([residual[:, :, None], slopes], axis=2)
    flat = both.reshape(len(basis), -1)
    both = (flat - basis @ (basis.T @ flat)).reshape(both.shape)
    return both[:, :, 0], both[:, :, 1:]


@dataclass(frozen=True, eq=False)
class Bent:
    """Torques that are not in proportion to their parameters, along all records, decimated."""

    runs: Mapping[str, Sequence[ArmRun]]
    joints: Sequence[int]
    made: Mapping[str, Sequence[Spring]]

    def torque(self, values: FloatArray, use: str, number: int) -> FloatArray:
        """Return the torque (rows, n) that the joints need more along one record."""
        return self.runs[use][number].slim(self.made[use][number](values)[:, self.joints], self.joints)

    def swings(self, values: FloatArray, use: str, number: int) -> FloatArray:
        """Return the torques (rows, n, k) of the swings that the record may begin in."""
        return self.runs[use][number].slim(self.made[use][number].swings(values)[:, self.joints], self.joints)


class WideRegression:
    """Residual torques of the joints that move; see :class:`harness.diagnosis.arm.regression.TorqueRegression`.

    Bodies and rotors are the same on another day; the friction of a joint is not, nor are what its sensor reads without
    a torque and the clock of its log. So the validation records fit these for themselves, and judge bodies beside them.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        From :func:`harness.diagnosis.arm.motion.arm_runs`.
    joints : sequence of int
        Those that move: while a joint sticks, its torque says nothing.
    calibrated : sequence of array (10 * bodies,)
        Directions in which inertial parameters are free.
    policy : ArmPolicy
    rotors : sequence of int, optional
        Joints that may have a rotor; all if not given.
    """

    def __init__(
        self,
        arm: ArmModel,
        runs: Mapping[str, Sequence[ArmRun]],
        joints: Sequence[int],
        calibrated: Sequence[FloatArray] = (),
        policy: ArmPolicy = ARM_POLICY,
        rotors: Sequence[int] | None = None,
    ) -> None:
        self.runs, self.joints = runs, list(joints)
        self._positions = [channel.name for channel in arm.positions]
        self.counts = {use: [moving_rows(run.motion)[:, self.joints] for run in runs[use]] for use in USES}
        level = turning_level(runs["estimation"][0], policy)
        self._target = {use: [self._slim(run, run.motion.u - run.rigid) for run in runs[use]] for use in USES}
        self._base: dict[str, list[FloatArray]] = {}
        own_of = [
            (k, c) for k in joints for c, word in enumerate(OWN) if word != ROTOR or rotors is None or k in rotors
        ]
        for use in USES:
            self._base[use] = []
            for run in runs[use]:
                m = run.calm
                own = own_columns(run, level)[:, :, [len(OWN) * k + c for k, c in own_of]]
                if len(calibrated):
                    free = arm.arm.regressor(m.q, m.v, m.a) @ np.stack(calibrated, axis=1)
                    own = np.concatenate([own, free.reshape(*m.q.shape, -1)], axis=2)
                self._base[use].append(self._slim(run, own))
        names = [f"{arm.positions[k].name} {OWN[c]}" for k, c in own_of]
        self.inertia = [f"inertia{k + 1}" for k in range(len(calibrated))]
        names += self.inertia
        self.own = frozenset(names).difference(self.own_name(k, ROTOR) for k in joints)
        self.nominal = LinearRegressors(tuple(Parameter(name, "1", 0.0) for name in names))
        torques = np.sqrt(np.mean(np.concatenate([run.calm.u for run in runs["estimation"]]) ** 2, axis=0))
        self.size = torques[self.joints]
        self.effects = {str(effect): effect for effect in wide_effects(arm, torques, policy)}
        self._columns: dict[str, dict[str, list[FloatArray]]] = {}
        self._bent: dict[str, Bent] = {}

    def bent(self, effect: Wide) -> Bent | None:
        """Return the torques of an effect that are not in proportion to its parameters, made once."""
        key = str(effect)
        if effect.bent is not None and key not in self._bent:
            made = {use: [effect.bent(run) for run in self.runs[use]] for use in USES}
            self._bent[key] = Bent(self.runs, self.joints, made)
        return self._bent.get(key)

    def _slim(self, run: ArmRun, columns: FloatArray) -> FloatArray:
        """Return columns (N, n) or (N, n, k) of the joints, decimated."""
        return run.slim(columns[:, self.joints], self.joints)

    def columns(self, effect: Wide) -> dict[str, list[FloatArray]]:
        """Return the columns (rows, n, k) of an effect by use, made once; 0 where it cannot show."""
        key = str(effect)
        if key not in self._columns:
            made = {use: [self._slim(run, effect.columns(run)) for run in self.runs[use]] for use in USES}
            most = [parameter.maximum for parameter in effect.placed.effect.parameters]
            size = np.sqrt(np.mean(np.concatenate(made["estimation"]) ** 2, axis=0)) * most
            left = np.sqrt(np.mean(np.concatenate(self._target["estimation"]) ** 2, axis=0))
            shows = (size >= ARM_POLICY.silent * left[:, None]).any(axis=0)
            self._columns[key] = {use: [part * shows for part in parts] for use, parts in made.items()}
        return self._columns[key]

    def equation(self, effects: Sequence[Placed]) -> LinearEquation:
        """Return the equation with effects, the parameters of the effects last."""
        parameters = list(self.nominal.parameters)
        columns = {use: [[part] for part in parts] for use, parts in self._base.items()}
        places: list[tuple[list[int], Bent]] = []
        for placed in effects:
            effect = self.effects[str(placed)]
            bent = self.bent(effect)
            if bent is not None:
                first = len(parameters)
                places.append((list(range(first, first + len(placed.effect.parameters))), bent))
            for parameter in placed.effect.parameters:
                least, most, value = parameter.minimum, parameter.maximum, 0.0
                if bent is not None:
                    value = least = max(least, ARM_POLICY.softest * most)
                parameters.append(Parameter(placed.name(parameter.name), parameter.unit, value, least, most))
            for use, parts in self.columns(effect).items():
                for whole, part in zip(columns[use], parts, strict=True):
                    whole.append(part if bent is None else np.zeros_like(part))
        joined = {use: [np.concatenate(parts, axis=2) for parts in each] for use, each in columns.items()}
        return LinearEquation(LinearRegressors(tuple(parameters)), self._target, joined, self._swinging(places))

    def _swinging(self, apart: Sequence[tuple[Sequence[int], Bent]]) -> list[tuple[list[int], Bent]]:
        """Return what is bent, with its places; springs whose links swing together are one."""
        if len(apart) < 2:
            return [(list(places), bent) for places, bent in apart]
        groups: list[list[int]] = []
        made: dict[str, list[list[Spring]]] = {use: [] for use in USES}
        for use in USES:
            for number in range(len(self.runs[use])):
                each = together([(bent.made[use][number], np.array(places)) for places, bent in apart])
                groups = [list(map(int, places)) for _, places in each]
                made[use].append([spring for spring, _ in each])
        return [
            (places, Bent(self.runs, self.joints, {use: [parts[k] for parts in made[use]] for use in USES}))
            for k, places in enumerate(groups)
        ]

    def twisted(self, fit: Fit) -> dict[str, tuple[ArmRun, ...]]:
        """Return the records with the twists of the springs of a fit."""
        equation = self.equation(fit.effects)
        p = np.array([fit.values[name] for name in equation.system.parameter_names])
        found = {use: [np.zeros_like(run.calm.q) for run in self.runs[use]] for use in USES}
        for places, bent in equation.bent:
            own = p[list(places)]
            for spring, twist in ((one, e) for use in USES for one, e in zip(bent.made[use], found[use], strict=True)):
                if isinstance(spring, Swinging):
                    twist[:, list(spring.joints)] = spring.twist(own[::2], own[1::2])[:, :, 0]
        return {
            use: tuple(replace(run, twist=e) for run, e in zip(self.runs[use], found[use], strict=True)) for use in USES
        }

    def changes(self, values: Mapping[str, float], candidates: Sequence[Placed]) -> list[TorqueChange]:
        """Return the columns of candidates, and the whole of what is not in proportion at several choices."""
        del values
        found = []
        for placed in candidates:
            effect = self.effects[str(placed)]
            bent, columns, names = self.bent(effect), self.columns(effect), placed.effect.parameter_names
            if bent is None:
                found.append(TorqueChange(placed, {}, names, columns))
                continue
            for given in bent.made["estimation"][0].starts():
                at = np.array([given[name] for name in names])
                torque = {
                    use: [bent.torque(at, use, k)[:, :, None] for k in range(len(self.runs[use]))] for use in USES
                }
                found.append(TorqueChange(placed, given, ("effect",), torque))
            last = {name: given[name] for name in names[1:]}
            found.append(
                TorqueChange(
                    placed, last, names[:1], {use: [x[:, :, :1] for x in each] for use, each in columns.items()}
                )
            )
        return found

    def free_torques(self) -> list[TorqueChange]:
        """Return nothing: what is left is asked joint by joint."""
        return []

    def own_name(self, joint: int, word: str) -> str:
        """Return the name of a column of :func:`own_columns` of a joint."""
        return f"{self._positions[joint]} {word}"

    def beside_friction(self, placed: Placed, fit: Fit) -> float:
        """Return the torque of an effect over that of the dry friction at the joint where it weighs most."""
        own = np.array([fit.values[placed.name(parameter.name)] for parameter in placed.effect.parameters])
        effect = self.effects[str(placed)]
        torque = np.concatenate(
            [self._slim(run, torques_of([(effect, own)], run)[0]) for run in self.runs["estimation"]]
        )
        size = np.sqrt(np.mean(torque**2, axis=0))
        joint = int(np.argmax(size))
        places = [len(OWN) * joint + OWN.index(word) for word in FRICTION]
        values = np.array([fit.values[self.nominal.parameter_names[k]] for k in places])
        friction = np.concatenate(self._base["estimation"])[:, joint, places] @ values
        return float(size[joint] / max(np.sqrt(np.mean(friction**2)), 1e-300))


def turning_level(run: ArmRun, policy: ArmPolicy = ARM_POLICY) -> FloatArray:
    """Return the width (n,) of the sign of each joint's speed."""
    return np.asarray(np.maximum(policy.turning * np.sqrt(np.mean(run.motion.v**2, axis=0)), 1e-6))


def begun_swings(run: ArmRun, needed: FloatArray, swings: FloatArray) -> FloatArray:
    """Return the torque (N, n) of the swings that a record begins in, beside what every joint could do by itself.

    Parameters
    ----------
    run : ArmRun
    needed : array (N, n)
        Torque that the arm needs if it begins at rest.
    swings : array (N, n, k)
        From :func:`harness.diagnosis.arm.effects.torques_of`.
    """
    own = run.slim(own_columns(run, turning_level(run)))
    columns = np.concatenate([own, run.slim(swings)], axis=2)
    columns = columns.reshape(-1, columns.shape[2])
    size = np.linalg.norm(columns, axis=0)
    size[size <= FADED] = np.inf
    values = np.linalg.lstsq(columns / size, run.slim(run.motion.u - needed).ravel(), rcond=1e-10)[0] / size
    return np.asarray(swings @ values[own.shape[2] :])


def own_columns(run: ArmRun, level: Sequence[float] | FloatArray) -> FloatArray:
    """Return what every joint could do by itself (N, n, 6 n).

    Sign of the speed, speed, 1, size of what the bodies need times the sign, rate of the torque, acceleration; what
    jumps is filtered as the torque is.

    The rate stands for a torque that is recorded a fraction of a sample too late (tau - s tau'), and for the half
    step by which an integrator is late.

    Parameters
    ----------
    run : ArmRun
    level : sequence of float
        Width of the sign of each joint.
    """
    rows, n = run.motion.u.shape
    result = np.zeros((rows, n, len(OWN) * n))
    needed = run.calmed(run.rigid)
    for k in range(n):
        v = run.motion.v[:, k]
        sign = np.tanh(v / level[k])
        dry, load = run.followed(np.stack([sign, np.abs(needed[:, k]) * sign], axis=1)).T
        parts = (dry, v, np.ones(rows), load, -run.first[:, k], run.calm.a[:, k])
        for place, column in enumerate(parts):
            result[:, k, len(OWN) * k + place] = column
    return result
