"""The tiger behind one of two doors: the smallest process in which listening pays, with its reward measured."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from harness.signals import Channel, FloatArray, PlantSpec
from plants.checking import checked_inputs, refuse_option
from plants.finite.pomdp import FinitePomdp


class TigerPomdp(FinitePomdp):
    """Kaelbling, Littman & Cassandra's tiger (1998, *Artificial Intelligence* 101, sec. 3.3).

    The hidden state is the door behind which the tiger is. Action 0 listens and hears the right door with probability
    ``hearing``; actions 1 and 2 open the left and the right door, after which the tiger is put behind a random one and
    what is heard means nothing. The second output is the reward of the step that led to it: -1 for listening,
    ``-danger`` for the tiger, 10 for the other door.

    Parameters
    ----------
    hearing : float
        0.5 to 1.
    danger : float
    sample_time : float
        Seconds between decisions.

    Raises
    ------
    InputError
        If ``hearing`` is out of range.

    Examples
    --------
    >>> print(TigerPomdp().spec)
    action [category 0..2] -> heard [category 0..1], reward [1] every 1 s
    """

    def __init__(self, *, hearing: float = 0.85, danger: float = 100.0, sample_time: float = 1.0) -> None:
        refuse_option("hearing", hearing, 0.5 <= hearing <= 1, "0.5 to 1")
        transition = np.full((2, 3, 2), 0.5)
        transition[:, 0] = np.eye(2)
        told = np.array([[hearing, 1 - hearing], [1 - hearing, hearing]])
        super().__init__(transition, told, sample_time=sample_time)
        self.true_reward = np.array([[-1.0, -danger, 10.0], [-1.0, 10.0, -danger]])
        base = self._spec
        heard = Channel("heard", "1", 0, 1, kind="category")
        self._spec = PlantSpec(base.inputs, (heard, Channel("reward", "1")), base.sample_time, base.states)
        self._deaf = np.array([0.5, 1.0])
        self._listened = False

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Draw the tiger's door, or take it from ``x0``; returns what is heard by chance, and no reward (2,)."""
        self._listened = False
        return np.append(super().reset(rng=rng, x0=x0), 0.0)

    def step(self, u: FloatArray) -> FloatArray:
        """Take action ``u`` (1,); returns what is heard next, and the reward of this action (2,)."""
        action = int(checked_inputs(np.atleast_2d(u), self.spec)[0, 0])
        door = int(self.truth()[0])
        self._listened = action == 0
        heard = super().step(u)
        return np.append(heard, self.true_reward[door, action])

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Take actions ``inputs`` (N, 1) in order; row k of the result (N, 2) is what ``step`` returned."""
        return np.array([self.step(row) for row in checked_inputs(inputs, self.spec)]).reshape(-1, 2)

    def _observed(self) -> FloatArray:
        """Draw what is heard: of the door after listening, of nothing otherwise."""
        if self._listened:
            return super()._observed()
        return np.array([float(np.searchsorted(self._deaf, self._rng.random(), side="right"))])
