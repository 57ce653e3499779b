"""Signals scaled to their own size, so that no decision of a fit depends on the units of a channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.signals import FloatArray, Trajectory

__all__ = ["Scaling", "centred", "scaled", "sizes"]

# A column that moves by less than this fraction of its value counts as constant: what moves may be rounding.
_STILL = 1e-12


def sizes(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the size of each column (n,): its standard deviation, of a constant its value, of zeros 1.

    Parameters
    ----------
    parts : sequence of array (N_i, n)
        Records, taken together.

    Examples
    --------
    >>> sizes([np.array([[1.0, 5.0, 0.0], [3.0, 5.0, 0.0]])]).tolist()
    [1.0, 5.0, 1.0]
    """
    rows = sum(len(part) for part in parts)
    mean = sum((part.sum(axis=0) for part in parts), np.zeros(parts[0].shape[1])) / rows
    spread = np.sqrt(sum((((part - mean) ** 2).sum(axis=0) for part in parts), np.zeros(mean.size)) / rows)
    still = spread <= _STILL * np.abs(mean)
    size: FloatArray = np.where(still, np.abs(mean), spread)
    return np.where(size > 0, size, 1.0)


@dataclass(frozen=True, eq=False)
class Scaling:
    """Sizes of inputs (nu,) and outputs (ny,) that records were divided by."""

    inputs: FloatArray
    outputs: FloatArray


def scaled(records: Sequence[Trajectory]) -> tuple[list[Trajectory], Scaling]:
    """Return the records with every channel divided by its size, and the sizes.

    Parameters
    ----------
    records : sequence of Trajectory
        Of one plant; they share the sizes.
    """
    found = Scaling(sizes([record.u for record in records]), sizes([record.y for record in records]))
    return [replace(record, u=record.u / found.inputs, y=record.y / found.outputs) for record in records], found


def centred(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (n,) of signals (N_i, n) over all records; 1 where a signal never moves.

    Examples
    --------
    >>> mean, std = centred([np.array([[0.0, 3.0]]), np.array([[2.0, 3.0]])])
    >>> mean.tolist(), std.tolist()
    ([1.0, 3.0], [1.0, 1.0])
    """
    every = np.concatenate(parts)
    std = every.std(axis=0)
    return np.asarray(every.mean(axis=0)), np.where(std > 0, std, 1.0)
