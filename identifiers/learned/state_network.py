"""What models of networks with a state have in common: free runs, corrections, and how sure they are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from harness.models.distributions import NormalMixture, normal
from harness.signals import FloatArray, PlantSpec, residual
from identifiers.common.bands import Bands, told
from identifiers.common.described import Described
from identifiers.common.observers import run_in_steps


class StateNetwork(Described, ABC):
    """A model whose state begins with the network's own (nx), which the error of an output that was seen moves.

    What follows in the state counts the steps since then. Where signals are scaled, a subclass has ``u_mean``,
    ``u_std`` and ``y_std``.
    """

    spec: PlantSpec
    filter_gain: FloatArray
    burn_in: ClassVar[int] = 0  # No samples: the initial state is estimated.

    @abstractmethod
    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state moved by the error of the output (..., ny) just seen."""
        x, nx = np.asarray(x, dtype=float), len(self.filter_gain)
        predicted = self.output(x, u)
        miss = residual(self.spec.outputs, np.broadcast_to(y, predicted.shape), predicted)
        miss = miss / getattr(self, "y_std", 1.0)
        return np.concatenate([x[..., :nx] + miss @ self.filter_gain.T, 0.0 * x[..., nx:]], axis=-1)

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx or more) under inputs u (M, N, nu)."""
        model: Any = self
        return run_in_steps(model, x, u)

    def _input(self, u: FloatArray) -> FloatArray:
        """Return scaled inputs."""
        model: Any = self
        return np.asarray((np.asarray(u, dtype=float) - model.u_mean) / model.u_std)


class BandedNetwork(StateNetwork):
    """One whose bands widen with the steps since an output was seen, which the last entry of its state counts."""

    bands: Bands | None
    called: ClassVar[str]  # The identifier that fits it.

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., ny), as wide as held-out data asked for.

        Raises
        ------
        InputError
            If the model was stored without bands.
        """
        return normal(self.output(x, u), told(self.bands, self.called).at(np.asarray(x)[..., -1]), self.spec.outputs)
