"""Inertial parameters of a robot whose base floats, from a record of its motion: with or without forces at its feet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from harness.algebra import unit_columns
from harness.errors import FitError, InputError
from harness.models.analysis import Findings, Takes
from harness.physics.arms.contact import friction_cone, restitution
from harness.physics.arms.floating import FloatingRobot, load_floating
from harness.physics.arms.inertia import is_consistent, pseudo_inertia
from harness.physics.arms.inertial_fit import Bodies, InertialProblem, by_semidefinite_program
from harness.physics.lumps.identifiability import identifiability
from harness.signals import Dataset, FloatArray, Trajectory
from identifiers.mechanics.arms.floating_rows import Rows, channels_of, floating_motion, measured, rows_of
from identifiers.mechanics.motion import Smoothing

if TYPE_CHECKING:
    from harness.physics.lumps.identifiability import Identifiability

BLOCKS = 20  # Stretches of the record, by which the spread of a parameter is told whatever the colour of its errors.
SEEN = 1e-5  # What is new in a column, relative to it, below which the record does not tell it from the others.
ROUNDS, FAR = 5, 2.0  # Rounds of the weights, and standard deviations from which on an equation counts less.
WIDE = 2.093  # Student's t for 95 % and 19 degrees of freedom.


@dataclass(frozen=True)
class OnSites:
    """A robot without a fixed base, and the sites at which it touches.

    Parameters
    ----------
    model : str
        An MJCF with one free joint.
    contacts : sequence of str
        Sites at which something may touch.
    radius : float
        Of the ball around such a site: the force acts so far below it [m].

    Raises
    ------
    InputError
        If the file or a name cannot be used.
    FitError
        If the record lacks a signal.
    """

    takes: ClassVar[Takes] = "data"
    model: str = ""
    contacts: Sequence[str] = ()
    radius: float = 0.0


@dataclass(frozen=True)
class FloatingInertial(OnSites):
    """Inertial parameters of a floating robot from its motion, torques and contact forces; what can be told at all.

    The equations of the whole tree with the base's six rows are linear in ten parameters a body. A force that was
    measured at a site enters by the transpose of its Jacobian; one that was not is eliminated by the null space of it
    (Mistry, Schaal & Yamane 2009, *Humanoids*, eq. 7). What that costs is shown: the rank, and the spread of every
    parameter. Channels are named as the plant ``mjcf`` names them: ``base_x`` ... ``base_z``, ``base_qw`` ...
    ``base_qz``, where measured ``base_wx`` ... ``base_wz``, ``q1`` ..., ``tau1`` ... (inputs or outputs), and
    ``SITE_force_x`` ... ``SITE_force_z`` in the axes of the world.

    Parameters
    ----------
    contacts : sequence of str
        Sites at which something may touch, measured or not.
    unmeasured : sequence of str
        Contacts whose force is eliminated although the record has it.
    free : sequence of str, optional
        Bodies that are fitted; the others stay as in the file. All by default.
    trust : float
        Relative standard deviation of the file's inertial parameters.
    friction : bool
        Fit damping and dry friction of the joints beside.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal", "none"}
    """

    unmeasured: Sequence[str] = ()
    free: Sequence[str] | None = None
    trust: float = 0.3
    friction: bool = True
    smoothing: Smoothing = "auto"

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        robot = _robot(self.model, self.contacts, self.unmeasured)
        return channels_of(robot, self.contacts)

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return the bodies, with their spreads, and what the record tells."""
        del rng
        robot = _robot(self.model, self.contacts, self.unmeasured)
        hidden = [site for site in self.contacts if site in self.unmeasured or not _has_force(subject, site)]
        parts = [self._rows(robot, run.trajectory, hidden) for run in subject.runs]
        chosen = self._chosen(robot)
        fixed = np.concatenate([robot.arm.parameters, *_at_joints(robot)])
        free = np.array([10 * body + k for body in chosen for k in range(10)], dtype=int)
        if self.friction:
            free = np.concatenate([free, 10 * len(robot.names) + np.arange(2 * robot.n)])
        names = tuple(parts[0].names[k] for k in free)
        matrix = np.concatenate([part.matrix for part in parts])
        target = np.concatenate([part.target for part in parts]) - np.delete(matrix, free, axis=1) @ np.delete(
            fixed, free
        )
        matrix, block = matrix[:, free], _blocks(parts)
        told = identifiability(matrix, names, tolerance=SEEN)
        weights = _weights(matrix, target, np.concatenate([part.kind for part in parts]))
        problem = self._problem(robot, chosen, matrix * weights[:, None], target * weights)
        x = by_semidefinite_program(problem)
        residual = target - matrix @ x
        spread = _spread(problem, x, matrix * weights[:, None], residual * weights, block)
        share = 1.0 - float(residual @ residual) / max(float(target @ target), 1e-300)
        table = [self._row(robot, body, x[10 * k : 10 * k + 10], spread[10 * k : 10 * k + 10])
                 for k, body in enumerate(chosen)]  # fmt: skip
        words = [
            f"{len(target)} equations explain {100 * share:.4g} % of the generalized forces",
            _told(robot, told, chosen, complete=not hidden),
        ]
        if hidden:
            words.append(self._lost(robot, subject, free, matrix, told, hidden))
        units = tuple(parts[0].units[k] for k in free)
        details = {"names": list(names), "units": list(units), "values": x, "spread": spread, "rank": told.rank,
                   "determined": [names[k] for k in told.kept], "combinations": list(told.combinations)}  # fmt: skip
        return Findings(f"bodies of {robot.model.name}", table, words, details)

    def _rows(self, robot: FloatingRobot, record: Trajectory, hidden: Sequence[str], *, forces: bool = True) -> Rows:
        return rows_of(
            robot, record, self.contacts, hidden, radius=self.radius, smoothing=self.smoothing, forces=forces
        )

    def _chosen(self, robot: FloatingRobot) -> list[int]:
        """Return the numbers of the bodies that are fitted."""
        asked = list(robot.names) if self.free is None else list(self.free)
        table = robot.arm.parameters.reshape(-1, 10)
        wrong = [name for name in asked if name not in robot.names]
        wrong += [name for name in asked if name in robot.names and not is_consistent(table[robot.names.index(name)])]
        if wrong or not asked:
            raise InputError(
                "option free",
                expected=f"bodies with mass among {', '.join(robot.names)}",
                got=", ".join(wrong) or "none",
                remedy="correct it",
            )
        return [robot.names.index(name) for name in asked]

    def _problem(
        self, robot: FloatingRobot, chosen: Sequence[int], matrix: FloatArray, target: FloatArray
    ) -> InertialProblem:
        """Return the problem of consistent bodies beside the prior, then friction that is not negative."""
        prior = robot.arm.parameters.reshape(-1, 10)[list(chosen)]
        gram, side = matrix.T @ matrix, matrix.T @ target
        others = np.arange(prior.size, len(gram))
        gram[others, others] += 1e-8 * float(np.diag(gram).max())  # of joints that do not move
        return InertialProblem(gram, side, Bodies(prior), self.trust, np.ones(len(others), dtype=bool))

    def _row(self, robot: FloatingRobot, body: int, row: FloatArray, spread: FloatArray) -> dict[str, Any]:
        """Return what is shown of a body."""
        stated = robot.arm.parameters.reshape(-1, 10)[body]
        return {
            "body": robot.names[body],
            "mass of the file [kg]": float(stated[0]),
            "mass [kg]": float(row[0]),
            "+- (95 %)": float(WIDE * spread[0]),
            **{f"centre {axis} [m]": float(row[1 + k] / row[0]) for k, axis in enumerate("xyz")},
        }

    def _lost(
        self, robot: FloatingRobot, subject: Dataset, free: FloatArray, matrix: FloatArray, told: Identifiability,
        hidden: Sequence[str],
    ) -> str:  # fmt: skip
        """Return what the same motion would tell if every contact force were measured."""
        parts = [self._rows(robot, run.trajectory, (), forces=False) for run in subject.runs]
        every = np.concatenate([part.matrix for part in parts])[:, free]
        rank = identifiability(every, told.names, tolerance=SEEN).rank
        kept = list(told.kept)
        errors = [np.sqrt(np.diag(np.linalg.pinv(rows[:, kept].T @ rows[:, kept]))) for rows in (matrix, every)]
        lost = f"{told.rank} of {rank} combinations" if rank > told.rank else f"all {rank} combinations"
        return (
            f"forces at {', '.join(hidden)} are not measured and were eliminated, {len(every) - len(matrix)} of "
            f"{len(every)} equations with them: {lost} are still told (friction among them), their spread "
            f"{np.median(errors[0] / errors[1]):.2g} times (up to {np.max(errors[0] / errors[1]):.2g}) what it "
            "were with these forces measured"
        )


