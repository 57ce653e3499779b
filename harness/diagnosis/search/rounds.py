"""The rounds of the search: score test, refits of the leaders, the best one that passes, and so on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from harness.diagnosis.policy import EFFORT, POLICY, Policy
from harness.diagnosis.search.compare import (
    BEYOND,
    UNCONVERGED,
    Judged,
    compared,
    difference,
    impossible,
    judged,
    pays,
    violations,
    wrong_signs,
)
from harness.diagnosis.search.fit import Begun, Fit, Form
from harness.diagnosis.search.grown import grow
from harness.diagnosis.search.score_test import Lead, ScoreTest, score_test
from harness.diagnosis.search.ties import (
    WANTS,
    Accepted,
    asked_again,
    close,
    held,
    own_values,
    physical,
    tie_set,
    tied,
    total,
    typical_elsewhere,
    value,
)
from harness.effects import family, nested
from harness.effects.effect import Placed

__all__ = ["Outcome", "Round", "in_its_place", "search"]

Say = Callable[[str], None]
Passes = Callable[[Placed, Fit], bool]


@dataclass(frozen=True, eq=False)
class Round:
    """One round: the score test beside a model, the refits that followed, and what was begun and left."""

    base: Fit
    test: ScoreTest
    candidates: tuple[Judged, ...]
    left: frozenset[str] = frozenset()


@dataclass(eq=False)
class Outcome:
    """What a search found: the nominal fit at its maximum, the model with the accepted effects, and the way there."""

    nominal: Fit
    model: Fit
    accepted: list[Accepted] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    withdrawn: list[Accepted] = field(default_factory=list)
    """Effects that the likelihood prefers and that were taken back."""

    def unlawful(self, policy: Policy = POLICY) -> Judged | None:
        """Return the rival that explains the records best, if its law forbids its values and the answer is worse.

        Where one is, the answer is the best of the laws that were allowed, and not the law of the plant. What has the
        answer in it, as a special case of a law or beside others, is no rival of it, unless it is a further effect that
        nothing but its law speaks against.
        """
        best: tuple[float, Judged] | None = None
        answer = {str(placed) for placed in self.model.effects}
        for base, rival in ((past.base, row) for past in self.rounds for row in past.candidates):
            if rival.fit is None:
                continue
            forbidden = [
                text
                for placed in rival.added
                for text in (*wrong_signs(placed, rival.fit.values), *violations(placed, rival.fit))
            ]
            if not forbidden:
                continue
            if answer <= _contained(rival.fit.effects) and not _asked_for(rival, base, answer, forbidden, policy):
                continue
            gap = compared(rival.fit, self.model, policy).total
            _, error = difference(rival.fit, self.model, ("estimation", "validation"), policy)
            if gap > max(policy.tie, policy.tie_z * error) and (best is None or gap > best[0]):
                best = gap, rival
        return None if best is None else best[1]

    def promised(self, policy: Policy = POLICY) -> Judged | None:
        """Return the likeliest rival of the answer that nothing but its own fit or law speaks against, if any.

        The data prefer it by all that is asked of an effect: it is no answer, and without it something is missing.
        """
        asked = (*WANTS, "amplitude and phase", "beside it")
        rows = [row for row in self.rounds[-1].candidates if row.fit is not None and row.reasons]
        held = [
            row
            for row in rows
            if not any(text.startswith(asked) for text in row.reasons) or _sure_where_fitted(row, policy)
        ]
        best = max(held, key=total, default=None)
        if best is None or best.fit is None or best.fit.change(best.added[0]) < policy.least:
            return None
        return best

    def withdraw(self, reason: str) -> None:
        """Take all effects back; the reason stands beside them in the rounds that accepted them."""
        names = {str(accepted.placed) for accepted in self.accepted}
        self.rounds = [
            replace(past, candidates=tuple(
                replace(row, reasons=(*row.reasons, reason))
                if row.passed and row.name in names else row
                for row in past.candidates
            )) for past in self.rounds
        ]  # fmt: skip
        self.withdrawn, self.accepted, self.model = self.accepted, [], self.nominal


def search(
    form: Form,
    nominal: Fit,
    candidates: Sequence[Placed],
    *,
    policy: Policy = POLICY,
    say: Say = lambda text: None,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
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

    Returns
    -------
    Outcome
    """
    outcome = Outcome(nominal, nominal)
    while len(outcome.accepted) < policy.most:
        base = outcome.model
        present = {str(placed) for placed in base.effects}
        untried = [placed for placed in candidates if str(placed) not in present]
        laws = [placed for placed in untried if not placed.effect.grows]
        test = score_test(form, base, laws, policy)
        fits, left = _refitted(form, base, nominal, test, laws, policy, say)
        grow(form, fits, base, untried, sizes or {}, policy, say)
        better = _polished(form, base, [fit for fit in fits.values() if fit is not None])
        if better is not base:  # nothing is compared with a model that is not at its maximum
            nominal = better if base is nominal else nominal
            base = outcome.model = better
        rows = [judged([placed], fit, base, nominal, policy) for placed, fit in fits.items()]
        rows = _ended(form, rows, base, nominal, policy)
        outcome.rounds.append(Round(base, test.with_shown(_shown(rows, policy)), tuple(rows), left))
        passed = [row for row in rows if row.passed]
        if passed:
            best = _answer(passed, policy)
            _accept(outcome, best, tie_set(best, [*rows, *held(form, best, rows, base, nominal, policy)], policy))
        if len(outcome.accepted) > 1 and passed:
            _exchange(form, outcome, nominal, policy)
            _pruned(form, outcome, policy)
        alone = len(outcome.rounds) == 1 and not passed
        if alone or (len(outcome.rounds) == 2 and outcome.accepted):
            _pairs(form, outcome, nominal, candidates, policy, say)
        if not passed:
            break
    outcome.nominal = nominal
    rows = [row for past in outcome.rounds for row in past.candidates]
    _simplified(form, outcome, rows, policy)
    outcome.accepted = asked_again(form, outcome.model, outcome.accepted, rows, nominal, policy)
    return outcome


