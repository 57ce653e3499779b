"""Finite Markov decision processes: states and actions are categories, the next state is drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, positive, probability

TOLERANCE = 1e-9  # How far a distribution's sum may be from 1.


class FinitePlant(BasePlant, ABC):
    """A plant of categories that one action moves at every step."""

    _state: Any

    @abstractmethod
    def truth(self) -> FloatArray:
        """Return the states (nx,)."""

    @abstractmethod
    def _move(self, action: int) -> None:
        """Draw the next states."""

    def step(self, u: FloatArray) -> FloatArray:
        """Take action ``u`` (1,) and return the next states (nx,).

        Raises
        ------
        InputError
            If the action is not one of 0 .. A-1.
        """
        row = checked_inputs(np.atleast_2d(u), self.spec)[0]
        self._move(category_number(row[0], self.spec.inputs[0]))
        return self.truth()

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Take actions ``inputs`` (N, 1) in order; row k of the result (N, nx) is what ``step`` returned."""
        actions = [category_number(u, self.spec.inputs[0]) for u in checked_inputs(inputs, self.spec)[:, 0]]
        outputs = np.empty((len(actions), self.spec.ny))
        for k, action in enumerate(actions):
            self._move(action)
            outputs[k] = self._state
        return outputs


class FiniteMdp(FinitePlant):
    """A finite Markov decision process as a plant: action in, state out.

    Parameters
    ----------
    transition : array (S, A, S)
        ``transition[s, a, s']`` is the probability that action ``a`` in state ``s`` leads to ``s'``.
    initial : array (S,), optional
        Distribution of the first state; default uniform.
    sample_time : float
        Seconds between decisions.
    state_name, action_name : str
        Names of the channels.

    Raises
    ------
    InputError
        If a shape does not fit, a probability is negative, or a distribution does not sum to 1.

    Notes
    -----
    All draws come from the generator given to ``reset``: the first state (one number, drawn even where ``x0``
    names the state, so that later draws do not move), then one number for each step.

    Examples
    --------
    >>> stay = FiniteMdp(np.eye(2)[:, None, :], initial=[0.0, 1.0])
    >>> start = stay.reset(rng=np.random.default_rng(0))
    >>> start.tolist(), stay.step(np.array([0.0])).tolist()
    ([1.0], [1.0])
    """

    def __init__(
        self,
        transition: npt.ArrayLike,
        initial: npt.ArrayLike | None = None,
        *,
        sample_time: float = 1.0,
        state_name: str = "state",
        action_name: str = "action",
    ) -> None:
        table = np.array(transition, dtype=float)
        if table.ndim != 3 or table.shape[0] != table.shape[2] or 0 in table.shape:
            raise InputError(
                "shape of transition",
                expected="(S, A, S) with axes (state, action, next state)",
                got=str(table.shape),
                remedy="put the next state on the last axis",
            )
        self.transition = checked_distribution("transition", table)
        n_states, n_actions, _ = table.shape
        first = np.full(n_states, 1 / n_states) if initial is None else np.array(initial, dtype=float)
        if first.shape != (n_states,):
            raise InputError(
                "shape of initial", expected=f"({n_states},)", got=str(first.shape), remedy="one number for each state"
            )
        self.initial = checked_distribution("initial", first)
        state = Channel(state_name, "1", 0, n_states - 1, kind="category")
        action = Channel(action_name, "1", 0, n_actions - 1, kind="category")
        self._spec = PlantSpec((action,), (state,), positive("sample_time", sample_time), (state,))
        # The last bound is exactly 1, so that no draw from [0, 1) falls beyond the last state.
        self._bounds = cumulated(self.transition)
        self._first_bounds = cumulated(self.initial)
        self._rng = np.random.default_rng(0)
        self._state = 0

    @property
    def true_transition(self) -> FloatArray:
        """The transition probabilities (S, A, S)."""
        return self.transition

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Draw the first state, or take it from ``x0``; returns it as ``y[0]`` (1,)."""
        self._rng = rng
        drawn = int(np.searchsorted(self._first_bounds, rng.random(), side="right"))
        (value,) = initial_values(x0, self.spec.states, [drawn])
        self._state = category_number(value, self.spec.states[0])
        return np.array([float(self._state)])

    def truth(self) -> FloatArray:
        """Return the state (1,)."""
        return np.array([float(self._state)])

    def get_state(self) -> Any:
        """Return the state and a copy of the generator's state."""
        return self._state, self._rng.bit_generator.state

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._state, self._rng.bit_generator.state = state

    def _move(self, action: int) -> None:
        """Draw the next state."""
        bounds = self._bounds[self._state, action]
        self._state = int(np.searchsorted(bounds, self._rng.random(), side="right"))


