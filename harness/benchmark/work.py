"""What a worker does with the cells of a task: make their data once, run every identifier on it, score the models."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from harness import registry
from harness.benchmark.control import score_control
from harness.benchmark.parts import Cell, Task
from harness.benchmark.records import TaskRecords, make_records
from harness.benchmark.row import Row, blank, encoded, one_line
from harness.errors import HarnessError, InputError, PlantError, PluginError
from harness.jobs import Desk
from harness.jobs.batch import described
from harness.jobs.room import raise_if_full
from harness.parts.files import make_plant
from harness.protocols import OnlinePredictive, Predictive
from harness.rng import stream
from harness.signals import Trajectory

if TYPE_CHECKING:
    from harness.protocols import Model
    from harness.scoring import Score

_SETS = 0.9
"""Probability of the sets whose coverage is shown: a few held-out samples in a hundred are enough to judge it."""

STRETCHES = 500
"""A trace keeps two samples of each: an overlay that is looked at has about a thousand points of a screen."""


@dataclass(frozen=True)
class CellBatch:
    """The cells of a task as jobs; see :class:`harness.jobs.JobBatch`."""

    task: Task
    trace: bool = False
    """Keep what the overlay of a cell is drawn from: its first held-out record and the free run of its model."""

    @property
    def title(self) -> str:
        """What the progress calls it."""
        return self.task.title

    @property
    def jobs(self) -> tuple[str, ...]:
        """The cells' hashes."""
        return tuple(cell.job for cell in self.task.cells)

    @property
    def time_limit(self) -> float:
        """Seconds for one cell, and for the data."""
        return self.task.time_limit

    def only(self, jobs: Sequence[str]) -> CellBatch:
        """Return the batch with some of its cells."""
        wanted = set(jobs)
        cells = tuple(cell for cell in self.task.cells if cell.job in wanted)
        return replace(self, task=msgspec.structs.replace(self.task, cells=cells))

    def lost(self, job: str, status: str, reason: str, *, shared: bool) -> bytes:
        """Return the row of a cell that broke its worker."""
        (cell,) = (cell for cell in self.task.cells if cell.job == job)
        if status == "timeout":
            reason = f"no data: the plant or scenario {reason}" if shared else f"{cell.identifier.name} {reason}"
        elif shared:
            reason = f"no data: {reason}"
        return encoded(blank(self.task, cell, status=status, reason=reason))

    def work(self, desk: Desk) -> None:
        """Do all cells of the task."""
        task = self.task
        _preload(task)
        started = time.perf_counter()
        failure: HarnessError | None = None
        records: TaskRecords | None = None
        with desk.shared():
            try:
                records = make_records(task)
            except HarnessError as error:
                raise_if_full(error)
                failure = error
            except BaseException as error:  # an interrupt too: of a worker it is the plug-in's own
                raise_if_full(error)
                failure = PluginError(f"{task.plant.name} under {task.scenario.name}: {described(error)}")
        seconds = time.perf_counter() - started
        for cell in task.cells:
            if records is None:
                row = blank(task, cell, status=failure.status if failure else "failed", reason=f"no data: {failure}")
            else:
                with desk.job(cell.job):
                    row = _do_cell(task, cell, records.runs, records.held_out, trace=self.trace)
                row.noise_floor = records.floor
                row.least_equation_error = records.least_equation
                row.least_simulation_error = records.least_simulation
            row.data_seconds, row.memory_mib = seconds, _memory()
            desk.put(cell.job, encoded(row))


def _preload(task: Task) -> None:
    """Import what the task needs, so that no cell pays for it: a first import takes seconds where cores are busy.

    A part that does not load says so when it is made.
    """
    wanted = [("scenarios", task.scenario.id), ("plants", task.plant.id)]
    wanted += [("identifiers", cell.identifier.id) for cell in task.cells]
    for kind, id in dict.fromkeys(wanted):
        with suppress(BaseException):
            registry.load(kind, id)
    import harness.rollout
    import harness.scoring  # noqa: F401


def _memory() -> float | None:
    """Return the most that this process has had in memory [MiB]."""
    try:
        import resource
    except ImportError:  # a system without it
        return None
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes / 1024 if sys.platform != "darwin" else kilobytes / 1024**2


