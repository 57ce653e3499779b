"""Two corridors that lead to one goal: a decision process whose states differ in more than a decision needs."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray
from plants.checking import positive, refuse_option, whole
from plants.finite.mdp import FiniteMdp


class CorridorsMdp(FiniteMdp):
    """Two corridors of the same length side by side, of which one is slippery, and a goal at their ends.

    States ``0 .. n - 1`` are the first corridor from its far end on, ``n .. 2 n - 1`` the second, ``2 n`` is the goal.
    Action 0 walks towards the goal, action 1 away from it; in the second corridor a step fails with the probability
    ``slip``. The goal leads back to a random far end. The reward is 1 in the goal and 0 elsewhere.

    So the best action is the same everywhere: one class is enough to act. The values differ with the distance and, if
    ``slip`` is more than 0, with the corridor. Without slip the two corridors are bisimilar.

    Parameters
    ----------
    length : int
        Cells of each corridor.
    slip : float
        Probability that a step in the second corridor fails.
    sample_time : float
        Seconds between decisions.

    Raises
    ------
    InputError
        If there is no cell, or ``slip`` is no probability below 1.

    Examples
    --------
    >>> CorridorsMdp(length=4).true_transition.shape
    (9, 2, 9)
    """

    def __init__(self, *, length: int = 5, slip: float = 0.0, sample_time: float = 1.0) -> None:
        length = whole("length", length)
        refuse_option("slip", slip, 0 <= slip < 1, "0 <= slip < 1")
        goal = 2 * length
        table = np.zeros((goal + 1, 2, goal + 1))
        for corridor, failing in ((0, 0.0), (1, slip)):
            for cell in range(length):
                state = corridor * length + cell
                forth = state + 1 if cell + 1 < length else goal
                for action, there in ((0, forth), (1, corridor * length + max(cell - 1, 0))):
                    table[state, action, there] += 1 - failing
                    table[state, action, state] += failing
        table[goal, :, 0] = table[goal, :, length] = 0.5
        super().__init__(table, sample_time=positive("sample_time", sample_time))

    @property
    def true_reward(self) -> FloatArray:
        """Reward of each state and action (S, A)."""
        reward = np.zeros(self.transition.shape[:2])
        reward[-1] = 1.0
        return reward
