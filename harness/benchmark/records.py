"""The records of a task: those that models are fitted to, those that they are scored on, and the least error there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness import registry
from harness.benchmark.parts import RECORDING, Task
from harness.errors import InputError
from harness.parts.files import make_plant
from harness.rng import Streams
from harness.signals import FloatArray, Trajectory, residual


@dataclass(frozen=True, eq=False)
class TaskRecords:
    """What every identifier of a task is given, and what the best could do with it."""

    # To be fitted to, and to be scored on
    runs: list[Trajectory]
    held_out: list[Trajectory]
    floor: float | None  # NRMSE of the sensor noise in the held-out records
    # The least errors to be expected, where the plant is linear (see :func:`harness.scoring.least_errors`); the first
    # for free runs of whole records only
    least_simulation: float | None = None
    least_equation: float | None = None


def make_records(task: Task) -> TaskRecords:
    """Return the records of a task, made or recorded."""
    from harness.rollout import perform
    from harness.scoring import least_errors, linear_truth

    if task.plant.id.startswith(RECORDING):
        return _recorded(task.plant.id.removeprefix(RECORDING))
    scenario = registry.create("scenarios", task.scenario.id, **task.scenario.options)
    streams = Streams(task.plant.stream, task.scenario.stream, task.seed)
    with make_plant(task.plant.id, dict(task.plant.options)) as plant:
        disturbances = []

        def record(role: str) -> tuple[Trajectory, dict[int, FloatArray]]:
            experiment, clean = scenario.prepare(plant.spec, streams=streams, role=role), {}

            def measure(k: int, y: FloatArray) -> FloatArray:
                clean[k] = np.array(y)
                measured: FloatArray = experiment.measure(k, y)
                return measured

            disturbances.append(experiment.disturbance)
            made = perform(plant, replace(experiment, measure=measure), rng=streams(f"{role}/plant"))
            return made, clean

        runs = [record(f"estimation/{i}")[0] for i in range(task.score.runs)]
        pairs = [record(f"validation/{i}") for i in range(task.score.held_out)]
        held_out = [made for made, _ in pairs]
        truth = linear_truth(plant, [*runs, *held_out], disturbances)
    least = None if truth is None else least_errors(truth, runs, held_out)
    if least is None:
        return TaskRecords(runs, held_out, noise_floor(pairs))
    free = least.simulation if task.score.horizon is None else None
    return TaskRecords(runs, held_out, noise_floor(pairs), free, least.equation)


def _recorded(name: str) -> TaskRecords:
    """Return the runs of a recording: those for estimation, and those for a test or else for validation.

    The floor is that of the sensor noise that the recording declares, if it does so for every output.
    """
    from harness.data import load_dataset

    data = load_dataset(registry.dataset_path(name)).dataset
    held_out = list(data.test or data.validation)
    if not data.estimation or not held_out:
        raise InputError(
            f"recording {name}",
            expected="runs for estimation, and for test or validation",
            got=f"{len(data.estimation)} and {len(held_out)}",
            remedy="leave it out of the suite",
        )
    outputs = data.spec.outputs
    if not all(channel.name in data.noise for channel in outputs):
        return TaskRecords(list(data.estimation), held_out, None)
    noise = np.array([data.noise[channel.name] for channel in outputs])
    spreads = [np.std(record.y, axis=0) for record in held_out]
    floor = float(np.sqrt(np.mean([np.mean((noise / spread) ** 2) for spread in spreads if (spread > 0).all()])))
    return TaskRecords(list(data.estimation), held_out, floor if np.isfinite(floor) else None)


def noise_floor(pairs: Sequence[tuple[Trajectory, dict[int, FloatArray]]]) -> float | None:
    """Return the NRMSE that the true outputs score against the measured ones, pooled as the scores are.

    None where nothing is measured with noise, or an output is a category.
    """
    total, count = 0.0, 0
    for made, clean in pairs:
        if any(channel.kind == "category" for channel in made.spec.outputs):
            return None
        true = np.array([clean[k] for k in range(len(made))])
        wrong = residual(made.spec.outputs, made.y, true)
        spread = np.array(
            [
                np.std(np.unwrap(column, period=channel.period) if channel.period else column)
                for column, channel in zip(made.y.T, made.spec.outputs, strict=True)
            ]
        )
        moving = spread > 0
        if not moving.any():
            return None
        total += len(made) * float(np.mean(np.mean(wrong[:, moving] ** 2, axis=0) / spread[moving] ** 2))
        count += len(made)
    return float(np.sqrt(total / count)) or None
