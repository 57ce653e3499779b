"""Maximum-likelihood identification of a physical model with process and measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.models.estimate import Estimate
from harness.signals import Trajectory
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.physical import PhysicalFit

if TYPE_CHECKING:
    from harness.physics.compiled.system import System
    from harness.physics.fitting.maximum import LikelihoodFit

METHOD = "curvature of the log-likelihood, noise estimated"


@dataclass(frozen=True)
class MaximumLikelihood(PhysicalFit):
    """Stochastic grey box: parameters, initial states and noise by maximum likelihood through a Kalman filter.

    An unmeasured force disturbs every equation of motion: where it vanishes this is the output-error fit, where it is
    large the equation-error fit, and the data choose (Kristensen, Madsen & Jorgensen 2004, Automatica 40:225).

    Parameters
    ----------
    model, options, effects, fixed, start
        As of :class:`identifiers.mechanics.physical.PhysicalFit`.
    latent, white : bool
        Whether an unmeasured force is there at all, and whether it has a white part.
    intersample : {"zoh", "foh", "smooth"}

    Examples
    --------
    >>> import harness
    >>> record = harness.simulate("pendulum-ode", scenario="prbs", scenario_options={"duration": 6.0})
    >>> fitted = MaximumLikelihood(model="pendulum").fit([record.measured()], rng=np.random.default_rng(0))
    >>> {name: round(value, 2) for name, value in fitted.parameters.items()}
    {'J': 0.1, 'b': 0.05, 'mgl': 1.0}
    """

    latent: bool = True
    white: bool = True
    intersample: Literal["zoh", "foh", "smooth"] = "zoh"

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the grey box; its notes hold the record of the estimate, the noise and the log-likelihood."""
        from harness.physics.fitting.likelihood_fit import fit_likelihood

        what = "maximum-likelihood"
        records, spec, recipe, system = self.prepared(trajectories, what)
        _, fit = fit_likelihood(
            system,
            records,
            start=dict(self.start),
            fixed=self.fixed,
            latent=self.latent,
            white=self.white,
            intersample=self.intersample,
        )
        noise = fit.point.noise
        notes: dict[str, Any] = {
            "converged": bool(fit.converged),
            "message": fit.message,
            "log_likelihood": -fit.nll,
            "noise": {"r": noise.r.tolist(), "s": noise.s.tolist(), "tau": noise.tau.tolist(), "w": noise.w.tolist()},
            "estimate": likelihood_estimate(system, fit).to_dict(),
        }
        model = GreyBoxModel(spec, recipe, dict(fit.parameters), None, self.intersample, notes=notes)
        return replace(model, filter_gain=tuned_gain(model, records))


def likelihood_estimate(system: System, fit: LikelihoodFit) -> Estimate:
    """Return the record of a fit; no interval is claimed without a maximum, nor for what ended on a bound."""
    names = tuple(name for name in fit.names if name in system.parameter_names)
    values = np.array([fit.parameters[name] for name in names])
    rows = [fit.names.index(name) for name in names]
    derivative = np.where(fit.logarithmic[rows], values, 1.0)
    covariance = fit.covariance[np.ix_(rows, rows)] * np.outer(derivative, derivative)
    intervals = np.array([fit.interval(name) for name in names]).reshape(-1, 2)
    intervals[[name in fit.on_bound for name in names]] = np.nan
    return Estimate(
        names,
        tuple(system.parameter(name).unit for name in names),
        values,
        covariance,
        intervals if fit.converged else None,
        method=METHOD if fit.converged else "no interval: the fit did not converge",
        converged=bool(fit.converged),
        message=fit.message,
        on_bound=fit.on_bound,
    )
