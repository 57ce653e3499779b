"""An answer is held against the simpler laws that its own become at a limit: where these do as well, they are it.

A law with an exponent near 1, or with a constant that the data do not determine, fits as well as the law that it then
equals, alone or beside another one: "less than in proportion" and viscous plus dry friction, say. Which laws those are,
every law of the dictionary declares (``nests``, ``limits``).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from harness.diagnosis.policy import Policy
from harness.diagnosis.search.compare import impossible
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Accepted, value
from harness.diagnosis.search.ties import close
from harness.effects.effect import Effect, Placed

MOST = 2
"""Laws that are replaced, and that replace them, at once: no law of the dictionary is the sum of three."""


def becomes(effect: Effect, known: Mapping[str, Effect]) -> tuple[Effect, ...]:
    """Return the laws of fewer free parameters that an effect becomes at a limit, theirs included.

    Parameters
    ----------
    effect : Effect
    known : mapping
        The dictionary by name.

    Examples
    --------
    >>> from harness.effects import builtin
    >>> [law.name for law in becomes(builtin()["yield_friction"], builtin())]
    ['sublinear_friction', 'coulomb_friction', 'viscous_friction']
    """
    found: dict[str, Effect] = {}
    waiting = [effect]
    while waiting:
        law = waiting.pop(0)
        for name in (*law.nests, *law.limits):
            simple = known.get(name)
            if simple is not None and name not in found and _free(simple) < _free(law):
                found[name] = simple
                waiting.append(simple)
    return tuple(found.values())


def with_simpler_laws(form: Form, outcome: Outcome, candidates: Sequence[Placed], policy: Policy) -> Outcome:
    """Return an outcome with simpler laws in the place of accepted ones while these data do not tell them apart.

    One or two laws of a place are replaced by up to two of those that they become at a limit. The best such replacement
    is the answer if it is as likely, or has fewer parameters and errs by less than is asked of an effect; and where an
    accepted law ended on a bound at which it is another one, or against its own physics, if it is better than nothing.

    Parameters
    ----------
    form : Form
    outcome : Outcome
    candidates : sequence of Placed
        The laws of the dictionary that may stand here.
    policy : Policy
    """
    while (better := _better(form, outcome, candidates, policy)) is not None:
        old, new, fit, lawful = better
        gain = (value(fit) - value(outcome.model)) / 2
        evidence = (sum(known.evidence for known in old) + gain) / len(new)
        validation = (sum(known.validation for known in old) + gain) / len(new)
        gone = tuple(known.placed for known in old)
        tie = dict.fromkeys([gone, *(old[0].tie if len(old) == 1 else ())]) if lawful else ()
        present = {str(placed) for placed in fit.effects}
        rivals = [group for group in tie if not present & {*map(str, group)}]
        place = min(outcome.accepted.index(known) for known in old)
        kept = [_beside(known, present) for known in outcome.accepted if known not in old]
        made = [
            Accepted(placed, ((placed,), *rivals), evidence, validation, found=min(known.found for known in old))
            for placed in new
        ]
        outcome = replace(outcome, accepted=(*kept[:place], *made, *kept[place:]), model=fit)
    return outcome


def _beside(known: Accepted, present: set[str]) -> Accepted:
    """Return an accepted effect without rivals that now stand beside it."""
    tie = [group for group in known.tie if group == (known.placed,) or not present & {*map(str, group)}]
    return replace(known, tie=tuple(tie), beside=None)


def _better(
    form: Form, outcome: Outcome, candidates: Sequence[Placed], policy: Policy
) -> tuple[list[Accepted], list[Placed], Fit, bool] | None:
    """Return the best replacement: what goes, what comes, the fit, and whether what goes was within its law."""
    model = outcome.model
    best: tuple[list[Accepted], list[Placed], Fit, bool] | None = None
    for old, new in _replacements(outcome.accepted, candidates):
        gone = {str(known.placed) for known in old}
        kept = [placed for placed in model.effects if str(placed) not in gone]
        fit = form.fit([*kept, *new], _starts(model, old, new), model)
        if fit is None or not fit.converged or fit.count > model.count:
            continue
        if any(impossible(form, placed, fit) for placed in fit.effects):
            continue
        lawful = not any(impossible(form, known.placed, model) for known in old)
        enough = (
            close(model, fit, value(model) - value(fit), policy)
            or (fit.count < model.count and form.distance(model, fit) < policy.least)
            if lawful
            else value(fit) > value(outcome.nominal) + 2 * policy.evidence
        )
        if enough and (best is None or value(fit) > value(best[2])):
            best = old, new, fit, lawful
    return best


def _replacements(
    accepted: Sequence[Accepted], candidates: Sequence[Placed]
) -> Iterator[tuple[list[Accepted], list[Placed]]]:
    """Yield which accepted laws of a place may go for which simpler ones."""
    present = {str(known.placed) for known in accepted}
    for size in range(1, MOST + 1):
        for old in itertools.combinations(accepted, size):
            at = {known.placed.at for known in old}
            if len(at) > 1:
                continue
            here = {placed.effect.name: placed for placed in candidates if placed.at in at}
            known = {name: placed.effect for name, placed in here.items()}
            simple = dict.fromkeys(law.name for one in old for law in becomes(one.placed.effect, known))
            open_to = [here[name] for name in simple if str(here[name]) not in present]
            for law in (here[name] for name in known if str(here[name]) not in present):
                if size > 1 and {one.placed.effect.name for one in old} <= {*law.effect.nests}:
                    yield [*old], [law]  # the two are parts of it
            for count in range(1, MOST + 1):
                for new in itertools.combinations(open_to, count):
                    if not any(_same(one.placed, new) for one in old):
                        yield [*old], [*new]


def _same(law: Placed, others: Sequence[Placed]) -> bool:
    """Return True for laws that are another one by definition: nothing is simpler about them."""
    names = {placed.effect.name for placed in others}
    return any({*text.split(" + ")} == names for text in law.effect.same_as)


def _starts(model: Fit, old: Sequence[Accepted], new: Sequence[Placed]) -> list[dict[str, float]]:
    """Return where laws start: from the sizes of the data, and from values of the same name in what goes."""
    shared = {
        placed.name(name): model.values[known.placed.name(name)]
        for known in old
        for placed in new
        for name in placed.effect.parameter_names
        if name in known.placed.effect.parameter_names
    }
    own = {name for known in old for name in map(known.placed.name, known.placed.effect.parameter_names)}
    base = {name: number for name, number in model.values.items() if name not in own}
    return [base, {**base, **shared}] if shared else [base]


def _free(effect: Effect) -> int:
    """Return the number of its free parameters."""
    return sum(not parameter.fixed for parameter in effect.parameters)
