"""Lumped parameters of a mechanism by linear least squares: torque, energy and momentum (weak) form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, Trajectory
from identifiers.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.motion import Motion, Smoothing, motion
from identifiers.physical import recipe_for
from identifiers.records import moving, real_signals, usable

if TYPE_CHECKING:
    from harness.physics import LumpedFit, LumpedModel, System

__all__ = ["Lumped", "lumped_energy", "lumped_momentum", "lumped_torque"]

Form = Literal["torque", "energy", "momentum"]
Intersample = Literal["zoh", "smooth"]


@dataclass(frozen=True)
class Lumped:
    """Lumped parameters of a mechanism, then the physical parameters that they determine.

    The torque form needs accelerations and suffers most from noise; the energy form needs rates; the momentum form
    moves the derivative onto a test function and suffers least (Tedrake 2024, *Underactuated Robotics*, ch. 18). The
    rows of each coordinate weigh by their own residual, so that newtons and newton metres mix.

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
    smoothing : {"auto", "local", "spline", "kalman", "forward"}
        How rates and accelerations come of what was measured: local cubics with the width of least leave-one-out
        error; an interpolating spline; a Kalman filter with its backward pass; forward differences; or the spline
        where there is no noise to speak of.
    intersample : {"zoh", "smooth"}
        The input was held over each sample, or moved smoothly through the samples.
    tolerance : float
        Relative size below which a combination of parameters counts as not identifiable.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> from harness.signals import PlantSpec
    >>> system = pendulum().system()
    >>> u = np.repeat(np.random.default_rng(0).normal(size=(100, 1)), 10, axis=0)
    >>> y = system.simulator(0.01, backend="casadi").rollout([0.2, 0.05, 1.0], [0.5, 0.0], u)
    >>> data = Trajectory(np.arange(1000) * 0.01, u, y, PlantSpec(system.inputs, system.outputs, 0.01))
    >>> fitted = lumped_momentum().fit([data], rng=np.random.default_rng(0))
    >>> {name: round(value, 3) for name, value in fitted.parameters.items()}
    {'J': 0.2, 'b': 0.05, 'mgl': 1.0}
    """

    form: Form
    model: str | None = None
    window: float | None = None
    known: Mapping[str, float] | None = None
    smoothing: Smoothing = "auto"
    intersample: Intersample = "zoh"
    tolerance: float = 1e-6

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the mechanism with the parameters found.

        Raises
        ------
        FitError
            If the model is no mechanism, the signals are not its own, or the motion does not determine all lumped
            parameters: the message names the combinations that it does determine.
        """
        what = f"lumped-{self.form}"
        records, spec = usable(trajectories, samples=12, what=what)
        real_signals(spec, what)
        moving(records, what, inputs=False)
        recipe = recipe_for(spec, what, model=self.model)
        system = recipe.system(spec)
        found, regression = self.regress(system, records)
        identifiable = found.identifiability
        if identifiable.rank < regression.k:
            raise FitError(
                f"{what}: the motion does not determine all lumped parameters",
                expected=f"rank {regression.k} ({', '.join(regression.names)})",
                got=str(identifiable),
                remedy="excite the plant more richly, or give known={...}",
            )
        parameters = {**regression.to_parameters(found.values), **dict(self.known or {})}
        self._refuse_unphysical(system, regression, found.values, parameters, what)
        deviations = dict(zip(regression.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
        notes: dict[str, Any] = {"lumped": found.values, "lumped_deviations": deviations, "residual_rms": found.rms}
        model = GreyBoxModel(spec, recipe, parameters, notes=notes)
        return replace(model, filter_gain=tuned_gain(model, records))

    def regress(self, system: System, records: Sequence[Trajectory]) -> tuple[LumpedFit, LumpedModel]:
        """Return the least-squares fit of the lumped parameters, and the regression they belong to.

        Raises
        ------
        FitError
            If the system is no mechanism, or a coordinate is not measured.
        """
        from harness.physics import Mechanism, lumped

        what = f"lumped-{self.form}"
        if not isinstance(system.mechanism, Mechanism) or not system.coordinates:
            raise FitError(
                f"{what}: {system.name} is no mechanism",
                expected="a model with coordinates and a Lagrangian",
                got=str(system),
                remedy="use output-error for other models",
            )
        regression = lumped(system.mechanism, known=dict(self.known or {}))
        rows, targets = [], []
        for one in records:
            moved = motion(system, one, self.smoothing)
            phi, target = self._equations(regression, moved, one.spec.sample_time)
            rows.append(phi)
            targets.append(target)
        phi, target = np.concatenate(rows), np.concatenate(targets)
        if not np.any(target):
            raise FitError(
                f"{what}: nothing known drives the motion",
                expected="a moving input or a known parameter",
                got="free motion: the parameters have a common scale that cannot be seen",
                remedy="excite the plant, or give known={...}",
            )
        return self._weighted(regression, phi, target), regression

    def _equations(self, regression: LumpedModel, moved: Motion, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return the rows and targets of one record."""
        t, q, v, u = moved.t, moved.q, moved.v, moved.u
        if self.form == "torque":
            return regression.torque_rows(t, q, v, moved.a, u if self.intersample == "smooth" else moved.mean_u)
        longest = max(1, (len(t) - 1) // 4)
        if self.form == "energy":
            samples = moved.width if self.window is None else round(self.window / dt)
            return regression.energy_rows(
                t, q, v, u, samples=int(np.clip(samples, 1, longest)), intersample=self.intersample
            )
        samples = max(51, 3 * moved.width) if self.window is None else round(self.window / dt)
        return regression.momentum_rows(
            t, q, v, u, samples=int(np.clip(samples, 5, max(5, longest))), intersample=self.intersample
        )

    def _weighted(self, regression: LumpedModel, phi: FloatArray, target: FloatArray) -> LumpedFit:
        """Return the fit in which the rows of each coordinate weigh by their own residual."""
        found = regression.solve(phi, target, tolerance=self.tolerance)
        n = 1 if self.form == "energy" else regression.n
        if n == 1 or found.identifiability.rank < regression.k:
            return found
        scale = np.sqrt(np.mean(target**2)) or 1.0
        for _ in range(2):
            miss = (target - phi @ np.array(list(found.values.values()))).reshape(-1, n)
            size = np.maximum(np.sqrt(np.mean(miss**2, axis=0)), 1e-9 * scale)
            found = regression.solve(phi, target, weights=np.tile(1.0 / size, len(miss)), tolerance=self.tolerance)
        return found

    def _refuse_unphysical(
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


def lumped_torque(
    model: str | None = None,
    *,
    known: Mapping[str, float] | None = None,
    smoothing: Smoothing = "auto",
    intersample: Intersample = "zoh",
    tolerance: float = 1e-6,
) -> Lumped:
    """Lumped parameters from the torque form (inverse dynamics); options as of :class:`Lumped`."""
    return Lumped("torque", model, None, known, smoothing, intersample, tolerance)


def lumped_energy(
    model: str | None = None,
    *,
    window: float | None = None,
    known: Mapping[str, float] | None = None,
    smoothing: Smoothing = "auto",
    intersample: Intersample = "zoh",
    tolerance: float = 1e-6,
) -> Lumped:
    """Lumped parameters from the energy form (work over short intervals); options as of :class:`Lumped`."""
    return Lumped("energy", model, window, known, smoothing, intersample, tolerance)


def lumped_momentum(
    model: str | None = None,
    *,
    window: float | None = None,
    known: Mapping[str, float] | None = None,
    smoothing: Smoothing = "auto",
    intersample: Intersample = "zoh",
    tolerance: float = 1e-6,
) -> Lumped:
    """Lumped parameters from the momentum (weak) form; options as of :class:`Lumped`."""
    return Lumped("momentum", model, window, known, smoothing, intersample, tolerance)
