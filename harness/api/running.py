"""A scenario on a plant, or a file that runs as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from harness import registry
from harness.api.written import PICTURES, draw, refuse_overwrite, write_record
from harness.errors import InputError, PlantError
from harness.options import as_options, say_beyond
from harness.parts.as_is import run_as_is
from harness.parts.files import is_plant_file, make_hiding, stream_key
from harness.protocols import Experiment, Scenario
from harness.rng import Streams
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.cosim.convergence import Convergence


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
    """Run a scenario on a plant and record it; without a scenario, an FMU or a system runs its own experiment.

    Parameters
    ----------
    plant : str
        Id of a registered plant, or a path: an FMU, a coupling in TOML, an SSP package (also unpacked), an OSP system
        structure.
    scenario : str, optional
        Id of a registered scenario. What is a file runs without one too: with its default experiment, its start
        values, and all its outputs.
    seed : int
        Together with the two ids and the role it seed of every random number.
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
    refuse_overwrite(out, force=force, endings=(".csv", ".parquet"))
    options = as_options(options)
    if exchange is not None:
        if names_fmu(plant) or not is_plant_file(plant):
            raise InputError(
                "exchange", expected="a coupling or a system of FMUs", got=plant, remedy="leave --exchange out"
            )
        options["order"] = exchange
    if not is_plant_file(plant):
        registry.entry("plants", plant)  # a wrong name is said before a scenario is asked for
    if scenario is None:
        asked = {"start": start, "stop": stop, "step": step, "tolerance": tolerance}
        trajectory = run_as_is(plant, asked, options, bool(hide or scenario_options), progress, note, broke)
        write_record(trajectory, out)
        return trajectory
    if any(value is not None for value in (start, stop, step, tolerance)):
        raise InputError(
            "start, stop, step and tolerance",
            expected="none of them with a scenario, which says how long the run is",
            got=f"the scenario {scenario}",
            remedy="give --scenario-option duration=... and --option sample_time=..., tolerance=..., start_time=...",
        )
    made_scenario = cast(Scenario, registry.create("scenarios", scenario, **as_options(scenario_options)))
    with make_hiding(plant, options, hide) as made:
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
    write_record(trajectory, out, references=_from_outside(experiment, made.spec))
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
    """Run an FMU, a coupling or a system at a step, its half, and so on: what changes, and at which order.

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

    refuse_overwrite(out, force=force)
    refuse_overwrite(picture, force=force, endings=PICTURES)
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
    write_record(found.finest, out)
    draw(found.figure, picture)
    return found


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


def _started(experiment: Experiment, start: Any) -> Experiment:
    """Return an experiment that leaves alone the states whose start values the plant was given by name."""
    if not isinstance(start, Mapping) or not experiment.x0:
        return experiment
    return replace(experiment, x0={name: x for name, x in experiment.x0.items() if name not in start} or None)
