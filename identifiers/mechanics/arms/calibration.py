"""The geometry of an arm, its marker and its camera from pairs of joint readings and what the camera sees."""

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
    from harness.physics.arms.marked_arm import Eye, MarkedArm

LEVEL = 0.95
TURN = 1.0
"""A direction of the offsets whose standard deviation is above a radian (for lengths: above the length itself) is not
determined: the data say nothing about it that was not known before."""
ROUNDS = 50
TIGHT = 1e-12
"""Relative change of the sum of squares at which Gauss-Newton stops: the problem is nearly linear and takes 4 to 6."""


@dataclass(frozen=True, eq=False)
class MarkerModel(Described):
    """What the camera sees at joint readings: a model without a state.

    Parameters
    ----------
    spec : PlantSpec
        Readings in, what is seen out (:class:`harness.physics.arms.marked_arm.MarkedArm`).
    model : str
        ``iiwa``, a URDF file, or ``hand``.
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
        from harness.physics.arms.marked_arm import marked_arm

        eye: Eye = "hand" if self.spec.outputs[0].name.startswith("target") else "room"
        return marked_arm(self.model, self.marker, pose=self.spec.ny > 3, eye=eye)

    def to_urdf(self) -> str:
        """Return the URDF with the zeros, axes and lengths that were found, in the frames of its joints.

        Raises
        ------
        InputError
            If the arm was not read from a URDF.
        """
        from harness.physics.arms.urdf_write import urdf_moved

        arm, given = self.arm, self.arm.vector(self.parameters)
        before = arm.frames(arm.vector())
        joints = zip(arm.arm.arm.joints, arm.frames(given), before, strict=True)
        moved = {joint.name: new for joint, new, old in joints if not all(map(np.array_equal, new, old))}
        return urdf_moved(arm.arm, moved)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the empty state (0,)."""
        same_language(self.spec, data)
        return np.zeros(0)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return what is seen (..., ny) at readings (..., n)."""
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
    pose : bool
        The camera tells the orientation of the marker too; where both are is always fitted.
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
    pose: bool = False
    fixed: Sequence[str] = ()

    def free(self, arm: MarkedArm) -> list[str]:
        """Return the names of the parameters that are fitted."""
        seen = arm.pose or arm.eye == "hand" or arm.reported
        kinds = [] if arm.reported else ["offset"] + ["length"] * self.lengths + ["tilt", "shift"] * self.axes
        kinds += [f"{arm.carried}_"] * (self.free_marker or seen) + [f"{arm.standing}_"] * (self.camera or seen)
        left = {*self.fixed, *["length_marker"] * (self.free_marker or seen)}  # a free place has its length
        return [name for name in arm.parameters if name.startswith(tuple(kinds)) and name not in left]


@dataclass(frozen=True)
class JointCalibration(Calibrated):
    """Offsets of the joints, and lengths of the links, that bring the marker to where it was seen.

    Maximum likelihood by Gauss-Newton: white noise of one variance on every coordinate of the marker, of another one on
    its orientation, and of a known deviation on the readings, which enters through the derivative of what is seen by
    the readings. What the pairs do not determine stays as the URDF has it and is named: the offset of a joint whose
    axis goes through the marker, or of two joints on one axis.

    With ``model="hand"`` nothing of the arm is fitted: the readings are poses of the hand as its controller reports
    them, and where camera and marker are is found (hand-eye calibration, A X = Z B). It starts from the closed form of
    Shah 2013 (*J. Mechanisms Robotics* 5:031007) where orientations are seen.

    Parameters
    ----------
    model : str
        ``iiwa`` or a URDF file; or ``hand``, whose readings are ``hand_x``, ``hand_y``, ``hand_z`` [m], ``hand_yaw``,
        ``hand_pitch`` and ``hand_roll`` [rad] in the frame of the base, R = Rz(yaw) Ry(pitch) Rx(roll).
    eye : {"room", "hand"}
        Where the camera is: it sees the marker on the hand, or it is on the hand and sees a target that stands. Then
        ``marker`` is where the fit starts for the camera.
    reading_noise : float
        Standard deviation of the joint readings [rad or m]; 0 if they are exact beside the marker.

    Raises
    ------
    InputError
        If an option is wrong, or the URDF cannot be read.
    """

    model: str = "iiwa"
    eye: Eye = "room"
    reading_noise: float = 0.0

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return [channel.name for channel in self._arm().channels], []

    def inputs(self) -> list[str]:
        """Return the readings."""
        return [channel.name for channel in self._arm().arm.positions]

    def _arm(self) -> MarkedArm:
        from harness.physics.arms.marked_arm import marked_arm

        return marked_arm(self.model, [float(value) for value in self.marker], pose=self.pose, eye=self.eye)

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
                remedy="rename the signals: readings are inputs, what the camera sees outputs",
            )
        q, p = np.concatenate([record.u for record in records]), np.concatenate([record.y for record in records])
        told = 6 if self.pose else 3
        if told * len(q) <= len(names):
            raise FitError(
                f"{what}: too few pairs",
                expected=f"more than {len(names) // told}: {told} numbers each for {len(names)} parameters",
                got=str(len(q)),
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
        if arm.reported and (self.lengths or self.axes):
            raise InputError(
                "options of joint-calibration",
                expected="neither lengths nor axes with the model hand, which has no joints",
                got=f"lengths {self.lengths}, axes {self.axes}",
                remedy="give the URDF and the readings of its joints, or leave them out",
            )
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
        theta = arm.vector(_started(arm, names, q, p))
        scale = TURN * arm.scale[free]
        variance = np.repeat([float(np.var(p[:, :3])), 1.0][: 1 + self.pose], 3)
        cost, converged = np.inf, False
        kept = np.eye(len(names))
        for _ in range(ROUNDS):
            _wrap(arm, theta)
            place, jacobian, turned = arm.jacobians(q, theta, free)
            white = self._whitening(turned, variance)
            residual = np.einsum("nij,nj->ni", white, arm.errors(p, place))
            rows = np.einsum("nij,njk->nik", white, jacobian).reshape(-1, len(free)) * scale
            left, singular, right = np.linalg.svd(rows, full_matrices=False)
            # the noise in units of itself is 1: a direction with a smaller singular value is known to worse than TURN
            seen = singular > np.sqrt(_level(residual, len(free)))
            kept = right[seen].T
            step = right[seen].T @ ((left[:, seen].T @ residual.ravel()) / singular[seen])
            theta[free] += scale * step
            errors = arm.errors(p, arm.places(q, theta, free))
            used = np.sum(left[:, seen] ** 2, axis=1).reshape(errors.shape)
            variance = self._variance(errors, turned, used)
            now = float(np.sum(errors**2))
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

    def _whitening(self, turned: FloatArray, variance: FloatArray) -> FloatArray:
        """Return (N, d, d) which make the errors of every pair white, of variance 1."""
        spread = np.diag(variance) + self.reading_noise**2 * (turned @ turned.transpose(0, 2, 1))
        return np.linalg.inv(np.linalg.cholesky(spread))

    def _variance(self, errors: FloatArray, turned: FloatArray, used: FloatArray) -> FloatArray:
        """Return the variances (d,) of places and orientations that explain the errors beside the readings' noise.

        ``used`` is how much of every error the parameters took up (the leverage).
        """
        found = []
        for first in range(0, errors.shape[1], 3):
            part = slice(first, first + 3)
            own, size = errors[:, part], errors[:, part].size
            freedom = max(size - float(used[:, part].sum()), 1.0)
            known = self.reading_noise**2 * float(np.sum(turned[:, part] ** 2)) * freedom / size
            floor = 1e-24 * max(float(np.mean(own**2)), 1e-6)
            found += 3 * [max((float(np.sum(own**2)) - known) / freedom, floor, 1e-6 * known / freedom)]
        return np.array(found)

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


def _started(arm: MarkedArm, names: Sequence[str], q: FloatArray, p: FloatArray) -> dict[str, float]:
    """Return where camera and marker are, roughly, with the arm of the file: nothing where they are known."""
    if f"{arm.standing}_x" not in names and f"{arm.carried}_rx" not in names:
        return {}
    from scipy.spatial.transform import Rotation

    from harness.physics.arms.marked_arm import MarkedArm, turns_of

    body = MarkedArm(arm.arm, pose=True).places(q)
    turns, places, seen = turns_of(body), body[:, :3], p[:, :3]
    if arm.pose:
        other = turns_of(p)
        if arm.eye == "hand":  # (A X)^-1 Z = B is A X = Z B^-1, with the camera in the room A X = C^-1 B
            seen, other = -np.einsum("nji,nj->ni", other, seen), other.transpose(0, 2, 1)
        carried, standing = _both_poses(turns, places, other, seen)
    elif arm.eye == "hand":
        carried, standing = _target(turns, places, seen)
    else:
        carried = (np.eye(3), arm.marker)
        standing = _nearest(seen, places + turns @ arm.marker)
    standing = standing if arm.eye == "hand" else _inverse(standing)
    found: dict[str, float] = {}
    for word, (turn, place) in ((arm.carried, carried), (arm.standing, standing)):
        values = [*place, *Rotation.from_matrix(turn).as_rotvec()]
        found |= dict(zip([f"{word}_{r}{axis}" for r in ("", "r") for axis in "xyz"], map(float, values), strict=True))
    return {name: value for name, value in found.items() if name in names}


Pose = tuple[FloatArray, FloatArray]
"""A rotation matrix (3, 3) and a place (3,)."""


def _wrap(arm: MarkedArm, theta: FloatArray) -> None:
    """Bring the rotation vectors among the parameters to half a turn at most, in place: of each there are many."""
    every = list(arm.parameters)
    for word in (arm.carried, arm.standing):
        rows = [every.index(name) for axis in "xyz" if (name := f"{word}_r{axis}") in every]
        angle = float(np.linalg.norm(theta[rows]))
        if angle > np.pi:
            theta[rows] *= 1 - 2 * np.pi * round(angle / (2 * np.pi)) / angle


def _inverse(pose: Pose) -> Pose:
    return pose[0].T, -pose[0].T @ pose[1]


def _turn_next_to(matrix: FloatArray) -> FloatArray:
    """Return the rotation nearest to a matrix (3, 3)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right)


