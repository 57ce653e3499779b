"""One FMU, instantiated once in each process and reset for every simulation."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from harness.blackbox.system import FmuSystem
from harness.signals import FloatArray
from harness.supervision.guarded import alive


class Runner:
    """The FMU of a system, at a sample time [s]; shared by the simulators of all effects."""

    def __init__(self, nominal: FmuSystem, sample_time: float) -> None:
        self.nominal, self.sample_time = nominal, sample_time
        self._plant: Any = None
        self._left: Any = None
        self._owner = 0
        self._set: dict[str, float] = {}
        self._finer: dict[int, Runner] = {}
        self.steps = 0
        """Communication steps that simulations around the FMU took."""
        self._rng = np.random.default_rng(0)  # an FMU draws nothing

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
