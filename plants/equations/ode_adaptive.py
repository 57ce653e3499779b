"""Adaptive integration of an ODE plant by SciPy, with dense output; the same calls as the engine of fixed step."""

from __future__ import annotations

import warnings
from typing import Any, Literal

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from plants.checking import positive

Integrator = Literal["rk4", "dop853", "lsoda", "bdf", "radau"]
METHODS: dict[str, Any] = {"dop853": "DOP853", "lsoda": "LSODA", "bdf": "BDF", "radau": "Radau"}


def checked_integrator(integrator: str, rtol: float, atol: float, substeps: int | None) -> None:
    """Refuse options that do not fit each other.

    Raises
    ------
    InputError
        If the method is unknown, a tolerance is not positive, or substeps are asked of an adaptive method.
    """
    positive("rtol", rtol)
    positive("atol", atol)
    if integrator != "rk4" and integrator not in METHODS:
        raise InputError(
            "option integrator", expected=f"one of rk4, {', '.join(METHODS)}", got=repr(integrator), remedy="choose one"
        )
    if integrator != "rk4" and substeps is not None:
        raise InputError(
            "option substeps",
            expected="none with an adaptive integrator",
            got=repr(substeps),
            remedy="use rtol and atol, or integrator rk4",
        )


class AdaptiveEngine:
    """One sample at a time by :func:`scipy.integrate.solve_ivp`.

    Time counts from the start of each sample, so that a step gives the same bits wherever it stands in a run.
    """

    def __init__(self, simulator: Any, p: FloatArray, integrator: str, rtol: float, atol: float) -> None:
        self.simulator, self.p = simulator, p
        self.nu, self.nx, self.ny = simulator.spec.nu, simulator.nx, simulator.spec.ny
        self._method, self._rtol, self._atol = METHODS[integrator], float(rtol), float(atol)

    def _solved(self, x: FloatArray, u: FloatArray, t: float, *, dense: bool) -> Any:
        """Return SciPy's solution over one sample."""
        from scipy.integrate import solve_ivp

        rates = self.simulator.derivative
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # a method that gives up is told by its status
            return solve_ivp(
                lambda s, z: rates(z, u, self.p, t + s),
                (0.0, self.simulator.dt),
                x,
                method=self._method,
                rtol=self._rtol,
                atol=self._atol,
                dense_output=dense,
            )

    def step(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return the state and the output one sample later; NaN where the method gives up."""
        if not np.isfinite(x).all():
            return np.full(self.nx, np.nan), np.full(self.ny, np.nan)
        solved = self._solved(x, u, t, dense=False)
        new = solved.y[:, -1].copy() if solved.success else np.full(self.nx, np.nan)
        return new, self.output(new, u, t + self.simulator.dt)

    def run(self, x: FloatArray, u: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return states (N, nx) and outputs (N, ny) from a state; row 0 is the state itself."""
        n = u.shape[0]
        xs, ys = np.empty((n, self.nx)), np.empty((n, self.ny))
        xs[0], ys[0] = x, self.output(x, u[0], t)
        for k in range(1, n):
            xs[k], ys[k] = self.step(xs[k - 1], u[k - 1], t + (k - 1) * self.simulator.dt)
        return xs, ys

    def output(self, x: FloatArray, u: FloatArray, t: float) -> FloatArray:
        """Return the output in a state."""
        full = np.concatenate([u, np.zeros(self.nu - len(u))]) if len(u) < self.nu else u
        return np.array(self.simulator.output(x, full, self.p, t))

    def between(self, x: FloatArray, u: FloatArray, t: float, times: FloatArray) -> FloatArray:
        """Return the states (M, nx) at times inside the sample that starts in a state."""
        path: FloatArray = self._solved(x, u, t, dense=True).sol(times).T
        return path
