"""Inverse dynamics: the loop on force residuals of measured motion.

Right where the motion is measured far more exactly than the forces are modelled: an unmodelled force then is the
noise of the equation, and the least-squares fit of the decimated equation (inverse dynamic identification model) is the
efficient estimator, also for data taken in closed loop. A simulation would integrate that force noise twice.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from harness.diagnosis.records.motion import Motion, measured_coordinates, smooth_motion, thinned
from harness.diagnosis.runs.equation import Equations, decimated, equations_of, expressible, weak_rows
from harness.diagnosis.runs.fitted import Fitted
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.compiled.system import System
from harness.signals import Dataset, FloatArray, Trajectory


class EquationForm:
    """Compare force residuals.

    - ``nominal``: all of its coordinates are measured
    - ``dataset``: estimation and validation runs
    - ``sizes``: sizes of the data by port, for start values
    - ``shape`` {"strong", "weak"}: decimated samples of M a - Q, or means over test functions of the momentum residual
    """

    def __init__(
        self,
        nominal: System,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        shape: Literal["strong", "weak"] = "strong",
    ) -> None:
        columns = measured_coordinates(nominal)
        if columns is None:
            raise FitError(
                "no inverse dynamics",
                expected="a measured position for every coordinate",
                got=", ".join(channel.name for channel in nominal.outputs),
                remedy="judge this model by simulation",
            )
        self.nominal = nominal
        self.sample_time = dataset.spec.sample_time
        self.shape: Literal["strong", "weak"] = shape
        self.sizes = sizes
        self.columns = tuple((coordinate.name, coordinate.force_unit) for coordinate in nominal.coordinates)
        weak, smooth = shape == "weak", dataset.intersample == "smooth"
        self.motions: dict[str, tuple[Motion, ...]] = {
            use: tuple(
                smooth_motion(run, columns, dataset.intersample if weak or smooth else "foh")
                for run in dataset.using(use)
            )
            for use in ("estimation", "validation", "test")
        }
        if shape == "weak":  # a screen: it need not see every sample
            self.motions = {use: tuple(map(thinned, motions)) for use, motions in self.motions.items()}
        self.weights = np.ones(len(self.columns))
        self._equations: dict[tuple[str, ...], Equations] = {}

    def judges(self, placed: Placed) -> bool:
        """Return True for forces without a state of their own; see :func:`expressible`."""
        return expressible(placed) and placed.at not in {channel.name for channel in self.nominal.outputs} - {
            coordinate.name for coordinate in self.nominal.coordinates
        }

    def equations(self, effects: Sequence[Placed]) -> Equations:
        """Return the equation form with effects, made once."""
        key = tuple(str(placed) for placed in effects)
        if key not in self._equations:
            system = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
            self._equations[key] = equations_of(system)
        return self._equations[key]

    def evaluate(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fitted:
        """Return residuals and Jacobian of a record."""
        values = record["values"]
        equations = self.equations(tuple(effects))
        system = equations.system
        p = system.vector({name: values[name] for name in system.parameter_names})
        free = tuple(parameter.name for parameter in system.parameters if not parameter.fixed)
        index = [system.parameter_names.index(name) for name in free]
        inside = [equations.residual(motion, p, self.shape, index) for motion in self.motions["estimation"]]
        outside = [equations.residual(motion, p, self.shape, ()) for motion in self.motions["validation"]]
        # a block before the inputs could make the equation small by passing nothing on: count by what it passes on
        inputs = {channel.name for channel in self.nominal.inputs}
        lost = 1.0
        if any(placed.at in inputs for placed in effects):
            motion = self.motions["estimation"][0]
            passed = equations.input_size(motion, p)
            lost = self.equations(()).input_size(motion, self.nominal.vector()) / max(passed, 1e-300)
        return Fitted.of(
            effects,
            system,
            p,
            record,
            estimation=tuple(-lost * r / self.weights for r, _ in inside),
            validation=tuple(-lost * r / self.weights for r, _ in outside),
            jacobian=tuple(lost * j / self.weights[:, None] for _, j in inside),
        )

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return the columns unchanged: there are no initial states."""
        return tuple(parts)

    def averaged(self, columns: FloatArray, motion: Motion) -> FloatArray:
        """Return columns (N, n, k) of forces along a motion as the residual is: decimated, or as means."""
        count, n, k = columns.shape
        slim = decimated if self.shape == "strong" else weak_rows
        return slim(columns.reshape(count, n * k), motion).reshape(-1, n, k)

    def force(self, placed: Sequence[Placed], fitted: Fitted, motion: Motion) -> FloatArray:
        """Return the force (rows, n) that effects of a fitted model exert, decimated as the residual is."""
        keep = [effect for effect in fitted.effects if str(effect) not in {str(gone) for gone in placed}]
        full = self.equations(fitted.effects)
        less = self.equations(tuple(keep))
        a, _ = full.residual(motion, full.system.vector(fitted.values), self.shape)
        known = {name: fitted.values[name] for name in less.system.parameter_names}
        b, _ = less.residual(motion, less.system.vector(known), self.shape)
        return b - a

    def driven_jacobian(self, fitted: Fitted, driven: Sequence[Trajectory]) -> tuple[FloatArray, ...]:
        """Return the sensitivities (N_i, n, p) along other estimation records."""
        columns = measured_coordinates(self.nominal)
        assert columns is not None
        other = copy.copy(self)
        motions = []
        for run, old in zip(driven, self.motions["estimation"], strict=True):
            motion = smooth_motion(run, columns, "zoh" if self.shape == "weak" else "foh")
            motions.append(replace(motion, inside=old.inside, factor=old.factor))
        other.motions = {**self.motions, "estimation": tuple(motions)}
        return other.evaluate(fitted.effects, dict(fitted.record)).jacobian

    def lengths(self, fitted: Fitted, records: Sequence[Trajectory]) -> list[int]:
        """Return the samples of each record."""
        return [len(part) for part in fitted.estimation]
