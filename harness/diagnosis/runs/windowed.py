"""What simulates models along records that are cut into windows, for what belongs to a record and not to the plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from harness.diagnosis.systems import AnySystem
from harness.effects.effect import Placed
from harness.physics.compiled.simulator import Simulator
from harness.physics.compiled.windows import Windows
from harness.signals import FloatArray, Trajectory


class WindowedForm(Protocol):
    """See :class:`harness.diagnosis.runs.form.FreeRunForm`."""

    @property
    def records(self) -> Mapping[str, Sequence[Trajectory]]:
        """Measured samples by use."""
        ...

    @property
    def sample_time(self) -> float:
        """Of the data [s]."""
        ...

    @property
    def horizon(self) -> float | None:
        """Window length [s]; None for whole records."""
        ...

    @property
    def weights(self) -> FloatArray:
        """What residuals are divided by (ny,)."""
        ...

    @property
    def decrease(self) -> float:
        """Relative decrease of the cost at which a fit of what belongs to a record has converged."""
        ...

    def system(self, effects: Sequence[Placed]) -> AnySystem:
        """Return the nominal model with effects."""
        ...

    def simulator(self, system: AnySystem, p: FloatArray) -> Simulator:
        """Return the simulator of a model."""
        ...

    def windows(self, system: AnySystem, p: FloatArray, use: str) -> Windows:
        """Return the windows of a use."""
        ...

    def cut(self, simulator: Simulator, records: list[Trajectory], horizon: float | None) -> Windows:
        """Return the windows of records."""
        ...

    def from_data(self, simulator: Simulator, record: Trajectory, p: FloatArray) -> tuple[FloatArray, list[bool]]:
        """Return what a record tells about the states (N, nx), and which of them it tells."""
        ...

    def fit_states(self, windows: Windows, p: FloatArray, x0: FloatArray, most: int) -> FloatArray:
        """Return initial states (W, nx) fitted with the parameters held."""
        ...
