"""Smaller processes as analyses: which states are the same, and how few beliefs stand for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes, as_dataset
from harness.signals import FloatArray
from identifiers.finite.bisimulation import (
    LEVEL,
    bisimulation,
    bisimulation_metric,
    counted_bisimulation,
    information_gap,
    quotient,
)
from identifiers.finite.decision import Labels, optimal_values, value_error_bound
from identifiers.finite.hmm import HiddenMarkov
from identifiers.finite.mdp import weissman_bound

_SETTLED = 1e-7  # Relative gain of the divergence in an iteration below which it ends.


@dataclass(frozen=True, eq=False)
class BeliefCompression:
    """Beliefs (N, S) as mixtures: ``weights @ basis``."""

    basis: FloatArray  # (K, S): Typical beliefs; each sums to 1
    weights: FloatArray  # (N, K): Each row sums to 1
    divergence: float  # Mean Kullback-Leibler divergence of the mixtures from the beliefs, in nats

    @property
    def beliefs(self) -> FloatArray:
        """The mixtures (N, S), themselves distributions."""
        return np.asarray(self.weights @ self.basis)


def compress_beliefs(
    beliefs: FloatArray, size: int, *, rng: np.random.Generator, iterations: int = 2000
) -> BeliefCompression:
    """Find the ``size`` typical beliefs whose mixtures are closest to the given ones.

    Beliefs that a process visits lie near a surface of few dimensions (Roy, Gordon and Thrun 2005, *JAIR* 23). Here the
    surface is flat and its points stay distributions: multiplicative updates of the Kullback-Leibler divergence (Lee
    and Seung 2001, *NIPS* 13, theorem 2), which keep the sums, started at visited beliefs that lie far apart.

    Parameters
    ----------
    beliefs : array (N, S)
        Each row sums to 1.
    size : int
        Number of typical beliefs, 1 to S.
    rng : numpy.random.Generator
        For the first of the starting beliefs.
    iterations : int
        At most.

    Raises
    ------
    InputError
        If the rows are no distributions or the size does not fit.

    Examples
    --------
    >>> corner = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.25, 0.25]])
    >>> compress_beliefs(corner, 2, rng=np.random.default_rng(0)).divergence < 1e-4
    True
    """
    b = np.asarray(beliefs, dtype=float)
    if b.ndim != 2 or (b < 0).any() or np.abs(b.sum(axis=1) - 1.0).max() > 1e-6:
        raise InputError(
            "beliefs", expected="rows (N, S) that sum to 1", got=f"shape {b.shape}", remedy="take HmmModel.beliefs"
        )
    if not 1 <= size <= b.shape[1]:
        raise InputError("size", expected=f"1 .. {b.shape[1]} (states)", got=str(size), remedy="correct it")
    chosen = [int(rng.integers(len(b)))]
    distance = np.abs(b - b[chosen[0]]).sum(axis=1)
    while len(chosen) < size:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.abs(b - b[chosen[-1]]).sum(axis=1))
    # Nothing starts at 0, which no multiplication leaves.
    basis = 0.99 * b[chosen] + 0.01 / b.shape[1]
    weights = np.full((len(b), size), 1.0 / size)
    last = np.inf
    for _ in range(iterations):
        weights = weights * ((b / np.maximum(weights @ basis, 1e-300)) @ basis.T)
        weights /= weights.sum(axis=1, keepdims=True)
        basis = basis * (weights.T @ (b / np.maximum(weights @ basis, 1e-300)))
        basis /= basis.sum(axis=1, keepdims=True)
        now = _divergence(b, weights @ basis)
        if last - now < _SETTLED * max(now, 1e-12):
            break
        last = now
    return BeliefCompression(basis, weights, _divergence(b, weights @ basis))


def _divergence(b: FloatArray, mixture: FloatArray) -> float:
    """Return the mean Kullback-Leibler divergence of the rows."""
    ratio = np.where(b > 0, b / np.maximum(mixture, 1e-300), 1.0)
    return float(np.maximum(np.sum(b * np.log(ratio), axis=1), 0.0).mean())


_SHOWN = 12  # States of a class that are named in the table.


@dataclass(frozen=True)
class Bisimulation:
    """States of a finite process that no experiment tells apart, and how different the others are.

    Exact bisimulation (Givan, Dean & Greig 2003, *Artificial Intelligence* 147, def. 4), the bisimulation metric
    (Ferns, Panangaden & Precup 2004, *UAI*, theorem 4.5), and what the classes lose as an approximate information
    state.

    Parameters
    ----------
    discount : float
        Of future rewards, below 1.
    tolerance : float, optional
        Probabilities and rewards that differ by less are equal. By default 1e-9; of a process that was counted from
        data states are equal unless a test of the counts tells them apart
        (:func:`identifiers.finite.bisimulation.counted_bisimulation`).
    reward : sequence, optional
        Reward of each state, or of each state and action; needed where the process has none of its own.
    """

    takes: ClassVar[Takes] = "process"
    discount: float = 0.9
    tolerance: float | None = None
    reward: Sequence[Any] | None = None

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the classes of states, with the largest distance to another class and within."""
        transition, reward = self._tables(subject)
        visits = getattr(subject, "visits", None) if self.tolerance is None else None
        if visits is None:
            tolerance = 1e-9 if self.tolerance is None else self.tolerance
            labels = bisimulation(transition, reward, tolerance=tolerance)
            small, earned = quotient(transition, reward, labels)
            told = f"no experiment tells apart within {tolerance:g}"
        else:
            labels, small, told = _counted(transition, visits, reward, self.discount)
            earned = quotient(transition, reward, labels)[1]
        distance = bisimulation_metric(small, earned, self.discount)
        gap = information_gap(transition, reward, labels, self.discount)
        rows = []
        for number in range(len(small)):
            members = np.flatnonzero(labels == number)
            others = np.delete(distance[number], number)
            named = ", ".join(map(str, members[:_SHOWN])) + (", ..." if len(members) > _SHOWN else "")
            rows.append(
                {
                    "class": number,
                    "states": named,
                    "size": len(members),
                    "distance to the nearest class": float(others.min()) if others.size else None,
                }
            )
        words = (
            f"{len(labels)} states in {len(small)} classes that {told}",
            f"values of the classes differ from those of the states by at most {gap.realised:.3g} (bound "
            f"{gap.bound:.3g}); their policy loses at most {gap.loss:.3g}",
        )
        details = {"labels": labels, "distance": distance, "transition": small, "reward": earned}
        return Findings("bisimulation", rows, words, details)

    def _tables(self, subject: Any) -> tuple[FloatArray, FloatArray]:
        """Return transition (S, A, S) and reward (S, A)."""
        transition = getattr(subject, "true_transition", getattr(subject, "transition", None))
        if transition is None or np.ndim(transition) != 3 or hasattr(subject, "emission"):
            raise InputError(
                "bisimulation",
                expected="a finite process whose states are seen: a plant such as corridors-mdp, or an mdp model",
                got=type(subject).__name__,
                remedy="count one from data (sysid identify --identifier mdp-counting -o model.json)",
            )
        table = np.asarray(transition, dtype=float)
        given = self.reward if self.reward is not None else getattr(subject, "true_reward", None)
        if given is None:
            raise InputError(
                "reward of a process",
                expected=f"{table.shape[0]} numbers, one a state, or a table of states and actions",
                got="none",
                remedy="give -O reward=[...]",
            )
        reward = np.asarray(given, dtype=float)
        if reward.ndim == 1:
            reward = np.repeat(reward[:, None], table.shape[1], axis=1)
        if reward.shape != table.shape[:2]:
            raise InputError(
                "reward of a process",
                expected=f"shape {table.shape[:2]} or ({table.shape[0]},)",
                got=str(reward.shape),
                remedy="give one number for each state, or for each state and action",
            )
        return table, reward


