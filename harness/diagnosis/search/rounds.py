"""The rounds of the search: score test, refits of the leaders, the best one that passes, its ties, and so on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.policy import EFFORT, POLICY, Policy
from harness.diagnosis.search.compare import (
    BEYOND,
    Judged,
    compared,
    difference,
    impossible,
    judged,
    violations,
    wrong_signs,
)
from harness.diagnosis.search.fit import Begun, Fit, Form
from harness.diagnosis.search.score_test import Lead, ScoreTest, score_test
from harness.effects import family, nested
from harness.effects.effect import Placed

__all__ = ["Accepted", "Outcome", "Round", "in_its_place", "search"]

Say = Callable[[str], None]
WANTS = ("evidence", "validation", "it brings", "it changes")
"""How reasons begin that are a want of evidence and nothing against the candidate."""


@dataclass(frozen=True, eq=False)
class Round:
    """One round: the score test beside a model, and the refits that followed."""

    base: Fit
    test: ScoreTest
    candidates: tuple[Judged, ...]


@dataclass(frozen=True, eq=False)
class Accepted:
    """One accepted effect with all that these data cannot tell from it, itself first, and its evidence."""

    placed: Placed
    tie: tuple[tuple[Placed, ...], ...]
    evidence: float
    validation: float


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
        answer in it, as a special case of a law or beside others, is no rival of it.
        """
        best: tuple[float, Judged] | None = None
        answer = {str(one) for one in self.model.effects}
        for one in (candidate for here in self.rounds for candidate in here.candidates):
            if one.fit is None or answer <= _contained(one.fit.effects):
                continue
            if not any(wrong_signs(it, one.fit.values) or violations(it, one.fit) for it in one.added):
                continue
            gap = compared(one.fit, self.model, policy).total
            _, error = difference(one.fit, self.model, ("estimation", "validation"), policy)
            if gap > max(policy.tie, policy.tie_z * error) and (best is None or gap > best[0]):
                best = gap, one
        return None if best is None else best[1]

    def promised(self, policy: Policy = POLICY) -> Judged | None:
        """Return the likeliest rival of the answer that nothing but its own fit or law speaks against, if any.

        The data prefer it by all that is asked of an effect: it is no answer, and without it something is missing.
        """
        asked = (*WANTS, "amplitude and phase", "beside it")
        rows = [one for one in self.rounds[-1].candidates if one.fit is not None and one.reasons]
        held = [one for one in rows if not any(text.startswith(asked) for text in one.reasons)]
        best = max(held, key=_total, default=None)
        if best is None or best.fit is None or best.fit.change(best.added[0]) < policy.least:
            return None
        return best

    def withdraw(self, reason: str) -> None:
        """Take all effects back; the reason stands beside them in the rounds that accepted them."""
        names = {str(one.placed) for one in self.accepted}
        self.rounds = [
            replace(here, candidates=tuple(
                replace(one, reasons=(*one.reasons, reason)) if one.passed and one.name in names else one
                for one in here.candidates
            )) for here in self.rounds
        ]  # fmt: skip
        self.withdrawn, self.accepted, self.model = self.accepted, [], self.nominal


