"""Controllers designed on a model that is linear in lifted coordinates: LQR, and MPC whose inputs have bounds.

Korda & Mezic 2018 (Automatica 93:149, sec. 5): the output is a linear function of the lifted state, so the costs stay
quadratic, and at every sample the state is lifted anew from what was measured. A model that is linear as it stands is
the same with nothing lifted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.models.lqr import lqr_gain, stabilisable
from harness.protocols import Model
from harness.signals import FloatArray, Trajectory

_CONSTANT = 1e-6  # a function whose part in all but the constant is no larger is the constant itself
_SHOWN = 0.95  # the largest values lie in corners that no record reached, and would hide the rest
HORIZON = 30  # Samples that MPC looks ahead if nothing is said.


@runtime_checkable
class Lifted(Model, Protocol):
    """A model whose first ``lifted`` states move linearly and give the output linearly.

    ``matrices`` are A (nz, nz), B (nz, nu), C (ny, nz) and D (ny, nu) between them.
    """

    @property
    def lifted(self) -> int:
        """Dimension of the lifted state."""
        ...

    @property
    def constant(self) -> int:
        """Which lifted state is the constant function."""
        ...

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B, C and D."""
        ...


def deviations(model: Lifted) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.intp]]:
    """Return A, B, C of deviations from an equilibrium, and which lifted states they keep: all but the constant.

    The constant function keeps itself, whatever its fitted row errs by, no input moves it, and its deviation is 0: no
    design may ask to hold it.
    """
    a, b, c, _ = (np.asarray(matrix, dtype=float) for matrix in model.matrices)
    kept = np.delete(np.arange(len(a)), model.constant)
    return a[np.ix_(kept, kept)], b[kept], c[:, kept], kept


class LiftedController:
    """State feedback on the lifted state: ``u = u* - K (z - z*)`` within the bounds of the inputs, or MPC.

    - ``gain`` (nu, nz): of the deviations that :func:`deviations` keeps
    - ``target`` (ny,): outputs to be held
    - ``hold`` (nu,): inputs that hold them
    - ``plan``: what is solved at every sample instead of the gain

    Notes
    -----
    ``reset`` comes first, with the first output; then ``act`` once a sample.
    """

    def __init__(
        self, model: Lifted, gain: FloatArray, target: FloatArray, hold: FloatArray, plan: _Plan | None = None
    ) -> None:
        self.model, self.gain, self.target, self.hold, self.plan = model, gain, target, hold, plan
        self.low = np.array([channel.minimum for channel in model.spec.inputs])
        self.high = np.array([channel.maximum for channel in model.spec.inputs])
        self._kept = deviations(model)[3]
        self._goal = self._lifted(self._started(target))
        self._x = self._started(target)

    def reset(self, y: FloatArray) -> None:
        """Begin at an output (ny,), at rest before it."""
        self._x = self._started(y)

    def act(self, y: FloatArray) -> FloatArray:
        """Return the input (nu,) for the output (ny,) of this sample."""
        self._x = self.model.correct(self._x, self.hold, y)
        away = self._lifted(self._x) - self._goal
        if self.plan is not None:
            u = self.hold + self.plan.first(away, self.low - self.hold, self.high - self.hold)
        else:
            u = self.hold - self.gain @ away
        u = np.clip(u, self.low, self.high)
        self._x = self.model.step(self._x, u)
        return np.asarray(u)

    def _lifted(self, x: FloatArray) -> FloatArray:
        return np.asarray(x[: self.model.lifted][self._kept])

    def _started(self, y: FloatArray) -> FloatArray:
        record = Trajectory(np.zeros(1), self.hold[None, :], np.asarray(y, dtype=float)[None, :], self.model.spec)
        return self.model.initial_state(record)