def _sure_where_fitted(row: Judged, policy: Policy) -> bool:
    """Return True for a candidate beyond doubt where it was fitted, of which the validation records show nothing."""
    if row.comparison is None or row.comparison.evidence < policy.misfit_gain:
        return False
    return all(text.startswith("validation gains") for text in row.reasons) and row.comparison.validation > 0.0


def _ended(form: Form, rows: Sequence[Judged], base: Fit, nominal: Fit, policy: Policy) -> list[Judged]:
    """Return candidates of which those go to their end that nothing speaks against but that they have not come there.

    Only those that would be the answer or tie with it: both uses decide that, and a fit is left by one of them.
    """
    found = list(rows)
    for _ in range(EFFORT.onward):
        best = max((row for row in found if row.passed), key=total, default=None)
        waiting = [
            number
            for number, row in enumerate(found)
            if row.fit is not None
            and row.reasons in ((BEYOND,), (UNCONVERGED,))
            and (best is None or tied(best, row, policy))
        ]
        for number in waiting:
            row = found[number]
            assert row.fit is not None
            again = form.fit(row.fit.effects, [row.fit.values], row.fit)
            found[number] = row if again is None else judged(row.added, again, base, nominal, policy)
        if not waiting:
            break
    return found


def _shown(rows: Sequence[Judged], policy: Policy) -> set[str]:
    """Return what a refit has shown, whatever the score test said of it."""
    clear = [row for row in rows if row.comparison is not None and row.comparison.evidence >= policy.evidence]
    return {str(row.added[0]) for row in clear}


def _asked_for(row: Judged, base: Fit, answer: set[str], forbidden: Sequence[str], policy: Policy) -> bool:
    """Return True for a candidate beside a whole answer that would be accepted if its law allowed its values.

    One whose fit has not come to its end is as likely as it is at least. With exact sensors the data are sure of the
    rounded corners of the answer too, and of the step of the engine that wrote them: what other parameters cannot do as
    well must be a part of what the answer changes.
    """
    assert row.fit is not None
    beside = answer == {str(placed) for placed in row.fit.effects} - {str(placed) for placed in row.added}
    rest = set(row.reasons) - {*forbidden, UNCONVERGED}
    if not beside or rest or row.fit.change(row.added[0]) < policy.least:
        return False
    whole = max((base.change(placed) for placed in base.effects), default=0.0)
    return row.fit.distance(base) >= policy.second_share * whole


def _contained(effects: Sequence[Placed]) -> set[str]:
    """Return the effects with their special cases."""
    return {
        f"{name}@{placed.at}" for placed in effects for name in (placed.effect.name, *map(str, nested(placed.effect)))
    }


def _accept(outcome: Outcome, best: Judged, tie: tuple[tuple[Placed, ...], ...]) -> None:
    """Take a candidate into the model."""
    assert best.fit is not None
    assert best.comparison is not None
    outcome.model = best.fit
    beside = frozenset(str(accepted.placed) for accepted in outcome.accepted)
    outcome.accepted.append(Accepted(best.added[-1], tie, best.comparison.evidence, best.comparison.validation, beside))


