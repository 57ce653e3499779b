"""Before the loop: check the data against the model, and size the effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from harness.diagnosis.records.motion import measured_coordinates, smooth_motion
from harness.diagnosis.systems import Measured
from harness.effects.columns import motion_sizes
from harness.errors import InputError
from harness.physics.compiled.system import System
from harness.resolution import resolution
from harness.signals import Dataset

SHORTEST = 64
"""Samples of a record: each has an initial state of its own to be fitted, and a residual needs some tens to be one."""


def checked(dataset: Dataset, system: Measured) -> Dataset:
    """Return the data set in the channels of the system, or refuse what cannot be judged.

    Raises InputError if there is no estimation or no validation run, channels do not fit, or nothing moves.
    """
    spec = dataset.spec
    for use in ("estimation", "validation"):
        if not dataset.using(use):
            raise InputError(
                f"no {use} run in {dataset.name!r}",
                expected="at least one estimation and one validation run",
                got=", ".join(run.use for run in dataset),
                remedy=f'mark a run as use = "{use}"',
            )
    for what, ours, theirs in (("inputs", system.inputs, spec.inputs), ("outputs", system.outputs, spec.outputs)):
        if [port.name for port in ours] != [port.name for port in theirs]:
            raise InputError(
                f"{what} of {dataset.name!r} do not fit the model {system.name}",
                expected=", ".join(str(port) for port in ours) or "none",
                got=", ".join(str(port) for port in theirs) or "none",
                remedy="name the signals as the model's ports, or map them with port = ... in the data set",
            )
    for use in ("estimation", "validation"):
        runs = dataset.using(use)  # type: ignore[arg-type]
        moving = any(np.ptp(run.y, axis=0).any() or (run.u.size and np.ptp(run.u, axis=0).any()) for run in runs)
        if not moving:
            raise InputError(
                f"the {use} runs of {dataset.name!r} never move",
                expected="an input or an output that changes",
                got="constants only",
                remedy="choose other rows, or record with excitation",
            )
        longest = max(len(run) for run in runs)
        if longest < SHORTEST:
            raise InputError(
                f"every {use} run of {dataset.name!r} is too short",
                expected=f"one of at least {SHORTEST} samples",
                got=str(longest),
                remedy="record longer, or join the rows",
            )
    dataset = _resolved(_long_enough(dataset))
    # periods of the model's angles are known even where the file does not say so
    outputs = tuple(
        replace(theirs, period=ours.period) if theirs.period is None and ours.unit == theirs.unit else theirs
        for ours, theirs in zip(system.outputs, spec.outputs, strict=True)
    )
    if outputs == spec.outputs:
        return dataset
    full = replace(spec, outputs=outputs)
    runs_of = tuple(replace(run, trajectory=replace(run.trajectory, spec=full)) for run in dataset)
    return replace(dataset, runs=runs_of)


def _resolved(dataset: Dataset) -> Dataset:
    """Return the data set with the resolution of every output whose readings lie, or lay, on a grid."""
    records = [run.trajectory for run in dataset if run.use != "test"]
    found = {
        channel.name: dataset.resolution.get(channel.name, 0.0) or resolution([run.readings[:, k] for run in records])
        for k, channel in enumerate(dataset.spec.outputs)
    }
    return replace(dataset, resolution={name: step for name, step in found.items() if step > 0.0})


def _long_enough(dataset: Dataset) -> Dataset:
    """Return the data set without records that are too short, what remains of lost rows, and say how much that is."""
    kept = tuple(run for run in dataset if len(run.trajectory) >= SHORTEST)
    if len(kept) == len(dataset.runs):
        return dataset
    lost = sum(len(run.trajectory) for run in dataset) - sum(len(run.trajectory) for run in kept)
    note = (
        f"{len(dataset.runs) - len(kept)} of {len(dataset.runs)} records are shorter than {SHORTEST} samples: "
        f"{lost} samples are left out"
    )
    return replace(dataset, runs=kept, warnings=(*dataset.warnings, note))


def sizes_of(system: System, values: Mapping[str, float], dataset: Dataset) -> dict[str, dict[str, float]]:
    """Return the rms sizes of the data at every port, for start values of effects."""
    runs = dataset.estimation
    dt = dataset.spec.sample_time
    common = {"dt": dt, "T": max(len(run) for run in runs) * dt}
    columns = measured_coordinates(system)
    if columns is not None:
        motion = smooth_motion(runs[0], columns, dataset.intersample)
        known = motion_sizes(system, motion.signals(), values)
        return {port: {**sizes, **common} for port, sizes in known.items()}
    result: dict[str, dict[str, float]] = {"base": dict(common)}
    u = np.concatenate([run.u for run in runs])
    y = np.concatenate([run.y for run in runs])
    for k, channel in enumerate(system.inputs):
        size = float(np.sqrt(np.mean(u[:, k] ** 2)))
        result[channel.name] = {**common, "u": size, "F": size}
    for k, channel in enumerate(system.outputs):
        size = float(np.sqrt(np.mean(y[:, k] ** 2)))
        result.setdefault(channel.name, dict(common)).update(y=size)
    level = float(np.sqrt(np.mean(y**2)))
    for port in system.ports:
        if port.kind == "process":
            result.setdefault(port.name, dict(common)).update(x=level, F=level / common["T"])
        elif port.kind == "coordinate":
            force = float(np.sqrt(np.mean(u**2))) if u.size else 1.0
            result.setdefault(port.name, dict(common)).update(F=force, q=level, v=level, a=level)
    return result
