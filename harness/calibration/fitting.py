"""The story of a calibration: read the model and the records, say what is free, search, judge on validation data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from harness.blackbox.accuracy import ROWS, FmuAccuracy, coarsest
from harness.calibration.calibration import Calibration, Errors
from harness.calibration.runs import FreeModel, RecordSimulator
from harness.calibration.search import beginnings, best_fit, drawn, estimated_starts
from harness.calibration.slopes import OwnSlopes
from harness.calibration.variables import ModelContents, contents_of, free_parameters, start_values
from harness.errors import InputError, PlantError, refuse_unknown
from harness.models.estimate import null_words
from harness.options import as_options
from harness.parts.files import make_plant
from harness.physics.definition.parameters import Parameter
from harness.physics.fitting.fit_result import OutputErrorFit
from harness.physics.fitting.likelihood_fit import sensor_noise
from harness.physics.fitting.output_error_estimate import output_error_estimate
from harness.protocols import Plant
from harness.rng import stream
from harness.signals import Channel, Dataset, FloatArray, Trajectory

NOTHING = 1e-8
"""Relative eigenvalue of the information below which differences of runs tell no direction: four digits of a
sensitivity are sure, and the information is their square."""
HARDLY = 0.5
"""Relative standard deviation of a direction from which on the data hardly tell it: its interval holds nearly 0."""
MOST_STATES = 20  # States beyond which starts are not estimated: each costs a run for every derivative.
LOOK = 200  # Samples within which the start of a state must have moved an output.
NUDGE = 1e-2  # By how much a start is moved, relative to its value, or [SI unit].
SEEN = 1e-7  # Share of the nudge, in the unit of the output, below which an output counts as not moved.
DOMINATES = 0.2  # Share of the residual's rms that the solver inside may move the outputs by before it is said.

BIAS = 0.1
"""Of the noise that a solver may move readings by where only errors are compared, what it may where parameters get
intervals: noise averages out over a record, an error of the solver does not."""


def calibrate(
    path: str | Path,
    data: Dataset,
    *,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    starts: int = 3,
    initial: str = "estimated",
    slopes: str = "differences",
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Calibration:
    """Fit parameters of an FMU or a system so that its free runs come nearest to the estimation records.

    Output error: Levenberg-Marquardt on differences of runs, positive parameters through their logarithm, the start
    values of the states estimated in every record, outputs weighed by their residuals.

    Parameters
    ----------
    path : path
        An FMU, or a system of them (SSP, OSP).
    data : Dataset
        In SI units; channels are named after the model's variables.
    free : sequence of str
        Parameters; of a system ``component.parameter``.
    bounds : mapping, optional
        ``{"p": (low, high)}`` in SI, within the model's own.
    start : mapping, optional
        Start values in SI: of free parameters where the search begins, of others what they are, of states where every
        record begins.
    starts : int
        Starts of the search: the first as declared, the others drawn.
    initial : {"estimated", "file"}
        Whether the starts of states are estimated record by record, or those of the file hold for all.
    slopes : {"differences", "own"}
        ``"own"``: an FMU's own directional derivatives, where it has any and they agree with differences of runs. They
        are more exact, and cheaper where a step of the FMU costs more than telling its derivatives.
    seed : int
        Keys the drawn starts.
    options : mapping, optional
        Of the plant: ``tolerance``, ``step``, ``kind``, ``start_time``, ...
    progress : callable, optional
        Called as ``progress(share, what)``.

    Raises
    ------
    InputError
        If a name, a bound or the data do not fit the model (``FitError`` if they tell nothing).
    PlantError
        If the model breaks at its own start values.
    """
    if starts < 1:
        raise InputError("starts", expected="1 or more", got=str(starts), remedy="correct it", place="starts")
    refuse_unknown("initial", initial, ("estimated", "file"), remedy="choose one")
    refuse_unknown("slopes", slopes, ("differences", "own"), remedy="choose one")
    contents = contents_of(path)
    contents = contents if slopes == "own" else replace(contents, derivatives={})
    given = start_values(contents, start or {})
    parameters = free_parameters(contents, free, bounds or {}, given)
    tell = progress or (lambda share, what: None)
    records = _by_use(data)
    fixed = {contents.variables[n].key: v for n, v in given.items() if n not in free}
    chosen, finer = _settled(contents, data, as_options(options), fixed)
    with _plant(contents, data, chosen) as plant:
        runs, told, notes = _runs(contents, plant, data, parameters, fixed, initial, records["estimation"])
        x0 = {use: _first_starts(told, own) for use, own in records.items()}
        before = np.array([_own(contents, one) for one in parameters])
        sigma = np.maximum(np.std(np.vstack([one.y for one in records["estimation"]]), axis=0), 1e-12)
        was = {use: _errors(runs, own, before, x0[use], sigma) for use, own in records.items()}
        guesses = drawn(
            beginnings(runs, records["estimation"]),
            parameters,
            starts,
            x0["estimation"],
            [one.shown is None for one in told],
            stream("calibrate", seed),
        )
        fit, alike = best_fit(runs, records["estimation"], guesses, data.noise, tell)
        p = np.array([fit.parameters[one.name] for one in parameters])
        estimate = output_error_estimate(cast(Any, runs.system), fit, nothing=NOTHING, rule="differences of runs")
        now = {use: _errors(runs, own, p, x0[use], sigma) for use, own in records.items()}
        weak = _hardly(fit, parameters)
        notes += [*getattr(plant, "warnings", ()), *finer]
        count = runs.count
    notes += _solver_noise(contents, data, chosen, runs, p, fit, fixed)
    names = [channel.name for channel in runs.system.states]
    return Calibration(
        model=contents.path,
        kind=contents.kind,
        parameters=dict(zip(free, p.tolist(), strict=True)),
        before=dict(zip(free, before.tolist(), strict=True)),
        keys={name: contents.variables[name].key for name in free},
        given={name: value for name, value in given.items() if name not in free},
        estimate=estimate,
        starts=tuple(dict(zip(names, map(float, one), strict=True)) for one in fit.x0) if names else (),
        spec=data.spec,
        errors_before=was,
        errors_after=now,
        weak=weak,
        reached=alike,
        runs=count,
        notes=tuple(dict.fromkeys([*data.warnings, *notes])),
        recorded=data.recorded,
    )


def ports_of_system(path: str | Path) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """Return the inputs and outputs of a system, as data for it must be named."""
    with make_plant(str(path), {}) as plant:
        return plant.spec.inputs, plant.spec.outputs


def _by_use(data: Dataset) -> dict[str, list[Trajectory]]:
    """Return the measured records by their use, at least one for estimation."""
    records = {use: [one.measured() for one in data.using(use)] for use in ("estimation", "validation", "test")}
    if not records["estimation"]:
        raise InputError("records", expected="one for estimation at least", got="none", remedy='use = "estimation"')
    return records


def _plant(contents: ModelContents, data: Dataset, options: dict[str, Any]) -> Plant:
    """Return the model as a plant at the sample time of the data, with the channels of the data."""
    spec = data.spec
    asked: dict[str, Any] = {"sample_time": spec.sample_time, "start_time": contents.start_time}
    if contents.kind == "fmu":
        asked |= {"inputs": [one.name for one in spec.inputs], "outputs": [one.name for one in spec.outputs]}
    return make_plant(str(contents.path), asked | options)


def _settled(
    contents: ModelContents, data: Dataset, options: dict[str, Any], fixed: Mapping[str, float]
) -> tuple[dict[str, Any], list[str]]:
    """Return options with a step and tolerance at which finer ones change less than the noise, and what is to be said.

    Where the options name neither; as the model starts by itself along the first record.
    """
    if contents.kind != "fmu" or {"step", "tolerance"} & options.keys():
        return options, []
    records = [one.measured() for one in data.using("estimation")]
    record, dt = records[0][:ROWS], data.spec.sample_time
    known = [data.noise.get(channel.name, np.nan) for channel in data.spec.outputs]
    noise = np.where(np.isnan(known), sensor_noise(records), known)

    def given(settings: FmuAccuracy) -> dict[str, Any]:
        return {name: value for name, value in settings._asdict().items() if value is not None}

    def outputs(settings: FmuAccuracy) -> FloatArray:
        try:
            with _plant(contents, data, options | given(settings)) as plant:
                if fixed:
                    plant.preset(fixed)  # type: ignore[attr-defined]
                first = plant.reset(rng=np.random.default_rng(0))
                return np.vstack([first, plant.rollout(np.ascontiguousarray(record.u[:-1]))])  # type: ignore[attr-defined]
        except (InputError, PlantError) as error:
            if isinstance(error, PlantError) and error.status == "timeout" and settings == own:
                raise  # it would be waited for as long again
            return np.full((len(record), data.spec.ny), np.nan)

    own = FmuAccuracy(None, None)
    found = coarsest(outputs, own, dt, contents.tolerance, np.maximum(BIAS * noise, 1e-12))
    if found.settings == own or not found.enough:
        return options, []
    worst = int(np.argmax(found.first))
    moved = f"{data.spec.outputs[worst].name} by {BIAS * found.first[worst]:.2g} of its noise"
    said = f"the FMU is run with {found.settings.words(own, dt)}: with its own, finer ones move {moved}"
    return options | given(found.settings), [said]


def _runs(
    contents: ModelContents,
    plant: Plant,
    data: Dataset,
    parameters: tuple[Parameter, ...],
    fixed: Mapping[str, float],
    initial: str,
    records: Sequence[Trajectory],
) -> tuple[RecordSimulator, list[_Told], list[str]]:
    """Return what simulates, the states whose starts are estimated, and what is to be said."""
    if fixed:
        plant.preset(fixed)  # type: ignore[attr-defined]
    by_key = {one.key: one for one in contents.variables.values()}
    candidates = list(plant.spec.states)
    if not candidates and contents.kind == "fmu":
        candidates = [Channel(one.name, one.unit) for one in contents.variables.values() if one.integrated]
    notes: list[str] = []
    if initial == "file":
        candidates = []
    elif len(candidates) > MOST_STATES:
        notes.append(
            f"{len(candidates)} states: their starts are those of the file (at most {MOST_STATES} are estimated)"
        )
        candidates = []
    keys = {one.name: contents.variables[one.name].key for one in parameters}
    model = FreeModel(contents.name, data.spec.inputs, data.spec.outputs, tuple(candidates), parameters, keys)
    held = dict(zip((c.name for c in plant.spec.inputs), getattr(plant, "input_starts", ()), strict=False))
    runs = RecordSimulator(model, plant, held)
    p = np.array([one.value for one in parameters])
    own = np.array([by_key[c.name].start or 0.0 if c.name in by_key else 0.0 for c in candidates])
    told = _told_states(runs, p, own.tolist(), records, fixed)
    kept = replace(model, states=tuple(candidates[one.row] for one in told))
    made = RecordSimulator(kept, plant, held)
    first = made.run(p, np.array([one.start for one in told]), records[0].u)
    if not np.isfinite(first).all() and made.broken is not None and not np.isfinite(first[:1]).all():
        raise PlantError(f"at its start values: {made.broken}", status=made.broken.status)
    states = [channel.name for channel in plant.spec.states]
    if states and set(states) <= set(contents.derivatives):
        derivatives = {name: contents.derivatives[name] for name in states}
        trusted = _trust_own_slopes(made, plant, derivatives, p, told, records[0])
        notes += [f"derivatives of the FMU itself by: {', '.join(trusted)}"] if trusted else []
    return made, told, notes


def _trust_own_slopes(
    runs: RecordSimulator,
    plant: Plant,
    derivatives: Mapping[str, str],
    p: FloatArray,
    told: Sequence[_Told],
    record: Trajectory,
) -> list[str]:
    """Let the FMU's own directional derivatives stand for differences of runs; return where the two agree."""
    model = runs.system
    keys = [*(model.keys[name] for name in model.parameter_names), *(state.name for state in model.states)]
    own = OwnSlopes(plant, runs.begin, keys, derivatives, [channel.name for channel in model.outputs])
    x0 = _first_starts(told, [record])[0]
    own.try_out(p, x0, runs.rows(record.u), lambda k, count: runs.differences(k, p, x0, record.u[:count]))
    runs.own = own
    return [[*model.parameter_names, *(state.name for state in model.states)][k] for k in sorted(own.trusted)]


