"""The geometry of an arm, its marker and its camera from pairs of joint readings and places of the marker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from harness.errors import FitError, InputError
from harness.models.estimate import Estimate, RankDecision
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.records import real_signals, usable

if TYPE_CHECKING:
    from harness.physics.arms.marked_arm import MarkedArm

LEVEL = 0.95
TURN = 1.0
"""A direction of the offsets whose standard deviation is above a radian (for lengths: above the length itself) is not
determined: the data say nothing about it that was not known before."""
ROUNDS = 50
TIGHT = 1e-12
"""Relative change of the sum of squares at which Gauss-Newton stops: the problem is nearly linear and takes 4 to 6."""


@dataclass(frozen=True, eq=False)
class MarkerModel(Described):
    """Where the marker is at joint readings: a model without a state.

    Parameters
    ----------
    spec : PlantSpec
        Readings in, coordinates of the marker out.
    model : str
        ``iiwa`` or a URDF file.
    marker : (x, y, z)
    parameters : dict
        Those that differ from the file, by name (:class:`harness.physics.arms.marked_arm.MarkedArm`) [rad or m].
    notes : dict
    """

    spec: PlantSpec
    model: str
    marker: tuple[float, float, float]
    parameters: dict[str, float]
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "marker"
    burn_in: ClassVar[int] = 0  # No samples: there is no state.

    @cached_property
    def arm(self) -> MarkedArm:
        """Joints and geometry."""
        return marked(self.model, self.marker)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the empty state (0,)."""
        same_language(self.spec, data)
        return np.zeros(0)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the marker (..., 3) at readings (..., n)."""
        u = np.broadcast_to(u, (*np.shape(x)[:-1], self.spec.nu))
        places = self.arm.places(u.reshape(-1, self.spec.nu), self.arm.vector(self.parameters))
        return places.reshape(*u.shape[:-1], self.spec.ny)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the empty state."""
        return np.asarray(x, dtype=float)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the empty state."""
        return np.asarray(x, dtype=float)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """What is calibrated of an arm with a marker.

    Parameters
    ----------
    marker : (x, y, z)
        In the frame of the last body [m].
    lengths : bool
        Fit the lengths of the links (and of the marker's arm) beside the offsets.
    axes : bool
        Fit all that a joint's axis may be off by: two tilts and two shifts (:class:`harness.physics.arms.marked_arm.
        MarkedArm`); with the offsets that is every kinematic error that a chain can have.
    free_marker : bool
        Fit the place of the marker in its body: ``marker`` is where the fit starts.
    camera : bool
        Fit where the camera stands (hand-eye calibration, the camera in the room): places are in its frame, and the fit
        starts from the turn that brings the file's places nearest to them (Arun, Huang & Blostein 1987, *IEEE PAMI*
        9:698).
    fixed : sequence of str
        Parameters that stay as the URDF has them.
    """

    marker: Sequence[float] = (0.05, 0.0, 0.1)
    lengths: bool = False
    axes: bool = False
    free_marker: bool = False
    camera: bool = False
    fixed: Sequence[str] = ()

    def free(self, arm: MarkedArm) -> list[str]:
        """Return the names of the parameters that are fitted."""
        kinds = ["offset"] + ["length"] * self.lengths + ["tilt", "shift"] * self.axes
        kinds += ["marker_"] * self.free_marker + ["camera_"] * self.camera
        left = {*self.fixed, "length_marker"} if self.free_marker else {*self.fixed}  # a free place has its length
        return [name for name in arm.parameters if name.startswith(tuple(kinds)) and name not in left]


@dataclass(frozen=True)
class JointCalibration(Calibrated):
    """Offsets of the joints, and lengths of the links, that bring the marker to where it was seen.

    Maximum likelihood by Gauss-Newton: white noise of one variance on every coordinate of the marker, and of a known
    deviation on the readings, which enters through the derivative of the place by the readings. What the pairs do not
    determine stays as the URDF has it and is named: the offset of a joint whose axis goes through the marker, or of two
    joints on one axis.

    Parameters
    ----------
    model : str
        ``iiwa`` or a URDF file.
    reading_noise : float
        Standard deviation of the joint readings [rad or m]; 0 if they are exact beside the marker.

    Raises
    ------
    InputError
        If an option is wrong, or the URDF cannot be read.
    """

    model: str = "iiwa"
    reading_noise: float = 0.0

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [channel.name for channel in self._arm().channels], []

    def inputs(self) -> list[str]:
        """Return the readings."""
        return [channel.name for channel in self._arm().arm.positions]

    def _arm(self) -> MarkedArm:
        x, y, z = (float(value) for value in self.marker)
        return marked(self.model, (x, y, z))

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> MarkerModel:
        """Return the calibrated arm; the record of the estimate stands in its notes.

        Raises
        ------
        FitError
            If the signals are not readings and marker of the arm, or the pairs determine nothing.
        """
        what = "joint-calibration"
        records, spec = usable(trajectories, samples=2, what=what, holes="kept")
        real_signals(spec, what)
        arm = self._arm()
        names = self._free(arm)
        inputs, outputs = [c.name for c in spec.inputs], [c.name for c in spec.outputs]
        wanted = [c.name for c in arm.arm.positions], [c.name for c in arm.channels]
        if (inputs, outputs) != wanted:
            raise FitError(
                f"{what}: the records do not speak the language of {arm.arm.name}",
                expected=f"{', '.join(wanted[0])} -> {', '.join(wanted[1])}",
                got=str(spec),
                remedy="rename the signals: joint readings are inputs, the marker's coordinates outputs",
            )
        q, p = np.concatenate([record.u for record in records]), np.concatenate([record.y for record in records])
        if p.size <= len(names):
            raise FitError(
                f"{what}: too few pairs",
                expected=f"more than {len(names)} coordinates",
                got=str(p.size),
                remedy="record more postures",
            )
        theta, estimate = self._solved(arm, names, q, p)
        every = dict(zip(arm.parameters, theta.tolist(), strict=True))
        values = {name: value for name, value in every.items() if name in names or value != arm.parameters[name]}
        x, y, z = arm.marker.tolist()
        return MarkerModel(spec, self.model, (x, y, z), values, {"estimate": estimate.to_dict()})

    def _free(self, arm: MarkedArm) -> list[str]:
        """Return the names of the parameters that are fitted."""
        unknown = sorted(set(self.fixed) - set(arm.parameters))
        if unknown or not self.reading_noise >= 0:
            raise InputError(
                "options of joint-calibration",
                expected=f"fixed among {', '.join(arm.parameters)}; reading_noise >= 0",
                got=f"fixed {', '.join(self.fixed) or 'none'}; reading_noise {self.reading_noise}",
                remedy="correct them",
            )
        return self.free(arm)

    def _solved(self, arm: MarkedArm, names: list[str], q: FloatArray, p: FloatArray) -> tuple[FloatArray, Estimate]:
        """Return all parameters (k,), and the record of those that were fitted."""
        every = list(arm.parameters)
        free = [every.index(name) for name in names]
        theta = arm.vector(_camera(arm, q, p) if self.camera else None)
        scale = TURN * arm.scale[free]
        variance, cost, converged = float(np.var(p)), np.inf, False
        kept = np.eye(len(names))
        for _ in range(ROUNDS):
            place, jacobian, turned = arm.jacobians(q, theta, free)
            white = self._whitening(turned, variance)
            residual = np.einsum("nij,nj->ni", white, p - place)
            rows = np.einsum("nij,njk->nik", white, jacobian).reshape(-1, len(free)) * scale
            left, singular, right = np.linalg.svd(rows, full_matrices=False)
            # the noise in units of itself is 1: a direction with a smaller singular value is known to worse than TURN
            seen = singular > np.sqrt(_level(residual, len(free)))
            kept = right[seen].T
            step = right[seen].T @ ((left[:, seen].T @ residual.ravel()) / singular[seen])
            theta[free] += scale * step
            left = p - arm.places(q, theta, free)
            variance = self._variance(left, turned, variance, int(seen.sum()))
            now = float(np.sum(left**2))
            if abs(cost - now) <= TIGHT * max(now, 1e-300) or now < 1e-26 * float(np.sum(p**2)):
                converged = True
                break
            cost = now
        if kept.shape[1] == 0:
            raise FitError(
                "joint-calibration: the pairs determine nothing",
                expected="postures that turn the joints, and a marker off their axes",
                got=f"{len(q)} pairs whose noise hides every offset",
                remedy="move the joints further",
            )
        return theta, self._record(
            names, [arm.units[row] for row in free], theta[free], rows, scale, kept, converged, residual
        )

    def _whitening(self, turned: FloatArray, variance: float) -> FloatArray:
        """Return (N, 3, 3) which make the errors of every pair white, of variance 1."""
        spread = variance * np.eye(3) + self.reading_noise**2 * (turned @ turned.transpose(0, 2, 1))
        return np.linalg.inv(np.linalg.cholesky(spread))

    def _variance(self, residual: FloatArray, turned: FloatArray, variance: float, count: int) -> float:
        """Return the variance of the marker's coordinates that explains the residuals beside the readings' noise."""
        freedom = max(residual.size - count, 1)
        known = self.reading_noise**2 * float(np.sum(turned**2)) * freedom / residual.size
        floor = 1e-24 * max(float(np.mean(residual**2)), 1e-6)
        return max((float(np.sum(residual**2)) - known) / freedom, floor, 1e-6 * known / freedom)

    def _record(
        self,
        names: list[str],
        units: list[str],
        values: FloatArray,
        rows: FloatArray,
        scale: FloatArray,
        kept: FloatArray,
        converged: bool,
        residual: FloatArray,
    ) -> Estimate:
        """Return the record: covariance from the curvature (the Cramer-Rao bound at the estimate)."""
        from scipy.stats import t as student

        k, rank = len(names), kept.shape[1]
        null = np.linalg.svd(kept, full_matrices=True)[0][:, rank:]
        loose = np.sum(null**2, axis=1) > 1e-6
        inner = np.linalg.inv(kept.T @ (rows.T @ rows) @ kept)
        level = _level(residual, rank)
        covariance = level * scale[:, None] * (kept @ inner @ kept.T) * scale
        half = float(student.ppf(0.5 + LEVEL / 2, max(residual.size - rank, 1))) * np.sqrt(np.diag(covariance))
        half = np.where(loose, np.nan, half)
        covariance[np.diag_indices(k)] = np.where(loose, np.inf, np.diag(covariance))
        lengths = np.linalg.norm(rows / scale, axis=0)
        singular = np.linalg.svd(rows / np.where(lengths > 0, lengths * scale, 1.0), compute_uv=False)
        return Estimate(
            tuple(names),
            tuple(units),
            values,
            covariance,
            np.column_stack([values - half, values + half]),
            LEVEL,
            "curvature of the likelihood at its maximum",
            RankDecision.of(names, null, 1.0 / scale, loose, "known to better than a radian, or than the length"),
            float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf"),
            converged,
        )


def marked(model: str, marker: tuple[float, float, float]) -> MarkedArm:
    """Return the arm of a model with its marker."""
    from harness.physics.arms.arm import load_arm
    from harness.physics.arms.marked_arm import MarkedArm

    return MarkedArm(load_arm(model), marker)


def _camera(arm: MarkedArm, q: FloatArray, p: FloatArray) -> dict[str, float]:
    """Return the pose of the base in the camera's frame that brings the file's places nearest to those seen."""
    from scipy.spatial.transform import Rotation

    there = arm.places(q)
    middle, seen = there.mean(axis=0), p.mean(axis=0)
    left, _, right = np.linalg.svd((there - middle).T @ (p - seen))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    turn = right.T @ flip @ left.T
    values = [*(seen - turn @ middle), *Rotation.from_matrix(turn).as_rotvec()]
    return dict(zip([f"camera_{r}{axis}" for r in ("", "r") for axis in "xyz"], map(float, values), strict=True))


def _level(residual: FloatArray, count: int) -> float:
    """Return the variance of whitened residuals; 1 where they are what was expected."""
    return max(float(np.sum(residual**2)) / max(residual.size - count, 1), 1e-12)
