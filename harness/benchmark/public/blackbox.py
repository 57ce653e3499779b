"""The black-box column: every declared identifier learns, the validation part chooses one, all data teach it anew."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness import registry
from harness.benchmark.public.choices import Candidate
from harness.benchmark.public.rules import Rule
from harness.benchmark.public.scores import figure, simulated
from harness.errors import HarnessError
from harness.protocols import Model
from harness.rng import stream
from harness.signals import Trajectory

WHOLE_RECORDS = 4  # From so many records on, whole ones validate.


@dataclass(frozen=True)
class Tried:
    """One identifier with its options on the validation part."""

    identifier: str
    options: dict[str, Any]
    figure: float | None  # The rule's own figure there, in its unit; None where there is no model
    seconds: float  # Of the fit, wall time
    reason: str = ""  # Why there is no figure


def parted(train: Sequence[Trajectory], share: float) -> tuple[tuple[Trajectory, ...], tuple[Trajectory, ...]]:
    """Return the records to learn from in two parts, the second to choose between models.

    - ``share``: of whole records where there are at least four; otherwise of each record, at its end

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> one = Trajectory(np.arange(8.0), np.zeros((8, 1)), np.zeros((8, 1)), spec)
    >>> learn, validate = parted([one], 0.25)
    >>> len(learn[0]), len(validate[0])
    (6, 2)
    """
    if len(train) >= WHOLE_RECORDS:
        cut = len(train) - max(1, round(share * len(train)))
        return tuple(train[:cut]), tuple(train[cut:])
    cuts = [round((1.0 - share) * len(one)) for one in train]
    return (
        tuple(one[:cut] for one, cut in zip(train, cuts, strict=True)),
        tuple(one[cut:] for one, cut in zip(train, cuts, strict=True)),
    )


def chosen(
    rule: Rule,
    train: Sequence[Trajectory],
    share: float,
    candidates: Sequence[Candidate],
    progress: Callable[[str], None] | None = None,
) -> tuple[Model | None, Tried | None, list[Tried]]:
    """Return the model of the identifier that is best on the validation part, fitted to all of the records.

    - ``train``: the records to learn from; no test record comes near this function
    - ``share, candidates``: see :class:`harness.benchmark.public.choices.BlackChoices`
    - ``progress``: called with what is fitted next
    - returns the model, what was chosen, and all that was tried; None for the first two where no candidate has a finite
      figure, or where the chosen one cannot be fitted to all of the records
    """
    learn, validate = parted(train, share)
    tried: list[Tried] = []
    rows: dict[int, int | None] = {}
    for candidate in candidates:
        for options in candidate.variants():
            if progress is not None:
                progress(f"{candidate.id} {_words(options)}".strip())
            rows[len(tried)] = candidate.rows
            tried.append(_judged(rule, learn, validate, candidate, options))
    order = sorted((one.figure, number) for number, one in enumerate(tried) if one.figure is not None)
    if not order or not np.isfinite(order[0][0]):
        return None, None, tried
    best = tried[order[0][1]]
    if progress is not None:
        progress(f"{best.identifier} {_words(best.options)}".strip() + ", on all of the data")
    try:
        return _fitted(rule, train, best.identifier, best.options, rows[order[0][1]]), best, tried
    except HarnessError as error:
        lost = Tried(best.identifier, best.options, None, best.seconds, f"on all of the data: {error}")
        return None, None, [*tried, lost]


def _judged(
    rule: Rule,
    learn: Sequence[Trajectory],
    validate: Sequence[Trajectory],
    candidate: Candidate,
    options: dict[str, Any],
) -> Tried:
    """Return one identifier's figure on the validation part."""
    began = time.perf_counter()
    try:
        model = _fitted(rule, learn, candidate.id, options, candidate.rows)
        seconds = time.perf_counter() - began
        outputs = [simulated(model, one, rule.window) for one in validate]
        value = figure(rule, [one.y for one in validate], outputs)
    except HarnessError as error:
        return Tried(candidate.id, options, None, time.perf_counter() - began, " ".join(str(error).split())[:400])
    if not np.isfinite(value):
        return Tried(candidate.id, options, None, seconds, "its free run over the validation part diverges")
    return Tried(candidate.id, options, value, seconds)


def _fitted(
    rule: Rule, records: Sequence[Trajectory], identifier: str, options: dict[str, Any], rows: int | None
) -> Model:
    """Return a model; the random numbers are keyed by set and identifier."""
    learner = registry.create("identifiers", identifier, **options)
    model: Model = learner.fit([one[:rows] for one in records], rng=stream("public", rule.id, identifier))
    return model


def _words(options: dict[str, Any]) -> str:
    """Return options on one line."""
    return ", ".join(f"{name}={value}" for name, value in options.items())
