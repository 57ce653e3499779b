"""Iterative learning control: a better input at every repetition, from a linear model along the trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.protocols import Model
from harness.signals import FloatArray

__all__ = ["Learned", "TimeVarying", "learn_input", "linearised_along"]


@dataclass(frozen=True, eq=False)
class TimeVarying:
    """``dx+ = A[k] dx + B[k] du``, ``dy = C[k] dx + D[k] du`` about a trajectory of N samples.

    Parameters
    ----------
    a_matrices, b_matrices, c_matrices, d_matrices : array (N, nx, nx), (N, nx, nu), (N, ny, nx), (N, ny, nu)
    """

    a_matrices: FloatArray
    b_matrices: FloatArray
    c_matrices: FloatArray
    d_matrices: FloatArray

    def lifted(self) -> FloatArray:
        """Return the map (N ny, N nu) from changes of all inputs to changes of all outputs."""
        n, nx = self.a_matrices.shape[:2]
        ny, nu = self.d_matrices.shape[1:]
        found = np.zeros((n, ny, n, nu))
        moved = np.zeros((nx, n, nu))
        for k in range(n):
            found[k] = np.tensordot(self.c_matrices[k], moved, axes=1)
            found[k, :, k] += self.d_matrices[k]
            moved = np.tensordot(self.a_matrices[k], moved, axes=1)
            moved[:, k] += self.b_matrices[k]
        return found.reshape(n * ny, n * nu)

    def frozen(self, k: int = 0) -> TimeVarying:
        """Return the time-invariant model of one sample, for all samples."""
        n = len(self.a_matrices)
        parts = (self.a_matrices, self.b_matrices, self.c_matrices, self.d_matrices)
        return TimeVarying(*(np.repeat(part[k : k + 1], n, axis=0) for part in parts))


def linearised_along(model: Model, x0: FloatArray, u: FloatArray, *, size: float = 1e-5) -> TimeVarying:
    """Return a model linearised along its own run, by central differences.

    Parameters
    ----------
    model : Model
    x0 : array (nx,)
    u : array (N, nu)
    size : float
        Step of the differences, relative to the largest size that each state and input reaches (1 where it is zero).
    """
    n, nu = u.shape
    nx = np.size(x0)
    states = np.empty((n, nx))
    x = np.asarray(x0, dtype=float)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n):
            states[k] = x
            x = model.step(x, u[k])
    if not np.isfinite(states).all():
        raise InputError(
            "trajectory to linearise along", expected="a finite run", got="one that diverges", remedy="change the input"
        )
    steps = [size * np.where((top := np.abs(part).max(axis=0)) > 0, top, 1.0) for part in (states, u)]

    def jacobian(of: Callable[[FloatArray, FloatArray], FloatArray], which: int) -> FloatArray:
        columns = []
        for j, step in enumerate(steps[which]):
            push = np.zeros(nx if which == 0 else nu)
            push[j] = step
            sides = [(states + s * push, u) if which == 0 else (states, u + s * push) for s in (1.0, -1.0)]
            columns.append((of(*sides[0]) - of(*sides[1])) / (2 * step))
        return np.stack(columns, axis=-1) if columns else np.zeros((n, model.spec.ny, 0))

    return TimeVarying(
        jacobian(model.step, 0), jacobian(model.step, 1), jacobian(model.output, 0), jacobian(model.output, 1)
    )


@dataclass(frozen=True, eq=False)
class Learned:
    """What repetitions brought.

    Parameters
    ----------
    inputs : array (N, nu)
        The input of the best repetition.
    errors : tuple of float
        Root mean square error of the outputs at each repetition, each relative to the weights; inf where it diverged.
    """

    inputs: FloatArray
    errors: tuple[float, ...]


def learn_input(
    run: Callable[[FloatArray], FloatArray],
    reference: FloatArray,
    first: FloatArray,
    model: Callable[[FloatArray], TimeVarying] | TimeVarying,
    *,
    repetitions: int = 14,
    effort: float = 1e-4,
    weights: FloatArray | None = None,
) -> Learned:
    """Learn the input that makes a plant follow a reference, by repeating it and correcting with a model.

    Norm-optimal iterative learning control (Amann, Owens & Rogers 1996, IEE Proc. D 143:217; Bristow, Tharayil &
    Alleyne 2006, IEEE Control Systems 26:96): the change of the input minimises the error that the model foretells plus
    ``effort`` times its own square. The model need only be right about the direction in which inputs move outputs along
    the trajectory; the error itself is measured.

    Parameters
    ----------
    run : callable
        ``run(u (N, nu)) -> y (N, ny)``: one repetition of the plant, always from the same start.
    reference : array (N, ny)
    first : array (N, nu)
        Input of the first repetition.
    model : TimeVarying or callable
        The model along the trajectory, or ``model(u) -> TimeVarying`` for one along the trajectory of each input.
    repetitions : int
        After the first.
    effort : float
        Relative to the mean square gain of the model.
    weights : array (ny,), optional
        Errors are divided by these; ones by default.

    Returns
    -------
    Learned
    """
    size = np.ones(reference.shape[1]) if weights is None else np.asarray(weights, dtype=float)
    u = np.array(first, dtype=float)
    best, errors = (np.inf, u), []
    for _ in range(repetitions + 1):
        with np.errstate(over="ignore", invalid="ignore"):
            y = np.asarray(run(u), dtype=float)
        miss = ((reference - y) / size).ravel()
        error = float(np.sqrt(np.mean(miss**2))) if np.isfinite(y).all() else float("inf")
        errors.append(error)
        if error < best[0]:
            best = (error, u)
        if not np.isfinite(error):
            break
        gain = (model(u) if callable(model) else model).lifted()
        gain = (gain.reshape(len(u), -1, gain.shape[1]) / size[:, None]).reshape(gain.shape)
        gram = gain.T @ gain
        damping = effort * float(np.trace(gram)) / len(gram)
        u = u + np.linalg.solve(gram + damping * np.eye(len(gram)), gain.T @ miss).reshape(u.shape)
    return Learned(best[1], tuple(errors))
