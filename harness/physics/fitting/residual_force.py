"""A force without a name, learned on what a closed loop leaves unexplained: labelled as not physical, with its hull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.physics.definition.parameters import Parameter
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System

LABEL = "learned from data, not physical"  # What every report and file says of such a force.

_MOST_FACES = 4  # Dimensions up to which the hull is convex; beyond, its faces are too many, and a box serves.

_HULL_POINTS = 20_000
"""Samples from which a hull is made: evenly thinned, it keeps all that records a few times longer would show."""


@dataclass(frozen=True, eq=False)
class Hull:
    """Where the data of a learned force lie: ``faces @ z + offsets <= 0`` for its arguments z."""

    faces: FloatArray  # (F, d)
    offsets: FloatArray  # (F,)
    convex: bool  # False where it is the box of the data
    # (d,): The box
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

    Far from the data the basis functions, and with them the force, are 0: there the model is the named one alone.
    """

    coordinate: str  # The equation of motion that it is added to
    unit: str  # Of the force
    arguments: tuple[str, ...]  # States and inputs that z is made of, by name
    centres: FloatArray  # (M, d)
    width: FloatArray  # (d,)
    weights: FloatArray  # (M,): In ``unit``
    hull: Hull  # Of the z in the estimation data
    samples: int  # Estimation samples

    label = LABEL

    def __str__(self) -> str:
        sides = ", ".join(
            f"{name} in [{low:.3g}, {high:.3g}]"
            for name, low, high in zip(self.arguments, self.hull.low, self.hull.high, strict=True)
        )
        size = f"{len(self.weights)} basis functions"
        return f"force on {self.coordinate} [{self.unit}] of {size}, {LABEL}; known for {sides}"

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Return the force (n,) at arguments (n, d)."""
        scaled = (np.asarray(rows)[:, None, :] - self.centres) / self.width
        return np.asarray(np.exp(-0.5 * np.sum(scaled**2, axis=2)) @ self.weights)

    def rows(self, system: System, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the arguments (n, d) in states x (n, nx) under inputs u (n, nu)."""
        return np.hstack([x, u])[:, argument_columns(system, self.arguments)]

    def attach(self, system: System) -> System:
        """Return the system with the force built in; its weights are parameters ``learned@COORDINATE.wI``.

        Raises InputError if the system lacks the coordinate or an argument, or has such a force already.
        """
        joint = ca.vertcat(system.x, system.u)
        z = ca.vertcat(*[joint[column] for column in argument_columns(system, self.arguments)])
        total, parameters = ca.SX(0.0), []
        for number, (centre, weight) in enumerate(zip(self.centres, self.weights, strict=True)):
            symbol = ca.SX.sym(f"learned_{self.coordinate}_{number}")
            name = f"learned@{self.coordinate}.w{number}"
            parameters.append((Parameter(name, self.unit, float(weight)), symbol))
            scaled = (z - ca.DM(centre)) / ca.DM(self.width)
            total += symbol * ca.exp(-0.5 * ca.dot(scaled, scaled))
        return system.rebuild(forces={self.coordinate: total}, parameters=parameters, remarks=[str(self)])

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


def argument_columns(system: System, arguments: Sequence[str]) -> list[int]:
    """Return the columns of the arguments in [x, u]."""
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
