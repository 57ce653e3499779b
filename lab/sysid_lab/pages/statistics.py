"""Exact bounds for counts."""

from __future__ import annotations

from harness.errors import InputError


def upper_bound(found: int, of: int, *, confidence: float = 0.95) -> float:
    """Return the one-sided upper Clopper-Pearson bound of a probability.

    Parameters
    ----------
    found, of : int
        Events, out of trials.
    confidence : float
        In (0, 1).

    Raises
    ------
    InputError
        If the counts make no sense.

    Notes
    -----
    Clopper & Pearson 1934: the largest p for which ``found`` or fewer events have probability ``1 - confidence``.

    Examples
    --------
    >>> round(upper_bound(0, 300), 5)
    0.00994
    """
    from scipy.stats import beta

    _check(found, of)
    return 1.0 if found == of else float(beta.ppf(confidence, found + 1, of - found))


def clopper_pearson(found: int, of: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the two-sided Clopper-Pearson interval of a probability.

    Raises
    ------
    InputError
        If the counts make no sense.

    Examples
    --------
    >>> [round(limit, 3) for limit in clopper_pearson(95, 100)]
    [0.887, 0.984]
    """
    from scipy.stats import beta

    _check(found, of)
    tail = 0.5 * (1 - confidence)
    low = 0.0 if found == 0 else float(beta.ppf(tail, found, of - found + 1))
    high = 1.0 if found == of else float(beta.ppf(1 - tail, found + 1, of - found))
    return low, high


def _check(found: int, of: int) -> None:
    if not 0 <= found <= of or of == 0:
        raise InputError("counts", expected="0 <= found <= of, of > 0", got=f"{found} of {of}", remedy="count again")
