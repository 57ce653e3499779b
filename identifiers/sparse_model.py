"""Sparse model: equations that are sums of a few library functions, simulated without blowing up silently."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from harness.errors import InputError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.derivatives import measured_motion
from identifiers.library import Library, equation_text
from identifiers.observers import fitted_start
from harness.specs import spec_from_dict, spec_to_dict

__all__ = ["SparseModel"]

# Polynomials run away outside the data: this many times beyond their range a run has diverged.
_FAR = 100.0


@dataclass(frozen=True, eq=False)
class SparseModel:
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

    def __post_init__(self) -> None:
        ny, nx = self.spec.ny, self.order * self.spec.ny
        for name, shape in (
            ("coefficients", (ny, len(self.library))),
            ("scale", (nx,)),
            ("filter_gain", (nx, ny)),
        ):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape:
                raise InputError(
                    f"{name} of a sparse model", expected=f"shape {shape}", got=str(array.shape), remedy="correct it"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)

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

    @cached_property
    def _active(self) -> tuple[list[int], FloatArray]:
        """Functions that any equation uses, and their coefficients (ny, active)."""
        used = [int(i) for i in np.flatnonzero(np.any(self.coefficients != 0.0, axis=0))]
        return used, np.ascontiguousarray(self.coefficients[:, used])

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the first output; with rates, the state (nx,) whose free run fits the start of the record best."""
        same_language(self.spec, data)
        if self.order == 1:
            return np.array(data.y[0])
        part = data[: min(len(data), 400)]
        value, rate = measured_motion(part, 2)
        # The smoothed angle is unwrapped: start on the turn that was measured.
        value = value[0] - np.round((value[0] - part.y[0]) / self._periods) * self._periods
        return fitted_start(
            self.free_run, self.spec.outputs, part, np.concatenate([value, rate[0]]), scale=self.scale
        )

    @property
    def _periods(self) -> FloatArray:
        return np.array([np.inf if c.period is None else c.period for c in self.spec.outputs])

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
                    a = self._slope(new, inputs)
                    b = self._slope(new + 0.5 * h * a, inputs)
                    c = self._slope(new + 0.5 * h * b, inputs)
                    d = self._slope(new + h * c, inputs)
                    new = new + h / 6 * (a + 2 * b + 2 * c + d)
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
        outputs = np.empty((m, n, self.spec.ny))
        state = np.array(np.broadcast_to(x, (m, np.shape(x)[-1])), dtype=float)
        for k in range(n):
            outputs[:, k] = state[:, : self.spec.ny]
            if not np.isfinite(state).any():
                outputs[:, k:] = np.nan
                break
            if k + 1 < n:
                state = self.step(state, u[:, k])
        return outputs

    @cached_property
    def _turning(self) -> FloatArray:
        """Which states are angles."""
        return np.array([c.period is not None for c in self.spec.outputs] + [False] * (self.spec.ny * (self.order - 1)))

    def _value(self, x: FloatArray, inputs: list[FloatArray]) -> FloatArray:
        """Return what the equations give (..., ny)."""
        used, coefficients = self._active
        if not used:
            return np.zeros((*x.shape[:-1], self.spec.ny))
        rows = self.library.rows([*np.moveaxis(x, -1, 0), *inputs], used)
        return np.moveaxis(np.tensordot(coefficients, rows, axes=1), 0, -1)

    def _slope(self, x: FloatArray, inputs: list[FloatArray]) -> FloatArray:
        value = self._value(x, inputs)
        return value if self.order == 1 else np.concatenate([x[..., self.spec.ny :], value], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "sparse",
            "spec": spec_to_dict(self.spec),
            "library": self.library.to_dict(),
            "coefficients": self.coefficients.tolist(),
            "order": self.order,
            "time": self.time,
            "scale": self.scale.tolist(),
            "filter_gain": self.filter_gain.tolist(),
            "substeps": self.substeps,
            "equations": list(self.equations),
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> SparseModel:
        """Return the model of a description."""
        return cls(
            spec_from_dict(content["spec"]),
            Library.from_dict(content["library"]),
            np.array(content["coefficients"], dtype=float),
            int(content["order"]),
            content["time"],
            np.array(content["scale"], dtype=float),
            np.array(content["filter_gain"], dtype=float),
            int(content["substeps"]),
            dict(content.get("notes", {})),
        )