def _do_cell(task: Task, cell: Cell, runs: Sequence[Trajectory], held_out: Sequence[Trajectory], *, trace: bool) -> Row:
    """Return the row of one identifier; whatever it raises becomes a status with its reason."""
    row = blank(task, cell)
    spec = runs[0].spec
    row.outputs = tuple(channel.name for channel in spec.outputs)
    row.units = tuple(channel.unit for channel in spec.outputs)
    row.samples = sum(map(len, runs))
    row.held_out_samples = sum(map(len, held_out))
    rng = stream("identifier", task.plant.name, task.scenario.name, cell.identifier.name, task.seed)
    borrowed: list[Any] = []
    try:
        identifier = _make_identifier(task, cell, borrowed)
        shown = [trajectory.measured() for trajectory in runs]
        scored = False
        if hasattr(identifier, "fit"):
            model = _fit_and_score(identifier, shown, held_out, task, row, rng, trace=trace)
            if task.score.control:
                # one stream for all identifiers of a place: they are disturbed alike
                paired = stream("control", task.plant.name, task.scenario.name, task.seed)
                score_control(model, identifier, task, runs, row, paired)
            scored = True
        elif task.score.control:
            row.control_status = f"not for control: {type(identifier).__name__} predicts while it learns, no more"
        if hasattr(identifier, "hindsight"):
            _score_regret(identifier, shown, row, rng, task.score.curve)
            scored = True
        if not scored:
            raise PluginError(
                f"identifier {cell.identifier.id!r} breaks its contract: expected fit() or an online identifier with "
                f"hindsight(), got {type(identifier).__name__}; remedy: see 'sysid check {cell.identifier.id}'"
            )
    except HarnessError as error:
        raise_if_full(error)
        row.status, row.reason = error.status, one_line(error)
    except MemoryError:
        row.status, row.reason = "crashed", "out of memory"
    except BaseException as error:  # an interrupt too: of a worker it is the plug-in's own
        raise_if_full(error)
        row.status, row.reason = "crashed", one_line(f"{cell.identifier.name} raised {described(error)}")
    finally:
        for plant in borrowed:
            plant.close()
    return row


def _make_identifier(task: Task, cell: Cell, borrowed: list[Any]) -> Any:
    """Return the identifier; one that asks for the plant (the baseline that knows the truth) is given one to borrow."""
    part = cell.identifier
    options = dict(part.options)
    if "plant" in registry.named_options("identifiers", part.id) and "plant" not in options:
        borrowed.append(make_plant(task.plant.id, dict(task.plant.options)))
        options["plant"] = borrowed[0]
    return registry.create("identifiers", part.id, **options)


def _fit_and_score(
    identifier: Any,
    shown: Sequence[Trajectory],
    held_out: Sequence[Trajectory],
    task: Task,
    row: Row,
    rng: np.random.Generator,
    *,
    trace: bool,
) -> Model:
    """Return the fitted model, after filling in its equation error and simulation error on the held-out records."""
    from harness.scoring import equation_error, simulation_error

    started = time.perf_counter()
    model = identifier.fit(shown, rng=rng)
    fitted = time.perf_counter()
    row.fit_seconds = fitted - started
    row.reason = _doubts(model)
    try:
        one_step = [equation_error(model, record.measured()) for record in held_out]
        row.equation_error, row.equation_rms = _pooled(one_step)
        free = [simulation_error(model, record.measured(), horizon=task.score.horizon) for record in held_out]
        row.simulation_error, row.simulation_rms = _pooled(free)
        row.horizon, row.burn_in, row.initial_state = free[0].horizon, free[0].burn_in, free[0].initial_state
    finally:
        row.score_seconds = time.perf_counter() - fitted
    if trace:
        _trace(model, held_out[0].measured(), task.score.horizon, row)
    if row.equation_error is None:
        raise PlantError("the one-step predictions of the model are not finite", status="diverged")
    if row.simulation_error is None:
        raise PlantError("the free run of the model diverges on held-out data", status="diverged")
    if isinstance(model, Predictive):
        _score_distributions(model, [record.measured() for record in held_out], row)
    return model  # type: ignore[no-any-return]


