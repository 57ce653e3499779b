"""The step and the tolerance at which an FMU is run as a model: finer ones must change less than the sensors' noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.blackbox.system import FmuSystem
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory

SHARE = 0.3  # Part of the noise that halving the step may move a reading by (rms): its square adds less than a tenth.
FINER = 0.01  # Factor of the tolerance from one trial to the next.
FIRST, LAST = 1e-4, 1e-12  # Tolerance that is taken as the FMU's own where it tells none, and the finest that is tried.
TRIALS = 4
ROWS = 2000  # Samples over which settings are compared.


class FmuAccuracy(NamedTuple):
    """Communication step [s] and relative tolerance of an FMU; None: the sample time, its own."""

    step: float | None
    tolerance: float | None

    def words(self, other: FmuAccuracy, sample_time: float) -> str:
        """Return in which of them these are finer than others."""
        return " and ".join(
            [
                *([] if self.step == other.step else [f"a communication step of {self.step or sample_time:g} s"]),
                *([] if self.tolerance == other.tolerance else [f"a tolerance of {self.tolerance:g}"]),
            ]
        )


class Coarsest(NamedTuple):
    """The coarsest settings that suffice, how far finer ones than the first moved each reading (ny,), and the last.

    Both in standard deviations of the noise; ``enough`` tells whether any of those tried sufficed.
    """

    settings: FmuAccuracy
    first: FloatArray
    last: FloatArray
    enough: bool


def coarsest(
    outputs: Callable[[FmuAccuracy], FloatArray],
    own: FmuAccuracy,
    sample_time: float,
    told: float | None,
    noise: FloatArray,
) -> Coarsest:
    """Return the coarsest step and tolerance at which finer ones change less than a part of the noise.

    - ``outputs``: from settings to the readings (N, ny) of a run; NaN where there are none
    - ``own``: what is tried first
    - ``sample_time``: of the readings [s]
    - ``told``: tolerance of the FMU's default experiment
    - ``noise`` (ny,): standard deviation of the sensors
    """

    def apart(a: FloatArray, b: FloatArray) -> FloatArray:
        both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        return np.sqrt(np.mean((a - b)[both] ** 2, axis=0)) / noise if both.any() else np.full(a.shape[1], np.nan)

    now, y = own, outputs(own)
    first = last = np.zeros(noise.shape)
    if not np.isfinite(y).any():
        return Coarsest(own, first, last, True)
    for _ in range(TRIALS):
        stricter = FmuAccuracy(now.step, max(FINER * (now.tolerance or told or FIRST), LAST))
        finer = FmuAccuracy((now.step or sample_time) / 2, stricter.tolerance)
        best = outputs(finer)
        last = apart(y, best)
        if not np.isfinite(last).all():  # finer settings break it: those that it has are what there is
            return Coarsest(now, first, last, True)
        first = last if now == own else first
        if (last <= SHARE).all():
            return Coarsest(now, first, last, True)
        strict = outputs(stricter)
        enough = np.isfinite(strict).all() and (apart(strict, best) <= SHARE).all()
        now, y = (stricter, strict) if enough else (finer, best)
    return Coarsest(now, first, last, False)


def settled(system: FmuSystem, record: Trajectory, noise: FloatArray, x0: FloatArray, told: float | None) -> FmuSystem:
    """Return an FMU with a step and a tolerance at which finer ones change its readings by less than their noise.

    - ``record``: its inputs drive the comparison
    - ``noise`` (ny,): standard deviation of the sensors
    - ``x0`` (nx,): where the states start
    - ``told``: tolerance of the FMU's default experiment
    - returns the FMU with the coarsest settings that suffice; ``notes`` say where they are not its own, and where none
      does
    """
    run = record[:ROWS]

    def outputs(settings: FmuAccuracy) -> FloatArray:
        made = replace(system, step=settings.step, tolerance=settings.tolerance)
        try:
            simulator = FmuSimulator(made, Runner(made, run.spec.sample_time))
            return simulator.run(made.vector(), x0, run.u, float(run.t[0]))[1]
        except HarnessError:  # it does not take such a step or tolerance
            return np.full((len(run), made.ny), np.nan)

    own = FmuAccuracy(system.step, system.tolerance)
    found = coarsest(outputs, own, run.spec.sample_time, told, noise)
    if found.settings == own:
        return system
    said = found.settings.words(own, run.spec.sample_time)
    words = f"the FMU is run with {said}: with its own, finer ones move {_worst(system, found.first)}"
    if not found.enough:
        moved = f"half the step and a hundredth of the tolerance still move {_worst(system, found.last)}"
        words = f"the FMU's own solver is part of what is fitted: {moved}"
    step, tolerance = found.settings
    return replace(system, step=step, tolerance=tolerance, notes=(*system.notes, words))


def _worst(system: FmuSystem, off: FloatArray) -> str:
    """Return which output moves most, in words."""
    k = int(np.argmax(off))
    return f"{system.outputs[k].name} by {off[k]:.2g} of its noise"
