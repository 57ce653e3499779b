"""Networks whose outputs are sums of what they say: positions, levels and charges, which return to no place alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.signals import FloatArray
from identifiers.learned.recurrent_pass import Layout

__all__ = ["Integrating"]


@dataclass(frozen=True)
class Integrating:
    """``y+ = y + size * g(x, u)``, ``x+ = f(x, u)`` with f and g of a network: what it says is summed, not shown.

    Neither f nor g knows y: wherever the plant stands it moves alike (Forgione & Piga 2021, *European Journal of
    Control* 59, 69-81, sec. 2.3). The states are those of the network, then y.

    Parameters
    ----------
    inner : Layout
    size : tuple of float
        Of an increment of each scaled output in a sample.
    """

    inner: Layout
    size: tuple[float, ...]

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

    def description(self) -> dict[str, Any]:
        """Return its sizes, JSON-ready."""
        return {"inner": self.inner.description(), "size": list(self.size)}
