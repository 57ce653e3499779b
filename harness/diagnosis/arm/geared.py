"""What nearly every geared joint has, asked for together: dry and viscous friction, and a rotor.

Each of them may be several times what the bodies need. Beside what the others leave, an error that remembers takes up
what one of them alone explains, and no search from nothing has a first step; together they leave noise. So they are
fitted at once, what brings too little goes, one after the other, and from there the search goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from harness.diagnosis.arm.effects import GAIN
from harness.diagnosis.arm.rotor import ROTOR
from harness.diagnosis.policy import ARM_POLICY, Policy
from harness.diagnosis.search.compare import Comparison, compared, impossible
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.search import search
from harness.diagnosis.search.table import Accepted, named, value
from harness.diagnosis.search.ties import close
from harness.effects.effect import Placed

__all__ = ["beside_the_usual", "rotor_or_gain"]

USUAL = ("coulomb_friction", "viscous_friction", ROTOR)


def beside_the_usual(form: Form, outcome: Outcome, candidates: Sequence[Placed], policy: Policy) -> Outcome:
    """Return the outcome of a search that begins with what is usual, where that is better than one from nothing.

    Parameters
    ----------
    form : Form
    outcome : Outcome
        Of the search from nothing.
    candidates : sequence of Placed
        Of one joint.
    policy : Policy
    """
    found = _needed(form, outcome.nominal, [one for one in candidates if one.effect.name in USUAL], policy)
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


def _needed(form: Form, nominal: Fit, effects: Sequence[Placed], policy: Policy) -> Fit | None:
    """Return the fit of those effects that bring what is asked of one, beside each other; None if none does."""
    effects = list(effects)
    while effects:
        fits = [form.fit(effects, [{}], base) for base in (None, nominal)]
        fit = max((one for one in fits if one is not None), key=value, default=None)
        if fit is None:
            return None
        unlawful = [placed for placed in effects if impossible(form, placed, fit)]
        if not unlawful:
            weak = [(gain.total, placed) for placed, gain in _gains(form, fit, policy) if _lacks(gain, policy)]
            weak += [(0.0, placed) for placed in effects if form.change(fit, placed) < policy.least]
            if not weak:
                return fit
            unlawful = [min(weak, key=lambda pair: pair[0])[1]]
        effects = [placed for placed in effects if placed not in unlawful]
    return None


def _gains(form: Form, fit: Fit, policy: Policy) -> list[tuple[Placed, Comparison]]:
    """Return what every effect brings beside the others."""
    found = []
    for out in fit.effects:
        less = form.fit([placed for placed in fit.effects if placed is not out], [fit.values], fit)
        if less is not None:
            found.append((out, compared(fit, less, policy)))
    return found


def _lacks(gain: Comparison, policy: Policy) -> bool:
    """Return whether less than what is asked of an effect is brought."""
    asked = max(2 * policy.evidence, policy.gain_z * gain.total_error)
    alone = gain.validation < policy.alone_z * gain.error
    return gain.total < asked or gain.evidence < policy.alone or alone
