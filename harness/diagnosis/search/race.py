"""The refits beside a base, as a race by successive halving: all are begun, those that keep up are finished."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import pays, wrong_signs
from harness.diagnosis.search.fit import Begun, Fit
from harness.diagnosis.search.scores import Lead, ScoreTest, score_test
from harness.diagnosis.search.table import FitTable, named
from harness.diagnosis.search.warm import Fits, share_ends
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed

Passes = Callable[[Placed, Fit], bool]


def raced(table: FitTable, base: Fit, test: ScoreTest, untried: Sequence[Placed]) -> tuple[Fits, frozenset[str]]:
    """Begin the refits of all that promises something; finish those whose first steps keep up with the best.

    Returns them, and the names of those that were begun and left.
    """

    @cache
    def passes(placed: Placed, fit: Fit) -> bool:
        return table.judged([placed], fit, base).passed

    race = _begun(table, base, test, untried)
    fits: Fits = {}
    while len(fits) < EFFORT.refits and (order := race.next(fits)):
        for placed in order:
            first = race.begun[placed]
            assert first is not None
            table.say(f"{placed} to its maximum")
            fits[placed] = table.finish(first, race.origins[placed], _best(fits, placed, passes), race.worth(placed))
        race.refused |= {placed for placed, fit in fits.items() if fit is None or not passes(placed, fit)}
        if len(race.refused) < len(fits):
            break
    fits |= dict.fromkeys(_special_cases(table, base, fits, race.begun))
    share_ends(table, base, fits, lambda placed: _best(fits, placed, passes))
    return fits, named(placed for placed in race.begun if placed not in fits)


def _special_cases(table: FitTable, base: Fit, fits: Fits, begun: Mapping[Placed, Begun | None]) -> list[Placed]:
    """Return what was begun and left, and is a special case of what pays: it is tried from where that one ended."""
    paying = [placed for placed, fit in fits.items() if fit is not None and pays(fit, base, table.policy)]
    return [simple for simple in begun if simple not in fits and any(rich.generalises(simple) for rich in paying)]


@dataclass(eq=False)
class _Race:
    """Refits that were begun, from where, and which of them are to be finished.

    What no law allows is no answer, nor what was refused: neither says how little an answer may gain. ``found`` is what
    the base brings beyond the nominal model.
    """

    base: Fit
    found: float
    policy: Policy
    laws: Dictionary
    begun: dict[Placed, Begun | None] = field(default_factory=dict)
    origins: dict[Placed, Fit] = field(default_factory=dict)
    refused: set[Placed] = field(default_factory=set)

    def gain(self, placed: Placed) -> float:
        """Return what the first steps gained."""
        first = self.begun[placed]
        return -np.inf if first is None else first.log_likelihood - self.base.log_likelihood("estimation")

    def enough(self) -> float:
        """Return the gain below which a refit is not finished: it need not be begun in full."""
        gains = [
            self.gain(placed)
            for placed, refit in self.begun.items()
            if refit is not None and placed not in self.refused and not wrong_signs(placed, refit.values)
        ]
        return max(self.policy.lead, self.policy.reach * max(gains, default=0.0))

    def worth(self, placed: Placed) -> float:
        """Return the log-likelihood below which a maximum is no rival and no answer, whatever its last digits are."""
        return self.base.log_likelihood("estimation") + self._price(placed) - self.policy.evidence

    def next(self, done: Container[Placed]) -> list[Placed]:
        """Return what is to be finished beside what was, best first; one that no law allows says enough of its kind.

        What is exactly the same as the first one must not lose by its first steps.
        """
        able = [placed for placed in self.begun if placed not in done and self.gain(placed) >= self._needed(placed)]
        order = sorted(able, key=lambda placed: (self._forbidden(placed), -self.gain(placed)))
        order = order[: min(sum(not self._forbidden(placed) for placed in order) + 1, EFFORT.refits)]
        same = {name for placed in order[:1] for name in self.laws.family(placed.effect).exact}
        alike = [placed for placed in self.begun if placed.effect.name in same and self.begun[placed] is not None]
        return [*order, *(placed for placed in alike if placed not in order and placed not in done)]

    def _price(self, placed: Placed) -> float:
        free = sum(not parameter.fixed for parameter in placed.effect.parameters)
        return 0.5 * float(np.log(self.base.samples)) * free

    def _needed(self, placed: Placed) -> float:
        """Return what the first steps must gain of what acceptance asks: to pay, and the share of a further effect."""
        asked = max(self.policy.evidence, self.policy.second_share * self.found)
        return max(self.enough(), self.policy.reach * (asked + self._price(placed)))

    def _forbidden(self, placed: Placed) -> bool:
        """Return True for what no law allows: it must not take the place of what one does."""
        first = self.begun[placed]
        return first is not None and bool(wrong_signs(placed, first.values))


def _begun(table: FitTable, base: Fit, test: ScoreTest, untried: Sequence[Placed]) -> _Race:
    """Begin the refits of all that promises something, and of what no promise tells of."""
    race = _Race(base, base.penalised - table.nominal.penalised, table.policy, table.laws)
    before = base.log_likelihood("estimation")
    leads = chosen(test, table.laws, table.policy)
    if table.form.limited():  # what comes last may not be begun at all, however much it promises
        leads.sort(key=lambda lead: -lead.penalised)
    for lead in [*leads, *_remembered(table, base, test, untried)]:
        table.say(str(lead.placed))
        promising = lead.starts if lead.penalised > 0.0 else lead.starts[:1]
        starts = [{**base.values, **start} for start in promising]
        race.origins[lead.placed] = base
        race.begun[lead.placed] = table.begin([*base.effects, lead.placed], starts, base, before + race.enough())
    best = max((refit for refit in race.begun.values() if refit), key=lambda refit: refit.log_likelihood, default=None)
    for suspect in table.form.suspects(base, best, untried):
        table.say(str(suspect.placed))
        origin = base if suspect.base is None else suspect.base
        starts = [{**origin.values, **start} for start in suspect.starts]
        race.origins[suspect.placed] = origin
        # its starts lie far off: two steps tell nothing of where it leads
        race.begun[suspect.placed] = table.begin([*base.effects, suspect.placed], starts, origin)
    return race


def _best(fits: Fits, beside: Placed, passes: Passes) -> Fit | None:
    """Return the likeliest of the other refits that may be the answer: nothing else puts an end to another fit.

    What the validation records or its own law refuse says nothing of how near to it the answer may come.
    """
    done = [fit for placed, fit in fits.items() if fit is not None and placed != beside and passes(placed, fit)]
    return max(done, key=lambda fit: fit.log_likelihood("estimation"), default=None)


def chosen(test: ScoreTest, laws: Dictionary, policy: Policy = POLICY) -> list[Lead]:
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
        names = {leader.placed.effect.name, *laws.family(leader.placed.effect).near}
        near += [lead for lead in clear if lead.placed.effect.name in names and lead.placed.at == leader.placed.at]
    ordered = dict.fromkeys([*clear[: EFFORT.refits], *near, *clear])
    return [*list(ordered)[: EFFORT.begun], *faint[: EFFORT.faint]]


def _remembered(table: FitTable, base: Fit, test: ScoreTest, untried: Sequence[Placed]) -> list[Lead]:
    """Return leads that promise something only where the base has not taken it up, and that start from there."""
    without_memory = table.form.without_memory(base)
    if without_memory is None:
        return []
    policy = table.policy
    known = {str(lead.placed) for lead in (*test.leads, *test.hidden) if lead.gain >= policy.lead}
    others = [placed for placed in untried if str(placed) not in known]
    leads = score_test(table.form, without_memory, others, policy).leads
    clear = [lead for lead in leads if lead.penalised > 0.0 and lead.share >= policy.clear][: EFFORT.faint]
    origin = without_memory.values
    return [replace(lead, starts=tuple({**origin, **start} for start in lead.starts)) for lead in clear]
