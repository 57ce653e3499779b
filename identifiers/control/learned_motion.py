"""A motion under feedback alone, with a feed-forward, and learned by repetition: what each costs on the plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from harness.errors import FitError, InputError
from harness.models.analysis import Findings, Takes
from harness.models.lqr import lqr_gain
from harness.options import check_options
from harness.scoring import linearise
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import Columns, refuse_feedback
from identifiers.control.planning import Limits, Moves, QuadraticCost, limited_change, riccati, within
from identifiers.control.repeating import MotionPlan, Observer, Repeated, Repetition, quiet
from identifiers.linear.arx import one_step
from identifiers.linear.iterative import TimeVarying
from identifiers.linear.time_varying import AlongTrajectory, AlongTrajectoryModel

LQR, AHEAD = "LQR alone", "LTI feed-forward"
STILL, ALONG, ITERATIVE, SPLIT = "LTI ILC", "LTV ILC", "iLQR", "ADMM-ILC"

_COLOURS = {LQR: "C0", AHEAD: "C1", ALONG: "C2", SPLIT: "C3", ITERATIVE: "C4", STILL: "C5"}

_LONGEST, _SHORTEST = 400, 20  # Samples of a motion: matrices of all its inputs are solved with; a model needs some.

_FREE = 1e-9
"""Proximity where a model is trusted everywhere, relative to the mean curvature of the cost: rounding only."""

_RETREAT = 100.0  # A correction that costs more is taken back, and the next one held back so many times as much.
_HINDSIGHT = 25  # Corrections with the true slopes of the plant; it ends where they gain no more than this share:
_GAINED = 1e-5

_PUSH = 1e-4  # Step of the differences on the true plant, relative to the size of the inputs.
_FEWEST = 3  # Repetitions that came to their end, at least, for a model along them.

_REMEMBERED = 4
"""Rounds of repetitions that a model along the motion learns from: later motions are close to each other."""

_LEAST = 2.0  # Departure of inputs from a law of the outputs, in its noise, as of ``least-squares``.


@dataclass(frozen=True, eq=False)
class _Row:
    method: str
    number: int
    cost: float
    rms: float
    asked: float
    change: float


@dataclass(frozen=True)
class LearnedMotion:
    """A motion by feedback alone, with a feed-forward, and learned by repetition, on a plant that is to be identified.

    The first output is to step (or glide) by a height. A Kalman filter and an LQR designed on the plant that is
    believed hold the operating point while records are taken with random steps added to the input. From there on
    only what is identified counts. ``LQR alone``: a time-invariant model of these records, its observer and its LQR
    about the new set point. ``LTI feed-forward``: the inputs of least cost on that model, the same feedback about
    them. ``LTV ILC``: a model along the motion (``along-trajectory``) of some repetitions with random steps; the inputs
    of least cost by it about the motion that was *measured*; again (norm-optimal iterative learning: Amann, Owens &
    Rogers 1996, IEE Proc. D 143:217). ``LTI ILC``: the same with the time-invariant model. ``iLQR``: a Riccati
    recursion about the measured motion gives the new inputs and a feedback of its own for every sample (Li & Todorov
    2004). ``ADMM-ILC``: the inputs of least cost within the actuator's limits, by splitting cost and limits (Boyd et
    al. 2011); the others ask for what the actuator clips. A correction that costs more than the best so far is
    taken back and the next one held back. Cost ``sum (y - y*)' q (y - y*) + u' r u`` of noise-free outputs and applied
    inputs; regret is what the repetitions so far cost more than as many of the best input in hindsight, which is
    optimised with the slopes of the true plant, within the limits.

    Parameters
    ----------
    believed : mapping
        Options of the plant that the first controller is designed on, such as ``parameters``; without them the first
        records are taken without feedback, for plants that are stable at the point.
    start : mapping
        State at the operating point, by name: an equilibrium under zero input, from which every repetition begins.
    varied : mapping
        Standard deviation of states at the start of each repetition, by name.
    height : float
        Of the motion of the first output, in its unit.
    shape : {"step", "glide"}
        At once, or along a cycloid over a third of the motion.
    duration : float
        [s].
    repetitions : int
        Corrections.
    trials : int
        Repetitions with random steps from which a model is made.
    excitation : float
        Standard deviation of the random steps, in the unit of the inputs.
    noise : float
        Standard deviation of the sensors, in the unit of each output.
    order : int
        Past outputs and inputs in the models.
    q, r : float or sequence
        Weights of outputs and inputs: one number, or one each.
    limit, change : float, optional
        Of the actuator: largest size of an input (by default that of the plant) and largest change in a sample.
    effort : float
        What changes of the inputs cost, relative to the mean curvature of the cost.
    """

    takes: ClassVar[Takes] = "maker"
    believed: dict[str, Any] = field(default_factory=dict)
    start: dict[str, float] = field(default_factory=dict)
    varied: dict[str, float] = field(default_factory=dict)
    height: float = 0.2
    shape: Literal["step", "glide"] = "step"
    duration: float = 10.0
    repetitions: int = 6
    trials: int = 8
    excitation: float = 0.1
    noise: float = 1e-3
    order: int = 2
    q: float | Sequence[float] = 1.0
    r: float | Sequence[float] = 0.1
    limit: float | None = None
    change: float | None = None
    effort: float = 1e-3

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return cost, tracking error and regret at every repetition of every method."""
        self._check()
        with subject() as plant:
            stage = _Stage(self, plant, subject, int(rng.integers(2**62)))
            rows: list[_Row] = []
            shown: dict[str, Repetition] = {}
            still = stage.still()
            for name, plan in ((LQR, stage.held(still)), (AHEAD, stage.ahead(still))):
                row, shown[name] = stage.scored(name, 0, plan)
                rows.append(row)
            first = stage.ahead(still)
            for name in (STILL, ALONG, ITERATIVE, *((SPLIT,) if stage.limits.any else ())):
                found, shown[name] = stage.learned(name, first, still)
                rows += found
            best, ideal = stage.hindsight(shown, first)
        return _findings(stage, rows, shown, best, ideal)

    def _check(self) -> None:
        above = dict.fromkeys(("duration", "excitation", "height", "effort", "limit", "change"), "> 0")
        check_options(self, "learned-motion", **above, noise=">= 0", repetitions=">= 1", order=">= 1", trials=">= 3")


