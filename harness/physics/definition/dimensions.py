"""How many of what a model has, whatever its kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from harness.signals import Ported


class Dimensions(Ported):
    """Counts and names of a model with ``inputs``, ``outputs``, ``states`` and ``parameters``."""

    parameters: Any

    @property
    def nx(self) -> int:
        """Number of states."""
        states: Sequence[Any] = self.states  # type: ignore[attr-defined]
        return len(states)

    @property
    def np(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)