def _nearest(there: FloatArray, seen: FloatArray) -> Pose:
    """Return the pose that brings places (N, 3) nearest to others (Arun, Huang & Blostein 1987, *IEEE PAMI* 9:698)."""
    middle, aim = there.mean(axis=0), seen.mean(axis=0)
    turn = _turn_next_to((seen - aim).T @ (there - middle))
    return turn, aim - turn @ middle


def _both_poses(turns: FloatArray, places: FloatArray, others: FloatArray, seen: FloatArray) -> tuple[Pose, Pose]:
    """Return X and Z of A X = Z B for poses A (N, 3, 3), (N, 3) and B (Shah 2013)."""
    joined = sum(np.kron(a, b) for a, b in zip(turns, others, strict=True))
    left, _, right = np.linalg.svd(joined)
    carried, standing = right[0].reshape(3, 3), left[:, 0].reshape(3, 3)
    sign = np.sign(np.linalg.det(carried)) or 1.0
    x, z = _turn_next_to(sign * carried), _turn_next_to(sign * standing)
    rows = np.concatenate([turns, np.broadcast_to(-np.eye(3), turns.shape)], axis=2).reshape(-1, 6)
    both = np.linalg.lstsq(rows, (seen @ z.T - places).ravel(), rcond=None)[0]
    return (x, both[:3]), (z, both[3:])


def _target(turns: FloatArray, places: FloatArray, seen: FloatArray) -> tuple[Pose, Pose]:
    """Return the pose of a camera on the hand and the place of a point that stands, from where it sees it."""
    count = len(turns)
    rows = np.concatenate([
        np.einsum("nij,nk->nijk", turns, seen).reshape(count, 3, 9), turns, np.broadcast_to(-np.eye(3), turns.shape)
    ], axis=2)  # fmt: skip
    turn = _turn_next_to(np.linalg.lstsq(rows.reshape(-1, 15), -places.ravel(), rcond=None)[0][:9].reshape(3, 3))
    goal = -(places + np.einsum("nij,jk,nk->ni", turns, turn, seen)).ravel()
    both = np.linalg.lstsq(rows[:, :, 9:].reshape(-1, 6), goal, rcond=None)[0]
    return (turn, both[:3]), (np.eye(3), both[3:])


def _level(residual: FloatArray, count: int) -> float:
    """Return the variance of whitened residuals; 1 where they are what was expected."""
    return max(float(np.sum(residual**2)) / max(residual.size - count, 1), 1e-12)
