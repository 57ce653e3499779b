"""The moves of the search from an answer to others: an effect is added, exchanged, specialised or dropped.

A move fits sets of effects into the table and returns the answers among them that stand. Which of these is taken, one
function tells: :func:`preferred`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import Policy
from harness.diagnosis.search.compare import Judged, difference, wrong_signs
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.generalised import generalise, generalised, refined_twice
from harness.diagnosis.search.race import raced
from harness.diagnosis.search.refusal import Kind, Refusal, only
from harness.diagnosis.search.scores import Lead, score_test
from harness.diagnosis.search.table import Accepted, Answer, Round, Table, named, value
from harness.diagnosis.search.ties import alike, physical, tied, total
from harness.diagnosis.search.warm import own_values, polished, start_between
from harness.diagnosis.stand_in import same_whole
from harness.effects.effect import Placed


def preferred(table: Table, new: Answer, old: Answer, *, simpler: bool = False) -> bool:
    """Return True if one answer is to take the place of another: the rule of all moves.

    Every effect more must bring the evidence that is asked of one, an exchange more than a tie, and an effect less may
    cost no more than a tie. A special case of a law takes its place where the data do not tell the two apart,
    and where the law adds less than the share of a further effect: then it is the corner of the special case.
    """
    policy, more = table.policy, len(new.accepted) - len(old.accepted)
    asked = 2 * policy.evidence * more if more > 0 else policy.tie if more == 0 else -policy.tie
    if simpler:
        _, error = difference(old.model, new.model, ("estimation", "validation"), policy)
        asked = -max(policy.tie, policy.tie_z * error, _corner(table, old.model))
    return value(new.model) > value(old.model) + asked


def _corner(table: Table, fit: Fit) -> float:
    """Return what a law may bring more than a special case and be no other law: a share of what all effects bring."""
    return table.policy.second_share * (value(fit) - value(table.nominal))


# ---- add -------------------------------------------------------------------------------------------------------------


def expanded(table: Table, base: Fit) -> Round:
    """Fit a set with each effect more that promises something; the set itself is at its maximum then."""
    present = named(base.effects)
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
    return past


def add(table: Table, answer: Answer, past: Round) -> tuple[Judged, Answer] | None:
    """Return the best candidate beside an answer, or the simplest that ties with it.

    Of its special cases, and of the other laws of what it is the whole law of: dry friction at the same place.
    """
    passed = [row for row in past.candidates if row.passed]
    if not passed:
        return None
    best = max(passed, key=total)
    for row in sorted(passed, key=lambda row: (row.fit.count if row.fit else 0, -total(row))):
        first, other = best.added[0], row.added[0]
        special, fit = first.generalises(other), best.fit
        tie = tied(best, row, table.policy) and (special or same_whole(first, other))
        if tie or (special and fit is not None and total(best) - total(row) < _corner(table, fit)):
            return row, answer.added(row, len(table.rounds) - 1)
    return best, answer.added(best, len(table.rounds) - 1)


def _ended(table: Table, rows: Sequence[Judged], base: Fit) -> list[Judged]:
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


def add_two(table: Table, answer: Answer) -> Answer | None:
    """Return the best pair in the place of a first answer: one law may stand in for two.

    Its best rivals go to their end, and get a second effect. Each of a pair has to pass beside the other, as if it had
    been found last.
    """
    best: Answer | None = None
    for rival in _rivals(table, answer):
        fit = rival.fit
        if fit is not None and fit.beyond:  # alone it had no hope: beside another it may
            fit = table.fit(fit.effects, [fit.values], fit)
            best = _better(table, best, [table.judged(rival.added, fit)])
        if fit is None:
            continue
        for lead in _second(table, answer, rival, fit):
            table.say(f"{rival.added[0]} + {lead.placed}")
            starts = [{**fit.values, **start} for start in lead.starts]
            pair = table.fit([*fit.effects, lead.placed], starts, fit)
            best = _better(table, best, _pair(table, rival.added[0], lead.placed, pair, fit, best))
    return best if best is not None and preferred(table, best, answer) else None


def _rivals(table: Table, answer: Answer) -> list[Judged]:
    """Return the likeliest candidates of the first round that may be one of two; what refines others comes later."""
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
    return sorted(rows, key=lambda row: -total(row))[: EFFORT.pairs]


def _second(table: Table, answer: Answer, rival: Judged, fit: Fit) -> Iterator[Lead]:
    """Yield what may be the second of a pair: its column promises enough of what the pair would need."""
    policy = table.policy
    ruled_out = {str(row.added[0]) for past in table.rounds[1:] for row in past.candidates if not physical(row)}
    tried = {*named(fit.effects), *ruled_out}
    others = [placed for placed in table.candidates if not placed.effect.grows and str(placed) not in tried]
    leads = [lead for lead in score_test(table.form, fit, others, policy).leads if lead.share >= policy.clear]
    needed = value(answer.model) - value(table.nominal) + 2 * policy.evidence - total(rival)
    for lead in leads[:2]:
        if not answer.accepted or 2 * lead.penalised / policy.reach >= needed:  # both uses gain alike, at first order
            yield lead


def _pair(
    table: Table, first: Placed, second: Placed, pair: Fit | None, alone: Fit, best: Answer | None
) -> list[Judged]:
    """Return a pair, judged, if each of the two passes beside the other."""
    whole = table.judged([first, second], pair)
    if pair is None or not (whole.passed and table.judged([second], pair, alone).passed):
        return []
    if best is not None and value(pair) <= value(best.model):
        return []
    other = table.best([second])
    if other is None or not other.converged:
        other = table.fit([second], [pair.values], table.nominal) or table.nominal
    return [whole] if table.judged([first], pair, other).passed else []


def _better(table: Table, best: Answer | None, rows: Sequence[Judged]) -> Answer | None:
    """Return the best of an answer and others that pass, each effect of several with its part of the evidence."""
    for row in rows:
        if row.fit is None or row.comparison is None or not row.passed:
            continue
        if best is not None and value(row.fit) <= value(best.model):
            continue
        each = row.comparison.evidence / len(row.added), row.comparison.validation / len(row.added)
        best = Answer(row.fit, tuple(
            Accepted(placed, ((placed,), *alike(placed, table.rounds[0], table.laws)), *each, found=number)
            for number, placed in enumerate(row.added)
        ))  # fmt: skip
    return best


# ---- exchange, generalise, specialise --------------------------------------------------------------------------------


def second_friction(base: Fit, best: Judged) -> bool:
    """Return True for a law of what a place has a whole law of already: a second dry friction at a joint."""
    return any(same_whole(best.added[-1], placed) for placed in base.effects)


def exchange_contradicted(table: Table, answer: Answer, past: Round) -> Iterator[Answer]:
    """Yield answers with a candidate in the place of an earlier effect that is no law beside it.

    Signs that a law does not have show two effects that do the same.
    """
    base = answer.model
    for row in sorted(past.candidates, key=lambda row: -total(row))[: EFFORT.pairs + 1]:
        if row.fit is None or row.comparison is None or row.comparison.evidence < table.policy.evidence:
            continue
        new = row.added[0]
        for number, earlier in enumerate(answer.accepted):
            if earlier.given:
                continue
            if wrong_signs(earlier.placed, row.fit.values):
                fit = table.fit([*answer.without(number), new], [row.fit.values], base, base)
                if fit is not None and table.judged([new], fit).passed:
                    yield answer.exchanged(number, new, fit, len(table.rounds) - 1)


def generalise_earlier(table: Table, answer: Answer) -> Iterator[Answer]:
    """Yield answers with what refines an earlier effect in its place; one alone was refined when it was found."""
    for number, earlier in answer.earlier:
        for rich, fit in generalised(table, answer.model, earlier.placed):
            if table.judged([rich], fit).passed:
                yield answer.exchanged(number, rich, fit, len(table.rounds) - 1)


def exchange(table: Table, answer: Answer) -> Answer:
    """Return an answer in which rivals of earlier effects took their places: the first may have stood in for two."""
    for number, earlier in answer.earlier:
        if earlier.found >= len(table.rounds):
            continue
        past, best = table.rounds[earlier.found], answer
        rivals = [
            row
            for row in past.candidates
            if row.fit is not None and row.comparison is not None and row.comparison.evidence > table.policy.evidence
        ]
        for row in sorted(rivals, key=lambda row: -total(row))[: EFFORT.pairs + 1]:
            trial = _exchanged(table, answer, number, row, best.model)
            if trial is not None and preferred(table, trial, best):
                best = trial
        if best is not answer:
            changed = best.accepted[number]
            tie = dict.fromkeys([*changed.tie, *alike(changed.placed, past, table.laws)])
            changed = replace(changed, tie=tuple(tie))
            answer = Answer(best.model, (*best.accepted[:number], changed, *best.accepted[number + 1 :]))
    return answer


def _exchanged(table: Table, answer: Answer, number: int, row: Judged, best: Fit) -> Answer | None:
    """Return an answer with a rival in the place of an effect, if its first steps may lead it to the best one."""
    new, model, others = row.added[0], answer.model, answer.without(number)
    if str(new) in named(model.effects) or refined_twice([*others, new]):
        return None
    assert row.fit is not None
    # nominal parameters as they are beside the effect that would go, and as they were beside its rival
    starts = [{**model.values, **values} for values in (own_values(new, row.fit), row.fit.values)]
    hope = best.log_likelihood("estimation") - EFFORT.margin
    begun = table.begin([*others, new], starts, model, hope)
    if begun is None or begun.log_likelihood < hope:
        return None
    fit = table.finish(begun, model, best)
    if fit is None or not table.judged([new], fit).passed:
        return None
    return answer.exchanged(number, new, fit, answer.accepted[number].found)


def specialise(table: Table, answer: Answer) -> Answer:
    """Return an answer with special cases in the place of laws where the data do not tell the two apart.

    Asked of a law beside what did not stand beside it when it was accepted: what was general there may have been so for
    what another effect explains.
    """
    rows = [row for past in table.rounds for row in past.candidates if row.fit is not None]
    for number, earlier in enumerate(answer.accepted):
        rich, others = earlier.placed, answer.without(number)
        if earlier.given or earlier.beside == named(others):
            continue
        special = {row.added[0]: row.fit for row in rows if rich.generalises(row.added[0])}
        for simple, alone in special.items():
            assert alone is not None
            model = answer.model
            starts = [start_between(simple, alone, rich, model), {**model.values, **own_values(simple, alone)}]
            fit = table.fit([*others, simple], starts, model, model)
            trial = answer.exchanged(number, simple, fit, earlier.found) if fit and table.lawful(fit) else None
            if trial is not None and preferred(table, trial, answer, simpler=True):
                answer = trial
                break
    return answer


# ---- drop ------------------------------------------------------------------------------------------------------------


def drop(table: Table, answer: Answer) -> Answer:
    """Return an answer without the earlier effects that a later one has made needless."""
    for _, earlier in answer.earlier:
        number, model = answer.accepted.index(earlier), answer.model
        left = answer.without(number)
        fit = table.fit(left, [model.values], model, model)
        if fit is not None and table.lawful(fit):
            trial = answer.dropped(number, fit)
            answer = trial if preferred(table, trial, answer) else answer
    return answer
