"""What is left of the residual after the search, graded in every view in which a missing law may show itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import Adequacy, grade, no_small_disturbance, nothing_left, predictable_part
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import short_window
from harness.diagnosis.response import Family, responses_of
from harness.diagnosis.subset import SearchResult
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["leftover"]


def leftover(
    form: Any,
    result: SearchResult,
    others: Sequence[tuple[Any, Fitted]],
    dataset: Dataset,
    seed: int,
    *,
    detected: bool,
) -> tuple[Adequacy, dict[str, Family]]:
    """Return how much of what is left can be predicted on validation data, and by which curves.

    Parameters
    ----------
    form : Form
        That judged.
    result : SearchResult
    others : sequence of (form, model)
        Further views of the same answer: the usual horizon where a shorter one judged.
    dataset : Dataset
    seed : int
        Keys the random draws.
    detected : bool
        Is anything left beyond the sensors' noise.
    """
    model = result.model
    if not (detected or not all(form.floors)):
        return nothing_left(), {}
    views = [(form, model), *others] if detected else [(form, model)]
    seconds, horizon = short_window(dataset), getattr(form, "horizon", None)
    longer = horizon is None or horizon > 1.5 * seconds
    shorter = not result.accepted and horizon is not None and horizon < seconds / 1.5
    if isinstance(form, OutputForm) and detected and (longer or shorter):
        views.append(form.shortened(model, seconds))
    found = [_graded(*view, seed) for view in views]
    best = max(found, key=lambda one: one[0].rest)
    if not (isinstance(form, OutputForm) and detected):
        return best
    if not result.accepted and not best[0].predictable:
        checked = [(form, model), *others, form.shortened(model, seconds)]
        if any(_too_large(*view) for view in checked):
            best = (replace(best[0], grade="proxy_or_incomplete", too_large=True), best[1])
    return best


def _too_large(form: Any, model: Fitted) -> bool:
    """Return True if what is left is no small disturbance, on estimation or on validation."""
    for use, parts in (("estimation", model.estimation), ("validation", model.validation)):
        outputs = [run.y / form.weights for run in form.records[use]]
        if no_small_disturbance(parts, outputs, form.floors):
            return True
    return False


def _graded(form: Form, fitted: Fitted, seed: int) -> tuple[Adequacy, dict[str, Family]]:
    """Return how much of what is left can be predicted on validation data."""
    responses, families, outside = responses_of(form, fitted)
    usable = {
        name: pair for name, pair in responses.items() if all(np.isfinite(one).all() for part in pair for one in part)
    }
    seams = getattr(form, "seams", None)
    windows = ((), ()) if seams is None else (seams(fitted), seams(fitted, "validation"))
    inside = form.clean(fitted, [one[:, :, None] for one in fitted.estimation])
    found, null = predictable_part(
        [one[:, :, 0] for one in inside],
        outside,
        usable,
        rng=stream("diagnosis-adequacy", seed),
        roughness={name: family.roughness() for name, family in families.items()},
        windows=windows,
    )
    return grade(found, null, outside, form.floors, rng=stream("diagnosis-adequacy-blocks", seed)), families
