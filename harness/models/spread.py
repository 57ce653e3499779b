"""How far a linear model can be believed: models near it, whose distances add up to the covariance of what it says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

ComplexArray = npt.NDArray[np.complex128]
Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]  # A, B, C, D.


@dataclass(frozen=True, eq=False)
class Spread:
    """Neighbours of a fitted linear model.

    The covariance of any function f of the model M is ``factor * sum over g of (f(M_g) - f(M)) (f(M_g) - f(M))'``. The
    neighbours are the fits without one stretch of the records each (delete-a-group jackknife, factor (G - 1) / G; Kott
    2001, J. Official Statistics 17:521), or steps along the directions of a covariance.

    Examples
    --------
    >>> one = np.ones((2, 1, 1))
    >>> near = Spread(np.array([[[0.4]], [[0.6]]]), one, one, 0 * one, 0.5, 1.0, "jackknife over 2 stretches")
    >>> near.count
    2
    """

    # (G, nx, nx), (G, nx, nu), (G, ny, nx), (G, ny, nu)
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    factor: float
    freedom: float  # Degrees of freedom of the covariance, for Student's quantile
    method: str  # Where the neighbours come from, in words
    warning: str = ""  # Why the spread says too little, where it does: a bias is not in it

    @property
    def count(self) -> int:
        """Number of neighbours."""
        return len(self.a)

    @property
    def models(self) -> list[Matrices]:
        """The neighbours one by one."""
        return list(zip(self.a, self.b, self.c, self.d, strict=True))

    def scaled(self, inputs: FloatArray, outputs: FloatArray) -> Spread:
        """Return the neighbours of a model whose inputs (nu,) and outputs (ny,) were divided by these sizes."""
        rows = outputs[:, None]
        return replace(self, b=self.b / inputs, c=self.c * rows, d=self.d * rows / inputs)

    def to_dict(self, model: Any) -> dict[str, Any]:
        """Return a JSON-ready description: the rows of the matrices in which neighbours differ from their model."""
        content: dict[str, Any] = {"factor": self.factor, "freedom": self.freedom, "method": self.method}
        content["warning"] = self.warning
        for name, middle in zip("abcd", _matrices(model), strict=True):
            near = getattr(self, name)
            rows = np.flatnonzero(np.any(near != middle, axis=(0, 2)))
            content[name] = {"rows": rows.tolist(), "values": near[:, rows].tolist(), "count": len(near)}
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], matrices: Matrices) -> Spread:
        """Return the spread of a description, around the matrices of its model."""
        found = []
        for name, middle in zip("abcd", matrices, strict=True):
            part = content[name]
            near = np.repeat(np.asarray(middle, dtype=float)[None], int(part["count"]), axis=0)
            rows = [int(row) for row in part["rows"]]
            if rows:
                near[:, rows] = np.array(part["values"], dtype=float).reshape(len(near), len(rows), -1)
            found.append(near)
        a, b, c, d = found
        factor, freedom = float(content["factor"]), float(content["freedom"])
        return cls(a, b, c, d, factor, freedom, str(content["method"]), str(content["warning"]))


def quantile(spread: Spread, level: float = 0.95) -> float:
    """Return the half width of an interval in standard deviations."""
    from scipy.stats import t

    return float(t.ppf(0.5 + level / 2, spread.freedom))


def deviation_of(model: Any, function: Callable[[Matrices], FloatArray]) -> FloatArray:
    """Return the standard deviation of anything that follows from a linear model.

    Parameters
    ----------
    model : LinearModel
        With a ``spread``.
    function : callable
        Takes (A, B, C, D) and returns an array of real numbers.

    Returns
    -------
    array
        Of the function's shape.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> one = np.ones((1, 1))
    >>> near = Spread(*(np.repeat(m[None], 2, 0) for m in (one / 2, one, one, 0 * one)), 0.5, 1.0, "")
    >>> near.a[:, 0, 0] = 0.4, 0.6
    >>> model = SimpleNamespace(matrices=(one / 2, one, one, 0 * one), spread=near)
    >>> float(deviation_of(model, lambda m: m[0][0, 0]).round(3))
    0.1
    """
    away = _away(model, function)
    return np.asarray(np.sqrt(model.spread.factor * np.sum(away**2, axis=0)), dtype=np.float64)


def covariance_of(model: Any, function: Callable[[Matrices], FloatArray]) -> FloatArray:
    """Return the covariance (k, k) of k numbers that follow from a linear model; see :func:`deviation_of`."""
    away = _away(model, function)
    return np.asarray(model.spread.factor * away.T @ away, dtype=np.float64)


def response_covariance(model: Any, frequency: FloatArray) -> FloatArray:
    """Return the covariance of real and imaginary part of a frequency response, (F, ny, nu, 2, 2).

    - ``model``: with a ``spread``
    - ``frequency`` (F,): [Hz]
    """
    sample_time = model.spec.sample_time

    def both(matrices: Matrices) -> FloatArray:
        g = gains(matrices, frequency, sample_time)
        return np.stack([g.real, g.imag], axis=-1)

    away = _away(model, both)
    return np.asarray(model.spread.factor * np.einsum("g...i,g...j->...ij", away, away), dtype=np.float64)


def gain_and_phase_deviation(response: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations of modulus and phase [rad] of a frequency response, to first order.

    - ``response`` (..., )
    - ``covariance`` (..., 2, 2): of its real and imaginary part

    Examples
    --------
    >>> gain, phase = gain_and_phase_deviation(np.array([2j]), np.array([[[0.01, 0.0], [0.0, 0.04]]]))
    >>> gain.round(3).tolist(), phase.round(3).tolist()
    ([0.2], [0.05])
    """
    size = np.abs(response)
    turn = np.where(size > 0, response / np.where(size > 0, size, 1.0), 1.0)
    along = np.stack([turn.real, turn.imag], axis=-1)
    across = np.stack([-turn.imag, turn.real], axis=-1)
    of_gain = np.sqrt(np.maximum(np.einsum("...i,...ij,...j->...", along, covariance, along), 0.0))
    of_phase = np.sqrt(np.maximum(np.einsum("...i,...ij,...j->...", across, covariance, across), 0.0))
    return of_gain, np.asarray(of_phase / np.where(size > 0, size, np.inf), dtype=np.float64)


