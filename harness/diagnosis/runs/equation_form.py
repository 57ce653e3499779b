"""Inverse dynamics: force residuals of measured motion.

Right where the motion is measured far more exactly than the forces are modelled: an unmodelled force then is the
noise of the equation, also for data taken in closed loop. A simulation would integrate that force noise twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from harness.diagnosis.records.motion import SmoothedMotion, measured_coordinates, smooth_motion, thinned
from harness.diagnosis.runs.equation import MotionEquations, equations_of, expressible
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.compiled.system import System
from harness.signals import Dataset


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
        self.sizes = sizes
        self.columns = tuple((coordinate.name, coordinate.force_unit) for coordinate in nominal.coordinates)
        weak, smooth = shape == "weak", dataset.intersample == "smooth"
        self.motions: dict[str, tuple[SmoothedMotion, ...]] = {
            use: tuple(
                smooth_motion(run, columns, dataset.intersample if weak or smooth else "foh")
                for run in dataset.using(use)
            )
            for use in ("estimation", "validation", "test")
        }
        if weak:  # a screen: it need not see every sample
            self.motions = {use: tuple(map(thinned, motions)) for use, motions in self.motions.items()}
        self._equations: dict[tuple[str, ...], MotionEquations] = {}

    def judges(self, placed: Placed) -> bool:
        """Return True for forces without a state of their own; see :func:`expressible`."""
        return expressible(placed) and placed.at not in {channel.name for channel in self.nominal.outputs} - {
            coordinate.name for coordinate in self.nominal.coordinates
        }

    def equations(self, effects: Sequence[Placed]) -> MotionEquations:
        """Return the equation form with effects, made once."""
        key = tuple(str(placed) for placed in effects)
        if key not in self._equations:
            system = compose(self.nominal, effects, sizes=self.sizes) if effects else self.nominal
            self._equations[key] = equations_of(system)
        return self._equations[key]
