"""Errors of the torques of a mechanical model along a measured motion: what inverse dynamics is judged by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from harness.signals import Trajectory


@dataclass(frozen=True)
class TorqueError:
    """Error of one joint's torque.

    Attributes
    ----------
    joint : str
        Name of the torque's channel.
    unit : str
        Of the torque.
    rms : float
        Root mean square of predicted less measured torque, in that unit.
    nrmse : float
        The same over the standard deviation of the measured torque (Ljung 1999, sec. 16.5: 1 - fit).

    Examples
    --------
    >>> print(TorqueError("tau1", "N m", 0.5, 0.05))
    tau1: 0.5 N m (NRMSE 0.05)
    """

    joint: str
    unit: str
    rms: float
    nrmse: float

    def __str__(self) -> str:
        return f"{self.joint}: {self.rms:.3g} {self.unit} (NRMSE {self.nrmse:.3g})"


@runtime_checkable
class Torques(Protocol):
    """A model that says what torques a motion needs."""

    def torque_errors(self, record: Trajectory) -> tuple[TorqueError, ...]:
        """Return the errors of its torques along the measured motion of a record, joint by joint."""
        ...
