"""Output-error identification of a physical model: its parameters by simulation error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError
from harness.physics.fitting.output_error_estimate import at_bound, output_error_estimate
from harness.signals import FloatArray, Trajectory
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.physical import PhysicalFit
from identifiers.mechanics.starting import StartBelief

if TYPE_CHECKING:
    from harness.physics import OutputErrorFit, System

__all__ = ["GreyBoxModel", "OutputError"]

# exp(6): as far as an error may grow over a window before the fit has nothing to hold on to.
_GROWTH = 6.0
# A first horizon [s] that spans a swing of most mechanisms; a window has at least so many samples.
_FIRST, _FEWEST = 2.0, 15


@dataclass(frozen=True)
class OutputError(PhysicalFit):
    """Grey-box identification: the parameters with which free runs of a physical model fit best.

    Parameters
    ----------
    model, options, effects, fixed, start
        As of :class:`identifiers.mechanics.physical.PhysicalFit`.
    horizon : float, "record" or "auto"
        Length of the windows of the fit [s]; whole records; or whole records unless the motion is so unstable that an
        error would grow beyond exp(6) over them: then the longest windows over which it does not and the fit converges.
    starts : int
        Number of starts; the best minimum counts.
    intersample : {"zoh", "foh", "smooth"}

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> from harness.signals import PlantSpec
    >>> system = pendulum().system()
    >>> u = np.random.default_rng(0).normal(size=(200, 1))
    >>> y = system.simulator(0.05, backend="casadi").rollout([0.2, 0.05, 1.0], [0.5, 0.0], u)
    >>> data = Trajectory(np.arange(200) * 0.05, u, y, PlantSpec(system.inputs, system.outputs, 0.05))
    >>> fitted = OutputError().fit([data], rng=np.random.default_rng(0))
    >>> {name: round(value, 5) for name, value in fitted.parameters.items()}
    {'J': 0.2, 'b': 0.05, 'mgl': 1.0}
    """

    horizon: float | Literal["record", "auto"] = "auto"
    starts: int = 1
    intersample: Literal["zoh", "foh", "smooth"] = "zoh"

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the grey box; its notes hold the record of the estimate."""
        what = "output-error"
        records, spec, recipe, system = self.prepared(trajectories, what)
        fit = self._fitted(system, records, rng)
        if not np.isfinite(fit.cost):
            raise FitError(
                f"{what}: no finite simulation", expected="a converged fit", got=fit.message, remedy="give start values"
            )
        notes: dict[str, Any] = {
            "converged": bool(fit.converged),
            "message": fit.message,
            "horizon": fit.horizon,
            "rms": fit.rms.tolist(),
            "estimate": output_error_estimate(system, fit).to_dict(),
        }
        model = GreyBoxModel(spec, recipe, dict(fit.parameters), None, self.intersample, notes=notes)
        model = replace(model, belief=StartBelief.of(model.simulator, records, fit))
        return replace(model, filter_gain=tuned_gain(model, records))

    def _fitted(self, system: System, records: list[Trajectory], rng: np.random.Generator) -> OutputErrorFit:
        """Return the fit at the horizon that suits the plant."""
        from harness.physics import fit_output_error

        def fit(horizon: float | None, before: OutputErrorFit | None = None) -> OutputErrorFit:
            return fit_output_error(
                system,
                records,
                start=dict(self.start) or None,
                fixed=self.fixed,
                horizon=horizon,
                starts=self.starts if before is None else 1,
                rng=rng,
                intersample=self.intersample,
                prefer_parameters_of=before,
            )

        if self.horizon == "record":
            return fit(None)
        if self.horizon != "auto":
            return fit(float(self.horizon))
        longest = max(record.duration for record in records)
        dt = records[0].spec.sample_time
        shortest = _FEWEST * dt
        short = max(_FIRST, 40 * dt)
        rate = _growth(system, self._guess(system, records), records)
        if rate * short > 0.5 * _GROWTH:
            short = max(0.5 * _GROWTH / rate, shortest)
        first = fit(short)
        rate = _growth(system, system.vector(first.parameters), records)
        if rate * longest <= _GROWTH:
            return fit(None, first)
        # Unstable: twice as long as long as errors keep growing gently and the fit goes on converging.
        best = first
        while (horizon := 2 * short) * rate <= _GROWTH:
            longer = fit(horizon, best)
            if not _believable(system, longer) and _believable(system, best):
                break
            best, short = longer, horizon
        return best

    def _guess(self, system: System, records: list[Trajectory]) -> FloatArray:
        """Return parameters near the data, before any fit: where the fit itself would start."""
        from harness.physics.fitting.start import first_values

        free = np.array(
            [not parameter.fixed and parameter.name not in self.fixed for parameter in system.parameters], dtype=bool
        )
        values = system.values(dict(self.start) or None)
        return first_values(system, records, values, free, set(self.start), self.intersample)[-1]


def _believable(system: System, fit: OutputErrorFit) -> bool:
    """Return True if a fit converged inside the bounds."""
    return fit.converged and not any(at_bound(system, name, fit.parameters[name]) for name in fit.names)


def _growth(system: System, p: FloatArray, records: Sequence[Trajectory]) -> float:
    """Return the mean over the motion of the fastest growth rate of small errors [1/s]."""
    import casadi as ca

    from harness.physics.compiled.windows import data_states

    simulator = system.simulator(records[0].spec.sample_time)
    jacobian = ca.Function("A", [system.x, system.u, system.p, system.t], [ca.jacobian(system.f, system.x)])
    rates: list[float] = []
    for record in records[:3]:
        states: FloatArray = data_states(simulator, record, p)[0]
        for k in np.linspace(0, len(record) - 1, 40).astype(int):
            a = jacobian(states[k], record.u[k], p, record.t[k]).full()
            if np.isfinite(a).all():
                rates.append(float(np.linalg.eigvals(a).real.max()))
    return max(float(np.mean(rates)), 0.0) if rates else 0.0
