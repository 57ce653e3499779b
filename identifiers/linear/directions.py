"""Directions of many outputs that have dynamics: what is white noise is left out, and the model expanded again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from harness.algebra import divisor, orthonormal
from harness.signals import Channel, FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel

LAGS = 2
"""Samples before and after in which a direction must show: whatever has dynamics is correlated over one or two."""
CHANCE = 1e-3  # Probability of keeping a direction of white noise.
CHECKED = 20_000  # Samples that are looked at: at so many a correlation of 0.03 is seen.
ROUNDING = 1e-10  # Singular values of the outputs below this share of the largest are rounding.
EQUATIONS = 3  # Equations for each regressor, below which correlations are chance and nothing is left out.


@dataclass(frozen=True, eq=False)
class Directions:
    """Kept directions ``z = W' y`` of the outputs, and the outputs from them: ``y = P' z + level`` and white noise."""

    weights: FloatArray
    """(ny, nz): W; z have unit variance and are not correlated with one another, nor with what is left out."""
    back: FloatArray  # (nz, ny): P, with ``P W = 1``
    level: FloatArray  # (ny,)

    def compressed(self, records: Sequence[Trajectory]) -> list[Trajectory]:
        """Return records whose outputs are the directions."""
        outputs = tuple(Channel(f"direction {i} of the outputs") for i in range(1, self.weights.shape[1] + 1))
        return [
            Trajectory(record.t, record.u, record.y @ self.weights, replace(record.spec, outputs=outputs))
            for record in records
        ]

    def expanded(self, model: LinearModel, like: Trajectory) -> LinearModel:
        """Return the model of all outputs from that of the directions.

        What was left out is orthogonal to past, present and future of what was kept, so the filter of the directions
        is the filter of all outputs.
        """
        return replace(
            model,
            spec=like.spec,
            c_matrix=self.back.T @ model.c_matrix,
            d_matrix=self.back.T @ model.d_matrix,
            filter_gain=model.filter_gain @ self.weights.T,
            output_offset=self.level + self.back.T @ model.output_offset,
            spread=None
            if model.spread is None
            else replace(model.spread, c=self.back.T @ model.spread.c, d=self.back.T @ model.spread.d),
        )


def lively_directions(records: Sequence[Trajectory]) -> Directions | None:
    """Return the directions of the outputs that have dynamics; None where all have, or too few samples tell.

    Canonical correlations of the outputs with inputs and outputs of the samples before and after; those that chance
    explains (Bartlett 1947, Suppl. J. R. Stat. Soc. 9:176) are of white noise that neither the past foretells nor the
    future follows. A regression on many outputs that are nearly the same signals has such noise, magnified, in its
    regressors. Units do not matter.

    Examples
    --------
    >>> from harness.signals import PlantSpec
    >>> rng = np.random.default_rng(0)
    >>> u, x = rng.normal(size=(500, 1)), np.zeros((500, 1))
    >>> for k in range(499):
    ...     x[k + 1] = 0.5 * x[k] + u[k]
    >>> y = x @ [[1.0, 2.0, -1.0]] + 0.01 * rng.normal(size=(500, 3))
    >>> spec = PlantSpec((Channel("u"),), tuple(map(Channel, "abc")), 1.0)
    >>> lively_directions([Trajectory(np.arange(500.0), u, y, spec)]).weights.shape
    (3, 1)
    """
    from scipy.stats import chi2

    spec = records[0].spec
    if spec.ny < 2:
        return None
    now, around = _rows(records)
    level = now.mean(axis=0)
    now, around = now - level, around - around.mean(axis=0)
    n, q = around.shape
    if n < EQUATIONS * q:
        return None
    size = divisor(np.sqrt(np.mean(now**2, axis=0)))
    left, values, right = np.linalg.svd(now / size, full_matrices=False)
    rank = int(np.sum(values > ROUNDING * values[0]))
    basis = orthonormal(around, ROUNDING)
    inner, shares, _ = np.linalg.svd(left[:, :rank].T @ basis, full_matrices=False)
    # 1 - rho^2 of exact data is rounding, whose logarithm would be lost
    remaining = np.log(np.clip(1.0 - shares**2, 1e-15, 1.0))
    kept = 0
    while kept < shares.size:
        freedom = (rank - kept) * (basis.shape[1] - kept)
        statistic = -(n - 1 - (rank + basis.shape[1] + 1) / 2) * float(remaining[kept:].sum())
        if chi2.sf(statistic, freedom) > CHANCE:
            break
        kept += 1
    if kept in (0, spec.ny):
        return None
    weights = (right[:rank].T / values[:rank]) @ inner[:, :kept] * np.sqrt(n) / size[:, None]
    seen = now @ weights
    back = seen.T @ now / n
    return Directions(weights, back, level - (level @ weights) @ back)


def lively_channels(records: Sequence[Trajectory]) -> npt.NDArray[np.bool_]:
    """Return which outputs have dynamics (ny,): the others are white noise that nothing foretells or follows.

    The multiple correlation of each output with inputs and outputs of the samples before and after, as of
    :func:`lively_directions`. All count where too few samples tell, or none would be left.

    Examples
    --------
    >>> from harness.signals import PlantSpec
    >>> rng = np.random.default_rng(0)
    >>> y = np.column_stack([np.cumsum(rng.normal(size=500)), rng.normal(size=500)])
    >>> spec = PlantSpec((), (Channel("a"), Channel("b")), 1.0)
    >>> lively_channels([Trajectory(np.arange(500.0), np.zeros((500, 0)), y, spec)]).tolist()
    [True, False]
    """
    from scipy.stats import chi2

    now, around = _rows(records)
    n, q = around.shape
    if n < EQUATIONS * q:
        return np.ones(now.shape[1], dtype=bool)
    now, basis = now - now.mean(axis=0), orthonormal(around - around.mean(axis=0), ROUNDING)
    power = np.sum(now**2, axis=0)
    told = np.sum((basis.T @ now) ** 2, axis=0) / divisor(power)
    statistic = -(n - 2 - basis.shape[1] / 2) * np.log(np.clip(1.0 - told, 1e-15, 1.0))
    lively = np.asarray(chi2.sf(statistic, basis.shape[1]) <= CHANCE, dtype=bool)
    return lively if lively.any() else np.ones_like(lively)


def _rows(records: Sequence[Trajectory]) -> tuple[FloatArray, FloatArray]:
    """Return outputs, and inputs and outputs of the samples around them, none across a seam."""
    now, around, left = [], [], CHECKED
    for record in records:
        if min(len(record), left) <= 2 * LAGS:
            continue
        part = record[:left]
        count = len(part) - 2 * LAGS
        now.append(part.y[LAGS : LAGS + count])
        blocks = [part.u[shift : shift + count] for shift in range(2 * LAGS + 1)]
        blocks += [part.y[shift : shift + count] for shift in range(2 * LAGS + 1) if shift != LAGS]
        around.append(np.hstack(blocks))
        left -= len(part)
    if not now:
        spec = records[0].spec
        return np.zeros((1, spec.ny)), np.zeros((1, 1))
    return np.concatenate(now), np.concatenate(around)
