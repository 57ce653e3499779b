"""Residual physics: a mechanism with its lumped parameters, and what forces remain as functions of its motion."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.algebra import column_norms
from harness.errors import FitError, as_described
from harness.models.estimate import Estimate
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.normal import NormalEquations
from identifiers.common.records import learnable
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.lumped import Form, Lumped
from identifiers.mechanics.lumped_estimate import lumped_unit
from identifiers.mechanics.lumped_rows import instants, weighted
from identifiers.mechanics.motion import Smoothing, motion
from identifiers.mechanics.physical import Recipe, recipe_for
from identifiers.mechanics.residual_basis import Basis, Kind, basis_of
from identifiers.sparse.selection import best_subset, lasso

if TYPE_CHECKING:
    from harness.physics import LumpedModel, System

Choice = Literal["ridge", "lasso", "best-subset"]
FOLDS = 5  # Stretches of the records that are left out in turn; not single rows, because neighbours share their noise.
WIDTHS = (1.0, 2.0, 4.0)
"""Widths tried, in distances between neighbouring centres: from functions that hardly touch to smooth ones."""
RIDGES = np.logspace(-8, 2, 21)  # Ridge weights tried, relative to the mean square of the functions' columns.


@dataclass(frozen=True)
class ResidualRecipe(Recipe):
    """A mechanism with residual forces."""

    forces: tuple[tuple[str, Basis, FloatArray], ...] = field(default=(), compare=False)
    """tuple of (str, Basis, array): Coordinate, functions, weights in the unit of its force."""

    def system(self, spec: PlantSpec) -> System:
        """Return the system that speaks like a spec, the residual forces built in."""
        import casadi as ca

        plain = super().system(spec)
        added: dict[str, Any] = {}
        for name, basis, weights in self.forces:
            used = np.flatnonzero(weights)
            small = replace(basis, centres=basis.centres[used], widths=basis.widths[used])
            if used.size:
                added[name] = ca.dot(ca.SX(weights[used]), small.symbolic(plain.x))
        return plain.rebuild(forces=added) if added else plain

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        rows = [
            {"coordinate": name, "basis": basis.to_dict(), "weights": weights.tolist()}
            for name, basis, weights in self.forces
        ]
        return {**super().to_dict(), "forces": rows}


@dataclass(frozen=True, eq=False)
class ResidualModel(GreyBoxModel):
    """A grey box with residual forces; see :class:`GreyBoxModel`."""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {**super().to_dict(), "kind": "residual-physics"}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> ResidualModel:
        """Return the model of a description; raises InputError if it is none."""
        plain = GreyBoxModel.from_dict(content)
        with as_described("a residual-physics model"):
            forces = tuple(
                (str(force["coordinate"]), Basis.from_dict(force["basis"]), np.array(force["weights"], dtype=float))
                for force in content["forces"]
            )
        own = plain.recipe
        recipe = ResidualRecipe(own.model, own.options, own.outputs, own.effects, forces=forces)
        return cls(
            plain.spec, recipe, plain.parameters, plain.filter_gain, plain.intersample, plain.substeps, plain.notes
        )


@dataclass(frozen=True)
class ResidualPhysics:
    """A mechanism whose lumped parameters are fitted together with a residual force on each coordinate.

    The residual force is a sum of radial functions of position and rate, whose centres are instants of the records and
    which vanish outside of them: there the mechanism alone remains. By default the lumped parameters are fitted first
    and explain what they can; with ``joint`` they are fitted together with the functions, which then may take over what
    the mechanism should explain. The functions are held small by ridge regression, or by taking few of them. Weight,
    width and number are those of least error on stretches that were left out.

    Parameters
    ----------
    model : str, optional
        A mechanism; by default the built-in one with the signals of the records.
    functions : int
        Radial functions of each coordinate.
    basis : {"gaussian", "wavelet"}
    choice : {"ridge", "lasso", "best-subset"}
        All functions held small; those on the LASSO path of least extended BIC; or the best subset of up to ``most``.
    most : int
        Of the best subset.
    features : {"own", "all"}
        A coordinate's own position and rate, or those of all coordinates.
    joint : bool
        Fit lumped parameters and functions together.
    form : {"torque", "energy", "momentum"}
        Of the equations, as of the lumped forms; the energy form has one equation for all coordinates.
    known : mapping, optional
        Physical parameters that are known, by name.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal"}

    Notes
    -----
    ``notes`` of the model: ``held_out``, the rms error of the equations on stretches left out, in units of that of the
    mechanism alone, by number of functions (the first entry is the mechanism alone); ``width`` and ``ridge`` chosen;
    ``functions``, how many each coordinate uses.
    """

    model: str | None = None
    functions: int = 20
    basis: Kind = "gaussian"
    choice: Choice = "ridge"
    most: int = 6
    features: Literal["own", "all"] = "own"
    joint: bool = False
    form: Form = "momentum"
    known: Mapping[str, float] | None = None
    smoothing: Smoothing = "auto"

    def __post_init__(self) -> None:
        check_options(self, "residual-physics", functions=">= 1", most=">= 1")

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> ResidualModel:
        """Return the mechanism with its residual forces.

        Raises
        ------
        FitError
            If the model is no mechanism, its signals are not those of the records, or the records are too short.
        """
        what = "residual-physics"
        records, spec = learnable(trajectories, samples=12, what=what, inputs=False)
        recipe = recipe_for(spec, what, model=self.model)
        system = recipe.system(spec)
        equations = Lumped(self.form, model=self.model, known=self.known, smoothing=self.smoothing)
        nominal = equations.regression_of(system)
        moved = [motion(system, record, self.smoothing) for record in records]
        path = np.concatenate([np.hstack([smoothed.q, smoothed.v]) for smoothed in moved])
        n = 1 if self.form == "energy" else nominal.n
        plain, target = equations.stacked(nominal, moved, records)
        theta, white = weighted(plain, target, np.eye(nominal.k), n)
        residual = white @ instants((target - plain @ theta)[:, None], n)
        unit = float(np.sqrt(np.mean(residual**2))) or 1.0
        best: tuple[float, _Solved, list[Basis], float] | None = None
        for width in WIDTHS:
            bases = self._bases(nominal, path, width)
            wide = self._widened(nominal, bases)
            phi = equations.stacked(wide, moved, records)[0]
            if not (np.isfinite(phi).all() and np.isfinite(target).all()):
                raise FitError(what, expected="finite equations", got="NaN or infinity", remedy="cut the records")
            rows = (white @ instants(phi, n)).reshape(phi.shape) / unit
            known = (white @ instants(target[:, None], n)).reshape(-1) / unit
            if self.joint:
                solved = self._solved(rows, known, nominal.k)
            else:
                own = rows[:, nominal.k :]
                solved = self._solved(own, known - rows[:, : nominal.k] @ theta, 0)
                solved = replace(solved, theta=np.concatenate([theta, solved.theta]))
            if best is None or solved.error < best[0]:
                best = solved.error, solved, bases, width
        assert best is not None
        _, solved, bases, width = best
        return self._model(spec, recipe, records, nominal, system, equations, bases, solved, width)

    def _bases(self, nominal: LumpedModel, path: FloatArray, width: float) -> list[Basis]:
        """Return the functions of each coordinate."""
        n = nominal.n
        every = tuple(range(2 * n))
        return [
            basis_of(self.basis, (row, n + row) if self.features == "own" else every, path, self.functions, width)
            for row in range(n)
        ]

    def _widened(self, nominal: LumpedModel, bases: list[Basis]) -> LumpedModel:
        """Return the lumped model with the functions as force columns, coordinate after coordinate."""
        names = [f"{nominal.mechanism.q[row]}_{k}" for row, basis in enumerate(bases) for k in range(basis.k)]

        def columns(q: FloatArray, v: FloatArray, u: FloatArray, t: FloatArray) -> FloatArray:
            found = np.zeros((len(q), nominal.n, len(names)))
            first = 0
            for row, basis in enumerate(bases):
                found[:, row, first : first + basis.k] = basis.values(q, v)
                first += basis.k
            return found

        return nominal.with_force_columns(names, columns)

    def _solved(self, rows: FloatArray, known: FloatArray, k: int) -> _Solved:
        """Return lumped values and weights of least error on stretches left out, the lumped values free."""
        held = [(0, self._alone(rows, known, k))]
        if self.choice == "ridge":
            theta, error, ridge = _best_ridge(rows, known, k)
            return _Solved(theta, error, ridge, [*held, (rows.shape[1] - k, error)])
        supports = [self._few(rows, known, k)]
        if self.choice == "best-subset":
            supports = [self._few(rows, known, k, count) for count in range(1, self.most + 1)]
        best = np.zeros(0), held[0][1], 0.0, list[int]()
        for keep in supports:
            if not keep or len(keep) in (count for count, _ in held):
                continue
            # chosen functions overlap: without any ridge they may grow large against each other
            own, error, ridge = _best_ridge(rows[:, [*range(k), *(k + index for index in keep)]], known, k)
            held.append((len(keep), error))
            if error < best[1]:
                best = own, error, ridge, keep
        theta = np.zeros(rows.shape[1])
        if best[3]:
            theta[[*range(k), *(k + index for index in best[3])]] = best[0]
        elif k:
            theta[:k] = _ridge(rows[:, :k], known, k, 0.0)
        return _Solved(theta, best[1], best[2], sorted(held))

    def _alone(self, rows: FloatArray, known: FloatArray, k: int) -> float:
        """Return the error of the mechanism alone on stretches left out."""
        return _left_out(rows[:, :k], known, lambda a, b: _ridge(a, b, k, 0.0))

    def _few(self, rows: FloatArray, known: FloatArray, k: int, most: int | None = None) -> list[int]:
        """Return the functions chosen beside the lumped parameters, which are projected out (Frisch & Waugh 1933)."""
        lumps = np.linalg.qr(rows[:, :k])[0] if k else np.zeros((len(rows), 0))
        free, target = rows[:, k:], known
        free = free - lumps @ (lumps.T @ free)
        target = target - lumps @ (lumps.T @ target)
        equations = NormalEquations.of([(free.T, target[None])], free.shape[1], 1)
        support = lasso(equations)[1] if self.choice == "lasso" else best_subset(equations, most or self.most)[1]
        return np.flatnonzero(support[:, 0]).tolist()

    def _model(
        self,
        spec: PlantSpec,
        recipe: Recipe,
        records: list[Trajectory],
        nominal: LumpedModel,
        system: System,
        equations: Lumped,
        bases: list[Basis],
        solved: _Solved,
        width: float,
    ) -> ResidualModel:
        values = dict(zip(nominal.names, solved.theta[: nominal.k].tolist(), strict=True))
        parameters = {**nominal.to_parameters(values), **equations.known_of(system)}
        forces, first = [], nominal.k
        for coordinate, basis in zip(system.coordinates, bases, strict=True):
            forces.append((coordinate.name, basis, solved.theta[first : first + basis.k]))
            first += basis.k
        record = Estimate(
            nominal.names,
            tuple(lumped_unit(system, combination) for combination in nominal.combinations),
            solved.theta[: nominal.k],
            method="no intervals: the residual functions share the forces with the parameters",
        )
        notes: dict[str, Any] = {
            "estimate": record.to_dict(),
            "held_out": [[int(count), float(error)] for count, error in solved.held_out],
            "width": width,
            "ridge": solved.ridge,
            "functions": [int(np.count_nonzero(weights)) for _, _, weights in forces],
        }
        own = ResidualRecipe(recipe.model, recipe.options, recipe.outputs, recipe.effects, forces=tuple(forces))
        model = ResidualModel(spec, own, parameters, notes=notes)
        return replace(model, filter_gain=tuned_gain(model, records))


@dataclass(frozen=True, eq=False)
class _Solved:
    """Lumped values and weights, their error on stretches left out, the ridge, and that error by number."""

    theta: FloatArray
    error: float
    ridge: float
    held_out: list[tuple[int, float]]


def _ridge(rows: FloatArray, known: FloatArray, k: int, ridge: float) -> FloatArray:
    """Return least squares in which all but the first k columns are held small."""
    if not rows.shape[1]:
        return np.zeros(0)
    size = column_norms(rows)
    scaled = rows / size
    penalty = np.sqrt(ridge) * np.eye(rows.shape[1])[k:]
    stacked, target = np.vstack([scaled, penalty]), np.concatenate([known, np.zeros(len(penalty))])
    return np.asarray(np.linalg.lstsq(stacked, target, rcond=1e-12)[0] / size)


def _best_ridge(rows: FloatArray, known: FloatArray, k: int) -> tuple[FloatArray, float, float]:
    """Return the ridge regression of least error on stretches left out, that error, and the ridge."""
    errors = [_left_out(rows, known, lambda a, b, r=ridge: _ridge(a, b, k, r)) for ridge in RIDGES]
    place = int(np.argmin(errors))
    return _ridge(rows, known, k, float(RIDGES[place])), errors[place], float(RIDGES[place])


def _left_out(rows: FloatArray, known: FloatArray, fit: Any) -> float:
    """Return the rms error on stretches that were left out of the fit."""
    edges = np.linspace(0, len(rows), FOLDS + 1).astype(int)
    total = 0.0
    for low, high in itertools.pairwise(edges.tolist()):
        inside = np.r_[0:low, high : len(rows)]
        theta = fit(rows[inside], known[inside])
        total += float(np.sum((known[low:high] - rows[low:high] @ theta) ** 2))
    return float(np.sqrt(total / len(rows)))
