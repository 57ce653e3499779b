"""One FMU, instantiated once in each process and reset for every simulation."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, thread_time
from typing import Any

import numpy as np

from harness.blackbox.recent import Recent
from harness.blackbox.system import FmuSystem
from harness.errors import PlantError
from harness.signals import FloatArray
from harness.supervision.guarded import alive
from harness.supervision.patience import Aside

KEPT = 64  # Runs that are kept, also with their derivatives: records alternate while a fit steps.
MEASURED = 8
"""Runs of a length that tell what one costs; the first, which loads the library, takes several times as long."""


@dataclass
class _Alike:
    """Runs of one length: how many, and what each of the first of them took [s]."""

    count: float = 0.0
    took: list[float] = field(default_factory=list)

    @property
    def cost(self) -> float:
        middle = statistics.median(self.took)
        return 2.0 ** (0.5 * round(2 * math.log2(middle))) if middle > 0.0 else 0.0


@dataclass
class Meter:
    """What runs of an FMU cost: each the median CPU time [s] of the first ones as long as it, as half a power of two.

    So a run costs the same whatever else the machine does later, and two searches end at the same place, but for the
    rare FMU whose runs take what lies between two such. One that took several times that, as a solver inside may that
    is led astray, counts 2, 4 or more times.

    Examples
    --------
    >>> meter = Meter()
    >>> for took in [0.01] * 8 + [0.012, 0.05]:
    ...     meter.add(1000, took)
    >>> meter.seconds == (8 + 1 + 4) * 2**-6.5
    True
    """

    runs: dict[int, _Alike] = field(default_factory=dict)

    def add(self, steps: int, seconds: float) -> None:
        """Count a run."""
        alike = self.runs.setdefault(steps, _Alike())
        if len(alike.took) < MEASURED:
            alike.took.append(seconds)
            alike.count += 1.0
        else:
            longer = seconds / alike.cost if alike.cost > 0.0 else 1.0
            alike.count += 2.0 ** math.floor(math.log2(max(longer, 1.0)))

    @property
    def seconds(self) -> float:
        """CPU time of all runs [s]."""
        return sum(alike.count * alike.cost for alike in self.runs.values())


class Runner:
    """The FMU of a system, at a sample time [s]; shared by the simulators of all effects."""

    def __init__(self, nominal: FmuSystem, sample_time: float) -> None:
        self.nominal, self.sample_time = nominal, sample_time
        self._plant: Any = None
        self._left: list[Any] = []
        self._owner = 0
        self._aside = Aside(Path(nominal.path).name)
        self.stuck: PlantError | None = None  # The last run that did not come to its end
        self._set: dict[str, float] = {}
        self._finer: dict[int, Runner] = {}
        self.meter = Meter()
        self.before: float | None = None  # CPU time [s] that was spent when a search around the FMU began
        self.steps: dict[tuple[str, int], float] = {}  # Relative steps of differences by parameter and length of a run
        self._rng = np.random.default_rng(0)  # an FMU draws nothing
        self.tables: Recent[bytes, tuple[FloatArray, FloatArray, FloatArray]] = Recent(KEPT)
        """The last runs of the FMU: effects at the outputs share those of the FMU alone."""

    @property
    def seconds(self) -> float:
        """CPU time [s] of all simulations around the FMU, also at parts of the sample time."""
        return self.meter.seconds + sum(runner.seconds for runner in self._finer.values())

    def __getstate__(self) -> dict[str, Any]:
        fresh: dict[str, Any] = {
            "_plant": None,
            "_left": [],
            "_aside": Aside(Path(self.nominal.path).name),
            "_owner": 0,
            "_set": {},
            "_finer": {},
            "tables": Recent(KEPT),
        }
        return {**self.__dict__, **fresh}

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

            self._left.append(self._plant)  # closing it here would free what belongs to the parent
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

    def run(self, work: Callable[[], None], samples: int) -> None:
        """Let ``work`` begin a run of so many samples and step the plant through it; counts what that costs.

        Raises PlantError (``timeout``) where a step does not end: the plant is left as it is, and the next run gets a
        fresh one.
        """
        spent: list[float] = []

        def measured() -> None:
            began = thread_time()
            try:
                work()
            finally:
                spent.append(thread_time() - began)

        def steps() -> int:
            return -1 if self._plant is None else int(self._plant.steps)

        def where() -> str:
            return "its start" if self._plant is None else f"the step from t = {self._plant.now:.6g} s"

        begun, patience = monotonic(), self._aside.patience
        try:
            self._aside.call(measured, steps, where, loads=self._plant is None)
        except PlantError as error:
            if not spent:
                spent.append(patience.limit())
                self._leave(error)
            raise
        finally:
            self.meter.add(samples, sum(spent))
        patience.took(self.plant.steps, monotonic() - begun)

    def _leave(self, error: PlantError) -> None:
        """Leave a plant behind that does not come back."""
        plant, self._plant, self.stuck = self._plant, None, error
        if plant is not None:
            plant.abandon()
            self._left.append(plant)

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