def _refitted(
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
            if other is None or (fit is not None and _as_good(fit, other, contains=mine is rich)):
                continue
            start = dict(other.values)
            for parameter in mine.effect.parameters:
                if parameter.name in theirs.effect.parameter_names:
                    start[mine.name(parameter.name)] = other.values[theirs.name(parameter.name)]
                elif fit is not None:
                    start[mine.name(parameter.name)] = fit.values[mine.name(parameter.name)]
            again = form.fit([*base.effects, mine], [start], other, _best(fits, mine, passes))
            if again is not None and (fit is None or value(again) > value(fit)):
                fits[mine] = again


def _as_good(fit: Fit, other: Fit, *, contains: bool) -> bool:
    """Return True if a fit has nothing to learn from where another ended; a law that contains it may not be worse."""
    if contains:
        return fit.log_likelihood("estimation") > other.log_likelihood("estimation") - 1.0
    return value(fit) > value(other) - 1.0


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


def _polished(form: Form, base: Fit, fits: Sequence[Fit]) -> Fit:
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


def _answer(passed: Sequence[Judged], policy: Policy) -> Judged:
    """Return the best candidate, or a simpler one that ties with it and is a special case of it."""
    best = max(passed, key=total)
    for row in sorted(passed, key=lambda row: row.fit.count if row.fit else 0):
        special = row.added[0].effect.name in best.added[0].effect.nests and row.added[0].at == best.added[0].at
        if special and tied(best, row, policy):
            return row
    return best


def _pairs(form: Form, outcome: Outcome, nominal: Fit, candidates: Sequence[Placed], policy: Policy, say: Say) -> None:
    """Try the best rivals of the first answer to their end and with a second effect: one law may stand in for two.

    What was tried beside the answer and is impossible there is not tried beside what is like it. Each of a pair has to
    pass beside the other, as if it had been found last.
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
        and (physical(row) or row.reasons == (BEYOND,))
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
            if outcome.accepted and total(rival) + 2 * lead.penalised < so_far + policy.tie:  # both uses gain alike
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
    if best is None or total(best) < so_far + policy.tie:
        return
    assert best.fit is not None
    assert best.comparison is not None
    each = best.comparison.evidence / len(best.added), best.comparison.validation / len(best.added)
    outcome.model = best.fit
    outcome.accepted = [Accepted(placed, _alike(placed, outcome.rounds[0]), *each) for placed in best.added]


def _alone(form: Form, outcome: Outcome, placed: Placed, pair: Fit, nominal: Fit) -> Fit:
    """Return the fit of the second of a pair without the first; the nominal one where it has none."""
    known = [row.fit for row in outcome.rounds[0].candidates if row.added == (placed,)]
    done = [fit for fit in known if fit is not None and fit.converged]
    return (done[0] if done else form.fit([placed], [pair.values], nominal)) or nominal


def _alike(placed: Placed, past: Round) -> tuple[tuple[Placed, ...], ...]:
    """Return an effect and what may be tied with it: what is like it, at its place, and was refitted in a round."""
    names = {placed.effect.name, *family(placed.effect).near}
    near = [row.added[0] for row in past.candidates if row.added[0].effect.name in names and typical_elsewhere(row)]
    return ((placed,), *((other,) for other in near if other.at == placed.at and other != placed))


def _exchange(form: Form, outcome: Outcome, nominal: Fit, policy: Policy) -> None:
    """Try the rivals of earlier effects again beside the last one: the first answer may have stood in for two."""
    for number, earlier in enumerate(outcome.accepted[:-1]):
        if number >= len(outcome.rounds):
            continue
        others = [accepted.placed for k, accepted in enumerate(outcome.accepted) if k != number]
        rivals = [
            row
            for row in outcome.rounds[number].candidates
            if row.fit is not None and row.comparison is not None and row.comparison.evidence > policy.evidence
        ]
        best, placed = outcome.model, earlier.placed
        for row in sorted(rivals, key=lambda row: -total(row))[: EFFORT.pairs + 1]:
            new = row.added[0]
            if str(new) in {str(placed) for placed in outcome.model.effects}:
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
            tie = tuple(dict.fromkeys([(placed,), *earlier.tie, *_alike(placed, outcome.rounds[number])]))
            outcome.accepted[number] = Accepted(placed, tie, earlier.evidence, earlier.validation)


def _pruned(form: Form, outcome: Outcome, policy: Policy) -> None:
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


def _simplified(form: Form, outcome: Outcome, rows: Sequence[Judged], policy: Policy) -> None:
    """Take a special case of an earlier law where it ties beside what was accepted later, as among the first answers.

    What was general alone may have been so for what a later effect explains.
    """
    for number, earlier in enumerate(outcome.accepted[:-1]):
        rich, model = earlier.placed, outcome.model
        others = [placed for placed in model.effects if str(placed) != str(rich)]
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
                outcome.accepted[number] = Accepted(simple, tie, earlier.evidence, earlier.validation)
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
