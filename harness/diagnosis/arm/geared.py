"""What nearly every geared joint has, asked for together: dry and viscous friction, and a rotor.

Each of them may be several times what the bodies need. Beside what the others leave, an error that remembers takes up
what one of them alone explains, and no search from nothing has a first step; together they leave noise. So they are
fitted at once, with every law of dry friction in turn, of the best what brings too little goes, one after the other,
and from there the search goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from harness.diagnosis.arm.effects import GAIN
from harness.diagnosis.arm.joint import JointRegression
from harness.diagnosis.arm.regression import RegressionForm
from harness.diagnosis.arm.rotor import ON_LOAD, ROTOR
from harness.diagnosis.policy import ARM_POLICY, Policy
from harness.diagnosis.search.compare import FitComparison, compared, impossible
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, named, value
from harness.diagnosis.search.ties import close, undecided
from harness.effects.effect import DRY, Placed

USUAL = ("viscous_friction", ROTOR)
PLAIN = "coulomb_friction"
DRAGS = ("viscous_friction", "quadratic_drag")


def beside_the_usual(form: RegressionForm, outcome: Outcome, candidates: Sequence[Placed], policy: Policy) -> Outcome:
    """Return the outcome of a search that begins with what is usual, where that is better than one from nothing.

    Parameters
    ----------
    form : RegressionForm
        Of one joint.
    outcome : Outcome
        Of the search from nothing.
    candidates : sequence of Placed
        Of one joint.
    policy : Policy
    """
    found = _needed(form, _likeliest(form, outcome.nominal, candidates), policy)
    if found is None or named(found.effects) <= named(outcome.model.effects):
        return outcome
    if value(found) < value(outcome.model) - policy.misfit_gain:
        return outcome
    accepted = tuple(
        Accepted(placed, ((placed,), *_near(form, placed, candidates)), gain.evidence, gain.validation)
        for placed, gain in _gains(form, found, policy)
    )
    begun = Outcome(form, outcome.nominal, found, accepted, outcome.rounds)
    again = search(form, outcome.nominal, candidates, policy=policy, begun=begun)
    return again if value(again.model) > value(outcome.model) + policy.tie else outcome


def _near(form: Form, placed: Placed, candidates: Sequence[Placed]) -> list[tuple[Placed, ...]]:
    """Return the laws at the place of an effect that may do the same: the search asks them when it ends."""
    near = form.laws.family(placed.effect).near
    return [(other,) for other in candidates if other.at == placed.at and other.effect.name in near]


def with_rivals(form: RegressionForm, outcome: Outcome, candidates: Sequence[Placed], policy: Policy) -> Outcome:
    """Return an outcome that says which laws of dry friction do the same as one of its own, with or without a drag.

    A search asks the rivals of what it adds. Two effects that are one law at its limit it may find one by one, and then
    nobody has asked that law.
    """
    dry = [one for one in candidates if one.effect.whole == DRY and str(one) not in named(outcome.model.effects)]
    friction = [known for known in outcome.accepted if known.placed.effect.whole == DRY]
    drags = [known for known in outcome.accepted if known.placed.effect.name in DRAGS]
    found: dict[str, list[tuple[Placed, ...]]] = {}
    for gone in (*([one] for one in friction), *([one, other] for one in friction for other in drags)):
        kept = [one for one in outcome.model.effects if one not in [known.placed for known in gone]]
        for law in dry:
            asked = not all((law,) in known.tie for known in gone)
            if asked and _does_the_same(form, outcome.model, gone[0].placed, kept, law, policy):
                for known in gone:
                    found.setdefault(str(known.placed), []).append((law,))
    accepted = tuple(
        replace(known, tie=tuple(dict.fromkeys([*known.tie, *found.get(str(known.placed), ())])))
        for known in outcome.accepted
    )
    return replace(outcome, accepted=accepted)


def _does_the_same(
    form: RegressionForm, model: Fit, placed: Placed, kept: Sequence[Placed], law: Placed, policy: Policy
) -> bool:
    """Return True if a law beside what is kept of an answer cannot be told from one of its effects."""
    fits = _fits(form, [*kept, law], _begun(form, model.values, [law]), (model,))
    lawful = [fit for fit in fits if not any(impossible(form, one, fit) for one in fit.effects)]
    fit = max(lawful, key=value, default=None)
    return fit is not None and undecided(form, model, placed, fit, (law,), value(model) - value(fit), policy)


def rotor_or_gain(form: Form, outcome: Outcome, candidates: Sequence[Placed], policy: Policy) -> Outcome:
    """Return an outcome that says where a rotor and a factor on the torque do the same.

    So it is at a joint without gravity: a factor on the torque is one on its friction and on its inertia. Of the two
    the answer is the rotor, unless drives are off by as little as that factor.
    """
    names = {ROTOR, GAIN}
    for at, known in enumerate(outcome.accepted):
        other = next((one for one in candidates if {known.placed.effect.name, one.effect.name} == names), None)
        if other is None or named([other]) <= named(outcome.model.effects):
            continue
        fit = _in_its_place(form, outcome.model, known.placed, other)
        if fit is None or not close(outcome.model, fit, value(outcome.model) - value(fit), policy):
            continue
        first, last = known.placed, other
        gain = outcome.model.values.get(first.name("gain"), 1.0)
        if not 1 / ARM_POLICY.drive < gain < ARM_POLICY.drive:
            first, last, outcome = other, first, replace(outcome, model=fit)
        changed = replace(known, placed=first, tie=tuple(dict.fromkeys([(first,), *known.tie, (last,)])))
        outcome = replace(outcome, accepted=(*outcome.accepted[:at], changed, *outcome.accepted[at + 1 :]))
    return outcome


def _in_its_place(form: Form, model: Fit, gone: Placed, new: Placed) -> Fit | None:
    """Return the fit of a rotor in the place of a gain, or the other way round: all forces change by one factor."""
    effects = [new if str(placed) == str(gone) else placed for placed in model.effects]
    starts = []
    factors = [1 / model.values[gone.name("gain")]] if gone.effect.name == GAIN else ARM_POLICY.gains_tried
    for factor in factors:
        start = dict(model.values) | ({new.name("gain"): factor} if new.effect.name == GAIN else {})
        for placed in model.effects:
            for parameter in placed.effect.parameters:
                if parameter.linear and placed is not gone:
                    start[placed.name(parameter.name)] *= factor
        starts.append(start)
    return form.fit(effects, starts, None)


def _likeliest(form: RegressionForm, nominal: Fit, candidates: Sequence[Placed]) -> Fit | None:
    """Return the likeliest fit of what is usual with one of the laws of dry friction, that its law allows."""
    usual = [one for one in candidates if one.effect.name in USUAL]
    dry = [one for one in candidates if one.effect.whole == DRY]
    load = [one for one in candidates if one.effect.name == ON_LOAD]
    plain = [one for one in dry if one.effect.name == PLAIN]
    first = max(_fits(form, [*plain, *usual], [{}], (None, nominal)), key=value, default=None)
    fits = [] if first is None else [first]
    level = nominal.values if first is None else first.values
    for others in (*([one] for one in dry if one not in plain), *([*plain, one] for one in load)):
        fits += _fits(form, [*others, *usual], _begun(form, level, others), (first,))
    fits += _fits(form, usual, [{}], (None, nominal))
    lawful = [fit for fit in (_allowed(form, fit) for fit in fits) if fit is not None]
    return max(lawful, key=value, default=None)


def _allowed(form: Form, fit: Fit | None) -> Fit | None:
    """Return a fit without what is usual where its law does not allow that, None where another law is not allowed."""
    while fit is not None and (unlawful := [one for one in fit.effects if impossible(form, one, fit)]):
        gone = next((one for one in unlawful if one.effect.name in USUAL), None)
        kept = [one for one in fit.effects if one is not gone]
        fit = form.fit(kept, [fit.values], fit) if gone is not None and kept else None
    return fit


def _fits(
    form: Form, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], bases: Sequence[Fit | None]
) -> list[Fit]:
    """Return the fits of effects with the errors of several others; None are errors without memory."""
    fits = (form.fit(effects, starts, base) for base in bases)
    return [fit for fit in fits if fit is not None]


def _begun(form: RegressionForm, known: Mapping[str, float], laws: Sequence[Placed]) -> list[dict[str, float]]:
    """Return where laws of dry friction begin: as Coulomb's of a level that was fitted, at their other parameters."""
    assert isinstance(form.regression, JointRegression)
    new = laws[-1]
    level = f"{PLAIN}@{new.at}.Fc"
    levels = [known[level]] if level in known else []
    own = {
        new.name(parameter.name): levels[0]
        for parameter in new.effect.parameters
        if levels and parameter.linear and parameter.unit == "F"
    }
    chosen = form.regression.choices(new)
    return [{**known, **own, **{new.name(name): number for name, number in one.items()}} for one in chosen]


