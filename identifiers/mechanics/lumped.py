"""Lumped parameters of a mechanism by linear regression: torque, energy and momentum (weak) form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError
from harness.options import options_of
from harness.signals import FloatArray, Trajectory
from identifiers.common.records import learnable
from identifiers.common.row_solvers import Estimator, huber, instrumental, total
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.lumped_estimate import lumped_estimate, physical_estimate
from identifiers.mechanics.lumped_rows import instants, simulated_motion, weighted
from identifiers.mechanics.motion import Motion, Smoothing, between, motion, noisier
from identifiers.mechanics.physical import Recipe, recipe_for
from identifiers.mechanics.simulated_records import EstimateSpread, corrected, pieces

if TYPE_CHECKING:
    from harness.models.estimate import RankDecision
    from harness.physics import LumpedModel, System

Form = Literal["torque", "energy", "momentum"]
Intersample = Literal["zoh", "smooth"]
# Rounds of instruments: each simulates with the parameters of the one before.
MEASURED = ("least-squares", "unweighted")
"""Estimators whose 95 % intervals hold in 90 to 98 % of 200 simulated records (benchmarks/coverage_of_estimates.py)."""
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Regressed:
    """The regression of a record's equations."""

    names: tuple[str, ...]  # Lumped parameters, ``"m*l**2"``
    values: dict[str, float]  # Of those
    rank: RankDecision
    condition: float  # Of the rows, columns at unit length
    rms: float  # Of the residual, in units of its own noise where coordinates weigh by it


