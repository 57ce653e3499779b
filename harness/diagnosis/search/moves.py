"""The moves of the search: each yields answers that are one step away from an answer, fitted into the table.

Which of them is taken, one function tells: :func:`preferred`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import Policy
from harness.diagnosis.search.compare import Judged, difference, wrong_signs
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.generalised import generalise, generalised, refined_twice
from harness.diagnosis.search.race import raced
from harness.diagnosis.search.refusal import Kind, Refusal, only
from harness.diagnosis.search.scores import Lead, score_test
from harness.diagnosis.search.table import Accepted, Answer, FitTable, Round, named, value
from harness.diagnosis.search.ties import alike, physical, tied, total
from harness.diagnosis.search.warm import own_values, polished, start_between
from harness.diagnosis.stand_in import same_whole
from harness.effects.effect import Placed

Move = Callable[[FitTable, Answer], Iterator[Answer]]


def preferred(table: FitTable, new: Answer, old: Answer, *, simpler: bool = False) -> bool:
    """Return True if one answer is to take the place of another: the rule of all moves.

    Every effect more must bring the evidence that is asked of one, an exchange more than a tie, and an effect less may
    cost no more than a tie. A law that gives way to its own special case and another law, with no more parameters, is
    exchanged: it stood in for both. A special case of a law takes its place where the data do not tell the two apart,
    and where the law adds less than the share of a further effect: then it is the corner of the special case.
    """
    policy, more = table.policy, len(new.accepted) - len(old.accepted)
    split = new.model.count <= old.model.count and any(_special(old, placed) for placed in new.model.effects)
    asked = -policy.tie if more < 0 else policy.tie if more == 0 or split else 2 * policy.evidence * more
    if simpler:
        _, error = difference(old.model, new.model, ("estimation", "validation"), policy)
        asked = -max(policy.tie, policy.tie_z * error, _corner(table, old.model))
    return value(new.model) > value(old.model) + asked


def best_of(table: FitTable, answer: Answer, trials: Iterable[Answer], *, simpler: bool = False) -> Answer | None:
    """Return the likeliest of some answers that are to take the place of another one; None where none is."""
    stand = [trial for trial in trials if preferred(table, trial, answer, simpler=simpler)]
    return max(stand, key=lambda trial: value(trial.model), default=None)


def climbed(table: FitTable, answer: Answer, move: Move, *, simpler: bool = False) -> Answer:
    """Return where a move leads from an answer until it betters it no more."""
    while (better := best_of(table, answer, move(table, answer), simpler=simpler)) is not None:
        answer = better
    return answer


def _corner(table: FitTable, fit: Fit) -> float:
    """Return what a law may bring more than a special case and be no other law: a share of what all effects bring."""
    return table.policy.second_share * (value(fit) - value(table.nominal))


# ---- add -------------------------------------------------------------------------------------------------------------


def expanded(table: FitTable, answer: Answer) -> Answer:
    """Fit an answer with each effect more that promises something, as a round; return it, at its maximum then."""
    base, present = answer.model, named(answer.model.effects)
    untried = [placed for placed in table.candidates if str(placed) not in present]
    laws = [placed for placed in untried if not placed.effect.grows]
    test = score_test(table.form, base, laws, table.policy)
    fits, left = raced(table, base, test, laws)
    generalise(table, base, fits, untried)
    base = polished(table, base, [fit for fit in fits.values() if fit is not None])
    rows = _ended(table, [table.judged([placed], fit, base) for placed, fit in fits.items()], base)
    clear = [row for row in rows if row.comparison is not None and row.comparison.evidence >= table.policy.evidence]
    past = Round(base, test.with_shown({str(row.added[0]) for row in clear}), tuple(rows), left)
    table.rounds.append(past)
    return replace(answer, model=base)


def add(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers with one candidate of the last round more, first the one to take.

    It is the likeliest one, or the simplest that these data do not tell from it: of its special cases, and of the other
    laws of what it is the whole law of, dry friction at the same place.
    """
    passed = sorted((row for row in table.rounds[-1].candidates if row.passed), key=total, reverse=True)
    same = [row for row in passed if _no_more(table, passed[0], row)] or passed[:1]
    first = min(same, key=lambda row: row.fit.count if row.fit else 0, default=None)
    for row in sorted(passed, key=lambda row: row is not first):
        yield answer.added(row, len(table.rounds) - 1)


def _no_more(table: FitTable, best: Judged, row: Judged) -> bool:
    """Return True for a candidate that the best one is, as far as these data tell, or a corner of it."""
    first, other, fit = best.added[0], row.added[0], best.fit
    special = first.generalises(other)
    if special and fit is not None and total(best) - total(row) < _corner(table, fit):
        return True
    return (special or same_whole(first, other)) and tied(best, row, table.policy)


