"""What a later effect changes in the earlier ones: they are exchanged, refined, replaced, pruned or simplified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from harness.diagnosis.policy import EFFORT, Policy
from harness.diagnosis.search.compare import (
    Judged,
    compared,
    impossible,
    judged,
    wrong_signs,
)
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.grown import refined, refined_twice
from harness.diagnosis.search.leftover import left_over
from harness.diagnosis.search.outcome import Outcome, Round
from harness.diagnosis.search.refits import Say
from harness.diagnosis.search.refusal import Kind, Refusal
from harness.diagnosis.search.score_test import score_test
from harness.diagnosis.search.ties import (
    Accepted,
    close,
    own_values,
    physical,
    refines,
    total,
    typical_elsewhere,
    value,
)
from harness.diagnosis.stand_in import same_whole
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed

__all__ = [
    "contradictions",
    "displace",
    "exchange",
    "in_its_place",
    "mark_parts",
    "prune",
    "refinements",
    "second_friction",
    "simplify",
    "tried_pairs",
]

Trial = tuple[int, Placed, Fit]
"""The number of an accepted effect, what may take its place, and the fit with it there."""


def contradictions(form: Form, outcome: Outcome, rows: Sequence[Judged], policy: Policy) -> list[Trial]:
    """Try candidates in the place of an earlier effect where one of the two is no law beside the other.

    Signs that a law does not have show two effects that do the same.
    """
    base = outcome.model
    trials = []
    for row in sorted(rows, key=lambda row: -total(row))[: EFFORT.pairs + 1]:
        if row.fit is None or row.comparison is None or row.comparison.evidence < policy.evidence:
            continue
        new = row.added[0]
        for number, earlier in enumerate(outcome.accepted):
            lawless = wrong_signs(earlier.placed, row.fit.values)
            if not lawless and not (refines(row.added, earlier.placed, form.laws) and wrong_signs(new, row.fit.values)):
                continue
            others = [accepted.placed for accepted in outcome.accepted if accepted is not earlier]
            starts = [row.fit.values, *in_its_place(row.fit.values, earlier.placed, [new])]
            if (fit := form.fit([*others, new], starts, base, base)) is not None:
                trials.append((number, new, fit))
    return trials


def second_friction(base: Fit, best: Judged) -> bool:
    """Return True for a law of what a place has a whole law of already: a second dry friction at a joint."""
    return any(same_whole(best.added[-1], placed) for placed in base.effects)


def refinements(
    form: Form,
    outcome: Outcome,
    untried: Sequence[Placed],
    sizes: Mapping[str, Mapping[str, float]],
    policy: Policy,
    say: Say,
) -> list[Trial]:
    """Try what refines the earlier effects in their place: before the search ends, or a joint gets a second friction.

    One alone was refined when it was found, if that helped.
    """
    return [
        (number, rich, fit)
        for number, accepted in enumerate(outcome.accepted[:-1])
        for rich, fit in refined(form, outcome.model, accepted.placed, untried, sizes, policy, say)
    ]


def displace(outcome: Outcome, trials: Sequence[Trial], rows: Sequence[Judged], nominal: Fit, policy: Policy) -> bool:
    """Put the likeliest of some trials in the place of an earlier effect, if no candidate beside that one is likelier.

    It must be likelier than the model so far; with a candidate it may tie, which is one effect more. A second friction
    at a joint only imitates what one law is, and does not keep one from its place.
    """
    base = outcome.model
    rivals = [row for row in rows if row.passed and not second_friction(base, row)]
    beside = [value(row.fit) - policy.tie for row in rivals if row.fit is not None]
    best, least = None, max([value(base) + policy.tie, *beside])
    for number, new, fit in trials:
        if judged([new], fit, nominal, nominal, policy).passed and value(fit) > least:
            best, least = (number, new, fit), value(fit)
    if best is None:
        return False
    number, new, outcome.model = best
    earlier, gains = outcome.accepted[number], compared(outcome.model, base, policy)
    outcome.accepted[number] = replace(
        earlier,
        placed=new,
        tie=tuple(dict.fromkeys([(new,), *earlier.tie])),
        evidence=earlier.evidence + gains.evidence,
        validation=earlier.validation + gains.validation,
        beside=None,
        found=len(outcome.rounds) - 1,
    )
    return True


def tried_pairs(
    form: Form, outcome: Outcome, nominal: Fit, candidates: Sequence[Placed], policy: Policy, say: Say
) -> None:
    """Try the best rivals of the first answer to their end and with a second effect: one law may stand in for two.

    What was tried beside the answer and is impossible there is not tried beside what is like it. Each of a pair has to
    pass beside the other, as if it had been found last, and both together must bring more than the answer by what is
    asked of one effect: it is one more.
    """
    so_far = compared(outcome.model, nominal, policy).total
    ruled_out = {str(row.added[0]) for past in outcome.rounds[1:] for row in past.candidates if not physical(row)}
    present = {str(placed) for placed in outcome.model.effects}
    rivals = [
        row
        for row in outcome.rounds[0].candidates
        if row.comparison is not None
        and row.comparison.evidence >= policy.evidence
        and str(row.added[0]) not in present
        and (physical(row) or row.refusals == (Refusal(Kind.STOPPED),))
        and (not outcome.accepted or total(row) >= policy.reach * so_far)
    ]
    best: Judged | None = None
    for rival in sorted(rivals, key=lambda row: -total(row))[: EFFORT.pairs]:
        fit = rival.fit
        if fit is not None and fit.beyond:  # alone it had no hope: beside another it may
            fit = form.fit(fit.effects, [fit.values], fit)
            alone = judged(rival.added, fit, nominal, nominal, policy)
            if alone.passed and (best is None or total(alone) > total(best)):
                best = alone
        if fit is None:
            continue
        tried = {str(rival.added[0]), *ruled_out}
        others = [placed for placed in candidates if not placed.effect.grows and str(placed) not in tried]
        leads = [lead for lead in score_test(form, fit, others, policy).leads if lead.share >= policy.clear]
        for lead in leads[:2]:
            promised = 2 * lead.penalised / policy.reach  # both uses gain alike; columns are of first order
            if outcome.accepted and total(rival) + promised < so_far + 2 * policy.evidence:
                continue
            say(f"{rival.added[0]} + {lead.placed}")
            pair = form.fit([*fit.effects, lead.placed], [{**fit.values, **start} for start in lead.starts], fit)
            whole = judged([rival.added[0], lead.placed], pair, nominal, nominal, policy)
            second = judged([lead.placed], pair, fit, nominal, policy)
            if not (whole.passed and second.passed) or (best is not None and total(whole) <= total(best)):
                continue
            assert pair is not None
            alone_too = _alone(form, outcome, lead.placed, pair, nominal)
            if judged(rival.added, pair, alone_too, nominal, policy).passed:
                best = whole
    if best is None or total(best) < so_far + (2 * policy.evidence if len(best.added) > 1 else policy.tie):
        return
    assert best.fit is not None
    assert best.comparison is not None
    each = best.comparison.evidence / len(best.added), best.comparison.validation / len(best.added)
    outcome.model = best.fit
    outcome.accepted = [
        Accepted(placed, _alike(placed, outcome.rounds[0], form.laws), *each, found=number)
        for number, placed in enumerate(best.added)
    ]


def _alone(form: Form, outcome: Outcome, placed: Placed, pair: Fit, nominal: Fit) -> Fit:
    """Return the fit of the second of a pair without the first; the nominal one where it has none."""
    known = [row.fit for row in outcome.rounds[0].candidates if row.added == (placed,)]
    done = [fit for fit in known if fit is not None and fit.converged]
    return (done[0] if done else form.fit([placed], [pair.values], nominal)) or nominal


def _alike(placed: Placed, past: Round, laws: Dictionary) -> tuple[tuple[Placed, ...], ...]:
    """Return an effect and what may be tied with it: what is like it, at its place, and was refitted in a round."""
    names = {placed.effect.name, *laws.family(placed.effect).near}
    near = [row.added[0] for row in past.candidates if row.added[0].effect.name in names and typical_elsewhere(row)]
    return ((placed,), *((other,) for other in near if other.at == placed.at and other != placed))


def exchange(form: Form, outcome: Outcome, nominal: Fit, policy: Policy) -> None:
    """Try the rivals of earlier effects again beside the last one: the first answer may have stood in for two."""
    for number, earlier in enumerate(outcome.accepted[:-1]):
        if earlier.found >= len(outcome.rounds):
            continue
        others = [accepted.placed for k, accepted in enumerate(outcome.accepted) if k != number]
        rivals = [
            row
            for row in outcome.rounds[earlier.found].candidates
            if row.fit is not None and row.comparison is not None and row.comparison.evidence > policy.evidence
        ]
        best, placed = outcome.model, earlier.placed
        for row in sorted(rivals, key=lambda row: -total(row))[: EFFORT.pairs + 1]:
            new = row.added[0]
            if str(new) in {str(placed) for placed in outcome.model.effects} or refined_twice([*others, new]):
                continue
            assert row.fit is not None
            # nominal parameters as they are beside the effect that would go, and as they were beside its rival
            starts = [{**outcome.model.values, **values} for values in (own_values(new, row.fit), row.fit.values)]
            hope = best.log_likelihood("estimation") - EFFORT.margin
            begun = form.begin([*others, new], starts, outcome.model, hope)
            if begun is None or begun.log_likelihood < hope:
                continue
            fit = form.finish(begun, outcome.model, best)
            trial = judged([new], fit, nominal, nominal, policy)
            if fit is not None and trial.passed and value(fit) > value(best) + policy.tie:
                best, placed = fit, new
        if best is not outcome.model:
            outcome.model = best
            tie = tuple(
                dict.fromkeys([(placed,), *earlier.tie, *_alike(placed, outcome.rounds[earlier.found], form.laws)])
            )
            outcome.accepted[number] = replace(earlier, placed=placed, tie=tie, beside=None)


def prune(form: Form, outcome: Outcome, policy: Policy) -> None:
    """Drop earlier effects that a later one has made needless."""
    for earlier in outcome.accepted[:-1]:
        left = [accepted.placed for accepted in outcome.accepted if accepted is not earlier]
        starts = [outcome.model.values, *in_its_place(outcome.model.values, earlier.placed, left)]
        without = form.fit(left, starts, outcome.model, outcome.model)
        if without is None or not without.converged or any(impossible(placed, without) for placed in left):
            continue
        if value(without) > value(outcome.model) - policy.tie:
            outcome.model = without
            outcome.accepted = [accepted for accepted in outcome.accepted if accepted is not earlier]


def mark_parts(form: Form, outcome: Outcome, policy: Policy) -> None:
    """Mark effects that explain less than an unknown force that is left: each may be a part of that.

    Where something unknown acts, laws of the dictionary follow parts of it. What the records are surer of than of all
    that a free force could still explain is no such part; of several effects the surest one stands in any case. The
    faintest is asked first, and the next one beside what that leaves.
    """
    model, standing = outcome.model, list(outcome.accepted)
    while len(standing) > 1 and (unknown := left_over(form, model, policy).best) is not None:
        losses: dict[int, tuple[float, Fit]] = {}
        for number, accepted in enumerate(standing):
            others = [other.placed for other in standing if other is not accepted]
            starts = [model.values, {**model.values, **outcome.nominal.values}]
            again = form.fit(others, starts, model)
            fits = [*([] if again is None else [again]), *outcome.fits_with(others)]
            if fits:
                without = max(fits, key=value)
                losses[number] = value(model) - value(without), without
        if not losses:
            return
        faintest = min(losses, key=lambda number: losses[number][0])
        loss, model = losses[faintest]
        if loss > unknown.total:
            return
        gone = standing.pop(faintest)
        outcome.accepted[outcome.accepted.index(gone)] = replace(gone, part_of=unknown.name)


def simplify(form: Form, outcome: Outcome, rows: Sequence[Judged], policy: Policy) -> None:
    """Take a special case of a law where it ties beside what did not stand beside the law when that was accepted.

    What was general there may have been so for what another effect explains.
    """
    for number, earlier in enumerate(outcome.accepted):
        rich, model = earlier.placed, outcome.model
        others = [placed for placed in model.effects if str(placed) != str(rich)]
        if earlier.beside == frozenset(map(str, others)):
            continue
        special = {
            row.added[0]: row.fit
            for row in rows
            if row.fit is not None and row.added[0].effect.name in rich.effect.nests and row.added[0].at == rich.at
        }
        for simple, alone in special.items():
            fit = form.fit([*others, simple], [{**model.values, **own_values(simple, alone)}], model, model)
            if fit is None or not fit.converged or any(impossible(placed, fit) for placed in fit.effects):
                continue
            if close(model, fit, value(model) - value(fit), policy):
                outcome.model = fit
                tie = ((simple,), *earlier.tie)
                outcome.accepted[number] = replace(earlier, placed=simple, tie=tie, beside=None)
                break


def in_its_place(values: Mapping[str, float], gone: Placed, left: Sequence[Placed]) -> list[dict[str, float]]:
    """Return values with which another effect at the same place carries the level of one that goes as well."""
    starts = []
    for other in left:
        pairs = [(a, b) for a in gone.effect.parameters for b in other.effect.parameters if a.main and b.main]
        for a, b in pairs:
            if other.at == gone.at and a.unit == b.unit:
                starts.append({**values, other.name(b.name): values[other.name(b.name)] + values[gone.name(a.name)]})
    return starts