class _Stage:
    """The plant, the motion that is asked for, and what is tried on it."""

    def __init__(self, options: LearnedMotion, plant: Any, make: Callable[..., Any], seed: int) -> None:
        spec = plant.spec
        count = round(options.duration / spec.sample_time)
        if not _SHORTEST <= count <= _LONGEST:
            raise InputError(
                "learned-motion",
                expected=f"{_SHORTEST} to {_LONGEST} samples of motion",
                got=str(count),
                remedy="choose another sample_time or duration",
            )
        low = np.array([channel.minimum for channel in spec.inputs], dtype=float)
        high = np.array([channel.maximum for channel in spec.inputs], dtype=float)
        if options.limit is not None:
            low, high = np.maximum(low, -options.limit), np.minimum(high, options.limit)
        change = np.full(spec.nu, np.inf if options.change is None else options.change)
        self.options, self.seed, self.limits = options, seed, Limits(low, high, change)
        self.repeated = Repeated(
            plant, options.start, samples=count, limits=self.limits, noise=options.noise, varied=options.varied,
            size=options.height,
        )  # fmt: skip
        self.spec, self.count = self.repeated.spec, count
        rise: FloatArray = np.ones(count)
        if options.shape == "glide":
            part = np.clip(np.arange(count) / (count / 3), 0.0, 1.0)
            rise = part - np.sin(2 * np.pi * part) / (2 * np.pi)
        reference = np.zeros((count, spec.ny))
        reference[:, 0] = options.height * rise
        weights = [np.broadcast_to(np.asarray(one, dtype=float), (n,)).copy() for one, n in
                   ((options.q, spec.ny), (options.r, spec.nu))]  # fmt: skip
        self.cost = QuadraticCost(reference, weights[0], weights[1])
        self.quiet = quiet(options.height, options.noise)
        self.first = self._believed(plant, make)
        self.trials = 0

    # ---- models ------------------------------------------------------------------------------------------------------

    def still(self) -> AlongTrajectoryModel:
        """Return the time-invariant model of records about the operating point."""
        options = self.options
        records = self._excited(self.first, "still")
        if not records:
            raise FitError(
                "learned-motion: the first records",
                expected="repetitions that stay about the operating point",
                got="all leave it",
                remedy="say what is believed of the plant (believed), or less excitation",
            )
        solution = one_step(records, options.order, False, 0.0, "learned-motion")
        refuse_feedback(solution, Columns(self.spec, options.order), _LEAST, "learned-motion")
        theta = np.vstack([solution.coefficients, np.zeros((1, self.spec.ny))])  # an equilibrium needs no constant
        self.residual = np.asarray(solution.residual_rms, dtype=float).reshape(-1)
        return AlongTrajectoryModel(self.spec, theta[None], options.order)

    def _believed(self, plant: Any, make: Callable[..., Any]) -> MotionPlan:
        """Return the feedback of the plant that is believed, about the operating point."""
        options, n = self.options, self.count
        zero = np.zeros((n, self.spec.nu)), np.zeros((n, self.spec.ny))
        if not options.believed:
            blind = Observer(np.zeros((1, 1)), np.zeros((1, self.spec.nu)), np.zeros((self.spec.ny, 1)),
                             np.zeros((1, self.spec.ny)))  # fmt: skip
            return MotionPlan(*zero, np.zeros((n, self.spec.nu, 1)), blind)
        with make(**options.believed) as belief:
            model = linearise(belief, x0=options.start)
        parts = model.a_matrix, model.b_matrix, model.c_matrix
        return self._fed_back(parts, options.excitation**2 * parts[1] @ parts[1].T, *zero)

    def _fed_back(
        self, parts: tuple[FloatArray, FloatArray, FloatArray], pushed: FloatArray, u: FloatArray, y: FloatArray
    ) -> MotionPlan:
        a, b, c = parts
        # What the cost does not see is weighed a little: the Riccati equation has a solution where it is stabilisable.
        gain = lqr_gain(a, b, (c.T * self.cost.q) @ c + _FREE * np.eye(len(a)), np.diag(self.cost.r))
        watch = Observer.of(parts, pushed + _FREE * self.quiet**2 * np.eye(len(a)), self.quiet)
        if gain is None or watch is None:
            raise FitError(
                "learned-motion: no controller",
                expected="a model that can be stabilised and observed",
                got="none",
                remedy="say more of the plant, or record with more excitation",
            )
        return MotionPlan(u, y, np.repeat(gain[None], self.count, axis=0), watch)

    def _excited(self, plan: MotionPlan, *key: str) -> list[Trajectory]:
        """Return the records of repetitions with random steps added that came to their end."""
        records = []
        for _ in range(self.options.trials):
            rng = self._rng()
            steps = self.options.excitation * rng.normal(size=(self.count, self.spec.nu))
            one = self.repeated.play(plan, rng, steps)
            if one.stayed:
                records.append(one.record)
        return records

    def _rng(self) -> np.random.Generator:
        self.trials += 1
        return np.random.default_rng([self.seed, self.trials])

    # ---- plans -------------------------------------------------------------------------------------------------------

    def held(self, still: AlongTrajectoryModel) -> MotionPlan:
        """Return the feedback of the time-invariant model about the reference, nothing else."""
        return self._about(still, np.zeros((self.count, self.spec.nu)), self.cost.reference)

    def ahead(self, still: AlongTrajectoryModel) -> MotionPlan:
        """Return the inputs of least cost on the time-invariant model, and its feedback about them."""
        n, zero = self.count, np.zeros((self.count, self.spec.nu))
        plan = self._about(still, zero, np.zeros((n, self.spec.ny)))
        first = Trajectory(self.repeated.times[:1], zero[:1], plan.outputs[:1], self.spec)
        x, rest = still.initial_state(first), np.zeros((n, self.spec.ny))
        for k in range(n):  # without an input, but under feedback: the constant of the model may push
            pushed = -plan.gains[k] @ x[:-1]
            rest[k], zero[k] = still.output(x, pushed), pushed
            x = still.step(x, pushed)
        return self._changed(plan, still.along(n), rest, zero, _FREE, limited=False)

    def _changed(
        self, plan: MotionPlan, model: TimeVarying, y: FloatArray, u: FloatArray, effort: float, *, limited: bool
    ) -> MotionPlan:
        """Return the plan of least cost by a model along a motion y, u."""
        with np.errstate(over="ignore", invalid="ignore"):
            moves = Moves.of(model, plan.gains)
            h, g = self.cost.normal(moves, y, u, effort)
        if not (np.isfinite(h).all() and np.isfinite(g).all()):
            raise FitError(
                "learned-motion: the model along the motion",
                expected="one that stays finite under the feedback",
                got="one that grows beyond all numbers",
                remedy="record with more excitation, or lower the order",
            )
        v = limited_change(h, g, moves.inputs, u, self.limits)[0] if limited else np.linalg.solve(h, g)
        new = u + (moves.inputs @ v).reshape(u.shape)
        if limited:
            new = within(new, self.limits)  # what ADMM leaves of its tolerance
        return replace(plan, inputs=new, outputs=y + (moves.outputs @ v).reshape(y.shape))

    def _about(self, still: AlongTrajectoryModel, u: FloatArray, y: FloatArray) -> MotionPlan:
        model = still.along(1)
        parts = model.a_matrices[0], model.b_matrices[0], model.c_matrices[0]
        pushed = np.zeros_like(parts[0])
        ny = self.spec.ny
        pushed[:ny, :ny] = np.diag(self.residual**2)
        return self._fed_back(parts, pushed, u, y)

    def corrected(
        self, name: str, plan: MotionPlan, model: TimeVarying, y: FloatArray, u: FloatArray, effort: float
    ) -> MotionPlan:
        """Return the plan of least cost by a model along the measured motion y, u."""
        if name == ITERATIVE:
            passed = riccati(model, self.cost, y, u, effort)
            x, inputs, outputs = np.zeros(model.a_matrices.shape[1]), np.empty_like(u), np.empty_like(y)
            for k in range(self.count):
                change = passed.forward[k] - passed.gains[k] @ x
                inputs[k], outputs[k] = u[k] + change, y[k] + model.c_matrices[k] @ x
                x = model.a_matrices[k] @ x + model.b_matrices[k] @ change
            return MotionPlan(inputs, outputs, passed.gains, plan.observer)
        return self._changed(plan, model, y, u, effort, limited=name == SPLIT)

    # ---- repetitions -------------------------------------------------------------------------------------------------

    def scored(self, name: str, number: int, plan: MotionPlan) -> tuple[_Row, Repetition]:
        """Return what a repetition of a plan costs, and the repetition."""
        one = self.repeated.play(plan, self._rng())
        if not one.stayed:
            return _Row(name, number, np.inf, np.inf, np.inf, np.inf), one
        miss = one.outputs[:, 0] - self.cost.reference[:, 0]
        return _Row(
            name, number, self.cost.cost(one.outputs, one.record.u), float(np.sqrt(np.mean(miss**2))),
            float(np.abs(plan.inputs).max()), float(np.abs(np.diff(plan.inputs, axis=0, prepend=0.0)).max()),
        ), one  # fmt: skip

    def learned(self, name: str, plan: MotionPlan, still: AlongTrajectoryModel) -> tuple[list[_Row], Repetition]:
        """Return a row for every repetition, and the best one."""
        effort = self.options.effort
        if name == SPLIT:  # it knows of the limits from the start
            plan = self._changed(plan, still.along(self.count), plan.outputs, plan.inputs, _FREE, limited=True)
        row, shown = self.scored(name, 0, plan)
        rows, best = [row], (row.cost, plan, shown)
        apart: list[list[Trajectory]] = []
        for number in range(1, self.options.repetitions + 1):
            records = self._excited(best[1])
            apart = [*apart, _apart(records)][-_REMEMBERED:]
            if len(records) >= _FEWEST and best[2].stayed:
                y, u = best[2].record.y, best[2].record.u
                try:
                    model = (still if name == STILL else self._along(apart)).along(self.count)
                    plan = self.corrected(name, best[1], model, y, u, effort)
                except FitError:
                    plan = best[1]
            row, shown = self.scored(name, number, plan)
            rows.append(row)
            if row.cost < best[0]:
                best, effort = (row.cost, plan, shown), max(effort / _RETREAT, self.options.effort)
            else:
                effort *= _RETREAT
        return rows, best[2]

    def _along(self, apart: Sequence[Sequence[Trajectory]]) -> AlongTrajectoryModel:
        """Return the model along the motion of what differs between the repetitions of each round."""
        records = [record for one in apart for record in one]
        return AlongTrajectory(self.options.order).fit(records, rng=np.random.default_rng(0))

    def hindsight(self, shown: Mapping[str, Repetition], plan: MotionPlan) -> tuple[float, Repetition]:
        """Return the least cost that is known within the limits, and its repetition: slopes of the true plant."""
        finished = [one for one in shown.values() if one.stayed]
        if not finished:
            raise FitError("learned-motion", expected="a repetition that stays", got="none", remedy="ask for less")
        begun = min(finished, key=lambda one: self.cost.cost(one.outputs, one.record.u))
        plan = replace(plan, inputs=begun.record.u, outputs=begun.outputs)
        one = self.repeated.play(plan, None)
        found, effort = (self.cost.cost(one.outputs, one.record.u), one, plan), _FREE
        nu = self.spec.nu
        free = copy(self.repeated)
        free.limits = Limits(np.full(nu, -np.inf), np.full(nu, np.inf), np.full(nu, np.inf))
        push = _PUSH * max(float(np.abs(begun.record.u).max()), _PUSH)
        for _ in range(_HINDSIGHT):
            here, moves = free.map_of(replace(found[2], inputs=found[1].record.u, outputs=found[1].outputs), push)
            if not (here.stayed and np.isfinite(moves.outputs).all()):
                break
            better, gained = False, 0.0
            for _ in range(4):
                y, u = here.outputs, here.asked
                h, g = self.cost.normal(moves, y, u, effort)
                v = limited_change(h, g, moves.inputs, u, self.limits)[0]
                new = within(u + (moves.inputs @ v).reshape(u.shape), self.limits)
                plan = replace(plan, inputs=new, outputs=y + (moves.outputs @ v).reshape(y.shape))
                one = self.repeated.play(plan, None)
                cost = self.cost.cost(one.outputs, one.record.u)
                if cost < found[0]:
                    better, gained = True, found[0] - cost
                    found = (cost, one, plan)
                    effort = max(effort / _RETREAT, _FREE)
                    break
                effort *= 100.0
            if not better or gained < _GAINED * found[0]:
                break
        return found[0], found[1]


