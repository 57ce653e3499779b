"""Records of one use that do not follow one model: another load, another gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import f as f_distribution

from harness.data.oddities.foretold import foretold
from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray, Oddity, Run

_WHITE = 0.2  # Correlation of neighbouring errors up to which a linear prediction is as good as the noise lets it be.


def mismatched(runs: Sequence[Run]) -> list[Oddity]:
    """Return for each use the runs that its first one does not foretell, though each follows a linear model of its own.

    The test of Chow 1960 (Econometrica 28:591) of one model against two. Where a linear model leaves errors that are
    no noise, the plant is not linear, and other amplitudes look like another plant: nothing is said then.
    """
    found = []
    for use in ("estimation", "validation", "test"):
        numbers = [k for k, run in enumerate(runs) if run.use == use and len(run.trajectory) >= 2 * ODD.fewest]
        for number in numbers[1:]:
            first, other = runs[numbers[0]].trajectory, runs[number].trajectory
            for column, channel in enumerate(first.spec.outputs):
                y = (first.y[:, column], other.y[:, column])
                factor = _worse(y, (first.u, other.u)) if all(np.ptp(part) > 0 for part in y) else 1.0
                if factor > ODD.worse:
                    words = (
                        f"{channel.name} does not move as in run {numbers[0]}: one linear model for both errs "
                        f"{factor:.3g} times as much as one for each: another load, gain or operating point?"
                    )
                    found.append(Oddity("mismatch", number, channel.name, (), words))
                    break
    return found


def _worse(y: tuple[FloatArray, FloatArray], u: tuple[FloatArray, FloatArray]) -> float:
    """Return by what factor one linear model for two records errs more than two; 1 where that may be chance."""
    alone = [foretold(part, inputs) for part, inputs in zip(y, u, strict=True)]
    n = len(alone[0].own)
    gap = np.ones(sum(map(len, y)), dtype=bool)
    gap[: len(y[0])] = gap[len(y[0]) + n :] = False  # nothing is foretold across the seam
    level = np.concatenate([part - part.mean() for part in y])
    inputs = np.concatenate([part - part.mean(axis=0) for part in u])
    both = foretold(level, inputs, gap)
    errors = [one.error[n:] for one in alone]
    if any(abs(np.corrcoef(part[1:], part[:-1])[0, 1]) > _WHITE for part in errors):
        return 1.0
    together = [both.error[n : len(y[0])], both.error[len(y[0]) + n :]]
    apart, joint = (sum(float(part @ part) for part in parts) for parts in (errors, together))
    used = n + (n + 1) * u[0].shape[1]
    free = sum(map(len, errors)) - 2 * used
    if free <= 0 or apart <= 0:
        return 1.0
    statistic = (joint - apart) / used / (apart / free)
    factor = float(np.sqrt(joint / apart))
    return factor if f_distribution.sf(statistic, used, free) < ODD.mismatch else 1.0