def _score_distributions(model: Any, held_out: Sequence[Trajectory], row: Row) -> None:
    """Fill in log score and coverage, one step ahead; an outcome that was called impossible leaves no log score."""
    from harness.scoring.predictive import probability_score

    scores = [probability_score(model, record, levels=(_SETS,)) for record in held_out]
    gain = float(np.mean([np.mean(score.skill) for score in scores]))
    row.log_score = gain if np.isfinite(gain) else None
    row.coverage = float(np.mean([np.mean(score.coverage) for score in scores]))


def _trace(model: Model, record: Trajectory, horizon: float | None, row: Row) -> None:
    """Keep of each stretch of a record the first sample and the one where the free run is farthest off."""
    from harness.scoring import errors

    miss, _ = errors(model, record, horizon)
    spread = np.std(record.y, axis=0)
    far = np.nan_to_num(np.abs(miss) / np.where(spread > 0, spread, 1.0), nan=-1.0).max(axis=1)
    edges = np.unique(np.linspace(0, len(record), min(STRETCHES, len(record)) + 1).astype(int))
    worst = [first + int(np.argmax(far[first:last])) for first, last in pairwise(edges)]
    kept = np.unique([*edges[:-1], *worst])
    row.trace_t = tuple(record.t[kept].tolist())
    row.trace_measured = tuple(map(tuple, record.y[kept].T.tolist()))
    row.trace_residual = tuple(map(tuple, miss[kept].T.tolist()))


def _doubts(model: Any) -> str:
    """Return why the estimate of a model that is scored all the same is in doubt; empty where it is not."""
    from harness.models.estimate import estimate_of

    found = estimate_of(model)
    if found is None:
        return ""
    doubts = [] if found.converged else [f"not converged: {found.message}" if found.message else "not converged"]
    if found.on_bound and "on a bound" not in found.message:
        doubts.append(f"on a bound: {', '.join(found.on_bound)}")
    if found.rank is not None and not found.rank.full:
        doubts.append(str(found.rank))
    return one_line("; ".join(doubts))


def _score_regret(
    identifier: Any, shown: Sequence[Trajectory], row: Row, rng: np.random.Generator, points: int
) -> None:
    """Fill in the regret on the stream of the estimation records."""
    from harness.scoring import regret

    started = time.perf_counter()
    result = regret(identifier, shown, rng=rng, points=points)
    row.score_seconds += time.perf_counter() - started
    row.regret, row.average_regret, row.regret_exact = result.total, result.average, result.exact
    known = np.isfinite(result.curve)
    row.curve_steps = tuple(int(n) for n in result.steps[known])
    row.curve_regret = tuple(result.curve[known].tolist())
    row.curve_theory = tuple(value if np.isfinite(value) else None for value in result.theory[known].tolist())
    row.regret_law, row.regret_over_theory = result.growth.law if result.growth else "", result.over_theory
    if isinstance(identifier, OnlinePredictive):
        from harness.scoring.predictive import log_regret

        in_nats = log_regret(cast(Any, identifier), shown, rng=rng)
        row.log_regret, row.average_log_regret = in_nats.total, in_nats.average
    if not np.isfinite(row.regret):
        raise PlantError("the predictions of the online identifier are not finite", status="diverged")


def _pooled(scores: Sequence[Score]) -> tuple[float | None, tuple[float | None, ...]]:
    """Return the NRMSE over outputs and records in the mean square, and the rms of each output; None if it diverged.

    An output that stands still in the record has no NRMSE and is left out of the mean.
    """
    weights = np.array([score.samples for score in scores], dtype=float)
    weights /= weights.sum()
    rms, nrmse = np.array([score.rms for score in scores]), np.array([score.nrmse for score in scores])
    moving = ~(np.isfinite(rms) & ~np.isfinite(nrmse)).any(axis=0)
    if not moving.any():
        raise InputError(
            "held-out record",
            expected="an output that moves",
            got="outputs that stand still",
            remedy="excite the plant more, or start it elsewhere",
        )
    with np.errstate(over="ignore", invalid="ignore"):
        total = float(np.sqrt(weights @ np.mean(nrmse[:, moving] ** 2, axis=1)))
        each = np.sqrt(weights @ rms**2)
    finite = tuple(float(value) if np.isfinite(value) else None for value in each)
    return (total if np.isfinite(total) and all(score.finite for score in scores) else None), finite
