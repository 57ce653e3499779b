"""After the search: each effect against its rivals while the others stay, and what none can be told from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from harness.diagnosis.accept import compare_blocks
from harness.diagnosis.confirm import Candidate, assess
from harness.diagnosis.descent import Bar
from harness.diagnosis.forms import Fitted, placed_name
from harness.diagnosis.pairs import SHORT, short_of
from harness.diagnosis.refit import Task
from harness.diagnosis.screens import SEEN, Probe
from harness.diagnosis.starts import starts_of
from harness.diagnosis.ties import ALIKE, leader, tie_set
from harness.effects.effect import Placed
from harness.rng import stream

if TYPE_CHECKING:
    from harness.diagnosis.subset import Round, Search

__all__ = ["Accepted", "swapped", "with_ties"]


RIVAL = 1.0
"""A rival whose squared error over short windows exceeds that of the standing model by this share is given up."""


@dataclass(frozen=True, eq=False)
class Accepted:
    """An accepted effect with what it cannot be told from, itself first."""

    placed: Placed
    delta_bic: float
    tie: tuple[tuple[Placed, ...], ...]


def swapped(
    search: Search, nominal: Fitted, model: Fitted, picked: list[Placed], rounds: Sequence[Round]
) -> tuple[Fitted, list[Placed]]:
    """Exchange each effect against its rivals while the others stay, drop what is not needed."""
    rivals: dict[str, Placed] = {}
    for here in rounds:
        for one in short_of(here):
            rivals.setdefault(str(one), one)
    by_name = {(one.effect.name, one.at): one for one in search.candidates}
    for one in picked:
        for name in one.effect.nests:
            if (name, one.at) in by_name:
                rivals.setdefault(f"{name}@{one.at}", by_name[name, one.at])
    probes: dict[str, Probe] = {}
    for here in rounds:
        for probe in here.screen.probes:
            probes.setdefault(str(probe.placed), probe)
    search.say("best subset: swaps")
    for _ in range(2):
        changed = False
        for place in range(len(picked)):
            others = [one for k, one in enumerate(picked) if k != place]
            taken = {str(one) for one in picked}
            tries = [one for key, one in rivals.items() if key not in taken][: SHORT + 2 - len(picked)]
            known = {k: v for k, v in model.values.items() if not k.startswith(f"{picked[place]}.")}
            stand_in = replace(model, values=known)
            standing = Bar(model.effects, model.values, -RIVAL)
            tasks = [
                Task((*nominal.effects, *others, one), starts_of(search, stand_in, [one], probes), standing)
                for one in tries
            ]
            before_task = Task((*nominal.effects, *others), (known,))
            before = search.refitter.fit(before_task)
            if before is None:
                continue
            added = [*tries, picked[place]]
            records = search.refitter.solve(tasks)
            models: list[tuple[tuple[Placed, ...], Fitted | None]] = [
                ((one,), search.refitter.evaluate(task, record))
                for one, task, record in zip(tries, tasks, records, strict=True)
            ]
            models.append(((picked[place],), model))
            judged = assess(search.form, before, models, surrogate_p=None, seed=search.seed)
            best = search.winner(judged)
            if best is None:
                if before.finite and _worse(search, model, before):
                    continue
                return before, others  # not needed beside the others any more
            if best.added[0] is not added[-1] and best.fitted is not None and not _worse(search, model, best.fitted):
                picked = [*others[:place], best.added[0], *others[place:]]
                model, changed = best.fitted, True
        if not changed:
            break
    return model, picked


def _worse(search: Search, model: Fitted, rival: Fitted) -> bool:
    """Return True if validation speaks against a rival of the model that stands.

    Both are better than the model without either; but that one may be far off where one of two effects is missing. A
    rival with more parameters must be better on validation, another one only not worse.
    """
    rng = stream("diagnosis-swap", placed_name(rival.effects), search.seed)
    versus = compare_blocks(model.validation, rival.validation, rng=rng)
    if len(rival.free) > len(model.free):
        return versus.gain < ALIKE or not versus.distinguishable
    return versus.gain < 0 and versus.distinguishable


def with_ties(
    search: Search, nominal: Fitted, model: Fitted, picked: Sequence[Placed], rounds: Sequence[Round]
) -> tuple[list[Accepted], list[Candidate]]:
    """Return each effect of the final model with its tie set, the others being in the model."""
    if not picked:
        return [], []
    if len(picked) == 1:
        judged = list(rounds[0].candidates)
        own = next((one for one in judged if one.added == (picked[0],)), None)
        if own is not None and own.fitted is not None and _same(own.fitted, model):
            accepted = [one for one in judged if one.accepted]
            tied = tie_set(search.form, leader(accepted, seed=search.seed), judged, seed=search.seed)
            # the simplest of them is the answer: what ties with that one ties too
            tied += [one for one in tie_set(search.form, own, accepted, seed=search.seed) if one not in tied]
            rest = tuple(one.added for one in tied if one is not own)
            return [Accepted(picked[0], own.delta_bic, ((picked[0],), *rest))], []
    probes = {str(one.placed): one for here in rounds for one in here.screen.probes}
    result, extra = [], []
    for placed in picked:
        others = [one for one in picked if one is not placed]
        known = {k: v for k, v in model.values.items() if not k.startswith(f"{placed}.")}
        before = search.refitter.fit(Task((*nominal.effects, *others), (known,)))
        if before is None:
            result.append(Accepted(placed, float("nan"), ((placed,),)))
            continue
        names = {*placed.effect.family, *placed.effect.nests}
        tries = [
            one
            for one in search.candidates
            if str(one) not in {str(other) for other in picked}
            and one.effect.name in names
            and (str(one) not in probes or probes[str(one)].left >= SEEN)
        ]
        here = [one for one in tries if one.at == placed.at]
        tries = (here + [one for one in tries if one.at != placed.at])[:SHORT]
        stand_in = replace(model, values=known)
        standing = Bar(model.effects, model.values, -RIVAL)
        tasks = [
            Task((*nominal.effects, *others, one), starts_of(search, stand_in, [one], probes), standing)
            for one in tries
        ]
        records = search.refitter.solve(tasks)
        models: list[tuple[tuple[Placed, ...], Fitted | None]] = [((placed,), model)]
        models += [
            ((one,), search.refitter.evaluate(task, record))
            for one, task, record in zip(tries, tasks, records, strict=True)
        ]
        judged = assess(search.form, before, models, surrogate_p=None, seed=search.seed)
        extra += judged[1:]
        tied = tie_set(search.form, judged[0], judged, seed=search.seed)
        result.append(Accepted(placed, judged[0].delta_bic, tuple(one.added for one in tied)))
    return result, extra


def _same(a: Fitted, b: Fitted) -> bool:
    """Return True if two fits of one model ended in the same minimum."""
    return bool(abs(a.record["cost"] - b.record["cost"]) <= 1e-3 * max(b.record["cost"], 1e-300))
