"""A ring of machines that fail one another: a decision process whose state has many factors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from harness.signals import Channel, FloatArray, PlantSpec
from plants.checking import initial_values, positive, probability, whole
from plants.finite.mdp import FinitePlant, category_number


class MachinesMdp(FinitePlant):
    """A ring of machines, each up (1) or down (0); every step one of them, or none, is rebooted.

    A machine that runs fails more often while the one before it in the ring is down; a machine that is down comes back
    by itself rarely, and surely if it is rebooted. So the next state of each machine depends on two machines and the
    action, whatever their number (the ring of Guestrin, Koller, Parr and Venkataraman 2003, *JAIR* 19, sec. 2).

    Parameters
    ----------
    machines : int
        At least 2.
    stays : float
        Probability that a machine stays up while the one before it is up.
    stays_alone : float
        The same, while the one before it is down.
    recovers : float
        Probability that a machine that is down comes back without a reboot.
    sample_time : float
        Seconds between decisions.

    Raises
    ------
    InputError
        If a number is no probability, or there are fewer than two machines.

    Examples
    --------
    >>> print(MachinesMdp(machines=2).spec)
    reboot [category 0..2] -> m0 [category 0..1], m1 [category 0..1] every 1 s
    """

    def __init__(
        self,
        *,
        machines: int = 6,
        stays: float = 0.95,
        stays_alone: float = 0.7,
        recovers: float = 0.05,
        sample_time: float = 1.0,
    ) -> None:
        self.machines = whole("machines", machines, 2)
        probability(stays=stays, stays_alone=stays_alone, recovers=recovers)
        # up[own, before]: probability that a machine is up next.
        self._up = np.array([[recovers, recovers], [stays_alone, stays]])
        states = tuple(Channel(f"m{i}", "1", 0, 1, kind="category") for i in range(self.machines))
        # The last action reboots none.
        action = Channel("reboot", "1", 0, self.machines, kind="category")
        self._spec = PlantSpec((action,), states, positive("sample_time", sample_time), states)
        self._rng = np.random.default_rng(0)
        self._state = np.ones(self.machines, dtype=np.intp)

    def chances(self, state: FloatArray, action: int) -> FloatArray:
        """Return the probability (machines,) that each machine is up after an action."""
        now = np.asarray(state, dtype=np.intp)
        up: FloatArray = self._up[now, np.roll(now, 1)].copy()
        if action < self.machines:
            up[action] = 1.0
        return up

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start with all machines up, or as ``x0`` says; returns the states (machines,)."""
        self._rng = rng
        values = initial_values(x0, self.spec.states, [1] * self.machines)
        self._state = np.array([category_number(v, c) for v, c in zip(values, self.spec.states, strict=True)])
        return self.truth()

    def truth(self) -> FloatArray:
        """Return the states (machines,)."""
        return np.asarray(self._state, dtype=float)

    def get_state(self) -> Any:
        """Return the states and a copy of the generator's state."""
        return self._state.copy(), self._rng.bit_generator.state

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._state, self._rng.bit_generator.state = state[0].copy(), state[1]

    def _move(self, action: int) -> None:
        """Draw the next states, one number for each machine."""
        self._state = (self._rng.random(self.machines) < self.chances(self.truth(), action)).astype(np.intp)
