"""Pairs of effects: tried where no single effect is accepted but something is left.

Two laws of one family can hide each other: with viscous friction in the model, Coulomb friction and quadratic drag
bend the decay of a swing in opposite directions, and either one alone fits best with the wrong sign. So an effect
that only its sign speaks against is tried again beside every member of its family.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from harness.diagnosis.accept import DELTA_BIC, LEVEL, WRONG_SIGN
from harness.diagnosis.confirm import Candidate, assess
from harness.diagnosis.descent import Bar
from harness.diagnosis.forms import Fitted
from harness.diagnosis.refit import Task
from harness.diagnosis.screens import SEEN
from harness.diagnosis.starts import starts_of
from harness.diagnosis.ties import simplest, tie_set
from harness.effects.effect import Placed

if TYPE_CHECKING:
    from harness.diagnosis.subset import Round, Search

__all__ = ["best_pair", "compatible", "complements", "short_of"]

PAIR_GAIN = 0.5
"""Share of the squared validation error that a pair must take away: among many pairs one gains a little by chance."""

PAIR_PROMISE = 0.25
"""Share of the error that a pair must take away over short windows to be fitted over long ones."""
ONWARD = 0.1
"""Share of the error that a pair must take away to be fitted on where it has not converged."""

PROMISING = 0.4
"""Share of the residual that a pair must explain in a screen to be refitted; a screen is linear, a fit is not."""
SHORT = 6


def compatible(effects: Sequence[Placed]) -> bool:
    """Return False for effects that exclude each other: between an input and a coordinate lies one transmission."""
    driven = [one.at for one in effects if one.effect.drives]
    return len(driven) == len(set(driven))


def short_of(here: Round) -> list[Placed]:
    """Return at most six effects worth combining: best refits first, then leaders of the screens."""
    ranked = sorted((one for one in here.candidates if one.fitted is not None), key=lambda one: -one.delta_bic)
    ordered = [one.added[0] for one in ranked] + [one.placed for one in here.screen.leaders(3)]
    return list({str(one): one for one in ordered}.values())[:SHORT]


def complements(candidates: Sequence[Placed], here: Round) -> list[tuple[Placed, Placed]]:
    """Return pairs of an effect of the wrong sign, in its simplest form, with each member of its family at its port."""
    unseen = {str(one.placed) for one in here.screen.probes if one.left < SEEN}
    taken = {str(one) for one in here.before.effects}
    free = [one for one in candidates if str(one) not in unseen | taken]
    by_name = {(one.effect.name, one.at): one for one in free}
    found: dict[frozenset[str], tuple[Placed, Placed]] = {}
    for candidate in here.candidates:
        wrong = any(reason.endswith(WRONG_SIGN) for reason in candidate.judgement.reasons)
        if not wrong or candidate.delta_bic <= DELTA_BIC:
            continue
        given = candidate.added[0]
        simple = next((by_name[name, given.at] for name in given.effect.nests if (name, given.at) in by_name), given)
        for other in free:
            kin = other.effect.name in simple.effect.family or simple.effect.name in other.effect.family
            nested = simple.effect.name in other.effect.nests or other.effect.name in simple.effect.nests
            if kin and not nested and other.at == simple.at and str(other) != str(simple):
                found.setdefault(frozenset((str(simple), str(other))), (simple, other))
    return list(found.values())


def best_pair(search: Search, model: Fitted, here: Round) -> Candidate | None:
    """Return the best accepted pair, where no single effect was accepted.

    Beside the nominal model these are the pairs of the best refits, and complements; beside an effect that stands
    already, complements only.
    """
    probes = {str(one.placed): one for one in here.screen.probes}
    wanted = complements(search.candidates, here)
    if not model.effects:
        wanted += _promising(here, list(combinations(short_of(here)[:4], 2)))
    if not wanted:
        return None
    distinct = {frozenset(map(str, pair)): pair for pair in wanted}.values()
    pairs = [pair for pair in distinct if compatible((*model.effects, *pair))]
    if here.line is None:
        pairs = [pair for pair in pairs if all(one.effect.name != "periodic_disturbance" for one in pair)]
    if not pairs:
        return None
    search.say(f"refitting {len(pairs)} pairs")
    bar = Bar(model.effects, model.values, PAIR_PROMISE)
    tasks = [Task((*model.effects, *pair), starts_of(search, model, pair, probes), bar) for pair in pairs]
    judged = search.judge(model, tasks, pairs, here.p)
    for _ in range(2):  # two effects share a long valley: a pair that gains is fitted on from where it ended
        onward = {
            k: Task(tasks[k].effects, (one.fitted.values,))
            for k, one in enumerate(judged)
            if one.fitted is not None and not one.fitted.converged and one.comparison.gain >= ONWARD
        }
        if not onward:
            break
        tasks = [onward.get(k, task) for k, task in enumerate(tasks)]
        judged = search.judge(model, tasks, pairs, here.p)
    found = [one for one in judged if one.accepted and one.comparison.gain >= PAIR_GAIN]
    accepted = [one for one in found if _each_needed(search, model, one)]
    if not accepted:
        return None
    best = max(accepted, key=lambda one: one.delta_bic)
    return simplest([one for one in tie_set(search.form, best, judged, seed=search.seed) if one in accepted])


def _promising(here: Round, pairs: Sequence[tuple[Placed, Placed]]) -> list[tuple[Placed, Placed]]:
    """Return the pairs that could take away as much as a pair must, by the screen: at most six, best first."""
    shares = {frozenset(map(str, pair)): (here.screen.share(*pair), pair) for pair in pairs}
    ranked = sorted(shares.values(), key=lambda one: -one[0])
    return [pair for share, pair in ranked if share >= PROMISING][:SHORT]


def _each_needed(search: Search, model: Fitted, pair: Candidate) -> bool:
    """Return True if both members of a pair lower the BIC by more than 10 beside the other."""
    assert pair.fitted is not None
    for kept in pair.added:
        task = Task((*model.effects, kept), starts_of(search, model, [kept], {}))
        alone = search.refitter.fit(task)
        if alone is None:
            continue
        gone = tuple(one for one in pair.added if one is not kept)
        judged = assess(search.form, alone, [(gone, pair.fitted)], surrogate_p=None, seed=search.seed)[0]
        if judged.delta_bic <= DELTA_BIC or judged.comparison.gain < 0.01 or judged.comparison.p > LEVEL:
            return False
    return True
