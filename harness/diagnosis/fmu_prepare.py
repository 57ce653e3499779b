"""Before the loop, where the nominal model is an FMU: rough fit, horizon, sizes and form without its equations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.diagnosis.fmu_form import FmuForm
from harness.diagnosis.fmu_reader import fmu_system
from harness.diagnosis.fmu_runner import Runner
from harness.diagnosis.fmu_simulator import FmuSimulator
from harness.diagnosis.fmu_system import FmuSystem
from harness.diagnosis.noise import NoiseFloor
from harness.diagnosis.prepare import GROWTH, Horizon, checked, short_window
from harness.errors import InputError
from harness.physics.windows import Windows
from harness.signals import Dataset, FloatArray

__all__ = ["checked", "choose_horizon", "form", "nominal_fmu", "rough_values", "sizes_of"]

SHORTEST = 50
"""Samples that a window has at least."""


def nominal_fmu(path: str | Path, dataset: Dataset, parameters: Mapping[str, Any] | None = None) -> FmuSystem:
    """Return an FMU as the nominal model of a data set; parameters that do not move its outputs are kept fixed.

    Raises
    ------
    InputError
        See :func:`harness.diagnosis.fmu_reader.fmu_system`; or the inputs of the data are not held.
    """
    if dataset.intersample != "zoh":
        raise InputError(
            "an FMU as nominal model",
            expected="inputs that are held (intersample 'zoh')",
            got=repr(dataset.intersample),
            remedy="resample the records, or write the model as equations",
            file=path,
        )
    system = fmu_system(path, dataset.spec, parameters)
    simulator = FmuSimulator(system, Runner(system, dataset.spec.sample_time))
    run = dataset.estimation[0].measured()[:2000] if dataset.estimation else None
    if run is None:
        return system
    p, x0 = system.vector(), FmuForm.first_state(system, simulator, run)
    slopes = simulator.windows(p[None], x0[None], run.u[None], None, run.t[:1])[2]
    assert slopes is not None
    moved = np.abs(slopes[0]).max(axis=(0, 1))
    kept = tuple(
        replace(one, fixed=True, minimum=-np.inf, maximum=np.inf) if not one.fixed and not moved[k] > 0 else one
        for k, one in enumerate(system.parameters)
    )
    return replace(system, parameters=kept)


def rough_values(system: FmuSystem, dataset: Dataset) -> dict[str, float]:
    """Return the parameters fitted over short windows: good enough for sizes and for the horizon."""
    form = _plain(system, dataset, None)
    free = np.array([not one.fixed for one in system.parameters], dtype=bool)
    found = form._stage(system, system.vector(), None, free, short_window(dataset))
    return system.values() if found is None else system.values(dict(zip(system.parameter_names, found.p, strict=True)))


def choose_horizon(system: FmuSystem, values: Mapping[str, float], dataset: Dataset) -> Horizon:
    """Decide from how an error of the initial state grows whether whole records can be simulated.

    The derivative of the outputs by each settable state, over the sizes of both, must not grow beyond 20. The size of a
    state is that of the record: a free run of an unstable FMU soon has left it.
    """
    form = _plain(system, dataset, None)
    p = system.vector(values)
    shortest = np.inf
    for run in form.records["estimation"]:
        windows = Windows(form.simulator(system, p), [run], None, form.weights)
        seen, told = form._from_data(windows.simulator, run, p)
        x0 = windows.starts_from([seen])
        x, y, slopes = windows.simulator.windows(p[None], x0, run.u[None], None, run.t[:1])
        assert slopes is not None
        finite = np.isfinite(y[0]).all(axis=1)
        span = np.maximum(np.std(run.y, axis=0), 1e-12)
        begun = x[0][:SHORTEST][finite[:SHORTEST]]
        simulated = np.std(begun, axis=0) if begun.size else np.ones(system.nx)
        states = np.maximum(np.where(told, np.std(seen, axis=0), simulated), 1e-12)
        grown = np.abs(slopes[0][..., system.np :]) * states / span[:, None]
        worst = np.where(finite, np.nan_to_num(grown, nan=np.inf).max(axis=(1, 2), initial=0.0), np.inf)
        beyond = np.flatnonzero(worst > GROWTH)
        if beyond.size:
            shortest = min(shortest, beyond[0] * dataset.spec.sample_time)
    if not np.isfinite(shortest):
        return Horizon(None, "an error of the initial state does not grow: whole records are simulated")
    length = float(max(shortest, SHORTEST * dataset.spec.sample_time))
    return Horizon(float(f"{length:.2g}"), f"an error of the initial state grows {GROWTH:g} times in {shortest:.2g} s")


def sizes_of(system: FmuSystem, values: Mapping[str, float], dataset: Dataset) -> dict[str, dict[str, float]]:
    """Return the rms sizes of the data at every port, positions and rates as the FMU simulates them."""
    runs, dt = dataset.estimation, dataset.spec.sample_time
    common = {"dt": dt, "T": max(len(run) for run in runs) * dt}
    form = _plain(system, dataset, short_window(dataset))
    fitted = form.evaluate((), form.started(values))
    u = np.concatenate([run.u for run in runs])
    y = np.concatenate([run.y for run in runs])
    result: dict[str, dict[str, float]] = {"base": dict(common)}
    for k, channel in enumerate(system.outputs):
        result[channel.name] = {**common, "y": _size(y[:, k])}
    for k, channel in enumerate(system.inputs):
        result.setdefault(channel.name, dict(common)).update(u=_size(u[:, k]), F=_size(u[:, k]))
    moved = form.motion(fitted, "estimation")
    for row, one in enumerate(system.coordinates):
        q, v = (np.concatenate([part[which][:, row] for part in moved]) for which in (0, 1))
        own = {"q": _size(q), "v": _size(v), "a": _size(np.gradient(v, dt)), "F": _size(u[:, one.force])}
        result.setdefault(one.name, dict(common)).update(own)
    return result


def form(
    system: FmuSystem,
    dataset: Dataset,
    *,
    horizon: Horizon,
    floors: tuple[NoiseFloor, ...],
    weights: FloatArray,
    sizes: Mapping[str, Mapping[str, float]],
) -> FmuForm:
    """Return the simulation form."""
    known = [one.value for one in floors]
    return FmuForm(system, dataset, sizes=sizes, horizon=horizon.seconds, weights=weights, floors=known)


def _plain(system: FmuSystem, dataset: Dataset, horizon: float | None) -> FmuForm:
    """Return a form whose outputs are weighted by their spread."""
    spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
    weights = np.maximum(0.1 * spread, 1e-12)
    return FmuForm(system, dataset, sizes={}, horizon=horizon, weights=weights, floors=[None] * dataset.spec.ny)


def _size(x: FloatArray) -> float:
    """Return the rms of what is finite."""
    kept = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0
