"""The rounds of the search: score test, refits of the leaders, the best one that passes, and so on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from harness.diagnosis.policy import EFFORT, POLICY, Policy
from harness.diagnosis.search.compare import Judged, judged
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.grown import grow
from harness.diagnosis.search.outcome import Outcome, Round
from harness.diagnosis.search.refits import Say, polished, refitted
from harness.diagnosis.search.refusal import OF_ESTIMATION_AND_VALIDATION, Kind, only
from harness.diagnosis.search.revised import (
    contradictions,
    displace,
    exchange,
    mark_parts,
    prune,
    refinements,
    second_friction,
    simplify,
    tried_pairs,
)
from harness.diagnosis.search.score_test import score_test
from harness.diagnosis.search.ties import (
    Accepted,
    asked_again,
    held,
    tie_set,
    tied,
    total,
    value,
)
from harness.effects.effect import Placed

__all__ = ["search"]


def search(
    form: Form,
    nominal: Fit,
    candidates: Sequence[Placed],
    *,
    policy: Policy = POLICY,
    say: Say = lambda text: None,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
    begun: Outcome | None = None,
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

    Returns
    -------
    Outcome
    """
    outcome = Outcome(nominal, nominal, laws=form.laws) if begun is None else begun
    while len(outcome.accepted) < policy.most:
        base = outcome.model
        present = {str(placed) for placed in base.effects}
        untried = [placed for placed in candidates if str(placed) not in present]
        laws = [placed for placed in untried if not placed.effect.grows]
        test = score_test(form, base, laws, policy)
        fits, left = refitted(form, base, nominal, test, laws, policy, say)
        grow(form, fits, base, untried, sizes or {}, policy, say)
        better = polished(form, base, [fit for fit in fits.values() if fit is not None])
        if better is not base:  # nothing is compared with a model that is not at its maximum
            nominal = better if base is nominal else nominal
            base = outcome.model = better
        rows = [judged([placed], fit, base, nominal, policy) for placed, fit in fits.items()]
        rows = _ended(form, rows, base, nominal, policy)
        outcome.rounds.append(Round(base, test.with_shown(_shown(rows, policy)), tuple(rows), left))
        passed = [row for row in rows if row.passed]
        best = _answer(passed, policy) if passed else None
        trials = contradictions(form, outcome, rows, policy)
        if best is None or second_friction(base, best):
            trials += refinements(form, outcome, untried, sizes or {}, policy, say)
        displaced = displace(outcome, trials, rows, nominal, policy)
        if best is not None and not displaced:
            rivals = [*rows, *held(form, best, rows, base, nominal, policy)]
            _accept(outcome, best, tie_set(best, rivals, form.laws, policy))
        if len(outcome.accepted) > 1 and (passed or displaced):
            exchange(form, outcome, nominal, policy)
            prune(form, outcome, policy)
        alone = len(outcome.rounds) == 1 and not passed
        if alone or (len(outcome.rounds) == 2 and outcome.accepted):
            tried_pairs(form, outcome, nominal, candidates, policy, say)
        if not (passed or displaced):
            break
    outcome.nominal = nominal
    rows = [row for past in outcome.rounds for row in past.candidates]
    simplify(form, outcome, rows, policy)
    outcome.accepted = asked_again(form, outcome.model, outcome.accepted, rows, nominal, policy)
    mark_parts(form, outcome, policy)
    return outcome


def _ended(form: Form, rows: Sequence[Judged], base: Fit, nominal: Fit, policy: Policy) -> list[Judged]:
    """Return candidates of which those go to their end that nothing speaks against but that they have not come there.

    Only those that would be the answer or tie with it: both uses decide that, and a fit is left by one of them. What
    explains the estimation records far better than they do, and is refused by the validation records alone, is tried on
    these once more from where it ended: they may have been started badly.
    """
    found = list(rows)
    again: set[int] = set()
    for _ in range(EFFORT.onward):
        best = max((row for row in found if row.passed), key=total, default=None)
        waiting = [
            number
            for number, row in enumerate(found)
            if row.fit is not None
            and (
                (_only_unfinished(row) and (best is None or tied(best, row, policy)))
                or (number not in again and _refused_by_validation_alone(row, best, policy))
            )
        ]
        for number in waiting:
            row = found[number]
            assert row.fit is not None
            fit = form.fit(row.fit.effects, [row.fit.values], row.fit)
            if fit is not None and (row.fit.beyond or not row.fit.converged or value(fit) > value(row.fit)):
                found[number] = judged(row.added, fit, base, nominal, policy)
        again |= {*waiting}
        if not waiting:
            break
    return found


def _only_unfinished(row: Judged) -> bool:
    """Return True for a candidate that nothing speaks against but that its fit has not come to its end."""
    return bool(row.refusals) and only(row.refusals, {Kind.STOPPED, Kind.UNCONVERGED})


def _refused_by_validation_alone(row: Judged, best: Judged | None, policy: Policy) -> bool:
    """Return True for what the estimation records are far surer of than of any answer, and the others refuse."""
    if row.comparison is None or not row.refusals:
        return False
    known = 0.0 if best is None or best.comparison is None else best.comparison.evidence
    return row.comparison.evidence > known + policy.misfit_gain and only(row.refusals, OF_ESTIMATION_AND_VALIDATION)


def _shown(rows: Sequence[Judged], policy: Policy) -> set[str]:
    """Return what a refit has shown, whatever the score test said of it."""
    clear = [row for row in rows if row.comparison is not None and row.comparison.evidence >= policy.evidence]
    return {str(row.added[0]) for row in clear}


def _accept(outcome: Outcome, best: Judged, tie: tuple[tuple[Placed, ...], ...]) -> None:
    """Take a candidate into the model."""
    assert best.fit is not None
    assert best.comparison is not None
    outcome.model = best.fit
    beside = frozenset(str(accepted.placed) for accepted in outcome.accepted)
    gains = best.comparison.evidence, best.comparison.validation
    outcome.accepted.append(Accepted(best.added[-1], tie, *gains, beside, len(outcome.rounds) - 1))


def _answer(passed: Sequence[Judged], policy: Policy) -> Judged:
    """Return the best candidate, or a simpler one that ties with it and is a special case of it."""
    best = max(passed, key=total)
    for row in sorted(passed, key=lambda row: row.fit.count if row.fit else 0):
        special = row.added[0].effect.name in best.added[0].effect.nests and row.added[0].at == best.added[0].at
        if special and tied(best, row, policy):
            return row
    return best
