"""The step and the tolerance at which an FMU is run as a model: finer ones must change less than the sensors' noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.blackbox.system import FmuSystem
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory

__all__ = ["settled"]

SHARE = 0.3
"""Part of the noise that halving the step may move a reading by (rms): its square adds less than a tenth."""
FINER = 0.01
"""Factor of the tolerance from one trial to the next."""
FIRST, LAST = 1e-4, 1e-12
"""Tolerance that is taken as the FMU's own where it tells none, and the finest that is tried."""
TRIALS = 4
ROWS = 2000
"""Samples over which settings are compared."""


def settled(system: FmuSystem, record: Trajectory, noise: FloatArray, x0: FloatArray, told: float | None) -> FmuSystem:
    """Return an FMU with a step and a tolerance at which finer ones change its readings by less than their noise.

    Parameters
    ----------
    system : FmuSystem
    record : Trajectory
        Its inputs drive the comparison.
    noise : array (ny,)
        Standard deviation of the sensors.
    x0 : array (nx,)
        Where the states start.
    told : float or None
        Tolerance of the FMU's default experiment.

    Returns
    -------
    FmuSystem
        With the coarsest settings that suffice; ``notes`` say where they are not the FMU's own, and where none does.
    """
    run = record[:ROWS]

    def outputs(made: FmuSystem) -> FloatArray:
        try:
            simulator = FmuSimulator(made, Runner(made, run.spec.sample_time))
            return simulator.run(made.vector(), x0, run.u, float(run.t[0]))[1]
        except HarnessError:  # it does not take such a step or tolerance
            return np.full((len(run), made.ny), np.nan)

    def apart(a: FloatArray, b: FloatArray) -> FloatArray:
        both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        return np.sqrt(np.mean((a - b)[both] ** 2, axis=0)) / noise if both.any() else np.full(a.shape[1], np.nan)

    now, y = system, outputs(system)
    off = first_off = np.zeros(system.ny)
    if not np.isfinite(y).any():
        return system
    for _ in range(TRIALS):
        step, tolerance = now.step or run.spec.sample_time, now.tolerance or told or FIRST
        stricter = replace(now, tolerance=max(FINER * tolerance, LAST))
        finer = replace(stricter, step=step / 2)
        best = outputs(finer)
        off = apart(y, best)
        if not np.isfinite(off).all():  # finer settings break it: those that it has are what there is
            return now
        if (off <= SHARE).all():
            return _noted(now, system, run, first_off) if now is not system else system
        first_off = off if now is system else first_off
        strict = outputs(stricter)
        enough = np.isfinite(strict).all() and (apart(strict, best) <= SHARE).all()
        now, y = (stricter, strict) if enough else (finer, best)
    words = f"half the step and a hundredth of the tolerance still move {_worst(system, off)}"
    return replace(now, notes=(*now.notes, f"the FMU's own solver is part of what is fitted: {words}"))


def _noted(now: FmuSystem, system: FmuSystem, run: Trajectory, off: FloatArray) -> FmuSystem:
    """Return the FMU with a note of what was made finer, and why."""
    changed = [
        *([] if now.step == system.step else [f"a communication step of {now.step or run.spec.sample_time:g} s"]),
        *([] if now.tolerance == system.tolerance else [f"a tolerance of {now.tolerance:g}"]),
    ]
    words = f"the FMU is run with {' and '.join(changed)}: with its own, finer ones move {_worst(system, off)}"
    return replace(now, notes=(*now.notes, words))


def _worst(system: FmuSystem, off: FloatArray) -> str:
    """Return which output moves most, in words."""
    k = int(np.argmax(off))
    return f"{system.outputs[k].name} by {off[k]:.2g} of its noise"
