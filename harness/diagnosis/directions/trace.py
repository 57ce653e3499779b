"""A record with the states that a smoother found along it: what directions of the score test are taken along."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from harness.physics.compiled.kalman_pass import Pass
from harness.signals import FloatArray, Trajectory


class Along(Protocol):
    """A record with what a model does along it."""

    @property
    def record(self) -> Trajectory:
        """The record."""
        ...

    @property
    def expected(self) -> FloatArray:
        """Outputs of the model (K, ny)."""
        ...

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        ...


@dataclass(frozen=True, eq=False)
class Trace:
    """A record with its smoothed states (latent forces last), and the parameters that hold."""

    record: Trajectory
    x: FloatArray
    passes: Pass
    p: FloatArray
    ports: tuple[str, ...]
    """Where a force can push: coordinates, or the rates of a process."""

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.passes.dt

    @cached_property
    def expected(self) -> FloatArray:
        """Outputs along the smoothed motion (K, ny)."""
        function, n = self.passes.simulator.functions.output, len(self.record)
        return np.asarray(
            function.map(n)(self.x.T, self.record.u.T, np.tile(self.p[:, None], n), self.record.t).full().T
        )