@dataclass(frozen=True, eq=False)
class _Plan:
    """The quadratic programme of one sample, as bounded least squares."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    output_root: FloatArray
    input_root: FloatArray
    end_root: FloatArray
    horizon: int

    @cached_property
    def columns(self) -> tuple[FloatArray, FloatArray]:
        """What inputs (N nu) and the state now (nz) do to the weighted outputs, the end and the weighted inputs."""
        n, nz, nu = self.horizon, *self.b.shape
        driven, free = np.zeros((nz, n * nu)), np.eye(nz)
        rows_u: list[FloatArray] = []
        rows_x: list[FloatArray] = []
        for k in range(n):
            driven = self.a @ driven
            driven[:, k * nu : (k + 1) * nu] += self.b
            free = self.a @ free
            root = self.output_root @ self.c if k < n - 1 else self.end_root
            rows_u.append(root @ driven)
            rows_x.append(root @ free)
        rows_u.append(np.asarray(np.kron(np.eye(n), self.input_root), dtype=np.float64))
        rows_x.append(np.zeros((n * nu, nz)))
        return np.vstack(rows_u), np.vstack(rows_x)

    def first(self, away: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return the first input (nu,) of the best plan from a deviation (nz,)."""
        from scipy.optimize import lsq_linear

        of_inputs, of_state = self.columns
        bounds = np.tile(low, self.horizon), np.tile(high, self.horizon)
        found = lsq_linear(of_inputs, -of_state @ away, bounds, method="bvls" if of_inputs.shape[1] < 200 else "trf")
        return np.asarray(found.x[: len(low)], dtype=np.float64)


def lifted_lqr(
    model: Any, *, q: FloatArray, r: FloatArray, target: FloatArray | None = None, hold: FloatArray | None = None
) -> LiftedController | None:
    """Return the LQR in lifted coordinates that holds an output; None where the model has no stabilising one.

    Parameters
    ----------
    model : Lifted
        Such as ``edmdc`` returns.
    q, r : array (ny, ny), (nu, nu)
        Weights of outputs and inputs.
    target, hold : array (ny,), (nu,), optional
        Outputs to be held, and the inputs that hold them; zeros by default.

    Raises
    ------
    InputError
        If the model is not linear in lifted coordinates.
    """
    goal, rest = _point(model, target, hold)
    gain = _gain(model, q, r)
    return None if gain is None else LiftedController(model, gain, goal, rest)


def lifted_mpc(
    model: Any,
    *,
    q: FloatArray,
    r: FloatArray,
    target: FloatArray | None = None,
    hold: FloatArray | None = None,
    horizon: int = HORIZON,
) -> LiftedController | None:
    """Return model predictive control in lifted coordinates, inputs within the ranges that the model's spec declares.

    The cost to go at the end of the horizon is that of the LQR; None where there is none.

    Parameters
    ----------
    model, q, r, target, hold
        As for :func:`lifted_lqr`.
    horizon : int
        Samples.

    Raises
    ------
    InputError
        If the model is not linear in lifted coordinates, or the horizon is below 1.
    """
    from scipy.linalg import solve_discrete_lyapunov

    goal, rest = _point(model, target, hold)
    if horizon < 1:
        raise InputError("horizon of MPC", expected="at least 1 sample", got=str(horizon), remedy="correct it")
    gain = _gain(model, q, r)
    if gain is None:
        return None
    a, b, c, _ = deviations(model)
    cost = solve_discrete_lyapunov((a - b @ gain).T, c.T @ q @ c + gain.T @ r @ gain)
    plan = _Plan(a, b, c, _root(q), _root(r), _root(np.asarray(cost, dtype=np.float64)), horizon)
    return LiftedController(model, gain, goal, rest, plan)


