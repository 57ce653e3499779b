"""Two judges where something that is not measured disturbs the plant: simulations, and the momentum balance.

Simulations can judge every effect, yet under a disturbance they are poor judges of a force; the whitened balance of the
measured motion is the best there is, but cannot see hidden masses, nor what rounds or cuts a reading. So the balance is
asked where no model comes near the noise. Its answer counts unless simulations found what it cannot tell from its own,
or an effect that it cannot judge explains them better.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.diagnosis.accept import GAIN, LEVEL, WRONG_SIGN, compare_blocks
from harness.diagnosis.confirm import assess, far_above
from harness.diagnosis.exchange import Accepted
from harness.diagnosis.forms import Fitted, fit_here, placed_name
from harness.diagnosis.momentum_form import MomentumForm
from harness.diagnosis.noise import NoiseFloor, fourth_difference
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.pairs import compatible
from harness.diagnosis.refit import Task
from harness.diagnosis.starts import starts_of
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.ties import ALIKE
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["BALANCE", "Balance", "second_opinion"]

DROWNED = 0.1
"""Share of sensor noise in the balance beyond which it names no force: least squares would find what is not there."""
UNBALANCED, CLEAR = 0.9, 0.1
"""Share of the change of momentum that no small disturbance leaves, and how much of that noise may be. Records with a
disturbance of 2 % leave up to 5 %; sensors that lose a sign all or more, of which noise is 7 % at most. A cart-pole
balanced upright, where the motion drowns in noise, leaves up to 99 %, of which noise is a fifth at least."""
SHORT = (0.1, 0.03, 0.01)
"""Horizons over which the answer of the balance is refitted, as parts of the usual one, where none was clearer."""
FEWEST = 50
"""Samples of a horizon at least."""
BALANCE = (
    "the answer comes from the whitened momentum balance of the measured motion: the plant is disturbed, and the error "
    "of a simulation then rings for too long to tell"
)


@dataclass(frozen=True, eq=False)
class Balance:
    """The momentum balance of a data set, fitted when it is first needed, and whether it may be asked.

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

    system: Any
    dataset: Dataset
    sizes: Mapping[str, Mapping[str, float]]
    values: Mapping[str, float]
    floors: Sequence[NoiseFloor]
    seed: int

    @functools.cached_property
    def form(self) -> MomentumForm:
        """The balance; raises FitError or LinAlgError if it cannot be fitted."""
        with np.errstate(all="ignore"):
            return MomentumForm(self.system, self.dataset, sizes=self.sizes, values=self.values)

    def asked(self) -> tuple[MomentumForm | None, list[str]]:
        """Return the balance; or None, and why it cannot be asked."""
        try:
            share = self._noise([one.value or 0.0 for one in self.floors], None)
        except (FitError, np.linalg.LinAlgError) as error:
            return None, [f"the momentum balance of the measured motion could not be asked: {error}"]
        if not share <= DROWNED:
            return None, [
                f"the momentum balance of the measured motion was not asked: sensor noise is {share:.0%} of it"
            ]
        return self.form, []

    def unexplained(self) -> str:
        """Return what to say if a model misses so much of the change of momentum that no small disturbance explains it.

        Empty if it does not, or if the noise of a sensor may be the reason. Where a noise floor is unknown, the fourth
        difference of the readings counts, which is no less than their white noise.
        """
        runs = self.dataset.estimation
        noise = [
            float(np.median([fourth_difference(run.y[:, k]) for run in runs])) if one.value is None else one.value
            for k, one in enumerate(self.floors)
        ]
        try:
            with np.errstate(all="ignore"):
                rest, hidden = self.form.rest(self.values), self._noise(noise, self.values)
        except (FitError, np.linalg.LinAlgError):  # `asked` tells why
            return ""
        if not (rest >= UNBALANCED and hidden < CLEAR * rest):
            return ""
        return f"{rest:.0%} of the change of momentum is not the model's: no small disturbance explains that"

    def _noise(self, noise: Sequence[float], values: Mapping[str, float] | None) -> float:
        """Return the share of noise of these standard deviations in the balance."""
        rng = stream("diagnosis-balance", self.seed)
        with np.errstate(all="ignore"):
            return self.form.noise_share(self.dataset, noise, rng, values)


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
    effects = _effects(found)
    kept = (form, nominal, result)
    if not effects:
        return kept
    named, known = {str(one) for one in _effects(result)}, set().union(*(_tied(one) for one in found.accepted))
    more = [one for one in _effects(result) if str(one) not in known and momentum.judges(one)]
    if all(named & _tied(one) for one in found.accepted) and not more:
        return form, nominal, replace(result, accepted=tuple(_both_ties(one, found) for one in result.accepted))
    rounds, notes = (*result.rounds, *found.rounds), (*result.notes, BALANCE)
    plain = nominal if form is usual else fit_here(usual, (), [nominal.values])
    over = search_of(usual).refitter.fit(Task(effects, ({**plain.values, **found.model.values},)))
    if over is not None and over.finite and not far_above(usual, over):
        return usual, plain, SearchResult(over, found.accepted, rounds, found.extra, notes)
    for near, seen in _shorter(usual, form, nominal):
        here = search_of(near)
        model = _simulated(here, seen, effects, found.model)
        if model is None:
            continue
        if _rival_stands(here, momentum, seen, model, result):
            return kept
        left = {str(placed) for placed in model.effects}
        accepted = []
        for one in found.accepted:
            if str(one.placed) in left:
                unseen = _unseen(here, momentum, seen, model, one.placed)
                if unseen is None:
                    return kept
                accepted.append(replace(one, tie=(*one.tie, *((placed,) for placed in unseen))))
        return near, seen, SearchResult(model, tuple(accepted), rounds, found.extra, notes)
    return kept


