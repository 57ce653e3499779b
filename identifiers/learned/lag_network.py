"""What networks on lagged signals share: an affine part, a network for the rest, bands that widen beyond the data."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray
from identifiers.common.lag_state import LagModel
from identifiers.common.reach import Reach

__all__ = ["LagNetwork"]


@dataclass(frozen=True, eq=False)
class LagNetwork(LagModel):
    """The change of the output is an affine function of lagged outputs and inputs plus a network of them; abstract.

    A subclass says :meth:`change`, ``kind`` and how its tables are stored.

    Parameters
    ----------
    affine : array (p + 1, ny)
        In scaled numbers.
    variance : array (ny,)
        Of the one-step error on held-out samples.
    reach : Reach or None
        Where the data lie, in scaled rows: beyond them the variance grows.
    """

    affine: FloatArray
    variance: FloatArray
    reach: Reach | None

    @abstractmethod
    def change(self, x: FloatArray) -> FloatArray:
        """Return the scaled addition (..., ny) of the network at scaled rows (..., p)."""

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        x = self.scaling.rows(rows)
        change = self.change(x) + x @ self.affine[:-1] + self.affine[-1]
        mean = rows[..., : self.spec.ny] + self.scaling.y_mean + change * self.scaling.y_std
        variance = np.broadcast_to(self.variance, mean.shape)
        return mean, variance if self.reach is None else variance + self.reach.std(x) ** 2
