"""Free runs of the nominal and the repaired model: the errors that users know, before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.forms import Fitted
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.per_record import on_validation, settled_states
from harness.diagnosis.prepare import Horizon, choose_horizon
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.likelihood_form import LikelihoodForm
from harness.errors import HarnessError

__all__ = ["FreeRuns", "free_runs", "seen"]


@dataclass(frozen=True, eq=False)
class FreeRuns:
    """Free runs over a horizon.

    Attributes
    ----------
    horizon : Horizon
    output : OutputForm
        What simulates; its weights are the sensor noise of the final model.
    before, after : Fitted or None
        None where the simulation diverges.
    left : float
        Share of the variance of the validation outputs that the final model leaves over the horizon, the worst output.
    """

    horizon: Horizon
    output: OutputForm
    before: Fitted | None
    after: Fitted | None
    left: float


def free_runs(form: LikelihoodForm, nominal: Fit, final: Fit) -> FreeRuns:
    """Simulate both models over windows, initial states fitted to each."""
    try:
        horizon = choose_horizon(form.nominal, nominal.values, form.dataset)
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        horizon = Horizon(None, "the poles of the nominal model are unknown: whole records are simulated")
    noise = final.detail.points["estimation"].noise.r
    output = OutputForm(
        form.nominal, form.dataset, sizes=form.sizes, horizon=horizon.seconds, weights=noise, floors=list(noise)
    )
    before = seen(output, nominal)
    after = before if final is nominal else seen(output, final)
    left = np.inf
    if after is not None and after.finite:
        y = np.concatenate([run.y for run in form.dataset.validation])
        error = np.concatenate(list(after.validation)) * output.weights
        left = float(np.max(np.mean(error**2, axis=0) / np.maximum(y.var(axis=0), 1e-300)))
    return FreeRuns(horizon, output, before, after, left)


def seen(output: OutputForm, fit: Fit) -> Fitted | None:
    """Return a fit as free runs show it, its parameters held; None where the simulation diverges."""
    system = output.system(fit.effects)
    p = system.vector({name: fit.values[name] for name in system.parameter_names})
    try:
        with np.errstate(all="ignore"):
            windows = output._windows(system, p, "estimation")
            states = [output._from_data(windows.simulator, one, p)[0] for one in output.records["estimation"]]
            x0 = settled_states(output, system, p, "estimation", windows, windows.starts_from(states))
            record: dict[str, Any] = {
                "values": dict(fit.values), "x0": x0.tolist(), "converged": fit.converged, "message": "",
            }  # fmt: skip
            record.update(on_validation(output, system, record))
            return output.evaluate(fit.effects, record)
    except (HarnessError, ArithmeticError, np.linalg.LinAlgError):
        return None
