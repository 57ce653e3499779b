"""Before the loop, where the nominal model is an FMU: its parameters, a rough fit, the horizon, sizes of effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.blackbox.accuracy import settled
from harness.blackbox.reader import fmu_system
from harness.blackbox.runner import Runner
from harness.blackbox.simulator import FmuSimulator
from harness.blackbox.system import FmuSystem
from harness.calibration.search import drawn
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.horizon import Horizon, short_window
from harness.errors import HarnessError, InputError
from harness.parts.files import describe_fmu
from harness.physics.compiled.windows import Evaluation, Windows
from harness.physics.fitting.levenberg import Minimised, minimise, minimise_states
from harness.physics.fitting.likelihood_fit import sensor_noise
from harness.physics.fitting.smoothing import smooth
from harness.rng import stream
from harness.signals import Dataset, FloatArray, Trajectory
from harness.supervision.patience import Aside, Patience

if TYPE_CHECKING:
    from harness.diagnosis.fmu.pushes import Moved

STARTS, ROUGH = 4, 40
"""Starts of the rough fit, and its iterations."""
LOOK = 3.0
"""Steps that the first look at an FMU may take as long as: it is loaded, and begun and stepped, up to three times."""
PULSE, ORDER = 4, 1.5
"""Samples in which a force over one sample has moved the readings, and the power of the exchanges in a sample with
which the error of dry friction falls."""
ALIKE = 0.1
"""Of the motion: how far a run that goes on from its own states may be off the one that was not interrupted."""
DECREASE = 1e-5
"""Relative decrease of the cost at which the states of windows are fitted: finite differences see no more."""


def nominal_fmu(path: str | Path, dataset: Dataset, parameters: Mapping[str, Any] | None = None) -> FmuSystem:
    """Return an FMU as the nominal model of a data set; parameters that do not move its outputs are kept fixed.

    It gets the step and the tolerance at which finer ones change less than the noise of the readings that are judged.

    Raises
    ------
    InputError
        See :func:`harness.blackbox.reader.fmu_system`; or the inputs of the data are not held.
    PlantError
        If it does not end to begin, or a step at the declared values.
    """
    if dataset.intersample != "zoh":
        raise InputError(
            "an FMU as nominal model",
            expected="inputs that are held (intersample 'zoh')",
            got=repr(dataset.intersample),
            remedy="resample the records, or write the model as equations",
            file=path,
        )
    system = _looked_at(path, dataset, parameters)
    simulator = FmuSimulator(system, Runner(system, dataset.spec.sample_time))
    run = dataset.estimation[0].measured()[: DATA_POLICY.look] if dataset.estimation else None
    if run is None:
        return system
    p = system.vector()
    x0 = measured_states(system, simulator, run, p)[0][0]
    _, y, sensitivities = simulator.windows(p[None], x0[None], run.u[None], None, run.t[:1])
    assert sensitivities is not None
    _refuse_stuck(simulator, y)
    moved = np.abs(sensitivities[0]).max(axis=(0, 1))
    kept = tuple(
        replace(parameter, fixed=True, minimum=-np.inf, maximum=np.inf)
        if not parameter.fixed and not moved[k] > 0
        else parameter
        for k, parameter in enumerate(system.parameters)
    )
    system = replace(system, parameters=kept)
    judged = dataset.estimation
    noise = sensor_noise([record.measured() for record in judged])
    told = describe_fmu(path)["experiment"]["tolerance"]
    system = settled(system, judged[0].measured(), noise, x0, told)
    return replace(system, exchanges=_exchanges(system, judged[0].measured(), noise, x0))


def _exchanges(system: FmuSystem, record: Trajectory, noise: FloatArray, x0: FloatArray) -> int:
    """Return how often in a sample a force that jumps has to be told.

    A force of the inputs' size over one sample may move no reading by more than its noise: where dry friction turns
    over, it is wrong by its own size for as long as it is held.
    """
    run, simulator = record[:PULSE], FmuSimulator(system, Runner(system, record.spec.sample_time))
    still = simulator.run(system.vector(), x0, run.u, float(run.t[0]))[1]
    most = 1.0
    for column in {coordinate.force for coordinate in system.coordinates}:
        size = float(np.sqrt(np.mean((record.u[:, column] - record.u[:, column].mean()) ** 2)))
        pulse = np.zeros_like(run.u)
        pulse[0, column] = size
        moved = np.abs(simulator.run(system.vector(), x0, run.u, float(run.t[0]), pulse)[1] - still) / noise
        most = max(most, float(np.nan_to_num(moved).max(initial=0.0)))
    parts = min(int(np.ceil(most ** (1 / ORDER))), EFFORT.exchanges)
    while parts > 1:
        try:
            Runner(system, record.spec.sample_time / parts).start(system.values(), {})
            return parts
        except HarnessError:  # it takes no such steps, or no second instance
            parts //= 2
    return parts


def rough_values(system: FmuSystem, dataset: Dataset, runner: Runner) -> dict[str, float] | None:
    """Return the parameters fitted over windows of a few periods of the motion; None if the simulation diverges.

    The best of fits from several starts: the declared values may be far off, and over a long window an error of the
    period has many minima.
    """
    simulator, p = FmuSimulator(system, runner), system.vector()
    records = [run.measured() for run in dataset.estimation]
    told = [measured_states(system, simulator, record, p) for record in records]
    hidden = [not all(known) for known in zip(*(known for _, known in told), strict=True)]
    length = round(short_window(dataset) / dataset.spec.sample_time)
    places = _places([len(record) for record in records], length, whole=restarts(simulator, records[0], p, told[0][0]))
    pieces = [records[number][first : first + length] for number, first in places]
    windows = FmuWindows(simulator, pieces, None, _spread(dataset))  # type: ignore[arg-type]
    begun = windows.starts_from([told[number][0][first : first + length] for number, first in places])
    rng, simulator.one_sided = stream("nominal FMU", system.digest), True
    free = np.array([not parameter.fixed for parameter in system.parameters], dtype=bool)
    tried: list[Minimised] = []
    for start, states in drawn(windows, system.parameters, STARTS, begun, hidden, rng, spread=EFFORT.spread):
        x0 = minimise_states(windows, start, states, 8)
        tried.append(minimise(windows, start, x0, free, EFFORT.first_steps, decrease=EFFORT.roughly))
    best = min(tried, key=lambda solution: solution.evaluation.cost)
    _refuse_stuck(simulator, np.array(best.evaluation.cost))
    if not np.isfinite(best.evaluation.cost):
        return None
    if not best.converged:
        simulator.one_sided = False
        simulator.forget()
        best = minimise(windows, best.p, best.x0, free, ROUGH - EFFORT.first_steps, decrease=EFFORT.roughly)
    return system.values(dict(zip(system.parameter_names, map(float, best.p), strict=True)))


def _looked_at(path: str | Path, dataset: Dataset, parameters: Mapping[str, Any] | None) -> FmuSystem:
    """Return an FMU as a system; raises PlantError (``timeout``) if it does not end to begin, or its first steps."""
    aside = Aside(Path(path).name, LOOK * Patience().longest)

    def look() -> FmuSystem:
        return fmu_system(path, dataset.spec, parameters)

    found: FmuSystem = aside.call(look, lambda: 0, lambda: "its initialisation, or a first step", loads=True)
    return found


def _refuse_stuck(simulator: FmuSimulator, y: FloatArray) -> None:
    """Raise PlantError (``timeout``) if a run of the model as it stands has no outputs because it did not end."""
    if simulator.runner.stuck is not None and not np.isfinite(y).all():
        raise simulator.runner.stuck


def restarts(simulator: FmuSimulator, record: Trajectory, p: FloatArray, states: FloatArray) -> bool:
    """Return whether a run that begins anew in the middle of a record, at the states that it had there, goes on alike.

    Where a state cannot be set, every run begins at the FMU's own start: only the beginnings of records are windows.
    """
    middle, t = len(record) // 2, record.t
    x, y = simulator.run(p, states[0], record.u, float(t[0]))
    if not np.isfinite(y).all():  # nothing is told
        return True
    again = simulator.run(p, x[middle], record.u[middle:], float(t[middle]))[1]
    return bool((np.sqrt(np.mean((again - y[middle:]) ** 2, axis=0)) <= ALIKE * np.std(y, axis=0)).all())


def _places(lengths: Sequence[int], length: int, *, whole: bool) -> list[tuple[int, int]]:
    """Return the record and the first sample of each window: their beginnings, or some evenly over all of them."""
    every = [(number, first) for number, n in enumerate(lengths) for first in range(0, max(n - length, 0) + 1, length)]
    if not whole:
        return [place for place in every if place[1] == 0]
    most = min(len(every), EFFORT.windows)
    return [every[k] for k in np.linspace(0, len(every) - 1, most).round().astype(int)]


def choose_horizon(system: FmuSystem, values: Mapping[str, float], dataset: Dataset, runner: Runner) -> Horizon:
    """Decide from how an error of the initial state grows whether whole records can be simulated.

    The derivative of the outputs by each settable state, over the sizes of both, must not grow beyond
    :data:`harness.diagnosis.records.horizon.GROWTH`. The size of a state is that of the record: a free run of an
    unstable FMU soon has left it.
    """
    simulator = FmuSimulator(system, runner)
    p = system.vector(values)
    shortest = np.inf
    for run in (record.measured() for record in dataset.estimation):
        seen, told = measured_states(system, simulator, run, p)
        x, y, sensitivities = simulator.windows(p[None], seen[:1], run.u[None], None, run.t[:1])
        assert sensitivities is not None
        _refuse_stuck(simulator, y)
        finite = np.isfinite(y[0]).all(axis=1)
        span = np.maximum(np.std(run.y, axis=0), 1e-12)
        begun = x[0][: DATA_POLICY.shortest][finite[: DATA_POLICY.shortest]]
        simulated = np.std(begun, axis=0) if begun.size else np.ones(system.nx)
        states = np.maximum(np.where(told, np.std(seen, axis=0), simulated), 1e-12)
        grown = np.abs(sensitivities[0][..., system.np :]) * states / span[:, None]
        worst = np.where(finite, np.nan_to_num(grown, nan=np.inf).max(axis=(1, 2), initial=0.0), np.inf)
        beyond = np.flatnonzero(worst > DATA_POLICY.growth)
        if beyond.size:
            shortest = min(shortest, beyond[0] * dataset.spec.sample_time)
    if not np.isfinite(shortest):
        return Horizon(None, "an error of the initial state does not grow: whole records are simulated")
    length = float(max(shortest, DATA_POLICY.shortest * dataset.spec.sample_time))
    return Horizon(
        float(f"{length:.2g}"), f"an error of the initial state grows {DATA_POLICY.growth:g} times in {shortest:.2g} s"
    )


def sizes_of(system: FmuSystem, moved: Sequence[Moved]) -> dict[str, dict[str, float]]:
    """Return the rms sizes at every port along the FMU's own motion, for start values of effects."""
    dt = moved[0].dt
    common = {"dt": dt, "T": max(len(part.u) for part in moved) * dt}
    u, y = (np.concatenate([getattr(part, name) for part in moved]) for name in ("u", "y"))
    result: dict[str, dict[str, float]] = {"base": dict(common)}
    for k, channel in enumerate(system.outputs):
        result[channel.name] = {**common, "y": _size(y[:, k])}
    for k, channel in enumerate(system.inputs):
        result.setdefault(channel.name, dict(common)).update(u=_size(u[:, k]), F=_size(u[:, k]))
    for row, coordinate in enumerate(system.coordinates):
        q, v = (np.concatenate([getattr(part, name)[:, row] for part in moved]) for name in ("q", "v"))
        own = {"q": _size(q), "v": _size(v), "a": _size(np.gradient(v, dt)), "F": _size(u[:, coordinate.force])}
        result.setdefault(coordinate.name, dict(common)).update(own)
    return result


