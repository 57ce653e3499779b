"""Values of finite decision processes, and what an error of the transition probabilities costs them.

Tables: ``transition`` (S, A, S), ``reward`` (S, A), ``policy`` (S, A) with rows that sum to 1, ``discount`` in [0, 1).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.signals import FloatArray

Labels = npt.NDArray[np.intp]

_SWEEPS = 1000  # Policy iteration ends after few sweeps; so many mean that the tables are no decision process.


def policy_values(transition: FloatArray, reward: FloatArray, policy: FloatArray, discount: float) -> FloatArray:
    """Return the discounted value of every state under a policy (S,).

    Solves ``V = r_pi + discount P_pi V`` (Puterman 1994, *Markov Decision Processes*, eq. 6.1.5).

    Raises
    ------
    InputError
        If a shape or the discount does not fit.

    Examples
    --------
    >>> policy_values(np.ones((1, 1, 1)), np.ones((1, 1)), np.ones((1, 1)), 0.9).round(9).tolist()
    [10.0]
    """
    _fitting(transition, reward, discount)
    if np.shape(policy) != np.shape(reward):
        raise InputError(
            "shape of policy",
            expected=str(np.shape(reward)),
            got=str(np.shape(policy)),
            remedy="one row for each state",
        )
    mixed = np.einsum("sa,sat->st", policy, transition)
    earned = np.sum(policy * reward, axis=1)
    values: FloatArray = np.linalg.solve(np.eye(len(earned)) - discount * mixed, earned)
    return values


def optimal_values(transition: FloatArray, reward: FloatArray, discount: float) -> tuple[FloatArray, FloatArray]:
    """Return the optimal values (S,) and action values (S, A), by policy iteration (Puterman 1994, sec. 6.4).

    Raises InputError as of :func:`policy_values`.

    Examples
    --------
    >>> stay_or_go = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
    >>> values, _ = optimal_values(stay_or_go, np.array([[0.0, 0.0], [1.0, 1.0]]), 0.5)
    >>> values.round(9).tolist()
    [1.0, 2.0]
    """
    _fitting(transition, reward, discount)
    states, actions = reward.shape
    chosen = np.argmax(reward, axis=1)
    for _ in range(_SWEEPS):
        values = policy_values(transition, reward, np.eye(actions)[chosen], discount)
        q = reward + discount * transition @ values
        # An action changes only where it gains more than rounding, so that ties cannot circle.
        gain = q.max(axis=1) - q[np.arange(states), chosen]
        better = gain > 1e-12 * (1.0 + np.abs(values).max())
        if not better.any():
            return values, q
        chosen = np.where(better, np.argmax(q, axis=1), chosen)
    raise InputError(
        "policy iteration", expected="an end", got=f"none in {_SWEEPS} sweeps", remedy="check that the rows sum to 1"
    )


def value_error_bound(radius: FloatArray, values: FloatArray, discount: float) -> float:
    """Return a bound of the error of a policy's values on the identified process.

    ``discount max ||P - P_hat||_1 span(V) / (2 (1 - discount))``, where V are the values on either process (the
    simulation lemma, Kearns and Singh 2002, *Machine Learning* 49, lemma 4, with span for twice the largest value).

    Parameters
    ----------
    radius : array (S, A)
        Bound on the l1 error of every row, for example :attr:`identifiers.finite.mdp.MdpModel.bound`; 2 at most counts.
    values : array (S,)
        On the identified process.
    discount : float

    Examples
    --------
    >>> value_error_bound(np.array([[0.1]]), np.array([0.0, 1.0]), 0.9)
    0.45
    """
    worst = float(np.minimum(radius, 2.0).max())
    return round(discount * worst * float(np.ptp(values)) / (2.0 * (1.0 - discount)), 15)


def action_sufficient(transition: FloatArray, reward: FloatArray, discount: float, tolerance: float = 1e-9) -> Labels:
    """Return the classes (S,) of states with the same set of optimal actions.

    Enough to act optimally once the best actions are known, but neither to value nor, in general, to learn them
    (pi*-irrelevance, Li, Walsh and Littman 2006).
    """
    q = optimal_values(transition, reward, discount)[1]
    return groups_of_rows((q >= q.max(axis=1, keepdims=True) - tolerance).astype(float), 0.5)


def groups_of_rows(rows: FloatArray, tolerance: float, labels: Labels | None = None) -> Labels:
    """Return group numbers (S,) of rows (S, n) that agree in every column; numbered as they first appear.

    Values of a column belong together as long as no gap between neighbours is wider than the tolerance.

    - ``rows`` (S, n)
    - ``labels`` (S,): groups that are only split further

    Examples
    --------
    >>> groups_of_rows(np.array([[1.0], [2.0], [1.0 + 1e-12]]), 1e-9).tolist()
    [0, 1, 0]
    """
    found = np.zeros(len(rows), dtype=np.intp) if labels is None else np.asarray(labels, dtype=np.intp)
    for column in np.asarray(rows, dtype=float).T:
        order = np.lexsort((column, found))
        cut = (np.diff(found[order]) != 0) | (np.diff(column[order]) > tolerance)
        new = np.empty_like(found)
        new[order] = np.concatenate([[0], np.cumsum(cut)])
        found = new
    _, first, number = np.unique(found, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[number]


def _fitting(transition: FloatArray, reward: FloatArray, discount: float) -> None:
    """Refuse tables that do not belong together."""
    shape = np.shape(transition)
    if len(shape) != 3 or shape[0] != shape[2] or np.shape(reward) != shape[:2]:
        raise InputError(
            "tables of a decision process",
            expected="transition (S, A, S) and reward (S, A)",
            got=f"{shape} and {np.shape(reward)}",
            remedy="give a reward for each state and action",
        )
    if not 0 <= discount < 1:
        raise InputError("discount", expected="0 <= discount < 1", got=repr(discount), remedy="correct it")