def grid_mdp(
    *,
    rows: int = 3,
    columns: int = 4,
    slip: float = 0.2,
    walls: Sequence[tuple[int, int]] = ((1, 1),),
    restart: float = 0.05,
    sample_time: float = 1.0,
) -> FiniteMdp:
    """Slippery grid: four actions move up, right, down, left, or slip to a side; walls and borders stop.

    Parameters
    ----------
    rows, columns : int
        Size of the grid.
    slip : float
        Probability of moving at right angles instead, half to each side.
    walls : sequence of (row, column)
        Cells that cannot be entered and are no states.
    restart : float
        Probability of being put into a cell at random: it makes every policy ergodic.
    sample_time : float
        Seconds between decisions.

    Raises
    ------
    InputError
        If the grid has no free cell or a probability is outside [0, 1].

    Examples
    --------
    >>> grid_mdp().true_transition.shape
    (11, 4, 11)
    """
    probability(slip=slip, restart=restart)
    blocked = {(int(row), int(column)) for row, column in walls}
    cells = [(row, column) for row in range(rows) for column in range(columns) if (row, column) not in blocked]
    if not cells:
        raise InputError("a grid without cells", expected="a free cell", got="none", remedy="enlarge it")
    number = {cell: index for index, cell in enumerate(cells)}
    moves = ((-1, 0), (0, 1), (1, 0), (0, -1))
    table = np.zeros((len(cells), 4, len(cells)))
    for (row, column), state in number.items():
        for action in range(4):
            for turn, chance in ((0, 1 - slip), (1, slip / 2), (3, slip / 2)):
                down, right = moves[(action + turn) % 4]
                table[state, action, number.get((row + down, column + right), state)] += chance
    table = (1 - restart) * table + restart / len(cells)
    return FiniteMdp(table, sample_time=sample_time)


def checked_distribution(name: str, table: FloatArray) -> FloatArray:
    """Return a read-only table whose last axis holds distributions, or refuse it.

    Raises InputError if an entry is negative or not finite, or a distribution does not sum to 1.
    """
    bad = ~(np.isfinite(table) & (table >= 0))
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(
            f"probability in {name}",
            expected="numbers >= 0",
            got=f"{table[where]} at {name}{list(where)}",
            remedy="correct the entry",
            place=f"{name}{list(where)}",
        )
    sums = table.sum(axis=-1)
    if (off := np.abs(sums - 1)).max() > TOLERANCE:
        at = tuple(int(i) for i in np.unravel_index(int(np.argmax(off)), off.shape))
        raise InputError(
            f"distribution in {name}",
            expected="a sum of 1",
            got=f"{float(sums[at]):.12g} at {name}{list(at)}",
            remedy="normalise the last axis",
            place=f"{name}{list(at)}",
        )
    table.flags.writeable = False
    return table


def cumulated(table: FloatArray) -> FloatArray:
    """Return upper bounds of the draws; all of the states after the last possible one are exactly 1."""
    bounds: FloatArray = np.cumsum(table, axis=-1)
    last = table.shape[-1] - 1 - np.argmax(table[..., ::-1] > 0, axis=-1)
    bounds[np.arange(table.shape[-1]) >= last[..., None]] = 1.0
    return bounds


def category_number(value: float, channel: Channel) -> int:
    """Return a category as an integer, or refuse it."""
    number = int(value) if np.isfinite(value) else -1
    if number != value or not 0 <= number <= channel.maximum:
        raise InputError(
            f"value of {channel.name!r}",
            expected=f"an integer in 0..{int(channel.maximum)}",
            got=str(float(value)),
            remedy="give a category of this channel",
        )
    return number
