"""One FMU, instantiated once in each process and reset for every simulation."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.blackbox.system import FmuSystem
from harness.signals import FloatArray
from harness.supervision.guarded import alive

MEASURED = 0.25
"""CPU time [s] of the runs that tell what a step costs: those of the rough fit, before any effect is tried."""


@dataclass
class Meter:
    """What runs of an FMU cost: steps, each at the CPU time [s] that the first runs took, rounded to a power of two.

    So a run costs the same whatever else the machine does later, and two searches end at the same place, but for the
    rare FMU whose steps take what lies between two powers. A run that took several times that, as a solver inside may
    that is led astray, counts 4, 16 or more times.

    Examples
    --------
    >>> meter = Meter()
    >>> for took in (0.2, 0.1, 0.11, 0.5):
    ...     meter.add(1000, took)
    >>> meter.seconds == (1000 + 1000 + 1000 + 4 * 1000) * 2**-13
    True
    """

    steps: float = 0.0
    measured: int = 0
    took: float = 0.0

    def add(self, steps: int, seconds: float) -> None:
        """Count a run."""
        if self.took < MEASURED:
            self.measured, self.took = self.measured + steps, self.took + seconds
            self.steps += steps
        else:
            self.steps += steps * max(1.0, 4.0 ** round(0.5 * np.log2(max(seconds, 1e-9) / (steps * self._cost))))

    @property
    def seconds(self) -> float:
        """CPU time of all runs [s]."""
        return self.steps * self._cost if self.took > 0 else 0.0

    @property
    def _cost(self) -> float:
        return float(2.0 ** round(np.log2(self.took / self.measured)))


class Runner:
    """The FMU of a system, at a sample time [s]; shared by the simulators of all effects."""

    def __init__(self, nominal: FmuSystem, sample_time: float) -> None:
        self.nominal, self.sample_time = nominal, sample_time
        self._plant: Any = None
        self._left: Any = None
        self._owner = 0
        self._set: dict[str, float] = {}
        self._finer: dict[int, Runner] = {}
        self.meter = Meter()
        self._rng = np.random.default_rng(0)  # an FMU draws nothing

    @property
    def seconds(self) -> float:
        """CPU time [s] of all simulations around the FMU, also at parts of the sample time."""
        return self.meter.seconds + sum(runner.seconds for runner in self._finer.values())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_plant": None, "_left": None, "_owner": 0, "_set": {}, "_finer": {}}

    def finer(self, parts: int) -> Runner:
        """Return the runner of a part of the sample time, made once."""
        if parts == 1:
            return self
        return self._finer.setdefault(parts, Runner(self.nominal, self.sample_time / parts))

    @property
    def plant(self) -> Any:
        """The plant of this process (after a fork the parent's must be left alone)."""
        if self._plant is None or self._owner != os.getpid():
            from harness import registry

            self._left = self._plant  # closing it here would free what belongs to the parent
            self._plant = registry.create(
                "plants",
                "fmu",
                path=self.nominal.path,
                sample_time=self.sample_time,
                inputs=[channel.name for channel in self.nominal.inputs],
                outputs=list(self.nominal.variables),
                **self._settings(),
            )
            self._owner, self._set = os.getpid(), {}
        return self._plant

    def _settings(self) -> dict[str, float]:
        """Return the step and the tolerance that the system asks for."""
        system, given = self.nominal, {}
        if system.step is not None and system.step < self.sample_time:
            given["step"] = self.sample_time / int(np.ceil(self.sample_time / system.step - 1e-9))
        if system.tolerance is not None:
            given["tolerance"] = system.tolerance
        return given

    def start(self, values: dict[str, float], x0: dict[str, float]) -> FloatArray:
        """Set parameters, reset; returns the first row of the variables."""
        plant = self.plant
        others = {name: value for name, value in values.items() if self._set.get(name) != value}
        if others:
            plant.preset(others)
            self._set.update(others)
        alive()
        return np.asarray(plant.reset(rng=self._rng, x0=x0))
