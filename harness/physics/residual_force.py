"""A force without a name, learned on what a closed loop leaves unexplained: labelled as not physical, with its hull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.physics.output_error import fit_output_error, simulate_error
from harness.physics.parameters import Parameter
from harness.physics.windows import data_states
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from harness.physics.system import System

__all__ = ["LABEL", "Hull", "LearnedForce", "ResidualForce", "learn_residual_force"]

LABEL = "learned from data, not physical"
"""What every report and file says of such a force."""

SIZES = (6, 12, 24)
"""Numbers of bumps that are tried: a smooth curve, one with corners, a surface. The validation records choose. Curves
(one argument) are not tried with more than 12: their bumps would be closer than what data with noise tell apart."""

_MOST_ON_A_LINE = 12

_WIDTH = 1.5
"""Width of a bump in distances to its nearest neighbour: less leaves gaps, more makes weights large and opposite."""

_MOST_FACES = 4
"""Dimensions up to which the hull is convex; beyond, its faces are too many, and a box serves."""

_HULL_POINTS = 20_000
"""Samples from which a hull is made: evenly thinned, it keeps all that records a few times longer would show."""


@dataclass(frozen=True, eq=False)
class Hull:
    """Where the data of a learned force lie: ``faces @ z + offsets <= 0`` for its arguments z.

    Parameters
    ----------
    faces : array (F, d)
    offsets : array (F,)
    convex : bool
        False where it is the box of the data.
    low, high : array (d,)
        The box.
    """

    faces: FloatArray
    offsets: FloatArray
    convex: bool
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> Hull:
        """Return the hull of rows (n, d): convex up to four dimensions, else a box.

        Examples
        --------
        >>> hull = Hull.of(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        >>> hull.contains(np.array([[0.2, 0.2], [0.9, 0.9]])).tolist()
        [True, False]
        """
        from scipy.spatial import ConvexHull, QhullError

        low, high = rows.min(axis=0), rows.max(axis=0)
        size = np.where(high > low, high - low, 1.0)
        dimensions = rows.shape[1]
        eye = np.eye(dimensions)
        box = cls(np.vstack([-eye, eye]), np.concatenate([low, -high]), False, low, high)
        if not 2 <= dimensions <= _MOST_FACES:
            return box
        thinned = rows[:: max(1, len(rows) // _HULL_POINTS)] / size
        try:
            equations = ConvexHull(thinned).equations
        except QhullError:
            return box  # flat data: a column that follows another
        return cls(equations[:, :-1] / size, equations[:, -1], True, low, high)

    def contains(self, rows: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which rows (n, d) lie inside."""
        return np.asarray((np.asarray(rows) @ self.faces.T + self.offsets <= 1e-9).all(axis=1))


@dataclass(frozen=True, eq=False)
class ResidualForce:
    """``F = sum_i w_i exp(-|(z - c_i) / width|^2 / 2)`` added to the force on one coordinate; not physical.

    Far from the data the bumps, and with them the force, are 0: there the model is the named one alone.

    Parameters
    ----------
    coordinate : str
        The equation of motion that it is added to.
    unit : str
        Of the force.
    arguments : tuple of str
        States and inputs that z is made of, by name.
    centres : array (M, d)
    width : array (d,)
    weights : array (M,)
        In ``unit``.
    hull : Hull
        Of the z in the estimation data.
    samples : int
        Estimation samples.
    """

    coordinate: str
    unit: str
    arguments: tuple[str, ...]
    centres: FloatArray
    width: FloatArray
    weights: FloatArray
    hull: Hull
    samples: int

    label = LABEL

    def __str__(self) -> str:
        sides = ", ".join(
            f"{name} in [{low:.3g}, {high:.3g}]"
            for name, low, high in zip(self.arguments, self.hull.low, self.hull.high, strict=True)
        )
        return f"force on {self.coordinate} [{self.unit}] of {len(self.weights)} bumps, {LABEL}; known for {sides}"

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Return the force (n,) at arguments (n, d)."""
        scaled = (np.asarray(rows)[:, None, :] - self.centres) / self.width
        return np.asarray(np.exp(-0.5 * np.sum(scaled**2, axis=2)) @ self.weights)

    def rows(self, system: System, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the arguments (n, d) in states x (n, nx) under inputs u (n, nu)."""
        return np.hstack([x, u])[:, _columns(system, self.arguments)]

    def attach(self, system: System) -> System:
        """Return the system with the force built in; its weights are parameters ``learned@COORDINATE.wI``.

        Raises
        ------
        InputError
            If the system lacks the coordinate or an argument, or has such a force already.
        """
        joint = ca.vertcat(system.x, system.u)
        z = ca.vertcat(*[joint[column] for column in _columns(system, self.arguments)])
        total, parameters = ca.SX(0.0), []
        for number, (centre, weight) in enumerate(zip(self.centres, self.weights, strict=True)):
            symbol = ca.SX.sym(f"learned_{self.coordinate}_{number}")
            name = f"learned@{self.coordinate}.w{number}"
            parameters.append((Parameter(name, self.unit, float(weight)), symbol))
            scaled = (z - ca.DM(centre)) / ca.DM(self.width)
            total += symbol * ca.exp(-0.5 * ca.dot(scaled, scaled))
        return system.rebuild(forces={self.coordinate: total}, parameters=parameters)

    def with_weights(self, parameters: Mapping[str, float]) -> ResidualForce:
        """Return the force with the weights found among the parameters of the attached system."""
        names = [f"learned@{self.coordinate}.w{number}" for number in range(len(self.weights))]
        return replace(self, weights=np.array([parameters[name] for name in names]))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description; it says what the force is not."""
        hull = {name: getattr(self.hull, name).tolist() for name in ("faces", "offsets", "low", "high")}
        return {
            "label": LABEL,
            "coordinate": self.coordinate,
            "unit": self.unit,
            "arguments": list(self.arguments),
            "centres": self.centres.tolist(),
            "width": self.width.tolist(),
            "weights": self.weights.tolist(),
            "hull": {**hull, "convex": self.hull.convex},
            "samples": self.samples,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> ResidualForce:
        """Return the force of a description."""
        hull = content["hull"]
        sides = {name: np.array(hull[name], dtype=float) for name in ("faces", "offsets", "low", "high")}
        arrays = {name: np.array(content[name], dtype=float) for name in ("centres", "width", "weights")}
        return cls(
            str(content["coordinate"]),
            str(content["unit"]),
            tuple(map(str, content["arguments"])),
            **arrays,
            hull=Hull(**sides, convex=bool(hull["convex"])),
            samples=int(content["samples"]),
        )


@dataclass(frozen=True, eq=False)
class LearnedForce:
    """What came of learning: the force, and the errors without and with it.

    Parameters
    ----------
    force : ResidualForce
    system : System
        With the force built in; ``system.simulator(dt)`` and its values export like any other.
    before, after : array (ny,)
        Rms of free runs on the validation records, in the units of the outputs.
    outside : float
        Share of the validation samples outside the hull: of them nothing is claimed.
    """

    force: ResidualForce
    system: System
    before: FloatArray
    after: FloatArray
    outside: float

    @property
    def helps(self) -> bool:
        """True if the validation error fell, outputs weighed by their error before."""
        return bool(np.mean((self.after / np.maximum(self.before, 1e-300)) ** 2) < 1.0)

    def __str__(self) -> str:
        pairs = ", ".join(f"{a:.4g} -> {b:.4g}" for a, b in zip(self.before, self.after, strict=True))
        return f"{self.force}; validation rms {pairs}; {100 * self.outside:.1f} % of validation outside the hull"


def learn_residual_force(
    system: System,
    values: Mapping[str, float],
    estimation: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    *,
    coordinate: str | None = None,
    arguments: Sequence[str] | None = None,
    horizon: float | None = None,
    intersample: Literal["zoh", "foh", "smooth"] = "zoh",
    sizes: Sequence[int] = SIZES,
    refit: bool = False,
    rng: np.random.Generator,
) -> LearnedForce:
    """Learn the force that a system lacks, by free runs of the system with the force in it.

    The named parameters stay what they are, unless ``refit`` lets them move too: an effect that they have already
    taken up in part (dry friction as viscous) is otherwise not the force's to find. Bumps lie where the data lie
    (k-means); their weights are fitted by output error; their number, and coordinate and arguments unless given, are
    those with the least error on the validation records. For a loop that ends ``unexplained``: ``system`` and
    ``values`` are those of its final model.

    Parameters
    ----------
    system : System
        With coordinates; its outputs are those of the records, in order.
    values : mapping
        Its parameters by name.
    estimation, validation : sequence of Trajectory
    coordinate : str, optional
        By default the one that helps most.
    arguments : sequence of str, optional
        States and inputs that the force depends on; by default the rate, the coordinate, or both, whichever helps most.
    horizon : float, optional
        Length of the windows of free runs [s]; whole records if None.
    intersample : {"zoh", "foh", "smooth"}
    sizes : sequence of int
        Numbers of bumps that are tried.
    refit : bool
        Fit the named parameters beside the force.
    rng : numpy.random.Generator
        For the places of the bumps.

    Returns
    -------
    LearnedForce
        Also where it helps nothing: see ``helps``.

    Raises
    ------
    InputError
        If the system has no coordinates, or a name is unknown.
    FitError
        If no fit succeeds.
    """
    if not system.coordinates or not validation:
        raise InputError(
            "residual force",
            expected="a system with coordinates, and validation records that choose its size",
            got=f"{len(system.coordinates)} coordinates, {len(validation)} validation records",
            remedy="give a mechanical model and a validation run",
        )
    names = [one.name for one in system.coordinates]
    if coordinate is not None and coordinate not in names:
        raise InputError(
            "coordinate of a residual force",
            expected=f"one of {', '.join(names)}",
            got=repr(coordinate),
            remedy="correct",
        )
    known = {one.name: float(values.get(one.name, one.value)) for one in system.parameters}
    base = _at(system, known)
    how: dict[str, Any] = {"horizon": horizon, "intersample": intersample}
    before = _rms(simulate_error(base, known, validation, **how))
    best: LearnedForce | None = None
    problems: list[str] = []
    for one in base.coordinates:
        if coordinate not in (None, one.name):
            continue
        place, speed = base.states[one.q].name, base.states[one.v].name
        choices = [tuple(arguments)] if arguments is not None else [(speed,), (place,), (place, speed)]
        for wanted in choices:
            shown, checked = (_arguments(base, known, part, wanted) for part in (estimation, validation))
            hull = Hull.of(shown)
            outside = float(np.mean(~hull.contains(checked)))
            for size in sorted({min(size, _MOST_ON_A_LINE) if len(wanted) == 1 else size for size in sizes}):
                centres, width = _bumps(shown, min(size, len(shown) // 5), rng)
                draft = ResidualForce(
                    one.name, one.force_unit, wanted, centres, width, np.zeros(len(centres)), hull, len(shown)
                )
                fixed = () if refit else list(known)
                try:
                    fit = fit_output_error(draft.attach(base), estimation, start=known, fixed=fixed, **how)
                    force = draft.with_weights(fit.parameters)
                    whole = force.attach(_at(base, fit.parameters))
                    after = _rms(simulate_error(whole, {}, validation, **how))
                except FitError as error:
                    problems.append(f"{one.name} by {', '.join(wanted)}, {size} bumps: {error.what}")
                    continue
                trial = LearnedForce(force, whole, before, after, outside)
                if best is None or _loss(trial) < _loss(best):
                    best = trial
    if best is None:
        raise FitError(
            "residual force", expected="at least one fit", got="; ".join(problems), remedy="shorten the horizon"
        )
    return best


def _at(system: System, values: Mapping[str, float]) -> System:
    """Return the system with its parameters at values by name."""
    names = [one.name for one in system.parameters]
    return system.with_parameters({name: replace(system.parameter(name), value=values[name]) for name in names})


def _columns(system: System, arguments: Sequence[str]) -> list[int]:
    """Return where the arguments stand in [x, u]."""
    names = [channel.name for channel in (*system.states, *system.inputs)]
    unknown = [name for name in arguments if name not in names]
    if unknown or not arguments:
        raise InputError(
            "arguments of a residual force",
            expected=f"names among {', '.join(names)}",
            got=", ".join(unknown) or "none",
            remedy="correct them",
        )
    return [names.index(name) for name in arguments]


def _arguments(
    system: System, values: Mapping[str, float], records: Sequence[Trajectory], arguments: Sequence[str]
) -> FloatArray:
    """Return the arguments (n, d) along records, states as smoothed measurements tell them."""
    p = system.vector(values)
    columns = _columns(system, arguments)
    parts = []
    for record in records:
        x, _ = data_states(system.simulator(record.spec.sample_time), record, p)
        parts.append(np.hstack([x, record.u])[:, columns])
    return np.concatenate(parts)


def _bumps(rows: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return centres (M, d) where the rows lie, and the width (d,) of the bumps."""
    from scipy.cluster.vq import kmeans2
    from scipy.spatial.distance import cdist

    size = np.where(rows.std(axis=0) > 0, rows.std(axis=0), 1.0)
    centres, label = kmeans2(rows / size, max(count, 1), minit="++", rng=rng, missing="warn")
    centres = np.asarray(centres)[np.unique(label)]
    apart = cdist(centres, centres) + np.where(np.eye(len(centres)) > 0, np.inf, 0.0)
    near = float(np.median(apart.min(axis=1))) if len(centres) > 1 else 1.0
    return centres * size, _WIDTH * near * size


def _rms(errors: Sequence[FloatArray]) -> FloatArray:
    """Return the rms (ny,) over records; infinite where a run diverges."""
    square = np.concatenate(errors) ** 2
    return np.asarray(np.where(np.isfinite(square).all(axis=0), np.sqrt(square.mean(axis=0)), np.inf))


def _loss(trial: LearnedForce) -> float:
    return float(np.mean((trial.after / np.maximum(trial.before, 1e-300)) ** 2))