def _counted(
    transition: FloatArray, visits: FloatArray, reward: FloatArray, discount: float
) -> tuple[Labels, FloatArray, str]:
    """Return the classes of a counted process, its pooled transitions (B, A, B), and how surely they are known.

    Raises InputError if a pair of state and action was never tried.
    """
    if not visits.all():
        never = [(int(s), int(a)) for s, a in np.argwhere(visits == 0)]
        raise InputError(
            "bisimulation of a counted process",
            expected="every action tried in every state",
            got=f"{len(never)} of {visits.size} pairs never tried, such as {', '.join(map(str, never[:3]))}",
            remedy="record longer with actions at random, or give a tolerance to take the prior for their answer",
        )
    counts = transition * visits[:, :, None]
    labels = counted_bisimulation(counts, reward)
    member = np.eye(int(labels.max()) + 1)[labels]
    pooled = np.einsum("sb,sac,cd->bad", member, counts, member)
    tried = pooled.sum(axis=2)
    small = pooled / tried[:, :, None]
    radius = weissman_bound(tried, len(small))
    values, _ = optimal_values(small, quotient(transition, reward, labels)[1], discount)
    return (
        labels,
        small,
        f"{visits.sum():.0f} counted transitions tell apart (a class too many in {LEVEL:.0%} of records); states that "
        f"they do not tell apart count as one. Between classes every pair was tried at least {tried.min():.0f} times: "
        f"probabilities are off by at most {radius.max():.2g} (l1, 95 % each), values by at most "
        f"{value_error_bound(radius, values, discount):.2g}",
    )


@dataclass(frozen=True)
class BeliefLadder:
    """How few typical beliefs stand for all that a hidden process visits, from records of what was seen.

    A hidden Markov model is fitted (``hidden-markov``), its beliefs along the records are written as mixtures of 1, 2,
    ... typical ones (:func:`identifiers.finite.smaller.compress_beliefs`; after Roy, Gordon & Thrun 2005, *JAIR* 23).

    Parameters
    ----------
    states : int, optional
        Hidden states; by default chosen by the Bayesian information criterion.
    enough : float
        Mean Kullback-Leibler divergence [nats] below which mixtures count as the beliefs themselves.
    most : int
        Beliefs that are used, the first of the records.
    """

    takes: ClassVar[Takes] = "data"
    states: int | None = None
    enough: float = 0.01
    most: int = 2000

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the divergence of the mixtures by the number of typical beliefs."""
        records = [record.measured() for record in as_dataset(subject, "belief compression").estimation]
        model = HiddenMarkov(states=self.states).fit(records, rng=rng)
        seen = np.concatenate([model.beliefs(record) for record in records])[: self.most]
        rows, bases = [], []
        for size in range(1, seen.shape[1] + 1):
            found = compress_beliefs(seen, size, rng=rng)
            bases.append(found.basis)
            rows.append({"typical beliefs": size, "divergence [nats]": found.divergence})
        few = next((k for k, row in enumerate(rows, start=1) if row["divergence [nats]"] <= self.enough), len(rows))
        text = (
            f"{seen.shape[1]} hidden states; mixtures of {few} typical beliefs stand for {len(seen)} visited ones "
            f"within {self.enough:g} nats"
        )
        words = (text, model.notes["warning"]) if "warning" in model.notes else (text,)
        return Findings("belief compression", rows, words, {"enough": few, "basis": bases[few - 1]})
