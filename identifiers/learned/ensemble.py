"""Several models of one kind as one model, whose predicted distribution is the mixture of theirs."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from harness.models.distributions import NormalMixture
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.bands import drawn_together
from identifiers.common.described import Described

_NINETY = 1.6449  # Half width of the central 90 % of a normal distribution, in standard deviations.

_OWN = 0.3
"""Least share of the spread that is each member's own, and not their disagreement: outputs are noisy for all alike."""


def own_spread(misses: FloatArray, disagreement: FloatArray) -> FloatArray:
    """Return the standard deviation (ny,) of each member so that the mixture's 90 % bands hold 90 % of held-out data.

    What the members disagree by widens the mixture besides; it is the part that grows outside the data.

    - ``misses`` (n, ny): measured minus the mean of the members, held out
    - ``disagreement`` (n, ny): variance of the members' predictions there

    Examples
    --------
    >>> own_spread(np.random.default_rng(0).normal(size=(4000, 1)), np.zeros((4000, 1))).round(1).tolist()
    [1.0]
    """
    size = np.quantile(np.abs(misses), 0.9, axis=0) / _NINETY
    return np.asarray(np.sqrt(np.maximum(size**2 - disagreement.mean(axis=0), (_OWN * size) ** 2)))


@dataclass(frozen=True, eq=False)
class Ensemble(Described, ABC):
    """Several models of the same kind; the state is theirs side by side, so that each follows its own run.

    The output is their mean; the predicted distribution is the equal mixture of theirs (Lakshminarayanan, Pritzel and
    Blundell 2017, *NeurIPS*, sec. 2.4), wide where they disagree. A subclass names its ``kind`` and the class of its
    members.
    """

    spec: PlantSpec
    members: tuple[Any, ...]
    """With as many states each. ``band_factor(x)`` says by what held-out data scaled their deviations; where it is
    below 1 their disagreement shrinks by it too, as it was wider than the errors."""
    notes: dict[str, Any] = field(default_factory=dict)

    member: ClassVar[type[Any]]

    @property
    def burn_in(self) -> int:
        """Samples that the members need before their predictions count."""
        return int(self.members[0].burn_in)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the states of all members at the first sample, side by side (nx,)."""
        same_language(self.spec, data)
        return np.concatenate([member.initial_state(data) for member in self.members])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the mean of the members' outputs (..., ny)."""
        return np.asarray(np.mean([member.output(part, u) for member, part in self.parts(x)], axis=0))

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the equal mixture of the members' distributions (..., ny)."""
        each = [member.predictive(part, u) for member, part in self.parts(x)]
        means, stds = (
            np.concatenate([getattr(mixture, name) for mixture in each], axis=-2) for name in ("means", "stds")
        )
        factor = self.members[0].band_factor(self.parts(x)[0][1])
        return drawn_together(NormalMixture(means, stds, self.spec.outputs), factor)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx)."""
        return np.concatenate([member.step(part, u) for member, part in self.parts(x)], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states with the present output as it was measured (..., nx)."""
        return np.concatenate([member.correct(part, u, y) for member, part in self.parts(x)], axis=-1)

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        return np.asarray(np.mean([member.free_run(part, u) for member, part in self.parts(x)], axis=0))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """Return the model of a description."""
        return cls.read(content, members=tuple(map(cls.member.from_dict, content["members"])))

    def parts(self, x: FloatArray) -> list[tuple[Any, FloatArray]]:
        """Return every member with its part of states (..., nx)."""
        return list(zip(self.members, np.split(np.asarray(x, dtype=float), len(self.members), axis=-1), strict=True))
