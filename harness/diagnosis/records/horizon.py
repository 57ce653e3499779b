"""How far a model can be simulated freely before its errors are those of the start: the horizon of the free runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.motion import motion_band
from harness.diagnosis.systems import AnySystem
from harness.physics.compiled.system import System
from harness.signals import Dataset, FloatArray


@dataclass(frozen=True)
class Horizon:
    """Window length of the simulation error [s] (None: whole records), and why."""

    seconds: float | None
    reason: str


def choose_horizon(system: System, values: Mapping[str, float], dataset: Dataset) -> Horizon:
    """Decide from the nominal model whether whole records can be simulated, or windows.

    An integrating plant (a pole at 0) is judged over four of its slowest time constants, an unstable one over the
    time in which an error grows 20 times; a stable one over the whole record. Poles that no output shows count for
    nothing: the turns of a motor whose speed is read.
    """
    import casadi as ca

    if not system.nx:
        return Horizon(None, "the nominal model is static: whole records are simulated")
    longest = max(len(run) for run in dataset.estimation) * dataset.spec.sample_time
    shortest = 50 * dataset.spec.sample_time
    points = _operating_points(system, dataset)
    along = [ca.jacobian(system.f, system.x), ca.jacobian(system.h, system.x)]
    jacobians = ca.Function("AC", [system.x, system.u, system.p, system.t], along)
    p = system.vector(values)
    u = np.mean(np.concatenate([run.u for run in dataset.estimation]), axis=0) if system.nu else np.zeros(0)
    centre = _seen_poles(*jacobians(points.mean(axis=0), u, p, 0.0))
    if not np.isfinite(centre).all():
        return Horizon(None, "the poles of the nominal model are not finite at its operating point")
    size = max(float(np.abs(centre).max(initial=0.0)), 1e-12)
    least = DATA_POLICY.integrates * size
    integrating = bool((np.abs(centre) < least).any())
    rates = []
    for point in points[:: max(len(points) // 60, 1)]:
        poles = _seen_poles(*jacobians(point, u, p, 0.0))
        if np.isfinite(poles).all():
            rates.append(float(poles.real.max(initial=-np.inf)))
    typical = float(np.median(rates)) if rates else 0.0
    if typical * longest > np.log(DATA_POLICY.growth) and typical > 1e-3 * size:
        seconds = _round(float(np.clip(np.log(DATA_POLICY.growth) / typical, shortest, longest / 4)))
        return Horizon(seconds, f"the nominal model is unstable where it was operated (a pole at +{typical:.3g} 1/s)")
    lost = vanished(system, values) if integrating else []
    if lost:  # a rough fit to readings that no model explains may lose gravity: then the model itself says what it is
        other = choose_horizon(system, {**values, **{name: system.values()[name] for name in lost}}, dataset)
        if other.seconds is None:
            return other
    if integrating:
        decaying = -centre.real[np.abs(centre) >= least]
        slow = 1 / decaying[decaying > least].min() if (decaying > least).any() else longest
        seconds = _round(float(np.clip(4 * slow, shortest, longest / 4)))
        return Horizon(seconds, "the nominal model integrates: an error of the force never leaves the position")
    return Horizon(None, "the nominal model is stable: whole records are simulated")


def short_window(dataset: Dataset) -> float:
    """Return a window [s] of four periods of the motion, 50 samples at least: short, yet longer than a start-up."""
    run, dt = max(dataset.estimation, key=len), dataset.spec.sample_time
    band = max(motion_band(run.y[:, j], dt)[0] for j in range(run.spec.ny))
    return float(np.clip(4.0 / max(band, 1e-12), 50 * dt, len(run) * dt / 3))


def _operating_points(system: System, dataset: Dataset) -> FloatArray:
    """Return states (N, nx) along the estimation data, as far as they are measured."""
    from harness.physics.compiled.windows import data_states

    simulator = system.simulator(dataset.spec.sample_time, intersample=dataset.intersample, backend="casadi")
    states = [data_states(simulator, run, system.vector())[0] for run in dataset.estimation]
    joined = np.concatenate(states)
    return joined[np.isfinite(joined).all(axis=1)]


def _seen_poles(a: Any, c: Any) -> FloatArray:
    """Return the poles that the outputs show: those of the observable part (Kalman 1963); NaN where A is not finite."""
    a, c = np.array(a, dtype=float), np.array(c, dtype=float)
    if not (np.isfinite(a).all() and np.isfinite(c).all()):
        return np.full(1, np.nan)
    least = len(a) * float(np.finfo(float).eps)
    basis, fresh = np.zeros((0, len(a))), c / max(float(np.abs(c).max(initial=0.0)), 1e-300)
    while fresh.size:  # what the outputs show, what their rates show besides, and so on
        for _ in range(2):
            fresh = fresh - fresh @ basis.T @ basis
        _, shares, rows = np.linalg.svd(fresh, full_matrices=False)
        basis = np.vstack([basis, rows[shares > least]])
        fresh = rows[shares > least] @ a / max(float(np.linalg.norm(a)), 1e-300)
    return np.asarray(np.linalg.eigvals(basis @ a @ basis.T))


def _round(seconds: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above (one part in ten of grace)."""
    power = 10.0 ** np.floor(np.log10(seconds * 1.1))
    return float(next(step * power for step in (5, 2, 1) if step * power <= seconds * 1.1))


def vanished(system: AnySystem, values: Mapping[str, float]) -> list[str]:
    """Return the free parameters of a nominal model that cannot be negative and have gone to 0."""
    return [
        parameter.name
        for parameter in system.parameters
        if parameter.name in values
        and "." not in parameter.name and not parameter.fixed and parameter.minimum == 0.0
        and 0.0 <= values[parameter.name] < 1e-3 * abs(parameter.value)
    ]  # fmt: skip
