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

_PROBED = 1e-3  # Probability at which it is asked how much the records speak against one that is at its bound.

_NEVER = 1.5
"""Half of the 95 % bound on a probability that was met in none of n cases, times n (rule of three, Hanley 1983)."""


def probability_errors(
    records: Sequence[Record], initial: FloatArray, transition: FloatArray, emission: FloatArray, *, prior: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return standard errors of the transitions (S, A, S) and emissions (S, O) at their maximum-likelihood values.

    The gradient of the log likelihood is that of the expected complete one (Fisher's identity; Louis 1982, *J. Royal
    Statistical Society B* 44, eq. 2.1), so its differences over log probabilities give the observed information, which
    is inverted where it is positive. What has no information has the error :data:`UNKNOWN`; no error is below the one
    of an event that its row, visited so many times, has not shown. A probability at its bound is as uncertain as the
    slope of the likelihood there lets it be, and few cases widen the errors (:func:`_widened`).

    - ``records`` sequence of (observations, actions)
    - ``initial`` (S,): held
    - ``transition`` (S, A, S)
    - ``emission`` (S, O)
    - ``prior``: pseudo-counts of the fit

    Examples
    --------
    A coin that is seen has nearly the binomial error:

    >>> seen, none = np.array([0, 1, 1, 1] * 25, dtype=np.intc), np.zeros(100, dtype=np.intc)
    >>> one = probability_errors([(seen, none)], np.ones(1), np.ones((1, 1, 1)), np.array([[0.25, 0.75]]))
    >>> one[1].round(4).tolist(), round((0.25 * 0.75 / 100) ** 0.5, 4)
    ([[0.0438, 0.0438]], 0.0433)
    """
    states, actions, _ = transition.shape
    cut = states * actions
    rows = [*transition.reshape(cut, states), *emission]
    free = [row > _LEAST for row in rows]
    places = [(number, column) for number, one in enumerate(free) for column in np.flatnonzero(one).tolist()]
    basis = _within_rows([int(one.sum()) for one in free])

    def counted(changed: Sequence[FloatArray]) -> list[FloatArray]:
        tables = np.array(changed[:cut]).reshape(transition.shape), np.array(changed[cut:])
        counts = expected_counts(records, initial, *tables)
        return [*counts.transition.reshape(cut, states), *counts.emission]

    def gradient(changed: Sequence[FloatArray]) -> FloatArray:
        found = [one + prior for one in counted(changed)]
        slopes = [n - p * n.sum() for n, p in zip(found, changed, strict=True)]
        return np.array([slopes[number][column] for number, column in places])

    def with_one(number: int, column: int, value: float) -> list[FloatArray]:
        moved = rows[number].copy()
        moved[column] = value
        return [*rows[:number], moved / moved.sum(), *rows[number + 1 :]]

    at = gradient(rows)
    information = np.empty((len(places), len(places)))
    for k, (number, column) in enumerate(places):
        there = with_one(number, column, rows[number][column] * np.exp(_STEP))
        information[k] = (at - gradient(there)) / _STEP
    slope = np.zeros((len(places), len(places)))
    for k, (number, column) in enumerate(places):
        for j, (other, at_column) in enumerate(places):
            if number == other:
                slope[k, j] = rows[number][column] * (float(k == j) - rows[number][at_column])
    spread = np.sqrt(_variances(basis.T @ (information + information.T) @ basis / 2.0, slope @ basis))
    least = [_NEVER / max(float(one.sum()), 1e-12) for one in counted(rows)]
    errors = [np.full(len(row), min(one, UNKNOWN)) for row, one in zip(rows, least, strict=True)]
    for value, (number, column) in zip(spread, places, strict=True):
        errors[number][column] = np.clip(_widened(value, rows[number][column]), errors[number][column], UNKNOWN)
    for number, error in enumerate(errors):
        one = free[number]
        for absent in np.flatnonzero(~one).tolist():
            there = with_one(number, absent, _PROBED)
            own = counted(there)[number]
            against = float(own.sum() - own[absent] / there[number][absent])  # fall of the log likelihood with it
            error[absent] = np.clip(_NEVER / max(against, 1e-12), error[absent], UNKNOWN)
        # what those at their bound may have, the others lack
        error[one] = np.minimum(np.hypot(error[one], rows[number][one] * np.linalg.norm(error[~one])), UNKNOWN)
    return np.array(errors[:cut]).reshape(transition.shape), np.array(errors[cut:])


def _widened(error: float, p: float) -> float:
    """Return a standard error with the variance of a probability nearer to a half (Agresti & Coull 1998, sec. 2)."""
    if not 0 < error < UNKNOWN:
        return error
    cases = p * (1 - p) / error**2  # as many that are seen would leave this error
    nearer = (cases * p + 2) / (cases + 4)
    return float(np.sqrt(nearer * (1 - nearer) / max(cases, 1e-12)))


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
