"""What is left of the residual after the search, graded in every view in which a missing law may show itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.adequacy import LEVEL, Adequacy, grade, no_small_disturbance, nothing_left, predictable_part
from harness.diagnosis.equation import bump_rows
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.momentum_form import MomentumForm
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.prepare import short_window
from harness.diagnosis.response import Family, force_along, responses_of
from harness.diagnosis.subset import SearchResult
from harness.diagnosis.surrogates import ENOUGH
from harness.diagnosis.witness import found_function
from harness.rng import stream
from harness.signals import Dataset

__all__ = ["leftover"]

CONFIRMED = 3.0
"""Standard errors by which a force that simulations predict must show in the balance of the validation records."""
TRACE = 0.005
"""Share of the change of momentum below which a force that predicts the rest may be a trace of smoothing. On cart-poles
without any effect the traces had up to 0.4 %."""


def leftover(
    form: Any,
    result: SearchResult,
    others: Sequence[tuple[Any, Fitted]],
    weak: EquationForm | None,
    dataset: Dataset,
    seed: int,
    *,
    detected: bool,
    balance: MomentumForm | None = None,
    unbalanced: bool = False,
) -> tuple[Adequacy, dict[str, Family]]:
    """Return how much of what is left can be predicted on validation data, and by which curves.

    Parameters
    ----------
    form : Form
        That judged.
    result : SearchResult
    others : sequence of (form, model)
        Further views of the same answer: the usual horizon where a shorter one judged.
    weak : EquationForm or None
        The momentum balance of the measured motion, where there is one.
    dataset : Dataset
    seed : int
        Keys the random draws.
    detected : bool
        Is anything left beyond the sensors' noise.
    balance : MomentumForm, optional
        Where something disturbs the plant: the whitened balance is one view more. Simulations over few windows, whose
        errors ring for so long that their surrogates say little, then count only with a force that it confirms.
    unbalanced : bool
        The forces of the nominal model are far from the change of momentum: that is no disturbance.
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
    if balance is not None and all(balance.judges(one) for one in model.effects):
        seen = _in_balance(balance, model)
        found = [_without_details(balance, *_graded(balance, seen, seed))]
        for view in views:
            one = _graded(*view, seed)
            if len(view[0].seams(view[1])) >= ENOUGH or _confirmed(balance, seen, *one):
                found.append(one)
    else:
        found = [_graded(*view, seed) for view in views]
    best = max(found, key=lambda one: one[0].rest)
    if not (isinstance(form, OutputForm) and detected):
        return best
    direct = weak is not None and balance is None and all(weak.judges(one) for one in model.effects)
    if not best[0].predictable and weak is not None and direct:
        # a strong law makes free runs lose track; in the momentum balance of the measured motion it shows directly
        other = _graded(weak, _in_balance(weak, model), seed)
        best = other if other[0].predictable else best
    if not result.accepted and not best[0].predictable:
        checked = [(form, model), *others, form.shortened(model, seconds)]
        if unbalanced or any(_too_large(*view) for view in checked):
            best = (replace(best[0], grade="proxy_or_incomplete", too_large=True), best[1])
    return best


def _in_balance(form: EquationForm, model: Fitted) -> Fitted:
    """Return a model refitted to a balance of forces."""
    return form.evaluate(model.effects, form.solve(model.effects, [model.values], seed=0))


def _without_details(
    balance: MomentumForm, adequacy: Adequacy, families: dict[str, Family]
) -> tuple[Adequacy, dict[str, Family]]:
    """Return the grade of the balance; a force that is a detail of the smoothed motion does not count."""
    best = adequacy.best
    if best is None or not adequacy.predictable:
        return adequacy, families
    motions = balance.motions["estimation"]
    forces = [force_along(families[best.axes], best.coefficients, balance.nominal, motion) for motion in motions]
    if balance.share([bump_rows(one, motion) for one, motion in zip(forces, motions, strict=True)]) >= TRACE:
        return adequacy, families
    return replace(adequacy, grade="explained", rest=1.0, predictable=False), families


def _confirmed(balance: MomentumForm, seen: Fitted, adequacy: Adequacy, families: Mapping[str, Family]) -> bool:
    """Return True if the balance shows a force that simulations predict, on records that it was not fitted to."""
    return any(
        found_function(balance, seen, families[one.axes], one.coefficients) >= CONFIRMED
        for one in adequacy.families
        if one.share > 0 and one.p <= LEVEL and families[one.axes].place.startswith("force on ")
    )


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
