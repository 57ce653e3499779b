"""The refits of a round: which are begun, which are finished, and from where each of them starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np

from harness.diagnosis.policy import EFFORT, POLICY, Policy
from harness.diagnosis.search.compare import (
    impossible,
    judged,
    pays,
    violations,
    wrong_signs,
)
from harness.diagnosis.search.fit import Begun, Fit, Form
from harness.diagnosis.search.grown import as_good, start_between
from harness.diagnosis.search.score_test import Lead, ScoreTest, score_test
from harness.diagnosis.search.ties import value
from harness.effects import family
from harness.effects.effect import Placed

__all__ = ["Say", "chosen", "polished", "refitted"]


Say = Callable[[str], None]

Passes = Callable[[Placed, Fit], bool]


def refitted(
    form: Form, base: Fit, nominal: Fit, test: ScoreTest, untried: Sequence[Placed], policy: Policy, say: Say
) -> tuple[dict[Placed, Fit | None], frozenset[str]]:
    """Begin the refits of all that promises something; finish those whose first steps keep up with the best.

    Returns them, and the names of those that were begun and left.
    """

    @cache
    def passes(placed: Placed, fit: Fit) -> bool:
        return judged([placed], fit, base, nominal, policy).passed

    origins: dict[Placed, Fit] = {}
    begun: dict[Placed, Begun | None] = {}
    before = base.log_likelihood("estimation")

    def enough() -> float:  # what is not refitted in the end need not be begun in full
        gains = [  # what no law allows is no answer: it does not say how little an answer may gain
            refit.log_likelihood - before
            for placed, refit in begun.items()
            if refit is not None and not wrong_signs(placed, refit.values)
        ]
        return max(policy.lead, policy.reach * max(gains, default=0.0))

    for lead in [*chosen(test, policy), *_remembered(form, base, test, untried, policy)]:
        say(str(lead.placed))
        origins[lead.placed] = base
        promising = lead.starts if lead.penalised > 0.0 else lead.starts[:1]
        starts = [{**base.values, **start} for start in promising]
        begun[lead.placed] = form.begin([*base.effects, lead.placed], starts, base, before + enough())
    best = max((refit for refit in begun.values() if refit), key=lambda refit: refit.log_likelihood, default=None)
    unseen = []
    for suspect in form.suspects(base, best, untried):
        say(str(suspect.placed))
        unseen.append(suspect.placed)
        origin = base if suspect.base is None else suspect.base
        starts = [{**origin.values, **start} for start in suspect.starts]
        origins[suspect.placed] = origin
        # its starts lie far off: two steps tell nothing of where it leads
        begun[suspect.placed] = form.begin([*base.effects, suspect.placed], starts, origin)
    gains = {placed: refit.log_likelihood - before for placed, refit in begun.items() if refit is not None}
    least = enough()
    penalty = 0.5 * float(np.log(base.samples))

    def price(placed: Placed) -> float:
        return penalty * sum(not parameter.fixed for parameter in placed.effect.parameters)

    def needed(placed: Placed) -> float:  # nothing is accepted that does not pay for its parameters
        return max(least, policy.reach * (policy.evidence + price(placed)))

    def worth(placed: Placed) -> float:  # below it a maximum is no rival and no answer, whatever its last digits are
        return before + price(placed) - policy.evidence

    def place(placed: Placed) -> tuple[bool, float]:  # what no law allows must not take the place of what one does
        first = begun[placed]
        assert first is not None
        return bool(wrong_signs(placed, first.values)), -gains[placed]

    uncertain = {str(lead.placed) for lead in (*test.leads, *test.hidden) if lead.share < policy.clear}
    uncertain |= {str(placed) for placed in unseen if gains.get(placed, 0.0) > 0.0}

    def hoped(placed: Placed) -> float:  # along a narrow valley the first steps are short
        first = begun[placed]
        return gains[placed] + (EFFORT.first_steps * first.pace if first and str(placed) in uncertain else 0.0)

    order = sorted((placed for placed in gains if hoped(placed) >= needed(placed)), key=place)
    lawful = sum(not place(placed)[0] for placed in order)
    order = order[: min(lawful + 1, EFFORT.refits)]  # one law that is not allowed says that none which is explains it
    # what is exactly the same must not lose by its first steps
    same = {name for placed in order[:1] for name in family(placed.effect).exact}
    order += [placed for placed in begun if placed.effect.name in same and placed not in order and begun[placed]]
    fits: dict[Placed, Fit | None] = {}
    for placed in order:
        first = begun[placed]
        assert first is not None
        say(f"{placed} to its maximum")
        fits[placed] = form.finish(first, origins[placed], _best(fits, placed, passes), worth(placed))
    for placed in [
        simple
        for simple in begun
        if simple not in fits
        and any(
            fit is not None
            and pays(fit, base, policy)
            and simple.at == rich.at
            and simple.effect.name in rich.effect.nests
            for rich, fit in fits.items()
        )
    ]:  # a law is no answer before its special cases were tried from where it ended
        fits[placed] = None
    _share_starts(form, fits, base, passes)
    _lawful(form, fits, base, {lead.placed: lead.starts[0] for lead in test.leads})
    return fits, frozenset(str(placed) for placed in begun if placed not in fits)


def _best(fits: Mapping[Placed, Fit | None], beside: Placed, passes: Passes) -> Fit | None:
    """Return the likeliest of the other refits that may be the answer: nothing else puts an end to another fit.

    What the validation records or its own law refuse says nothing of how near to it the answer may come.
    """
    done = [fit for placed, fit in fits.items() if fit is not None and placed != beside and passes(placed, fit)]
    return max(done, key=lambda fit: fit.log_likelihood("estimation"), default=None)


def chosen(test: ScoreTest, policy: Policy = POLICY) -> list[Lead]:
    """Return the leads whose refits are begun: those that promise most, and the families of the first two.

    A promise along a column that the nominal parameters take up nearly whole is uncertain, as columns are: some such
    are tried as well. With little noise a thousandth of a column is seen.
    """
    promising = [lead for lead in (*test.leads, *test.hidden) if lead.gain >= policy.lead]
    clear = [lead for lead in promising if lead.share >= policy.clear]
    most = max((lead.gain for lead in clear), default=0.0)
    clear = [lead for lead in clear if lead.gain >= EFFORT.faintest * most]
    faint = sorted((lead for lead in promising if lead.share < policy.clear), key=lambda lead: -lead.penalised)
    if not any(lead.penalised > 0.0 for lead in promising):
        return []
    near: list[Lead] = []
    for leader in clear[:2]:
        names = {leader.placed.effect.name, *family(leader.placed.effect).near}
        near += [lead for lead in clear if lead.placed.effect.name in names and lead.placed.at == leader.placed.at]
    ordered = dict.fromkeys([*clear[: EFFORT.refits], *near, *clear])
    return [*list(ordered)[: EFFORT.begun], *faint[: EFFORT.faint]]


def _remembered(form: Form, base: Fit, test: ScoreTest, untried: Sequence[Placed], policy: Policy) -> list[Lead]:
    """Return leads that promise something only where the latent force does not remember what it took up."""
    forgetful = form.forgetful(base)
    if forgetful is None:
        return []
    known = {str(lead.placed) for lead in (*test.leads, *test.hidden) if lead.gain >= policy.lead}
    leads = score_test(form, forgetful, [placed for placed in untried if str(placed) not in known], policy).leads
    return [lead for lead in leads if lead.penalised > 0.0 and lead.share >= policy.clear][: EFFORT.faint]


def _share_starts(form: Form, fits: dict[Placed, Fit | None], base: Fit, passes: Passes) -> None:
    """Fit a law and its special cases from each other's ends: no rival loses by a bad start."""
    for rich, simple in [(a, b) for a in fits for b in fits if b.effect.name in a.effect.nests and a.at == b.at]:
        for mine, theirs in ((rich, simple), (simple, rich)):
            fit, other = fits[mine], fits[theirs]
            if other is None or (fit is not None and as_good(fit, other, contains=mine is rich)):
                continue
            start = start_between(mine, fit, theirs, other)
            again = form.fit([*base.effects, mine], [start], other, _best(fits, mine, passes))
            if again is not None and (fit is None or value(again) > value(fit)):
                fits[mine] = again


