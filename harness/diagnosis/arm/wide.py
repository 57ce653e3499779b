"""Effects that act on several joints of an arm at once: payload, tilted base, wrong link, joint zero, elasticity.

They are tested beside what a joint could have by itself: friction (dry, viscous, in proportion to its torque, a
constant), and the inertia of its rotor. So neither is ever mistaken for a payload or a heavy link, and hides none. A
wrong torque gain of one joint competes with them on equal terms: what it explains better is left to the search on that
joint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.arm.effects import GAIN, Wide, wide_effects
from harness.diagnosis.arm.motion import ArmRun, moving_rows
from harness.diagnosis.arm.regression import USES, Change, RegressionForm
from harness.diagnosis.policy import ARM_POLICY, POLICY, ArmPolicy, Policy
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.arms.arm import ArmModel
from harness.physics.definition.parameters import Parameter
from harness.signals import FloatArray

__all__ = ["WideRegression", "WideResult", "own_columns", "wide_search"]

ROTOR = "rotor"
OWN = ("dry", "viscous", "constant", "load", "clock", ROTOR)
"""Columns of each joint in :func:`own_columns`."""
FRICTION = ("dry", "load")


@dataclass(frozen=True, eq=False)
class Linear:
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
    """Columns times parameters minus the torque; see :class:`harness.diagnosis.arm.regression.Equation`."""

    system: Linear
    target: Mapping[str, Sequence[FloatArray]]
    columns: Mapping[str, Sequence[FloatArray]]

    def residual(self, p: FloatArray, use: str) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every record the residual torque (rows, n) and the columns (rows, n, np)."""
        return [(x @ p - y, x) for x, y in zip(self.columns[use], self.target[use], strict=True)]


class WideRegression:
    """Residual torques of the joints that move; see :class:`harness.diagnosis.arm.regression.TorqueRegression`.

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
        self.counts = {use: [moving_rows(run.motion)[:, self.joints] for run in runs[use]] for use in USES}
        speeds = np.sqrt(np.mean(runs["estimation"][0].motion.v ** 2, axis=0))
        level = np.maximum(policy.turning * speeds, 1e-6)
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
        self.own = frozenset(f"inertia{k + 1}" for k in range(len(calibrated)))
        names += [f"inertia{k + 1}" for k in range(len(calibrated))]
        self.nominal = Linear(tuple(Parameter(name, "1", 0.0) for name in names))
        torques = np.sqrt(np.mean(np.concatenate([run.calm.u for run in runs["estimation"]]) ** 2, axis=0))
        self.size = torques[self.joints]
        self.effects = {str(effect): effect for effect in wide_effects(arm, torques, policy)}
        self._columns: dict[str, dict[str, list[FloatArray]]] = {}

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
        for placed in effects:
            parameters += [
                Parameter(placed.name(parameter.name), parameter.unit, 0.0, parameter.minimum, parameter.maximum)
                for parameter in placed.effect.parameters
            ]
            for use, parts in self.columns(self.effects[str(placed)]).items():
                for whole, part in zip(columns[use], parts, strict=True):
                    whole.append(part)
        joined = {use: [np.concatenate(parts, axis=2) for parts in each] for use, each in columns.items()}
        return LinearEquation(Linear(tuple(parameters)), self._target, joined)

    def changes(self, values: Mapping[str, float], candidates: Sequence[Placed]) -> list[Change]:
        """Return the columns of candidates."""
        del values
        return [
            Change(placed, {}, placed.effect.parameter_names, self.columns(self.effects[str(placed)]))
            for placed in candidates
        ]

    def free_torques(self) -> list[Change]:
        """Return nothing: what is left is asked joint by joint."""
        return []

    def beside_friction(self, placed: Placed, fit: Fit) -> float:
        """Return the torque of an effect over that of the dry friction at the joint where it weighs most."""
        own = np.array([fit.values[placed.name(parameter.name)] for parameter in placed.effect.parameters])
        torque = np.concatenate(self.columns(self.effects[str(placed)])["estimation"]) @ own
        size = np.sqrt(np.mean(torque**2, axis=0))
        joint = int(np.argmax(size))
        places = [len(OWN) * joint + OWN.index(word) for word in FRICTION]
        values = np.array([fit.values[self.nominal.parameter_names[k]] for k in places])
        friction = np.concatenate(self._base["estimation"])[:, joint, places] @ values
        return float(size[joint] / max(np.sqrt(np.mean(friction**2)), 1e-300))


@dataclass(frozen=True, eq=False)
class WideResult:
    """What acts on the whole arm.

    Attributes
    ----------
    fit : Fit
        With all that was accepted, wrong gains among it.
    accepted : tuple of Accepted
        Without wrong gains.
    outcome : Outcome
        The rounds, for the report.
    gains : dict
        Inputs whose gain explained more than any effect on the whole arm, with what ties with it.
    effects : dict
        All that was looked for, by name.
    rotors : dict
        Inertia of the rotor at every joint where the records show one beside all that.
    notes : list of str
    """

    fit: Fit
    accepted: tuple[Accepted, ...]
    outcome: Outcome
    gains: dict[str, tuple[Placed, ...]]
    effects: dict[str, Wide]
    rotors: dict[int, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def fast(self, run: ArmRun, joint: int) -> FloatArray:
        """Return the torque (N,) that a rotor needs beyond the calm motion: no column of its joint holds it."""
        return np.asarray(self.rotors.get(joint, 0.0) * (run.motion.a[:, joint] - run.calm.a[:, joint]))

    def torque(self, run: ArmRun) -> FloatArray:
        """Return the torque (N, n) that the arm needs with all that was accepted."""
        result = run.rigid.copy()
        for accepted in self.accepted:
            values = np.array(
                [self.fit.values[accepted.placed.name(p.name)] for p in accepted.placed.effect.parameters]
            )
            result += self.effects[str(accepted.placed)].columns(run.sharp) @ values
        return result


def own_columns(run: ArmRun, level: Sequence[float] | FloatArray) -> FloatArray:
    """Return what every joint could do by itself (N, n, 6 n).

    Sign of the speed, speed, 1, size of the torque times the sign, rate of the torque, acceleration.

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
    for k in range(n):
        v = run.motion.v[:, k]
        sign = np.tanh(v / level[k])
        parts = (sign, v, np.ones(rows), np.abs(run.calm.u[:, k]) * sign, -run.first[:, k], run.calm.a[:, k])
        for place, column in enumerate(parts):
            result[:, k, len(OWN) * k + place] = column
    return result


