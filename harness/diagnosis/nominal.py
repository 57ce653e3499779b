"""The first fit of the nominal model: from two starts or more, and every output weighed by what is known of its noise.

Two starts through short windows are enough where they agree and the sensor is what limits the fit. Where they do not,
or where no sensor noise is known that says how good the fit should be, more starts descend on the whole horizon at
once: the way through short windows hides minima that only long runs have. Of minima that the data cannot tell apart
the one nearest to what was known of the parameters counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from harness.diagnosis.accept import DELTA_BIC, bic, information_samples
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, Form, fit_here, rms, vanished
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.output_form import OutputForm
from harness.errors import HarnessError
from harness.rng import stream

__all__ = ["fit_nominal", "reweighed"]

SAME = 1e-3
"""Relative difference of the cost within which two ends are one minimum."""
NEAR, WIDE = 0.3, 1.2
"""Spread (of the logarithm) of the second start and of the further ones."""
MORE = 8


def fit_nominal(
    form: Form, values: Mapping[str, float], seed: int, floors: tuple[NoiseFloor, ...] = ()
) -> tuple[Fitted, bool]:
    """Return the nominal fit, and whether a second start ends in the same minimum.

    Parameters
    ----------
    form : Form
    values : mapping
        Start values by name.
    seed : int
        Keys the further starts.
    floors : tuple of NoiseFloor
        Noise floors of the outputs; one that is no sensor noise asks for more starts.

    Returns
    -------
    (Fitted, bool)
    """
    first = form.solve((), [dict(values)], seed=seed)
    rng = stream("diagnosis-second-start", seed)
    ends = [first]
    try:
        ends.append(form.solve((), [_moved(form, values, rng, NEAR)], seed=seed))
    except HarnessError:
        ends = [first]
    same = len(ends) == 2 and _alike(ends[0], ends[1])
    unknown = any(one.source in (None, "black_box") for one in floors)
    if isinstance(form, OutputForm) and form.many_starts and (unknown or not same):
        ends += form.directly([_moved(form, values, rng, WIDE) for _ in range(MORE)])
        form.direct = True  # what hides minima from this fit hides them from the refits
    lowest = min(ends, key=lambda one: one["cost"])["values"]
    if gone := vanished(form.nominal, lowest):
        # near 0 nothing moves them any more, wherever they should be: once more, from what the model declares
        declared = {name: form.nominal.parameter(name).value for name in gone}
        ends.append(form.solve((), [{**lowest, **declared}], seed=seed))
    minima = _distinct(ends)
    if len(minima) == 1:
        return form.evaluate((), minima[0]), sum(_alike(minima[0], one) for one in ends) > 1
    fits = [form.evaluate((), one) for one in minima]
    fits = [one for one in fits if one.finite] or fits[:1]
    samples = information_samples(fits[0].estimation, None)
    scores = [bic(one.estimation, 0, samples) for one in fits]
    tied = [one for one, score in zip(fits, scores, strict=True) if score - scores[0] < DELTA_BIC]
    best = min(tied, key=lambda one: _from_known(form.nominal, one))  # the lowest one where nothing is known
    return best, sum(_alike(best.record, one) for one in ends) > 1


def _moved(form: Form, values: Mapping[str, float], rng: np.random.Generator, spread: float) -> dict[str, float]:
    """Return start values drawn around the given ones within the bounds of the parameters."""
    return {
        one.name: values[one.name]
        if one.fixed
        else float(np.clip(values[one.name] * np.exp(spread * rng.standard_normal()), one.minimum, one.maximum))
        for one in form.nominal.parameters
    }


def _alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Return True if two ends are one minimum."""
    return abs(one["cost"] - other["cost"]) <= SAME * max(min(one["cost"], other["cost"]), 1e-300)


def _distinct(ends: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return one end of each minimum, lowest cost first."""
    result: list[dict[str, float]] = []
    for one in sorted(ends, key=lambda end: end["cost"]):
        if not any(_alike(one, other) for other in result):
            result.append(one)
    return result


def _from_known(system: Any, fitted: Fitted) -> float:
    """Return how far the parameters are from what the model declares: rms of the logarithm of their ratio.

    Only parameters that cannot be negative count: the declared value of another says nothing about its size.
    """
    known = system.values()
    ratios = [fitted.values[one.name] / known[one.name] for one in system.parameters if one.positive and not one.fixed]
    usable = np.array([ratio for ratio in ratios if np.isfinite(ratio) and ratio > 0])
    return float(np.sqrt(np.mean(np.log(usable) ** 2))) if usable.size else 0.0


def _measure_levels(output: OutputForm, nominal: Fitted) -> None:
    """Take the size of unmeasured levels from the fitted model: rims and limits start from it."""
    levels = [port.name for port in nominal.system.ports if port.kind == "process"]
    if not levels:
        return
    p = nominal.system.vector(nominal.values)
    windows = output._windows(nominal.system, p, "estimation")
    x0 = np.array(nominal.record["x0"], dtype=float).reshape(len(windows), nominal.system.nx)
    path = np.concatenate(windows.evaluate(p, x0, keep=True).states)
    names = [channel.name for channel in nominal.system.states]
    sizes = {name: {**own} for name, own in output.sizes.items()}
    for name in levels:
        sizes.setdefault(name, {})["x"] = float(np.sqrt(np.mean(path[:, names.index(name)] ** 2)))
    output.sizes = sizes


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
        ratio = weights / output.weights
        output.weights = weights
        if np.allclose(ratio, ratio[0]):
            # one common factor moves no minimum
            nominal = output.evaluate((), {**nominal.record, "cost": float(nominal.record["cost"] / ratio[0] ** 2)})
        else:
            nominal = fit_here(output, (), [dict(nominal.values)])
    output.floors = tuple(None if f.value is None else f.value / w for f, w in zip(floors, weights, strict=True))
    _measure_levels(output, nominal)
    return output, nominal, floors
