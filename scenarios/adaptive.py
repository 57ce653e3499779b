"""Adaptive control: a controller that learns the mechanism while it tracks, by Slotine and Li or by an identifier."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.options import check_options
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec
from scenarios.closed_loop import ArmTracking

SMALL = 1e-3  # Scale of a lumped parameter that is believed to be 0, relative to the largest.


@dataclass(frozen=True, kw_only=True)
class AdaptiveControl(ArmTracking):
    """Mechanism with a motor at every joint that tracks a reference while its parameters are learned.

    ``slotine-li``: with e = q_ref - q, the virtual rate ``v_r = v_ref + w e`` and ``s = v_r - v``, the torque is
    ``Y(q, v, v_r, a_r) theta + K s`` and the lumped parameters follow ``theta' = Gamma Y' s`` (Slotine & Li 1987, Int.
    J. Robotics Res. 6(3):49, eq. 13-17): errors of tracking vanish whatever is believed at first, those of the
    parameters if the reference is rich. ``identifier``: an online identifier with a model of the mechanism (``ekf``,
    ``ukf``) runs in the loop, and computed torque uses what it knows at each sample. Options of the reference:
    ``ArmTracking``; ``amplitude=0`` with a ``move`` is a set point.

    Parameters
    ----------
    mechanism : str
        Model with as many inputs as coordinates.
    believed : float or mapping
        What the controller believes at first: all parameters of the model that are not fixed times a number, or values
        by name.
    method : {"slotine-li", "identifier"}
    identifier : str or object
        Online identifier by name, or one that is made.
    move : mapping, optional
        By how much the reference moves away from the start, by output name [rad or m].
    adaptation : float
        Gamma relative to (believed lumped parameter)^2 / (energy of the believed mechanism at the rate w).
    feedback : float
        K relative to w times the believed inertia of each joint.

    Notes
    -----
    The controller of the prepared experiment keeps ``names`` and ``estimates``, a row of lumped parameters for every
    sample.
    """

    mechanism: str = "pendulum"
    believed: float | Mapping[str, float] = 0.2
    method: Literal["slotine-li", "identifier"] = "slotine-li"
    identifier: Any = "ekf"
    move: Mapping[str, float] = field(default_factory=dict)
    adaptation: float = 1.0
    feedback: float = 2.0
    natural_frequency: float = 5.0

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; raises InputError if model or options do not fit the plant."""
        check_options(self, "adaptive-control", adaptation="> 0", feedback="> 0")
        plain = super().prepare(spec, streams=streams, role=role)
        tracking: Any = plain.controller
        learner = None
        if self.method == "identifier":
            learner = _online(self.identifier, self.mechanism, tracking.law.parameters)
        learning = _Learning(tracking, learner, spec, plain.excitation, streams(f"{role}/identifier"))
        return replace(plain, controller=learning)

    def law(self, spec: PlantSpec) -> _Adaptive:
        """Return the feedback law for this plant."""
        return _Adaptive(self, spec)

    def _planned(
        self, n: int, spec: PlantSpec, positions: list[int], *, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the reference about the start, (3, n, joints): the random one, and the move."""
        names = [spec.outputs[i].name for i in positions]
        refuse_unknown("option move", self.move, names)
        moves = np.zeros((3, n, len(names)))
        moves[0] = [self.move.get(name, 0.0) for name in names]
        t: FloatArray = np.arange(n, dtype=np.float64) * spec.sample_time
        return self._reference(n, spec, positions, rng=rng) + self.faded(t, moves), None


class _Adaptive:
    """The law of one run: lumped parameters, and the torque from them."""

    def __init__(self, options: AdaptiveControl, spec: PlantSpec) -> None:
        from harness.physics import Mechanism, load_model, lumped

        system = load_model(options.mechanism)
        if not isinstance(system.mechanism, Mechanism) or len(system.coordinates) != spec.nu or system.nu != spec.nu:
            raise InputError(
                "model of adaptive-control",
                expected=f"a mechanism with {spec.nu} coordinates, each with a motor",
                got=str(system),
                remedy="choose the plant's own model",
            )
        fixed = {one.name: one.value for one in system.parameters if one.fixed}
        self.regression = lumped(system.mechanism, known=fixed)
        self.parameters = _believed(system, options.believed)
        self.theta = self.regression.values(self.parameters)
        self.learns = options.method == "slotine-li"
        self.options, self.dt = options, spec.sample_time
        still = np.zeros((1, spec.nu))
        none = self.regression.target(still, still, still, still)
        self.drive = np.column_stack(
            [self.regression.target(still, still, still, unit[None]) - none for unit in np.eye(spec.nu)]
        )
        if np.linalg.matrix_rank(self.drive) < spec.nu:
            raise InputError(
                "model of adaptive-control",
                expected="a motor for every coordinate",
                got=str(system),
                remedy="use a mechanism that is not underactuated",
            )
        self.gains: tuple[FloatArray, FloatArray] | None = None

    def __call__(self, q: FloatArray, v: FloatArray, wanted: FloatArray) -> FloatArray:
        """Return the torque (n,) for position, rate and reference (3, n)."""
        options, w = self.options, self.options.natural_frequency
        error, slower = wanted[0] - q, wanted[1] - v
        if not self.learns:
            aim = wanted[2] + 2 * options.damping_ratio * w * slower + w**2 * error
            return self._torque(self._rows(q, v, aim))
        if self.gains is None:
            self.gains = self._gains(q)
        feedback, gamma = self.gains
        s = slower + w * error
        rows = self._bilinear(q, v, wanted[1] + w * error, wanted[2] + w * slower)
        torque = self._torque(rows) + np.linalg.solve(self.drive, feedback * s)
        self.theta = self.theta + self.dt * gamma * (rows[:, :-1].T @ s)
        return torque

    def knows(self, parameters: Mapping[str, float]) -> None:
        """Take over what an identifier knows."""
        self.theta = self.regression.values({**self.parameters, **parameters})

    def _rows(self, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the torque form's rows (n, k + 1): a column for each lumped parameter, the last what is known."""
        known = self.regression.target(q[None], v[None], a[None], np.zeros((1, len(q))))
        return np.column_stack([self.regression.regressor(q[None], v[None], a[None]), -known.reshape(-1)])

    def _force(self, rows: FloatArray) -> FloatArray:
        """Return the forces (n,) that rows stand for with what is believed."""
        return np.asarray(rows @ np.append(self.theta, 1.0))

    def _torque(self, rows: FloatArray) -> FloatArray:
        """Return the inputs that give the forces of these rows."""
        return np.asarray(np.linalg.solve(self.drive, self._force(rows)))

    def _bilinear(self, q: FloatArray, v: FloatArray, rate: FloatArray, a: FloatArray) -> FloatArray:
        """Return Y(q, v, v_r, a_r): quadratic terms of the rates are polarised, which gives Christoffel's C(q, v) v_r.

        Terms odd in the rates are friction, which is compensated at the rate that is there.
        """
        zero = np.zeros_like(q)
        rest = self._rows(q, zero, zero)

        def even(x: FloatArray) -> FloatArray:
            return 0.5 * (self._rows(q, x, zero) + self._rows(q, -x, zero)) - rest

        odd = 0.5 * (self._rows(q, v, zero) - self._rows(q, -v, zero))
        return self._rows(q, zero, a) + 0.5 * (even(v + rate) - even(v) - even(rate)) + odd

    def _gains(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return K (n,) and Gamma (k,), scaled by the mechanism that is believed at the start."""
        zero, w = np.zeros_like(q), self.options.natural_frequency
        weight = self._rows(q, zero, zero)
        inertia = np.array(
            [self._force(self._rows(q, zero, unit) - weight)[row] for row, unit in enumerate(np.eye(len(q)))]
        )
        size = np.maximum(np.abs(self.theta), SMALL * np.abs(self.theta).max())
        energy = float(np.sum(inertia)) * w**2
        return self.options.feedback * w * inertia, self.options.adaptation * size**2 / energy


class _Learning:
    """The controller of one run: tracks, and lets an identifier learn from what was applied."""

    def __init__(
        self, tracking: Any, learner: Any, spec: PlantSpec, excitation: FloatArray, rng: np.random.Generator
    ) -> None:
        self.tracking, self.learner, self.spec, self.excitation, self.rng = tracking, learner, spec, excitation, rng
        self.references = tracking.references
        self.names = tracking.law.regression.names
        self._rows: list[FloatArray] = []
        self._state: Any = None
        self._u: FloatArray | None = None

    @property
    def estimates(self) -> FloatArray:
        """Lumped parameters (N, k) that the controller used."""
        return np.array(self._rows)

    def __call__(self, t: float, y: FloatArray) -> FloatArray:
        """Return the torque (nu,)."""
        law = self.tracking.law
        if self.learner is not None:
            if self._u is None:
                self._state = self.learner.start(self.learner.init(self.spec, rng=self.rng), y)
            else:
                self._state = self.learner.update(self._state, self._u, y)
                law.knows(self._state.parameters)
        self._rows.append(law.theta.copy())
        torque: FloatArray = self.tracking(t, y)
        k = min(round(t / self.spec.sample_time), len(self.excitation) - 1)
        self._u = torque + self.excitation[k]
        return torque


def _believed(system: Any, believed: float | Mapping[str, float]) -> dict[str, float]:
    """Return the parameters that the controller starts with."""
    known: dict[str, float] = system.values()
    if isinstance(believed, Mapping):
        return dict(system.values(dict(believed)))
    return {one.name: known[one.name] * (1.0 if one.fixed else float(believed)) for one in system.parameters}


def _online(source: Any, model: str, start: Mapping[str, float]) -> Any:
    """Return an online identifier whose state tells physical parameters."""
    if hasattr(source, "update") and hasattr(source, "init"):
        return source
    for entry in entry_points(group="sysid_harness.identifiers", name=str(source)):
        return entry.load()(model, start=dict(start))
    raise InputError(
        "option identifier",
        expected="an online identifier of a physical model (ekf, ukf), by name or made",
        got=repr(source),
        remedy="choose one",
    )
