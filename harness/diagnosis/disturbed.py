"""Two judges where something that is not measured disturbs the plant: simulations, and the momentum balance.

Simulations can judge every effect, yet under a disturbance they are poor judges of a force; the whitened balance of the
measured motion is the best there is, but sees only forces without a state of their own. So the balance is asked where
no model comes near the noise. Its answer counts where simulations found none or only forces too, unless an effect that
it cannot judge explains the balance as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.accept import GAIN, LEVEL, WRONG_SIGN, compare_blocks
from harness.diagnosis.confirm import Task, assess, far_above
from harness.diagnosis.exchange import Accepted
from harness.diagnosis.forms import Fitted, fit_here, placed_name
from harness.diagnosis.momentum_form import MomentumForm
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.screens import SEEN
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.ties import ALIKE, WITHIN
from harness.diagnosis.weak_screen import weak_screen
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["BALANCE", "asked", "second_opinion"]

DROWNED = 0.1
"""Share of sensor noise in the balance beyond which it names no force: least squares would find what is not there."""
SHORT = 0.1
"""Horizon over which the answer of the balance is refitted, as a part of the usual one, where none was clearer."""
BALANCE = (
    "the answer comes from the whitened momentum balance of the measured motion: the plant is disturbed, and the error "
    "of a simulation then rings for too long to tell"
)


def asked(
    system: Any,
    dataset: Dataset,
    sizes: Mapping[str, Mapping[str, float]],
    values: Mapping[str, float],
    floors: Sequence[NoiseFloor],
    seed: int,
) -> tuple[MomentumForm | None, list[str]]:
    """Return the momentum balance of a data set; or None, and why it cannot be asked.

    Parameters
    ----------
    system, dataset, sizes
        As :class:`MomentumForm` takes them.
    values : mapping
        Parameters of the fitted nominal model.
    floors : sequence of NoiseFloor
        Of the outputs.
    seed : int
        Keys the noise that is added to find out how much of it there is.
    """
    try:
        with np.errstate(all="ignore"):
            momentum = MomentumForm(system, dataset, sizes=sizes, values=values)
            noise = [one.value or 0.0 for one in floors]
            share = momentum.noise_share(dataset, noise, stream("diagnosis-balance", seed))
    except (FitError, np.linalg.LinAlgError) as error:
        return None, [f"the momentum balance of the measured motion could not be asked: {error}"]
    if not share <= DROWNED:
        return None, [f"the momentum balance of the measured motion was not asked: sensor noise is {share:.0%} of it"]
    return momentum, []


def second_opinion(
    usual: OutputForm,
    form: OutputForm,
    nominal: Fitted,
    result: SearchResult,
    momentum: MomentumForm,
    search_of: Callable[[Any], Search],
) -> tuple[OutputForm, Fitted, SearchResult]:
    """Return form, nominal model and answer after the momentum balance was asked.

    Parameters
    ----------
    usual : OutputForm
        At the usual horizon.
    form, nominal, result
        What the search over simulations ended with; at the usual horizon, or a shorter one.
    momentum : MomentumForm
    search_of : callable
        Makes the search in a form.
    """
    search = search_of(momentum)
    found = search.run(momentum.start)
    effects = tuple(one.placed for one in found.accepted)
    kept = (form, nominal, result)
    known = {str(one.placed) for one in result.accepted}
    if {str(one) for one in effects} <= known:
        return kept
    ties = [_tie(search, momentum, found, one, search_of(usual).candidates) for one in found.accepted]
    if not all(ties):
        return kept
    accepted = tuple(replace(one, tie=tie) for one, tie in zip(found.accepted, ties, strict=True))
    rounds, notes = (*result.rounds, *found.rounds), (*result.notes, BALANCE)
    plain = nominal if form is usual else fit_here(usual, (), [nominal.values])
    over = search_of(usual).refitter.fit(Task(effects, ({**plain.values, **found.model.values},)))
    if over is not None and over.finite and not far_above(usual, over):
        return usual, plain, SearchResult(over, accepted, rounds, found.extra, notes)
    near, seen = form, nominal
    if form is usual:
        longest = max(len(one) for one in usual.records["estimation"]) * usual.sample_time
        near, seen = usual.shortened(nominal, max(SHORT * (usual.horizon or longest), 50 * usual.sample_time))
        seen = fit_here(near, (), [seen.values])
    here = search_of(near)
    model = here.refitter.fit(Task(effects, ({**seen.values, **found.model.values},)))
    while model is not None and model.finite and len(effects) > 1:
        idle = _idle(here, model)
        if idle is None:
            break
        effects, model = idle.effects, idle
    if {str(one) for one in effects} <= known:
        return kept
    accepted = tuple(one for one in accepted if str(one.placed) in {str(placed) for placed in effects})
    judged = assess(near, seen, [(effects, model)], surrogate_p=None, seed=search.seed)[0]
    wrong = any(reason.endswith(WRONG_SIGN) for reason in judged.judgement.reasons)
    if model is None or not model.finite or not model.converged or wrong or judged.comparison.gain < GAIN:
        return kept
    if any(not momentum.judges(one.placed) for one in result.accepted):
        other = tuple(one.placed for one in result.accepted)
        rival = here.refitter.fit(Task(other, ({**seen.values, **result.model.values},)))
        if rival is not None and rival.finite:
            rng = stream("diagnosis-opinions", placed_name(effects), search.seed)
            versus = compare_blocks(rival.validation, model.validation, rng=rng)
            if versus.gain < ALIKE or not versus.distinguishable:
                return kept
    return near, seen, SearchResult(model, accepted, rounds, found.extra, notes)


def _idle(search: Search, model: Fitted) -> Fitted | None:
    """Return the model without the effect that simulations miss least, if they do not miss it at all; else None.

    Of several effects one may stand for a detail of the smoothed motion: that one gains nothing in a simulation.
    """
    without: list[tuple[float, Fitted]] = []
    for one in model.effects:
        rest = tuple(other for other in model.effects if other is not one)
        known = {k: v for k, v in model.values.items() if not k.startswith(f"{one}.")}
        less = search.refitter.fit(Task(rest, (known,)))
        if less is not None and less.finite:
            rng = stream("diagnosis-opinions", f"without {one}", search.seed)
            versus = compare_blocks(less.validation, model.validation, rng=rng)
            if versus.gain < GAIN or versus.p > LEVEL:
                without.append((versus.gain, less))
    return min(without, key=lambda pair: pair[0])[1] if without else None


def _tie(
    search: Search, momentum: MomentumForm, found: SearchResult, one: Accepted, everything: Sequence[Placed]
) -> tuple[tuple[Placed, ...], ...]:
    """Return the tie set of an effect with those added that the balance sees only as a linear regression.

    Empty if one of these explains the balance better.
    """
    others = [other.placed for other in found.accepted if other is not one]
    unjudged = [other for other in everything if not momentum.judges(other)]
    values = {k: v for k, v in found.model.values.items() if not k.startswith(f"{one.placed}.")}
    screen = weak_screen(momentum, others, values, [one.placed, *unjudged], search.sizes).screen
    scores = {str(probe.placed): probe for probe in screen.probes if probe.left >= SEEN and probe.rank}
    own = scores.pop(str(one.placed), None)
    if own is None:
        return one.tie
    if any(probe.score > own.score + WITHIN for probe in scores.values()):
        return ()
    return (*one.tie, *((probe.placed,) for probe in scores.values() if probe.score > own.score - WITHIN))
