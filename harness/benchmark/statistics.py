"""What may be concluded from scores over seeds: who is no worse than the best, and average ranks with their error.

Every comparison is paired: the data of a seed are the same for all identifiers, so seeds are drawn anew as a whole
(Efron & Tibshirani 1993, *An Introduction to the Bootstrap*, ch. 8). Ranks and the critical difference follow Demsar
2006, *Statistical Comparisons of Classifiers over Multiple Data Sets*, JMLR 7, sec. 3.2.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

__all__ = ["MINIMUM_SEEDS", "Ranking", "no_worse", "ranking"]

LEVEL = 0.05
"""Two-sided level of all comparisons."""
MINIMUM_SEEDS = 5
"""Fewer pairs cannot reach the level: with n pairs all of one sign, the least two-sided level of a sign test is
2^(1-n), that is 1/16 for 5; below that nothing is decided and no line is marked."""


def no_worse(scores: Mapping[str, Sequence[float | None]]) -> set[str]:
    """Return the names whose scores the paired bootstrap cannot tell from the least median, the leader among them.

    Parameters
    ----------
    scores : mapping
        Name to one score for each seed, in the same order for all; None where there is none (it counts as infinite).

    Returns
    -------
    set of str
        Empty with fewer than five seeds, or where nobody has a median.

    Examples
    --------
    >>> good, bad, alike = [1.0, 2.0, 3.0, 1.5, 2.5], [2.0, 4.0, 6.0, 3.0, 5.0], [1.1, 1.9, 3.1, 1.4, 2.6]
    >>> sorted(no_worse({"good": good, "bad": bad, "alike": alike}))
    ['alike', 'good']
    """
    table = {name: np.array([np.inf if s is None else s for s in values]) for name, values in scores.items()}
    table = {name: values for name, values in table.items() if values.size and np.isfinite(np.median(values))}
    if not table or min(values.size for values in table.values()) < MINIMUM_SEEDS:
        return set()
    leader = min(table, key=lambda name: (float(np.median(table[name])), name))
    return {name for name, values in table.items() if name == leader or not _worse(values, table[leader])}


def _worse(values: FloatArray, best: FloatArray) -> bool:
    """Return True if the median of the paired differences is above 0 in nearly all draws of the seeds.

    For a median the bootstrap needs no drawing: of n seeds drawn anew from n, m of them no worse, the number that is
    no worse is binomial(n, m/n), and the (lower) median is at most 0 where that is at least half (Efron 1979,
    *Bootstrap methods: another look at the jackknife*, sec. 3).
    """
    from scipy.stats import binom

    n = values.size
    with np.errstate(invalid="ignore"):
        no_worse = int(np.sum(~(values - best > 0.0)))  # both failed: no difference
    chance = float(binom.sf(int(np.ceil(n / 2)) - 1, n, no_worse / n))
    return chance < LEVEL / 2


@dataclass(frozen=True)
class Ranking:
    """Average ranks of identifiers over blocks (1 is best).

    Parameters
    ----------
    names : tuple of str
        From the best to the worst.
    ranks : tuple of float
        Average ranks.
    blocks : int
        Plant x scenario x seed over which they are averaged.
    critical : float
        Difference of average ranks beyond which two differ (Nemenyi, 5 %).
    places : tuple of str
        Plant x scenario that the blocks come from.
    """

    names: tuple[str, ...]
    ranks: tuple[float, ...]
    blocks: int
    critical: float
    places: tuple[str, ...] = ()

    def groups(self) -> list[tuple[int, int]]:
        """Return the longest runs (first, last) of names that are not told apart; runs of one are left out."""
        found: list[tuple[int, int]] = []
        for first, low in enumerate(self.ranks):
            last = max(k for k, rank in enumerate(self.ranks) if rank - low <= self.critical)
            if last > first and (not found or last > found[-1][1]):
                found.append((first, last))
        return found


def ranking(blocks: Sequence[Mapping[str, float | None]], places: Sequence[str] = ()) -> Ranking | None:
    """Return average ranks and the critical difference, or None with fewer than two names or five blocks.

    Parameters
    ----------
    blocks : sequence of mapping
        Name to score, the same names in each; None (a failure) ranks last, ties share their ranks.
    places : sequence of str
        Where they come from, for a caption.

    Examples
    --------
    >>> found = ranking([{"a": 1.0, "b": 2.0, "c": None}] * 10)
    >>> found.names, found.ranks, round(found.critical, 3)
    (('a', 'b', 'c'), (1.0, 2.0, 3.0), 1.048)
    """
    names = sorted(blocks[0]) if blocks else []
    if len(names) < 2 or len(blocks) < MINIMUM_SEEDS:
        return None
    from scipy.stats import rankdata, studentized_range

    table = np.array([[np.inf if block[name] is None else block[name] for name in names] for block in blocks])
    means = rankdata(table, axis=1).mean(axis=0)
    k, n = len(names), len(blocks)
    q = float(studentized_range.ppf(1 - LEVEL, k, np.inf)) / np.sqrt(2)
    order = np.argsort(means, kind="stable")
    return Ranking(
        tuple(names[i] for i in order),
        tuple(float(means[i]) for i in order),
        n,
        float(q * np.sqrt(k * (k + 1) / (6 * n))),
        tuple(places),
    )
