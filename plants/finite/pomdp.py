"""Partially observed Markov decision processes: the state is hidden, a noisy observation of it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, probability
from plants.finite.mdp import FiniteMdp, checked_distribution, cumulated, grid_mdp


class FinitePomdp(BasePlant):
    """A finite POMDP as a plant: action in, observation out; the hidden state is the truth.

    Parameters
    ----------
    transition : array (S, A, S)
        As in :class:`plants.finite.mdp.FiniteMdp`.
    observation : array (S, O)
        ``observation[s, o]`` is the probability of seeing ``o`` in state ``s``. With A = 1 this is a hidden Markov
        model.
    initial : array (S,), optional
        Distribution of the first state; default uniform.
    sample_time : float
        Seconds between decisions.

    Raises
    ------
    InputError
        As of :class:`plants.finite.mdp.FiniteMdp`.

    Notes
    -----
    Two numbers are drawn for each sample: the state's, then the observation's.

    Examples
    --------
    >>> plant = FinitePomdp(np.eye(2)[:, None, :], [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], initial=[0.0, 1.0])
    >>> plant.reset(rng=np.random.default_rng(0)).tolist(), plant.truth().tolist()
    ([1.0], [1.0])
    """

    def __init__(
        self,
        transition: npt.ArrayLike,
        observation: npt.ArrayLike,
        initial: npt.ArrayLike | None = None,
        *,
        sample_time: float = 1.0,
    ) -> None:
        self._mdp = FiniteMdp(transition, initial, sample_time=sample_time)
        table = np.array(observation, dtype=float)
        n_states = self._mdp.transition.shape[0]
        if table.ndim != 2 or table.shape[0] != n_states or 0 in table.shape:
            raise InputError(
                "shape of observation",
                expected=f"({n_states}, O) with axes (state, observation)",
                got=str(table.shape),
                remedy="give one row for each state",
            )
        self.observation = checked_distribution("observation", table)
        self._bounds = cumulated(self.observation)
        seen = Channel("observation", "1", 0, table.shape[1] - 1, kind="category")
        hidden = self._mdp.spec
        self._spec = PlantSpec(hidden.inputs, (seen,), hidden.sample_time, hidden.states)

    @property
    def true_transition(self) -> FloatArray:
        """The transition probabilities (S, A, S)."""
        return self._mdp.transition

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Draw the first state, or take it from ``x0``; returns the first observation (1,)."""
        self._mdp.reset(rng=rng, x0=x0)
        self._rng = rng
        return self._observed()

    def step(self, u: FloatArray) -> FloatArray:
        """Take action ``u`` (1,) and return the next observation (1,)."""
        self._mdp.step(u)
        return self._observed()

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Take actions ``inputs`` (N, 1) in order; row k of the result (N, 1) is what ``step`` returned."""
        checked = checked_inputs(inputs, self.spec)
        outputs = np.empty((len(checked), 1))
        for k, row in enumerate(checked):
            outputs[k] = self.step(row)
        return outputs

    def truth(self) -> FloatArray:
        """Return the hidden state (1,)."""
        return self._mdp.truth()

    def get_state(self) -> Any:
        """Return the state and a copy of the generator's state."""
        return self._mdp.get_state()

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._mdp.set_state(state)

    def _observed(self) -> FloatArray:
        """Draw an observation of the present state."""
        bounds = self._bounds[int(self._mdp.truth()[0])]
        return np.array([float(np.searchsorted(bounds, self._rng.random(), side="right"))])


def grid_pomdp(*, error: float = 0.2, **options: Any) -> FinitePomdp:
    """Slippery grid seen through a noisy sensor: with probability ``error`` it reports a cell at random.

    Parameters
    ----------
    error : float
        Probability of a wrong report (which may be right by chance).
    **options
        Of :func:`plants.finite.mdp.grid_mdp`.

    Raises
    ------
    InputError
        If ``error`` is no probability.

    Examples
    --------
    >>> print(grid_pomdp().spec)
    action [category 0..3] -> observation [category 0..10] every 1 s
    """
    probability(error=error)
    grid = grid_mdp(**options)
    n = grid.transition.shape[0]
    table = (1 - error) * np.eye(n) + error / n
    return FinitePomdp(grid.transition, table, sample_time=grid.spec.sample_time)