def _first_starts(told: Sequence[_Told], records: Sequence[Trajectory]) -> FloatArray:
    """Return a first guess of the starts (records, nx): what is measured, else what the file says."""
    rows = [[one.start if one.shown is None else record.y[0, one.shown] for one in told] for record in records]
    return np.array(rows, dtype=float).reshape(len(records), len(told))


def _own(contents: ModelContents, parameter: Parameter) -> float:
    """Return the model's own value of a parameter."""
    value = contents.variables[parameter.name].start
    assert value is not None
    return value


def _errors(
    runs: RecordSimulator, records: Sequence[Trajectory], p: FloatArray, x0: FloatArray, sigma: FloatArray
) -> tuple[Errors, ...]:
    """Return the errors of free runs by record, the starts of the states fitted to each."""
    found = []
    begun = estimated_starts(runs, records, p, x0, sigma)
    for record, first in zip(records, begun, strict=True):
        y = runs.run(p, first, record.u)
        miss = record.readings - y
        for k, channel in enumerate(runs.system.outputs):
            if channel.period is not None:
                miss[:, k] = (miss[:, k] + channel.period / 2) % channel.period - channel.period / 2
        if not np.isfinite(y).all():
            found.append({channel.name: (float("nan"), float("nan")) for channel in runs.system.outputs})
            continue
        rms = np.sqrt(np.nanmean(miss**2, axis=0))
        spread = np.maximum(np.nanstd(record.readings, axis=0), 1e-300)
        found.append(
            {c.name: (float(a), float(a / b)) for c, a, b in zip(runs.system.outputs, rms, spread, strict=True)}
        )
    return tuple(found)


