"""The resolution of readings: whether they lie on a grid, and how far apart its points are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

SMALLEST = 0.05
"""Share of the gaps between distinct readings that are one step, at least: of gaps of chance, one in hundreds is."""


@dataclass(frozen=True)
class QuantisationTest:
    """Whether the readings lie on a grid.

    Attributes
    ----------
    step : float
        Spacing of the grid, in the unit of the channel; nan if there is none.
    on_grid : float
        Share of the readings within 1 % of a step of a grid point.
    noise : float
        Standard deviation that rounding alone brings, ``step / sqrt(12)``.
    """

    step: float
    on_grid: float
    noise: float

    @property
    def quantised(self) -> bool:
        """True if nearly all readings lie on the grid."""
        return bool(np.isfinite(self.step) and self.on_grid > 0.99)


def quantisation_test(y: FloatArray) -> QuantisationTest:
    """Test whether a record was rounded to a grid.

    Parameters
    ----------
    y : array (N,)
        One channel.

    Returns
    -------
    QuantisationTest
        The step is the smallest difference between distinct readings, refined on all of them.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y = rng.standard_normal(2000)
    >>> quantisation_test(y).quantised, quantisation_test(np.round(y / 0.1) * 0.1).quantised
    (False, True)
    """
    values = np.unique(np.asarray(y, dtype=float))
    nothing = QuantisationTest(float("nan"), 0.0, float("nan"))
    if values.size < 4:  # three readings are always on some grid
        return nothing
    steps = np.diff(values)
    steps = steps[steps > 1e-9 * (values[-1] - values[0])]  # the last bits of a decimal number are no steps
    if steps.size < 2:
        return nothing
    step = float(steps.min())
    small = steps[steps < 1.5 * step]
    if small.size < SMALLEST * steps.size:  # readings on no grid have gaps of all sizes
        return nothing
    step = float(small.mean())
    for _ in range(2):  # a longer lever refines the step
        counts = np.round((values - values[0]) / step)
        step = float(counts @ (values - values[0]) / (counts @ counts))
    distance = np.abs((values - values[0]) / step - np.round((values - values[0]) / step))
    return QuantisationTest(step, float(np.mean(distance < 0.01)), step / np.sqrt(12.0))


def resolution(readings: Sequence[FloatArray]) -> float:
    """Return the step of the grid on which all readings of an output lie; 0 where they lie on none.

    No reading is more exact than that: rounding to a step has a deviation of ``step / sqrt(12)`` (Widrow, Kollar & Liu
    1996, *IEEE Trans. Instrum. Meas.* 45:353, eq. 1) wherever the output moves, and none at all where it rests.

    - ``readings`` sequence of array (N,): by record; NaN where one is missing

    Examples
    --------
    >>> t = np.arange(1000) / 100
    >>> resolution([np.round(np.sin(t) / 0.25) * 0.25]), resolution([np.sin(t)])
    (0.25, 0.0)
    """
    tests = [quantisation_test(read[np.isfinite(read)]) for read in readings]
    return min((test.step for test in tests), default=0.0) if all(test.quantised for test in tests) else 0.0
