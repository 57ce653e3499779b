"""Before the loop: check the data against the model, fit it roughly, choose horizon and form, size the effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.diagnosis.forms import vanished
from harness.diagnosis.motion import measured_coordinates, motion_band, smooth_motion
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.output_form import OutputForm
from harness.effects.columns import motion_sizes
from harness.errors import InputError
from harness.signals import Dataset, FloatArray

__all__ = ["Horizon", "checked", "choose_horizon", "form", "rough_values", "short_window", "sizes_of"]

GROWTH = 20.0
"""By how much an error of the initial state may grow within a window."""


@dataclass(frozen=True)
class Horizon:
    """Window length of the simulation error [s] (None: whole records), and why."""

    seconds: float | None
    reason: str


def checked(dataset: Dataset, system: Any) -> Dataset:
    """Return the data set in the channels of the system, or refuse what cannot be judged.

    Raises
    ------
    InputError
        If there is no estimation or no validation run, channels do not fit, or nothing moves.
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
        if [one.name for one in ours] != [one.name for one in theirs]:
            raise InputError(
                f"{what} of {dataset.name!r} do not fit the model {system.name}",
                expected=", ".join(str(one) for one in ours) or "none",
                got=", ".join(str(one) for one in theirs) or "none",
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
        shortest = min(len(run) for run in runs)
        if shortest < 64:
            raise InputError(
                f"an {use} run of {dataset.name!r} is too short",
                expected="at least 64 samples",
                got=str(shortest),
                remedy="record longer, or join the rows",
            )
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


def rough_values(system: Any, dataset: Dataset) -> dict[str, float]:
    """Return nominal parameters fitted over short windows: good enough for poles and sizes."""
    from harness.errors import FitError
    from harness.physics.output_error import fit_output_error

    dt = dataset.spec.sample_time
    longest = max(len(run) for run in dataset.estimation) * dt
    try:
        found = fit_output_error(
            system,
            list(dataset.estimation),
            horizon=max(min(longest / 10, 2.0 if dt < 0.1 else 25 * dt), 50 * dt),
            continuation=(),
            intersample=dataset.intersample,
            max_iterations=40,
        )
    except FitError:
        return dict(system.values())
    return dict(found.parameters)


def choose_horizon(system: Any, values: Mapping[str, float], dataset: Dataset) -> Horizon:
    """Decide from the nominal model whether whole records can be simulated, or windows.

    An integrating plant (a pole at 0) is judged over four of its slowest time constants, an unstable one over the
    time in which an error grows 20 times; a stable one over the whole record.
    """
    import casadi as ca

    longest = max(len(run) for run in dataset.estimation) * dataset.spec.sample_time
    shortest = 50 * dataset.spec.sample_time
    points = _operating_points(system, dataset)
    jacobian = ca.Function("A", [system.x, system.u, system.p, system.t], [ca.jacobian(system.f, system.x)])
    p = system.vector(values)
    u = np.mean(np.concatenate([run.u for run in dataset.estimation]), axis=0) if system.nu else np.zeros(0)
    centre = np.linalg.eigvals(np.array(jacobian(points.mean(axis=0), u, p, 0.0), dtype=float))
    if not np.isfinite(centre).all():
        return Horizon(None, "the poles of the nominal model are not finite at its operating point")
    size = max(float(np.abs(centre).max()), 1e-12)
    integrating = bool((np.abs(centre) < 1e-6 * size).any())
    rates = []
    for point in points[:: max(len(points) // 60, 1)]:
        poles = np.linalg.eigvals(np.array(jacobian(point, u, p, 0.0), dtype=float))
        if np.isfinite(poles).all():
            rates.append(float(poles.real.max()))
    typical = float(np.median(rates)) if rates else 0.0
    if typical * longest > np.log(GROWTH) and typical > 1e-3 * size:
        seconds = _round(float(np.clip(np.log(GROWTH) / typical, shortest, longest / 4)))
        return Horizon(seconds, f"the nominal model is unstable where it was operated (a pole at +{typical:.3g} 1/s)")
    lost = vanished(system, values) if integrating else []
    if lost:  # a rough fit to readings that no model explains may lose gravity: then the model itself says what it is
        other = choose_horizon(system, {**values, **{name: system.values()[name] for name in lost}}, dataset)
        if other.seconds is None:
            return other
    if integrating:
        decaying = -centre.real[np.abs(centre) >= 1e-6 * size]
        slow = 1 / decaying[decaying > 1e-6 * size].min() if (decaying > 1e-6 * size).any() else longest
        seconds = _round(float(np.clip(4 * slow, shortest, longest / 4)))
        return Horizon(seconds, "the nominal model integrates: an error of the force never leaves the position")
    return Horizon(None, "the nominal model is stable: whole records are simulated")


def short_window(dataset: Dataset) -> float:
    """Return a window [s] of four periods of the motion, 50 samples at least: short, yet longer than a start-up."""
    run, dt = max(dataset.estimation, key=len), dataset.spec.sample_time
    band = max(motion_band(run.y[:, j], dt)[0] for j in range(run.spec.ny))
    return float(np.clip(4.0 / max(band, 1e-12), 50 * dt, len(run) * dt / 3))


def sizes_of(system: Any, values: Mapping[str, float], dataset: Dataset) -> dict[str, dict[str, float]]:
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
            result.setdefault(port.name, dict(common)).update(x=level)
        elif port.kind == "coordinate":
            force = float(np.sqrt(np.mean(u**2))) if u.size else 1.0
            result.setdefault(port.name, dict(common)).update(F=force, q=level, v=level, a=level)
    return result


def form(
    system: Any,
    dataset: Dataset,
    *,
    horizon: Horizon,
    floors: tuple[NoiseFloor, ...],
    weights: FloatArray,
    sizes: Mapping[str, Mapping[str, float]],
) -> OutputForm:
    """Return the simulation form."""
    known = [one.value for one in floors]
    return OutputForm(system, dataset, sizes=sizes, horizon=horizon.seconds, weights=weights, floors=known)


def _operating_points(system: Any, dataset: Dataset) -> FloatArray:
    """Return states (N, nx) along the estimation data, as far as they are measured."""
    from harness.physics.windows import data_states

    simulator = system.simulator(dataset.spec.sample_time, intersample=dataset.intersample, backend="casadi")
    found = [data_states(simulator, run, system.vector())[0] for run in dataset.estimation]
    joined = np.concatenate(found)
    return joined[np.isfinite(joined).all(axis=1)]


def _round(seconds: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above (one part in ten of grace)."""
    power = 10.0 ** np.floor(np.log10(seconds * 1.1))
    return float(next(step * power for step in (5, 2, 1) if step * power <= seconds * 1.1))
