"""Least squares on the rows of a lumped model, what the rows do not determine left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import FitError
from harness.physics.lumps.identifiability import Identifiability, identifiability
from harness.signals import FloatArray

__all__ = ["LumpedFit", "least_squares"]


@dataclass(frozen=True, eq=False)
class LumpedFit:
    """Lumped parameters from least squares.

    Attributes
    ----------
    values : dict
        By name. A combination that the data do not determine has the value it takes when those left out are 0.
    covariance : array (k, k)
        Of all, from the residual; rows of those left out are 0.
    identifiability : Identifiability
        Rank, kept and dependent combinations.
    rms : float
        Of the residual, in the unit of the rows.
    """

    values: dict[str, float]
    covariance: FloatArray
    identifiability: Identifiability
    rms: float


def least_squares(
    rows: FloatArray,
    target: FloatArray,
    names: Sequence[str],
    model: str,
    *,
    weights: FloatArray | None = None,
    tolerance: float = 1e-8,
) -> LumpedFit:
    """Return the lumped parameters; see :meth:`harness.physics.LumpedModel.solve`."""
    if weights is not None:
        rows, target = rows * weights[:, None], target * weights
    if not (np.isfinite(rows).all() and np.isfinite(target).all()):
        raise FitError(
            "regression", expected="finite numbers", got="NaN or infinity", remedy="cut the record before it breaks"
        )
    found = identifiability(rows, names, tolerance=tolerance)
    if found.rank == 0:
        raise FitError(
            f"lumped parameters of {model}",
            expected="a motion that shows at least one",
            got="rows that are all zero",
            remedy="excite the plant",
        )
    kept = list(found.kept)
    part = rows[:, kept]
    size = np.linalg.norm(part, axis=0)
    solution, *_ = np.linalg.lstsq(part / size, target, rcond=None)
    residual = target - part / size @ solution
    freedom = max(len(target) - len(kept), 1)
    _, r = np.linalg.qr(part / size)
    inverse = np.linalg.inv(r) / size[:, None]
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(kept, kept)] = inverse @ inverse.T * float(residual @ residual) / freedom
    values = np.zeros(len(names))
    values[kept] = solution / size
    rms = float(np.sqrt(np.mean(residual**2)))
    return LumpedFit(dict(zip(names, values.tolist(), strict=True)), covariance, found, rms)
