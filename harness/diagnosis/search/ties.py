"""What the data do not tell from an answer: its tie set, as it was accepted and beside what was accepted later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import Judged, difference
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.leftover import left_over
from harness.diagnosis.search.refusal import WANT_OF_EVIDENCE, Kind, only, subjects
from harness.diagnosis.search.table import Accepted, Answer, FitTable, Round, named, value
from harness.diagnosis.search.warm import own_values
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed


def total(row: Judged) -> float:
    """Return what decides between rivals: the gain of both uses together."""
    return -np.inf if row.comparison is None else row.comparison.total


def physical(row: Judged) -> bool:
    """Return True if nothing but a want of evidence speaks against a candidate."""
    return only(row.refusals, WANT_OF_EVIDENCE)


def typical_elsewhere(row: Judged) -> bool:
    """Return True if nothing but a want of evidence, or a value on its bound, speaks against a candidate."""
    return only(row.refusals, {*WANT_OF_EVIDENCE, Kind.UNCONVERGED, Kind.BOUND})


def may_tie(row: Judged, placed: Placed, laws: Dictionary) -> bool:
    """Return True if nothing but a want of evidence keeps a candidate from being an answer in the place of an effect.

    A more general law may be a rival though its values ended outside its own physics: within it, it is the answer
    itself or something beside it.
    """
    lawless = refines(row.added, placed, laws) and only(row.refusals, {*WANT_OF_EVIDENCE, Kind.LAW})
    return physical(row) or lawless


def tied(best: Judged, other: Judged, policy: Policy = POLICY) -> bool:
    """Return True if the data do not tell two candidates apart."""
    assert best.fit is not None
    if other.fit is None:
        return False
    return close(best.fit, other.fit, total(best) - total(other), policy)


def refines(rival: Sequence[Placed], placed: Placed, laws: Dictionary) -> bool:
    """Return True for a law of which another one at the same place is a special case."""
    return len(rival) == 1 and laws.refines(rival[0], placed)


def undecided(
    form: Form,
    answer: Fit,
    placed: Placed,
    rival: Fit,
    law: Sequence[Placed],
    gap: float,
    policy: Policy = POLICY,
) -> bool:
    """Return True if the data do not decide between an effect of an answer and a rival.

    The rival is as likely, or lost by no more than chance makes what is as good lose (Vuong 1989). A more general law
    whose model differs by less than anybody would miss, and that does not pay for its parameter, is no rival: it is the
    answer, with a parameter that does nothing.

    Parameters
    ----------
    form : Form
    answer : Fit
    placed : Placed
        The effect.
    rival : Fit
        With another law in its place.
    law : sequence of Placed
        That law.
    gap : float
        By which it is less likely.
    policy : Policy
    """
    if not close(answer, rival, gap, policy):
        return False
    pays = gap < 0.0  # what its parameter explains is worth more than the parameter
    return pays or not (refines(law, placed, form.laws) and form.distance(rival, answer) < policy.least)


def tie_set(
    form: Form, best: Judged, rows: Sequence[Judged], policy: Policy = POLICY
) -> tuple[tuple[Placed, ...], ...]:
    """Return the tie set of an answer: what may tie with it (:func:`may_tie`), and is as likely."""
    found = [best.added]
    for row in sorted(rows, key=lambda row: -total(row)):
        if row is best or row.comparison is None or row.comparison.evidence < 0 or row.comparison.total < 0:
            continue
        if row.fit is None or best.fit is None or not may_tie(row, best.added[-1], form.laws):
            continue
        if undecided(form, best.fit, best.added[-1], row.fit, row.added, total(best) - total(row), policy):
            found.append(row.added)
    return tuple(found)


def tie_set_of_last(table: FitTable, answer: Answer) -> Answer:
    """Return an answer whose last effect, found in the last round, has its tie set."""
    last, past = answer.accepted[-1], table.rounds[-1]
    best = next(row for row in past.candidates if row.added[-1] == last.placed)
    tie = tie_set(table.form, best, [*past.candidates, *held(table, best, past)], table.policy)
    return replace(answer, accepted=(*answer.accepted[:-1], replace(last, tie=tie)))


def alike(placed: Placed, past: Round, laws: Dictionary) -> list[tuple[Placed, ...]]:
    """Return what may be tied with an effect: what is like it, at its place, and was refitted in a round."""
    names = {placed.effect.name, *laws.family(placed.effect).near}
    near = [row.added[0] for row in past.candidates if row.added[0].effect.name in names and typical_elsewhere(row)]
    return [(other,) for other in near if other.at == placed.at and other != placed]


def held(table: FitTable, best: Judged, past: Round) -> list[Judged]:
    """Return laws that are as likely as an answer but for a parameter with a usual value, with this held there.

    On its bound a law is another one: an exponent of 0.05 is dry friction. And what loses by the price of a parameter
    that nobody would fit, the exponent of turbulent flow, is not told by the data. Whether they tell the law itself
    from the answer shows where it is typical. Only what has no unit has a usual value whatever the data. It is another
    law than that of its name, and has no place in the table.

    Parameters
    ----------
    table : Table
    best : Judged
        The answer.
    past : Round
        With its rivals.
    """
    found = []
    for row in past.candidates:
        if best.fit is not None and (typical := _typical(best.fit, row, table.policy)) is not None:
            fit = table.form.fit([*past.base.effects, typical], [_usual(row, typical)], row.fit)
            found.append(table.judged([typical], fit, past.base))
    return found


def _typical(answer: Fit, row: Judged, policy: Policy) -> Placed | None:
    """Return a law with the one parameter held that lies on a bound, or that costs more than it tells; or None."""
    if row.fit is None or row.fit.beyond or len(row.added) != 1:
        return None
    placed = row.added[0]
    on_bound = subjects(row.refusals, Kind.BOUND)
    dear = row.fit.count > answer.count and not close(answer, row.fit, value(answer) - value(row.fit), policy)
    chosen = [
        known
        for known in placed.effect.parameters
        if (known.name in on_bound if on_bound else dear and known.unit == "1" and not known.fixed)
    ]
    if len(chosen) != 1 or chosen[0].unit != "1" or not typical_elsewhere(row):
        return None
    gap, _ = difference(answer, row.fit, ("estimation", "validation"), policy)
    if not close(answer, row.fit, gap, policy):
        return None
    usual = [replace(known, fixed=known.fixed or known is chosen[0]) for known in placed.effect.parameters]
    return replace(placed, effect=replace(placed.effect, parameters=tuple(usual)))


def _usual(row: Judged, typical: Placed) -> dict[str, float]:
    """Return the values of a fit, with what is held at its usual value."""
    assert row.fit is not None
    free = {parameter.name for parameter in row.added[0].effect.parameters if not parameter.fixed}
    held_now = [known for known in typical.effect.parameters if known.fixed and known.name in free]
    return {**row.fit.values, **{typical.name(known.name): known.start({}) for known in held_now}}


def asked_again(table: FitTable, answer: Answer) -> Answer:
    """Return an answer whose effects have the rivals that stay tied beside all that was accepted.

    A tie of the first effect was found when it stood alone: what was accepted later may tell them apart, be the rival
    itself, or have been what told them apart.
    """
    present, found = named(answer.model.effects), list[Accepted]()
    for effect in answer.accepted:
        others = present - {str(effect.placed)}
        if effect.beside != others and not effect.given:
            # a rival in the answer lost already without the effect
            known = list(effect.tie)
            if effect.found < len(table.rounds):
                near, names = alike(effect.placed, table.rounds[effect.found], table.laws), [*map(named, known)]
                known += [member for member in near if named(member) not in names]
            rivals = [member for member in known if not named(member) & present]
            kept = [member for member in rivals if _still_tied(table, answer.model, effect.placed, member)]
            effect = replace(effect, tie=((effect.placed,), *kept), beside=others)
        found.append(effect)
    return replace(answer, accepted=tuple(found))


def _still_tied(table: FitTable, model: Fit, placed: Placed, member: tuple[Placed, ...]) -> bool:
    """Return whether a model with a rival in the place of an effect is as likely."""
    policy = table.policy
    others = [effect for effect in model.effects if str(effect) != str(placed)]
    start = dict(model.values)
    for row in (row for past in table.rounds for row in past.candidates if row.added == member):
        if row.fit is not None:
            for rival in member:
                start |= own_values(rival, row.fit)
    hope = model.log_likelihood("estimation") - EFFORT.margin
    begun = table.begin([*others, *member], [start], model, hope)
    if begun is None or begun.log_likelihood < hope:
        return False
    trial = table.finish(begun, model, model)
    row = table.judged(member, trial)
    if (typical := _typical(model, row, policy)) is not None:
        trial = table.form.fit([*others, typical], [_usual(row, typical)], trial)
        row = table.judged([typical], trial)
    if trial is None or trial.beyond or not physical(row):
        return False
    return undecided(table.form, model, placed, trial, member, value(model) - value(trial), policy)


def unknown_parts(table: FitTable, answer: Answer) -> Answer:
    """Return an answer that marks effects which explain less than an unknown force that is left: parts of it, maybe.

    Where something unknown acts, laws of the dictionary follow parts of it. What the records are surer of than of all
    that a free force could still explain is no such part; of several effects the surest one stands in any case. The
    faintest is asked first, and the next one beside what that leaves.
    """
    model, marked = answer.model, dict[str, str]()
    standing = [one for one in answer.accepted if not one.given]
    while len(standing) > 1 and (unknown := left_over(table.form, model, table.policy).best) is not None:
        losses: dict[int, tuple[float, Fit]] = {}
        for number, accepted in enumerate(standing):
            others = [placed for placed in model.effects if str(placed) != str(accepted.placed)]
            table.fit(others, [model.values, {**model.values, **table.nominal.values}], model)
            without = table.best(others)
            if without is not None:
                losses[number] = value(model) - value(without), without
        if not losses:
            break
        faintest = min(losses, key=lambda number: losses[number][0])
        loss, model = losses[faintest]
        if loss > unknown.total:
            break
        marked[str(standing.pop(faintest).placed)] = unknown.name
    parts = tuple(replace(one, part_of=marked.get(str(one.placed), one.part_of)) for one in answer.accepted)
    return replace(answer, accepted=parts)


def close(best: Fit, other: Fit, gap: float, policy: Policy) -> bool:
    """Return whether a gap of the log-likelihoods is too small to prefer the better one, were the other simpler."""
    _, error = difference(best, other, ("estimation", "validation"), policy)
    return gap < max(policy.tie, policy.tie_z * error)
