"""An FMU, a coupling or a system of another tool, run without a scenario, with its own experiment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harness import registry
from harness.errors import InputError, PlantError, refuse_no_file
from harness.options import meant_options, say_beyond
from harness.parts.files import is_plant_file, is_system, make_plant
from harness.signals import Trajectory
from harness.supervision.processes import APART
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.cosim.free_run import CoupledRun


def run_as_is(
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
        **{"isolated": APART, **chosen},
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


def _told(
    run: CoupledRun, note: Callable[[str], None] | None, broke: Callable[[PlantError], None] | None
) -> Trajectory:
    """Say what a run has to say; returns its record."""
    say_beyond(run.beyond, note)
    for text in run.notes if note is not None else ():
        cast(Any, note)(text)
    if run.ended is not None and run.ended.status != "terminated" and broke is not None:
        broke(run.ended)
    return run.trajectory


def _system_as_is(
    plant: str, asked: Mapping[str, float | None], options: dict[str, Any], progress: Callable[[int, int], None] | None
) -> CoupledRun:
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