@dataclass(frozen=True)
class Contacts(OnSites):
    """Friction cone and restitution of the contacts of a floating robot, from measured forces and its motion.

    Channels as of :class:`FloatingInertial`; the ground is level and at rest.

    Parameters
    ----------
    contacts : sequence of str
        Sites whose force was measured.
    fast : float
        Speed from which on a contact slides [m/s].
    smoothing : {"none", "auto", "local", "spline", "kalman", "forward", "causal"}
        None by default: an impact is no smooth motion (give measured rates).
    """

    fast: float = 0.01
    smoothing: Smoothing = "none"

    def channels(self) -> tuple[list[str], list[str]]:
        """Return the columns that it needs of a bare table, and those that it takes where they are there."""
        return channels_of(_robot(self.model, self.contacts, ()), self.contacts)

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return a row for every contact."""
        del rng
        robot = _robot(self.model, self.contacts, ())
        table = []
        for site in self.contacts:
            force, speed, impacts = [], [], []
            for run in subject.runs:
                record = run.trajectory
                moved = floating_motion(robot, record, self.smoothing)
                others = measured(record, [f"{site}_force_{axis}" for axis in "xyz"], torques=False)
                generalized = np.concatenate([moved.in_base(moved.velocity), moved.base.spin, moved.v], axis=1)
                jacobian = robot.jacobian(site, moved.q, moved.below(self.radius))[:, :3]
                own = np.einsum("nci,ni->nc", jacobian, generalized)
                speed.append(np.einsum("nij,nj->ni", moved.base.rotation, own))
                force.append(np.stack([others[f"{site}_force_{axis}"][moved.rows] for axis in "xyz"], axis=1))
                try:
                    impacts.append(restitution(speed[-1][:, 2], force[-1][:, 2]))
                except FitError:  # a foot that never falls
                    continue
            cone = friction_cone(np.concatenate(force), np.concatenate(speed), fast=self.fast)
            slow = [one.after / one.before for one in impacts]
            table.append(
                {
                    "contact": site,
                    "friction, sliding": cone.sliding,
                    "spread": cone.spread,
                    "samples of it": cone.samples,
                    "at least, sticking": cone.at_least,
                    "restitution": float(np.median(np.concatenate(slow))) if slow else None,
                    "impacts": sum(len(one) for one in slow),
                }
            )
        words = [
            "friction of sliding is that of the force against the motion; where a contact sticks its cone is wider"
        ]
        return Findings(f"contacts of {robot.model.name}", table, words)


def _robot(model: str, contacts: Sequence[str], unmeasured: Sequence[str]) -> FloatingRobot:
    """Return the robot of a file; refuse contacts that are no sites of it."""
    if not model:
        raise InputError("option model", expected="an MJCF with a free joint", got="none", remedy="give model=FILE.xml")
    robot = load_floating(model)
    for site in (*contacts, *unmeasured):
        if site not in robot.points or site not in contacts:
            raise InputError(
                f"contact {site!r}",
                expected=f"sites of the file ({', '.join(robot.points) or 'none'}), unmeasured ones among contacts",
                got=repr(site),
                remedy="name it in contacts",
            )
    return robot


def _has_force(dataset: Dataset, site: str) -> bool:
    """Return whether every record holds the force at a site."""
    wanted = {f"{site}_force_{axis}" for axis in "xyz"}
    return all(
        wanted <= {channel.name for channel in (*run.trajectory.spec.inputs, *run.trajectory.spec.outputs)}
        for run in dataset.runs
    )


def _at_joints(robot: FloatingRobot) -> tuple[FloatArray, FloatArray, FloatArray]:
    model = robot.model
    return model.damping, model.friction, model.motor_inertia


def _blocks(parts: Sequence[Rows]) -> FloatArray:
    """Return the stretch (of :data:`BLOCKS` in all) to which each row belongs."""
    counts = [int(part.sample.max()) + 1 for part in parts]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    every = np.concatenate([part.sample + start for part, start in zip(parts, first, strict=True)])
    return np.asarray(np.minimum(every * BLOCKS // sum(counts), BLOCKS - 1))


def _weights(matrix: FloatArray, target: FloatArray, kind: NDArray[np.intp]) -> FloatArray:
    """Return by what each equation (M,) is multiplied: 1 over the errors of its coordinate, less where it is far off.

    Of an impact a record holds neither the force nor the acceleration between two samples (Huber 1964, *Ann. Math.
    Stat.* 35:73; the errors' size by their median).
    """
    scaled = unit_columns(matrix)
    floor = 1e-6 * float(np.std(target))
    size, own = np.zeros(len(target)), np.full(len(target), 1.0)
    for _ in range(ROUNDS):
        left = target - scaled @ np.linalg.lstsq(scaled * own[:, None], target * own, rcond=SEEN)[0]
        for k in np.unique(kind):
            size[kind == k] = 1.4826 * float(np.median(np.abs(left[kind == k]))) + floor
        own = np.sqrt(np.minimum(1.0, FAR * size / np.maximum(np.abs(left), 1e-300))) / size
    return own


def _spread(
    problem: InertialProblem, x: FloatArray, matrix: FloatArray, residual: FloatArray, block: FloatArray
) -> FloatArray:
    """Return standard deviations (k,) at an optimum: the score of each stretch of the record over the curvature.

    Errors of one stretch may have any colour (White 1980, *Econometrica* 48:817, with blocks for rows). Where the
    prior decides, its own doubt counts as well; its curvature is that of the divergence, ``tr(J^-1 dJ J^-1 dJ)``.
    """
    prior = np.zeros_like(problem.gram)
    units = pseudo_inertia(np.eye(10))
    for body in range(len(problem.bodies.prior)):
        own = slice(10 * body, 10 * body + 10)
        turned = np.linalg.solve(pseudo_inertia(x[own]), units)
        prior[own, own] = problem.weight * np.einsum("aij,bji->ab", turned, turned)
    scores = np.stack([matrix[block == b].T @ residual[block == b] for b in range(BLOCKS)])
    scores = scores - scores.mean(axis=0)
    curvature = problem.gram + prior
    size = np.sqrt(np.diag(curvature))
    inverse = np.linalg.inv(curvature / np.outer(size, size)) / np.outer(size, size)
    told = BLOCKS / (BLOCKS - 1) * np.sum((inverse @ scores.T) ** 2, axis=1)
    return np.asarray(np.sqrt(told + np.diag(inverse @ prior @ inverse)))


def _told(robot: FloatingRobot, told: Identifiability, chosen: Sequence[int], *, complete: bool) -> str:
    """Return the rank in words, beside that of the richest motion where all bodies are asked about."""
    inertial = [k for k in told.kept if k < 10 * len(chosen)]
    text = f"{len(inertial)} combinations of {10 * len(chosen)} inertial parameters are told"
    if len(chosen) == len(robot.names) and complete:
        most = 10 * len(robot.names) - sum(3 if channel.unit == "rad" else 6 for channel in robot.model.positions)
        text += f" (a tree of {robot.n} joints on a base that floats has at most {most}: 3 less for each that turns)"
    return text
