"""Linear systems in discrete time from their matrices, with process and measurement noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError
from harness.signals import Channel, FloatArray, PlantSpec
from plants.base import BasePlant
from plants.checking import checked_inputs, initial_values, positive, refuse_input


class LinearPlant(BasePlant):
    """``x[k+1] = A x[k] + B u[k] + w[k]``, ``y[k] = C x[k] + D u[k] + v[k]`` with white w of covariance Q, v of R.

    Parameters
    ----------
    A : array (nx, nx)
        Of one sample.
    B : array (nx, nu)
        Of one sample, the input held.
    C : array (ny, nx), optional
        By default the states are measured.
    D : array (ny, nu), optional
        By default 0. Where it is not 0 the plant has feedthrough.
    Q : array (nx, nx), optional
        Covariance of the process noise of one sample; by default 0.
    R : array (ny, ny), optional
        Covariance of the measurement noise; by default 0.
    sample_time : float
        Seconds.
    initial : mapping, optional
        Initial states by name, 0 otherwise.
    states, inputs, outputs : sequence of str, optional
        Names; by default x1, x2, ..., u1, ... (u if there is one), y1, ... (y if there is one).
    u_limit : float
        Declared range of the inputs, which scenarios use; nothing is clipped.

    Raises
    ------
    InputError
        If shapes do not fit, a value is not finite, or a covariance is not symmetric and positive semidefinite.

    Notes
    -----
    All noise is drawn from the ``rng`` of ``reset``. Steps and batches give the same bits.

    Examples
    --------
    >>> plant = LinearPlant(A=[[0.5]], B=[[1.0]], C=[[2.0]])
    >>> _ = plant.reset(rng=np.random.default_rng(0), x0={"x1": 1.0})
    >>> plant.rollout(np.array([[0.0], [1.0]]))[:, 0].tolist()
    [1.0, 2.5]
    """

    def __init__(
        self,
        *,
        A: Any,
        B: Any,
        C: Any = None,
        D: Any = None,
        Q: Any = None,
        R: Any = None,
        sample_time: float = 0.1,
        initial: Mapping[str, float] | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        u_limit: float = np.inf,
    ) -> None:
        a = np.asarray(A, dtype=float)
        nx = a.shape[0] if a.ndim == 2 else 0
        self.A = _matrix("A", A, nx, nx)
        b = np.asarray(B, dtype=float)
        nu = b.shape[1] if b.ndim == 2 else 0
        self.B = _matrix("B", B, nx, nu)
        c = np.eye(nx) if C is None else np.asarray(C, dtype=float)
        ny = c.shape[0] if c.ndim == 2 else 0
        self.C = _matrix("C", c, ny, nx)
        self.D = np.zeros((ny, nu)) if D is None else _matrix("D", D, ny, nu)
        self._w, self._v = _root("Q", Q, nx), _root("R", R, ny)
        limit = positive("u_limit", u_limit, infinite=True)
        self._direct = bool(self.D.any())
        self._spec = PlantSpec(
            tuple(Channel(n, minimum=-limit, maximum=limit) for n in _names("inputs", inputs, "u", nu)),
            tuple(Channel(n) for n in _names("outputs", outputs, "y", ny)),
            positive("sample_time", sample_time),
            tuple(Channel(n) for n in _names("states", states, "x", nx, lone=False)),
            self._direct,
        )
        self._initial = dict(initial or {})
        initial_values(self._initial, self.spec.states, [0.0] * nx)
        self._rng = np.random.default_rng(0)
        self._x, self._seen = np.zeros(nx), np.zeros(ny)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew; ``x0`` goes before the option ``initial``; returns ``y[0]`` (ny,) with no input."""
        self._need_open()
        given = {**self._initial, **(x0 or {})}
        self._x = np.array(initial_values(given, self.spec.states, [0.0] * len(self._x)))
        self._rng = rng
        self._seen = self._v @ rng.standard_normal(len(self._seen))
        return np.asarray(self.C @ self._x + self._seen)

    def step(self, u: FloatArray) -> FloatArray:
        """Hold ``u`` (nu,) for one sample time; returns the next output (ny,) under the same input."""
        self._need_open()
        if not (isinstance(u, np.ndarray) and u.shape == (self.spec.nu,) and np.isfinite(u).all()):
            refuse_input(u, self.spec)
        y = self._moved(u, self._rng.standard_normal(len(self._x) + len(self._seen)))
        if not np.isfinite(y).all():
            raise PlantError("the state is not finite", status="diverged")
        return y

    def _moved(self, u: FloatArray, drawn: FloatArray) -> FloatArray:
        """Go one sample on; the same operations for a step and for a row of a batch, so that the bits agree."""
        nx = len(self._x)
        with np.errstate(over="ignore", invalid="ignore"):
            self._x = self.A @ self._x + self.B @ u + self._w @ drawn[:nx]
            self._seen = self._v @ drawn[nx:]
            return self.output(u)

    def rollout(self, inputs: FloatArray) -> FloatArray:
        """Apply ``inputs`` (N, nu); row k of the result (N, ny) is what ``step`` returned; NaN once it diverges."""
        return self.rollout_truth(inputs)[0]

    def rollout_truth(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, ny) of ``rollout``, and the true states (N, nx) at the same instants."""
        self._need_open()
        rows = checked_inputs(inputs, self.spec)
        drawn = self._rng.standard_normal((len(rows), len(self._x) + len(self._seen)))
        y, x = np.empty((len(rows), self.spec.ny)), np.empty((len(rows), len(self._x)))
        for k, u in enumerate(rows):
            y[k] = self._moved(u, drawn[k])
            x[k] = self._x
        return y, x

    def output(self, u: FloatArray) -> FloatArray:
        """Return the output (ny,) with ``u`` applied, while no time passes; the measurement noise stays as it is."""
        self._need_open()
        return np.asarray(self.C @ self._x + self.D @ u + self._seen)

    def truth(self) -> FloatArray:
        """Return the true state (nx,)."""
        self._need_open()
        return self._x.copy()

    def get_state(self) -> Any:
        """Return state, present measurement noise and the state of the generator."""
        self._need_open()
        return self._x.copy(), self._seen.copy(), self._rng.bit_generator.state

    def set_state(self, state: Any) -> None:
        """Go back to a state of this same plant object."""
        self._need_open()
        self._x, self._seen = state[0].copy(), state[1].copy()
        self._rng.bit_generator.state = state[2]

    def discrete(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A, B, C."""
        return self.A, self.B, self.C


