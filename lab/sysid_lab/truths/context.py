"""What the sizes of hidden effects refer to, and what a hidden effect is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.signals import FloatArray
from sysid_lab.truths.simulation import GRAVITY, Motion

PRE = 125  # Samples before the record: it begins in motion, with an input history that nobody recorded.
Sensor = Callable[[FloatArray], FloatArray]


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True, eq=False)
class Context:
    """What sizes refer to: the motion without the effect.

    Attributes
    ----------
    plant : str
        ``pendulum`` or ``cart-pole``.
    values : dict
        The truth's parameters without effect.
    motion : Motion
    u : array (N,)
    """

    plant: str
    values: dict[str, float]
    motion: Motion
    u: FloatArray

    def coordinate(self, at: str) -> int:
        """Return the number of a coordinate; the base, the input and a pendulum have only the first."""
        return 1 if self.plant == "cart-pole" and at == "theta" else 0

    def q(self, at: str) -> FloatArray:
        """Return a coordinate (N,)."""
        return self.motion.q[:, self.coordinate(at)]

    def v(self, at: str) -> FloatArray:
        """Return a rate (N,)."""
        return self.motion.v[:, self.coordinate(at)]

    def torque(self, at: str) -> float:
        """Return the rms torque or force at a place."""
        if self.coordinate(at) == 0:
            return rms(self.u)
        return self.gravity * rms(np.sin(self.q(at)))

    @property
    def gravity(self) -> float:
        """Return the amplitude of gravity on the angle."""
        values = self.values
        return values["mgl"] if self.plant == "pendulum" else values["mp"] * values["l"] * GRAVITY

    def inertia(self, at: str) -> float:
        """Return the inertia of a coordinate with the others held."""
        values = self.values
        if self.plant == "pendulum":
            return values["J"]
        return values["mc"] + values["mp"] if self.coordinate(at) == 0 else values["mp"] * values["l"] ** 2

    def load(self, at: str) -> float:
        """Return the rms of what the joint carries."""
        values, q, v = self.values, self.q("theta"), self.v("theta")
        if self.plant == "pendulum":
            return rms(values["mgl"] * np.cos(q) + values["J"] * v**2)
        ml = values["mp"] * values["l"]
        if self.coordinate(at) == 0:
            return rms((values["mc"] + values["mp"]) * GRAVITY + ml * v**2 * np.cos(q))
        return rms(ml * GRAVITY * np.cos(q) + ml * values["l"] * v**2)


@dataclass(frozen=True, eq=False)
class Hidden:
    """An effect with its size.

    Attributes
    ----------
    truth : dict
        Parameters for :func:`sysid_lab.truths.simulation.simulate`.
    named : dict
        The same in the dictionary's parameters (short names), where both mean the same.
    engine : dict
        Options of engines that have the effect themselves (Bullet, pymunk, FMU).
    sensor : callable, optional
        What the reading of channel ``at`` suffers; ``late`` if it comes after the noise.
    own : dict
        Parameters of a record of its own: ``estimation`` and ``validation``, in the truth's names.
    exact : bool
        False where the truth has another formulation: ``named`` then only starts a refit, and judges no interval.
    """

    name: str
    at: str
    truth: dict[str, float] = field(default_factory=dict)
    named: dict[str, float] = field(default_factory=dict)
    engine: dict[str, Any] = field(default_factory=dict)
    sensor: Sensor | None = None
    late: bool = False
    own: dict[str, dict[str, float]] = field(default_factory=dict)
    exact: bool = True
