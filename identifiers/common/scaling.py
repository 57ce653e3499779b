"""Signals scaled to their own size, so that no decision of a fit depends on the units of a channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from harness.algebra import divisor, unit_columns
from harness.signals import FloatArray, Trajectory

# A column that moves by less than this fraction of its value counts as constant: what moves may be rounding.
_STILL = 1e-12
# An output is lively if a model foretells more than this share of its mean square on samples that it has not seen.
_FORETOLD = 0.02
# Noise is estimated from so many samples at most, from so many equations for each regressor at least.
_ROWS, _EQUATIONS = 20_000, 3
EXACT = 1e-9  # Errors below this share of an output's size are rounding.
# Outputs are not told apart by noise below this share of their size.
_QUIET = 1e-3


def sizes(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the size of each column (n,): its standard deviation, of a constant its value, of zeros 1.

    - ``parts`` sequence of array (N_i, n): records, taken together

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
    return divisor(size)


@dataclass(frozen=True, eq=False)
class Scaling:
    """Sizes of inputs (nu,) and outputs (ny,) that records were divided by."""

    inputs: FloatArray
    outputs: FloatArray


def scaled(records: Sequence[Trajectory]) -> tuple[list[Trajectory], Scaling]:
    """Return the records with every channel divided by its size, and the sizes.

    - ``records``: of one plant; they share the sizes
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
    return np.asarray(every.mean(axis=0)), divisor(std)


def noise_levels(records: Sequence[Trajectory]) -> FloatArray:
    """Return the noise of each output (ny,): what all outputs and inputs of the sample before do not foretell.

    Channels weighed by it count for what they tell: one that holds nothing but noise has all of its size as noise.
    Records too short for that regression leave its roughness, the fourth difference over ``sqrt(70)``, what white
    noise makes of it. Never below 1e-3 of the size.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng, k = np.random.default_rng(0), np.arange(2000.0)
    >>> y = np.column_stack([100.0 * np.sin(0.1 * k), 50.0 * np.cos(0.1 * k)]) + rng.normal(size=(2000, 2))
    >>> spec = PlantSpec((Channel("u"),), (Channel("s"), Channel("c")), 1.0)
    >>> (noise_levels([Trajectory(k, k[:, None], y, spec)]) < 2.5).all()
    np.True_
    """
    ny, nu = records[0].spec.ny, records[0].spec.nu
    size = sizes([record.y for record in records])
    before, after, left = [], [], _ROWS
    for record in records:
        part = record[: max(left, 0)]
        left -= len(part)
        if len(part) > 1:
            before.append(np.hstack([part.y[:-1] / size, part.u[:-1], np.ones((len(part) - 1, 1))]))
            after.append(part.y[1:] / size)
    if sum(map(len, after)) >= _EQUATIONS * (ny + nu + 1):
        known, target = np.concatenate(before), np.concatenate(after)
        known = unit_columns(known)
        residual = target - known @ np.linalg.lstsq(known, target, rcond=1e-10)[0]
        rms = np.sqrt(np.sum(residual**2, axis=0) / (len(target) - known.shape[1]))
    else:
        rough = [np.diff(record.y / size, 4, axis=0) for record in records if len(record) > 4]
        rms = np.sqrt(np.mean(np.concatenate(rough) ** 2, axis=0) / 70.0) if rough else np.ones(ny)
    return np.asarray(size * np.clip(rms, _QUIET, 1.0), dtype=np.float64)


def lively(errors: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which outputs (ny,) some candidate foretells better than chance; all where none is.

    The others hold noise alone: whatever they say of an order or a rank is chance.

    - ``errors`` (candidates, ny): mean square on samples held out, relative to that about the output's mean

    Examples
    --------
    >>> lively(np.array([[0.5, 1.01], [0.1, 1.02]])).tolist()
    [True, False]
    """
    found = errors.min(axis=0) < 1.0 - _FORETOLD
    return found if found.any() else np.ones(errors.shape[1], dtype=bool)


def together(errors: FloatArray, moves: npt.NDArray[np.bool_]) -> float:
    """Return the geometric mean of errors (ny,) over the outputs that move: each counts by its noise, not by its size.

    Examples
    --------
    >>> round(together(np.array([0.04, 0.01, 1.0]), np.array([True, True, False])), 3)
    0.02
    """
    return float(np.exp(np.mean(np.log(np.maximum(errors[moves], EXACT**2)))))