def wide_search(
    arm: ArmModel,
    runs: Mapping[str, Sequence[ArmRun]],
    joints: Sequence[int],
    *,
    calibrated: Sequence[FloatArray] = (),
    say: Callable[[str], None] = lambda text: None,
    policy: Policy = POLICY,
    arm_policy: ArmPolicy = ARM_POLICY,
) -> WideResult:
    """Find what acts on the whole arm.

    Parameters
    ----------
    arm : ArmModel
    runs : mapping
        From :func:`harness.diagnosis.arm.motion.arm_runs`.
    joints : sequence of int
        Those that move.
    calibrated : sequence of array (10 * bodies,)
        Directions in which inertial parameters are free.
    say : callable
        Called with words about what is being done.
    policy : Policy
    arm_policy : ArmPolicy

    Raises
    ------
    FitError
        If the torques are not finite.
    """
    regression = WideRegression(arm, runs, joints, calibrated, arm_policy)
    form = RegressionForm(regression, arm_policy)
    nominal = form.fit((), [{}], None)
    if nominal is None:
        raise FitError(
            f"the torques of arm {arm.name}",
            expected="finite torques along the measured motion",
            got="others",
            remedy="check units and spikes of the positions",
        )
    candidates = [effect.placed for effect in regression.effects.values()]
    own = replace(
        policy, most=arm_policy.wide, least=arm_policy.sensor, alone=arm_policy.alone, alone_z=arm_policy.alone_z
    )
    outcome = search(form, nominal, candidates, policy=own, say=say)
    small = [
        accepted
        for accepted in outcome.accepted
        if accepted.placed.effect.name != GAIN
        and regression.beside_friction(accepted.placed, outcome.model) < arm_policy.detail
    ]
    notes = []
    if small:
        large = tuple(accepted for accepted in outcome.accepted if accepted not in small)
        again = form.fit([accepted.placed for accepted in large], [outcome.model.values], outcome.model)
        outcome = replace(outcome, accepted=large, model=again or outcome.nominal)
        names = ", ".join(str(accepted.placed) for accepted in small)
        notes.append(
            f"{names} left out: less than {100 * arm_policy.detail:g} % of the friction beside it, whose law is not "
            "known so well"
        )
    gains = {
        accepted.placed.at: tuple(other for group in accepted.tie[1:] for other in group)
        for accepted in outcome.accepted
        if accepted.placed.effect.name == GAIN
    }
    kept = tuple(accepted for accepted in outcome.accepted if accepted.placed.effect.name != GAIN)
    fit = outcome.model
    rotors = {k: fit.values[name] for k in joints if _seen(fit, name := f"{arm.positions[k].name} {ROTOR}", policy)}
    if outcome.accepted:  # a rotor that is not there would take a part of what is, a few grams of a payload
        there = list(rotors)
        lean = RegressionForm(WideRegression(arm, runs, joints, calibrated, arm_policy, there), arm_policy)
        fit = lean.fit([accepted.placed for accepted in outcome.accepted], [fit.values], fit) or fit
    return WideResult(fit, kept, outcome, gains, regression.effects, rotors, notes)


def _seen(fit: Fit, name: str, policy: Policy) -> bool:
    """Return whether a parameter is positive, by the evidence that is asked of an effect."""
    value, error = fit.values[name], fit.deviations.get(name, np.inf)
    return value > 0 and 0.5 * (value / error) ** 2 - 0.5 * float(np.log(fit.samples)) >= policy.evidence
