"""Linear models: state-space in innovation form, least squares on measured states, ARX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.records import lagged, lagged_blocks, moving, real_signals, usable
from identifiers.regression import Solution, solve

__all__ = ["Arx", "LinearModel", "StateLeastSquares"]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """``x+ = A x + B u + a``, ``y = C x + D u + c``; a seen output corrects the state by ``L (y - C x - D u - c)``.

    Parameters
    ----------
    spec : PlantSpec
    a_matrix, b_matrix, c_matrix, d_matrix : array (nx, nx), (nx, nu), (ny, nx), (ny, nu)
    filter_gain : array (nx, ny)
        L; zero for a model that was fitted to free runs only.
    state_offset, output_offset : array (nx,), (ny,)
        Constants, for records around an operating point.
    burn_in : int
        Samples of a record that the memory of the model reaches back.
    notes : dict
        Condition numbers, singular values, what the fit wants to say.
    """

    spec: PlantSpec
    a_matrix: FloatArray
    b_matrix: FloatArray
    c_matrix: FloatArray
    d_matrix: FloatArray
    filter_gain: FloatArray
    state_offset: FloatArray
    output_offset: FloatArray
    burn_in: int = 0
    notes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nx = np.shape(self.a_matrix)[0]
        nu, ny = self.spec.nu, self.spec.ny
        shapes = {
            "a_matrix": (nx, nx),
            "b_matrix": (nx, nu),
            "c_matrix": (ny, nx),
            "d_matrix": (ny, nu),
            "filter_gain": (nx, ny),
            "state_offset": (nx,),
            "output_offset": (ny,),
        }
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape:
                raise InputError(
                    f"{name} of a linear model",
                    expected=f"shape {shape}",
                    got=str(array.shape),
                    remedy="give matrices of one state dimension",
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def eigenvalues(self) -> npt.NDArray[np.complex128]:
        """Eigenvalues of A (nx,), complex, by falling modulus."""
        values = np.linalg.eigvals(self.a_matrix).astype(np.complex128)
        return values[np.argsort(-np.abs(values), kind="stable")]

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx,) whose free run fits the start of the record best (least squares, least norm)."""
        same_language(self.spec, data)
        nx = self.a_matrix.shape[0]
        count = min(len(data), max(50, 4 * nx))
        # Unstable modes: beyond this the free response swamps the rest of the regression.
        radius = float(np.abs(np.linalg.eigvals(self.a_matrix)).max()) if nx else 0.0
        if radius > 1.0:
            count = min(count, max(nx + 1, int(np.log(1e6) / np.log(radius))))
        count = max(1, min(count, len(data)))
        forced = self.free_run(np.zeros((1, nx)), data.u[None, :count])[0]
        observed = np.empty((count, self.spec.ny, nx))
        power = self.c_matrix.copy()
        for k in range(count):
            observed[k] = power
            power = power @ self.a_matrix
        target = (data.y[:count] - forced).ravel()
        found: FloatArray = np.linalg.lstsq(observed.reshape(-1, nx), target, rcond=1e-10)[0]
        return found

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        y: FloatArray = x @ self.c_matrix.T + u @ self.d_matrix.T + self.output_offset
        return y

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx)."""
        new: FloatArray = x @ self.a_matrix.T + u @ self.b_matrix.T + self.state_offset
        return new

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx) after an output was seen."""
        new: FloatArray = x + (y - self.output(x, u)) @ self.filter_gain.T
        return new

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx) under inputs u (M, N, nu)."""
        m, n = u.shape[:2]
        driven = u @ self.b_matrix.T + self.state_offset
        states = np.empty((m, n, self.a_matrix.shape[0]))
        transposed = np.ascontiguousarray(self.a_matrix.T)
        state = np.array(np.broadcast_to(x, (m, self.a_matrix.shape[0])))
        for k in range(n):
            states[:, k] = state
            state = state @ transposed + driven[:, k]
        y: FloatArray = states @ self.c_matrix.T + u @ self.d_matrix.T + self.output_offset
        return y

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        arrays = ("a_matrix", "b_matrix", "c_matrix", "d_matrix", "filter_gain", "state_offset", "output_offset")
        return {
            "kind": "linear",
            "spec": spec_to_dict(self.spec),
            **{name: getattr(self, name).tolist() for name in arrays},
            "burn_in": self.burn_in,
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> LinearModel:
        """Return the model of a description."""
        spec = spec_from_dict(content["spec"])
        nx = len(content["a_matrix"])
        shapes = {"b_matrix": (nx, spec.nu), "d_matrix": (spec.ny, spec.nu), "c_matrix": (spec.ny, nx)}
        names = ("a_matrix", "b_matrix", "c_matrix", "d_matrix", "filter_gain", "state_offset", "output_offset")
        arrays = {name: np.array(content[name], dtype=float) for name in names}
        for name, shape in shapes.items():
            arrays[name] = arrays[name].reshape(shape)
        return cls(spec, **arrays, burn_in=int(content["burn_in"]), notes=dict(content.get("notes", {})))


@dataclass(frozen=True)
class StateLeastSquares:
    """Linear model from measured states: ``y[k+1] = A y[k] + B u[k] + a`` by least squares, rank-aware.

    Under pure state feedback the input is a linear function of the state and A and B cannot be told apart; sensor
    noise then makes the rank full while the answer is wrong. So the data are refused when their least excited direction
    is no larger than the equation's own residual. Sensor noise alone gives a ratio below 1 there; noise of ratio r
    biases the answer by about 1 / r^2 in that direction.

    Parameters
    ----------
    offset : bool
        Fit a constant too.
    method : {"ls", "iv", "tls", "l1", "linf"}
        Least squares; instrumental variables or total least squares, which white noise on the outputs does not bias
        where it biases least squares at any length of the record; least sum of absolute errors, which bears outliers;
        least largest error.
    least_excitation : float
        Least ratio of the smallest singular value of the regressors (each column scaled to rms 1, so that white data
        have all of them at 1) to the largest residual rms (relative to its output's rms).

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.array([[1.0], [-1.0], [2.0], [0.5], [0.0]])
    >>> y = np.zeros((5, 1))
    >>> for k in range(4):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> data = Trajectory(np.arange(5.0), u, y, spec)
    >>> model = StateLeastSquares().fit([data], rng=np.random.default_rng(0))
    >>> model.a_matrix.round(12).tolist(), model.b_matrix.round(12).tolist()
    ([[0.5]], [[2.0]])
    """

    offset: bool = False
    method: Literal["ls", "iv", "tls", "l1", "linf"] = "ls"
    least_excitation: float = 2.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a model whose state is the output."""
        what = "least-squares"
        records, spec = usable(trajectories, samples=2, what=what)
        real_signals(spec, what)
        moving(records, what)
        if self.method not in ("ls", "iv", "tls", "l1", "linf"):
            raise FitError(
                f"{what}: method", expected="ls, iv, tls, l1 or linf", got=repr(self.method), remedy="use one of these"
            )
        solution = _one_step(records, 1, self.offset, 0.0, what)
        if self.method in ("ls", "tls"):
            _refuse_poor_excitation(records, solution, self.least_excitation, what)
        theta = self._coefficients(records, solution, what).T
        ny, nu = spec.ny, spec.nu
        return LinearModel(
            spec,
            theta[:, :ny],
            theta[:, ny : ny + nu],
            np.eye(ny),
            np.zeros((ny, nu)),
            np.eye(ny),
            theta[:, ny + nu] if self.offset else np.zeros(ny),
            np.zeros(ny),
            notes={**_notes(solution), "method": self.method if self.method != "ls" else solution.method},
        )

    def _coefficients(self, records: list[Trajectory], solution: Solution, what: str) -> FloatArray:
        """Return the coefficients (p, ny) under the criterion chosen."""
        from identifiers import criteria

        if self.method == "ls":
            return solution.coefficients
        if self.method == "iv":
            return criteria.instrumental_variables(records, self.offset, what)
        if self.method == "tls":
            return criteria.total_least_squares(records, self.offset, what)
        x = np.concatenate([_design(one, 1, self.offset) for one in records])
        y = np.concatenate([one.y[1:] for one in records])
        return criteria.absolute_deviations(x, y, what, largest=self.method == "linf")


@dataclass(frozen=True)
class Arx:
    """ARX model of one order for all channels; the order by validation where none is given.

    Parameters
    ----------
    order : int, optional
        Number of past outputs and inputs. Without it the orders 1, 2, 3, 4, 6, 8, 12 are tried and the one with the
        least one-step error on the last third of the records wins (Ljung 1999, sec. 16.4).
    offset : bool
        Fit a constant too.
    ridge : float
        Tikhonov weight, for records that do not excite all lags.
    """

    order: int | None = None
    offset: bool = True
    ridge: float = 0.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a model whose state is the past outputs and inputs."""
        what = "arx"
        records, spec = usable(trajectories, samples=4, what=what)
        real_signals(spec, what)
        moving(records, what, inputs=False)
        order = self._order(records) if self.order is None else self.order
        if order < 1:
            raise FitError(f"{what}: order", expected="at least 1", got=str(order), remedy="raise it")
        records, _ = usable(records, samples=order + 2, what=what)
        solution = _one_step(records, order, self.offset, self.ridge, what)
        return lag_model(spec, solution, order, self.offset, {"order": order})

    def _order(self, records: list[Trajectory]) -> int:
        """Return the order that predicts the last third of the records best."""
        cuts = [(one[: 2 * len(one) // 3], one[2 * len(one) // 3 :]) for one in records]
        best = (np.inf, 1)
        for order in (1, 2, 3, 4, 6, 8, 12):
            fit = [head for head, _ in cuts if len(head) > order + 1]
            held = [tail for _, tail in cuts if len(tail) > order + 1]
            if not fit or not held:
                break
            try:
                theta = _one_step(fit, order, self.offset, self.ridge, "arx").coefficients
            except FitError:
                break
            wrong = [one.y[order:] - _design(one, order, self.offset) @ theta for one in held]
            spread = np.concatenate([one.y for one in held]).std(axis=0)
            error = float(np.mean((np.concatenate(wrong) / np.where(spread > 0, spread, 1.0)) ** 2))
            if error < 0.98 * best[0]:
                best = (error, order)
        return best[1]


def lag_model(
    spec: PlantSpec, solution: Solution, lags: int, offset: bool, notes: dict[str, Any] | None = None
) -> LinearModel:
    """Return the state-space form of ``y[k+1] = theta [lags of y, lags of u, 1]``.

    The state is ``[y[k], ..., y[k - lags + 1], u[k - 1], ..., u[k - lags + 1]]``.
    """
    ny, nu = spec.ny, spec.nu
    theta = solution.coefficients.T
    past = lags * ny
    nx = past + (lags - 1) * nu
    a, b = np.zeros((nx, nx)), np.zeros((nx, nu))
    a[:ny, :past] = theta[:, :past]
    b[:ny] = theta[:, past : past + nu]
    a[:ny, past:] = theta[:, past + nu : past + lags * nu]
    a[ny:past, : past - ny] = np.eye(past - ny)
    if lags > 1:
        b[past : past + nu] = np.eye(nu)
        a[past + nu :, past : nx - nu] = np.eye((lags - 2) * nu)
    c = np.zeros((ny, nx))
    c[:, :ny] = np.eye(ny)
    state_offset = np.zeros(nx)
    if offset:
        state_offset[:ny] = theta[:, -1]
    return LinearModel(
        spec,
        a,
        b,
        c,
        np.zeros((ny, nu)),
        c.T.copy(),
        state_offset,
        np.zeros(ny),
        burn_in=lags - 1,
        notes={**(notes or {}), **_notes(solution)},
    )


def _design(record: Trajectory, lags: int, offset: bool) -> FloatArray:
    """Return the regressors of one record (N - lags, p)."""
    rows = lagged(record, lags)
    return np.hstack([rows, np.ones((rows.shape[0], 1))]) if offset else rows


def _one_step(records: Sequence[Trajectory], lags: int, offset: bool, ridge: float, what: str) -> Solution:
    """Solve for the next output from lagged outputs and inputs."""
    return solve(lambda: lagged_blocks(records, lags, offset=offset), what, ridge=ridge)


def _refuse_poor_excitation(records: Sequence[Trajectory], solution: Solution, least: float, what: str) -> None:
    """Raise if the least excited direction of [y, u] could be noise."""
    rows = np.concatenate([_design(one, 1, False) for one in records])
    scale = np.sqrt(np.mean(rows**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    values = np.linalg.svd(rows / scale, compute_uv=False) / np.sqrt(rows.shape[0])
    y_scale = scale[: records[0].spec.ny]
    noise = float(np.max(solution.residual_rms / y_scale))
    if values[-1] < least * noise:
        raise FitError(
            f"{what}: the data do not determine the model",
            expected=f"every direction of states and inputs excited {least:g} times above the residual ({noise:.2e})",
            got=f"the weakest at {values[-1]:.2e} of full size: rank {int(np.sum(values >= least * noise))} of "
            f"{values.size}",
            remedy="add an excitation to what the controller commands",
        )


def _notes(solution: Solution) -> dict[str, Any]:
    """Return what a report should say of a regression."""
    return {
        "condition": solution.condition,
        "method": solution.method,
        "residual_rms": solution.residual_rms.tolist(),
        "samples": solution.rows,
    }
