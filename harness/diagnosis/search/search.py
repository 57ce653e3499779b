"""The search: from the nominal model by moves to the answer that none of them betters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.moves import (
    add,
    best_of,
    climbed,
    drop,
    exchange,
    exchange_contradicted,
    expanded,
    generalise_earlier,
    pair,
    preferred,
    second_friction,
    specialise,
)
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Answer, FitTable, Say, silent
from harness.diagnosis.search.ties import asked_again, tie_set_of_last, unknown_parts
from harness.effects.effect import Placed


def search(
    form: Form,
    nominal: Fit,
    candidates: Sequence[Placed],
    *,
    policy: Policy = POLICY,
    say: Say = silent,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
    begun: Outcome | None = None,
    given: Sequence[Placed] = (),
    lost: Callable[[Fit], bool] = lambda fit: False,
) -> Outcome:
    """Find the effects that a model lacks.

    Parameters
    ----------
    form : Form
    nominal : Fit
        Of the nominal model.
    candidates : sequence of Placed
    policy : Policy
    say : callable
        Told what is done.
    sizes : mapping, optional
        Sizes of the data by port, for what laws that refine others start from.
    begun : Outcome, optional
        What was found before, to go on from.
    given : sequence of Placed
        Effects that are part of the answer, whatever their evidence.
    lost : callable
        True of a model on which nothing is built: the search ends with a first effect that leaves it so.

    Returns
    -------
    Outcome
    """
    table = FitTable(form, nominal, candidates, policy, say, sizes or {}, rounds=list(begun.rounds) if begun else [])
    answer = table.given(given) if begun is None else Answer(begun.model, begun.accepted)
    paired = bool(given)  # a pair would be one in the place of what is given
    while len(answer.accepted) < policy.most + len(given):
        answer = expanded(table, answer)
        better = _step(table, answer)
        if lost((better or answer).model):
            ended = better or answer
            return Outcome(form, table.nominal, ended.model, ended.accepted, tuple(table.rounds))
        if better is not None:
            better = climbed(table, climbed(table, better, exchange), drop)
        if not paired and (better is None or len(table.rounds) > 1):
            so_far, paired = better or answer, True
            better = best_of(table, so_far, pair(table, so_far)) or better
        if better is None:
            break
        answer = better
    answer = climbed(table, answer, specialise, simpler=True)
    answer = unknown_parts(table, asked_again(table, answer))
    return Outcome(form, table.nominal, answer.model, answer.accepted, tuple(table.rounds))


def _step(table: FitTable, answer: Answer) -> Answer | None:
    """Return the best answer that one move away from another betters it; None where none does.

    A second friction at a joint only imitates what one law is, and keeps no refinement of the first from its place. An
    exchange is taken where it ties with what is added: it is one effect less.
    """
    added = [*add(table, answer)]
    clear = [one for one in added if not second_friction(one)]
    trials = [*exchange_contradicted(table, answer)]
    if not added or added[0] not in clear:
        trials += generalise_earlier(table, answer)
    best = best_of(table, answer, trials)
    if best is not None and all(preferred(table, best, one) for one in clear):
        return best
    return tie_set_of_last(table, added[0]) if added else None
