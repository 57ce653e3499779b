"""The errors of a model for the before/after table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.diagnosis.records.motion import measured_coordinates
from harness.diagnosis.runs.equation_form import EquationForm
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.systems import by_equations
from harness.signals import Dataset, FloatArray

USES = ("estimation", "validation", "test")


def figures(parts: Sequence[FloatArray], measured: Sequence[FloatArray], channels: Sequence[Any]) -> dict[str, Any]:
    """Return rms, NRMSE (over the standard deviation of the measurement) and unit by output; unknown ones are None.

    - ``parts`` sequence of array (N_i, ny): errors
    - ``measured`` sequence of array (N_i, ny): what the NRMSE divides by the standard deviation of
    - ``channels`` sequence of (name, unit)
    """
    if not parts:
        return {}
    error, truth = np.concatenate(list(parts)), np.concatenate(list(measured))
    result = {}
    for j, (name, unit) in enumerate(channels):
        rms = float(np.sqrt(np.mean(error[:, j] ** 2)))
        spread = float(np.std(truth[:, j]))
        still = 1e-12 * float(np.abs(truth[:, j]).max(initial=0.0))  # rounding of a constant is no spread
        known = bool(np.isfinite(rms))
        result[name] = {
            "rms": rms if known else None,
            "nrmse": rms / spread if known and spread > still else None,
            "unit": unit,
        }
    return result


def simulation_error(
    form: FreeRunForm,
    fitted: Fitted,
    dataset: Dataset,
    horizon: float | None,
    others: Sequence[float | None],
) -> dict[str, Any]:
    """Return the simulation error of every use at the horizon, and at other horizons.

    - ``fitted``: from either form
    - ``horizon``: seconds; None is the whole record
    - ``others``: more horizons

    Notes
    -----
    Initial states are fitted to each window. Where windows are used and the state is measured, the same windows
    started from the smoothed measurement are reported as well: a velocity read off a record is never exact.
    """
    longest = max(len(run.trajectory) for run in dataset) * dataset.spec.sample_time

    def at(length: float | None, start: str = "estimated") -> dict[str, Any]:
        row: dict[str, Any] = {}
        for use in USES:
            if dataset.using(use):  # type: ignore[arg-type]
                errors, _, _ = form.simulated(fitted, use, length, start=start)
                row[use] = figures(errors, [run.y for run in form.records[use]], form.columns)
            else:
                row[use] = {}
        return row

    result = at(horizon)
    result["horizon_s"] = longest if horizon is None else horizon
    result["whole_record"] = horizon is None
    result["initial_state"] = "estimated on each window"
    if horizon is not None and _state_is_read(form, fitted):
        result["from_measured_state"] = at(horizon, "data")
    result["other_horizons"] = [
        {**at(other), "horizon_s": longest if other is None else other, "whole_record": other is None}
        for other in others
    ]
    return result


def equation_error(
    output: FreeRunForm, strong: EquationForm | None, fitted: Fitted, dataset: Dataset, *, inverse: bool
) -> dict[str, Any]:
    """Return the equation error of every use.

    For inverse-dynamics models the residual force on measured motion (decimated); else the one-step prediction error
    from the smoothed measured state, None where the state is not measured.
    """
    result: dict[str, Any] = {}
    if inverse and strong is not None:
        equations = strong.equations(fitted.effects)
        p = equations.system.vector(fitted.values)
        for use in USES:
            parts = [equations.residual(motion, p) for motion in strong.motions[use]]
            pushes = [equations.force_of(motion, p) for motion in strong.motions[use]]
            result[use] = figures(parts, pushes, strong.columns)
        result["meaning"] = "residual force on measured motion, low-passed and decimated"
        return result
    known = _state_is_read(output, fitted)
    for use in USES:
        if not dataset.using(use) or not known:  # type: ignore[arg-type]
            result[use] = {}
            continue
        errors, _, _ = output.simulated(fitted, use, 2 * dataset.spec.sample_time, start="data")
        steps = [part[1::2] for part in errors]
        result[use] = figures(steps, [run.y for run in output.records[use]], output.columns)
    result["meaning"] = (
        "one-step prediction from the smoothed measured state"
        if known
        else "unknown: the model shows no equations"
        if output.nominal.h is None
        else "unknown: the state is not measured"
    )
    return result


def _state_is_read(form: FreeRunForm, fitted: Fitted) -> bool:
    """Return True if the records tell the positions of a model: not where its sensor has a memory (a lag, a filter)."""
    if measured_coordinates(form.nominal) is None:
        return False
    system, p = fitted.system, fitted.system.vector(fitted.values)
    _, told = form.from_data(form.simulator(system, p), form.records["estimation"][0], p)
    assert by_equations(system)  # as its nominal system is
    return all(told[coordinate.q] for coordinate in system.coordinates)