@dataclass(frozen=True, eq=False)
class Eigenfunctions:
    """Functions of the outputs that the model multiplies by one number each sample."""

    values: npt.NDArray[np.complex128]  # (M,): Eigenvalues, complex, the slowest first
    functions: npt.NDArray[np.complex128]  # (M, nz): Rows that turn a lifted state into the values of the functions
    model: Lifted

    def at(self, y: FloatArray) -> npt.NDArray[np.complex128]:
        """Return the functions (..., M) of outputs (..., ny), of a model without delays."""
        y = np.asarray(y, dtype=float)
        lifted = self.model.correct(np.zeros((*y.shape[:-1], self.model.lifted + y.shape[-1])), np.zeros(0), y)
        return np.asarray(lifted[..., : self.model.lifted] @ self.functions.T, dtype=np.complex128)

    def plot(self, low: FloatArray, high: FloatArray, *, count: int = 6, points: int = 121) -> Any:
        """Draw size and phase of the slowest functions over the plane of two outputs.

        Parameters
        ----------
        low, high : array (2,)
            Corners of the plane, in the units of the outputs.
        count : int
            Functions.
        points : int
            Points along each side.

        Raises
        ------
        InputError
            If the model has not two outputs, or remembers past samples.
        """
        from harness.plots import plain_texts, sheet

        outputs = self.model.spec.outputs
        if len(outputs) != 2 or self.model.burn_in:
            raise InputError(
                "eigenfunctions over a plane",
                expected="a model of two outputs without delays",
                got=f"{len(outputs)} outputs, {self.model.burn_in} samples of memory",
                remedy="measure both states, and fit with delays=1",
            )
        x, y = (np.linspace(low[k], high[k], points) for k in range(2))
        values = self.at(np.stack(np.meshgrid(x, y), axis=-1))[..., :count]
        figure = sheet(figsize=(2.6 * values.shape[-1], 5.0), layout="constrained")
        axes = figure.subplots(2, values.shape[-1], squeeze=False, sharex=True, sharey=True)
        for k in range(values.shape[-1]):
            size = np.abs(values[..., k])
            axes[0, k].pcolormesh(
                x, y, size, vmin=0.0, vmax=np.quantile(size, _SHOWN) or 1.0, shading="nearest", rasterized=True
            )
            axes[1, k].pcolormesh(
                x, y, np.angle(values[..., k]), cmap="twilight", vmin=-np.pi, vmax=np.pi, shading="nearest",
                rasterized=True,
            )  # fmt: skip
            axes[0, k].set_title(f"{abs(self.values[k]):.3f} at {np.degrees(np.angle(self.values[k])):.1f} deg", size=8)
            axes[1, k].set_xlabel(str(outputs[0]), size=8)
        axes[0, 0].set_ylabel(f"size; {outputs[1]}", size=8)
        axes[1, 0].set_ylabel(f"phase; {outputs[1]}", size=8)
        return plain_texts(figure)


def eigenfunctions(model: Any) -> Eigenfunctions:
    """Return the Koopman eigenfunctions of a lifted model without input: left eigenvectors of A on the dictionary.

    Williams, Kevrekidis & Rowley 2015 (J. Nonlinear Sci. 25:1307, eq. 14). Of a pair of complex ones the first is
    kept; the constant function is left out.

    Raises
    ------
    InputError
        If the model is not linear in lifted coordinates.
    """
    require_lifted(model)
    kept = deviations(model)[3]
    a = np.eye(model.lifted)  # The constant keeps itself exactly: what its fitted row errs by would pass for a mode.
    a[kept] = np.asarray(model.matrices[0], dtype=float)[kept]
    values, vectors = np.linalg.eig(a.T)
    moving = np.linalg.norm(vectors[kept], axis=0) > _CONSTANT
    order = [k for k in np.argsort(-np.abs(values), kind="stable") if values[k].imag >= 0 and moving[k]]
    return Eigenfunctions(values[order].astype(complex), vectors.T[order].astype(complex), model)


def require_lifted(model: Any) -> None:
    """Raise InputError unless a model is linear in lifted coordinates."""
    if not isinstance(model, Lifted):
        raise InputError(
            f"{type(model).__name__}: not for control in lifted coordinates",
            expected="a model that is linear in lifted coordinates (edmdc)",
            got="another",
            remedy="fit edmdc, or linearise the model about the point to be held",
        )


def _point(model: Any, target: FloatArray | None, hold: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return target and hold of a model that can be used."""
    require_lifted(model)
    goal = np.zeros(model.spec.ny) if target is None else np.asarray(target, dtype=float)
    rest = np.zeros(model.spec.nu) if hold is None else np.asarray(hold, dtype=float)
    if goal.shape != (model.spec.ny,) or rest.shape != (model.spec.nu,):
        raise InputError(
            "point to be held",
            expected=f"target ({model.spec.ny},), hold ({model.spec.nu},)",
            got=f"{goal.shape}, {rest.shape}",
            remedy="give one number for each output and each input",
        )
    return goal, rest


def _gain(model: Lifted, q: FloatArray, r: FloatArray) -> FloatArray | None:
    """Return the gain of the deviations, None where inputs do not reach every mode that does not die away."""
    a, b, c, _ = deviations(model)
    return lqr_gain(a, b, c.T @ q @ c, r) if stabilisable(a, b) else None


def _root(matrix: FloatArray) -> FloatArray:
    """Return a root R of a semidefinite matrix: R' R."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
