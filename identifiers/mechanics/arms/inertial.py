"""Inertial parameters of an arm from torque and motion: physically consistent, with friction, beside a prior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.algebra import column_norms
from harness.errors import FitError, InputError
from harness.models.estimate import Estimate, RankDecision
from harness.options import check_options
from harness.physics.arms.inertia import TEN, UNITS
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.records import learnable
from identifiers.common.row_solvers import whitening
from identifiers.mechanics.arms.arm_model import ArmDynamics
from identifiers.mechanics.arms.torque_errors import low_pass
from identifiers.mechanics.motion import Motion, Smoothing, motion, noisier

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel
    from harness.physics.arms.inertial_fit import InertialProblem

Method = Literal["sdp", "log-cholesky", "least-squares"]
SLOW = 0.01
"""Speed [rad/s] and acceleration [rad/s^2] at which friction of the size of the torques seen is held possible."""
ENOUGH = 3000  # Samples on which the rank is decided: the share of noise in a direction needs no more.
BLOCK = 2000  # Rows that are held in memory at a time.
BAND = 0.95  # Share of the power of a rate that its band holds: what is above is harmonics of its turns and noise.
MOVES = 0.05  # Rms rate, over that of the fastest joint, from which a joint has a band: noise alone would have all.
CORNERS = 10.0
"""Corner of the filter over the band of the rates: the motion's squares reach twice as far, what dry friction does at a
turn is seen to its ninth harmonic, and above there is noise. On public logs of two arms (bands 0.4 and 0.5 Hz) any
corner from 4 to 15 Hz errs alike; without one held-out torques of one of them are up to five times as far off."""


@dataclass(frozen=True)
class Inertial:
    """Ten inertial parameters a body, and joint friction, of an arm read from a URDF.

    Torques are linear in the parameters (Atkeson, An & Hollerbach 1986); joints weigh by the joint covariance of their
    residuals. What the motion does not determine is decided by the prior, the bodies of the URDF.

    Parameters
    ----------
    model : str
        ``iiwa`` or a URDF file.
    method : {"sdp", "log-cholesky", "least-squares"}
        Semidefinite program over pseudo-inertias; Newton's method in log-Cholesky coordinates (the same optimum); or
        least squares in the directions that the motion determines, the others as in the URDF, nothing constrained.
    trust : float or None
        Relative standard deviation of the URDF's inertial parameters, for the entropic prior (Lee, Wensing & Park
        2019); None for no prior (not with log-cholesky).
    weighted : bool
        Weigh the joints by their residuals; otherwise all alike [N m].
    damping, friction, motor_inertia : bool
        Fit viscous and dry friction, and the reflected inertia, of every joint.
    hull : bool
        Keep mass inside the bounding box of each body's collision shapes, as far as the URDF states any.
    free : sequence of str, optional
        Joints whose bodies are fitted, by name; the others stay as in the URDF. All by default. With the last one
        alone, what it gains over the URDF is the payload.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal"}
        As of the lumped forms.
    intersample : {"zoh", "smooth"}
        Whether the torque was held over each sample (a command), or sampled from a smooth course (a sensor).

    Raises
    ------
    InputError
        If an option is wrong, or the URDF cannot be read.
    """

    model: str = "iiwa"
    method: Method = "sdp"
    trust: float | None = 0.3
    weighted: bool = True
    damping: bool = True
    friction: bool = True
    motor_inertia: bool = False
    hull: bool = False
    free: Sequence[str] | None = None
    smoothing: Smoothing = "auto"
    intersample: Literal["zoh", "smooth"] = "zoh"

    def __post_init__(self) -> None:
        check_options(self, "inertial", trust="> 0")
        if self.method == "log-cholesky" and (self.trust is None or self.hull):
            raise InputError(
                "options of inertial",
                expected="a prior (trust) and no hull for log-cholesky",
                got=f"trust {self.trust}, hull {self.hull}",
                remedy="use method sdp",
            )

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> ArmDynamics:
        """Return the arm with the parameters found.

        Raises
        ------
        FitError
            If the signals are not those of the arm, or no consistent parameters can be found.
        """
        from harness.physics.arms.arm import load_arm

        what = "inertial"
        records, spec = learnable(trajectories, samples=12, what=what)
        arm = load_arm(self.model)
        speaks(arm, spec, what)
        names = SimpleNamespace(coordinates=arm.positions)
        equations, moved = self.prepared(arm, records)
        corner = CORNERS * band(moved)
        gram, side, rms = equations.weighted(moved, self.weighted, corner)
        decision, condition, kept = self._rank(equations, names, records, moved, rng, corner)
        problem = self.problem(arm, equations, gram, side)
        x = self._solved(problem, kept)
        inertial, found = equations.unpacked(x)
        how = {
            "sdp": "semidefinite program",
            "log-cholesky": "log-Cholesky coordinates",
            "least-squares": "least squares in the determined directions, the others as in the URDF",
        }[self.method]
        prior = "" if self.trust is None or self.method == "least-squares" else f", prior trusted to {self.trust:.0%}"
        record = Estimate(
            equations.names,
            equations.units,
            x,
            method=f"no intervals: they would be the prior's; {how}{prior}",
            rank=decision,
            condition=condition,
        )
        cost = problem.cost(x)  # of a body that no mass makes it is infinite, beside a prior
        notes = {
            "estimate": record.to_dict(),
            "torque_rms": rms.tolist(),
            "cost": cost if np.isfinite(cost) else None,
            "torques_seen": {"smoothing": self.smoothing, "intersample": self.intersample, "corner": corner},
        }
        return ArmDynamics(
            spec, self.model, inertial, found["damping"], found["friction"], found["motor_inertia"], notes
        )

    def prepared(
        self, arm: ArmModel, records: Sequence[Trajectory], *, like: Sequence[Motion] = (), coarser: bool = False
    ) -> tuple[TorqueEquations, list[Motion]]:
        """Return the equations of what is fitted, and the motion of the records (smoothed ``like`` another)."""
        names = SimpleNamespace(coordinates=arm.positions)
        given: Sequence[Motion | None] = like or [None] * len(records)
        moved = [
            motion(names, record, self.smoothing, like=known, coarser=coarser)
            for record, known in zip(records, given, strict=True)
        ]
        if self.intersample == "smooth":
            moved = [replace(smoothed, mean_u=smoothed.u) for smoothed in moved]
        return TorqueEquations(arm, self._free_joints(arm), self.damping, self.friction, self.motor_inertia), moved

    def _free_joints(self, arm: ArmModel) -> list[int]:
        """Return the numbers of the bodies that are fitted."""
        known = [joint.name for joint in arm.arm.joints]
        if self.free is not None:
            wrong = [name for name in self.free if name not in known]
            if wrong or not self.free:
                raise InputError(
                    "option free",
                    expected=f"some of {', '.join(known)}",
                    got=", ".join(wrong) or "none",
                    remedy="correct it",
                )
            return [known.index(name) for name in self.free]
        return [number for number, joint in enumerate(arm.arm.joints) if joint in arm.arm.moving]

    def problem(self, arm: ArmModel, equations: TorqueEquations, gram: FloatArray, side: FloatArray) -> InertialProblem:
        """Return the problem of the bodies beside their prior.

        Raises
        ------
        FitError
            If the file has no consistent bodies.
        """
        from harness.physics.arms.inertia import is_consistent
        from harness.physics.arms.inertial_fit import Bodies, InertialProblem

        prior = arm.arm.parameters.reshape(-1, 10)[equations.bodies]
        wrong = [arm.arm.joints[b].name for b, row in zip(equations.bodies, prior, strict=True)
                 if not is_consistent(row)]  # fmt: skip
        if wrong:
            raise FitError(
                "inertial: bodies of the URDF are not physically consistent",
                expected="a positive definite pseudo-inertia for every body that is fitted",
                got=f"behind {', '.join(wrong)}: mass 0, or inertia that no density makes",
                remedy="correct the URDF, or name the others in free=[...]",
            )
        boxes: list[Any] = [None] * len(prior)
        if self.hull:
            from harness.physics.arms.urdf_shapes import bounding_boxes

            found = bounding_boxes(arm)
            boxes = [found[b] for b in equations.bodies]
        positive = np.ones(len(side) - prior.size, dtype=bool)
        trust = None if self.method == "least-squares" else self.trust
        return InertialProblem(gram, side, Bodies(prior, boxes=boxes), trust, positive)

    def _solved(self, problem: InertialProblem, kept: FloatArray) -> FloatArray:
        from harness.physics.arms.inertial_fit import by_least_squares, by_log_cholesky, by_semidefinite_program

        if self.method == "sdp":
            return by_semidefinite_program(problem)
        if self.method == "log-cholesky":
            return by_log_cholesky(problem)
        return by_least_squares(problem, kept)

    def _rank(
        self,
        equations: TorqueEquations,
        names: Any,
        records: Sequence[Trajectory],
        moved: Sequence[Motion],
        rng: np.random.Generator,
        corner: float,
    ) -> tuple[RankDecision, float, FloatArray]:
        """Return which directions the motion determines above its noise; their basis (k, rank)."""
        from harness.physics.lumps.identifiability import determined

        def some(smoothed: Motion) -> FloatArray:
            parts = np.concatenate([rows for rows, _ in equations.blocks(smoothed, corner)])
            return parts[:: max(1, len(parts) * len(moved) // ENOUGH)].reshape(-1, parts.shape[2])

        rows, noise = [], []
        for record, old in zip(records, moved, strict=True):
            again = motion(names, noisier(record, rng), self.smoothing, like=old)
            bent = motion(names, record, self.smoothing, like=old, coarser=True)
            part = some(old)
            rows.append(part)
            noise += [some(other) - part for other in (again, bent)]
        phi = np.concatenate(rows)
        decision, kept, condition = determined(phi, equations.names, np.concatenate(noise))
        return decision, condition, kept / column_norms(phi)[:, None]


@dataclass(frozen=True, eq=False)
class TorqueEquations:
    """The torque equations of an arm in the parameters that are fitted."""

    arm: ArmModel
    bodies: list[int]
    damping: bool
    friction: bool
    motor_inertia: bool

    @property
    def names(self) -> tuple[str, ...]:
        """``m1`` ... of the bodies by number, then ``damping1`` ... of the joints."""
        own = [f"{name}{body + 1}" for body in self.bodies for name in TEN]
        return (*own, *(f"{kind}{joint + 1}" for kind in self.kinds for joint in range(self.arm.n)))

    @property
    def units(self) -> tuple[str, ...]:
        """Of the parameters."""
        found = [*UNITS * len(self.bodies)]
        for kind in self.kinds:
            for channel in self.arm.inputs:
                turns = channel.unit == "N m"
                found.append(
                    {
                        "damping": "N m s/rad" if turns else "N s/m",
                        "friction": channel.unit,
                        "motor_inertia": "kg m^2" if turns else "kg",
                    }[kind]
                )
        return tuple(found)

    @property
    def kinds(self) -> tuple[str, ...]:
        """What is fitted at the joints."""
        chosen = (("damping", self.damping), ("friction", self.friction), ("motor_inertia", self.motor_inertia))
        return tuple(name for name, wanted in chosen if wanted)

    def rows(self, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the regressor (N * n, k)."""
        from harness.physics.arms.arm import REST

        n, count = self.arm.n, len(q)
        rigid = self.arm.arm.regressor(q, v, a).reshape(count, n, -1, 10)[:, :, self.bodies].reshape(count, n, -1)
        what = {"damping": v, "friction": np.tanh(v / REST), "motor_inertia": a}
        joints = np.zeros((count, n, n * len(self.kinds)))
        for place, kind in enumerate(self.kinds):
            for joint in range(n):
                joints[:, joint, place * n + joint] = what[kind][:, joint]
        return np.concatenate([rigid, joints], axis=2).reshape(count * n, -1)

    def target(self, moved: Motion) -> FloatArray:
        """Return the torques (N, n) that the fitted parameters have to explain."""
        fixed = self.arm.arm.parameters.reshape(-1, 10).copy()
        fixed[self.bodies] = 0.0
        known = self.arm.torques(moved.q, moved.v, moved.a, parameters=fixed.ravel())
        if not self.damping:
            known = known + self.arm.damping * moved.v
        if not self.friction:
            from harness.physics.arms.arm import REST

            known = known + self.arm.friction * np.tanh(moved.v / REST)
        if not self.motor_inertia:
            known = known + self.arm.motor_inertia * moved.a
        return np.asarray(moved.mean_u - known)

    def blocks(self, moved: Motion, corner: float) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Return rows (M, n, k) and target (M, n), both low-passed at a corner [Hz] and thinned to what is left there.

        A relation between torques and motion that is linear in the parameters outlives any filter of both sides
        (parallel filtering; Gautier, Janot & Vandanjon 2013, IEEE Trans. Control Syst. Technol. 21:428). Of sharp
        torques and noisy accelerations the same relation is hidden under what neither side has in common.
        """
        from scipy import signal

        taps, step = low_pass(corner * float(moved.t[1] - moved.t[0]), len(moved.t))
        reach, n, target = len(taps) // 2, self.arm.n, self.target(moved)
        for first in range(reach, len(target) - reach, BLOCK * step):
            part = slice(first - reach, min(first + BLOCK * step, len(target) - reach) + reach)
            rows = self.rows(moved.q[part], moved.v[part], moved.a[part]).reshape(-1, n, len(self.names))
            if reach == 0:
                yield rows, target[part]
                continue
            both = np.concatenate([rows, target[part, :, None]], axis=2)
            slim = signal.oaconvolve(both, taps[:, None, None], mode="valid", axes=0)[::step]
            yield slim[:, :, :-1], slim[:, :, -1]

    def weighted(
        self, moved: Sequence[Motion], weigh: bool, corner: float = np.inf
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return G and s in units of the noise, and the residual rms (n,) of plain least squares, below a corner."""
        n = self.arm.n
        white = np.eye(n)
        spread = np.zeros((n, n))
        for _ in range(2):
            gram, side = np.zeros((len(self.names),) * 2), np.zeros(len(self.names))
            for rows, target in (pair for smoothed in moved for pair in self.blocks(smoothed, corner)):
                flat = (white @ rows).reshape(-1, rows.shape[2])
                gram += flat.T @ flat
                side += flat.T @ (target @ white.T).ravel()
            size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
            theta = np.linalg.pinv(gram / np.outer(size, size), rcond=1e-12, hermitian=True) @ (side / size) / size
            residuals = []
            for smoothed in moved:
                step = max(1, len(smoothed.t) // ENOUGH)
                pairs = self.blocks(smoothed, corner)
                residuals += [target[::step] - rows[::step] @ theta for rows, target in pairs]
            residual = np.concatenate(residuals)
            spread = residual.T @ residual / len(residual)
            level = np.sqrt(np.maximum(np.diag(spread), 1e-18 * max(float(np.trace(spread)), 1e-300)))
            # a floor for exact data: a millionth of the torques
            floor = 1e-6 * max(float(np.sqrt(np.mean(np.concatenate([self.target(m) for m in moved]) ** 2))), 1e-12)
            if weigh:
                white = whitening(np.vstack([residual, floor * np.sqrt(len(residual)) * np.eye(n)]))
            else:
                white = np.eye(n) / max(float(np.sqrt(np.mean(level**2))), floor)
        # What stands at joints that hardly move is held by a torque of the size seen there, no more.
        first = 10 * len(self.bodies)
        torque = np.sqrt(np.mean(np.concatenate([smoothed.mean_u for smoothed in moved]) ** 2, axis=0))
        start = np.concatenate([getattr(self.arm, kind, np.zeros(n)) for kind in self.kinds] or [np.zeros(0)])
        reach = {"damping": SLOW, "friction": 1.0, "motor_inertia": SLOW}
        loose = np.concatenate([torque / reach[kind] for kind in self.kinds] or [np.zeros(0)])
        loose = np.maximum(loose, 1e-9 * max(float(loose.max(initial=0.0)), 1e-9))
        gram[np.arange(first, len(side)), np.arange(first, len(side))] += loose**-2
        side[first:] += start / loose**2
        return gram, side, np.sqrt(np.diag(spread))

    def unpacked(self, x: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return the inertial parameters of all bodies, and what stands at the joints."""
        table = self.arm.arm.parameters.reshape(-1, 10).copy()
        table[self.bodies] = x[: 10 * len(self.bodies)].reshape(-1, 10)
        n, remaining = self.arm.n, x[10 * len(self.bodies) :]
        found = {"damping": self.arm.damping, "friction": self.arm.friction, "motor_inertia": self.arm.motor_inertia}
        found |= {kind: remaining[place * n : place * n + n] for place, kind in enumerate(self.kinds)}
        return table.ravel(), found


def band(moved: Sequence[Motion]) -> float:
    """Return the frequency [Hz] below which nearly all power of the rates is, at the joint where it reaches farthest.

    Parameters
    ----------
    moved : sequence of Motion
    """
    sizes = np.sqrt(np.mean(np.concatenate([smoothed.v for smoothed in moved]) ** 2, axis=0))
    fast = sizes > MOVES * sizes.max(initial=0.0)
    highest = 0.0
    for smoothed in moved:
        v = smoothed.v[:, fast]
        power = np.abs(np.fft.rfft((v - v.mean(axis=0)) * np.hanning(len(v))[:, None], axis=0)) ** 2
        held = np.cumsum(power, axis=0) >= BAND * power.sum(axis=0)
        frequencies = np.fft.rfftfreq(len(v), float(smoothed.t[1] - smoothed.t[0]))
        highest = max(highest, float(frequencies[np.argmax(held, axis=0)].max(initial=0.0)))
    return highest


def speaks(arm: ArmModel, spec: PlantSpec, what: str) -> None:
    """Refuse records whose signals are not those of the arm, by name.

    Raises FitError if they are not.
    """
    inputs, outputs = [c.name for c in spec.inputs], [c.name for c in spec.outputs]
    missing = [position.name for position in arm.positions if position.name not in outputs]
    if inputs != [channel.name for channel in arm.inputs] or missing:
        raise FitError(
            f"{what}: the records do not speak the language of {arm.name}",
            expected=f"{', '.join(c.name for c in arm.inputs)} -> {', '.join(c.name for c in arm.positions)}",
            got=str(spec),
            remedy="rename the signals, or choose another model",
        )
