"""Intervals of free runs: their errors are coloured, as what a model lacks lasts longer than a sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.search.coloured import LONGEST, Before, fitted_error
from harness.diagnosis.search.fit import Fit
from harness.physics.compiled.kalman_pass import Filtered
from harness.signals import FloatArray


def robust_covariance(
    errors: Sequence[FloatArray], jacobians: Sequence[FloatArray], order: int, floor: FloatArray
) -> FloatArray:
    """Return the covariance of what was fitted by least squares to free runs whose errors are coloured.

    ``(J' J)^-1 J' C J (J' J)^-1``, J over the deviations as the fit weighed them, C the correlation of the errors of an
    output, from an autoregression fitted to them (White 1982, Econometrica 50:1, theorem 3.2). Errors of a free run
    move many samples together; taken as independent they would count many times.

    - ``errors`` sequence of array (K, ny): by record; NaN where a reading is missing, which then counts nowhere
    - ``jacobians`` sequence of array (K, ny, p): their derivatives
    - ``order``: coefficients of the autoregression
    - ``floor`` (ny,): smallest deviations
    - returns array (p, p)

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> e = np.zeros((4000, 1))
    >>> for k in range(1, 4000):
    ...     e[k] = 0.9 * e[k - 1] + rng.standard_normal()
    >>> mean = robust_covariance([e], [np.ones((4000, 1, 1))], 1, np.array([1e-9]))
    >>> bool(abs(np.sqrt(mean[0, 0]) / (1.0 / 0.1 / np.sqrt(4000)) - 1.0) < 0.1)
    True
    """
    from scipy.signal import fftconvolve

    size = jacobians[0].shape[2]
    bread, meat = np.zeros((size, size)), np.zeros((size, size))
    for k, least in enumerate(floor):
        told = [np.isfinite(record[:, k]) for record in errors]
        before = [Before.of(rows.astype(float), order) for rows in told]
        error = fitted_error([np.nan_to_num(record[:, k]) for record in errors], before, order, float(least))
        for j, rows in zip(jacobians, told, strict=True):
            column = np.where(rows[:, None], j[:, k], 0.0) / error.deviation
            most = min(len(j) - 1, LONGEST)
            rho = error.correlation(most)
            spread = fftconvolve(column, np.concatenate([rho[:0:-1], rho])[:, None], axes=0)
            bread += column.T @ column
            meat += column.T @ spread[most : most + len(column)]
    scale = np.sqrt(np.maximum(np.diag(bread), 1e-300))
    inverse = np.linalg.pinv(bread / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    return np.asarray(inverse @ (0.5 * (meat + meat.T)) @ inverse)


def coloured_deviations(fit: Fit, paths: Sequence[Filtered], order: int, floor: FloatArray) -> Fit:
    """Return a fit with deviations for a coloured error of its free runs.

    - ``paths``: its free runs along the estimation records, with derivatives by what is free and by initial states
    - ``order``: coefficients of the autoregression
    - ``floor`` (ny,): smallest deviations
    """
    count = len(fit.free)
    own = paths[0].j.shape[2] - count if paths[0].j is not None else 0
    wide = []
    for number, passed in enumerate(paths):
        j = np.zeros((*passed.e.shape, count + own * len(paths)))
        assert passed.j is not None
        j[..., :count] = passed.j[..., :count]
        j[..., count + number * own : count + (number + 1) * own] = passed.j[..., count:]
        wide.append(j)
    keep = [k for k in range(wide[0].shape[2]) if k >= count or fit.deviations[fit.free[k]] > 0]
    parts = [part[..., keep] for part in wide]
    covariance = robust_covariance([passed.e for passed in paths], parts, order, floor)
    deviations = dict(fit.deviations)
    for k, column in enumerate(keep):
        if column < count and np.isfinite(fit.deviations[fit.free[column]]):
            name = fit.free[column]
            size = abs(fit.values[name]) if name in fit.logarithmic else 1.0
            deviations[name] = float(np.sqrt(max(covariance[k, k], 0.0)) / max(size, 1e-300))
    return replace(fit, deviations=deviations)
