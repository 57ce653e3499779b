"""Volterra series of second order: the output from products of past inputs, without any feedback of the output."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_undetermined
from harness.models.distributions import NormalMixture, normal
from harness.options import check_options
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.excitation import excited_lags
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.records import learnable

_BLOCK = 4096  # Rows of a block of regressors: a few hundred columns of them stay in the cache.

_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2, 1.0)
"""Weights of the regularisation that are tried, relative to the samples; the last fifth of each record chooses."""


@dataclass(frozen=True, eq=False)
class VolterraModel(Described):
    """``y[k] = h0 + sum_i h1[i] u[k-i] + sum_{i<=j} h2[i,j] u[k-i] u[k-j]`` with i, j = 0 .. memory - 1.

    The state is the scaled past inputs ``[u[k-1], ..., u[k-memory+1]]``; outputs correct nothing, because the series
    knows none.

    Parameters
    ----------
    spec : PlantSpec
    memory : int
    coefficients : array (p, ny)
        Of the constant, the inputs and their products, all scaled, in the order of :meth:`regressors`.
    mean, scale : array (nu,)
        Of the inputs.
    std : array (ny,)
        Of the error on samples that were not fitted.
    order : {1, 2}
    """

    spec: PlantSpec
    memory: int
    coefficients: FloatArray
    mean: FloatArray
    scale: FloatArray
    std: FloatArray
    order: int = 2
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "volterra"

    @property
    def burn_in(self) -> int:
        """Samples until the inputs before the record, which nobody knows, are forgotten."""
        return self.memory - 1

    def regressors(self, window: FloatArray) -> FloatArray:
        """Return constant, inputs and products (..., p) of windows (..., memory * nu), newest first, scaled."""
        return _regressors(window, self.order)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) as if the first input had been held for ever."""
        same_language(self.spec, data)
        return np.tile((data.u[0] - self.mean) / self.scale, self.memory - 1)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return np.asarray(self.regressors(self._window(x, u)) @ self.coefficients)

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., ny), with the error of the fit."""
        return normal(self.output(x, u), self.std, self.spec.outputs)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the inputs moved on by one sample (..., nx)."""
        return np.asarray(self._window(x, u)[..., : (self.memory - 1) * self.spec.nu])

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) unchanged: a reading corrects nothing."""
        return x

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        m, n = u.shape[:2]
        nu = self.spec.nu
        past = np.asarray(x).reshape(m, self.memory - 1, nu)[:, ::-1]
        whole = np.concatenate([past, (u - self.mean) / self.scale], axis=1)
        outputs = np.empty((m, n, self.spec.ny))
        for i in range(m):
            windows = _windows(whole[i], self.memory)
            for low in range(0, n, _BLOCK):
                outputs[i, low : low + _BLOCK] = self.regressors(windows[low : low + _BLOCK]) @ self.coefficients
        return outputs

    def _window(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the inputs of the present window (..., memory * nu), newest first, scaled."""
        x = np.asarray(x, dtype=float)
        now = (np.broadcast_to(u, (*x.shape[:-1], self.spec.nu)) - self.mean) / self.scale
        return np.concatenate([now, x], axis=-1)


