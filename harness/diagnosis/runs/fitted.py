"""A fitted model as free runs or forces show it: residuals, Jacobian, intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.diagnosis.records.horizon import vanished
from harness.diagnosis.runs.intervals import Interval, block_interval
from harness.diagnosis.systems import AnySystem
from harness.effects.effect import Placed
from harness.signals import FloatArray


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model fitted to the estimation runs and tried on the validation runs."""

    effects: tuple[Placed, ...]  # What was added to the nominal model
    system: AnySystem  # Nominal model with the effects
    values: dict[str, float]  # All parameters by full name
    free: tuple[str, ...]  # The fitted ones, in the order of the Jacobian
    converged: bool
    message: str  # How the fit ended
    # tuple of array (N_i, ny): Weighted residuals (each column over its weight)
    estimation: tuple[FloatArray, ...]
    validation: tuple[FloatArray, ...]
    jacobian: tuple[FloatArray, ...]
    """Tuple of array (N_i, ny, len(free)): Weighted derivative of the estimation outputs, what the initial states can
    do taken out."""
    refitted: dict[str, float] = field(default_factory=dict)
    """Parameters of the validation records themselves (phase, instant of a change)."""
    record: dict[str, Any] = field(default_factory=dict, repr=False)
    """Initial states and what else belongs to the records."""
    unaided: tuple[FloatArray, ...] = ()
    """Tuple of array (N_i, ny): The validation residual with hidden states of effects starting where the effects say,
    not where they fit best: a slow hidden state that is fitted anew in every window is a free force. Empty without
    hidden states."""
    starts: tuple[FloatArray, ...] = ()
    """Tuple of array (L_w * ny, k_w): For each estimation window an orthonormal basis of what its initial state can do.
    Empty where nothing is fitted."""

    @classmethod
    def of(
        cls, effects: Sequence[Placed], system: AnySystem, p: FloatArray, record: Mapping[str, Any], **parts: Any
    ) -> Fitted:
        """Return what a record of a fit says, with residuals and Jacobian as ``parts``."""
        return cls(
            effects=tuple(effects),
            system=system,
            values=dict(zip(system.parameter_names, map(float, p), strict=True)),
            free=tuple(parameter.name for parameter in system.parameters if not parameter.fixed),
            converged=bool(record["converged"]),
            message=str(record["message"]),
            record=dict(record),
            **parts,
        )

    @property
    def finite(self) -> bool:
        """True if both residuals are finite."""
        return all(np.isfinite(part).all() for part in (*self.estimation, *self.validation))

    def intervals(self, *, adapt: bool = True) -> dict[str, Interval]:
        """Return 95 % intervals of the free parameters; see :func:`harness.diagnosis.runs.intervals.block_interval`.

        A parameter of the nominal model that the fit has driven to 0, its lower bound, does not move any more: the
        intervals of the others are those of a fit without it.
        """
        if not self.free:
            return {}
        lost = vanished(self.system, self.values)
        gone = [name in lost for name in self.free]
        limits: dict[str, Interval] = {}
        for chosen in ([not vanishes for vanishes in gone], [True] * len(gone)):
            names = [name for name, use in zip(self.free, chosen, strict=True) if use]
            if names and not limits.keys() >= set(names):
                columns = [part[:, :, np.array(chosen)] for part in self.jacobian]
                values = np.array([self.values[name] for name in names])
                intervals = block_interval(values, columns, self.estimation, starts=self.starts, adapt=adapt)
                for name, interval in zip(names, intervals, strict=True):
                    limits.setdefault(name, interval)
        return {name: limits[name] for name in self.free}


def stacked(parts: Sequence[FloatArray]) -> FloatArray:
    """Return columns (N_i, ny, k) as one matrix (sum N_i * ny, k)."""
    return np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
