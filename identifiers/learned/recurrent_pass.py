"""Free runs of small recurrent networks with derivatives: compiled, or in numpy where there is no C compiler."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray
from identifiers.common import native
from identifiers.common.native import pointers

FAR = 1e3  # A scaled state beyond it has diverged, as in :mod:`identifiers.learned.neural_state`.


@functools.cache
def library() -> Any:
    """Return the compiled run, or None where there is no C compiler."""
    arguments = [ctypes.c_long] * 6 + [ctypes.c_void_p] * 3 + [ctypes.c_double] + [ctypes.c_void_p] * 3
    return native.declared("recurrent_loop", sysid_recurrent_run=(ctypes.c_long, arguments))


@dataclass(frozen=True)
class RecurrentLayout:
    """``x+ = x + z A + tanh(z W1) W2``, ``y = z C + tanh(z V1) V2`` with ``z = [x, u, 1]``; tables in one vector.

    Parameters
    ----------
    nx, nu, ny : int
        States, inputs, outputs.
    hidden, outside : int
        Units of the network of the state, and of that of the output.
    """

    nx: int
    nu: int
    ny: int
    hidden: int
    outside: int

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the tables in their order."""
        nz, nx, ny = self.nx + self.nu + 1, self.nx, self.ny
        return {
            "A": (nz, nx),
            "W1": (nz, self.hidden),
            "W2": (self.hidden, nx),
            "C": (nz, ny),
            "V1": (nz, self.outside),
            "V2": (self.outside, ny),
        }

    @property
    def count(self) -> int:
        """Number of parameters."""
        return sum(rows * columns for rows, columns in self.shapes.values())

    def tables(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return views of the tables in a vector (p,).

        Examples
        --------
        >>> layout = RecurrentLayout(2, 1, 1, 3, 1)
        >>> layout.tables(np.zeros(layout.count))["W1"].shape
        (4, 3)
        """
        views, low = {}, 0
        for name, (rows, columns) in self.shapes.items():
            views[name] = theta[low : low + rows * columns].reshape(rows, columns)
            low += rows * columns
        return views

    def step(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx); NaN once one is far outside the data."""
        t, z = self.tables(theta), self._joined(x, u)
        with np.errstate(over="ignore", invalid="ignore"):
            new = x + z @ t["A"] + np.tanh(z @ t["W1"]) @ t["W2"]
            return np.where(np.abs(new).max(axis=-1, keepdims=True) <= FAR, new, np.nan)

    def output(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""
        t, z = self.tables(theta), self._joined(x, u)
        return np.asarray(z @ t["C"] + np.tanh(z @ t["V1"]) @ t["V2"])

    def jacobians(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (nx, nx) of the next state and (ny, nx) of the output by the state x (nx,)."""
        t, z = self.tables(theta), self._joined(x, u)
        by_z = t["A"] + t["W1"] @ ((1.0 - np.tanh(z @ t["W1"]) ** 2)[:, None] * t["W2"])
        out_by_z = t["C"] + t["V1"] @ ((1.0 - np.tanh(z @ t["V1"]) ** 2)[:, None] * t["V2"])
        return np.eye(self.nx) + by_z[: self.nx].T, out_by_z[: self.nx].T

    def run(
        self, theta: FloatArray, start: FloatArray, u: FloatArray, *, sensitivities: bool, native: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the outputs (N, ny) of a free run, and their derivatives (N, ny, p + nx) by theta and start.

        A run that diverges ends in NaN.
        """
        n, q = len(u), self.count + self.nx
        y = np.full((n, self.ny), np.nan)
        table = np.zeros((n, self.ny, q)) if sensitivities else None
        compiled = library() if native else None
        if compiled is None:
            self._plain(theta, start, u, y, table)
            return y, table
        given = [np.ascontiguousarray(part, dtype=float) for part in (theta, start, u)]
        nz = self.nx + self.nu + 1
        size = nz + self.hidden + self.outside + self.nx * (1 + self.hidden + self.nx + 2 * q)
        work = np.empty(size)
        sizes = (n, self.nx, self.nu, self.ny, self.hidden, self.outside)
        address = None if table is None else table.ctypes.data
        compiled.sysid_recurrent_run(*sizes, *pointers(*given), FAR, *pointers(y), address, *pointers(work))
        return y, table

    def states(self, theta: FloatArray, start: FloatArray, u: FloatArray) -> FloatArray:
        """Return the states (N, nx) of a free run, NaN where it has diverged."""
        states = np.empty((len(u), self.nx))
        x = start
        for k, held in enumerate(u):
            states[k] = x
            x = self.step(theta, x, held)
        return states

    def to_dict(self) -> list[int]:
        """Return its sizes."""
        return [self.nx, self.nu, self.ny, self.hidden, self.outside]

    def _joined(self, x: FloatArray, u: FloatArray) -> FloatArray:
        u = np.broadcast_to(u, (*x.shape[:-1], self.nu))
        return np.concatenate([x, u, np.ones((*x.shape[:-1], 1))], axis=-1)

    def _plain(self, theta: FloatArray, x: FloatArray, u: FloatArray, y: FloatArray, table: FloatArray | None) -> None:
        """Fill in outputs and derivatives, in numpy."""
        t, nx, q = self.tables(theta), self.nx, self.count + self.nx
        sensitivity = np.hstack([np.zeros((nx, self.count)), np.eye(nx)])
        for k in range(len(u)):
            z = self._joined(x, u[k])
            outer, inner = np.tanh(z @ t["V1"]), np.tanh(z @ t["W1"])
            y[k] = z @ t["C"] + outer @ t["V2"]
            if table is not None:
                bend = (1.0 - outer**2)[:, None] * t["V2"]
                by_z = t["C"] + t["V1"] @ bend
                own = {"C": np.multiply.outer(z, np.eye(self.ny)), "V1": np.multiply.outer(z, bend)}
                own["V2"] = np.multiply.outer(outer, np.eye(self.ny))
                table[k] = by_z[:nx].T @ sensitivity + self._spread(own, self.ny, q)
            with np.errstate(over="ignore", invalid="ignore"):
                new = x + z @ t["A"] + inner @ t["W2"]
            if not (np.abs(new) <= FAR).all():
                return
            if table is not None:
                bend = (1.0 - inner**2)[:, None] * t["W2"]
                by_z = t["A"] + t["W1"] @ bend
                own = {"A": np.multiply.outer(z, np.eye(nx)), "W1": np.multiply.outer(z, bend)}
                own["W2"] = np.multiply.outer(inner, np.eye(nx))
                sensitivity = sensitivity + by_z[:nx].T @ sensitivity + self._spread(own, nx, q)
            x = new

    def _spread(self, own: dict[str, FloatArray], rows: int, q: int) -> FloatArray:
        """Return derivatives by the tables (..., rows) side by side in their places (rows, q)."""
        full, low = np.zeros((rows, q)), 0
        for name, (height, width) in self.shapes.items():
            if name in own:
                full[:, low : low + height * width] = own[name].reshape(height * width, rows).T
            low += height * width
        return full


@dataclass(frozen=True)
class Integrating:
    """``y+ = y + size * g(x, u)``, ``x+ = f(x, u)`` with f and g of a network: what it says is summed, not shown.

    Neither f nor g knows y: wherever the plant stands it moves alike (Forgione & Piga 2021, *European Journal of
    Control* 59, 69-81, sec. 2.3). The states are those of the network, then y.
    """

    inner: RecurrentLayout
    size: tuple[float, ...]  # Of an increment of each scaled output in a sample

    @property
    def nx(self) -> int:
        """States."""
        return self.inner.nx + self.inner.ny

    @property
    def count(self) -> int:
        """Coefficients."""
        return self.inner.count

    def step(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next states (..., nx)."""
        network, cut = self.inner, self.inner.nx
        said = network.output(theta, x[..., :cut], u) * self.size
        return np.concatenate([network.step(theta, x[..., :cut], u), x[..., cut:] + said], axis=-1)

    def output(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (..., ny)."""
        return np.array(x[..., self.inner.nx :])

    def jacobians(self, theta: FloatArray, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (nx, nx) of the next state and (ny, nx) of the output by the state x (nx,)."""
        cut, ny = self.inner.nx, self.inner.ny
        turn, said = self.inner.jacobians(theta, x[:cut], u)
        by_x = np.block([[turn, np.zeros((cut, ny))], [np.array(self.size)[:, None] * said, np.eye(ny)]])
        return by_x, np.hstack([np.zeros((ny, cut)), np.eye(ny)])

    def run(
        self, theta: FloatArray, start: FloatArray, u: FloatArray, *, sensitivities: bool, native: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the outputs (N, ny) of a free run, and their derivatives (N, ny, p + nx) by coefficients and start."""
        cut, ny = self.inner.nx, self.inner.ny
        said, inner = self.inner.run(theta, start[:cut], u, sensitivities=sensitivities, native=native)
        y = np.empty_like(said)
        y[0] = start[cut:]
        np.cumsum(said[:-1] * self.size, axis=0, out=y[1:])
        y[1:] += start[cut:]
        if inner is None:
            return y, None
        table = np.zeros((len(u), ny, self.count + self.nx))
        np.cumsum(inner[:-1] * np.array(self.size)[:, None], axis=0, out=table[1:, :, : self.count + cut])
        table[:, :, self.count + cut :] = np.eye(ny)
        return y, table

    def states(self, theta: FloatArray, start: FloatArray, u: FloatArray) -> FloatArray:
        """Return the states (N, nx) of a free run, NaN where it has diverged."""
        inner = self.inner.states(theta, start[: self.inner.nx], u)
        return np.hstack([inner, self.run(theta, start, u, sensitivities=False)[0]])

    def to_dict(self) -> dict[str, Any]:
        """Return its sizes, JSON-ready."""
        return {"inner": self.inner.to_dict(), "size": list(self.size)}
