"""Effects added to a physical model one by one, as long as the free runs that a rule scores get better by them.

The loop judges what a model lacks by short stretches, in which forces show; a rule may score one run over half a
minute, in which a small force that the loop leaves open adds up. Here the yardstick is the rule's own figure, with each
half of every record foretold by what the other half taught. No test record takes part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness import registry
from harness.benchmark.public.rules import Rule
from harness.benchmark.public.scores import figure, simulated
from harness.errors import HarnessError
from harness.protocols import Model
from harness.rng import stream
from harness.signals import Trajectory

_WORTH = 0.95
"""An effect must bring the figure over both halves below this share of what it is without: what half a record of one
motion says is no surer than some percent, and the best of some thirty tries is flattered."""


@dataclass(frozen=True)
class PublicModel:
    """A physical model: what is built into it, and where its parameters start."""

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)  # Of the model's function
    effects: tuple[str, ...] = ()  # ``"coulomb_friction@q"``
    start: Mapping[str, float] = field(default_factory=dict)  # Parameters
    intersample: str = "zoh"


def refitted(rule: Rule, structure: PublicModel, records: Sequence[Trajectory]) -> Model | None:
    """Return a structure fitted to free runs over whole records, or None where that fails."""
    options = {
        "model": structure.model,
        "options": dict(structure.options),
        "effects": structure.effects,
        "start": dict(structure.start),
        "intersample": structure.intersample,
        "horizon": "record",
    }
    try:
        learner = registry.create("identifiers", "output-error", **options)
        model: Model = learner.fit(list(records), rng=stream("public", rule.id, "output-error"))
    except HarnessError:
        return None
    return model


def halves_figure(rule: Rule, structure: PublicModel, records: Sequence[Trajectory]) -> float:
    """Return the rule's figure where each half of every record is foretold by a fit to the other halves.

    - returns the root mean square of both, in the rule's unit; infinite where a fit fails
    """
    halves = [[one[: len(one) // 2] for one in records], [one[len(one) // 2 :] for one in records]]
    found = []
    for learn, test in (halves, halves[::-1]):
        model = refitted(rule, structure, learn)
        if model is None:
            return np.inf
        try:
            found.append(figure(rule, [one.y for one in test], [simulated(model, one, rule.window) for one in test]))
        except HarnessError:
            return np.inf
    return float(np.sqrt(np.mean(np.square(found))))


def grown(
    rule: Rule,
    starts: Sequence[PublicModel],
    records: Sequence[Trajectory],
    most: int,
    progress: Callable[[str], None] | None = None,
) -> tuple[PublicModel, float]:
    """Return the best structure that effects of the dictionary lead to, and its figure over both halves.

    - ``starts``: from each of them effects are added, the best one each time; not from one that does worse as it stands
      than what an earlier one has led to
    - ``records``: the records to learn from, in the model's channels
    - ``most``: effects that are added
    - ``progress``: called with what is fitted next
    """
    best, error = starts[0], np.inf
    for start in starts:
        bare = halves_figure(rule, start, records)
        if bare < error:
            best, error = _path(rule, start, bare, records, most, progress)
    return best, error


def _path(
    rule: Rule,
    best: PublicModel,
    error: float,
    records: Sequence[Trajectory],
    most: int,
    progress: Callable[[str], None] | None,
) -> tuple[PublicModel, float]:
    """Return where adding the best effect each time leads from one structure, and its figure over both halves.

    An effect counts only if the structure, fitted to all records, errs over them no more than over the halves, within
    the accuracy of such figures.
    """
    places = _places(best)
    for _ in range(most):
        tried: list[tuple[float, int, PublicModel]] = []
        for rank, place in enumerate(places):
            if place in best.effects:
                continue
            if progress is not None:
                progress(f"{', '.join((*best.effects, place))}: best so far {error:.3g} {rule.unit}")
            more = PublicModel(best.model, best.options, (*best.effects, place), best.start, best.intersample)
            tried.append((halves_figure(rule, more, records), rank, more))
        for least, _, more in sorted(tried, key=lambda one: one[:2]):
            if not least < _WORTH * error:
                return best, error
            model = refitted(rule, more, records)
            if model is not None and _WORTH * _own_figure(rule, model, records) <= least:
                best = PublicModel(more.model, more.options, more.effects, _parameters(model), more.intersample)
                error = least
                break
        else:
            return best, error
    return best, error


def _own_figure(rule: Rule, model: Model, records: Sequence[Trajectory]) -> float:
    """Return the rule's figure over the records that a model was fitted to.

    Where it is above that of the halves, which fits to other samples foretold, the halves were luck: a state that the
    few samples of the window do not show makes every run another one.
    """
    try:
        return figure(rule, [one.y for one in records], [simulated(model, one, rule.window) for one in records])
    except HarnessError:
        return float("inf")


def _places(structure: PublicModel) -> list[str]:
    """Return every effect of the dictionary at every port of the model that it fits, but for laws of the clock.

    What acted at some time of the training records tells nothing of a test record, whose clock begins anew.
    """
    from harness.diagnosis.dictionary import laws_of, placed
    from harness.physics import load_model

    found, _ = placed(load_model(structure.model, **dict(structure.options)), laws_of())
    return [f"{one.effect.name}@{one.at}" for one in found if "t" not in one.effect.extras]


def _parameters(model: Any) -> dict[str, float]:
    """Return the parameters of a grey box."""
    return {name: float(value) for name, value in model.parameters.items()}
