"""What models share that predict the next output from past outputs and inputs, each in its own way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.models.distributions import NormalMixture, normal
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.bands import Bands
from identifiers.common.described import Described
from identifiers.common.observers import fitted_start, run_in_steps
from identifiers.common.records import lagged, recent

_START = 30  # Samples that the unknown past at the start of a record is fitted to: some times the usual number of lags.
_SURE = 1e-6  # Standard deviation of an output that was just measured, relative to its scale: it is known.
_FAR = 100.0  # A free run so many scales away from the data has diverged, as in :mod:`identifiers.sparse.sparse_model`.


@dataclass(frozen=True, eq=False)
class Standardisation(Described):
    """Mean and size of regressors and targets, so that learners see numbers about 1."""

    # (p,)
    x_mean: FloatArray
    x_std: FloatArray
    # (ny,)
    y_mean: FloatArray
    y_std: FloatArray

    @classmethod
    def of(cls, rows: FloatArray, targets: FloatArray) -> Standardisation:
        """Return the scaling of data; a column that never moves has the size 1."""
        x_std, y_std = rows.std(axis=0), targets.std(axis=0)
        return cls(
            rows.mean(axis=0), np.where(x_std > 0, x_std, 1.0), targets.mean(axis=0), np.where(y_std > 0, y_std, 1.0)
        )

    def rows(self, values: FloatArray) -> FloatArray:
        """Return scaled regressors."""
        return np.asarray((values - self.x_mean) / self.x_std)

    def targets(self, values: FloatArray) -> FloatArray:
        """Return scaled targets."""
        return np.asarray((values - self.y_mean) / self.y_std)


@dataclass(frozen=True, eq=False)
class LagModel(Described, ABC):
    """``y[k+1] = f(y[k], ..., y[k-L+1], u[k], ..., u[k-L+1])`` with an error of known size.

    The state is ``[y[k], ..., y[k-L+1], u[k-1], ..., u[k-L+1], v, steps]``, where v (ny,) is the variance of y[k]: 0
    once it was measured, that of the one-step error one step later; further ahead the variances of the steps are added,
    as if an error stayed what it is. ``steps`` counts those since an output was measured: where held-out data have told
    how far that sum is off so many steps ahead, the deviation is multiplied by it. A subclass says :meth:`ahead` only.
    """

    spec: PlantSpec
    lags: int  # L, at least 1
    scaling: Standardisation
    """Of the regressors ``[y lags, u lags]``, and of what is learned: the next output, or its change."""
    bands: Bands | None = field(default=None, kw_only=True)
    """Factor of the standard deviation by the steps since an output was measured; 1 where there are none."""
    notes: dict[str, Any] = field(default_factory=dict, kw_only=True)

    @abstractmethod
    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output from regressors (..., p), all in the units of data."""

    @property
    def y_size(self) -> FloatArray:
        """Standard deviation of the outputs (ny,) in the estimation data."""
        return self.scaling.x_std[: self.spec.ny]

    @property
    def burn_in(self) -> int:
        """Samples that the lags reach back."""
        return self.lags - 1

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) at the first sample; the unknown past is fitted to the start of the record."""
        same_language(self.spec, data)
        ny = self.spec.ny
        # Backwards along a parabola through the first samples, the input as it is at first.
        few = min(len(data), 7)
        past = np.tile(data.y[0], (self.lags, 1))
        if few > 2 and self.lags > 1:
            unwound = data.y[:few].copy()
            for i, channel in enumerate(self.spec.outputs):
                if channel.period is not None:
                    unwound[:, i] = np.unwrap(unwound[:, i], period=channel.period)
            curve = np.polynomial.polynomial.polyfit(np.arange(few), unwound, 2)
            guess = np.polynomial.polynomial.polyval(-np.arange(1.0, self.lags), curve).T
            size = 2 * self.y_size
            past[1:] = np.clip(guess, data.y[:few].min(axis=0) - size, data.y[:few].max(axis=0) + size)
        held = np.tile(data.u[0], self.lags - 1)
        variance = (_SURE * self.y_size) ** 2

        def complete(lagged: FloatArray) -> FloatArray:
            lead = lagged.shape[:-1]
            known = np.append(variance, 0.0)
            parts = [lagged, np.broadcast_to(held, (*lead, held.size)), np.broadcast_to(known, (*lead, ny + 1))]
            return np.concatenate(parts, axis=-1)

        if self.lags == 1:
            return complete(past.ravel())
        found = fitted_start(
            lambda x, u: self.free_run(complete(x), u),
            self.spec.outputs,
            data,
            past.ravel(),
            scale=np.tile(self.y_size, self.lags),
            lengths=(_START,),
        )
        return complete(found)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the present output (..., ny), the first part of the state."""
        return np.asarray(x)[..., : self.spec.ny]

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., ny)."""
        x, ny = np.asarray(x, dtype=float), self.spec.ny
        std = np.sqrt(np.maximum(x[..., -ny - 1 : -1], (_SURE * self.y_size) ** 2))
        return normal(x[..., :ny], std * self.band_factor(x), self.spec.outputs)

    def band_factor(self, x: FloatArray) -> FloatArray:
        """Return by what held-out data scaled the deviations (..., ny) at states (..., nx)."""
        x = np.asarray(x, dtype=float)
        if self.bands is None:
            return np.ones((*x.shape[:-1], self.spec.ny))
        return np.where(x[..., -1:] > 0, self.bands.at(x[..., -1]), 1.0)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx); NaN once it is far outside the data."""
        x = np.asarray(x, dtype=float)
        ny, nu, past = self.spec.ny, self.spec.nu, self.lags * self.spec.ny
        u = np.broadcast_to(u, (*x.shape[:-1], nu))
        lagged_u = np.concatenate([u, x[..., past : -ny - 1]], axis=-1)
        rows = np.concatenate([x[..., :past], lagged_u], axis=-1)
        with np.errstate(over="ignore", invalid="ignore"):
            mean, variance = self.ahead(rows)
            near = (np.abs(mean - self.scaling.x_mean[:ny]) <= _FAR * self.y_size).all(axis=-1, keepdims=True)
            mean = np.where(near, mean, np.nan)
        kept_u = lagged_u[..., : (self.lags - 1) * nu]
        told = [variance + x[..., -ny - 1 : -1], x[..., -1:] + 1.0]
        return np.concatenate([mean, x[..., : past - ny], kept_u, *told], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state with the present output as it was measured (..., nx)."""
        new = np.array(x, dtype=float)
        ny = self.spec.ny
        new[..., :ny] = y
        new[..., -ny - 1 : -1] = (_SURE * self.y_size) ** 2
        new[..., -1] = 0.0
        return new

    def filtered(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states (N, nx), each after its output was seen, under inputs u (N, nu) and outputs y (N, ny)."""
        known = np.append((_SURE * self.y_size) ** 2, 0.0)
        return np.hstack([recent(x[: -known.size], self.lags, u, y), np.tile(known, (len(y), 1))])

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        return run_in_steps(self, x, u)


def regression_data(records: list[Trajectory], lags: int) -> tuple[FloatArray, FloatArray]:
    """Return regressors (n, p) and next outputs (n, ny) of all records; no row reaches across a seam."""
    rows = np.concatenate([lagged(record, lags) for record in records])
    return rows, np.concatenate([record.y[lags:] for record in records])
