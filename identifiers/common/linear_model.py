"""Linear state-space models in innovation form: what every linear identifier returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import least_squares
from harness.errors import InputError
from harness.models.recurrence import recurrence
from harness.models.spread import Matrices, Spread, gains, steps
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from identifiers.common.scaling import Scaling, sizes

# Outputs are not told apart by what a free run leaves of them below this fraction of their size.
_QUIET = 1e-3


def freeze(model: Any, shapes: Mapping[str, tuple[int, ...]], what: str) -> None:
    """Make arrays of a frozen dataclass float64 and read-only, and refuse those of another shape."""
    for name, shape in shapes.items():
        array = np.array(getattr(model, name), dtype=float)
        if array.shape != shape:
            raise InputError(
                f"{name} of {what}",
                expected=f"shape {shape}",
                got=str(array.shape),
                remedy="give matrices of one state dimension",
            )
        array.flags.writeable = False
        object.__setattr__(model, name, array)


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
    spread : Spread, optional
        Neighbours of the model, from which every interval follows (:mod:`harness.models.spread`).
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
    spread: Spread | None = None

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
        freeze(self, shapes, "a linear model")

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D."""
        return self.a_matrix, self.b_matrix, self.c_matrix, self.d_matrix

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
        # Every state counts by what it does and every output by its size, then by what the free run leaves of it: no
        # unit decides, and an output that is mostly noise does not either.
        size = sizes([data[:count].y])
        weight, target = 1.0 / size, data.y[:count] - forced
        found = np.zeros(nx)
        for last in (False, True):
            rows = (observed * weight[:, None]).reshape(-1, nx)
            found = least_squares(rows, (target * weight).ravel(), 1e-10)
            if last or self.spec.ny == 1:
                break
            left = np.sqrt(np.mean((target - observed @ found) ** 2, axis=0))
            weight = 1.0 / np.maximum(left, _QUIET * size)
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
        return self.output(recurrence(self.a_matrix, x, u @ self.b_matrix.T + self.state_offset), u)

    def filtered(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the states (N, nx), each after its output was seen, under inputs u (N, nu) and outputs y (N, ny)."""
        kept = np.eye(len(self.a_matrix)) - self.filter_gain @ self.c_matrix
        seen = (y - u @ self.d_matrix.T - self.output_offset) @ self.filter_gain.T
        driven = seen @ self.a_matrix.T + u @ self.b_matrix.T + self.state_offset
        states: FloatArray = recurrence(self.a_matrix @ kept, x[None], driven[None])[0] @ kept.T + seen
        return states

    def in_units(self, scaling: Scaling) -> LinearModel:
        """Return this model, fitted to scaled records, for records in their own units."""
        u, y = scaling.inputs, scaling.outputs
        return replace(
            self,
            b_matrix=self.b_matrix / u,
            c_matrix=self.c_matrix * y[:, None],
            d_matrix=self.d_matrix * y[:, None] / u,
            filter_gain=self.filter_gain / y,
            output_offset=self.output_offset * y,
            spread=None if self.spread is None else self.spread.scaled(u, y),
        )

    def centred(self) -> LinearModel:
        """Return the model of deviations from its equilibrium, without offsets (what control design wants)."""
        nx = self.a_matrix.shape[0]
        return replace(self, state_offset=np.zeros(nx), output_offset=np.zeros(self.spec.ny))

    def impulse_response(self, length: int) -> FloatArray:
        """Return the Markov parameters ``D, C B, C A B, ...``, shape (length, ny, nu)."""
        return steps(self.matrices, length, "impulse")

    def frequency_response(self, frequency: FloatArray) -> npt.NDArray[np.complex128]:
        """Return ``C (z I - A)^-1 B + D`` at frequencies [Hz], shape (F, ny, nu)."""
        return gains(self.matrices, frequency, self.spec.sample_time)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        arrays = ("a_matrix", "b_matrix", "c_matrix", "d_matrix", "filter_gain", "state_offset", "output_offset")
        return {
            "kind": "linear",
            "spec": spec_to_dict(self.spec),
            **{name: getattr(self, name).tolist() for name in arrays},
            "burn_in": self.burn_in,
            "notes": self.notes,
            **({} if self.spread is None else {"spread": self.spread.to_dict(self)}),
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
        kept = content.get("spread")
        middle = (arrays["a_matrix"], arrays["b_matrix"], arrays["c_matrix"], arrays["d_matrix"])
        spread = None if kept is None else Spread.from_dict(kept, middle)
        return cls(spec, **arrays, burn_in=int(content["burn_in"]), notes=dict(content.get("notes", {})), spread=spread)
