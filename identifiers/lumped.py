"""Lumped parameters of a mechanism by linear least squares: torque, energy and momentum (weak) form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.grey_box import GreyBoxModel, system_for
from identifiers.records import moving, usable

if TYPE_CHECKING:
    from harness.physics import System
    from harness.physics.lumped_model import LumpedModel

__all__ = ["Lumped", "lumped_energy", "lumped_momentum", "lumped_torque"]

Form = Literal["torque", "energy", "momentum"]


@dataclass(frozen=True)
class Lumped:
    """Lumped parameters of a mechanism, then the physical parameters that they determine.

    The torque form needs accelerations and suffers most from noise; the energy form needs rates; the momentum form
    moves the derivative onto a test function and suffers least (Tedrake 2024, *Underactuated Robotics*, ch. 18).

    Parameters
    ----------
    model : str
        Name of a built-in mechanism (``sysid list models``), or ``FILE.py:NAME``.
    form : {"torque", "energy", "momentum"}
    window : float, optional
        Length of the intervals or test functions [s]; 0.2 s (energy) and 0.5 s (momentum) without it.
    known : mapping, optional
        Physical parameters that are known, by name.
    tolerance : float
        Relative size below which a combination of parameters counts as not identifiable.
    """

    model: str
    form: Form
    window: float | None = None
    known: Mapping[str, float] | None = None
    tolerance: float = 1e-6

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the mechanism with the parameters found.

        Raises
        ------
        FitError
            If the model is no mechanism, the signals are not its own, or the motion does not determine all lumped
            parameters: the message names the combinations that it does determine.
        """
        from harness.physics import lumped

        what = f"lumped-{self.form}"
        records, spec = usable(trajectories, samples=12, what=what)
        moving(records, what, inputs=False)
        system = system_for(self.model, spec, what)
        mechanism = system.mechanism
        if not system.coordinates or mechanism is None:
            raise FitError(
                f"{what}: {self.model} is no mechanism",
                expected="a model with coordinates and a Lagrangian",
                got=str(system),
                remedy="use output-error for other models",
            )
        known = dict(self.known or {})
        regression = lumped(mechanism, known=known) if known else lumped(mechanism)
        rows, targets = zip(*(self._equations(regression, system, one) for one in records), strict=True)
        found = regression.solve(np.concatenate(rows), np.concatenate(targets), tolerance=self.tolerance)
        identifiable = found.identifiability
        if identifiable.rank < regression.k:
            raise FitError(
                f"{what}: the motion does not determine all lumped parameters",
                expected=f"rank {regression.k} ({', '.join(regression.names)})",
                got=f"rank {identifiable.rank}: {identifiable}",
                remedy="excite the plant more richly, or give known={...}",
            )
        parameters = regression.to_parameters(found.values)
        deviations = dict(zip(regression.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
        notes = {"lumped": found.values, "lumped_deviations": deviations, "residual_rms": found.rms}
        return GreyBoxModel(spec, self.model, {**parameters, **known}, notes=notes)

    def _equations(self, regression: LumpedModel, system: System, record: Trajectory) -> tuple[FloatArray, FloatArray]:
        """Return the rows and targets of one record."""
        q, v, a, inner = _motion(system, record)
        t, u = record.t[inner], record.u[inner]
        dt = record.spec.sample_time
        if self.form == "torque":
            held = np.vstack([record.u[:1], 0.5 * (record.u[1:] + record.u[:-1])])[inner]
            return regression.torque_rows(t, q[inner], v[inner], a[inner], held)
        if self.form == "energy":
            samples = max(1, round((self.window or 0.2) / dt))
            return regression.energy_rows(t, q[inner], v[inner], u, samples=min(samples, max(1, len(t) // 4)))
        samples = max(5, round((self.window or 0.5) / dt))
        return regression.momentum_rows(t, q[inner], v[inner], u, samples=min(samples, max(5, len(t) // 4)))


def _motion(system: System, record: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray, slice]:
    """Return coordinates, rates, accelerations (N, n) smoothed within the record, and the rows away from its ends."""
    from harness.physics.smoothing import smooth

    spec: PlantSpec = record.spec
    columns = {channel.name: i for i, channel in enumerate(spec.outputs)}
    missing = [one.name for one in system.coordinates if one.name not in columns]
    if missing:
        raise FitError(
            "lumped parameters need every coordinate measured",
            expected=", ".join(one.name for one in system.coordinates),
            got=", ".join(columns),
            remedy=f"measure {', '.join(missing)}, or use output-error",
        )
    found = [
        smooth(record.y[:, columns[one.name]], spec.sample_time, period=spec.outputs[columns[one.name]].period)
        for one in system.coordinates
    ]
    edge = max(one.width for one in found) // 2
    inner = slice(edge, len(record) - edge) if len(record) > 4 * edge + 12 else slice(None)
    value, rate, acceleration = (
        np.stack([getattr(one, name) for one in found], axis=1) for name in ("value", "rate", "acceleration")
    )
    return value, rate, acceleration, inner


def lumped_torque(model: str, *, known: Mapping[str, float] | None = None, tolerance: float = 1e-6) -> Lumped:
    """Lumped parameters from the torque form (inverse dynamics), with smoothed accelerations."""
    return Lumped(model, "torque", known=known, tolerance=tolerance)


def lumped_energy(
    model: str, *, window: float | None = None, known: Mapping[str, float] | None = None, tolerance: float = 1e-6
) -> Lumped:
    """Lumped parameters from the energy form: work and energy over short intervals, no acceleration."""
    return Lumped(model, "energy", window, known, tolerance)


def lumped_momentum(
    model: str, *, window: float | None = None, known: Mapping[str, float] | None = None, tolerance: float = 1e-6
) -> Lumped:
    """Lumped parameters from the momentum (weak) form: test functions instead of accelerations."""
    return Lumped(model, "momentum", window, known, tolerance)
