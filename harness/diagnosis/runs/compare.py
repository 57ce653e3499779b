"""Free runs of the nominal and the repaired model: the errors that users know, before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.policy import Policy
from harness.diagnosis.records.horizon import Horizon
from harness.diagnosis.runs.fitted import Fitted
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.runs.states import on_validation, settled_states
from harness.diagnosis.search.fit import Fit
from harness.errors import HarnessError

__all__ = ["FreeRuns", "free_runs", "seen"]


@dataclass(frozen=True, eq=False)
class FreeRuns:
    """Free runs over a horizon.

    Attributes
    ----------
    horizon : Horizon
    output : FreeRunForm
        What simulates; its weights are the sensor noise of the final model.
    before, after : Fitted or None
        None where the simulation diverges.
    left : float
        Share of the variance of the validation outputs that the final model leaves over the horizon, the worst output.
    """

    horizon: Horizon
    output: FreeRunForm
    before: Fitted | None
    after: Fitted | None
    left: float

    def worse(self, policy: Policy) -> bool:
        """Return True if the final model runs further from the validation records than the nominal one.

        By more than the standard errors over blocks that validation asks for everywhere; what an unknown torque does to
        both is no difference between them.
        """
        if self.before is None or not self.before.finite or self.after is self.before:
            return False
        if self.after is None or not self.after.finite:
            return True
        sums: list[float] = []
        for new, old in zip(self.after.validation, self.before.validation, strict=True):
            edges = np.linspace(0, len(new), policy.blocks + 1).astype(int)
            change = np.concatenate([[0.0], np.cumsum((new**2 - old**2).sum(axis=1))])
            sums += list(np.diff(change[edges]))
        more = np.array(sums)
        return bool(more.sum() > policy.validation_z * np.sqrt(len(more)) * more.std(ddof=1))


def free_runs(output: FreeRunForm, horizon: Horizon, nominal: Fit, final: Fit) -> FreeRuns:
    """Simulate both models over windows, initial states fitted to each."""
    before = seen(output, nominal)
    after = before if final is nominal else seen(output, final)
    left = np.inf
    if after is not None and after.finite:
        y = np.concatenate([run.y for run in output.records["validation"]])
        error = np.concatenate(list(after.validation)) * output.weights
        left = float(np.max(np.mean(error**2, axis=0) / np.maximum(y.var(axis=0), 1e-300)))
    return FreeRuns(horizon, output, before, after, left)


def seen(output: FreeRunForm, fit: Fit) -> Fitted | None:
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
