"""Distributions that models predict: categories, and normal distributions or equal mixtures of them.

Shapes: leading axes ``(...)`` as in the model's state, then one column for each output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import Channel, FloatArray, residual

_SUM = 1e-6
"""How far the probabilities of an output may be from a sum of 1: rounding of long products, not an error of a model."""

_BISECTIONS = 60  # Halvings of a bracket for a quantile: to the last digits of a float64.


@dataclass(frozen=True, eq=False)
class Categories:
    """Probabilities of the categories of each output.

    Raises InputError if a table has negative entries or does not sum to 1.

    Examples
    --------
    >>> coin = Categories((np.array([0.25, 0.75]),))
    >>> coin.log_score(np.array([1.0])).round(4).tolist()
    [-0.2877]
    >>> coin.covered(np.array([1.0]), 0.6).round(2).tolist()  # the set of 60 % holds a part of category 1 only
    [0.8]
    """

    tables: tuple[FloatArray, ...]  # tuple of array (..., K_i): One for each output; the last axis sums to 1

    def __post_init__(self) -> None:
        for number, table in enumerate(self.tables):
            sums = np.sum(table, axis=-1)
            if np.size(table) and not (np.min(table) >= -_SUM and np.max(np.abs(sums - 1.0)) <= _SUM):
                raise InputError(
                    f"predicted probabilities of output {number}",
                    expected="numbers >= 0 with the sum 1",
                    got=f"least {float(np.min(table)):.3g}, sums from {float(np.min(sums)):.6g}",
                    remedy="normalise what the model predicts",
                )

    def log_score(self, y: FloatArray) -> FloatArray:
        """Return the log probability of y (..., ny); -inf for what was called impossible."""
        with np.errstate(divide="ignore"):
            return np.stack([np.log(np.maximum(chosen, 0.0)) for chosen in self._chosen(y)], axis=-1)

    def covered(self, y: FloatArray, level: float) -> FloatArray:
        """Return the share of y's category in the set of the most probable ones that holds exactly ``level``.

        The last category of the set belongs to it in part only (a randomised set), so that the mean over well
        calibrated predictions is ``level`` whatever the probabilities are.
        """
        parts = []
        for table, chosen in zip(self.tables, self._chosen(y), strict=True):
            before = np.sum(np.where(table > chosen[..., None], table, 0.0), axis=-1)
            equal = np.sum(np.where(table == chosen[..., None], table, 0.0), axis=-1)
            with np.errstate(divide="ignore", invalid="ignore"):
                part = np.where(equal > 0, (level - before) / equal, 0.0)
            parts.append(np.clip(part, 0.0, 1.0))
        return np.stack(parts, axis=-1)

    def _chosen(self, y: FloatArray) -> list[FloatArray]:
        """Return the probabilities (...) of the categories that happened, output by output."""
        result = []
        for column, table in enumerate(self.tables):
            index = np.asarray(y)[..., column].astype(np.intp)
            table = np.broadcast_to(table, (*index.shape, table.shape[-1]))
            result.append(np.take_along_axis(table, index[..., None], axis=-1)[..., 0])
        return result


@dataclass(frozen=True, eq=False)
class NormalMixture:
    """Equal mixture of M normal distributions for each output; the outputs are judged one by one.

    Examples
    --------
    >>> y = normal(np.array([1.0]), np.array([2.0]), [Channel("y")])
    >>> y.log_score(np.array([1.0])).round(4).tolist(), [float(v[0].round(3)) for v in y.interval(0.9)]
    ([-1.6121], [-2.29, 4.29])
    """

    # (..., M, ny): In the units of the outputs; standard deviations > 0
    means: FloatArray
    stds: FloatArray
    outputs: Sequence[Channel]  # Periodic ones are wrapped

    def __post_init__(self) -> None:
        if np.size(self.stds) and not np.nanmin(self.stds) > 0:
            raise InputError(
                "predicted standard deviation",
                expected="more than 0",
                got=f"{float(np.nanmin(self.stds)):.3g}",
                remedy="give the model a noise floor",
            )

    @property
    def mean(self) -> FloatArray:
        """Mean of the mixture (..., ny)."""
        return np.asarray(self.means.mean(axis=-2))

    @property
    def std(self) -> FloatArray:
        """Standard deviation of the mixture (..., ny)."""
        return np.asarray(np.sqrt((self.stds**2).mean(axis=-2) + self.means.var(axis=-2)))

    def log_score(self, y: FloatArray) -> FloatArray:
        """Return the log density of y (..., ny), in nats for the unit of the output."""
        z = self._scaled(y)
        each = -0.5 * z**2 - np.log(self.stds) - 0.5 * np.log(2 * np.pi)
        top = each.max(axis=-2, keepdims=True)
        return np.asarray(top[..., 0, :] + np.log(np.mean(np.exp(each - top), axis=-2)))

    def covered(self, y: FloatArray, level: float) -> FloatArray:
        """Return 1 where y lies in the central interval of this probability, else 0 (..., ny)."""
        from scipy.special import ndtr

        below = ndtr(self._scaled(y)).mean(axis=-2)
        return np.asarray((np.abs(below - 0.5) <= 0.5 * level).astype(float))

    def interval(self, level: float) -> tuple[FloatArray, FloatArray]:
        """Return the ends (..., ny) of the central interval of this probability, found by bisection."""
        return self._quantile(0.5 - 0.5 * level), self._quantile(0.5 + 0.5 * level)

    def _scaled(self, y: FloatArray) -> FloatArray:
        """Return (y - mean) / std of every member (..., M, ny)."""
        return residual(self.outputs, np.asarray(y, dtype=float)[..., None, :], self.means) / self.stds

    def _quantile(self, probability: float) -> FloatArray:
        from scipy.special import ndtr, ndtri

        far = self.means + ndtri(probability) * self.stds
        low, high = far.min(axis=-2), far.max(axis=-2)
        for _ in range(_BISECTIONS if self.means.shape[-2] > 1 else 0):
            middle = 0.5 * (low + high)
            above = ndtr((middle[..., None, :] - self.means) / self.stds).mean(axis=-2) > probability
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return np.asarray(0.5 * (low + high))


def normal(mean: FloatArray, std: FloatArray, outputs: Sequence[Channel]) -> NormalMixture:
    """Return the normal distribution of mean and standard deviation (..., ny)."""
    mean = np.asarray(mean, dtype=float)
    return NormalMixture(mean[..., None, :], np.broadcast_to(std, mean.shape)[..., None, :], outputs)
