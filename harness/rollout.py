"""The only stepping loop of the project: a plant, a scenario, a seed; out comes a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Batch, BatchTruth, Experiment, Feedthrough, Plant, Scenario, Truth
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec, Trajectory


def run(
    plant: Plant,
    scenario: Scenario,
    *,
    streams: Streams,
    role: str = "estimation/0",
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Excite a plant with a scenario and record it.

    Parameters
    ----------
    plant : Plant
        It is reset first.
    scenario : Scenario
        Excitation, feedback, noise.
    streams : Streams
        Random streams keyed (plant, scenario, seed).
    role : str
        Which run of the cell this is; part of every stream's key.
    progress : callable, optional
        Called as ``progress(samples_done, samples)`` now and then.

    Returns
    -------
    Trajectory
        With the true states where the plant declares the ability ``"truth"``.

    Raises
    ------
    PlantError
        If the plant diverges (an output or input is not finite) or breaks.
    InputError
        If the scenario does not fit the plant.
    """
    experiment = scenario.prepare(plant.spec, streams=streams, role=role)
    return perform(plant, experiment, rng=streams(f"{role}/plant"), progress=progress)


def perform(
    plant: Plant,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Carry out a prepared experiment; see :func:`run`."""
    spec = plant.spec
    excitation = _fitting(experiment.excitation, "excitation", spec)
    n = excitation.shape[0]
    hidden = np.zeros_like(excitation)
    if experiment.disturbance is not None:
        hidden = _fitting(experiment.disturbance, "disturbance", spec)
    y = plant.reset(rng=rng, x0=experiment.x0)
    outputs = np.empty((n, spec.ny))
    inputs = excitation.copy()
    truth = "truth" in plant.abilities
    open_loop = experiment.controller is None and not spec.feedthrough
    states = np.empty((n, len(spec.states))) if truth else None
    if open_loop and ("batch-truth" if truth else "batch") in plant.abilities:
        outputs[0] = y
        applied = (inputs + hidden)[:-1]
        if states is not None:
            states[0] = cast(Truth, plant).truth()
            if n > 1:
                outputs[1:], states[1:] = cast(BatchTruth, plant).rollout_truth(applied)
        elif n > 1:
            outputs[1:] = cast(Batch, plant).rollout(applied)
        _refuse_divergence(outputs, spec)
        for k in range(n):
            outputs[k] = experiment.measure(k, outputs[k])
        return Trajectory(_instants(n, spec), inputs, outputs, spec, states)
    for k in range(n):
        t = k * spec.sample_time
        if spec.feedthrough and experiment.controller is None:
            y = cast(Feedthrough, plant).output(inputs[k] + hidden[k])
        measured = experiment.measure(k, y)
        if experiment.controller is not None:
            inputs[k] += experiment.controller(t, measured)
            if not np.isfinite(inputs[k]).all():
                raise PlantError(f"the input is not finite at t = {t:g} s", status="diverged")
            if spec.feedthrough:
                y = cast(Feedthrough, plant).output(inputs[k] + hidden[k])
                measured = experiment.measure(k, y)
        outputs[k] = measured
        if states is not None:
            states[k] = cast(Truth, plant).truth()
        if k + 1 < n:
            y = plant.step(inputs[k] + hidden[k])
            if not np.isfinite(y).all():
                raise PlantError(f"an output is not finite at t = {t + spec.sample_time:g} s", status="diverged")
        if progress is not None and (k + 1) % 256 == 0:
            progress(k + 1, n)
    return Trajectory(_instants(n, spec), inputs, outputs, spec, states)


def _instants(n: int, spec: PlantSpec) -> FloatArray:
    """Return the sample instants k * dt, not accumulated."""
    return np.arange(n, dtype=np.float64) * spec.sample_time


def _fitting(values: FloatArray, name: str, spec: PlantSpec) -> FloatArray:
    """Return the values as float64 (N, nu), or refuse them."""
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != spec.nu or array.shape[0] == 0:
        raise InputError(
            f"{name} does not fit the plant",
            expected=f"shape (N, {spec.nu}) for the inputs ({', '.join(c.name for c in spec.inputs)})",
            got=str(array.shape),
            remedy="give one column for each input of the plant and at least one row",
        )
    return array


def _refuse_divergence(outputs: FloatArray, spec: PlantSpec) -> None:
    """Raise at the first output that is not finite."""
    bad = ~np.isfinite(outputs).all(axis=1)
    if bad.any():
        raise PlantError(
            f"an output is not finite at t = {int(np.argmax(bad)) * spec.sample_time:g} s", status="diverged"
        )
