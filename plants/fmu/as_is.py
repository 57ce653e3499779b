"""An FMU run as it is: its own experiment, start values and tolerance, and whatever it shows.

What a person does first with a file from a vendor: nothing is excited, inputs keep their start values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.cosim.free_run import CoupledRun, free_run, hold, window
from harness.errors import InputError, PlantError
from harness.options import meant_options
from harness.signals import FloatArray
from plants.fmu.archive import FmuFile, read_fmu
from plants.fmu.options import chosen_kind, default
from plants.fmu.plant import FmuPlant
from plants.fmu.variables import INTEGERS, REALS, states_of
from plants.isolation.isolated import IsolatedPlant

DOMINATES = 1e-3  # Share of an output's spread beyond which the error of the suggested tolerance is said.


def run_as_is(
    path: str | Path,
    *,
    start_time: float | None = None,
    stop_time: float | None = None,
    sample_time: float | None = None,
    tolerance: float | None = None,
    isolated: bool = True,
    timeout: float = 10.0,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> CoupledRun:
    """Run an FMU with its default experiment.

    Parameters
    ----------
    path : path
        The ``.fmu`` file.
    start_time, stop_time, sample_time : float, optional
        [s]; by default those of the FMU's default experiment; where it has none 0, one second after the start, and a
        500th of the run.
    tolerance : float, optional
        Relative tolerance of the solver; by default the FMU's.
    isolated : bool
        Run it in a process of its own.
    timeout : float
        Longest time [s] for one call, if isolated.
    progress : callable, optional
        Called as ``progress(samples_done, samples)``.
    **options
        More options of :class:`plants.fmu.plant.FmuPlant`; ``outputs`` where not all declared outputs (without any: the
        states and local variables) are wanted.

    Raises
    ------
    InputError
        If the file is no FMU, or an option does not fit it.
    PlantError
        If it cannot even be started.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> found = run_as_is(mockup("pendulum"), stop_time=0.1, sample_time=0.05, isolated=False)
    >>> found.trajectory.t.tolist(), found.trajectory.y.tolist(), found.ended
    ([0.0, 0.05, 0.1], [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], None)
    """
    options = meant_options(f"the FMU {Path(path).name}", FmuPlant, options)
    file = read_fmu(path)
    suggested = {name: default(file, name) for name in ("startTime", "stopTime", "stepSize")}
    inner = getattr(file.interface(chosen_kind(file, options.get("kind"))), "fixedInternalStepSize", None)
    suggested["fixedInternalStepSize"] = None if inner is None else float(inner)
    span = window(suggested, start=start_time, stop=stop_time, step=sample_time, file=path, who="the FMU")
    wanted = tolerance if tolerance is not None else default(file, "tolerance")
    chosen = {"start_time": span.first, "sample_time": span.step, "tolerance": wanted, **options}
    notes = [*file.renamed, *_left_out(file)]
    own = False
    if "outputs" not in chosen:
        chosen["outputs"], said = _shown(file)
        notes, own = notes + said, bool(said)
    asked = {"path": str(path), **chosen}

    def made(**more: Any) -> FmuPlant | IsolatedPlant:
        if isolated:
            return IsolatedPlant("plants.fmu.plant:FmuPlant", {**asked, **more}, timeout=timeout)
        return FmuPlant(**{**asked, **more})

    with made() as plant:
        starts = np.array(plant.input_starts)
        found = free_run(plant, starts, span, progress)
        notes += [*plant.warnings]
    notes += found.notes
    if found.ended is None and tolerance is None and wanted is not None:
        columns = {channel.name: k for k, channel in enumerate(found.trajectory.spec.outputs)}
        states = [one.variable.name for one in states_of(file) if one.variable.name in columns]
        if own and states:  # what tools add for themselves is no result
            columns = {name: columns[name] for name in states}
        said, moved = _dominated(made, starts, found.trajectory.y, columns, wanted)
        notes, found = notes + said, replace(found, moved=moved)
    return replace(found, notes=tuple(notes))


def _shown(file: FmuFile) -> tuple[list[str], list[str]]:
    """Return the variables to record: the outputs, or without any the states and locals."""
    able = [v for v in file.description.modelVariables if v.type in REALS | INTEGERS | {"Boolean"}]
    outputs = [v.name for v in able if v.causality == "output" and v.alias is None]
    if outputs:
        return outputs, []
    states = [one.variable.name for one in states_of(file)]
    locals_ = [v.name for v in able if v.causality in ("local", "calculatedParameter", "internal") and v.alias is None]
    names = list(dict.fromkeys([*states, *(n for n in locals_ if not _fixed(file, n))]))
    if not names:
        raise InputError(
            "an FMU that shows nothing",
            expected="outputs, states or local variables",
            got="none",
            remedy="name variables: --option 'outputs=[\"x\"]' (sysid list FILE.fmu)",
            file=file.path,
        )
    return names, [f"the FMU declares no outputs: its {len(names)} states and local variables are recorded"]


def _left_out(file: FmuFile) -> list[str]:
    """Say which inputs and outputs no record can hold."""
    names = [
        v.name
        for v in file.description.modelVariables
        if v.causality in ("input", "output") and v.type in ("String", "Binary")
    ]
    if not names:
        return []
    listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return [f"texts and bytes are not recorded: {listed} (inputs keep their start values; -O start.NAME=TEXT)"]


def _fixed(file: FmuFile, name: str) -> bool:
    """Return True for a variable that cannot change."""
    return file.variables[name].variability in ("constant", "fixed", "parameter")


def _dominated(
    made: Callable[..., FmuPlant | IsolatedPlant],
    u: FloatArray,
    rows: FloatArray,
    columns: dict[str, int],
    tolerance: float,
) -> tuple[list[str], float]:
    """Say where the FMU's own tolerance makes an error that can be seen, and its share of an output's range."""
    try:
        with made(tolerance=0.01 * tolerance) as plant:
            finer, _ = hold(plant, u, len(rows))
    except PlantError:
        return [], 0.0
    if finer.shape != rows.shape:
        said = f"with a tolerance 100 times smaller than the FMU's {tolerance:g} the run ends elsewhere (--tolerance)"
        return [said], float("inf")
    places = list(columns.values())
    spread = np.ptp(rows[:, places], axis=0)
    change = np.abs(finer - rows)[:, places].max(axis=0)
    shares = np.where(spread > 0, change / np.maximum(spread, 1e-300), 0.0)
    if shares.max(initial=0.0) < DOMINATES:
        return [], float(shares.max(initial=0.0))
    worst = int(shares.argmax())
    return [
        f"the FMU's own tolerance {tolerance:g} moves {list(columns)[worst]} by {100 * shares[worst]:.3g} % of its "
        "range: give a smaller one (--tolerance)"
    ], float(shares[worst])
