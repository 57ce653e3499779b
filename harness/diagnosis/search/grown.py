"""Laws that refine another one: fitted from where that one ended, if refining helps the likeliest of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from harness.diagnosis.policy import EFFORT, Policy
from harness.diagnosis.search.compare import impossible, pays
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.ties import value
from harness.effects.effect import Placed

__all__ = ["as_good", "grow", "refined", "refined_twice", "start_between"]

Fits = dict[Placed, Fit | None]


def grow(
    form: Form,
    fits: Fits,
    base: Fit,
    untried: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
    policy: Policy,
    say: Callable[[str], None],
) -> None:
    """Add the fits of what refines the laws that were fitted.

    What adds the same (bristles, say) to several laws at a place is one question. What refines the one that would be
    the answer is tried first, and the best of those that physics allows. Where it brings what is asked of an effect, so
    may what refines their rivals; where it does not, none of them is refined.

    Parameters
    ----------
    form : Form
    fits : dict
        By law, added to.
    base : Fit
    untried : sequence of Placed
        All laws beside the base, those that grow among them.
    sizes : mapping
        Sizes of the data by port, for the parameters that only they have.
    policy : Policy
    say : callable
        Told what is done.
    """
    refinements = [placed for placed in untried if placed.effect.grows and not refined_twice([*base.effects, placed])]
    before = base.log_likelihood("estimation")
    done = {placed: fit for placed, fit in fits.items() if fit is not None}
    most = max((fit.log_likelihood("estimation") - before for fit in done.values()), default=0.0)
    for at, added in dict.fromkeys((placed.at, placed.effect.grows) for placed in refinements):
        alike = [placed for placed in refinements if (placed.at, placed.effect.grows) == (at, added)]
        richer = {placed.effect.nests[0]: placed for placed in alike}
        simple = [placed for placed in done if placed.at == at and placed.effect.name in richer]
        if not simple:
            continue
        simple.sort(key=lambda placed: -value(done[placed]))
        lawful = [placed for placed in simple if not impossible(placed, done[placed])]
        likeliest = dict.fromkeys([*lawful[:1], simple[0]])  # a law may be forbidden for want of a refinement
        if not any(pays(done[law], base, policy) for law in likeliest):
            continue
        if done[simple[0]].log_likelihood("estimation") - before < max(policy.evidence, policy.reach * most):
            continue
        starts = {
            parameter.name: (fit.values[placed.name(parameter.name)],)
            for placed, fit in done.items()
            for parameter in placed.effect.parameters
            if placed.at == at and placed not in simple
        }
        helps: Fit | None = None
        for law in dict.fromkeys([*likeliest, *simple]):
            if law not in likeliest and helps is None:
                break
            rich = richer[law.effect.name]
            say(str(rich))
            grown = _grown(form, base.effects, rich, law, done[law], starts, sizes.get(at, {}), helps, policy)
            if grown is None or (law in likeliest and grown.penalised < done[law].penalised + policy.evidence):
                continue
            fits[rich] = grown
            helps = helps or grown
        _from_special_cases(form, fits, base, [richer[law.effect.name] for law in simple])


def refined_twice(effects: Sequence[Placed]) -> bool:
    """Return True if two effects add the same to their laws at a place: a joint has its bristles once."""
    grows = [(placed.at, placed.effect.grows) for placed in effects if placed.effect.grows]
    return len({*grows}) < len(grows)


def _from_special_cases(form: Form, fits: Fits, base: Fit, grown: Sequence[Placed]) -> None:
    """Fit what was refined once more from where a special case of it ended that explains the records better."""
    for rich, simple in [(a, b) for a in grown for b in grown if b.effect.name in a.effect.nests]:
        fit, other = fits.get(rich), fits.get(simple)
        if fit is None or other is None or as_good(fit, other, contains=True):
            continue
        again = form.fit([*base.effects, rich], [start_between(rich, fit, simple, other)], other, other)
        if again is not None and value(again) > value(fit):
            fits[rich] = again


def start_between(mine: Placed, fit: Fit | None, theirs: Placed, other: Fit) -> dict[str, float]:
    """Return where a law starts from the end of one that it contains or is contained in; the rest as it was."""
    start = dict(other.values)
    for parameter in mine.effect.parameters:
        if parameter.name in theirs.effect.parameter_names:
            start[mine.name(parameter.name)] = other.values[theirs.name(parameter.name)]
        elif fit is not None:
            start[mine.name(parameter.name)] = fit.values[mine.name(parameter.name)]
    return start


def as_good(fit: Fit, other: Fit, *, contains: bool) -> bool:
    """Return True if a fit has nothing to learn from where another ended; a law that contains it may not be worse.

    What it fits too closely costs a law that contains the other some of the validation records' likelihood, not much.
    """
    if contains:
        lost = other.log_likelihood("validation") - fit.log_likelihood("validation")
        return lost < EFFORT.close and fit.log_likelihood("estimation") > other.log_likelihood("estimation") - 1.0
    return value(fit) > value(other) - 1.0


def refined(
    form: Form,
    model: Fit,
    law: Placed,
    untried: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
    policy: Policy,
    say: Callable[[str], None],
) -> list[tuple[Placed, Fit]]:
    """Return what refines a law of a model, with its fit in the place of that law, where the first steps promise it.

    Beside what was found later a refinement may help that did not when the law stood alone.

    Parameters
    ----------
    form : Form
    model : Fit
    law : Placed
        One of its effects.
    untried : sequence of Placed
        What the model does not have.
    sizes : mapping
        Sizes of the data by port.
    policy : Policy
    say : callable
        Told what is done.
    """
    others = [placed for placed in model.effects if placed != law]
    found = []
    for rich in untried:
        if not rich.effect.grows or (rich.at, rich.effect.nests[0]) != (law.at, law.effect.name):
            continue
        if refined_twice([*model.effects, rich]):
            continue
        say(str(rich))
        fit = _grown(form, others, rich, law, model, {}, sizes.get(law.at, {}), None, policy)
        if fit is not None:
            found.append((rich, fit))
    return found


def _grown(
    form: Form,
    others: Sequence[Placed],
    rich: Placed,
    simple: Placed,
    fit: Fit,
    known: Mapping[str, Sequence[float]],
    sizes: Mapping[str, float],
    rival: Fit | None,
    policy: Policy,
) -> Fit | None:
    """Return the fit of a law from where a special case of it ended; None where its first steps promise nothing."""
    begun = form.begin([*others, rich], starts_of(rich, simple, fit, known, sizes), fit)
    if begun is None:
        return None
    free, before = (sum(not parameter.fixed for parameter in law.effect.parameters) for law in (rich, simple))
    price = 0.5 * (free - before) * float(np.log(fit.samples))
    likelihood = fit.log_likelihood("estimation")
    steps = EFFORT.onward * EFFORT.first_steps  # as many as a start from afar takes
    promised = begun.log_likelihood + steps * begun.pace - likelihood
    if promised < policy.reach * (policy.evidence + price):
        return None
    return form.finish(begun, fit, rival, likelihood + price - policy.evidence)


def starts_of(
    rich: Placed, simple: Placed, fit: Fit, known: Mapping[str, Sequence[float]], sizes: Mapping[str, float]
) -> list[dict[str, float]]:
    """Return where a law starts from the fit of the one that it refines.

    What is new in it starts from the sizes of the data, and from what other laws of the place know of it.
    """
    shared = set(simple.effect.parameter_names)
    choices = [
        (fit.values[simple.name(parameter.name)],)
        if parameter.name in shared
        else (*known.get(parameter.name, ()), *parameter.starts(sizes))
        for parameter in rich.effect.parameters
    ]
    names = [rich.name(parameter.name) for parameter in rich.effect.parameters]
    return [{**fit.values, **dict(zip(names, choice, strict=True))} for choice in itertools.product(*choices)]