def _lawful(form: Form, fits: dict[Placed, Fit | None], base: Fit, starts: Mapping[Placed, dict[str, float]]) -> None:
    """Fit a law whose values its own physics forbids once more, from a special case of it and its first start."""
    for rich, simple in [(a, b) for a in fits for b in fits if b.effect.name in a.effect.nests and a.at == b.at]:
        fit, other = fits[rich], fits[simple]
        if fit is None or other is None or rich not in starts or not violations(rich, fit):
            continue
        shared = {parameter.name for parameter in simple.effect.parameters if parameter.nuisance}
        own = {name: value for name, value in starts[rich].items() if name.startswith(f"{rich}.")}
        start = {**other.values, **own}
        start |= {rich.name(name): other.values[simple.name(name)] for name in shared}
        again = form.fit([*base.effects, rich], [start], other)
        if again is not None and not violations(rich, again):
            fits[rich] = again


def polished(form: Form, base: Fit, fits: Sequence[Fit]) -> Fit:
    """Return the base fitted again from where its best rival ended, if that is better."""
    best = max(fits, key=lambda fit: fit.penalised, default=None)
    if best is None or best.penalised < base.penalised:
        return base
    begun = form.begin(base.effects, [best.values], best)
    if begun is None or begun.log_likelihood < base.log_likelihood("estimation") - EFFORT.margin:
        return base
    again = form.finish(begun, best)
    better = again is not None and again.penalised > base.penalised + 0.5
    if again is not None and any(impossible(placed, again) and not impossible(placed, base) for placed in base.effects):
        return base  # it was accepted as a law
    return again if again is not None and better and (again.converged or not base.converged) else base
