"""Free runs of an FMU with the effects that were found, window by window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

from harness.blackbox.effects import surround
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.blackbox.system import FmuSystem
from harness.diagnosis.fmu.prepare import DECREASE, FmuWindows, measured_states
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.systems import AnySystem
from harness.effects.effect import Placed
from harness.physics.compiled.simulator import Simulator
from harness.physics.compiled.windows import Windows
from harness.physics.fitting.levenberg import minimise_states
from harness.signals import Dataset, FloatArray, Trajectory


class FmuRuns(FreeRunForm):
    """Simulates an FMU with effects around it; see :class:`harness.diagnosis.runs.form.FreeRunForm`."""

    decrease = DECREASE
    nominal: FmuSystem

    def __init__(
        self,
        nominal: FmuSystem,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        horizon: float | None,
        weights: FloatArray,
        runner: Runner,
    ) -> None:
        super().__init__(nominal, dataset, sizes=sizes, horizon=horizon, weights=weights)
        self.runner = runner
        self._surrounded: dict[tuple[str, ...], FmuSystem] = {}
        self._simulators: dict[int, tuple[FmuSystem, FmuSimulator]] = {}

    def system(self, effects: Sequence[Placed]) -> FmuSystem:
        """Return the FMU with effects around it, made once."""
        key = tuple(str(placed) for placed in effects)
        if key not in self._surrounded:
            self._surrounded[key] = surround(self.nominal, effects, self.sizes) if effects else self.nominal
        return self._surrounded[key]

    def simulator(self, system: AnySystem, p: FloatArray, *, quick: bool = False) -> Simulator:
        """Return the simulator of a system, made once."""
        assert isinstance(system, FmuSystem)
        if id(system) not in self._simulators:
            self._simulators[id(system)] = (system, FmuSimulator(system, self.runner))
        return cast(Simulator, self._simulators[id(system)][1])  # it offers all that windows ask of one

    def cut(self, simulator: Simulator, records: list[Trajectory], horizon: float | None) -> Windows:
        """Return the windows of records."""
        return FmuWindows(simulator, records, horizon, self.weights)

    def fit_states(self, windows: Windows, p: FloatArray, x0: FloatArray, most: int) -> FloatArray:
        """Return fitted initial states (W, nx)."""
        return minimise_states(windows, p, x0, most, decrease=self.decrease)

    def from_data(self, simulator: Simulator, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
        """Return smoothed measurements for states that are outputs, their derivatives for rates, else 0."""
        runner = cast(FmuSimulator, simulator)
        return measured_states(runner.system, runner, record, p)