def _apart(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return repetitions of one plan as departures from their mean, which those of other plans can stand beside."""
    if len(records) < _FEWEST:
        return []
    y, u = (np.mean([getattr(one, side) for one in records], axis=0) for side in ("y", "u"))
    return [replace(one, y=one.y - y, u=one.u - u) for one in records]


def _findings(
    stage: _Stage, rows: Sequence[_Row], shown: Mapping[str, Repetition], best: float, ideal: Repetition
) -> Findings:
    """Return the table, what it means, and its picture."""
    channel = stage.spec.outputs[0]
    column = f"rms of {channel.name} [{channel.unit}]" if channel.unit else f"rms of {channel.name}"
    table, regrets = [], dict.fromkeys(shown, 0.0)
    for row in rows:
        regrets[row.method] += row.cost - best
        table.append(
            {"method": row.method, "repetition": row.number, "cost": row.cost, column: row.rms,
             "regret": regrets[row.method], "largest input": row.asked, "largest change": row.change}
        )  # fmt: skip
    costs = {name: [row.cost for row in rows if row.method == name] for name in shown}
    fixed = [f"{name} {costs[name][0]:.4g}" for name in (LQR, AHEAD)]
    learned = [
        f"{name} {min(costs[name]):.4g} (regret {regrets[name]:.3g})" for name in costs if name not in (LQR, AHEAD)
    ]
    words = [
        f"cost on the plant: {', '.join(fixed)}; of the best repetition, learned: {', '.join(learned)}",
        f"the best input in hindsight costs {best:.4g}",
    ]
    if SPLIT in shown:
        words.append(f"what {SPLIT} plans keeps the limits; the others ask for what the actuator clips")
    arrays = {name: one.outputs for name, one in shown.items()}

    def draw() -> Any:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(12, 3.8), layout="constrained")
        motion, pushed, progress = figure.subplots(1, 3)
        times, unit = stage.repeated.times, f" [{channel.unit}]" if channel.unit else ""
        motion.plot(times, stage.cost.reference[:, 0], "k:", label="reference")
        for name in (LQR, AHEAD, ALONG, *((SPLIT,) if SPLIT in shown else ())):
            motion.plot(times, shown[name].outputs[:, 0], color=_COLOURS[name], label=name)
        motion.plot(times, ideal.outputs[:, 0], "k--", lw=1, label="best in hindsight")
        motion.set(xlabel="time [s]", ylabel=channel.name + unit, title="response, best repetition")
        motion.legend(fontsize=8)
        driven = stage.spec.inputs[0]
        for name in (ALONG, *((SPLIT,) if SPLIT in shown else ())):
            pushed.step(
                times[: len(shown[name].record)],
                shown[name].record.u[:, 0],
                where="post",
                color=_COLOURS[name],
                label=name,
            )
        pushed.step(times, ideal.record.u[:, 0], "k--", lw=1, where="post", label="best in hindsight")
        for edge in (stage.limits.low[0], stage.limits.high[0]):
            if np.isfinite(edge):
                pushed.axhline(edge, color="0.6", lw=1)
        pushed.set(xlabel="time [s]", ylabel=f"{driven.name} [{driven.unit}]", title="input")
        pushed.legend(fontsize=8)
        for name, values in costs.items():
            if name in (LQR, AHEAD):
                progress.axhline(values[0], color=_COLOURS[name], lw=1, label=name)
            else:
                progress.semilogy(values, "o-", ms=3, label=name, color=_COLOURS[name])
        progress.axhline(best, color="k", ls="--", lw=1, label="best in hindsight")
        progress.set(xlabel="repetition", ylabel="cost", title="cost by repetition")
        progress.legend(fontsize=7)
        return figure

    details = {
        "best": best, "reference": stage.cost.reference[:, 0], "outputs": arrays, "costs": costs, "regrets": regrets,
        "inputs": {name: one.record.u for name, one in shown.items()}, "ideal": ideal.outputs,
    }  # fmt: skip
    return Findings("a motion learned by repetition", table, words, details, draw)
