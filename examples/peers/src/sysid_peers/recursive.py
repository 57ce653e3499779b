"""ARX coefficients as the state of a Kalman filter of filterpy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from harness.signals import FloatArray, Trajectory
from identifiers.linear.least_squares import LinearModel
from sysid_peers.records import NO_JUDGE, called, package, real_records

__all__ = ["FilterPy"]

PRIOR = 1e6
"""Variance of the coefficients before any data, for signals scaled to unit variance: as good as unknown."""


@dataclass(frozen=True)
class FilterPy:
    """ARX of one order by ``filterpy.kalman.KalmanFilter``, one filter for each output, its state the coefficients.

    Parameters
    ----------
    order : int
        Past outputs and inputs in the regression.
    """

    order: int = 2
    expected_failures: ClassVar[Mapping[str, str]] = NO_JUDGE

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model with the coefficients after the last sample of the last record."""
        kalman = package("filterpy.kalman", "filterpy")
        least = 4 * self.order * (trajectories[0].spec.ny + trajectories[0].spec.nu) if trajectories else 1
        records, spec = real_records(trajectories, max(least, 20), "filterpy")
        n, ny, nu = self.order, spec.ny, spec.nu
        y_scale = np.vstack([one.y for one in records]).std(axis=0)
        u_scale = np.vstack([one.u for one in records]).std(axis=0)
        y_scale, u_scale = np.where(y_scale > 0, y_scale, 1.0), np.where(u_scale > 0, u_scale, 1.0)
        width = n * (ny + nu)
        coefficients = np.empty((ny, width))
        with called("filterpy"):
            for output in range(ny):
                filter = kalman.KalmanFilter(dim_x=width, dim_z=1)
                filter.P *= PRIOR
                filter.Q *= 0.0
                filter.R *= 1e-4
                for one in records:
                    y, u = one.y / y_scale, one.u / u_scale
                    for k in range(n, len(one)):
                        past = [y[k - 1 - j] for j in range(n)] + [u[k - 1 - j] for j in range(n)]
                        filter.predict()
                        filter.update(np.array([[y[k, output]]]), H=np.concatenate(past)[None])
                coefficients[output] = np.asarray(filter.x).ravel()
        scales = np.concatenate([np.tile(y_scale, n), np.tile(u_scale, n)])
        return _companion(spec, coefficients * y_scale[:, None] / scales, n, ny, nu)


def _companion(spec: object, coefficients: FloatArray, n: int, ny: int, nu: int) -> LinearModel:
    """Return the model whose state is the last n outputs (newest first) and the n - 1 inputs before the present one."""
    size = n * ny + (n - 1) * nu
    a, b = np.zeros((size, size)), np.zeros((size, nu))
    inputs = coefficients[:, n * ny :]
    a[:ny, : n * ny] = coefficients[:, : n * ny]
    a[:ny, n * ny :] = inputs[:, nu:]
    b[:ny] = inputs[:, :nu]
    a[ny : n * ny, : (n - 1) * ny] = np.eye((n - 1) * ny)
    if n > 1:
        b[n * ny : n * ny + nu] = np.eye(nu)
        a[n * ny + nu :, n * ny : n * ny + (n - 2) * nu] = np.eye((n - 2) * nu)
    c = np.hstack([np.eye(ny), np.zeros((ny, size - ny))])
    gain = c.T
    return LinearModel(spec, a, b, c, np.zeros((ny, nu)), gain, np.zeros(size), np.zeros(ny), n)  # type: ignore[arg-type]
