"""The commands of ``sysid`` as Python calls of the same names; the command line is a thin layer above this file.

The heavy rooms are imported inside the calls, so that asking for help stays fast.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, cast

import numpy as np

from harness import registry
from harness.errors import HarnessError, InputError, PlantError, PluginError, as_written, refuse_no_file
from harness.fitted import FittedModel, Usable, load_model
from harness.options import meant_options, say_beyond
from harness.parts.files import describe_fmu, is_plant_file, is_system, make_plant, stream_key
from harness.parts.listing import LISTED, describe_part, list_parts
from harness.protocols import Experiment, Identifier, Model, Plant, Predictive, Scenario
from harness.rng import Streams, stream
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Trajectory, Use
from harness.trust import names_fmu

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from harness.benchmark import Answer, BenchResult
    from harness.benchmark.planning import Plan
    from harness.benchmark.public import PublicResult
    from harness.calibration import Calibration
    from harness.comparison import Comparison, OrderSelection, ReportComparison, Spectrum
    from harness.conformance import CheckResult
    from harness.cosim.convergence import Convergence
    from harness.cosim.free_run import FreeRun
    from harness.data import LoadedDataset, Nominal
    from harness.data.oddities import DataCheck
    from harness.data.recipe.chosen import Noted, Records, Signals
    from harness.diagnosis import Report
    from harness.diagnosis.planned import Planned
    from harness.effects.effect import Effect
    from harness.fleet import FleetResult
    from harness.frequency.identified import IdentifiedResponse
    from harness.learned import LearnedResidual
    from harness.modal import Criteria, Modes
    from harness.models.analysis import Findings, Takes
    from harness.models.arx_orders import ArxGrid
    from harness.scoring import Score
    from harness.scoring.predictive import ProbabilityScore
    from harness.vetting import Agreement, Vetting

__all__ = [
    "DEFAULT_IDENTIFIER",
    "LISTED",
    "UNDRIVEN_IDENTIFIER",
    "FittedModel",
    "Identified",
    "agreement",
    "analyse",
    "arx_orders",
    "bench",
    "bench_public",
    "calibrate",
    "check",
    "check_data",
    "close_fleet",
    "close_loop",
    "compare",
    "compare_reports",
    "default_identifier",
    "describe_fmu",
    "describe_part",
    "describe_system",
    "equations",
    "export",
    "halve",
    "identify",
    "identify_response",
    "isolability",
    "learn_residual",
    "list_parts",
    "load_dataset",
    "load_model",
    "new",
    "order",
    "plan_bench",
    "query",
    "simulate",
    "spectrum",
    "stored_public",
    "table",
    "vet",
]


def describe_system(path: str | Path) -> dict[str, Any]:
    """Return what is in a system of FMUs: components, connections, values, experiment (``sysid list FILE.ssp``).

    Raises
    ------
    InputError
        If it cannot be read, or needs what is not understood.
    """
    from harness.cosim.structure import describe_structure

    return describe_structure(path, describe_fmu)


def describe_file(path: str | Path) -> dict[str, Any]:
    """Return what is inside a file (``sysid list FILE``): of data, a robot, or a stored model. Nothing of it is run.

    Parameters
    ----------
    path : path
        Data in any format that is read, a URDF, an MJCF, equations (``.eqs``), or a ``model.json``.

    Returns
    -------
    dict
        ``facts``, lines for a person; ``tables``, rows by name; ``content``, all of it.

    Raises
    ------
    InputError
        If the file is missing or cannot be read.
    """
    from harness.data.recipe.contents import contents_of

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in (".urdf", ".xml", ".mjcf"):
        from harness.physics.arms.formats.robot_files import robot_contents

        robot = robot_contents(path)
        facts = [f"{path.name}: {robot['format']} {robot['name']!r}, {robot['bodies']} bodies, "
                 f"{len(robot['joints'])} joints, {len(robot['actuators'])} actuators"]  # fmt: skip
        return {
            "facts": facts,
            "tables": {name: robot[name] for name in ("joints", "actuators", "sensors")},
            "content": robot,
        }
    if suffix == ".json":
        return _described_model(path)
    if suffix == ".eqs":
        return _described_equations(path)
    found = contents_of(path)
    numbers = ("minimum", "maximum", "mean", "deviation")
    sizes = [{key: getattr(channel, key) for key in numbers} for channel in found.channels]
    rows = [
        {
            "column": channel.column,
            "unit": channel.unit or "-",
            **{key: "" if value is None else f"{value:.4g}" for key, value in size.items()},
            "rows": str(channel.rows),
            "every [s]": "" if channel.every is None else f"{channel.every:.4g}",
            "empty": str(channel.empty),
            "note": channel.note,
        }
        for channel, size in zip(found.channels, sizes, strict=True)
    ]
    return {"facts": found.facts(), "tables": {"channels": rows}, "content": found.to_dict()}


def _described_equations(path: Path) -> dict[str, Any]:
    """Return the equations of a file of text, its inputs, outputs and parameters."""
    from harness.physics import load_model
    from harness.physics.symbolic.equation_text import equations

    system = load_model(str(path))
    groups = {"inputs": system.inputs, "outputs": system.outputs, "states": system.states}
    tables = {name: [{name[:-1]: one.name, "unit": one.unit} for one in channels] for name, channels in groups.items()}
    tables["parameters"] = [
        {"parameter": one.name, "unit": one.unit, "start": f"{one.value:g}"} for one in system.parameters
    ]
    facts = [f"{path.name}: {system}", *equations(system.mechanism)]
    return {"facts": facts, "tables": tables, "content": {"equations": facts[1:], **tables}}


def _described_model(path: Path) -> dict[str, Any]:
    """Return what a model.json states, without making the model."""
    import json

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            "a model.json", expected="JSON that sysid wrote", got=str(error)[:120], remedy="check the file", file=path
        ) from error
    if not isinstance(content, dict) or "kind" not in content:
        raise InputError(
            "a model.json",
            expected="an object with a kind",
            got=type(content).__name__,
            remedy="check the file",
            file=path,
        )
    with as_written(path, "model.json"):
        spec = content.get("spec") or {}
        ports = [
            {"port": port.get("name", ""), "role": role[:-1], "unit": port.get("unit", "1")}
            for role in ("inputs", "outputs", "states")
            for port in spec.get(role, [])
        ]
        parameters = [
            {"parameter": name, "value": f"{value:.6g}" if isinstance(value, int | float) else str(value)}
            for name, value in (content.get("parameters") or {}).items()
        ]
        facts = [f"{path.name}: model of kind {content['kind']!r}"]
        facts += [f"built on {content['model']}"] if content.get("model") else []
        facts += [f"sample time {spec['sample_time']} s"] if spec.get("sample_time") else []
        effects = content.get("effects") or []
        facts += [f"effects: {', '.join('@'.join(map(str, one)) for one in effects)}"] if effects else []
        return {"facts": facts, "tables": {"ports": ports, "parameters": parameters}, "content": content}


def new_dataset(
    files: Sequence[str | Path], *, model: str | None = None, out: str | Path = "dataset.toml", force: bool = False
) -> Path:
    """Write a dataset.toml drafted from files of data (``sysid new dataset FILE...``).

    Parameters
    ----------
    files : sequence of path
        One for each run; the first is for estimation, the others validate.
    model : str, optional
        Nominal model, whose ports name the columns.
    out : path
    force : bool
        Overwrite it.

    Raises
    ------
    InputError
        If a file cannot be read, or ``out`` exists.
    """
    from harness.data.recipe.draft import draft_dataset

    out = Path(out)
    _refuse_overwrite(out, force=force)
    out.write_text(draft_dataset(files, model=model, folder=out.parent), encoding="utf-8")
    return out


def simulate(
    plant: str,
    *,
    scenario: str | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
    scenario_options: Mapping[str, Any] | None = None,
    hide: Sequence[tuple[str, str, Mapping[str, float]]] = (),
    role: str = "estimation/0",
    start: float | None = None,
    stop: float | None = None,
    step: float | None = None,
    tolerance: float | None = None,
    exchange: str | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    note: Callable[[str], None] | None = None,
    broke: Callable[[PlantError], None] | None = None,
) -> Trajectory:
    """Run a scenario on a plant and record it; without a scenario, run an FMU or a system of them as it is.

    Parameters
    ----------
    plant : str
        Id of a registered plant, or a path: an FMU, a coupling in TOML, an SSP package (also unpacked), an OSP system
        structure.
    scenario : str, optional
        Id of a registered scenario. What is a file runs without one too: with its default experiment, its start
        values, and all its outputs.
    seed : int
        Together with the two ids and the role it keys every random number.
    out : path, optional
        ``.csv`` or ``.parquet`` file to write. A run with a controller also gets what came from outside the loop, in
        columns that start with ``reference:``.
    options, scenario_options : mapping, optional
        Options of the plant and of the scenario.
    hide : sequence of (effect, port, parameters)
        Effects to hide in the plant, e.g. ``("dead_zone", "u", {"width": 0.1})``.
    role : str
        ``estimation/0``, ``validation/0``, ...: other roles give other excitation and noise.
    start, stop, step, tolerance : float, optional
        Of an FMU or a system without a scenario: begin, end and sample time [s], relative tolerance of the solver.
    exchange : {"jacobi", "gauss-seidel"}, optional
        Of a coupling or a system: whether all parts step with the values of the last instant, or each with what those
        before it have just put out; by default as its file says.
    force : bool
        Overwrite ``out`` if it exists.
    progress : callable, optional
        Called as ``progress(samples_done, samples)``.
    note : callable, optional
        Called with what a run without a scenario has to say, such as why its run ended early.
    broke : callable, optional
        Called with the error that ended a run without a scenario early, if it was no wish of the plant (status
        ``"terminated"``); the rows before it are kept.

    Returns
    -------
    Trajectory
        With the true states where the plant knows them.

    Raises
    ------
    InputError
        If an id, an option or the output file cannot be used.
    PlantError
        If the plant breaks or diverges.

    Warns
    -----
    harness.options.BoundsWarning
        If a parameter is given a value outside the bounds that its model or FMU declares and ``note`` is not given
        (which gets the sentence otherwise). The run goes on with that value.
    """
    _refuse_overwrite(out, force=force, endings=(".csv", ".parquet"))
    options = dict(options or {})
    if exchange is not None:
        if names_fmu(plant) or not is_plant_file(plant):
            raise InputError(
                "exchange", expected="a coupling or a system of FMUs", got=plant, remedy="leave --exchange out"
            )
        options["order"] = exchange
    if scenario is None:
        asked = {"start": start, "stop": stop, "step": step, "tolerance": tolerance}
        trajectory = _as_is(plant, asked, options, bool(hide or scenario_options), progress, note, broke)
        _write_record(trajectory, out)
        return trajectory
    if any(value is not None for value in (start, stop, step, tolerance)):
        raise InputError(
            "start, stop, step and tolerance",
            expected="none of them with a scenario, which says how long the run is",
            got=f"the scenario {scenario}",
            remedy="give --scenario-option duration=... and --option sample_time=..., tolerance=..., start_time=...",
        )
    made_scenario = cast(Scenario, registry.create("scenarios", scenario, **dict(scenario_options or {})))
    with _make_plant(plant, options, hide) as made:
        from harness.rollout import perform

        say_beyond(getattr(made, "beyond", ()), note)
        if note is not None and (held := getattr(made, "held", ())):
            note(
                f"{', '.join(held)}: from outside the plant, held over each sample of {made.spec.sample_time:g} s; "
                "what is stiff within one is another law then (a smaller sample_time comes nearer)"
            )
        streams = Streams(stream_key(plant), scenario, seed)
        experiment = made_scenario.prepare(made.spec, streams=streams, role=role)
        experiment = _started(experiment, options.get("start"))
        trajectory = perform(made, experiment, rng=streams(f"{role}/plant"), progress=progress)
    _write_record(trajectory, out, references=_from_outside(experiment, made.spec))
    return trajectory


def halve(
    plant: str,
    *,
    times: int,
    step: float | None = None,
    out: str | Path | None = None,
    picture: str | Path | None = None,
    force: bool = False,
    note: Callable[[str], None] | None = None,
    **asked: Any,
) -> Convergence:
    """Run an FMU, a coupling or a system as it is at a step, its half, and so on: what changes, and at which order.

    Parameters
    ----------
    plant : str
        A path.
    times : int
        How often the step is halved.
    step : float, optional
        The coarsest step [s]; default that of the file.
    out : path, optional
        ``.csv`` or ``.parquet`` file for the record at the finest step.
    picture : path, optional
        ``.svg``, ``.png`` or ``.pdf`` file for the changes over the step.
    force : bool
        Overwrite what exists.
    note : callable, optional
        Called with what the coarsest run has to say.
    **asked
        ``start``, ``stop``, ``tolerance``, ``exchange``, ``options``, ``progress`` of :func:`simulate`.

    Raises
    ------
    InputError
        If the file, an option or ``times`` cannot be used, or a run ends early.
    """
    from harness.cosim.convergence import halved

    _refuse_overwrite(out, force=force)
    _refuse_overwrite(picture, force=force, endings=PICTURES)
    hearers = [note]

    def run(chosen: float | None) -> Trajectory:
        return simulate(plant, step=chosen, note=hearers.pop() if hearers else None, **asked)

    found = halved(run, times, step)
    if note is not None and not names_fmu(plant):
        from harness.cosim import own_steps

        kept = own_steps(plant, within=(asked.get("options") or {}).get("within"))
        if kept:
            named = ", ".join(kept[:6]) + (", ..." if len(kept) > 6 else "")
            note(f"steps of their own get no finer, only the exchange with the others does: {named}")
    _write_record(found.finest, out)
    _draw(found.figure, picture)
    return found


def bench(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    seeds: tuple[int, int] | None = None,
    engine: str = "local",
    resume: bool = False,
    shard: str | None = None,
    traces: str = "first",
    progress: Callable[[int, int, str], None] | None = None,
) -> BenchResult:
    """Run a benchmark suite; see :func:`harness.benchmark.bench`."""
    from harness import benchmark

    return benchmark.bench(
        suite,
        out=out,
        workers=workers,
        seeds=seeds,
        engine=engine,
        resume=resume,
        shard=shard,
        traces=traces,
        progress=progress,
    )


def bench_public(**asked: Any) -> PublicResult:
    """Run the public table (``sysid bench public``); see :func:`harness.benchmark.public.bench_public`."""
    from harness.benchmark import public

    return public.bench_public(**asked)


def stored_public(directory: str | Path) -> PublicResult | None:
    """Return the public table that a folder holds, or None; see :func:`harness.benchmark.public.read_public`."""
    if not (Path(directory) / "public.json").is_file():
        return None
    from harness.benchmark import public

    return public.read_public(directory)


def plan_bench(suite: str | Path, **asked: Any) -> Plan:
    """Return what :func:`bench` would run, and how long it would take; see :func:`harness.benchmark.plan`."""
    from harness import benchmark

    return benchmark.plan(suite, **asked)


def query(directory: str | Path, sql: str | None = None, *, filters: Mapping[str, Any] | None = None) -> Answer:
    """Return the answer to a query over the tables of a benchmark's or a fleet's folder, or its first table.

    See :func:`harness.benchmark.query` and :func:`harness.fleet.query`.
    """
    from harness import benchmark, fleet

    room = fleet.query if fleet.is_fleet_folder(directory) else benchmark.query
    return room(directory, sql, filters=filters)


def table(directory: str | Path) -> BenchResult:
    """Read a stored benchmark back, ready to be printed; see :func:`harness.benchmark.table`."""
    from harness import benchmark

    return benchmark.table(directory)


_DRAWN = 20_000
"""Samples that a notebook draws by itself: longer records ask for plot()."""

DEFAULT_IDENTIFIER = "prediction-error"
"""Where none is asked for: the state-space model of largest likelihood; order, dead times and noise by the data."""
UNDRIVEN_IDENTIFIER = "arx"
"""Where nothing drives the outputs either: least squares without start values, its order chosen on data held out."""


def default_identifier(spec: PlantSpec) -> str:
    """Return the id of the identifier that records of such channels get where none is asked for.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> default_identifier(PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.1))
    'prediction-error'
    """
    return DEFAULT_IDENTIFIER if spec.nu else UNDRIVEN_IDENTIFIER


@dataclass(frozen=True)
class Identified(Usable):
    """What ``identify`` returns: the model, and its scores by use of the data; to be used as a :class:`FittedModel`."""

    model: Model
    equation_error: dict[Use, list[Score]]
    simulation_error: dict[Use, list[Score]]
    warnings: tuple[str, ...]
    probability: dict[Use, list[ProbabilityScore]] = field(default_factory=dict)
    """One step ahead, of a model that predicts distributions; empty for others."""
    judged: Trajectory | None = field(default=None, repr=False, compare=False)
    """The record that the picture in a notebook shows: the first that validates."""
    bounds: Findings | None = field(default=None, repr=False)
    """What theorems for finite samples promise beside what was measured, where it was asked for."""

    def plot(self) -> Figure:
        """Return the figure of the record that judges: its inputs, what was measured, and the free run of the model."""
        from harness.scoring import predict

        if self.judged is None:
            raise InputError("no record to plot", expected="what identify returned", got="none", remedy="plot a record")
        figure: Figure = self.judged.plot()
        run = np.asarray(predict(self.model, self.judged, horizon=None))
        for axis, values in zip(figure.axes[self.judged.spec.nu :], run.T, strict=True):
            low, high = axis.get_ylim()
            axis.plot(self.judged.t, values, "--", color="#cc6677", linewidth=0.9, label="free run")
            room = 0.4 * (high - low)
            axis.set_ylim(max(axis.get_ylim()[0], low - room), min(axis.get_ylim()[1], high + room))
            axis.legend(loc="upper right", fontsize=8)
        return figure

    def errors(self) -> dict[str, tuple[float, str]]:
        """Return the rms of the free run on validation data (on estimation data where none validates), with its unit.

        By output, over all runs of that use.
        """
        from harness.comparison.models import free_run_errors

        return free_run_errors(self.model, self.simulation_error)

    def to_dict(self) -> dict[str, Any]:
        """Return model, scores and warnings, ready for JSON."""
        scores = {
            name: {
                use: [{"rms": s.rms.tolist(), "nrmse": s.nrmse.tolist(), "samples": s.samples} for s in own]
                for use, own in found.items()
            }
            for name, found in (("equation_error", self.equation_error), ("simulation_error", self.simulation_error))
        }
        bounds = {} if self.bounds is None else {"bounds": self.bounds.to_dict()}
        return {"model": self.model.to_dict(), **scores, "warnings": list(self.warnings), **bounds}

    def _rows(self) -> list[tuple[str, ...]]:
        """Return use, run, output, NRMSE one step ahead and in free run, rms in free run."""
        return [
            (use, str(run), channel.name, *(f"{s.nrmse[k]:.4g}" for s in pair), f"{pair[1].rms[k]:.3g} {channel.unit}")
            for use in self.equation_error
            for run, pair in enumerate(zip(self.equation_error[use], self.simulation_error[use], strict=True))
            for k, channel in enumerate(self.model.spec.outputs)
        ]

    def __repr__(self) -> str:
        rows = [f"{use} {run} {name} {free}" for use, run, name, _, free, _ in self._rows()]
        return f"<Identified {type(self.model).__name__}: NRMSE in free run: {', '.join(rows)}>"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        titles = ["use", "run", "output", "NRMSE one step ahead", "NRMSE in free run", "rms in free run"]
        parts = [table(titles, self._rows())]
        if values := getattr(self.model, "parameters", None):
            spread, found = getattr(self.model, "deviations", {}), self.estimate
            units = {} if found is None else dict(zip(found.names, found.units, strict=True))
            shown = [
                (n, f"{v:.6g}", f"{spread[n]:.2g}" if n in spread else "", units.get(n, "")) for n, v in values.items()
            ]
            parts.append(table(["parameter", "value", "standard deviation", "unit"], shown))
        if self.judged is not None and len(self.judged) <= _DRAWN:
            from harness.plots import inlined

            parts.append(inlined(self.plot(), "measured and simulated"))
        return page(f"{type(self.model).__name__}: {self.model.spec}", *parts)


def load_dataset(
    dataset: Any,
    *,
    model: str | None = None,
    validation: Any = None,
    ports: tuple[Sequence[Channel], Sequence[Channel]] | None = None,
    undriven: Sequence[str] = (),
    **signals: Unpack[Signals],
) -> LoadedDataset:
    """Read a data set, or a recording by its name, check it, and convert it to SI units.

    Parameters
    ----------
    dataset : path, str, table or records
        The name of a recording (``sysid list recordings``), or what :func:`harness.data.load_dataset` reads.
    model : str, optional
        Nominal model that names the ports.
    validation : path or table, optional
        Validation data beside a bare file or table; without them the last third validates.
    undriven : sequence of str
        Inputs of the model that nothing drove; any other must be recorded.
    ports, **signals
        See there.

    Returns
    -------
    harness.data.LoadedDataset
        What was noticed stands in ``dataset.warnings``.

    Raises
    ------
    InputError
        If there is no such recording, or a file, column, unit, time axis or value cannot be used.

    Examples
    --------
    >>> t = np.arange(90) * 0.1
    >>> found = load_dataset({"t [s]": t, "u [N m]": np.sin(t), "theta [rad]": np.cos(t)}, model="pendulum")
    >>> found.dataset.spec.sample_time
    0.1
    """
    from harness import data

    path = registry.dataset_path(dataset)
    return data.load_dataset(path, model=model, validation=validation, ports=ports, undriven=undriven, **signals)


def identify_response(
    data: Any,
    *,
    identifier: str = "transfer-function",
    options: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    sample_time: float | None = None,
    low: float = 0.0,
    high: float = float("inf"),
    out: str | Path | None = None,
    force: bool = False,
) -> IdentifiedResponse:
    """Fit a transfer function to a measured frequency response.

    Parameters
    ----------
    data : path, FrequencyResponse or Spectrum
        A CSV file (:func:`harness.frequency.read_response`), or what :func:`spectrum` found.
    identifier : str
        One that fits frequency responses: ``"transfer-function"``.
    options : mapping, optional
        Its options.
    units : mapping, optional
        Units of inputs and outputs of a file, by name.
    sample_time : float, optional
        [s]; the model that is stored is then that between samples, for records of this sample time.
    low, high : float
        [Hz]; the rest is left out.
    out : path, optional
        JSON file for the model.
    force : bool
        Overwrite ``out`` if it exists.

    Raises
    ------
    InputError
        If the file or the options cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from harness.frequency import FrequencyResponse
    >>> f = np.geomspace(0.01, 10, 30)
    >>> found = identify_response(FrequencyResponse(f, 3 / (2j * np.pi * f + 2)), options={"order": 1, "delay": 0.0})
    >>> print(found.model)
    y per u: 3 / (s + 2)
    """
    from harness.frequency import FrequencyResponse, read_response
    from harness.frequency.identified import IdentifiedResponse

    _refuse_overwrite(out, force=force)
    if hasattr(data, "coherence"):
        data = FrequencyResponse.of_spectrum(data)
    elif not isinstance(data, FrequencyResponse):
        data = read_response(data, units=units)
    if low > 0 or high < float("inf"):
        data = data.between(low, high)
    made = registry.create("identifiers", identifier, **dict(options or {}))
    if not hasattr(made, "fit_response"):
        raise InputError(
            f"identifier {identifier!r} fits records, not frequency responses",
            expected="transfer-function",
            got=identifier,
            remedy="use transfer-function",
        )
    model = made.fit_response(data)
    found = IdentifiedResponse(data, model)
    if out is not None:
        stored = model if sample_time is None else model.sampled(sample_time, getattr(made, "hold", "zoh"))
        _write_json(Path(out), stored.to_dict())
    return found


def identify(
    dataset: Any,
    y: Any = None,
    *,
    identifier: str | None = None,
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    bounds: bool = False,
    force: bool = False,
    **records: Unpack[Records],
) -> Identified:
    """Fit one model to a data set, or to an input and an output, and score it on every use of the data.

    Parameters
    ----------
    dataset : path, table, records, or the input
        ``dataset.toml``, a table (CSV, Parquet, ..., or a DataFrame, an xarray Dataset, a mapping of arrays), a
        :class:`Trajectory` or several, a :class:`Dataset`; or, beside ``y``, the input alone.
    y : array (N,) or (N, ny), Series or DataFrame, optional
        Output, where the first argument is the input u, (N,) or (N, nu): ``u[k]`` is held on ``[t[k], t[k+1])``. Give
        ``sample_time`` [s] (an index of times that both share is read). Numbers count as they are.
    identifier : str, optional
        Id of a registered identifier; without a physical model :func:`default_identifier`.
    options : mapping, optional
        Its options.
    model : str, optional
        Nominal model that names the ports (needed for a bare CSV or Parquet file). An identifier that fits a physical
        model fits this one, or the one that the data set names, unless ``options`` say otherwise.
    out : path, optional
        JSON file for the model.
    seed : int
        For identifiers that draw random numbers.
    bounds : bool
        Put bounds for finite samples beside what was measured; of linear models (the analysis ``finite-sample``).
    force : bool
        Overwrite ``out`` if it exists.
    **records : Records
        ``validation``, ``undriven``, ``input``, ``output``, ``column``, ``unit``, ``sample_time``, ``gaps``, ``run``:
        as for :func:`harness.load_dataset`.

    Raises
    ------
    InputError
        If the data or the options cannot be used (``FitError`` if no model can be learned from them).

    Examples
    --------
    >>> import numpy as np
    >>> u = np.random.default_rng(0).standard_normal(400)
    >>> y = np.zeros(400)
    >>> for k in range(399):
    ...     y[k + 1] = 0.8 * y[k] + 0.5 * u[k]
    >>> identify(u, y, sample_time=0.1, options={"order": 1}).poles.round(3)
    array([0.8+0.j])
    """
    _refuse_overwrite(out, force=force)
    from harness.scoring import equation_error, simulation_error
    from harness.scoring.predictive import probability_score

    if y is not None:
        dataset, records = _table_of(dataset, y, records)
    if identifier is None and model is not None:
        raise InputError(
            "no identifier for a physical model",
            expected="identifier = ... (sysid: --identifier), such as output-error",
            got=f"the model {model} alone",
            remedy="choose one (sysid list identifiers); of an FMU or an SSP name what is free: --free NAME,NAME",
        )
    if (
        identifier is not None
        and model is None
        and records.get("output") is None
        and hasattr(registry.load("identifiers", identifier), "channels")
    ):
        records = {**records, **_channels(registry.create("identifiers", identifier, **dict(options or {})), dataset)}
    loaded = load_dataset(dataset, model=model, **records)
    data = loaded.dataset
    identifier = default_identifier(data.spec) if identifier is None else identifier
    made = registry.create("identifiers", identifier, **_with_model(identifier, dict(options or {}), loaded.nominal))
    if not isinstance(made, Identifier):
        raise InputError(
            f"identifier {identifier!r} cannot be fitted to a record",
            expected="an identifier with fit()",
            got=type(made).__name__,
            remedy="use it online in a benchmark suite, or choose another (sysid list identifiers)",
        )
    measured = [trajectory.measured() for trajectory in data.estimation]
    try:
        fitted = made.fit(measured, rng=stream("identify", identifier, seed))
    except HarnessError:
        raise
    except Exception as error:
        raise PluginError(f"identifier {identifier!r} raised {type(error).__name__}: {error}") from error
    if out is not None:
        _write_json(Path(out), fitted.to_dict())
    uses: tuple[Use, ...] = ("estimation", "validation", "test")
    probability = {}
    if isinstance(fitted, Predictive):
        probability = {use: [probability_score(fitted, one) for one in data.using(use)] for use in uses}
    return Identified(
        fitted,
        {use: [equation_error(fitted, one) for one in data.using(use)] for use in uses},
        {use: [simulation_error(fitted, one) for one in data.using(use)] for use in uses},
        (*_said(fitted), *data.warnings),
        probability,
        next(iter((*data.validation, *data.estimation)), None),
        _bounds_beside(fitted, measured, identifier, seed) if bounds else None,
    )


def _table_of(u: Any, y: Any, records: Records) -> tuple[Any, Records]:
    """Return inputs and outputs that were given apart as a table, and what is said of its columns."""
    from harness.data.tables.memory import input_and_output

    table, names, others = input_and_output(u, y)
    if "input" in records or "output" in records:
        raise InputError(
            "input and output", expected="arrays u and y, or a table with input= and output=", got="both",
            remedy="leave out one",
        )  # fmt: skip
    return table, {**records, "input": names, "output": others}


def _bounds_beside(model: Model, records: Sequence[Trajectory], identifier: str, seed: int) -> Findings:
    """Return bounds for finite samples beside a model that was fitted to records."""
    made: Any = registry.create("analyses", "finite-sample", identifier=identifier)
    return cast("Findings", made.beside(model, records, rng=stream("bounds", identifier, seed)))


def calibrate(
    dataset: Any,
    *,
    model: str | Path,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    starts: int = 3,
    initial: str = "estimated",
    slopes: str = "differences",
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    ssv: str | Path | None = None,
    model_out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
    **records: Unpack[Records],
) -> Calibration:
    """Fit parameters of an FMU or a system of FMUs to data (``sysid identify DATA --model X.fmu --free p1,p2``).

    Parameters
    ----------
    dataset
        As for :func:`identify`; columns are named after the model's inputs and outputs.
    model : path
        ``.fmu``, ``.ssp``, ``.ssd`` or an OSP structure. It runs in a process of its own.
    free : sequence of str
        Parameters to fit; of a system ``component.parameter``.
    bounds, start, starts, initial, slopes, seed, options
        See :func:`harness.calibration.calibrate`.
    out : path, optional
        JSON file with all that was found.
    ssv : path, optional
        SSV file for the calibrated values.
    model_out : path, optional
        Copy of the FMU or the SSP that starts from the calibrated values.
    force : bool
        Overwrite what exists.
    progress : callable, optional
        Called as ``progress(share, what)``.
    **records : Records
        As for :func:`identify`.

    Raises
    ------
    InputError
        If a name, a bound, the data or a file cannot be used (``FitError`` if the data tell nothing).
    PlantError
        If the model breaks at its own start values.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> with registry.create("plants", "mass-spring-fmu", sample_time=0.05, m=1.5, k=4.0) as plant:
    ...     u = np.repeat(np.random.default_rng(0).normal(size=(20, 1)), 10, axis=0)
    ...     y = np.vstack([plant.reset(rng=np.random.default_rng(0)), plant.rollout(u[:-1])])
    ...     record = Trajectory(np.arange(200) * 0.05, u, y, plant.spec)
    >>> found = calibrate(record, model=mockup("mass_spring"), free=["m", "k"], starts=1)
    >>> {name: round(value, 3) for name, value in found.parameters.items()}
    {'m': 1.5, 'k': 4.0}
    """
    from harness import calibration

    _refuse_overwrite(out, ssv, model_out, force=force)
    name, system = str(model), is_system(str(model))
    if not (system or names_fmu(name)):
        raise InputError(
            "model to calibrate",
            expected="an FMU or a system of them (.fmu, .ssp, .ssd, OspSystemStructure.xml)",
            got=repr(name),
            remedy="a model of equations is fitted by --identifier output-error",
        )
    loaded = load_dataset(
        dataset, model=None if system else name, ports=calibration.ports_of_system(name) if system else None, **records
    )
    rates = [channel for channel, (_, times) in zip(loaded.dataset.spec.outputs, loaded.measured, strict=True) if times]
    if rates:
        raise InputError(
            "a derivative as an output",
            expected="variables of the model",
            got=", ".join(map(str, rates)),
            remedy="name the column after the model's own variable for it",
        )
    found = calibration.calibrate(
        name,
        loaded.dataset,
        free=free,
        bounds=bounds,
        start=start,
        starts=starts,
        initial=initial,
        slopes=slopes,
        seed=seed,
        options=options,
        progress=progress,
    )
    if out is not None:
        _write_json(Path(out), found.to_dict())
    if ssv is not None:
        found.write_ssv(ssv)
    if model_out is not None:
        found.write_model(model_out)
    return found


def _said(model: Model) -> tuple[str, ...]:
    """Return what the fit of a model warns of."""
    from harness.models.estimate import estimate_of
    from harness.physics.definition.parameters import said_far

    notes = getattr(model, "notes", None)
    warning = notes.get("warning") if isinstance(notes, Mapping) else None
    system, found = getattr(model, "system", None), estimate_of(model)
    intervals = {} if found is None else {name: found.interval(name) or (0.0, 0.0) for name in found.names}
    far = said_far(system().parameters, getattr(model, "parameters", {}), intervals) if callable(system) else None
    return tuple(str(text) for text in (far, warning) if text)


def close_loop(
    dataset: Any,
    *,
    out: str | Path | None = None,
    model: str | None = None,
    dictionary: str = "",
    effects: Sequence[str | Effect] = (),
    resume: bool = False,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
    **records: Unpack[Records],
) -> Report:
    """Find the effect that a model lacks, add it, report the error before and after.

    Parameters
    ----------
    dataset : path, str, table or records
        ``dataset.toml``, a CSV or Parquet file, the name of a recording (``sysid list recordings``), or what
        :func:`identify` takes: a DataFrame, a mapping of arrays, a :class:`Trajectory`, a :class:`Dataset`.
    out : path, optional
        Folder for ``report.html``, ``report.json`` and ``model.json``; nothing is written without it.
    model : str, optional
        Nominal model: a built-in name, ``FILE.py:NAME``; overrides the one that the data set names.
    dictionary : str
        Which effects are given, tried and left out, such as ``"coulomb_friction(theta); *delay*?"`` or
        ``"!thermal_*"``; all are tried without it. See :class:`harness.diagnosis.wanted.Wanted`.
    effects : sequence of str or Effect
        Laws of your own beside the built-in ones, each ``FILE.py:NAME`` or made with
        :func:`harness.effects.effect.effect`.
    resume : bool
        Continue what an interrupted call left in ``out``.
    force : bool
        Overwrite a finished report in ``out``.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    **records : Records
        As for :func:`identify`.

    Returns
    -------
    harness.diagnosis.Report
        Its ``data`` is the content of ``report.json``.

    Raises
    ------
    InputError
        If the data, the model or the folder cannot be used.
    PlantError
        If an FMU ends its process, or gives no sign of life (:data:`harness.supervision.guarded.SILENCE`): it runs in
        one of its
        own, which cannot end this one.
    """
    from harness import diagnosis
    from harness.diagnosis.dictionary import with_effects_of

    laws = with_effects_of(effects)
    loaded: Any = load_dataset(dataset, model=model, **records)
    how: dict[str, Any] = {"out": out, "resume": resume, "force": force, "progress": progress}
    how |= {"dictionary": laws, "wanted": dictionary}
    if loaded.nominal is not None and names_fmu(loaded.nominal.model):
        from harness.supervision.guarded import guarded

        what = f"the FMU {Path(loaded.nominal.model).name}"
        return cast("Report", guarded(diagnosis.close_loop_file, loaded, what=what, **how))
    return diagnosis.close_loop_file(loaded, **how)  # data that are read already pass through


def equations(
    model: Any,
    *,
    form: Literal["text", "latex", "python", "c"] = "text",
    out: str | Path | None = None,
    force: bool = False,
    **options: Any,
) -> str:
    """Return the equations of a model: of motion, energies, lumped parameters and regressor, with units.

    Parameters
    ----------
    model : str, path, System, Mechanism, Ode or fitted model
        A name (``sysid list models``), a URDF or MJCF, ``FILE.py:NAME``; the ``model.json`` of ``identify``, or the
        folder of ``close_loop``: then with the effects that were found, and the values.
    form : {"text", "latex", "python", "c"}
        The last two are programs with the functions ``derivative``, ``output``, ``energy``, ``lumped``, ``regressor``
        and ``known``, as far as the model has them; ``regressor @ lumped = known``.
    out : path, optional
        File to write as well.
    force : bool
        Overwrite it.
    **options
        Of a model by name.

    Raises
    ------
    InputError
        If it is no model of equations, too large to be read in symbols (then Python and C are written), or the file
        exists.

    Examples
    --------
    >>> print(equations("pendulum").splitlines()[3])
      J*theta'' + b*theta' + mgl*sin(theta) = u
    """
    from harness.export.equations import written_model
    from harness.fitted import load_model

    _refuse_overwrite(out, force=force)
    text = written_model(load_model(model, **options) if isinstance(model, str | Path) else model).write(form)
    if out is not None:
        _write_text(Path(out), text)
    return text


def learn_residual(
    loop: str | Path,
    dataset: Any,
    *,
    out: str | Path,
    validation: str | Path | None = None,
    undriven: Sequence[str] = (),
    coordinate: str | None = None,
    arguments: Sequence[str] | None = None,
    refit: bool = False,
    seed: int = 0,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> LearnedResidual:
    """Learn what a finished closed loop left over as a force without a name; ``export`` takes the folder.

    Parameters
    ----------
    loop : path
        Folder that ``close_loop`` wrote.
    dataset, validation, undriven
        The data of that loop, as for ``close_loop``.
    out : path
        Folder for ``learned.html``, ``learned.json`` and, if the force helps, ``model.json``.
    coordinate, arguments, refit, progress
        See :func:`harness.physics.fitting.residual_learning.learn_residual_force`.
    seed : int
        Places the bumps.
    force : bool
        Overwrite an earlier result in ``out``.

    Raises
    ------
    InputError
        If the loop left nothing to learn, or its model takes no force.
    """
    from harness import learned as room
    from harness.comparison.models import read_model

    target = Path(out)
    _refuse_overwrite(target / "learned.json" if target.is_dir() else target, force=force)
    if target.is_dir() and target.resolve() == Path(loop).resolve():
        raise InputError(
            "output folder", expected="a folder of its own", got="that of the loop", remedy="choose another --out"
        )
    model: Any = read_model(loop)
    path = registry.dataset_path(dataset)
    named = None if str(path).endswith(".toml") else getattr(getattr(model, "recipe", None), "model", None)
    loaded = load_dataset(path, model=named, validation=validation, undriven=undriven)
    return room.learn_residual(
        loop,
        model,
        loaded,
        out=out,
        coordinate=coordinate,
        arguments=arguments,
        refit=refit,
        rng=stream("learn-residual", seed),
        progress=progress,
    )


def close_fleet(source: str | Path, **asked: Any) -> FleetResult:
    """Close the loop on many records, each a job; see :func:`harness.fleet.close_fleet`."""
    from harness import fleet

    return fleet.close_fleet(source, **asked)


def isolability(
    model: str,
    *,
    scenario: str,
    seed: int = 0,
    sample_time: float = 0.01,
    scenario_options: Mapping[str, Any] | None = None,
    parameters: Mapping[str, float] | None = None,
) -> Planned:
    """Say before measuring which effects a planned experiment could tell apart.

    Parameters
    ----------
    model : str
        Nominal model: a built-in name or ``FILE.py:NAME``; or the id of a plant that is made of equations.
    scenario : str
        Id of a registered scenario.
    seed : int
        Keys the random numbers of the scenario.
    sample_time : float
        Of the planned record [s].
    scenario_options, parameters : mapping, optional
        Options of the scenario; values of the model's parameters.

    Returns
    -------
    harness.diagnosis.planned.Planned
        The matrix, the pairs that look alike, and what the experiment cannot show.

    Raises
    ------
    InputError
        If there is no such model or scenario, or the model has no equations.
    """
    from harness.diagnosis.planned import isolability_of

    made = cast(Scenario, registry.create("scenarios", scenario, **dict(scenario_options or {})))
    chosen: Any = model
    if any(entry.id == model for entry in registry.entries("plants")):
        with cast(Plant, registry.create("plants", model)) as plant:
            chosen = getattr(plant, "nominal", None)
        if chosen is None:
            raise InputError(
                f"plant {model!r} has no equations",
                expected="a model (sysid list models), FILE.py:NAME, or a plant made of equations",
                got="a simulation that shows its outputs only",
                remedy="give the nominal model that you believe in",
            )
    return isolability_of(chosen, made, parameters=parameters, sample_time=sample_time, seed=seed)


def export(source: str | Path, *, out: str | Path, fmi: str = "both", force: bool = False) -> list[Path]:
    """Write a model as co-simulation FMUs, a repaired FMU as an SSP package; see :func:`harness.export.export`."""
    from harness import export as room

    if fmi not in ("2", "3", "both"):
        raise InputError("FMI version", expected="2, 3 or both", got=repr(fmi), remedy="choose one", place="--fmi")
    target = Path(out)
    second = [target.with_name(f"{target.stem}-fmi3.fmu")] if fmi == "both" and names_fmu(target) else []
    _refuse_overwrite(target, *second, force=force)
    return room.export(source, out=out, fmi=cast(Any, fmi))


def compare(
    models: Sequence[str | Path],
    dataset: Any,
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> Comparison:
    """Put stored models side by side on one data set: fit, residuals, frequency responses.

    Parameters
    ----------
    models : sequence of path
        Files that ``identify`` wrote, or folders that ``close_loop`` wrote.
    dataset : path or table
        As for ``identify``.
    model : str, optional
        As for :func:`identify`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.
    **records : Noted
        As for :func:`identify`; ``note``, a callable, gets what is odd about the records (:func:`check_data`).

    Raises
    ------
    InputError
        If a file is no model, or a model does not speak the language of the data.
    """
    from harness import comparison as room
    from harness.comparison.models import read_model

    _refuse_overwrite(out, force=force)
    found = {str(path): read_model(path) for path in models}
    spec = next(iter(found.values())).spec
    ports = (spec.inputs, spec.outputs) if _is_table(dataset) and model is None else None
    data = _noted(dataset, model=model, ports=ports, **records)
    result = room.compare(found, data)
    _write_page(out, result)
    return result


def compare_reports(first: str | Path, second: str | Path) -> ReportComparison:
    """Say what differs between two reports of the closed loop; see :func:`harness.comparison.compare_reports`."""
    from harness import comparison as room

    return room.compare_reports(first, second)


def spectrum(
    dataset: Any,
    *,
    model: str | None = None,
    segment: int | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> Spectrum:
    """Return the frequency response that the estimation records of a data set show.

    Parameters
    ----------
    dataset : path or table
        As for ``identify``.
    model : str, optional
        As for :func:`identify`.
    segment : int, optional
        Samples of a segment of Welch's method.
    out : path, optional
        Picture to write: ``.svg``, ``.png`` or ``.pdf``.
    force : bool
        Overwrite ``out`` if it exists.
    **records : Noted
        As for :func:`identify`; ``note``, a callable, gets what is odd about the records (:func:`check_data`).

    Raises
    ------
    InputError
        If the records have no input, or are too short.
    """
    from harness import comparison as room

    _refuse_overwrite(out, force=force, endings=PICTURES)
    data = _noted(dataset, model=model, **records)
    found = room.spectrum([one.measured() for one in data.estimation], segment=segment)
    _draw(found.plot, out)
    return found


def order(
    dataset: Any,
    *,
    identifiers: Sequence[str] = (),
    orders: Sequence[int] = (),
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    **records: Unpack[Noted],
) -> OrderSelection:
    """Fit models of every order, judge them on data that they did not see, and show where more is no gain.

    Parameters
    ----------
    dataset : path or table
    identifiers : sequence of str
        Ids of identifiers with the option ``order``; by default ``arx``, ``n4sid`` and ``ho-kalman``.
    orders : sequence of int
        By default 1 to 12.
    options : mapping, optional
        Further options of the identifiers.
    seed : int
        For identifiers that draw random numbers.
    model, out, force, **records
        As for :func:`spectrum`.

    Raises
    ------
    InputError
        If the data or the options cannot be used, or no model of any order is found.
    """
    from harness import comparison as room

    _refuse_overwrite(out, force=force, endings=PICTURES)
    data = _noted(dataset, model=model, **records)
    asked: dict[str, Any] = {"identifiers": identifiers} if identifiers else {}
    if orders:
        asked["orders"] = orders
    found = room.order_selection(data, options=options, seed=seed, **asked)
    _draw(found.plot, out)
    return found


def arx_orders(
    dataset: Any,
    na: Sequence[int],
    nb: Sequence[int],
    nk: Sequence[int] = (1,),
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> ArxGrid:
    """Judge the ARX models of a whole grid of orders, from one QR factorisation of the data.

    Parameters
    ----------
    dataset : path or table
    na, nb, nk : sequence of int
        Past outputs, coefficients of each input, delays that are tried, each with each.
    model, out, force, **records
        As for :func:`spectrum`.

    Returns
    -------
    ArxGrid
        ``best("bic")``, ``best("aic")`` and ``best("held-out")`` say what each prefers.

    Raises
    ------
    InputError
        If the data or the orders cannot be used.
    """
    from harness import comparison as room

    _refuse_overwrite(out, force=force, endings=PICTURES)
    data = _noted(dataset, model=model, **records)
    found = room.arx_orders(data, na, nb, nk)
    _draw(found.plot, out)
    return found


def modes(
    dataset: Any,
    *,
    identifier: str | None = None,
    orders: Sequence[int] | None = None,
    criteria: Criteria | None = None,
    window: int | None = None,
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **records: Unpack[Noted],
) -> Modes:
    """Return the modes of vibration that a data set determines; see :func:`harness.modal.identify_modes`.

    Parameters
    ----------
    dataset : path or table
        As for ``identify``; estimation and validation records are used alike, as nothing is judged. A table whose
        ``input`` is ``["none"]`` is the answer to unknown excitation.
    identifier, orders, criteria, window, options, seed, progress
        As for :func:`harness.modal.identify_modes`.
    model : str, optional
        As for :func:`identify`.
    out : path, optional
        Folder to write: the page ``modes.html``, ``modes.json``, and the pictures as SVG.
    force : bool
        Overwrite what is in ``out``.
    **records : Noted
        As for :func:`identify`; ``note``, a callable, gets what is odd about the records (:func:`check_data`).

    Raises
    ------
    InputError
        If the data or the options cannot be used.
    """
    from harness.modal import identify_modes

    folder = None if out is None else Path(out)
    if folder is not None and folder.exists() and not force:
        raise InputError(
            "the output exists", expected="a new folder", got="an existing one", remedy="--force", file=folder
        )
    data = _noted(dataset, model=model, **records)
    found = identify_modes(
        (*data.estimation, *data.validation),
        name=data.name,
        identifier=identifier,
        orders=orders,
        criteria=criteria,
        window=window,
        options=options,
        seed=seed,
        progress=progress,
    )
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        _write_json(folder / "modes.json", found.to_dict())
        _write_text(folder / "modes.html", found.html())
        for name, plot in (("stabilisation", found.plot), ("shapes", found.plot_shapes), ("motion", found.plot_motion)):
            _draw(plot, folder / f"{name}.svg")
    return found


def analyse(
    name: str,
    subject: Any,
    *,
    options: Mapping[str, Any] | None = None,
    subject_options: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    **signals: Unpack[Signals],
) -> Findings:
    """Return what an analysis finds in a process, a plant, a model's equations or records.

    Parameters
    ----------
    name : str
        Id of an analysis (``sysid list analyses``), which says what it looks at.
    subject : str, path, table or object
        A plant's id or file, a ``model.json``, a model's name or URDF, or a data set; or the thing itself.
    options : mapping, optional
        Of the analysis.
    subject_options : mapping, optional
        Of the plant or the model that is looked at.
    out : path, optional
        Picture to write, of an analysis that has one: ``.svg``, ``.png`` or ``.pdf``.
    seed : int
        For analyses that draw random numbers.
    force : bool
        Overwrite ``out`` if it exists.
    **signals : Signals
        As for :func:`identify`, where records are looked at.

    Raises
    ------
    InputError
        If there is no such analysis, or the subject is none that it can look at.

    Examples
    --------
    >>> analyse("bisimulation", "corridors-mdp", subject_options={"length": 4}).words[0]
    '9 states in 5 classes that no experiment tells apart within 1e-09'
    """
    from harness.models.analysis import Analysis

    _refuse_overwrite(out, force=force, endings=PICTURES)
    made = cast(Analysis, registry.create("analyses", name, **dict(options or {})))
    if made.takes == "data" and hasattr(made, "channels") and signals.get("output") is None:
        signals = {**signals, **_channels(made, subject)}
    seen = _subject(made.takes, subject, dict(subject_options or {}), signals)
    try:
        found = made.of(seen, rng=stream("analysis", name, seed))
    finally:
        if seen is not subject and hasattr(seen, "close"):
            seen.close()
    if out is not None:
        _draw(found.plot, out)
    return found


def _channels(part: Any, subject: Any) -> Signals:
    """Return the columns of a bare table that an analysis or an identifier names: what it needs, and what is there."""
    from harness.data.tables.table import FORMATS, open_table, suffix_of

    path = registry.dataset_path(subject)
    if not isinstance(path, str | Path) or suffix_of(Path(path)) not in FORMATS:
        return {}
    needed, useful = part.channels()
    table = open_table(Path(path), {})
    there = [table.split(title)[0] for title in table.titles]
    driven = part.inputs() if hasattr(part, "inputs") else "none"
    return {"input": driven, "output": [*needed, *(name for name in useful if name in there)]}


def _subject(takes: Takes, subject: Any, more: dict[str, Any], signals: Signals) -> Any:
    """Return the thing that an analysis looks at."""
    if takes == "data":
        return load_dataset(subject, **signals).dataset
    if takes == "records" and not _planned_for(subject):
        return _subject("data", subject, more, signals)
    if not isinstance(subject, str | Path):
        if takes == "maker" and not callable(subject):
            raise InputError(
                "subject of the analysis",
                expected="the name of a plant, or what makes one: a function of its options",
                got=type(subject).__name__,
                remedy="give a name from sysid list plants",
            )
        return getattr(subject, "model", subject) if takes == "records" else subject
    if takes == "records":
        found = load_model(subject, **more)
        return getattr(found, "model", found)
    if takes == "maker":
        return lambda **other: make_plant(str(subject), {**more, **other})
    if takes == "definition":
        return load_model(str(subject), **more)
    return load_model(subject).model if str(subject).endswith(".json") else make_plant(str(subject), more)


def _planned_for(subject: Any) -> bool:
    """Return True of a model whose records are planned: a fitted one, its file, or a physical one by its name."""
    if isinstance(subject, str | Path):
        known = {entry.id for entry in registry.entries("models")}
        return str(subject).endswith(".json") or str(subject) in known or ".py:" in str(subject)
    return (hasattr(subject, "spec") and hasattr(subject, "step")) or hasattr(subject, "parameter_names")


def check_data(
    dataset: Any,
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Records],
) -> DataCheck:
    """Say what is odd about the records of a data set; see :mod:`harness.data.oddities`.

    Every command that reads records does the same, and keeps out of its fits what is no reading.

    Parameters
    ----------
    dataset, model
        As for ``identify``. With a nominal model given by equations, these are asked about the inputs too.
    out : path, optional
        HTML page to write, the odd rows marked in pictures.
    force : bool
        Overwrite ``out`` if it exists.
    **records : Records
        As for :func:`identify`.

    Raises
    ------
    InputError
        If the data cannot be used at all.
    """
    from harness.data.oddities import DataCheck
    from harness.diagnosis.records.inputs_check import inputs_checked
    from harness.physics.arms.arm import is_arm

    _refuse_overwrite(out, force=force)
    path = registry.dataset_path(dataset)
    loaded = load_dataset(path, model=model, **records)
    data, nominal = loaded.dataset, loaded.nominal
    if nominal is not None and not names_fmu(nominal.model) and not is_arm(nominal.model):
        system = loaded.system()
        data = inputs_checked(system, loaded.for_system(system))
    found = DataCheck(data)
    _write_page(out, found)
    return found


def _is_table(dataset: Any) -> bool:
    """Return True for a table whose columns someone has to name, False where a file or a record says it itself."""
    if isinstance(dataset, str | Path):
        return Path(registry.dataset_path(dataset)).suffix != ".toml"
    return isinstance(dataset, Mapping) or hasattr(dataset, "columns") or hasattr(dataset, "data_vars")


def new(kind: str, name: str, *, folder: str | Path = ".") -> list[Path]:
    """Begin a plug-in of one's own and return the files written; see :func:`harness.scaffold.new`."""
    from harness.scaffold import new as begin

    return begin(kind, name, folder=folder)


