"""Effects that act on several joints of an arm at once: payload, tilted base, wrong link, joint zero, elasticity.

They are tested beside what a joint could have by itself: friction (dry, viscous, in proportion to its torque, a
constant), and the inertia of its rotor. So neither is ever mistaken for a payload or a heavy link, and hides none. A
wrong torque gain of one joint competes with them on equal terms: what it explains better is left to the search on that
joint.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.arm.effects import GAIN, Wide, torques_of
from harness.diagnosis.arm.links import LINK, LinkSet, exchanged
from harness.diagnosis.arm.motion import ArmRun, clear_factor, clear_runs, standstill
from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.rotor import LINK_SIDE, MOTOR_SIDE, SPRINGS
from harness.diagnosis.arm.wide_regression import ROTOR, WideRegression, begun_swings
from harness.diagnosis.policy import ARM_POLICY, POLICY, ArmPolicy, Policy
from harness.diagnosis.search.compare import compared, impossible
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.scores import score_test
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, named, value
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.arms.arm import ArmModel
from harness.signals import FloatArray


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
        found = [
            (
                self.effects[str(placed)],
                np.array([self.fit.values[placed.name(p.name)] for p in placed.effect.parameters]),
            )
            for placed in (accepted.placed for accepted in self.accepted)
        ]
        more, swings = torques_of(found, run.sharp)
        needed = run.rigid + more
        return np.asarray(needed + begun_swings(run.sharp, needed, swings) if swings.shape[2] else needed)


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

    Where no joint pauses, records have rows enough in the band in which their motion is clear of noise, and a joint's
    elasticity promises evidence, all effects are searched on the true motion in that band, see
    :func:`harness.diagnosis.arm.motion.clear_runs`; that answer holds if a spring is in it. Else they are searched on
    the calm motion, without springs.

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
    own = replace(
        policy, most=arm_policy.wide, least=arm_policy.sensor, alone=arm_policy.alone, alone_z=arm_policy.alone_z
    )

    def lean(turning: Sequence[int] | None, records: Mapping[str, Sequence[ArmRun]] = runs) -> RegressionForm:
        return RegressionForm(WideRegression(arm, records, joints, calibrated, arm_policy, turning), arm_policy)

    def searched(form: RegressionForm, *without: str) -> tuple[RegressionForm, Outcome]:
        return form, _searched(arm, form, without, own, arm_policy, say)

    # springs are told on the true motion alone; beside bodies that are free no rotor is known, nor a stiffness from it
    hidden, springs = _no_springs(arm, runs, joints, arm_policy), list[Placed]()
    if not hidden:
        form, outcome = searched(lean(None, clear_runs(runs)), *([LINK_SIDE] if len(calibrated) else []))
        springs = [one.placed for one in outcome.accepted if one.placed.effect.name in SPRINGS]
    if not springs or not all(_has_rotor(outcome.model, one, policy) for one in springs):
        springs = []
        form, outcome = searched(lean(None), *SPRINGS)
    regression = _wide(form)
    if springs:
        form, outcome = _halfway(lean(None, regression.twisted(outcome.model)), outcome)
    outcome, notes = _without_small(form, outcome, arm_policy)
    notes += hidden
    fixed = len(calibrated) or springs
    outcome, beside = (outcome, None) if fixed else _as_a_set(form, outcome, lean, policy, own)
    gains, kept = _gains(outcome)
    fit = outcome.model
    if beside is not None:
        rotors = {k: fit.values[regression.own_name(k, ROTOR)] for k in beside}
        return WideResult(fit, kept, outcome, gains, regression.effects, rotors, notes)
    rotors = {k: fit.values[name] for k in joints if _seen(fit, name := f"{arm.positions[k].name} {ROTOR}", policy)}
    # a rotor that is not there would take a part of what is, a few grams of a payload
    if outcome.accepted and not springs:
        fit = lean(list(rotors)).fit([accepted.placed for accepted in outcome.accepted], [fit.values], fit) or fit
    return WideResult(fit, kept, outcome, gains, regression.effects, rotors, notes)


def _searched(
    arm: ArmModel,
    form: RegressionForm,
    without: Collection[str],
    policy: Policy,
    arm_policy: ArmPolicy,
    say: Callable[[str], None],
) -> Outcome:
    """Return what a search without some effects finds; with springs, nothing where none of them promises evidence."""
    nominal = form.fit((), [{}], None)
    if nominal is None:
        raise FitError(
            f"the torques of arm {arm.name}",
            expected="finite torques along the measured motion",
            got="others",
            remedy="check units and spikes of the positions",
        )
    every = [effect.placed for effect in _wide(form).effects.values()]
    candidates = [placed for placed in every if placed.effect.name not in without]
    springs = MOTOR_SIDE not in without
    if springs and not _promised(form, nominal, candidates, policy):
        return Outcome(form, nominal, nominal, (), ())
    own = replace(policy, least=arm_policy.spring) if springs else policy
    return search(form, nominal, candidates, policy=own, say=say)


def _halfway(form: RegressionForm, outcome: Outcome) -> tuple[RegressionForm, Outcome]:
    """Return the fit of an outcome in a form that takes the bodies' torques half way along the twist, and that form."""
    model = outcome.model
    return form, replace(outcome, model=form.fit(model.effects, [model.values], model) or model)


def _gains(outcome: Outcome) -> tuple[dict[str, tuple[Placed, ...]], tuple[Accepted, ...]]:
    """Return the gains of drives among what was accepted, each with what ties with it, and the rest."""
    gains = {
        accepted.placed.at: tuple(other for group in accepted.tie[1:] for other in group)
        for accepted in outcome.accepted
        if accepted.placed.effect.name == GAIN
    }
    return gains, tuple(accepted for accepted in outcome.accepted if accepted.placed.effect.name != GAIN)