def search(
    form: Form,
    nominal: Fit,
    candidates: Sequence[Placed],
    *,
    policy: Policy = POLICY,
    say: Say = lambda text: None,
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

    Returns
    -------
    Outcome
    """
    found = Outcome(nominal, nominal)
    while len(found.accepted) < policy.most:
        base = found.model
        present = {str(one) for one in base.effects}
        open_ones = [one for one in candidates if str(one) not in present]
        test = score_test(form, base, open_ones, policy)
        fits = _refitted(form, base, test, open_ones, policy, say)
        better = _polished(form, base, [one for one in fits.values() if one is not None])
        if better is not base:  # nothing is compared with a model that is not at its maximum
            nominal = better if base is nominal else nominal
            base = found.model = better
        rows = [judged([placed], fit, base, nominal, policy) for placed, fit in fits.items()]
        found.rounds.append(Round(base, test.with_shown(_shown(rows, policy)), tuple(rows)))
        passed = [one for one in rows if one.passed]
        if passed:
            best = _answer(passed, policy)
            _accept(found, best, _ties(best, rows, policy))
        if len(found.accepted) > 1 and passed:
            _exchange(form, found, nominal, policy)
            _pruned(form, found, policy)
        alone = len(found.rounds) == 1 and not passed
        if alone or (len(found.rounds) == 2 and found.accepted):
            _pairs(form, found, nominal, candidates, policy, say)
        if not passed:
            break
    found.nominal = nominal
    return found


def _shown(rows: Sequence[Judged], policy: Policy) -> set[str]:
    """Return what a refit has shown, whatever the score test said of it."""
    clear = [one for one in rows if one.comparison is not None and one.comparison.evidence >= policy.evidence]
    return {str(one.added[0]) for one in clear}


def _contained(effects: Sequence[Placed]) -> set[str]:
    """Return the effects with their special cases."""
    return {f"{name}@{one.at}" for one in effects for name in (one.effect.name, *map(str, nested(one.effect)))}


def _accept(found: Outcome, best: Judged, tie: tuple[tuple[Placed, ...], ...]) -> None:
    """Take a candidate into the model."""
    assert best.fit is not None
    assert best.comparison is not None
    found.model = best.fit
    found.accepted.append(Accepted(best.added[-1], tie, best.comparison.evidence, best.comparison.validation))


def _refitted(
    form: Form, base: Fit, test: ScoreTest, open_ones: Sequence[Placed], policy: Policy, say: Say
) -> dict[Placed, Fit | None]:
    """Begin the refits of all that promises something; finish those whose first steps keep up with the best."""
    origins: dict[Placed, Fit] = {}
    begun: dict[Placed, Begun | None] = {}
    before = base.log_likelihood("estimation")

    def enough() -> float:  # what is not refitted in the end need not be begun in full
        gains = [one.log_likelihood - before for one in begun.values() if one is not None]
        return max(policy.lead, policy.reach * max(gains, default=0.0))

    for lead in [*chosen(test, policy), *_remembered(form, base, test, open_ones, policy)]:
        say(str(lead.placed))
        origins[lead.placed] = base
        promising = lead.starts if lead.penalised > 0.0 else lead.starts[:1]
        starts = [{**base.values, **one} for one in promising]
        begun[lead.placed] = form.begin([*base.effects, lead.placed], starts, base, before + enough())
    best = max((one for one in begun.values() if one), key=lambda one: one.log_likelihood, default=None)
    for one in form.suspects(base, best, open_ones):
        say(str(one.placed))
        origin = base if one.base is None else one.base
        starts = [{**origin.values, **start} for start in one.starts]
        origins[one.placed] = origin
        begun[one.placed] = form.begin([*base.effects, one.placed], starts, origin, before + enough())
    gains = {placed: one.log_likelihood - before for placed, one in begun.items() if one is not None}
    least = enough()
    penalty = 0.5 * float(np.log(base.samples))

    def needed(one: Placed) -> float:  # nothing is accepted that does not pay for its parameters
        free = sum(not parameter.fixed for parameter in one.effect.parameters)
        return max(least, policy.reach * (policy.evidence + penalty * free))

    def place(one: Placed) -> tuple[bool, float]:  # what no law allows must not take the place of what one does
        first = begun[one]
        assert first is not None
        return bool(wrong_signs(one, first.values)), -gains[one]

    faint = {str(one.placed) for one in (*test.leads, *test.hidden) if one.share < policy.clear}

    def hoped(one: Placed) -> float:  # along a narrow valley the first steps are short
        first = begun[one]
        return gains[one] + (EFFORT.first_steps * first.pace if first and str(one) in faint else 0.0)

    order = sorted((placed for placed in gains if hoped(placed) >= needed(placed)), key=place)
    lawful = sum(not place(one)[0] for one in order)
    order = order[: min(lawful + 1, EFFORT.refits)]  # one law that is not allowed says that none which is explains it
    # what is exactly the same must not lose by its first steps
    same = {name for placed in order[:1] for name in family(placed.effect).exact}
    order += [placed for placed in begun if placed.effect.name in same and placed not in order and begun[placed]]
    fits: dict[Placed, Fit | None] = {}
    for placed in order:
        first = begun[placed]
        assert first is not None
        say(f"{placed} to its maximum")
        fits[placed] = form.finish(first, origins[placed], _best(fits, placed))
    for placed in [
        one
        for one in begun
        if one not in fits
        and any(
            fit is not None and one.at == rich.at and one.effect.name in rich.effect.nests for rich, fit in fits.items()
        )
    ]:  # a law is no answer before its special cases were tried from where it ended
        fits[placed] = None
    _share_starts(form, fits, base)
    _lawful(form, fits, base, {one.placed: one.starts[0] for one in test.leads})
    return fits


def _best(fits: Mapping[Placed, Fit | None], beside: Placed) -> Fit | None:
    """Return the likeliest of the other refits that reached a lawful maximum."""
    done = [one for placed, one in fits.items() if one is not None and one.converged and placed != beside]
    lawful = [one for one in done if not any(impossible(placed, one) for placed in one.effects)]
    return max(lawful, key=lambda one: one.log_likelihood("estimation"), default=None)


def chosen(test: ScoreTest, policy: Policy = POLICY) -> list[Lead]:
    """Return the leads whose refits are begun: those that promise most, and the families of the first two.

    A promise along a column that the nominal parameters take up nearly whole is uncertain, as columns are: some such
    are tried as well. With little noise a thousandth of a column is seen.
    """
    promising = [one for one in (*test.leads, *test.hidden) if one.gain >= policy.lead]
    clear = [one for one in promising if one.share >= policy.clear]
    most = max((one.gain for one in clear), default=0.0)
    clear = [one for one in clear if one.gain >= EFFORT.faintest * most]
    faint = sorted((one for one in promising if one.share < policy.clear), key=lambda one: -one.penalised)
    if not any(one.penalised > 0.0 for one in promising):
        return []
    near: list[Lead] = []
    for leader in clear[:2]:
        names = {leader.placed.effect.name, *family(leader.placed.effect).near}
        near += [one for one in clear if one.placed.effect.name in names and one.placed.at == leader.placed.at]
    ordered = dict.fromkeys([*clear[: EFFORT.refits], *near, *clear])
    return [*list(ordered)[: EFFORT.begun], *faint[: EFFORT.faint]]


def _remembered(form: Form, base: Fit, test: ScoreTest, open_ones: Sequence[Placed], policy: Policy) -> list[Lead]:
    """Return leads that promise something only where the latent force does not remember what it took up."""
    forgetful = form.forgetful(base)
    if forgetful is None:
        return []
    known = {str(one.placed) for one in (*test.leads, *test.hidden) if one.gain >= policy.lead}
    leads = score_test(form, forgetful, [one for one in open_ones if str(one) not in known], policy).leads
    return [one for one in leads if one.penalised > 0.0 and one.share >= policy.clear][: EFFORT.faint]


def _share_starts(form: Form, fits: dict[Placed, Fit | None], base: Fit) -> None:
    """Fit a law and its special cases from each other's ends: no rival loses by a bad start."""
    for rich, simple in [(a, b) for a in fits for b in fits if b.effect.name in a.effect.nests and a.at == b.at]:
        for mine, theirs in ((rich, simple), (simple, rich)):
            fit, other = fits[mine], fits[theirs]
            if other is None or (fit is not None and _value(fit) > _value(other) - 1.0):
                continue
            start = dict(other.values)
            for one in mine.effect.parameters:
                if one.name in theirs.effect.parameter_names:
                    start[mine.name(one.name)] = other.values[theirs.name(one.name)]
                elif fit is not None:
                    start[mine.name(one.name)] = fit.values[mine.name(one.name)]
            again = form.fit([*base.effects, mine], [start], other, _best(fits, mine))
            if again is not None and (fit is None or _value(again) > _value(fit)):
                fits[mine] = again


def _lawful(form: Form, fits: dict[Placed, Fit | None], base: Fit, starts: Mapping[Placed, dict[str, float]]) -> None:
    """Fit a law whose values its own physics forbids once more, from a special case of it and its first start."""
    for rich, simple in [(a, b) for a in fits for b in fits if b.effect.name in a.effect.nests and a.at == b.at]:
        fit, other = fits[rich], fits[simple]
        if fit is None or other is None or rich not in starts or not violations(rich, fit):
            continue
        shared = {one.name for one in simple.effect.parameters if one.nuisance}
        own = {name: value for name, value in starts[rich].items() if name.startswith(f"{rich}.")}
        start = {**other.values, **own}
        start |= {rich.name(name): other.values[simple.name(name)] for name in shared}
        again = form.fit([*base.effects, rich], [start], other)
        if again is not None and not violations(rich, again):
            fits[rich] = again


def _polished(form: Form, base: Fit, fits: Sequence[Fit]) -> Fit:
    """Return the base fitted again from where its best rival ended, if that is better."""
    best = max(fits, key=lambda one: one.penalised, default=None)
    if best is None or best.penalised < base.penalised:
        return base
    begun = form.begin(base.effects, [best.values], best)
    if begun is None or begun.log_likelihood < base.log_likelihood("estimation") - EFFORT.margin:
        return base
    again = form.finish(begun, best)
    better = again is not None and again.penalised > base.penalised + 0.5
    if again is not None and any(impossible(one, again) and not impossible(one, base) for one in base.effects):
        return base  # it was accepted as a law
    return again if again is not None and better and (again.converged or not base.converged) else base


def _answer(passed: Sequence[Judged], policy: Policy) -> Judged:
    """Return the best candidate, or a simpler one that ties with it and is a special case of it."""
    best = max(passed, key=_total)
    for one in sorted(passed, key=lambda c: c.fit.count if c.fit else 0):
        special = one.added[0].effect.name in best.added[0].effect.nests and one.added[0].at == best.added[0].at
        if special and _tied(best, one, policy):
            return one
    return best


def _total(one: Judged) -> float:
    return -np.inf if one.comparison is None else one.comparison.total


def _tied(best: Judged, other: Judged, policy: Policy) -> bool:
    """Return True if the data do not tell two candidates apart."""
    assert best.fit is not None
    if other.fit is None or other.comparison is None:
        return False
    gap = _total(best) - _total(other)
    _, error = difference(best.fit, other.fit, ("estimation", "validation"), policy)
    return gap < max(policy.tie, policy.tie_z * error)


def _ties(best: Judged, rows: Sequence[Judged], policy: Policy) -> tuple[tuple[Placed, ...], ...]:
    """Return the tie set of an answer: what passes, or fails only for a want of evidence, and is as likely.

    A more general law that is as likely stays in it though its values ended outside its own physics: within it, it is
    the answer itself or something beside it.
    """
    tied = [best.added]
    for one in sorted(rows, key=lambda c: -_total(c)):
        if one is best or one.comparison is None or one.comparison.evidence < 0 or one.comparison.total < 0:
            continue
        general = best.added[-1].effect.name in one.added[0].effect.nests and one.added[0].at == best.added[-1].at
        lawless = general and all(text.startswith(("not so", *WANTS)) for text in one.reasons)
        if (_physical(one) or lawless) and _tied(best, one, policy):
            tied.append(one.added)
    return tuple(tied)


def _pairs(form: Form, found: Outcome, nominal: Fit, candidates: Sequence[Placed], policy: Policy, say: Say) -> None:
    """Try the best rivals of the first answer to their end and with a second effect: one law may stand in for two.

    What was tried beside the answer and is impossible there is not tried beside what is like it.
    """
    so_far = compared(found.model, nominal, policy).total
    ruled_out = {str(one.added[0]) for here in found.rounds[1:] for one in here.candidates if not _physical(one)}
    present = {str(one) for one in found.model.effects}
    rivals = [
        one
        for one in found.rounds[0].candidates
        if one.comparison is not None
        and one.comparison.evidence >= policy.evidence
        and str(one.added[0]) not in present
        and (_physical(one) or one.reasons == (BEYOND,))
        and (not found.accepted or _total(one) >= policy.reach * so_far)
    ]
    best: Judged | None = None
    for rival in sorted(rivals, key=lambda one: -_total(one))[: EFFORT.pairs]:
        fit = rival.fit
        if fit is not None and fit.beyond:  # alone it had no hope: beside another it may
            fit = form.fit(fit.effects, [fit.values], fit)
            alone = judged(rival.added, fit, nominal, nominal, policy)
            if alone.passed and (best is None or _total(alone) > _total(best)):
                best = alone
        if fit is None:
            continue
        others = [one for one in candidates if str(one) not in {str(rival.added[0]), *ruled_out}]
        leads = [one for one in score_test(form, fit, others, policy).leads if one.share >= policy.clear]
        for lead in leads[:2]:
            if found.accepted and _total(rival) + 2 * lead.penalised < so_far + policy.tie:  # both uses gain alike
                continue
            say(f"{rival.added[0]} + {lead.placed}")
            pair = form.fit([*fit.effects, lead.placed], [{**fit.values, **one} for one in lead.starts], fit)
            whole = judged([rival.added[0], lead.placed], pair, nominal, nominal, policy)
            second = judged([lead.placed], pair, fit, nominal, policy)
            if whole.passed and second.passed and (best is None or _total(whole) > _total(best)):
                best = whole
    if best is None or _total(best) < so_far + policy.tie:
        return
    assert best.fit is not None
    assert best.comparison is not None
    each = best.comparison.evidence / len(best.added), best.comparison.validation / len(best.added)
    found.model = best.fit
    found.accepted = [Accepted(one, ((one,),), *each) for one in best.added]


def _physical(one: Judged) -> bool:
    """Return True if nothing but a want of evidence speaks against a candidate."""
    return all(text.startswith(WANTS) for text in one.reasons)


def _exchange(form: Form, found: Outcome, nominal: Fit, policy: Policy) -> None:
    """Try the rivals of earlier effects again beside the last one: the first answer may have stood in for two."""
    for number, earlier in enumerate(found.accepted[:-1]):
        if number >= len(found.rounds):
            continue
        others = [one.placed for k, one in enumerate(found.accepted) if k != number]
        rivals = [
            row
            for row in found.rounds[number].candidates
            if row.fit is not None and row.comparison is not None and row.comparison.evidence > policy.evidence
        ]
        best, placed = found.model, earlier.placed
        for row in sorted(rivals, key=lambda row: -_total(row))[: EFFORT.pairs + 1]:
            new = row.added[0]
            if str(new) in {str(one) for one in found.model.effects}:
                continue
            assert row.fit is not None
            start = {**found.model.values, **{k: v for k, v in row.fit.values.items() if k.startswith(f"{new}.")}}
            begun = form.begin([*others, new], [start], found.model)
            if begun is None or begun.log_likelihood < best.log_likelihood("estimation") - EFFORT.margin:
                continue
            fit = form.finish(begun, found.model)
            trial = judged([new], fit, nominal, nominal, policy)
            if fit is not None and trial.passed and _value(fit) > _value(best) + policy.tie:
                best, placed = fit, new
        if best is not found.model:
            found.model = best
            found.accepted[number] = Accepted(placed, ((placed,),), earlier.evidence, earlier.validation)


def _pruned(form: Form, found: Outcome, policy: Policy) -> None:
    """Drop earlier effects that a later one has made needless."""
    for earlier in found.accepted[:-1]:
        left = [one.placed for one in found.accepted if one is not earlier]
        starts = [found.model.values, *in_its_place(found.model.values, earlier.placed, left)]
        without = form.fit(left, starts, found.model)
        if without is None or not without.converged or any(impossible(one, without) for one in left):
            continue
        if _value(without) > _value(found.model) - policy.tie:
            found.model = without
            found.accepted = [one for one in found.accepted if one is not earlier]


def in_its_place(values: Mapping[str, float], gone: Placed, left: Sequence[Placed]) -> list[dict[str, float]]:
    """Return values with which another effect at the same place carries the level of one that goes as well."""
    found = []
    for other in left:
        pairs = [(a, b) for a in gone.effect.parameters for b in other.effect.parameters if a.main and b.main]
        for a, b in pairs:
            if other.at == gone.at and a.unit == b.unit:
                found.append({**values, other.name(b.name): values[other.name(b.name)] + values[gone.name(a.name)]})
    return found


def _value(fit: Fit) -> float:
    return fit.penalised + fit.log_likelihood("validation")
