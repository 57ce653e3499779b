"""Shorter windows where something unknown disturbs the plant: there the effects stand out most.

Over a long free run an unmeasured force adds up until it hides everything; over a short window it has moved the plant
little, while the effect of a law shows at once. Without a disturbance long runs tell more. So where the nominal model
leaves far more than the sensors' noise, the dictionary is tried over short windows first; if the best candidate comes
near the noise over the long horizon, that was the reason and the long horizon judges. Otherwise the short one does,
unless it finds nothing and the long one does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.diagnosis.accept import bic
from harness.diagnosis.confirm import far_above
from harness.diagnosis.forms import Fitted, fit_here, stacked
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.refit import Task
from harness.diagnosis.residual_tests import effective_samples
from harness.diagnosis.subset import Search, SearchResult
from harness.diagnosis.surrogates import ENOUGH, orthonormal
from harness.effects.effect import Placed

__all__ = ["searched"]

PARTS = (0.3, 0.1)
"""Shorter horizons that are tried, as parts of the usual one: 50 samples at least, and windows enough to shuffle."""
TYPICAL = (
    "coulomb_friction",
    "quadratic_drag",
    "linear_spring",
    "force_bias",
    "input_delay",
    "dead_zone",
    "sensor_delay",
)
"""Effects by which horizons are compared."""


def searched(
    form: Any,
    nominal: Fitted,
    search_of: Callable[[Any], Search],
    sizes: Callable[[Placed], Mapping[str, float]],
) -> tuple[Any, Fitted, SearchResult]:
    """Return the form that judged, the nominal model in it, and what the search found.

    Parameters
    ----------
    form : Form
        At the usual horizon.
    nominal : Fitted
    search_of : callable
        Makes the search in a form.
    sizes : callable
        Sizes of the data at an effect's port.
    """
    search = search_of(form)
    if type(form) is not OutputForm or not far_above(form, nominal) or not search.candidates:
        return form, nominal, search.run(nominal)
    seconds = _clearest(form, nominal, search.candidates, sizes)
    if seconds is None:
        return form, nominal, search.run(nominal)
    short, seen = form.shortened(nominal, seconds)
    seen = fit_here(short, (), [seen.values])
    near = search_of(short)
    first = near.round(seen) if near.detected(seen) else None
    if first is None or not _still_far(search, [one.fitted for one in first.candidates]):
        return form, nominal, search.run(nominal)
    result = near.run(seen, first=first)
    if len(result.accepted) > 1 and not _still_far(search, [result.model]):
        return form, nominal, search.run(nominal)
    if not result.accepted:
        # what distorts a reading, or acts slowly, may show in long runs only
        slow = search.round(nominal)
        if search.winner(slow.candidates) is not None:
            return form, nominal, search.run(nominal, first=slow)
    return short, seen, result


def _still_far(search: Search, models: Sequence[Fitted | None]) -> bool:
    """Return True if the best of models found over short windows stays far above the noise over the usual horizon."""
    usable = [one for one in models if one is not None and one.finite]
    if not usable:
        return True
    best = min(usable, key=lambda one: bic(one.estimation, 0, 1.0))
    over = search.refitter.fit(Task(best.effects, (best.values,)))
    return over is None or not over.finite or far_above(search.form, over)


def _clearest(
    form: Any, nominal: Fitted, candidates: Sequence[Placed], sizes: Callable[[Placed], Mapping[str, float]]
) -> float | None:
    """Return the horizon [s] over which typical effects stand out most from what is left; None for the usual one."""
    usual = max(len(one) for one in form.records["estimation"]) * form.sample_time
    usual = usual if form.horizon is None else form.horizon
    total = sum(len(one) for one in form.records["estimation"]) * form.sample_time
    lengths = [max(part * usual, 50 * form.sample_time) for part in PARTS]
    some = [one for one in candidates if one.effect.name in TYPICAL] or list(candidates)[:8]
    best, chosen = _clearness(form, nominal, some, sizes), None
    for seconds in dict.fromkeys(one for one in lengths if one < 0.6 * usual and one * ENOUGH <= 1.001 * total):
        short, seen = form.shortened(nominal, seconds)
        power = _clearness(short, seen, some, sizes)
        if power > best:
            best, chosen = power, seconds
    return chosen


def _clearness(
    form: Any, fitted: Fitted, some: Sequence[Placed], sizes: Callable[[Placed], Mapping[str, float]]
) -> float:
    """Return the median over effects of the logarithm of N_eff |change|^2 / |residual|^2.

    The change is that of an effect of usual size; what parameters and initial states can do is taken out of both.
    """
    basis = orthonormal(stacked(fitted.jacobian), tolerance=1e-7)
    rest = stacked(form.clean(fitted, [one[:, :, None] for one in fitted.estimation]))[:, 0]
    rest = rest - basis @ (basis.T @ rest)
    independent = sum(effective_samples(one[:, j]) for one in fitted.estimation for j in range(one.shape[1]))
    found = []
    for placed in some:
        parts = form.responses(fitted, placed, placed.effect.complete(placed.values, sizes(placed)))
        if parts is None:
            continue
        change = stacked(parts)[:, 0]
        change = change - basis @ (basis.T @ change)
        size = float(change @ change)
        if np.isfinite(size) and size > 0:
            found.append(np.log(independent * size / max(float(rest @ rest), 1e-300)))
    return float(np.median(found)) if found else -np.inf