def _no_springs(
    arm: ArmModel, runs: Mapping[str, Sequence[ArmRun]], joints: Sequence[int], policy: ArmPolicy
) -> list[str]:
    """Return why no springs can be looked for: joints that stand still too long, or too few rows of clear motion."""
    rows = min(run.motion.inside.stop - run.motion.inside.start for parts in runs.values() for run in parts)
    clear = rows // clear_factor(runs)
    if clear < policy.fewest:
        return [
            f"no elastic joint was looked for: in the band in which the motion is clear of noise a record has {clear} "
            f"rows, and {policy.fewest} are needed (record longer, or with faster motion)"
        ]
    still = standstill(runs)
    return [
        f"{arm.positions[k].name} stands still for {100 * still[k]:.0f} % of the time: no elastic joint was looked "
        "for, as what sticks and starts rings like one"
        for k in joints
        if still[k] > policy.pauses
    ]


def _wide(form: RegressionForm) -> WideRegression:
    """Return what a form of the whole arm is about."""
    assert isinstance(form.regression, WideRegression)
    return form.regression


def _promised(form: RegressionForm, nominal: Fit, candidates: Sequence[Placed], policy: Policy) -> bool:
    """Return whether an elasticity promises the evidence of an effect, alone: only then it is looked for."""
    springs = [placed for placed in candidates if placed.effect.name in SPRINGS]
    return any(lead.penalised >= policy.evidence for lead in score_test(form, nominal, springs, policy).leads)


def _has_rotor(fit: Fit, spring: Placed, policy: Policy) -> bool:
    """Return whether a spring is known: seen from the link, its stiffness is known through the rotor alone."""
    return spring.effect.name != LINK_SIDE or _seen(fit, f"{spring.at} {ROTOR}", policy)


def _without_small(form: RegressionForm, outcome: Outcome, policy: ArmPolicy) -> tuple[Outcome, list[str]]:
    """Return an outcome without what its joint's friction hides, and what is to be said of that."""
    regression = _wide(form)
    small = [
        accepted
        for accepted in outcome.accepted
        if accepted.placed.effect.name != GAIN
        and regression.beside_friction(accepted.placed, outcome.model) < policy.detail
    ]
    if not small:
        return outcome, []
    large = tuple(accepted for accepted in outcome.accepted if accepted not in small)
    again = form.fit([accepted.placed for accepted in large], [outcome.model.values], outcome.model)
    names = ", ".join(str(accepted.placed) for accepted in small)
    return replace(outcome, accepted=large, model=again or outcome.nominal), [
        f"{names} left out: less than {100 * policy.detail:g} % of the friction beside it, whose law is not known so "
        "well"
    ]


def _as_a_set(
    form: RegressionForm,
    outcome: Outcome,
    lean: Callable[[Sequence[int]], RegressionForm],
    policy: Policy,
    own: Policy,
) -> tuple[Outcome, Sequence[int] | None]:
    """Return the best set of links that exchange finds, and the joints that keep a rotor; None where nothing changes.

    Of sets that do as well the smallest one.
    """
    found = [
        (one, chosen.rotors)
        for chosen in exchanged(form, outcome, policy)
        if (one := _by_exchange(lean(chosen.rotors), outcome, chosen, own)) is not None
    ]
    most = max((value(one.model) for one, _ in found), default=0.0)
    alike = [pair for pair in found if value(pair[0].model) >= most - policy.tie]
    better, turning = min(alike, key=lambda pair: len(pair[0].accepted), default=(outcome, ()))
    if named(better.model.effects) == named(outcome.model.effects):
        return outcome, None
    return better, turning


def _by_exchange(form: RegressionForm, outcome: Outcome, chosen: LinkSet, policy: Policy) -> Outcome | None:
    """Return the outcome with a set that exchange found; None if it cannot be fitted or is against its own law.

    Every effect of it has to bring as much as is asked of one, beside all others.
    """
    old = {str(accepted.placed): accepted for accepted in outcome.accepted}
    effects = list(chosen.effects)
    while True:
        fit = form.fit(effects, [outcome.model.values], None)
        if fit is None or not effects:
            return None
        without = [form.fit([one for one in effects if one is not out], [fit.values], fit) for out in effects]
        gains = [None if less is None else compared(fit, less, policy) for less in without]
        weak = [
            (gain.total, at)
            for at, (gain, placed) in enumerate(zip(gains, effects, strict=True))
            if gain is not None
            and (
                gain.evidence < policy.evidence
                or form.change(fit, placed) < policy.least
                or (placed.effect.name == LINK and abs(fit.values[placed.name("scale")]) < ARM_POLICY.link)
            )
        ]
        if not weak:
            break
        effects.pop(min(weak)[1])
    if any(impossible(form, placed, fit) for placed in effects):
        return None
    beside = named(effects)
    accepted = tuple(
        replace(old[str(placed)], evidence=gain.evidence, validation=gain.validation)
        if str(placed) in old and gain is not None
        else Accepted(
            placed,
            ((placed,), *((rival,) for rival in chosen.rivals.get(str(placed), ()))),
            0.0 if gain is None else gain.evidence,
            0.0 if gain is None else gain.validation,
            beside - {str(placed)},
            len(outcome.rounds) - 1,
        )
        for placed, gain in zip(effects, gains, strict=True)
    )
    return replace(outcome, accepted=accepted, model=fit)


def _seen(fit: Fit, name: str, policy: Policy) -> bool:
    """Return whether a parameter is positive, by the evidence that is asked of an effect."""
    value, error = fit.values[name], fit.deviations.get(name, np.inf)
    return value > 0 and 0.5 * (value / error) ** 2 - 0.5 * float(np.log(fit.samples)) >= policy.evidence
