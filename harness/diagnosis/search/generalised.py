"""The move that generalises: what refines a law is fitted from where that one ended, if its first steps promise it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.search.compare import impossible, pays
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.table import FitTable, named, value
from harness.diagnosis.search.warm import Fits, share_ends
from harness.effects.effect import Placed


def refined_twice(effects: Sequence[Placed]) -> bool:
    """Return True if two effects add the same to their laws at a place: a joint has its bristles once."""
    grows = [(placed.at, placed.effect.grows) for placed in effects if placed.effect.grows]
    return len({*grows}) < len(grows)


@dataclass(frozen=True, eq=False)
class _Question:
    """Whether one addition (bristles, say) to the laws of a place helps.

    ``richer`` names by law what has the addition; ``simple`` are the laws that were fitted, likeliest first, and
    ``likeliest`` those of them that are asked in any case.
    """

    at: str
    richer: dict[str, Placed]
    simple: list[Placed]
    likeliest: list[Placed]


def generalise(table: FitTable, base: Fit, fits: Fits, untried: Sequence[Placed]) -> None:
    """Add the fits of what refines the laws that were fitted beside a base.

    What adds the same to several laws at a place is one question. What refines the one that would be the answer is
    tried first, and the best of those that physics allows. Where it brings what is asked of an effect, so may what
    refines their rivals; where it does not, none of them is refined.

    Parameters
    ----------
    table : Table
    base : Fit
    fits : dict
        By law, added to.
    untried : sequence of Placed
        All laws beside the base, those that refine others among them.
    """
    known: Fits = {placed: fit for placed, fit in fits.items() if fit is not None}
    for question in _questions(table, base, fits, untried):
        starts = _starts_elsewhere(question, known)
        helps: Fit | None = None
        for law in dict.fromkeys([*question.likeliest, *question.simple]):
            asked = law in question.likeliest
            if not asked and helps is None:
                break
            rich, fit = question.richer[law.effect.name], known[law]
            assert fit is not None
            grown = _grown(table, base.effects, rich, law, fit, starts, helps)
            if grown is None or (asked and grown.penalised < fit.penalised + table.policy.evidence):
                continue
            fits[rich] = grown
            helps = helps or grown
        richer = [question.richer[law.effect.name] for law in question.simple]
        share_ends(table, base, fits, lambda rich: None, richer, upward=True)


def _questions(table: FitTable, base: Fit, fits: Fits, untried: Sequence[Placed]) -> Iterator[_Question]:
    """Yield which additions may help: to laws that pay for themselves and are not far below the best one.

    Or that are near one that does: what it becomes in a limit, a rounded play, may have taken its place.
    """
    policy, before = table.policy, base.log_likelihood("estimation")
    done = {placed: fit for placed, fit in fits.items() if fit is not None}
    gains = {placed: fit.log_likelihood("estimation") - before for placed, fit in done.items()}
    enough = max(policy.evidence, policy.reach * max(gains.values(), default=0.0))
    refining = [placed for placed in untried if placed.effect.grows and not refined_twice([*base.effects, placed])]
    for at, added in dict.fromkeys((placed.at, placed.effect.grows) for placed in refining):
        richer = {
            placed.effect.nests[0]: placed for placed in refining if (placed.at, placed.effect.grows) == (at, added)
        }
        simple = [placed for placed in done if placed.at == at and placed.effect.name in richer]
        if not simple:
            continue
        simple.sort(key=lambda placed: -value(done[placed]))
        lawful = [placed for placed in simple if not impossible(table.form, placed, done[placed])]
        likeliest = [*dict.fromkeys([*lawful[:1], simple[0]])]  # a law may be forbidden for want of a refinement
        limits = {name for rich in richer.values() for name in rich.effect.limits}
        near = [placed for placed in done if placed.at == at and placed.effect.name in limits]
        if any(gains[law] >= enough and pays(done[law], base, policy) for law in [*likeliest, *near]):
            yield _Question(at, richer, simple, likeliest)


def _starts_elsewhere(question: _Question, known: Fits) -> dict[str, tuple[float, ...]]:
    """Return by short name what other laws of the place know of parameters."""
    return {
        parameter.name: (fit.values[placed.name(parameter.name)],)
        for placed, fit in known.items()
        for parameter in placed.effect.parameters
        if fit is not None and placed.at == question.at and placed not in question.simple
    }


def generalised(table: FitTable, model: Fit, law: Placed) -> list[tuple[Placed, Fit]]:
    """Return what refines a law of a model, with its fit in the place of that law, where the first steps promise it.

    Beside what was found later a refinement may help that did not when the law stood alone.

    Parameters
    ----------
    table : Table
    model : Fit
    law : Placed
        One of its effects.
    """
    others = [placed for placed in model.effects if placed != law]
    found = []
    for rich in table.candidates:
        if not rich.effect.grows or (rich.at, rich.effect.nests[0]) != (law.at, law.effect.name):
            continue
        if str(rich) in named(model.effects) or refined_twice([*model.effects, rich]):
            continue
        fit = _grown(table, others, rich, law, model, {}, None)
        if fit is not None:
            found.append((rich, fit))
    return found


def _grown(
    table: FitTable,
    others: Sequence[Placed],
    rich: Placed,
    simple: Placed,
    fit: Fit,
    known: Mapping[str, Sequence[float]],
    rival: Fit | None,
) -> Fit | None:
    """Return the fit of a law from where a special case of it ended; None where its first steps promise nothing."""
    table.say(str(rich))
    policy = table.policy
    begun = table.begin([*others, rich], starts_of(rich, simple, fit, known, table.sizes.get(rich.at, {})), fit)
    if begun is None:
        return None
    free, before = (sum(not parameter.fixed for parameter in law.effect.parameters) for law in (rich, simple))
    price = 0.5 * (free - before) * float(np.log(fit.samples))
    likelihood = fit.log_likelihood("estimation")
    steps = EFFORT.onward * EFFORT.first_steps  # as many as a start from afar takes
    promised = begun.log_likelihood + steps * begun.pace - likelihood
    if promised < policy.reach * (policy.evidence + price):
        return None
    return table.finish(begun, fit, rival, likelihood + price - policy.evidence)


def starts_of(
    rich: Placed, simple: Placed, fit: Fit, known: Mapping[str, Sequence[float]], sizes: Mapping[str, float]
) -> list[dict[str, float]]:
    """Return where a law starts from the fit of the one that it refines.

    What is new in it starts from the sizes of the data, and from what other laws of the place know of it.
    """
    shared = set(simple.effect.parameter_names)
    choices = [
        [fit.values[simple.name(parameter.name)] * factor for factor in parameter.refined]
        if parameter.name in shared
        else (*known.get(parameter.name, ()), *parameter.starts(sizes))
        for parameter in rich.effect.parameters
    ]
    names = [rich.name(parameter.name) for parameter in rich.effect.parameters]
    return [{**fit.values, **dict(zip(names, choice, strict=True))} for choice in itertools.product(*choices)]
