"""Sparse model: equations that are sums of a few library functions, simulated without blowing up silently."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.algebra import runge_kutta
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.described import Described
from identifiers.common.library import InLibrary, Library, equation_text
from identifiers.common.linear_model import freeze
from identifiers.common.observers import fitted_start
from identifiers.sparse.derivatives import measured_motion

# Polynomials run away outside the data: this many times beyond their range a run has diverged.
_FAR = 100.0


@dataclass(frozen=True, eq=False)
class SparseModel(InLibrary, Described):
    """``y' = Xi f(y, u)``, ``y'' = Xi f(y, y', u)`` or ``y[k+1] = Xi f(y[k], u[k])`` with few terms.

    Continuous equations are stepped by the classical Runge-Kutta method, the input held. A state that leaves
    the range of the estimation data a hundredfold becomes NaN: the run has diverged.

    Parameters
    ----------
    spec : PlantSpec
    library : Library
        Functions of ``[y, rates if order is 2, u]``.
    coefficients : array (ny, p)
    order : {1, 2}
        Order of the derivative that the equations give.
    time : {"continuous", "discrete"}
    scale : array (nx,)
        Largest size of each state in the estimation data.
    filter_gain : array (nx, ny)
        How a seen output corrects the state.
    substeps : int
        Runge-Kutta steps in a sample.
    notes : dict
    """

    spec: PlantSpec
    library: Library
    coefficients: FloatArray
    order: int
    time: Literal["continuous", "discrete"]
    scale: FloatArray
    filter_gain: FloatArray
    substeps: int = 1
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "sparse"

    def __post_init__(self) -> None:
        ny, nx = self.spec.ny, self.order * self.spec.ny
        shapes = {"coefficients": (ny, len(self.library)), "scale": (nx,), "filter_gain": (nx, ny)}
        freeze(self, shapes, "a sparse model")

    @property
    def burn_in(self) -> int:
        """No samples: the initial state is estimated."""
        return 0

    @property
    def equations(self) -> tuple[str, ...]:
        """The identified equations as text, one for each output."""
        mark = {"continuous": "'" * self.order, "discrete": "[k+1]"}[self.time]
        return tuple(
            equation_text(f"{channel.name}{mark}", self.library.names, row)
            for channel, row in zip(self.spec.outputs, self.coefficients, strict=True)
        )

    @property
    def support(self) -> tuple[tuple[str, ...], ...]:
        """Names of the functions in each equation."""
        names = self.library.names
        return tuple(tuple(n for n, c in zip(names, row, strict=True) if c != 0.0) for row in self.coefficients)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the first output; with rates, the state (nx,) whose free run fits the start of the record best."""
        same_language(self.spec, data)
        if self.order == 1:
            return np.array(data.y[0])
        part = data[: min(len(data), 400)]
        value, rate = measured_motion(part, 2)
        # The smoothed angle is unwrapped: start on the turn that was measured.
        start = value[0].copy()
        for i, channel in enumerate(self.spec.outputs):
            if channel.period is not None:
                start[i] -= np.round((start[i] - part.y[0, i]) / channel.period) * channel.period
        return fitted_start(self.free_run, self.spec.outputs, part, np.concatenate([start, rate[0]]), scale=self.scale)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny), the first part of the state."""
        return x[..., : self.spec.ny]

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx); NaN once it is far outside the range of the estimation data."""
        x = np.asarray(x, dtype=float)
        inputs = [np.broadcast_to(u, (*x.shape[:-1], self.spec.nu))[..., i] for i in range(self.spec.nu)]
        with np.errstate(over="ignore", invalid="ignore"):
            if self.time == "discrete":
                new = self._value(x, inputs)
            else:
                h = self.spec.sample_time / self.substeps
                new = x
                for _ in range(self.substeps):
                    new = runge_kutta(lambda state: self._derivative(state, inputs), new, h)
            # An angle may turn on and on.
            far = (np.abs(new) > _FAR * self.scale) & ~self._turning
            lost = far.any(axis=-1, keepdims=True) | ~np.isfinite(new).all(axis=-1, keepdims=True)
        return np.where(lost, np.nan, new)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after an output was seen; a diverged state starts anew from it."""
        miss = residual(self.spec.outputs, np.broadcast_to(y, (*x.shape[:-1], self.spec.ny)), self.output(x, u))
        new = x + miss @ self.filter_gain.T
        fresh = np.concatenate([y, np.zeros((*np.shape(y)[:-1], new.shape[-1] - self.spec.ny))], axis=-1)
        return np.where(np.isfinite(new).all(axis=-1, keepdims=True), new, fresh)

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        m, n = u.shape[:2]
        outputs = np.full((m, n, self.spec.ny), np.nan)
        states = np.array(np.broadcast_to(x, (m, np.shape(x)[-1])), dtype=float)
        if m <= 24:
            # numbers one by one are faster than short arrays
            for window in range(m):
                rows = self._run(states[window].tolist(), u[window].tolist())
                outputs[window, : len(rows)] = rows
            return outputs
        for k in range(n):
            outputs[:, k] = states[:, : self.spec.ny]
            if not np.isfinite(states).any():
                break
            if k + 1 < n:
                states = self.step(states, u[:, k])
        return outputs

    def _run(self, x: list[float], inputs: list[list[float]]) -> list[list[float]]:
        """Return the outputs of a free run, in plain numbers, up to where it diverges."""
        ny, nx = self.spec.ny, len(x)
        value, sin, cos = self._equations, math.sin, math.cos
        second, discrete = self.order == 2, self.time == "discrete"
        h = self.spec.sample_time / self.substeps
        limits = [math.inf if turns else _FAR * s for turns, s in zip(self._turning, self.scale.tolist(), strict=True)]
        both = range(nx)

        def derivative(state: list[float], u: list[float]) -> list[float]:
            found = value(sin, cos, *state, *u)
            return [*state[ny:], *found] if second else list(found)

        rows: list[list[float]] = []
        try:
            for k, u in enumerate(inputs):
                if not all(
                    abs(x[i]) <= limits[i] < math.inf or (math.isfinite(x[i]) and limits[i] == math.inf) for i in both
                ):
                    break
                rows.append(x[:ny])
                if k + 1 == len(inputs):
                    break
                if discrete:
                    x = list(value(sin, cos, *x, *u))
                    continue
                for _ in range(self.substeps):
                    a = derivative(x, u)
                    b = derivative([x[i] + 0.5 * h * a[i] for i in both], u)
                    c = derivative([x[i] + 0.5 * h * b[i] for i in both], u)
                    d = derivative([x[i] + h * c[i] for i in both], u)
                    x = [x[i] + h / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i]) for i in both]
        except (OverflowError, ValueError):  # the sine of infinity
            pass
        return rows

    @cached_property
    def _turning(self) -> npt.NDArray[np.bool_]:
        """Which states are angles."""
        return np.array([c.period is not None for c in self.spec.outputs] + [False] * (self.spec.ny * (self.order - 1)))

    def _value(self, x: FloatArray, inputs: list[FloatArray]) -> FloatArray:
        """Return what the equations give (..., ny)."""
        found = self._equations(np.sin, np.cos, *np.moveaxis(x, -1, 0), *inputs)
        return np.stack([np.broadcast_to(value, x.shape[:-1]) for value in found], axis=-1)

    def _derivative(self, x: FloatArray, inputs: list[FloatArray]) -> FloatArray:
        value = self._value(x, inputs)
        return value if self.order == 1 else np.concatenate([x[..., self.spec.ny :], value], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {**super().to_dict(), "equations": list(self.equations)}