def check(name: str) -> list[CheckResult]:
    """Hold a plug-in to its contract, in a process of its own; see :func:`harness.conformance.check`.

    Raises
    ------
    InputError
        If there is no such part, or it needs options to be made.
    HarnessError
        If the part ends its process (``crashed``) or hangs (:data:`harness.supervision.guarded.SILENCE`).
    """
    from harness.supervision.guarded import guarded

    return cast("list[CheckResult]", guarded(_checked, name, what=name))


def vet(
    path: str | Path,
    *,
    options: Mapping[str, Any] | None = None,
    limit: float = 10.0,
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Vetting:
    """Say what there is to know about an FMU before it is handed on (``sysid check X.fmu``).

    Parameters
    ----------
    path, options, limit, progress
        See :func:`harness.vetting.vet`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.

    Raises
    ------
    InputError
        If there is no such file, or an option does not fit it.
    """
    from harness import vetting

    _refuse_overwrite(out, force=force)
    found = vetting.vet(path, options=options, limit=limit, progress=progress)
    _write_page(out, found)
    return found


def agreement(
    run: str | Path, reference: str | Path, *, out: str | Path | None = None, force: bool = False, **asked: Any
) -> Agreement:
    """Compare the run of an FMU, or a table of a run, with a reference (``sysid check X.fmu --reference ref.csv``).

    Parameters
    ----------
    run, reference
        See :func:`harness.vetting.agreement`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.
    **asked
        ``tubes``, ``inputs``, ``options``, ``start``, ``stop``, ``step``, ``limit`` of
        :func:`harness.vetting.agreement`.

    Raises
    ------
    InputError
        If a file cannot be read, or a tube names no channel.
    PlantError
        If the FMU breaks at its start.
    """
    from harness import vetting

    _refuse_overwrite(out, force=force)
    found = vetting.agreement(run, reference, **asked)
    _write_page(out, found)
    return found


def _write_page(out: str | Path | None, found: Vetting | Agreement | Comparison | DataCheck) -> None:
    """Write what was found as a page of its own, if one was asked for."""
    if out is not None:
        _write_text(Path(out), found.html())


def _checked(name: str, *, progress: Callable[..., None]) -> list[CheckResult]:
    """Return the results of all checks, from the process that is theirs."""
    from harness import conformance

    return conformance.check(name)


def _noted(dataset: Any, note: Callable[[str], None] | None = None, **how: Any) -> Dataset:
    """Return the records of a data set, and tell what is odd about them."""
    from harness.data.oddities import lines

    data = load_dataset(dataset, **how).dataset
    for text in lines(data.oddities or ()) if note is not None else ():
        cast(Any, note)(text)
    return data


def _from_outside(experiment: Experiment, spec: PlantSpec) -> dict[str, FloatArray]:
    """Return by title what came from outside the loop of a run with a controller: excitation and references."""
    if experiment.controller is None:
        return {}
    added = {
        str(channel): experiment.excitation[:, k]
        for k, channel in enumerate(spec.inputs)
        if experiment.excitation[:, k].any()
    }
    return {**added, **getattr(experiment.controller, "references", {})}


def _as_is(
    plant: str,
    asked: Mapping[str, float | None],
    options: Mapping[str, Any],
    more: bool,
    progress: Callable[[int, int], None] | None,
    note: Callable[[str], None] | None,
    broke: Callable[[PlantError], None] | None,
) -> Trajectory:
    """Return the record of an FMU or a system that runs with its own experiment."""
    if not is_plant_file(plant) or more:
        refuse_no_file(plant, "the id of a plant (sysid list plants), an FMU, or a system of them")
        raise InputError(
            "no scenario",
            expected="--scenario ID (sysid list scenarios); only an FMU or a system of them runs without one, with "
            "nothing hidden in it",
            got=f"the plant {plant}",
            remedy="add --scenario, for example --scenario multisine",
        )
    chosen = dict(options)
    if names_fmu(plant):
        if "path" in chosen:
            raise InputError(
                f"options of the FMU {plant}", expected="none of the name path", got=f"path={chosen['path']!r}",
                remedy="remove it: the file is named already",
            )  # fmt: skip
        chosen = meant_options(f"the FMU {Path(plant).name}", registry.load("tools", "fmu-as-is"), chosen)
    names = {"start": "start_time", "step": "sample_time"}  # the same things, said as options
    told = {name: chosen.pop(names[name], None) if name in names else None for name in asked}
    window = {name: told[name] if value is None else value for name, value in asked.items()}
    if not names_fmu(plant):
        with _said_once(note):
            found = _system_as_is(plant, window, chosen, progress)
        return _told(found, note, broke)
    found = registry.load("tools", "fmu-as-is")(
        plant,
        start_time=window["start"],
        stop_time=window["stop"],
        sample_time=window["step"],
        tolerance=window["tolerance"] if window["tolerance"] is not None else chosen.pop("tolerance", None),
        progress=progress,
        **{"isolated": os.name == "posix", **chosen},
    )
    return _told(found, note, broke)


@contextmanager
def _said_once(note: Callable[[str], None] | None) -> Iterator[None]:
    """Keep plants from logging what ``note`` gets at the end."""
    log = logging.getLogger("plants")
    level = log.level
    if note is not None:
        log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def _told(run: FreeRun, note: Callable[[str], None] | None, broke: Callable[[PlantError], None] | None) -> Trajectory:
    """Say what a run has to say; returns its record."""
    say_beyond(run.beyond, note)
    for text in run.notes if note is not None else ():
        cast(Any, note)(text)
    if run.ended is not None and run.ended.status != "terminated" and broke is not None:
        broke(run.ended)
    return run.trajectory


def _system_as_is(
    plant: str, asked: Mapping[str, float | None], options: dict[str, Any], progress: Callable[[int, int], None] | None
) -> FreeRun:
    """Return the run of a coupling or a system of another tool with its own experiment."""
    from harness.cosim.free_run import free_run, window

    suggested: Mapping[str, float | None] = {}
    if is_system(plant):
        from harness.cosim.structure import opened

        with opened(plant, within=options.get("within")) as found:
            suggested = found.experiment
        first = asked["start"] if asked["start"] is not None else suggested["startTime"]
        options |= {"start_time": first, "solver_tolerance": asked["tolerance"]}
    elif asked["tolerance"] is not None:
        raise InputError(
            "tolerance", expected="none for a coupling in TOML", got="one", remedy="give it in the options of its FMUs"
        )
    if asked["step"] is not None:
        options["sample_time"] = asked["step"]
    with make_plant(plant, options) as made:
        step = {"stepSize": made.spec.sample_time}
        span = window(
            {**suggested, **step}, start=asked["start"], stop=asked["stop"], step=None, file=plant, who="the system"
        )
        starts = getattr(made, "input_starts", ()) or (0.0,) * made.spec.nu
        run = free_run(made, np.asarray(starts, dtype=float), span, progress)
        said = (*getattr(made, "warnings", ()), *run.notes)
    return replace(run, notes=said)


def _started(experiment: Experiment, start: Any) -> Experiment:
    """Return an experiment that leaves alone the states whose start values the plant was given by name."""
    if not isinstance(start, Mapping) or not experiment.x0:
        return experiment
    return replace(experiment, x0={name: x for name, x in experiment.x0.items() if name not in start} or None)


def _with_model(identifier: str, options: dict[str, Any], nominal: Nominal | None) -> dict[str, Any]:
    """Return the options of an identifier, with the nominal model of the data where it fits a model and names none."""
    if nominal is None or names_fmu(nominal.model):
        return options
    known = registry.named_options("identifiers", identifier)
    if "model" not in known or options.get("model") is not None:
        return options
    options["model"] = nominal.model
    if "options" in known and nominal.options:
        options.setdefault("options", dict(nominal.options))
    return options


def _make_plant(plant: str, options: dict[str, Any], hide: Sequence[tuple[str, str, Mapping[str, float]]]) -> Plant:
    """Return a plant by id or file, with effects hidden inside where it takes them, else around it."""
    wrong = [one for one in hide if isinstance(one, str) or len(one) != 3]
    if wrong:
        raise InputError(
            "what is hidden",
            expected='effects as (name, port, {parameter: value}), such as ("coulomb_friction", "theta", {"Fc": 0.05})',
            got=repr(wrong[0]),
            remedy="name the three (on the command line it is one text: --hide)",
            place="hide",
        )
    effects = [(name, port, dict(parameters)) for name, port, parameters in hide]
    if effects and not is_plant_file(plant) and registry.takes_option("plants", plant, "effects"):
        return cast(Plant, registry.create("plants", plant, effects=effects, **options))
    made = make_plant(plant, options)
    if effects:
        from harness.effects import WrappedPlant

        found = [(registry.load("effects", name), port, parameters) for name, port, parameters in effects]
        return cast(Plant, WrappedPlant(made, found))
    return made


PICTURES = (".svg", ".png", ".pdf")
"""Endings of the pictures that are drawn."""


def _refuse_overwrite(*outs: str | Path | None, force: bool, endings: Sequence[str] = ()) -> None:
    """Raise if a file that is to be written would be overwritten, its folder is missing, or it ends otherwise."""
    for path in (Path(out) for out in outs if out is not None):
        if path.exists() and not force:
            raise InputError(
                "the output exists", expected="a new file", got="an existing one", remedy="--force", file=path
            )
        if not path.parent.is_dir():
            raise InputError(
                "the output's folder is missing",
                expected="an existing folder",
                got="none",
                remedy=f"make {path.parent} first",
                file=path,
            )
        if endings and path.suffix not in endings:
            ends = f"a name that ends in {', '.join(endings[:-1])} or {endings[-1]}"
            raise InputError("output file", expected=ends, got=str(path), remedy="rename it")


def _draw(plot: Callable[[], Any], out: str | Path | None) -> None:
    """Write a picture if one was asked for."""
    from harness.data.whole_files import whole_file
    from harness.plots import plain_texts

    if out is not None:
        with whole_file(out) as scratch:
            plain_texts(plot()).savefig(scratch, format=Path(out).suffix[1:])


def _write_record(record: Trajectory, out: str | Path | None, **more: Any) -> None:
    """Write a record if a file was asked for."""
    if out is not None:
        from harness.data import write_trajectory

        write_trajectory(record, out, **more)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON so that a half-written file is never left behind."""
    import json

    _write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _write_text(path: Path, text: str) -> None:
    """Write a text so that a half-written file is never left behind."""
    from harness.data.whole_files import whole_file

    with whole_file(path) as scratch:
        scratch.write_text(text, encoding="utf-8")
