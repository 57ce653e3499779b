"""What may be concluded from scores over seeds: who is no worse than the best, and average ranks with their error.

Every comparison is paired: the data of a seed are the same for all identifiers. Pairs are compared by the exact sign
test (Conover 1999, *Practical Nonparametric Statistics*, sec. 3.4), the comparisons of a group by Holm's procedure
(Holm 1979, *A simple sequentially rejective multiple test procedure*, Scandinavian Journal of Statistics 6). Ranks and
the critical difference follow Demsar 2006, *Statistical Comparisons of Classifiers over Multiple Data Sets*, JMLR 7,
sec. 3.2.2.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from harness.signals import FloatArray

LEVEL = 0.05  # Two-sided level of all comparisons.
MINIMUM_SEEDS = 5  # With fewer pairs nothing is marked, with fewer blocks nothing is ranked.
MARGIN = 2.0  # Ratio to the best that a tie has to exclude: what may be twice as bad is not tied, it is undecided.

Seed = TypeVar("Seed", bound=Hashable)


@dataclass(frozen=True)
class Standing:
    """How a name stands against the one with the least median."""

    state: Literal["best", "tied", "worse", "undecided"]
    """{"best", "tied", "worse", "undecided"}: ``tied``: there are enough pairs to tell a difference, none is told, and
    the interval of the median ratio excludes :data:`MARGIN`. ``undecided``: neither told apart nor tied."""
    chance: float  # Two-sided level at which it is told from the best, adjusted by Holm; 1 for the best
    ratio: tuple[float, float]
    """(float, float): Ends of the interval of the median ratio to the best, from the order statistics of the pairs, 95
    % or more; 0 and infinity where there are too few pairs for one."""
    pairs: int  # Pairs compared
    others: int  # Names that the group compares with its best

    @property
    def marked(self) -> bool:
        """True for the best and for those that tie with it, from five pairs on."""
        return self.pairs >= MINIMUM_SEEDS and self.state in ("best", "tied")


def enough_pairs(others: int) -> int:
    """Return the number of pairs from which a difference can be told at all, after Holm's correction.

    Of n pairs that all have one sign the two-sided level is 2^(1-n); of ``others`` comparisons the first has to be
    below 0.05 / others.

    Examples
    --------
    >>> enough_pairs(1), enough_pairs(3), enough_pairs(9)
    (6, 7, 9)
    """
    n = 1
    while others * 2.0 ** (1 - n) > LEVEL:
        n += 1
    return n


def standings(scores: Mapping[str, Sequence[float | None]]) -> dict[str, Standing]:
    """Return the standing of each name against the one with the least median: best, tied, worse or undecided.

    - ``scores``: name to one score for each replicate, in the same order for all, above 0; None where there is none (it
      counts as infinite)
    - returns nothing where nobody has a finite median

    Examples
    --------
    >>> good = [1.0, 2.0, 3.0, 1.5, 2.5, 4.0, 1.2, 2.2]
    >>> bad, alike = [2.0 * score for score in good], [*(1.01 * score for score in good[:-1]), 2.19]
    >>> found = standings({"good": good, "bad": bad, "alike": alike})
    >>> {name: (one.state, round(one.chance, 3)) for name, one in found.items()}
    {'good': ('best', 1.0), 'bad': ('worse', 0.016), 'alike': ('tied', 0.07)}
    """
    table = {name: np.array([np.inf if s is None else s for s in values]) for name, values in scores.items()}
    table = {name: values for name, values in table.items() if values.size and np.isfinite(np.median(values))}
    if not table:
        return {}
    leader = min(table, key=lambda name: (float(np.median(table[name])), name))
    best = table[leader]
    others = [name for name in table if name != leader]
    chances = _holm({name: _sign_test(table[name], best) for name in others})
    able = best.size >= enough_pairs(max(1, len(others)))
    found = {leader: Standing("best", 1.0, (1.0, 1.0), best.size, len(others))}
    for name in others:
        ratio = _median_ratio(table[name], best)
        told = chances[name] < LEVEL
        state: Literal["tied", "worse", "undecided"] = "worse" if told else "undecided"
        if not told and able and ratio[1] < MARGIN:
            state = "tied"
        found[name] = Standing(state, chances[name], ratio, best.size, len(others))
    return found


def replicates(scores: Mapping[str, Mapping[Seed, float | None]]) -> dict[str, list[float | None]]:
    """Return the scores over replicates: seeds between which something differs.

    The same record under six seeds is one record. Seeds are one replicate where the larger part of the identifiers that
    have a score in both has the same to the last bit, which different data do not give; what is left is the random
    numbers of an identifier, of which the median counts.

    - ``scores``: name to score by seed, the same seeds in each; None is a failure

    Examples
    --------
    >>> replicates({"arx": {0: 0.3, 1: 0.3, 2: 0.3}, "net": {0: 0.1, 1: 0.2, 2: 0.4}, "dmdc": {0: 0.5, 1: 0.5, 2: 0.5}})
    {'arx': [0.3], 'net': [0.2], 'dmdc': [0.5]}
    """
    seeds = list(next(iter(scores.values()), {}))
    groups: list[list[Seed]] = []
    for seed in seeds:
        same = next((group for group in groups if _same_data(scores, group[0], seed)), None)
        if same is None:
            groups.append([seed])
        else:
            same.append(seed)
    return {name: [_middle([own[seed] for seed in group]) for group in groups] for name, own in scores.items()}


def _same_data(scores: Mapping[str, Mapping[Seed, float | None]], one: Seed, other: Seed) -> bool:
    """Return True if the larger part of the identifiers scores the same, and not 0, under two seeds."""
    pairs = [(own[one], own[other]) for own in scores.values()]
    known = [(a, b) for a, b in pairs if a is not None and b is not None and a != 0.0]
    return bool(known) and 2 * sum(a == b for a, b in known) > len(known)


def _middle(values: Sequence[float | None]) -> float | None:
    """Return the median, failures counting as infinite."""
    found = float(np.median([np.inf if value is None else value for value in values]))
    return found if np.isfinite(found) else None


def _sign_test(values: FloatArray, best: FloatArray) -> float:
    """Return the two-sided level of the sign test of values and their pairs; those without a difference drop."""
    from scipy.stats import binomtest

    above, below = int(np.sum(values > best)), int(np.sum(values < best))
    return 1.0 if above + below == 0 else float(binomtest(above, above + below, 0.5).pvalue)


def _holm(chances: Mapping[str, float]) -> dict[str, float]:
    """Return levels adjusted for their number, none below that of a smaller one."""
    found: dict[str, float] = {}
    last = 0.0
    for rank, (name, chance) in enumerate(sorted(chances.items(), key=lambda item: item[1])):
        last = max(last, min(1.0, (len(chances) - rank) * chance))
        found[name] = last
    return found


def _median_ratio(values: FloatArray, best: FloatArray) -> tuple[float, float]:
    """Return the ends of the interval of the median ratio (Conover 1999, sec. 3.2): order statistics, 95 % or more."""
    from scipy.stats import binom

    n = values.size
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.where(values == best, 1.0, values / best)  # both failed: no difference
    low = int(binom.ppf(LEVEL / 2, n, 0.5))
    if 2.0 * float(binom.cdf(low - 1, n, 0.5)) > LEVEL or low == 0:
        return 0.0, float("inf")
    ratios = np.sort(ratios)
    return float(ratios[low - 1]), float(ratios[n - low])


@dataclass(frozen=True)
class Ranking:
    """Average ranks of identifiers over blocks (1 is best)."""

    names: tuple[str, ...]  # From the best to the worst
    ranks: tuple[float, ...]  # Average ranks
    blocks: int  # Plant x scenario x seed over which they are averaged
    critical: float  # Difference of average ranks beyond which two differ (Nemenyi, 5 %)
    places: tuple[str, ...] = ()  # Plant x scenario that the blocks come from

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

    - ``blocks``: name to score, the same names in each; None (a failure) ranks last, ties share their ranks
    - ``places``: where they come from, for a caption

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