def _needed(form: Form, fit: Fit | None, policy: Policy) -> Fit | None:
    """Return the fit of those effects that bring what is asked of one, beside each other; None if none does."""
    while fit is not None and fit.effects:
        weak = [(gain.total, placed) for placed, gain in _gains(form, fit, policy) if _lacks(gain, policy)]
        weak += [(0.0, placed) for placed in fit.effects if form.change(fit, placed) < policy.least]
        if not weak:
            return fit
        _, gone = min(weak, key=lambda pair: pair[0])
        fit = form.fit([placed for placed in fit.effects if placed is not gone], [fit.values], fit)
    return None


def _gains(form: Form, fit: Fit, policy: Policy) -> list[tuple[Placed, FitComparison]]:
    """Return what every effect brings beside the others."""
    found = []
    for out in fit.effects:
        less = form.fit([placed for placed in fit.effects if placed is not out], [fit.values], fit)
        if less is not None:
            found.append((out, compared(fit, less, policy)))
    return found


def _lacks(gain: FitComparison, policy: Policy) -> bool:
    """Return whether less than what is asked of an effect is brought."""
    asked = max(2 * policy.evidence, policy.gain_z * gain.total_error)
    alone = gain.validation < policy.alone_z * gain.error
    return gain.total < asked or gain.evidence < policy.alone or alone