def _hardly(fit: OutputErrorFit, parameters: Sequence[Parameter]) -> tuple[str, ...]:
    """Return the directions that the data hardly tell, in words: their relative deviation is large."""
    p = np.array([fit.parameters[one.name] for one in parameters])
    size = np.maximum(np.abs(p), 1e-300)
    jacobian = fit.jacobian() * size
    if not jacobian.size or not np.isfinite(jacobian).all():
        return ()
    _, spread, turned = np.linalg.svd(jacobian, full_matrices=False)
    deviation = np.sqrt(fit.chi2) / np.maximum(spread, 1e-300)
    loose = deviation > HARDLY
    if not loose.any():
        return ()
    return null_words([one.name for one in parameters], turned[loose].T, 1.0 / size)


def _solver_noise(
    contents: ModelContents,
    data: Dataset,
    options: dict[str, Any],
    runs: RecordSimulator,
    p: FloatArray,
    fit: OutputErrorFit,
    fixed: Mapping[str, float],
) -> list[str]:
    """Say where the model's own step or tolerance moves the outputs by a good part of what is left over."""
    record = data.using("estimation")[0].measured()
    x0 = np.asarray(fit.x0[0]) if fit.x0 else np.zeros(0)
    dt = data.spec.sample_time
    if contents.kind != "fmu":
        return []
    finer = {**options, "step": options.get("step", dt) / 2}
    tolerance = options.get("tolerance", contents.tolerance)
    if tolerance is not None:
        finer["tolerance"] = 0.01 * float(tolerance)
    try:
        with _plant(contents, data, finer) as plant:
            if fixed:
                plant.preset(fixed)  # type: ignore[attr-defined]
            y = RecordSimulator(runs.system, plant, {}).run(p, x0, record.u)
    except (InputError, PlantError):
        return []
    there = record.y - fit.residuals[0]
    change = np.sqrt(np.mean((y - there) ** 2, axis=0))
    rms = np.maximum(fit.rms, 1e-300)
    worst = int(np.argmax(change / rms))
    size = float(np.std(record.y[:, worst]))
    if not np.isfinite(change).all() or change[worst] < DOMINATES * rms[worst] or change[worst] < 1e-6 * size:
        return []
    name = data.spec.outputs[worst].name
    share = 100 * change[worst] / rms[worst]
    finer_words = "" if tolerance is None else " and a hundredth of the tolerance"
    return [
        f"half the communication step{finer_words} moves {name} by {change[worst]:.2g}, {share:.0f} % of the residual: "
        "the solver inside is part of what is fitted (--option step=..., --option tolerance=...)"
    ]


@dataclass(frozen=True)
class _Told:
    """A state whose start moves an output; ``shown`` is the output that shows it as it is, None where none does."""

    row: int
    start: float
    shown: int | None


def _told_states(
    runs: RecordSimulator,
    p: FloatArray,
    starts: Sequence[float],
    records: Sequence[Trajectory],
    fixed: Mapping[str, float],
) -> list[_Told]:
    """Return the states of a model with all that come into question whose starts the first record tells."""
    u = records[0].u[:LOOK]
    found = []
    for row, (channel, start) in enumerate(zip(runs.system.states, starts, strict=True)):
        if channel.name in fixed:
            continue
        nudge = NUDGE * max(1.0, abs(start))
        try:
            still = runs.simulate(p, {channel.name: start}, u)
            change = runs.simulate(p, {channel.name: start + nudge}, u) - still
        except InputError:  # its start is the model's own affair
            continue
        if not np.isfinite(change).all() or np.abs(change).max(initial=0.0) <= SEEN * nudge:
            continue
        shows = [
            k
            for k, output in enumerate(runs.system.outputs)
            if abs(change[0, k] - nudge) < 1e-6 * nudge and output.unit == channel.unit
        ]
        found.append(_Told(row, float(start), shows[0] if shows else None))
    return found
