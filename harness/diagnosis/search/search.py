"""The search: from the nominal model by moves to the answer that none of them betters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.moves import (
    add,
    add_two,
    drop,
    exchange,
    exchange_contradicted,
    expanded,
    generalise_earlier,
    preferred,
    second_friction,
    specialise,
)
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Answer, Round, Say, Table, silent, value
from harness.diagnosis.search.ties import asked_again, tie_set_of_last, unknown_parts
from harness.diagnosis.search.warm import settled
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
    table = Table(form, nominal, candidates, policy, say, sizes or {}, rounds=list(begun.rounds) if begun else [])
    answer = table.given(given) if begun is None else Answer(begun.model, begun.accepted)
    paired = bool(given)  # a pair would be one in the place of what is given
    while len(answer.accepted) < policy.most + len(given):
        past = expanded(table, answer.model)
        answer = Answer(past.base, answer.accepted)
        better = _step(table, answer, past)
        if lost((better or answer).model):
            ended = better or answer
            return Outcome(form, table.nominal, ended.model, ended.accepted, tuple(table.rounds))
        if better is not None and len(better.accepted) > 1:
            better = drop(table, exchange(table, better))
        if not paired and (better is None or len(table.rounds) > 1):
            better, paired = add_two(table, better or answer) or better, True
        if better is None:
            break
        answer = better
    answer = specialise(table, answer)
    answer = replace(answer, model=settled(table, answer.model))
    answer = unknown_parts(table, asked_again(table, answer))
    return Outcome(form, table.nominal, answer.model, answer.accepted, tuple(table.rounds))


def _step(table: Table, answer: Answer, past: Round) -> Answer | None:
    """Return the best answer that one move away from another betters it; None where none does.

    A second friction at a joint only imitates what one law is, and keeps no refinement of the first from its place. An
    exchange is taken where it ties with what is added: it is one effect less.
    """
    found = add(table, answer, past)
    trials = [*exchange_contradicted(table, answer, past)]
    if found is None or second_friction(answer.model, found[0]):
        trials += generalise_earlier(table, answer)
    trials = [trial for trial in trials if preferred(table, trial, answer)]
    best = max(trials, key=lambda trial: value(trial.model), default=None)
    rivals = [row.fit for row in past.candidates if row.passed and not second_friction(answer.model, row)]
    if best is not None and all(fit is None or value(best.model) > value(fit) - table.policy.tie for fit in rivals):
        return best
    return None if found is None else tie_set_of_last(table, found[1], past, found[0])