@dataclass(frozen=True)
class Lumped:
    """Lumped parameters of a mechanism, then the physical parameters that they determine.

    The torque form needs accelerations and suffers most from noise; the energy form needs rates; the momentum form
    moves the derivative onto a test function and suffers least (Tedrake 2024, *Underactuated Robotics*, ch. 18). The
    equations of the coordinates weigh by their joint residual covariance, so that newtons and newton metres mix.
    Parameters that the model declares fixed are known. Directions of the parameters that the motion does not show above
    the noise are refused by name.

    Parameters
    ----------
    form : {"torque", "energy", "momentum"}
    model : str, optional
        A built-in mechanism (``sysid list models``) or ``FILE.py:NAME``; by default the built-in one with the signals
        of the records.
    window : float, optional
        Length of the intervals or test functions [s]. Without it one sample (energy) or 51 (momentum) where
        the records are free of noise, wider as they need more smoothing.
    known : mapping, optional
        Physical parameters that are known, by name.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal", "none"}
        How rates and accelerations come of what was measured: local cubics with the width of least leave-one-out
        error; a spline, through all samples or, where noise would spoil its second derivative, as smooth as those
        cubics; a Kalman filter with its backward pass; forward differences; cubics through past samples only (what a
        filter on the machine can do); by default local cubics, or the spline where there is no noise to speak of.
        ``none`` takes rates and accelerations (``NAME_acceleration``) as they were recorded.
    intersample : {"zoh", "smooth"}
        The input was held over each sample, or moved smoothly through the samples.
    tolerance : float
        Numerical floor of the rank decision: relative size below which a direction of the parameters counts as not
        determined, whatever the noise.
    estimator : {"least-squares", "unweighted", "total", "instruments", "huber", "l1"}
        Weighted least squares; least squares that adds newtons and newton metres as they are; generalised total least
        squares with the noise of the rows measured on a noisier copy; instruments from simulated motion (three
        rounds); Huber's criterion; least absolute deviations.
    intervals : int
        Simulated copies of the records whose scatter corrects the bias and gives 95 % intervals; 0 for none. They are
        given only where a free run of the model comes back to the records within their noise.

    Examples
    --------
    >>> from harness.models.estimate import estimate_of
    >>> from harness.physics.models import pendulum
    >>> from harness.signals import PlantSpec
    >>> system = pendulum().system()
    >>> u = np.repeat(np.random.default_rng(0).normal(size=(100, 1)), 10, axis=0)
    >>> y = system.simulator(0.01, backend="casadi").rollout([0.2, 0.05, 1.0], [0.5, 0.0], u)
    >>> data = Trajectory(np.arange(1000) * 0.01, u, y, PlantSpec(system.inputs, system.outputs, 0.01))
    >>> fitted = lumped_momentum().fit([data], rng=np.random.default_rng(0))
    >>> {name: round(value, 3) for name, value in fitted.parameters.items()}
    {'J': 0.2, 'b': 0.05, 'mgl': 1.0}
    >>> estimate_of(fitted).rank.full
    True
    """

    form: Form
    model: str | None = None
    window: float | None = None
    known: Mapping[str, float] | None = None
    smoothing: Smoothing = "auto"
    intersample: Intersample = "zoh"
    tolerance: float = 1e-6
    estimator: Estimator = "least-squares"
    intervals: int = 0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the mechanism with the parameters found; the record of the estimate stands in its notes.

        Raises
        ------
        FitError
            If the model is no mechanism, the signals are not its own, or the motion does not determine all lumped
            parameters above the noise: the message names what can change together unseen.
        """
        model, records = self.estimated(trajectories, rng=rng)
        return replace(model, filter_gain=tuned_gain(model, records))

    def estimated(
        self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator
    ) -> tuple[GreyBoxModel, list[Trajectory]]:
        """Return the model of :meth:`fit` before its filter is tuned, and the records that were used."""
        what = f"lumped-{self.form}"
        records, spec = learnable(trajectories, samples=12, what=what, inputs=False)
        recipe = recipe_for(spec, what, model=self.model)
        system = recipe.system(spec)
        found, regression = self.regress(system, records, rng=rng)
        if not found.rank.full:
            raise FitError(
                f"{what}: the motion does not determine all lumped parameters",
                expected=f"rank {regression.k} ({', '.join(regression.names)})",
                got=str(found.rank),
                remedy="excite the plant more richly, or give known={...}",
            )
        values, spread, how = self.without_bias(system, recipe, regression, found.values, records, rng)
        parameters = {**regression.to_parameters(values), **self.known_of(system)}
        self.refuse_unphysical(system, regression, values, parameters, what)
        record = lumped_estimate(system, regression, values, spread, how, found.rank, found.condition)
        notes: dict[str, Any] = {
            "estimate": physical_estimate(system, regression, parameters, record).to_dict(),
            "lumped": record.to_dict(),
            "residual_rms": found.rms,
        }
        return GreyBoxModel(spec, recipe, parameters, notes=notes), records

    def regress(
        self, system: System, records: Sequence[Trajectory], *, rng: np.random.Generator | None = None
    ) -> tuple[Regressed, LumpedModel]:
        """Return the lumped parameters of a system and the regression they belong to.

        Parameters
        ----------
        system : harness.physics.System
        records : sequence of Trajectory
        rng : numpy.random.Generator, optional
            Draws the noisier copy that the rank decision is made with.

        Raises
        ------
        FitError
            If the system is no mechanism, or a coordinate is not measured.
        """
        from harness.physics.lumps.identifiability import determined

        regression = self.regression_of(system)
        rng = rng or np.random.default_rng(0)
        moved = [motion(system, record, self.smoothing) for record in records]
        phi, target = self.stacked(regression, moved, records)
        if not np.any(target):
            raise FitError(
                f"lumped-{self.form}: nothing known drives the motion",
                expected="a moving input or a known parameter",
                got="free motion: the parameters have a common scale that cannot be seen",
                remedy="excite the plant, or give known={...}",
            )
        again = [
            motion(system, noisier(record, rng), self.smoothing, like=old)
            for record, old in zip(records, moved, strict=True)
        ]
        noisy, noisy_target = self.stacked(regression, again, records)
        if not (np.isfinite(phi).all() and np.isfinite(target).all()):
            raise FitError(
                "regression", expected="finite numbers", got="NaN or infinity", remedy="cut the record before it breaks"
            )
        errors = np.vstack([noisy - phi, *self._systematic(system, regression, records, moved, phi)])
        decision, kept, condition = determined(phi, regression.names, errors, tolerance=self.tolerance)
        if decision.rank == 0:
            raise FitError(
                f"lumped parameters of {regression.mechanism.name}",
                expected="a motion that shows at least one",
                got=str(decision),
                remedy="excite the plant",
            )
        noise = noisy - phi, noisy_target - target
        theta, white = self._criterion(
            system, regression, records, moved, (phi, target), kept, noise=noise, plain=not decision.full
        )
        residual = white @ instants((target - phi @ theta)[:, None], len(white))
        values = dict(zip(regression.names, theta.tolist(), strict=True))
        return Regressed(
            regression.names, values, decision, condition, float(np.sqrt(np.mean(residual**2)))
        ), regression

    # ---- inside --------------------------------------------------------------------------------------------------

    def known_of(self, system: System) -> dict[str, float]:
        """Return the parameters that are given or declared fixed."""
        return {parameter.name: parameter.value for parameter in system.parameters if parameter.fixed} | dict(
            self.known or {}
        )

    def regression_of(self, system: System) -> LumpedModel:
        """Return the lumped model of a system, known and fixed parameters on the known side.

        Raises
        ------
        FitError
            If the system is no mechanism.
        """
        from harness.physics import Mechanism, lumped

        if not isinstance(system.mechanism, Mechanism) or not system.coordinates:
            raise FitError(
                f"lumped-{self.form}: {system.name} is no mechanism",
                expected="a model with coordinates and a Lagrangian",
                got=str(system),
                remedy="use output-error for other models",
            )
        return lumped(system.mechanism, known=self.known_of(system))

    def stacked(
        self, regression: LumpedModel, moved: Sequence[Motion], records: Sequence[Trajectory]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the equations of all records; none reaches across a seam."""
        parts = [
            self._equations(regression, smoothed, record.spec.sample_time)
            for smoothed, record in zip(moved, records, strict=True)
        ]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _systematic(
        self,
        system: System,
        regression: LumpedModel,
        records: Sequence[Trajectory],
        moved: Sequence[Motion],
        phi: FloatArray,
    ) -> list[FloatArray]:
        """Return what smoothing, and the quadrature of the forms that integrate, change in the rows."""
        pairs = list(zip(records, moved, strict=True))
        bent = [motion(system, record, self.smoothing, like=old, coarser=True) for record, old in pairs]
        found = [self.stacked(regression, bent, records)[0] - phi]
        if self.form != "torque":
            fine = [self._equations(regression, old, record.spec.sample_time, finer=True)[0] for record, old in pairs]
            found.append(np.concatenate(fine) - phi)
        return found

    def _criterion(
        self,
        system: System,
        regression: LumpedModel,
        records: Sequence[Trajectory],
        moved: Sequence[Motion],
        equations: tuple[FloatArray, FloatArray],
        kept: FloatArray,
        *,
        noise: tuple[FloatArray, FloatArray] | None = None,
        rng: np.random.Generator | None = None,
        plain: bool = False,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the parameters by the chosen criterion, and the whitening of the coordinates.

        Without ``noise``, what noise changes in the rows and targets is drawn anew where it is needed; ``plain`` stays
        with least squares, as where the motion does not determine all parameters.
        """
        what, n = f"lumped-{self.form}", 1 if self.form == "energy" else regression.n
        theta, white = weighted(*equations, kept, n, plain=self.estimator == "unweighted")
        if plain or self.estimator in ("least-squares", "unweighted"):
            return theta, white
        phi = (white @ instants(equations[0], n)).reshape(-1, regression.k)
        target = (white @ instants(equations[1][:, None], n)).reshape(-1)
        if self.estimator == "huber":
            return huber(phi, target)[0], white
        if self.estimator == "l1":
            from identifiers.common.criteria import absolute_deviations

            return absolute_deviations(phi, target[:, None], what)[:, 0], white
        if self.estimator == "total":
            if noise is None:
                rng = rng or np.random.default_rng(0)
                pairs = zip(records, moved, strict=True)
                again = [motion(system, noisier(record, rng), self.smoothing, like=old) for record, old in pairs]
                shaken = self.stacked(regression, again, records)
                noise = shaken[0] - equations[0], shaken[1] - equations[1]
            wide = (white @ instants(noise[0], n)).reshape(phi.shape)
            return total(phi, target, wide, (white @ instants(noise[1][:, None], n)).reshape(-1), what), white
        for _ in range(_ROUNDS):
            parameters = {**regression.to_parameters(dict(zip(regression.names, theta, strict=True)))}
            copies = [
                simulated_motion(system, parameters | self.known_of(system), smoothed, record.spec.sample_time)
                for smoothed, record in zip(moved, records, strict=True)
            ]
            exact = self.stacked(regression, copies, records)[0]
            theta = instrumental(phi, target, (white @ instants(exact, n)).reshape(phi.shape), what)
        return theta, white

    def without_bias(
        self,
        system: System,
        recipe: Recipe,
        regression: LumpedModel,
        values: dict[str, float],
        records: list[Trajectory],
        rng: np.random.Generator,
    ) -> tuple[dict[str, float], EstimateSpread | None, str]:
        """Return the values without the bias that simulated records show, their spread, and how it was found."""
        if not self.intervals:
            return values, None, "no intervals: not asked for (option intervals = 60 simulates records)"
        if self.estimator not in MEASURED:
            return (
                values,
                None,
                f"no intervals: how often those of {self.estimator} hold was not measured",
            )
        known = self.known_of(system)
        first = GreyBoxModel(records[0].spec, recipe, {**regression.to_parameters(values), **known})

        def model_of(theta: FloatArray) -> tuple[GreyBoxModel, FloatArray]:
            wanted = dict(zip(regression.names, theta.tolist(), strict=True))
            parameters = {**regression.to_parameters(wanted, start=first.parameters), **known}
            return first.with_parameters(parameters), regression.values(parameters)

        def refit(noisy: list[Trajectory]) -> FloatArray:
            # smoothed as the records were: another width would be another estimate
            moved = [
                motion(system, record, self.smoothing, like=old) for record, old in zip(noisy, measured, strict=True)
            ]
            equations = self.stacked(regression, moved, noisy)
            return self._criterion(system, regression, noisy, moved, equations, np.eye(regression.k), rng=rng)[0]

        parts = pieces(records)
        measured = [motion(system, part.record, self.smoothing) for part in parts]
        found = corrected(parts, model_of, refit, self.intervals, rng)
        if found.spread is None:
            return values, None, found.how
        return dict(zip(regression.names, found.values.tolist(), strict=True)), found.spread, found.how

    def _equations(
        self, regression: LumpedModel, moved: Motion, dt: float, *, finer: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return the rows and targets of one record; the integrals on twice as many instants if ``finer``."""
        longest = max(1, (len(moved.t) - 1) // 4)
        if finer:
            moved = between(moved)
        t, q, v, u, many = moved.t, moved.q, moved.v, moved.u, 2 if finer else 1
        if self.form == "torque":
            return regression.torque_rows(t, q, v, moved.a, u if self.intersample == "smooth" else moved.mean_u)
        if self.form == "energy":
            samples = max(moved.width, 1) if self.window is None else round(self.window / dt)
            samples = many * int(np.clip(samples, 1, longest))
            rows, target = regression.energy_rows(t, q, v, u, samples=samples, intersample=self.intersample)
            return rows[::many], target[::many]
        samples = max(51, 3 * moved.width) if self.window is None else round(self.window / dt)
        samples = int(np.clip(samples, 5, max(5, longest)))
        return regression.momentum_rows(
            t,
            q,
            v,
            u,
            samples=many * (samples - 1) + 1,
            hop=many * max(1, samples // 4),
            intersample=self.intersample,
        )

    def refuse_unphysical(
        self,
        system: System,
        regression: LumpedModel,
        values: Mapping[str, float],
        parameters: Mapping[str, float],
        what: str,
    ) -> None:
        """Raise if no physical parameters give these lumped values: the model could not be simulated."""
        wanted = np.array([values[name] for name in regression.names])
        reached = regression.values(parameters)
        off = np.abs(reached - wanted) / np.maximum(np.abs(wanted), 1e-3 * np.abs(wanted).max())
        if off.max() > 0.5:
            worst = int(np.argmax(off))
            raise FitError(
                f"{what}: no physical parameters of {system.name} give the lumped values",
                expected=f"masses and lengths above 0, so that {regression.names[worst]} can be {wanted[worst]:.4g}",
                got=f"at best {reached[worst]:.4g}",
                remedy="use less noisy data, lumped-momentum, or output-error",
            )


@options_of(Lumped, "form", "window")
def lumped_torque(model: str | None = None, **options: Any) -> Lumped:
    """Lumped parameters from the torque form (inverse dynamics); options as of :class:`Lumped`."""
    return Lumped("torque", model, None, **options)


@options_of(Lumped, "form")
def lumped_energy(model: str | None = None, **options: Any) -> Lumped:
    """Lumped parameters from the energy form (work over short intervals); options as of :class:`Lumped`."""
    return Lumped("energy", model, **options)


@options_of(Lumped, "form")
def lumped_momentum(model: str | None = None, **options: Any) -> Lumped:
    """Lumped parameters from the momentum (weak) form; options as of :class:`Lumped`."""
    return Lumped("momentum", model, **options)
