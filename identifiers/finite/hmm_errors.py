"""How surely records tell the probabilities of a hidden Markov model: standard errors from the observed information."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.signals import FloatArray
from identifiers.finite.hmm_pass import Record, expected_counts

UNKNOWN = 0.5  # Standard error of a probability of which nothing is known: that of a coin whose side is not seen.

_STEP = 1e-4
"""Change of a log probability over which the gradient is differenced; it is exact, and smooth at this scale."""

_LEAST = 1e-4  # Probabilities below are at their bound: they stay there, and what is free is the rest of their row.

_NEVER = 1.5
"""Half of the 95 % bound on a probability that was met in none of n cases, times n (rule of three, Hanley 1983)."""


def probability_errors(
    records: Sequence[Record], initial: FloatArray, transition: FloatArray, emission: FloatArray, *, prior: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return standard errors of the transitions (S, A, S) and emissions (S, O) at their maximum-likelihood values.

    The gradient of the log likelihood is that of the expected complete one (Fisher's identity; Louis 1982, *J. Royal
    Statistical Society B* 44, eq. 2.1), so its differences over log probabilities give the observed information, which
    is inverted where it is positive. What has no information has the error :data:`UNKNOWN`; no error is below the one
    of an event that its row, visited so many times, has not shown.

    - ``records`` sequence of (observations, actions)
    - ``initial`` (S,): held
    - ``transition`` (S, A, S)
    - ``emission`` (S, O)
    - ``prior``: pseudo-counts of the fit

    Examples
    --------
    A coin that is seen has the binomial error:

    >>> seen, none = np.array([0, 1, 1, 1] * 25, dtype=np.intc), np.zeros(100, dtype=np.intc)
    >>> one = probability_errors([(seen, none)], np.ones(1), np.ones((1, 1, 1)), np.array([[0.25, 0.75]]))
    >>> one[1].round(4).tolist(), round((0.25 * 0.75 / 100) ** 0.5, 4)
    ([[0.0433, 0.0433]], 0.0433)
    """
    states, actions, _ = transition.shape
    cut = states * actions
    rows = [*transition.reshape(cut, states), *emission]
    free = [row > _LEAST for row in rows]
    places = [(number, column) for number, one in enumerate(free) for column in np.flatnonzero(one)]
    basis = _within_rows([int(one.sum()) for one in free])

    def gradient(changed: Sequence[FloatArray]) -> FloatArray:
        tables = np.array(changed[:cut]).reshape(transition.shape), np.array(changed[cut:])
        counts = expected_counts(records, initial, *tables)
        found = [*(counts.transition + prior).reshape(cut, states), *(counts.emission + prior)]
        slopes = [n - p * n.sum() for n, p in zip(found, changed, strict=True)]
        return np.array([slopes[number][column] for number, column in places])

    at = gradient(rows)
    information = np.empty((len(places), len(places)))
    for k, (number, column) in enumerate(places):
        moved = rows[number].copy()
        moved[column] *= np.exp(_STEP)
        moved /= moved.sum()
        information[k] = (at - gradient([*rows[:number], moved, *rows[number + 1 :]])) / _STEP
    slope = np.zeros((len(places), len(places)))
    for k, (number, column) in enumerate(places):
        for j, (other, at_column) in enumerate(places):
            if number == other:
                slope[k, j] = rows[number][column] * (float(k == j) - rows[number][at_column])
    spread = np.sqrt(_variances(basis.T @ (information + information.T) @ basis / 2.0, slope @ basis))
    counts = expected_counts(records, initial, transition, emission)
    visits = np.concatenate([counts.transition.sum(axis=2).ravel(), counts.emission.sum(axis=1)])
    least = _NEVER / np.maximum(visits, 1e-12)
    errors = [np.full(len(row), min(one, UNKNOWN)) for row, one in zip(rows, least, strict=True)]
    for value, (number, column) in zip(spread, places, strict=True):
        errors[number][column] = np.clip(value, errors[number][column], UNKNOWN)
    return np.array(errors[:cut]).reshape(transition.shape), np.array(errors[cut:])


def _within_rows(sizes: Sequence[int]) -> FloatArray:
    """Return an orthonormal basis of the changes of log probabilities that do not only rescale a row."""
    blocks = []
    for size in sizes:
        _, _, directions = np.linalg.svd(np.ones((1, size)))
        blocks.append(directions[1:].T)
    basis = np.zeros((sum(sizes), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        basis[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return basis


def _variances(information: FloatArray, slope: FloatArray) -> FloatArray:
    """Return the variances of ``slope @ x`` for an information of x; infinite along directions without any."""
    values, vectors = np.linalg.eigh(information)
    known = values > 1e-8 * max(float(values.max(initial=0.0)), 1.0)
    along = (slope @ vectors) ** 2
    variance = (along[:, known] / values[known]).sum(axis=1)
    lost = along[:, ~known].max(axis=1, initial=0.0) > 1e-6
    return np.asarray(np.where(lost, np.inf, variance))
