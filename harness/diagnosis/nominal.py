"""The first fit of the nominal model: from two starts, and with every output weighed by what is known of its noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form, fit_here, rms
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.output_form import OutputForm
from harness.errors import HarnessError
from harness.rng import stream

__all__ = ["fit_nominal", "reweighed"]


def fit_nominal(form: Form, values: Mapping[str, float], seed: int) -> tuple[Fitted, bool]:
    """Return the nominal fit, and whether a second start ends in the same minimum."""
    first = form.solve((), [dict(values)], seed=seed)
    rng = stream("diagnosis-second-start", seed)
    moved = {
        one.name: values[one.name]
        if one.fixed
        else float(np.clip(values[one.name] * np.exp(0.3 * rng.standard_normal()), one.minimum, one.maximum))
        for one in form.nominal.parameters
    }
    try:
        second = form.solve((), [moved], seed=seed)
    except HarnessError:
        return form.evaluate((), first), False
    best = min((first, second), key=lambda one: float(one["cost"]))
    same = abs(first["cost"] - second["cost"]) <= 1e-3 * max(best["cost"], 1e-300)
    return form.evaluate((), best), bool(same)


def reweighed(
    form: Form, output: OutputForm, nominal: Fitted, floors: tuple[NoiseFloor, ...], warnings: list[str]
) -> tuple[Form, Fitted, tuple[NoiseFloor, ...]]:
    """Weigh columns of unknown noise by their nominal residual; give up a black box that the nominal model beats."""
    size = rms(nominal.estimation) * form.weights
    if isinstance(form, EquationForm):
        form.weights = size
        return form, form.evaluate((), nominal.record), floors
    kept = []
    for value, floor in zip(size, floors, strict=True):
        if floor.source == "black_box" and floor.value is not None and value < 0.9 * floor.value:
            note = f"{floor.note}; not used: the nominal model does better ({value:.3g} against {floor.value:.3g})"
            warnings.append(f"noise floor of {floor.output} unknown: {note}")
            kept.append(replace(floor, value=None, source=None, note=note))
        else:
            kept.append(floor)
    floors = tuple(kept)
    weights = np.array([f.value if f.value else float(s) for f, s in zip(floors, size, strict=True)])
    if not np.allclose(weights, output.weights):
        output.weights = weights
        known = dict(nominal.values)
        nominal = fit_here(output, (), [known])
    output.floors = tuple(None if f.value is None else f.value / w for f, w in zip(floors, weights, strict=True))
    return output, nominal, floors