class FmuWindows(Windows):
    """Windows of an FMU: a plain evaluation is not differentiated, for every column costs a run."""

    def evaluate(self, p: FloatArray, x0: FloatArray, *, keep: bool = False, jacobian: bool = False) -> Evaluation:
        """Simulate all windows; ``gram`` and ``gradient`` are 0 unless the Jacobian is asked for."""
        return self._evaluated(p, x0, keep, jacobian, None if jacobian else np.zeros(0, dtype=np.intp))


def measured_states(
    system: FmuSystem, simulator: FmuSimulator, record: Trajectory, p: FloatArray
) -> tuple[FloatArray, list[bool]]:
    """Return states (N, nx) along a record, and which of them it tells: smoothed outputs and their derivatives."""
    names = [channel.name for channel in system.outputs]
    states = [channel.name for channel in system.inner_states]
    x, known = np.zeros((len(record), system.nx)), [False] * system.nx
    rates = {coordinate.position: coordinate.rate for coordinate in system.coordinates}
    names = [system.shown.get(name, name) for name in names]
    for row, name in enumerate(names):
        if name not in states and rates.get(name) not in states:
            continue
        smoothed = smooth(record.y[:, row], simulator.dt, period=record.spec.outputs[row].period)
        if name in states:
            x[:, states.index(name)], known[states.index(name)] = smoothed.value, True
        rate = rates.get(name)
        if rate in states and rate not in names:
            x[:, states.index(rate)], known[states.index(rate)] = smoothed.rate, True
    if system.hidden_count:
        x[:, len(states) :] = simulator.hidden_starts(x, record.u, p)
    return x, known


def _spread(dataset: Dataset) -> FloatArray:
    """Return weights (ny,) of outputs: a tenth of their spread."""
    spread = np.std(np.concatenate([run.y for run in dataset.estimation]), axis=0)
    return np.asarray(np.maximum(0.1 * spread, 1e-12))


def _size(x: FloatArray) -> float:
    """Return the rms of what is finite."""
    kept = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0