@dataclass(frozen=True)
class Volterra(Excited):
    """Volterra series by regularised least squares (Schetzen 1980, *The Volterra and Wiener Theories*, ch. 3).

    The regularisation prefers kernels that decay, and is chosen on the last fifth of every record. Suits plants that
    forget: stable, without memory beyond ``memory`` samples.

    Parameters
    ----------
    memory : int
        Samples that the output remembers, the present one included.
    order : {1, 2}
        1 is a finite impulse response.
    """

    memory: int = 20
    order: int = 2

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> VolterraModel:
        """Return the model."""
        what = "volterra"
        check_options(self, what, memory=">= 1", order=">= 1, <= 2")
        records, spec = learnable(trajectories, samples=self.memory + 5, what=what)
        if spec.nu == 0:
            raise FitError(f"{what}: no inputs", expected="an input", got="none", remedy="use another identifier")
        refuse_undetermined(records, what, self.least_excitation)
        u = np.concatenate([record.u for record in records])
        mean, scale = u.mean(axis=0), np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
        parts, held = [], []
        for record in records:
            windows = _windows((record.u - mean) / scale, self.memory)
            y = record.y[self.memory - 1 :]
            cut = len(y) - len(y) // 5
            parts.append((windows[:cut], y[:cut]))
            held.append((windows[cut:], y[cut:]))
        size = _regressors(parts[0][0][:1], self.order).shape[1]
        gram, right, count = self._sums(parts, size)
        weight = self._decay(spec.nu)
        best: tuple[float, float] | None = None
        spread: FloatArray = np.maximum(np.concatenate([record.y for record in records]).std(axis=0), 1e-300)
        for ridge in _RIDGES:
            theta = np.asarray(np.linalg.solve(gram + ridge * count * np.diag(weight), right), dtype=float)
            wrong = np.concatenate([y - _regressors(w, self.order) @ theta for w, y in held if len(y)])
            error = float(np.mean((wrong / spread) ** 2))
            if best is None or error < best[0]:
                best, std = (error, ridge), np.sqrt(np.mean(wrong**2, axis=0))
        assert best is not None
        more = self._sums(held, size)
        gram, right, count = gram + more[0], right + more[1], count + more[2]
        theta = np.asarray(np.linalg.solve(gram + best[1] * count * np.diag(weight), right), dtype=float)
        notes: dict[str, Any] = {"coefficients": size, "ridge": best[1], "samples": count}
        if (lags := excited_lags(records, self.memory)) < self.memory:
            notes["warning"] = (
                f"the inputs excite {lags} lags of {self.memory}: the rest of the kernel is what the regularisation "
                "prefers, and other inputs may be answered wrongly; use a richer input, or a shorter memory"
            )
        return VolterraModel(
            spec,
            self.memory,
            theta,
            mean,
            scale,
            np.asarray(np.maximum(std, 1e-9 * spread), dtype=float),
            self.order,
            notes,
        )

    def _sums(self, parts: list[tuple[FloatArray, FloatArray]], size: int) -> tuple[FloatArray, FloatArray, int]:
        """Return Gram matrix, right-hand side and number of rows, summed in blocks."""
        gram, right, count = np.zeros((size, size)), np.zeros((size, parts[0][1].shape[1])), 0
        for windows, y in parts:
            for low in range(0, len(y), _BLOCK):
                rows = _regressors(windows[low : low + _BLOCK], self.order)
                gram += rows.T @ rows
                right += rows.T @ y[low : low + _BLOCK]
            count += len(y)
        return gram, right, count

    def _decay(self, nu: int) -> FloatArray:
        """Return the weights (p,) of the squares of the coefficients, which grow with the age of the inputs."""
        age = np.repeat(np.exp(3.0 * np.arange(self.memory) / self.memory), nu)
        first, second = np.triu_indices(age.size)
        parts = [np.array([1e-12]), age]
        if self.order == 2:
            parts.append(np.sqrt(age[first] * age[second]))
        return np.concatenate(parts)


def _windows(u: FloatArray, memory: int) -> FloatArray:
    """Return the windows (N - memory + 1, memory * nu) of inputs (N, nu), newest first."""
    view = np.lib.stride_tricks.sliding_window_view(u, memory, axis=0)[:, :, ::-1]
    return np.ascontiguousarray(view.transpose(0, 2, 1)).reshape(len(view), -1)


def _regressors(window: FloatArray, order: int) -> FloatArray:
    """Return constant, inputs and their products (..., p)."""
    parts = [np.ones((*window.shape[:-1], 1)), window]
    if order == 2:
        first, second = np.triu_indices(window.shape[-1])
        parts.append(window[..., first] * window[..., second])
    return np.concatenate(parts, axis=-1)
