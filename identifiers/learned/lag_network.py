"""What networks on lagged signals share: an affine part, a network for the rest, bands that widen beyond the data."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from harness.signals import FloatArray
from harness.specs import spec_from_dict
from identifiers.common.bands import Bands
from identifiers.common.lag_state import LagModel, Scaling
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

    def head(self, kind: str) -> dict[str, Any]:
        """Return the entries that the descriptions of all networks have."""
        return {
            **super().head(kind),
            "affine": self.affine.tolist(),
            "variance": self.variance.tolist(),
            "reach": None if self.reach is None else self.reach.to_dict(),
        }

    @classmethod
    def read(cls, content: dict[str, Any], **own: Any) -> Self:
        """Return the model of a description, with what only its class has."""
        reach = content.get("reach")
        return cls(
            spec=spec_from_dict(content["spec"]),
            lags=int(content["lags"]),
            scaling=Scaling.from_dict(content["scaling"]),
            affine=np.array(content["affine"], dtype=float),
            variance=np.array(content["variance"], dtype=float),
            reach=None if reach is None else Reach.from_dict(reach),
            bands=Bands.from_dict(content.get("bands")),
            notes=dict(content.get("notes", {})),
            **own,
        )
