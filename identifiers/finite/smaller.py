"""Smaller processes as analyses: which states are the same, and how few beliefs stand for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes, as_dataset
from harness.signals import FloatArray
from identifiers.finite.beliefs import compress_beliefs
from identifiers.finite.bisimulation import bisimulation, bisimulation_metric, information_gap, quotient
from identifiers.finite.hmm import HiddenMarkov

_SHOWN = 12
"""States of a class that are named in the table."""


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
    tolerance : float
        Probabilities and rewards that differ by less are equal: of a process that was counted from data a tolerance of
        the size of their errors.
    reward : sequence, optional
        Reward of each state, or of each state and action; needed where the process has none of its own.
    """

    takes: ClassVar[Takes] = "process"
    discount: float = 0.9
    tolerance: float = 1e-9
    reward: Sequence[Any] | None = None

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return the classes of states, with the largest distance to another class and within."""
        transition, reward = self._tables(subject)
        labels = bisimulation(transition, reward, tolerance=self.tolerance)
        small, earned = quotient(transition, reward, labels)
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
            f"{len(labels)} states in {len(small)} classes that no experiment tells apart within {self.tolerance:g}",
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


@dataclass(frozen=True)
class BeliefLadder:
    """How few typical beliefs stand for all that a hidden process visits, from records of what was seen.

    A hidden Markov model is fitted (``hidden-markov``), its beliefs along the records are written as mixtures of 1, 2,
    ... typical ones (:func:`identifiers.finite.beliefs.compress_beliefs`; after Roy, Gordon & Thrun 2005, *JAIR* 23).

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
        return Findings("belief compression", rows, (text,), {"enough": few, "basis": bases[few - 1]})