def _matrix(name: str, given: Any, rows: int, columns: int) -> FloatArray:
    """Return a matrix of finite numbers of the given shape, or refuse it."""
    array = np.array(given, dtype=float)
    if array.shape != (rows, columns) or 0 in array.shape or not np.isfinite(array).all():
        raise InputError(
            f"matrix {name}",
            expected=f"finite numbers of shape ({rows or 'n'}, {columns or 'n'})",
            got=f"shape {array.shape}" if np.isfinite(array).all() else "a value that is not finite",
            remedy="let the rows and columns of A, B, C, D fit each other",
            place=name,
        )
    return array


def _root(name: str, given: Any, n: int) -> FloatArray:
    """Return L with L L^T the covariance; the covariance may be singular."""
    if given is None:
        return np.zeros((n, n))
    covariance = _matrix(name, given, n, n)
    values, vectors = np.linalg.eigh(covariance)
    scale = max(float(np.abs(values).max()), 1e-300)
    if values.min() < -1e-10 * scale or np.abs(covariance - covariance.T).max() > 1e-10 * scale:
        raise InputError(
            f"covariance {name}",
            expected="a symmetric positive semidefinite matrix",
            got=f"eigenvalues from {values.min():.3g} to {values.max():.3g}",
            remedy="give variances on the diagonal",
            place=name,
        )
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _names(option: str, given: Sequence[str] | None, letter: str, n: int, *, lone: bool = True) -> list[str]:
    """Return n names."""
    if given is None:
        return [letter] if n == 1 and lone else [f"{letter}{k + 1}" for k in range(n)]
    if len(given) != n or isinstance(given, str):
        raise InputError(
            f"option {option}", expected=f"{n} names", got=repr(given), remedy="give one for each", place=option
        )
    return list(given)
