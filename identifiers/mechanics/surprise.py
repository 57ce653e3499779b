"""How wrong a filter's predictions are, beside how wrong they say they are: sensor noise, and doubt that must grow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from harness.signals import Channel, FloatArray, residual

ROUGH = 20.0  # A third difference of white noise has twenty times its variance: 1 + 9 + 9 + 1.
KEPT = 0.95  # Share of the mean squared prediction error that is kept from one sample to the next.
CHANCE = 5.0
"""Standard deviations by which the mean squared error exceeds what it says before that is no chance any more."""
SETTLED, LONGEST = 50.0, 500.0  # Samples over which the misfit is averaged at first, and later.
PATIENCE = 200.0
"""Samples of widening after which half of what is still wrong is called noise: no parameters explain it."""


@dataclass(frozen=True, eq=False)
class Surprise:
    """Sensor noise of a record, and whether prediction errors are larger than a filter says.

    The noise is that of third differences of the outputs, whatever the model predicts: a model that starts far from the
    truth must not take its own errors for noise of the sensors. Prediction errors beyond it are the parameters' at
    first, and widen the covariance (fading factor of the strong tracking filter, Zhou & Frank 1996, Int. J. Systems
    Sci. 27:333); what stays wrong in spite of that becomes noise.
    """

    recent: FloatArray  # (4, ny): Last outputs of the record, newest last; NaN before it began
    rough: FloatArray  # (2, ny): Sum of the squared third differences by ROUGH, and their number
    begin: FloatArray  # (ny,): Variance that is believed before the first third difference
    misfit: FloatArray
    """(ny,): Mean product of the prediction error and what a correction leaves of it, the noise if the model is right
    (Mehra 1970, IEEE Trans. Autom. Control 15:175).
    """
    error: float  # Recent mean squared prediction error in units of the noise
    seen: int  # Samples
    widened: int  # Samples at which the covariance was widened

    @classmethod
    def none(cls, ny: int) -> Self:
        """Return the state before any output."""
        nothing = np.full(ny, np.nan)
        return cls(np.full((4, ny), np.nan), np.zeros((2, ny)), nothing, nothing, np.nan, 0, 0)

    @property
    def noise(self) -> FloatArray:
        """Variance (ny,) of what no parameters explain."""
        rough, count = self.rough
        own = np.where(count > 0, rough / np.maximum(count, 1.0), self.begin)
        share = self.widened / (self.widened + PATIENCE)
        return np.maximum(np.maximum(own, share * self.misfit), 1e-30)

    def begun(self, y: FloatArray) -> Self:
        """Return the surprise at the first output (ny,) of a record."""
        recent = np.full_like(self.recent, np.nan)
        recent[-1] = y
        begin = np.where(np.isnan(self.begin), (1e-2 * np.maximum(np.abs(y), 0.1)) ** 2, self.begin)
        return replace(self, recent=recent, begin=begin, misfit=np.where(np.isnan(self.misfit), begin, self.misfit))

    def heard(self, channels: Sequence[Channel], y: FloatArray) -> Self:
        """Return the surprise with the roughness of one more output (ny,)."""
        recent = np.vstack([self.recent[1:], y])
        steps = [residual(channels, after, before) for before, after in pairwise(recent)]
        third = steps[2] - 2 * steps[1] + steps[0]
        if not np.isfinite(third).all():
            return replace(self, recent=recent)
        return replace(self, recent=recent, rough=self.rough + np.vstack([third**2 / ROUGH, np.ones_like(third)]))

    def factor(self, miss: FloatArray, spread: FloatArray) -> tuple[float, Self]:
        """Return by how much the covariance of the outputs (ny, ny) must grow to explain errors (ny,) of late."""
        noise, ny = self.noise, len(miss)
        now = float(np.sum(miss**2 / noise))
        error = now if np.isnan(self.error) else KEPT * self.error + (1 - KEPT) * now
        said = float(np.sum(np.diag(spread) / noise))
        chance = 1 + CHANCE * np.sqrt(2 * (1 - KEPT) / (1 + KEPT) / ny)
        factor = max(1.0, (error / chance - ny) / max(said, 1e-300))
        return factor, replace(self, error=error, widened=self.widened + (factor > 1.0))

    def learned(self, miss: FloatArray, left: FloatArray) -> Self:
        """Return the surprise after a correction left so much (ny,) of an error (ny,)."""
        share = 1.0 / min(self.seen + 1 + SETTLED, LONGEST)
        misfit = np.maximum((1 - share) * self.misfit + share * miss * left, 0.0)
        return replace(self, misfit=misfit, seen=self.seen + 1)