def _ended(table: FitTable, rows: Sequence[Judged], base: Fit) -> list[Judged]:
    """Return candidates of which those go to their end that nothing speaks against but that they have not come there.

    Only those that would be the answer or tie with it: both uses decide that, and a fit is left by one of them.
    """
    found = list(rows)
    for _ in range(EFFORT.onward):
        best = max((row for row in found if row.passed), key=total, default=None)
        waiting = [k for k, row in enumerate(found) if _unfinished(row, best, table.policy)]
        for k in waiting:
            row = found[k]
            assert row.fit is not None
            fit = table.fit(row.fit.effects, [row.fit.values], row.fit)
            if fit is not None:
                found[k] = table.judged(row.added, fit, base)
        if not waiting:
            break
    return found


def _unfinished(row: Judged, best: Judged | None, policy: Policy) -> bool:
    """Return True for a candidate whose fit goes on: it may be an answer, and ended early."""
    if row.fit is None or not row.refusals or not only(row.refusals, {Kind.STOPPED, Kind.UNCONVERGED}):
        return False
    return best is None or tied(best, row, policy)


def pair(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield pairs in the place of a first answer, each likelier than the one before: one law may stand in for two.

    Its best rivals go to their end, and get a second effect. Each of a pair has to pass beside the other, as if it had
    been found last.
    """
    best = -np.inf
    for rival in _rivals(table, answer):
        fit = rival.fit
        if fit is not None and fit.beyond:  # alone it had no hope: beside another it may
            fit = table.fit(fit.effects, [fit.values], fit)
            row = table.judged(rival.added, fit)
            if fit is not None and row.passed and value(fit) > best:
                best = value(fit)
                yield _together(table, row)
        if fit is None:
            continue
        for lead in _second(table, answer, rival, fit):
            table.say(f"{rival.added[0]} + {lead.placed}")
            starts = [{**fit.values, **start} for start in lead.starts]
            both = table.fit([*fit.effects, lead.placed], starts, fit)
            if both is not None and value(both) > best:
                row = table.judged([rival.added[0], lead.placed], both)
                if row.passed and _each_passes(table, row, fit):
                    best = value(both)
                    yield _together(table, row)


def _rivals(table: FitTable, answer: Answer) -> list[Judged]:
    """Return the candidates of the first round that may be one of two; what refines others comes later.

    First the special cases of a law of the answer, which may stand in for one of them and another law, then the
    likeliest.
    """
    policy, present = table.policy, named(answer.model.effects)
    so_far = value(answer.model) - value(table.nominal)
    rows = [
        row
        for row in table.rounds[0].candidates
        if row.comparison is not None
        and row.comparison.evidence >= policy.evidence
        and not row.added[0].effect.grows
        and str(row.added[0]) not in present
        and (physical(row) or row.refusals == (Refusal(Kind.STOPPED),))
        and (not answer.accepted or total(row) >= policy.reach * so_far)
    ]
    return sorted(rows, key=lambda row: (not _special(answer, row.added[0]), -total(row)))[: EFFORT.pairs]


def _special(answer: Answer, simple: Placed) -> bool:
    """Return True for a special case of a law of an answer."""
    return any(placed.generalises(simple) for placed in answer.model.effects)


def _second(table: FitTable, answer: Answer, rival: Judged, fit: Fit) -> Iterator[Lead]:
    """Yield what may be the second of a pair: its column promises enough of what the pair would need.

    Nothing is promised where a latent force has taken it up. That something is there, beside its special case, the law
    of an answer tells.
    """
    policy = table.policy
    ruled_out = {str(row.added[0]) for past in table.rounds[1:] for row in past.candidates if not physical(row)}
    tried = {*named(fit.effects), *ruled_out}
    others = [placed for placed in table.candidates if not placed.effect.grows and str(placed) not in tried]
    leads = [lead for lead in score_test(table.form, fit, others, policy).leads if lead.share >= policy.clear]
    needed = value(answer.model) - value(table.nominal) + 2 * policy.evidence - total(rival)
    for lead in leads[:2]:
        promised = 2 * lead.penalised / policy.reach >= needed  # both uses gain alike, at first order
        if not answer.accepted or promised or _special(answer, rival.added[0]):
            yield lead


def _each_passes(table: FitTable, row: Judged, alone: Fit) -> bool:
    """Return True for a pair of which each passes beside the other; ``alone`` is the fit with the first one."""
    first, second = row.added
    assert row.fit is not None
    if not table.judged([second], row.fit, alone).passed:
        return False
    other = table.best([second])
    if other is None or not other.converged:
        other = table.fit([second], [row.fit.values], table.nominal) or table.nominal
    return table.judged([first], row.fit, other).passed


def _together(table: FitTable, row: Judged) -> Answer:
    """Return the answer of effects that were found together, each with its part of the evidence."""
    assert row.fit is not None
    assert row.comparison is not None
    share = row.comparison.evidence / len(row.added), row.comparison.validation / len(row.added)
    return Answer(row.fit, tuple(
        Accepted(placed, ((placed,), *alike(placed, table.rounds[0], table.laws)), *share, found=number)
        for number, placed in enumerate(row.added)
    ))  # fmt: skip


# ---- exchange, generalise, specialise --------------------------------------------------------------------------------


def second_friction(answer: Answer) -> bool:
    """Return True if the last effect is a law of what a place has a whole law of already: a second dry friction."""
    *earlier, last = answer.model.effects
    return any(same_whole(last, placed) for placed in earlier)


def _clear(table: FitTable, past: Round) -> list[tuple[Placed, Fit]]:
    """Return the likeliest candidates of a round with the evidence that is asked for, whatever else is said of them."""
    rows = [
        (row.added[0], row.fit)
        for row in sorted(past.candidates, key=total, reverse=True)
        if row.fit is not None and row.comparison is not None and row.comparison.evidence >= table.policy.evidence
    ]
    return rows[: EFFORT.pairs + 1]


def exchange_contradicted(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers with a candidate of the last round in the place of an earlier effect that is no law beside it.

    Signs that a law does not have show two effects that do the same.
    """
    base = answer.model
    for new, beside in _clear(table, table.rounds[-1]):
        for number, earlier in enumerate(answer.accepted):
            if not earlier.given and wrong_signs(earlier.placed, beside.values):
                fit = table.fit([*answer.without(number), new], [beside.values], base, base)
                if fit is not None and table.judged([new], fit).passed:
                    yield answer.exchanged(number, new, fit, len(table.rounds) - 1)


def generalise_earlier(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers with what refines an earlier effect in its place; one alone was refined when it was found."""
    for number, earlier in answer.earlier:
        for rich, fit in generalised(table, answer.model, earlier.placed):
            if table.judged([rich], fit).passed:
                yield answer.exchanged(number, rich, fit, len(table.rounds) - 1)


def exchange(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers with a rival of an earlier effect in its place: the first may have stood in for two."""
    for number, earlier in answer.earlier:
        past = table.rounds[earlier.found] if earlier.found < len(table.rounds) else None
        for new, alone in _clear(table, past) if past else ():
            others = answer.without(number)
            if str(new) in named(answer.model.effects) or refined_twice([*others, new]):
                continue
            fit = _in_place(table, answer.model, others, new, alone)
            if past and fit is not None and table.judged([new], fit).passed:
                yield answer.exchanged(number, new, fit, earlier.found, alike(new, past, table.laws))


def _in_place(table: FitTable, model: Fit, others: Sequence[Placed], new: Placed, alone: Fit) -> Fit | None:
    """Return a fit with a rival in the place of an effect, if its first steps may lead it to the model."""
    # nominal parameters as they are beside the effect that would go, and as they were beside its rival
    starts = [{**model.values, **values} for values in (own_values(new, alone), alone.values)]
    hope = model.log_likelihood("estimation") - EFFORT.margin
    begun = table.begin([*others, new], starts, model, hope)
    return None if begun is None or begun.log_likelihood < hope else table.finish(begun, model, model)


def specialise(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers with a special case of a law in its place.

    Asked of a law beside what did not stand beside it when it was accepted: what was general there may have been so for
    what another effect explains.
    """
    rows = [(row.added[0], row.fit) for past in table.rounds for row in past.candidates if row.fit is not None]
    for number, earlier in enumerate(answer.accepted):
        rich, others, model = earlier.placed, answer.without(number), answer.model
        if earlier.given or earlier.beside == named(others):
            continue
        for simple, alone in {simple: fit for simple, fit in rows if rich.generalises(simple)}.items():
            starts = [start_between(simple, alone, rich, model), {**model.values, **own_values(simple, alone)}]
            fit = table.fit([*others, simple], starts, model, model)
            if fit is not None and table.lawful(fit):
                yield answer.exchanged(number, simple, fit, earlier.found)


# ---- drop ------------------------------------------------------------------------------------------------------------


def drop(table: FitTable, answer: Answer) -> Iterator[Answer]:
    """Yield answers without one of the earlier effects: a later one may have made it needless."""
    for number, _ in answer.earlier:
        fit = table.fit(answer.without(number), [answer.model.values], answer.model, answer.model)
        if fit is not None and table.lawful(fit, answer.model):
            yield answer.dropped(number, fit)
