"""Polynomial NARX model: the next output as a sum of few products of past outputs and inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray, PlantSpec
from identifiers.common.lag_state import LagModel
from identifiers.common.library import InLibrary, Library, equation_text

_FAR = 100.0  # As of :mod:`identifiers.common.lag_state`: a free run so many sizes away from the data has diverged.
_FEW = 24  # Up to so many runs at once numbers one by one are faster than short arrays.


def argument_names(spec: PlantSpec, lags: int) -> tuple[str, ...]:
    """Return the names of the regressors, ``y[k]``, ``y[k-1]``, ..., ``u[k]``, ...

    Examples
    --------
    >>> from harness.signals import Channel
    >>> argument_names(PlantSpec((Channel("u"),), (Channel("y"),), 1.0), 2)
    ('y[k]', 'y[k-1]', 'u[k]', 'u[k-1]')
    """
    return tuple(
        f"{channel.name}[k{f'-{j}' if j else ''}]"
        for side in (spec.outputs, spec.inputs)
        for j in range(lags)
        for channel in side
    )


def _from(name: str, level: float) -> str:
    """Return a signal counted from a level, in words."""
    return name if level == 0.0 else f"{name} {'-' if level > 0 else '+'} {abs(level):.6g}"


@dataclass(frozen=True, eq=False)
class NarxModel(InLibrary, LagModel):
    """``y[k+1] = Xi f(y[k], ..., y[k-L+1], u[k], ..., u[k-L+1])`` with monomials f of scaled signals.

    The state and what it holds of the past are those of :class:`identifiers.common.lag_state.LagModel`. A free run
    that leaves the data a hundredfold becomes NaN: it has diverged.

    Parameters
    ----------
    library : Library
        Monomials of the scaled regressors.
    coefficients : array (ny, p)
        In scaled signals; 0 where a term was not chosen.
    std : array (ny,)
        Of the one-step error, in the outputs' units.
    """

    library: Library
    coefficients: FloatArray
    std: FloatArray
    kind = "narx"

    @property
    def terms(self) -> tuple[tuple[str, ...], ...]:
        """Names of the terms of each output."""
        names = self.names
        return tuple(tuple(n for n, c in zip(names, row, strict=True) if c != 0.0) for row in self.coefficients)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every monomial, with the level that its signals are counted from where that is not zero."""
        arguments = [
            name if level == 0.0 else f"({_from(name, level)})"
            for name, level in zip(argument_names(self.spec, self.lags), self.scaling.x_mean, strict=True)
        ]
        library = self.library
        return Library(tuple(arguments), library.degree).names

    @property
    def natural(self) -> FloatArray:
        """Coefficients (ny, p) in the units of the signals."""
        sizes = self.library.rows([np.asarray(1.0 / size) for size in self.scaling.x_std])
        return np.asarray(self.coefficients * self.scaling.y_std[:, None] * sizes)

    @property
    def equations(self) -> tuple[str, ...]:
        """The identified equations as text, one for each output."""
        found = []
        for channel, row, level in zip(self.spec.outputs, self.natural, self.scaling.y_mean, strict=True):
            found.append(equation_text(_from(f"{channel.name}[k+1]", level), self.names, row))
        return tuple(found)

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output from regressors (..., p)."""
        scaled = self.scaling.rows(rows)
        found = self._equations(np.sin, np.cos, *np.moveaxis(scaled, -1, 0))
        value = np.stack([np.broadcast_to(one, scaled.shape[:-1]) for one in found], axis=-1)
        mean = value * self.scaling.y_std + self.scaling.y_mean
        return mean, np.broadcast_to(self.std**2, mean.shape)

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        m, n = u.shape[:2]
        if m > _FEW:
            return super().free_run(x, u)
        ny, nu, lags = self.spec.ny, self.spec.nu, self.lags
        outputs = np.full((m, n, ny), np.nan)
        states = np.broadcast_to(np.asarray(x, dtype=float), (m, np.shape(x)[-1]))
        size, level = self.scaling.y_std, self.scaling.y_mean
        past = (states[:, : lags * ny] - self.scaling.x_mean[: lags * ny]) / self.scaling.x_std[: lags * ny]
        before = states[:, lags * ny : lags * ny + (lags - 1) * nu]
        u_mean, u_std = self.scaling.x_mean[lags * ny :], self.scaling.x_std[lags * ny :]
        before = (before - u_mean[nu:]) / u_std[nu:]
        inputs = (u - u_mean[:nu]) / u_std[:nu]
        for run in range(m):
            rows = self._run(past[run].tolist(), before[run].tolist(), inputs[run].tolist())
            outputs[run, : len(rows)] = np.array(rows) * size + level
        return outputs

    def _run(self, seen: list[float], fed: list[float], inputs: list[list[float]]) -> list[list[float]]:
        """Return the scaled outputs of a free run, in plain numbers, up to where it diverges."""
        ny, keep_y, keep_u = self.spec.ny, (self.lags - 1) * self.spec.ny, (self.lags - 1) * self.spec.nu
        value = self._equations
        rows = [seen[:ny]]
        try:
            for u in inputs[:-1]:
                lagged = [*u, *fed]
                new = list(value(None, None, *seen, *lagged))
                if not all(-_FAR <= one <= _FAR for one in new):
                    break
                rows.append(new)
                seen, fed = [*new, *seen[:keep_y]], lagged[:keep_u]
        except OverflowError:
            pass
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {**super().to_dict(), "equations": list(self.equations)}
