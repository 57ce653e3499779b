"""Values with their intervals, as far as the data determine them; where they tell ratios only, the ratios."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.table import Accepted
from harness.diagnosis.systems import AnySystem
from harness.signals import Dataset
from harness.units import quotient
from harness.units.grammar import composed


def known(value: float | None) -> float | None:
    """Return a finite number, or None."""
    return None if value is None or not np.isfinite(value) else float(value)


def estimate(fit: Fit, name: str, together: Sequence[str] = ()) -> dict[str, Any]:
    """Return a parameter with its interval, its unit, and why it has no interval where there is none.

    ``together`` are those of which the data tell ratios only: the curvature of a fit that stopped somewhere along the
    scale says nothing of them.
    """
    entry: dict[str, Any] = {"value": known(fit.values[name]), "low": None, "high": None,
                           "unit": fit.system.parameter(name).unit, "state": "fixed"}  # fmt: skip
    if name not in fit.free:
        return entry
    entry["state"] = "on_bound" if name in fit.on_bound else "not_determined"
    if name not in together and fit.deviations.get(name, 0.0) > 0 and np.isfinite(fit.deviations[name]):
        _limit(entry, *fit.interval(name), positive=name in fit.logarithmic)
    return entry


def effect_data(fit: Fit, accepted: Accepted, together: Sequence[str] = ()) -> dict[str, Any]:
    """Return one accepted effect with its parameters."""
    effect = accepted.placed.effect
    return {
        "name": effect.name,
        "at": accepted.placed.at,
        "parameters": {
            parameter.name: {
                **estimate(fit, accepted.placed.name(parameter.name), together),
                "meaning": parameter.meaning,
            }
            for parameter in effect.parameters
        },
        "evidence": known(accepted.evidence),
        "validation_gain": known(accepted.validation),
        "delta_bic": known(2 * accepted.evidence),
        "formula": effect.formula,
        "summary": effect.summary,
        "may_be_part_of": accepted.part_of and f"a force at {accepted.part_of}",
        "given": accepted.given,
        "rounds": effect.sampled == "quantise",
    }


def _limit(entry: dict[str, Any], low: float, high: float, *, positive: bool) -> None:
    """Give an estimate its interval, if that determines anything."""
    if not np.isfinite([low, high]).all() or (positive and abs(high) > POLICY.widest * abs(low)):
        return
    entry.update(low=low, high=high, state="determined")


def scaled_together(system: AnySystem, fit: Fit, dataset: Dataset) -> list[str]:
    """Return parameters of which the data tell ratios only: those that carry a mass, if nothing drives the model.

    One of them that is known, or an input that is not 0 all the time, fixes the scale of them all.
    """
    if not system.coordinates or any(np.any(run.u) for run in dataset.estimation):
        return []
    heavy = [parameter for parameter in fit.system.parameters if _base(parameter.unit)[0].get("kg") == 1]
    own = [parameter.name for parameter in system.parameters]
    if any(parameter.name in own and parameter.name not in fit.free for parameter in heavy):
        return []
    together = [parameter.name for parameter in heavy if parameter.name in fit.free]
    return together if len(together) > 1 else []


def ratios(fit: Fit, names: Sequence[str]) -> dict[str, Any]:
    """Return what each parameter is of the first one, with the interval that their covariance gives."""
    best = likelihood_detail(fit).best
    made: dict[str, Any] = {}
    for name in names[1:]:
        below, above = fit.values[names[0]], fit.values[name]
        entry = {"value": known(above / below) if below else None, "low": None, "high": None,
               "unit": ratio_unit(fit.system.parameter(name).unit, fit.system.parameter(names[0]).unit),
               "state": "not_determined"}  # fmt: skip
        rows = [best.names.index(each) for each in (name, names[0])]
        # derivatives of the logarithm of the ratio by what was estimated, a parameter or its logarithm
        gradient = np.array([sign / (1.0 if best.logarithmic[k] else best.parameters[each] or np.nan)
                           for sign, k, each in zip((1.0, -1.0), rows, (name, names[0]), strict=True)])  # fmt: skip
        variance = float(gradient @ best.covariance[np.ix_(rows, rows)] @ gradient)
        if entry["value"] is not None and 0 < variance < np.inf:
            half = 1.96 * float(np.sqrt(variance))
            ends = sorted(entry["value"] * (np.exp([-half, half]) if half < 50 else np.array([0.0, np.inf])))
            _limit(entry, float(ends[0]), float(ends[1]), positive=True)
        made[f"{name}/{names[0]}"] = entry
    return made


def ratio_unit(above: str, below: str) -> str:
    """Return the unit of a ratio in base units, radians left out; as it stands where units have factors.

    Examples
    --------
    >>> ratio_unit("N m s/rad", "kg m^2"), ratio_unit("N m", "kg m^2"), ratio_unit("kg", "mg")
    ('1/s', '1/s^2', 'kg/mg')
    """
    (first, factor), (second, other) = _base(above), _base(below)
    if factor != 1.0 or other != 1.0:
        return quotient(above, below)
    names = sorted({*first, *second} - {"rad"})
    return composed({name: first.get(name, 0) - second.get(name, 0) for name in names})


def _base(unit: str) -> tuple[dict[str, float], float]:
    """Return a unit as powers of base units, and the factor to them; nothing where it cannot be read."""
    from harness.errors import InputError
    from harness.units import base_units

    try:
        powers, factor, _ = base_units(unit or "1")
    except InputError:
        return {}, 0.0
    return powers, factor