def step_deviation(model: Any, count: int, kind: str = "step") -> FloatArray:
    """Return the standard deviation (N, ny, nu) of the step (or impulse) response over so many samples."""
    return deviation_of(model, lambda matrices: steps(matrices, count, kind))


def pole_covariance(model: Any) -> tuple[ComplexArray, FloatArray]:
    """Return the poles (nx,), by falling modulus, and the covariance of real and imaginary part of each (nx, 2, 2)."""
    poles = _poles(_matrices(model)[0])

    def both(matrices: Matrices) -> FloatArray:
        found = matched_poles(poles, matrices[0])
        return np.stack([found.real, found.imag], axis=-1)

    away = _away(model, both)
    return poles, np.asarray(model.spread.factor * np.einsum("gpi,gpj->pij", away, away), dtype=np.float64)


def matched_poles(poles: ComplexArray, a: FloatArray) -> ComplexArray:
    """Return the eigenvalue of A that belongs to each of some poles: the nearest, taken together."""
    from scipy.optimize import linear_sum_assignment

    other = np.linalg.eigvals(a).astype(np.complex128)
    _, order = linear_sum_assignment(np.abs(poles[:, None] - other[None]))
    return np.asarray(other[order], dtype=np.complex128)


def gains(matrices: Matrices, frequency: FloatArray, sample_time: float) -> ComplexArray:
    """Return ``C (z I - A)^-1 B + D`` at frequencies [Hz], (F, ny, nu)."""
    a, b, c, d = matrices
    z = np.exp(2j * np.pi * np.asarray(frequency, dtype=float) * sample_time)
    inner = np.linalg.solve(
        z[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b.astype(complex), (z.size, *b.shape))
    )
    return np.asarray(c @ inner + d, dtype=np.complex128)


def steps(matrices: Matrices, count: int, kind: str = "step") -> FloatArray:
    """Return the step (or impulse) response (N, ny, nu) from rest."""
    a, b, c, d = matrices
    found = np.empty((count, c.shape[0], b.shape[1]))
    state = b
    for k in range(count):
        found[k] = c @ state if k else d
        state = a @ state if k else state
    return found if kind == "impulse" else np.cumsum(found, axis=0)


def _matrices(model: Any) -> Matrices:
    """Return A, B, C, D of a model."""
    a, b, c, d = (np.asarray(matrix, dtype=np.float64) for matrix in model.matrices)
    return a, b, c, d


def _away(model: Any, function: Callable[[Matrices], FloatArray]) -> FloatArray:
    """Return how far a function of the neighbours is from that of the model (G, ...)."""
    middle = np.asarray(function(_matrices(model)), dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        near = np.array([function(one) for one in model.spread.models], dtype=np.float64)
    return np.asarray(near - middle, dtype=np.float64)


def _poles(a: FloatArray) -> ComplexArray:
    """Return the eigenvalues by falling modulus."""
    values = np.linalg.eigvals(a).astype(np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]
