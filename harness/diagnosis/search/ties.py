"""What the data do not tell from an answer: its tie set, as it was accepted and beside what was accepted later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.policy import EFFORT, POLICY, Policy
from harness.diagnosis.search.compare import Judged, difference, judged
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.refusal import WANT_OF_EVIDENCE, Kind, only, subjects
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed

__all__ = [
    "Accepted",
    "asked_again",
    "close",
    "held",
    "may_tie",
    "own_values",
    "physical",
    "refines",
    "tie_set",
    "tied",
    "total",
    "typical_elsewhere",
    "undecided",
    "value",
]


@dataclass(frozen=True, eq=False)
class Accepted:
    """One accepted effect with all that these data cannot tell from it, itself first, and its evidence.

    ``beside`` names the effects beside which the tie set was asked for, None where it was not asked for yet;
    ``found`` counts the rounds before the one that found it, with its rivals; ``part_of`` names the unknown force that
    it may be a part of, where that is larger than what it explains.
    """

    placed: Placed
    tie: tuple[tuple[Placed, ...], ...]
    evidence: float
    validation: float
    beside: frozenset[str] | None = None
    found: int = 0
    part_of: str = ""


def total(row: Judged) -> float:
    """Return what decides between rivals: the gain of both uses together."""
    return -np.inf if row.comparison is None else row.comparison.total


def value(fit: Fit) -> float:
    """Return the same of a fit itself."""
    return fit.penalised + fit.log_likelihood("validation")


def own_values(placed: Placed, fit: Fit) -> dict[str, float]:
    """Return the values of the parameters of one effect, by full name."""
    names = {*map(placed.name, placed.effect.parameter_names)}
    return {name: number for name, number in fit.values.items() if name in names}


def physical(row: Judged) -> bool:
    """Return True if nothing but a want of evidence speaks against a candidate."""
    return only(row.refusals, WANT_OF_EVIDENCE)


def typical_elsewhere(row: Judged) -> bool:
    """Return True if nothing but a want of evidence, or a value on its bound, speaks against a candidate."""
    return only(row.refusals, {*WANT_OF_EVIDENCE, Kind.UNCONVERGED, Kind.BOUND})


def may_tie(row: Judged, placed: Placed, laws: Dictionary) -> bool:
    """Return True if nothing but a want of evidence keeps a candidate from being an answer in the place of an effect.

    A more general law may be a rival though its values ended outside its own physics: within it, it is the answer
    itself or something beside it.
    """
    lawless = refines(row.added, placed, laws) and only(row.refusals, {*WANT_OF_EVIDENCE, Kind.LAW})
    return physical(row) or lawless


def tied(best: Judged, other: Judged, policy: Policy = POLICY) -> bool:
    """Return True if the data do not tell two candidates apart."""
    assert best.fit is not None
    if other.fit is None or other.comparison is None:
        return False
    return close(best.fit, other.fit, total(best) - total(other), policy)


def refines(rival: Sequence[Placed], placed: Placed, laws: Dictionary) -> bool:
    """Return True for a law of which another one at the same place is a special case."""
    return len(rival) == 1 and laws.refines(rival[0], placed)


def undecided(
    answer: Fit,
    placed: Placed,
    rival: Fit,
    law: Sequence[Placed],
    gap: float,
    laws: Dictionary,
    policy: Policy = POLICY,
) -> bool:
    """Return True if the data do not decide between an effect of an answer and a rival.

    The rival is as likely, or lost by no more than chance makes what is as good lose (Vuong 1989). A more general law
    whose model differs by less than anybody would miss, and that does not pay for its parameter, is no rival: it is the
    answer, with a parameter that does nothing.

    Parameters
    ----------
    answer : Fit
    placed : Placed
        The effect.
    rival : Fit
        With another law in its place.
    law : sequence of Placed
        That law.
    gap : float
        By which it is less likely.
    laws : Dictionary
    policy : Policy
    """
    if not close(answer, rival, gap, policy):
        return False
    pays = gap < 0.0  # what its parameter explains is worth more than the parameter
    return pays or not (refines(law, placed, laws) and rival.distance(answer) < policy.least)


def tie_set(
    best: Judged, rows: Sequence[Judged], laws: Dictionary, policy: Policy = POLICY
) -> tuple[tuple[Placed, ...], ...]:
    """Return the tie set of an answer: what may tie with it (:func:`may_tie`), and is as likely."""
    found = [best.added]
    for row in sorted(rows, key=lambda row: -total(row)):
        if row is best or row.comparison is None or row.comparison.evidence < 0 or row.comparison.total < 0:
            continue
        if row.fit is None or best.fit is None or not may_tie(row, best.added[-1], laws):
            continue
        if undecided(best.fit, best.added[-1], row.fit, row.added, total(best) - total(row), laws, policy):
            found.append(row.added)
    return tuple(found)


def held(
    form: Form, best: Judged, rows: Sequence[Judged], base: Fit, nominal: Fit, policy: Policy = POLICY
) -> list[Judged]:
    """Return laws that are as likely as an answer only on a bound, with what lies on it held at its usual value.

    On its bound a law is another one: an exponent of 0.05 is dry friction. Whether the data tell the law itself from
    the answer shows where it is typical. Only what has no unit has a usual value whatever the data.

    Parameters
    ----------
    form : Form
    best : Judged
        The answer.
    rows : sequence of Judged
        Its rivals.
    base, nominal : Fit
        What all were judged against.
    policy : Policy
    """
    found = []
    for row in rows:
        if best.fit is not None and (typical := _typical(best.fit, row, policy)) is not None:
            fit = form.fit([*base.effects, typical], [_usual(row, typical)], row.fit)
            found.append(judged([typical], fit, base, nominal, policy))
    return found


def _typical(answer: Fit, row: Judged, policy: Policy) -> Placed | None:
    """Return a law with what lies on its bound held, if nothing else speaks against it; None where there is none."""
    if row.fit is None or row.fit.beyond or len(row.added) != 1:
        return None
    placed = row.added[0]
    on_bound = subjects(row.refusals, Kind.BOUND)
    bound = [parameter for parameter in placed.effect.parameters if parameter.name in on_bound]
    gap, _ = difference(answer, row.fit, ("estimation", "validation"), policy)
    if len(bound) != 1 or bound[0].unit != "1" or not typical_elsewhere(row) or not close(answer, row.fit, gap, policy):
        return None
    usual = [replace(known, fixed=known.fixed or known is bound[0]) for known in placed.effect.parameters]
    return replace(placed, effect=replace(placed.effect, parameters=tuple(usual)))


def _usual(row: Judged, typical: Placed) -> dict[str, float]:
    """Return the values of a fit, with what is held at its usual value."""
    assert row.fit is not None
    free = {parameter.name for parameter in row.added[0].effect.parameters if not parameter.fixed}
    held_now = [known for known in typical.effect.parameters if known.fixed and known.name in free]
    return {**row.fit.values, **{typical.name(known.name): known.start({}) for known in held_now}}


def asked_again(
    form: Form,
    model: Fit,
    accepted: Sequence[Accepted],
    rows: Sequence[Judged],
    nominal: Fit,
    policy: Policy = POLICY,
) -> list[Accepted]:
    """Return the accepted effects with the rivals that stay tied beside all that was accepted.

    A tie of the first effect was found when it stood alone: what was accepted later may tell them apart, or be the
    rival itself.

    Parameters
    ----------
    form : Form
    model : Fit
        With all accepted effects.
    accepted : sequence of Accepted
    rows : sequence of Judged
        Earlier fits of the rivals, to start from.
    nominal : Fit
    policy : Policy
    """
    present = frozenset(str(placed) for placed in model.effects)
    found = []
    for effect in accepted:
        others = present - {str(effect.placed)}
        if effect.beside == others:
            found.append(effect)
            continue
        kept: list[tuple[Placed, ...]] = [(effect.placed,)]
        for member in effect.tie:
            new = {str(placed) for placed in member} & present  # without the effect, its rival in the answer lost
            if not new and _still_tied(form, model, effect.placed, member, rows, nominal, policy):
                kept.append(member)
        found.append(replace(effect, tie=tuple(kept), beside=others))
    return found


def _still_tied(
    form: Form,
    model: Fit,
    placed: Placed,
    member: tuple[Placed, ...],
    rows: Sequence[Judged],
    nominal: Fit,
    policy: Policy,
) -> bool:
    """Return whether a model with a rival in the place of an effect is as likely."""
    others = [effect for effect in model.effects if str(effect) != str(placed)]
    start = dict(model.values)
    for fit in (row.fit for row in rows if row.fit is not None and row.added == member):
        for rival in member:
            start |= own_values(rival, fit)
    begun = form.begin([*others, *member], [start], model)
    if begun is None or begun.log_likelihood < model.log_likelihood("estimation") - EFFORT.margin:
        return False
    trial = form.finish(begun, model, model)
    row = judged(member, trial, nominal, nominal, policy)
    if (typical := _typical(model, row, policy)) is not None:
        trial = form.fit([*others, typical], [_usual(row, typical)], trial)
        row = judged([typical], trial, nominal, nominal, policy)
    if trial is None or trial.beyond or not physical(row):
        return False
    return undecided(model, placed, trial, member, value(model) - value(trial), form.laws, policy)


def close(best: Fit, other: Fit, gap: float, policy: Policy) -> bool:
    """Return whether a gap of the log-likelihoods is too small to prefer the better one, were the other simpler."""
    _, error = difference(best, other, ("estimation", "validation"), policy)
    return gap < max(policy.tie, policy.tie_z * error)
