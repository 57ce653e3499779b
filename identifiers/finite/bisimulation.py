"""Smaller decision processes: exact bisimulation, the bisimulation metric, approximate information states.

Two states are bisimilar if they earn the same and reach the same classes with the same probabilities whatever is done
(Givan, Dean and Greig 2003, *Artificial Intelligence* 147, def. 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from identifiers.finite.decision import Labels, groups_of_rows, optimal_values

_PROBES = 2  # Random weights that tell distributions over classes apart in each round; a result is verified afterwards.

LEVEL = 0.01  # Chance that the counts of a process split states that are the same.

_TRIES = 5
"""Draws of other weights if the verification finds a class that is none (two probes agree by chance to 1e-9)."""


def bisimulation(transition: FloatArray | Sequence[Any], reward: FloatArray, *, tolerance: float = 1e-9) -> Labels:
    """Return the coarsest exact bisimulation: the class of every state (S,).

    Classes are split until all their states reach every class alike. Instead of the probabilities of all classes, a
    round compares expectations of random weights of the classes, so that it costs one product with the transition
    matrix; the result is checked with the probabilities themselves.

    Parameters
    ----------
    transition : array (S, A, S), or A sparse matrices (S, S)
    reward : array (S, A)
    tolerance : float
        Probabilities and rewards that differ by less are equal.

    Returns
    -------
    array (S,) of int
        Numbered as they first appear.

    Raises
    ------
    InputError
        If the shapes do not fit.

    Examples
    --------
    >>> twins = np.array([[[0.0, 0.5, 0.5]], [[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]])
    >>> bisimulation(twins, np.array([[0.0], [1.0], [1.0]])).tolist()
    [0, 1, 1]
    """
    matrices = _matrices(transition, reward)
    for attempt in range(_TRIES):
        rng = np.random.default_rng(attempt)
        labels = groups_of_rows(reward, tolerance)
        while True:
            weights = rng.random((int(labels.max()) + 1, _PROBES))
            seen = np.hstack([np.asarray(matrix @ weights[labels]) for matrix in matrices])
            finer = groups_of_rows(seen, tolerance, labels)
            if finer.max() == labels.max():
                break
            labels = finer
        if _deviation(matrices, labels) <= 10 * tolerance:
            return labels
    return _by_probabilities(matrices, reward, tolerance)


def counted_bisimulation(counts: FloatArray, reward: FloatArray, *, level: float = LEVEL) -> Labels:
    """Return the fewest classes that counted transitions allow: the class of every state (S,).

    Classes are split as in :func:`bisimulation`, a state from a class only if a chi-squared test of all its actions
    rejects that both reach the classes alike, at ``level`` shared among all pairs of states (Bonferroni). States that
    the counts do not tell apart are one: more data may split them.

    - ``counts`` (S, A, S)
    - ``reward`` (S, A)

    Examples
    --------
    >>> counts, reward = np.array([[[0, 5, 5]], [[9, 1, 0]], [[6, 0, 4]]]), np.array([[1.0], [0.0], [0.0]])
    >>> counted_bisimulation(counts, reward).tolist(), counted_bisimulation(20 * counts, reward).tolist()
    ([0, 1, 1], [0, 1, 2])
    """
    states = len(reward)
    labels = groups_of_rows(reward, 1e-9)
    share = level / max(1, states * (states - 1) // 2)
    while True:
        seen = counts @ np.eye(int(labels.max()) + 1)[labels]
        pooled: dict[tuple[int, int], FloatArray] = {}  # of each class so far, its number within the class before
        finer = np.empty((states, 1))
        for state in np.argsort(-seen.sum(axis=(1, 2)), kind="stable"):
            old = int(labels[state])
            mine = [key for key in pooled if key[0] == old]
            key = next((one for one in mine if _alike(pooled[one], seen[state], share)), (old, len(mine)))
            pooled[key] = pooled.get(key, 0.0) + seen[state]
            finer[state] = list(pooled).index(key)
        found = groups_of_rows(finer, 0.5)
        if found.max() == labels.max():
            return found
        labels = found


def _alike(one: FloatArray, other: FloatArray, level: float) -> bool:
    """Return whether two tables of counts (A, C) may have the same probabilities (chi-squared test of homogeneity)."""
    from scipy.stats import chi2

    both, sizes = one + other, (one.sum(axis=1), other.sum(axis=1))
    tried = (sizes[0] > 0) & (sizes[1] > 0)
    if not tried.any():
        return True
    total = (sizes[0] + sizes[1])[tried, None]
    statistic = 0.0
    for table, size in zip((one, other), sizes, strict=True):
        expected = np.maximum(size[tried, None] * both[tried] / total, 1e-300)
        statistic += float(((table[tried] - expected) ** 2 / expected).sum())
    free = int((both[tried] > 0).sum() - tried.sum())
    return free == 0 or float(chi2.sf(statistic, free)) >= level


def quotient(
    transition: FloatArray | Sequence[Any], reward: FloatArray, labels: Labels
) -> tuple[FloatArray, FloatArray]:
    """Return transition (B, A, B) and reward (B, A) between classes, means over the states of each class.

    Exact if the classes are a bisimulation; an aggregation otherwise.

    Examples
    --------
    >>> P, r = quotient(np.full((2, 1, 2), 0.5), np.ones((2, 1)), np.array([0, 0]))
    >>> P.tolist(), r.tolist()
    ([[[1.0]]], [[1.0]])
    """
    matrices = _matrices(transition, reward)
    member, share = _membership(labels)
    tables = [np.asarray((share @ (matrix @ member)).todense()) for matrix in matrices]
    return np.stack(tables, axis=1), np.asarray(share @ reward)


def bisimulation_metric(
    transition: FloatArray, reward: FloatArray, discount: float, *, tolerance: float = 1e-6
) -> FloatArray:
    """Return the bisimulation distance of every two states (S, S), 0 for bisimilar ones.

    The fixed point of ``d(s, t) = max_a |r(s,a) - r(t,a)| + discount W(P(s,a), P(t,a); d)`` with the Kantorovich
    distance W (Ferns, Panangaden and Precup 2004, *UAI*, theorem 4.5, with c_R = 1 and c_T = discount). Optimal values
    of two states differ by no more than it (theorem 5.1). Couplings are improved by linear programs, distances solved
    for between them, as in policy iteration; meant for some tens of classes, so reduce by :func:`bisimulation` first.

    Parameters
    ----------
    transition : array (S, A, S)
    reward : array (S, A)
    discount : float
        Less than 1.
    tolerance : float
        Largest error of a distance.

    Raises
    ------
    InputError
        If shapes do not fit or the discount is not in [0, 1).
    """
    optimal_values(transition, reward, discount)  # refuses what does not fit
    labels = bisimulation(transition, reward)
    small, earned = quotient(transition, reward, labels)
    count, actions = earned.shape
    first, second = np.triu_indices(count, 1)
    gap = np.abs(earned[first] - earned[second])
    d = np.zeros((count, count))
    if first.size == 0:
        return d[np.ix_(labels, labels)]
    couplings = _Couplings(small, first, second)
    # Errors shrink by the discount in each round: this change bounds what is left.
    enough = tolerance * (1.0 - discount)
    while True:
        moved = couplings.best(d)
        new = d
        while True:
            values = (gap + discount * (moved @ new.ravel()).reshape(actions, -1).T).max(axis=1)
            change = float(np.abs(values - new[first, second]).max())
            new = np.zeros_like(d)
            new[first, second] = new[second, first] = values
            if change <= 0.1 * enough:
                break
        settled = float(np.abs(new - d).max()) <= enough
        d = new
        if settled:
            return d[np.ix_(labels, labels)]


@dataclass(frozen=True)
class InformationGap:
    """What a compression of the state loses."""

    epsilon: float  # Largest error of the reward
    delta: float
    """Largest total variation between the true distribution of the next class and that of the small process."""
    bound: float
    """On ``realised``: ``(epsilon + discount delta span(V)) / (1 - discount)``, with the values V of the small process
    (Subramanian et al. 2022, *JMLR* 23(12), with total variation as the metric)."""
    realised: float  # Largest difference between optimal values of the true and of the small process
    loss: float  # What the small process's policy loses on the true one, at the worst state; at most twice ``bound``


def information_gap(transition: FloatArray, reward: FloatArray, labels: Labels, discount: float) -> InformationGap:
    """Judge classes of states as an approximate information state.

    Parameters
    ----------
    transition : array (S, A, S)
    reward : array (S, A)
    labels : array (S,)
        Class of each state.
    discount : float
        Less than 1.

    Raises
    ------
    InputError
        If shapes do not fit or the discount is not in [0, 1).

    Examples
    --------
    >>> P, r = np.array([[[0.9, 0.1]], [[0.1, 0.9]]]), np.array([[0.0], [1.0]])
    >>> gap = information_gap(P, r, np.array([0, 0]), 0.5)
    >>> gap.epsilon, gap.delta, gap.bound >= gap.realised
    (0.5, 0.0, True)
    """
    from identifiers.finite.decision import policy_values

    true_values, _ = optimal_values(transition, reward, discount)
    small, earned = quotient(transition, reward, labels)
    values, q = optimal_values(small, earned, discount)
    member = np.eye(small.shape[0])[labels]
    reached = transition @ member
    epsilon = float(np.abs(reward - earned[labels]).max())
    delta = float(0.5 * np.abs(reached - small[labels]).sum(axis=2).max())
    bound = (epsilon + discount * delta * float(np.ptp(values))) / (1.0 - discount)
    policy = np.eye(reward.shape[1])[np.argmax(q, axis=1)][labels]
    lost = true_values - policy_values(transition, reward, policy, discount)
    return InformationGap(
        epsilon, delta, bound, float(np.abs(true_values - values[labels]).max()), float(max(lost.max(), 0.0))
    )


class _Couplings:
    """Optimal transport between the rows of every two classes, all pairs and actions in one linear program."""

    def __init__(self, small: FloatArray, first: Labels, second: Labels) -> None:
        from scipy.sparse import coo_array

        count, actions = small.shape[:2]
        rows, columns, amounts, sources, row = [], [], [], [], 0
        variables = 0
        self._flat: list[Any] = []
        self._problem: list[Any] = []
        for action in range(actions):
            for pair, (i, j) in enumerate(zip(first, second, strict=True)):
                p, q = small[i, action], small[j, action]
                here, there = np.flatnonzero(p), np.flatnonzero(q)
                a, b = np.meshgrid(np.arange(here.size), np.arange(there.size), indexing="ij")
                number = variables + np.arange(a.size)
                rows += [row + a.ravel(), row + here.size + b.ravel()]
                columns += [number, number]
                amounts.append(np.concatenate([p[here], q[there]]))
                sources.append(here[a.ravel()] * count + there[b.ravel()])
                self._problem.append(np.full(a.size, action * len(first) + pair))
                row += here.size + there.size
                variables += a.size
        index = (np.concatenate(rows), np.concatenate(columns))
        self._equal: Any = coo_array((np.ones(index[0].size), index), shape=(row, variables)).tocsr()
        self._amount = np.concatenate(amounts)
        self._source = np.concatenate(sources)
        self._which = np.concatenate(self._problem)
        self._shape = (actions * len(first), count * count)

    def best(self, d: FloatArray) -> Any:
        """Return the cheapest couplings under distances d, a sparse matrix (A * pairs, S * S)."""
        from scipy.optimize import linprog
        from scipy.sparse import coo_array

        solver: Any = linprog
        found = solver(d.ravel()[self._source], A_eq=self._equal, b_eq=self._amount, method="highs")
        if found.x is None:
            raise InputError(
                "transport between distributions",
                expected="rows that sum to 1",
                got=str(found.message),
                remedy="normalise the transition probabilities",
            )
        return coo_array((np.maximum(found.x, 0.0), (self._which, self._source)), shape=self._shape).tocsr()


def _matrices(transition: FloatArray | Sequence[Any], reward: FloatArray) -> list[Any]:
    """Return one sparse matrix (S, S) for each action."""
    from scipy.sparse import csr_array

    if isinstance(transition, np.ndarray) and transition.ndim == 3:
        parts = [csr_array(transition[:, action]) for action in range(transition.shape[1])]
    else:
        parts = [csr_array(matrix) for matrix in transition]
    states, actions = reward.shape
    if len(parts) != actions or any(matrix.shape != (states, states) for matrix in parts):
        raise InputError(
            "tables of a decision process",
            expected=f"transition ({states}, {actions}, {states}), or {actions} matrices ({states}, {states})",
            got=f"{len(parts)} matrices {[matrix.shape for matrix in parts][:1]}",
            remedy="give a reward for each state and action",
        )
    return parts


def _membership(labels: Labels) -> tuple[Any, Any]:
    """Return which state belongs to which class (S, B), and the mean over each class (B, S), both sparse."""
    from scipy.sparse import csr_array

    states = len(labels)
    member = csr_array((np.ones(states), (np.arange(states), labels)))
    size = np.bincount(labels)
    share = csr_array((1.0 / size[labels], (labels, np.arange(states))))
    return member, share


def _deviation(matrices: Sequence[Any], labels: Labels) -> float:
    """Return how far states are from the mean of their class in the probability of any class."""
    member, share = _membership(labels)
    worst = 0.0
    for matrix in matrices:
        reached = matrix @ member
        difference = reached - member @ (share @ reached)
        worst = max(worst, float(np.abs(difference.data).max()) if difference.nnz else 0.0)
    return worst


def _by_probabilities(matrices: Sequence[Any], reward: FloatArray, tolerance: float) -> Labels:
    """Return the partition by comparing the probabilities themselves: slow, and never wrong."""
    labels = groups_of_rows(reward, tolerance)
    while True:
        member, _ = _membership(labels)
        rows = np.hstack([np.asarray((matrix @ member).todense()) for matrix in matrices])
        finer = groups_of_rows(rows, tolerance, labels)
        if finer.max() == labels.max():
            return labels
        labels = finer