def _both_ties(one: Accepted, found: SearchResult) -> Accepted:
    """Return an effect with all that either judge cannot tell from it."""
    more = [
        tied
        for other in found.accepted
        if str(one.placed) in _tied(other)
        for tied in other.tie
        if placed_name(tied) not in _tied(one)
    ]
    return replace(one, tie=(*one.tie, *more))


def _effects(result: SearchResult) -> tuple[Placed, ...]:
    """Return what a search accepted."""
    return tuple(one.placed for one in result.accepted)


def _shorter(usual: OutputForm, form: OutputForm, nominal: Fitted) -> Iterator[tuple[OutputForm, Fitted]]:
    """Yield the horizon that was clearer; else shorter and shorter ones, with the nominal model fitted there."""
    if form is not usual:
        yield form, nominal
        return
    longest = max(len(one) for one in usual.records["estimation"]) * usual.sample_time
    whole, least = usual.horizon or longest, FEWEST * usual.sample_time
    for seconds in dict.fromkeys(max(part * whole, least) for part in SHORT):
        near, seen = usual.shortened(nominal, seconds)
        yield near, fit_here(near, (), [seen.values])


def _simulated(here: Search, nominal: Fitted, effects: tuple[Placed, ...], start: Fitted) -> Fitted | None:
    """Return the model of the balance refitted to simulations, without what they do not miss; None if they refuse it.

    They need not prove it again; but error must be gone, and no sign wrong.
    """
    model = here.refitter.fit(Task(effects, ({**nominal.values, **start.values},)))
    while model is not None and model.finite and len(model.effects) > 1:
        idle = _idle(here, model)
        if idle is None:
            break
        model = idle
    if model is None or not model.finite or not model.converged:
        return None
    judged = assess(here.form, nominal, [(model.effects, model)], surrogate_p=None, seed=here.seed)[0]
    wrong = any(reason.endswith(WRONG_SIGN) for reason in judged.judgement.reasons)
    return None if wrong or judged.comparison.gain < GAIN else model


def _rival_stands(here: Search, momentum: MomentumForm, nominal: Fitted, model: Fitted, result: SearchResult) -> bool:
    """Return True if the answer of simulations alone stands against that of the balance, over the same windows.

    With an effect that the balance cannot judge: unless it is clearly worse. With more effects: if clearly better.
    """
    other = _effects(result)
    left, known = {str(one) for one in model.effects}, {str(one) for one in other}
    hidden, larger = any(not momentum.judges(one) for one in other), left < known
    if left == known:
        return True
    if not (hidden or larger):
        return False
    rival = here.refitter.fit(Task(other, ({**nominal.values, **result.model.values},)))
    if rival is None or not rival.finite:
        return False
    rng = stream("diagnosis-opinions", placed_name(model.effects), here.seed)
    versus = compare_blocks(rival.validation, model.validation, rng=rng)
    if hidden:
        return versus.gain < ALIKE or not versus.distinguishable
    return versus.gain <= -ALIKE and versus.distinguishable


def _tied(one: Accepted) -> set[str]:
    """Return the names of an effect and of what cannot be told from it."""
    return {str(placed) for tied in one.tie for placed in tied}


def _unseen(
    here: Search, momentum: MomentumForm, nominal: Fitted, model: Fitted, placed: Placed
) -> list[Placed] | None:
    """Return the effects which the balance cannot judge that explain simulations as well in the place of one.

    They must pass the rule of acceptance. None if one of them explains simulations better.
    """
    rest = tuple(one for one in model.effects if str(one) != str(placed))
    known = {k: v for k, v in model.values.items() if not k.startswith(f"{placed}.")}
    rivals = [one for one in here.candidates if not momentum.judges(one) and compatible((*rest, one))]
    tasks = [Task((*rest, one), starts_of(here, replace(nominal, values=known), [one], {})) for one in rivals]
    before = here.refitter.fit(Task(rest, (known,))) if rest else nominal
    alike: list[Placed] = []
    for judged in here.judge(before or nominal, tasks, [(one,) for one in rivals], None):
        if not judged.accepted or judged.fitted is None:
            continue
        rng = stream("diagnosis-opinions", f"{placed} against {judged.name}", here.seed)
        versus = compare_blocks(model.validation, judged.fitted.validation, rng=rng)
        if versus.gain >= ALIKE and versus.distinguishable:
            return None
        if versus.gain > -ALIKE:
            alike += judged.added
    return alike


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
