"""An FMU run as it is: its own experiment, start values and tolerance, and whatever it shows.

What a person does first with a file from a vendor: nothing is excited, inputs keep their start values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import InputError, PlantError
from harness.signals import FloatArray, Trajectory
from plants.fmu import FmuPlant
from plants.fmu_archive import FmuFile, read_fmu
from plants.fmu_options import default
from plants.fmu_variables import INTEGERS, REALS, states_of
from plants.isolated import IsolatedPlant

__all__ = ["AsIs", "run_as_is"]

SAMPLES = 500
"""Samples of a run whose FMU suggests no step."""
LENGTH = 1.0
"""Seconds of a run whose FMU suggests no end."""
MOST = 5_000_000
"""Samples beyond which a run must be asked for with a step of its own."""
DOMINATES = 1e-3
"""Share of an output's spread beyond which the error of the suggested tolerance is said."""


@dataclass(frozen=True)
class AsIs:
    """What a run brought.

    Parameters
    ----------
    trajectory : Trajectory
        Up to the end, or up to where the FMU ended it; its time counts from 0.
    start : float
        Time [s] of the first sample as the FMU sees it.
    notes : tuple of str
        What was taken where the FMU suggests nothing, and what is odd.
    ended : PlantError or None
        Why the run is shorter than asked for.
    """

    trajectory: Trajectory
    start: float
    notes: tuple[str, ...]
    ended: PlantError | None


def run_as_is(
    path: str | Path,
    *,
    start: float | None = None,
    stop: float | None = None,
    step: float | None = None,
    tolerance: float | None = None,
    isolated: bool = True,
    timeout: float = 10.0,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> AsIs:
    """Run an FMU with its default experiment.

    Parameters
    ----------
    path : path
        The ``.fmu`` file.
    start, stop, step : float, optional
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
        More options of :class:`plants.fmu.FmuPlant`; ``outputs`` where not all declared outputs (without any: the
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
    >>> found = run_as_is(mockup("pendulum"), stop=0.1, step=0.05, isolated=False)
    >>> found.trajectory.y.tolist(), found.ended
    ([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]], None)
    """
    file = read_fmu(path)
    notes: list[str] = []
    first = _first(start, default(file, "startTime"), 0.0)
    end = _first(stop, default(file, "stopTime"))
    if end is None:
        end = first + LENGTH
        notes.append(f"the FMU suggests no end: {LENGTH:g} s are run (--stop)")
    if not end > first:
        raise InputError(
            "the end of the run",
            expected=f"after the start, {first:g} s",
            got=f"{end:g} s",
            remedy="give --stop",
            file=path,
        )
    dt = _first(step, options.pop("sample_time", None), default(file, "stepSize"))
    if dt is None or not dt > 0:
        dt = float(f"{(end - first) / SAMPLES:.6g}")
        notes.append(f"the FMU suggests no step: {dt:g} s, a {SAMPLES}th of the run (--step)")
    count = int(np.floor((end - first) / dt + 1e-9)) + 1
    if not 2 <= count <= MOST:
        raise InputError(
            "the step",
            expected=f"2 to {MOST} samples between {first:g} and {end:g} s",
            got=f"{dt:g} s, which makes {count}",
            remedy="give --step",
            file=path,
        )
    wanted = _first(tolerance, default(file, "tolerance"))
    chosen = {"start_time": first, "sample_time": float(dt), "tolerance": wanted, **options}
    if "outputs" not in chosen:
        chosen["outputs"], note = _shown(file)
        notes += note
    asked = {"path": str(path), **chosen}

    def made(**more: Any) -> FmuPlant | IsolatedPlant:
        if isolated:
            return IsolatedPlant("plants.fmu:FmuPlant", {**asked, **more}, timeout=timeout)
        return FmuPlant(**{**asked, **more})

    starts = _input_starts(file, chosen)
    with made() as plant:
        rows, ended = _rows(plant, starts, count, progress)
        spec, said = plant.spec, plant.warnings
    notes += said
    if ended is not None:
        at = first + (len(rows) - 1) * dt
        notes.append(f"the run ends at t = {at:g} s of {end:g} s ({len(rows)} of {count} samples are kept): {ended}")
    elif tolerance is None and wanted is not None:
        notes += _dominated(made, starts, rows, wanted)
    time: FloatArray = np.arange(len(rows), dtype=np.float64) * spec.sample_time
    inputs: FloatArray = np.tile(starts, (len(rows), 1))
    return AsIs(Trajectory(time, inputs, rows, spec), first, tuple(notes), ended)


def _first(*values: float | None) -> Any:
    """Return the first value that is given."""
    return next((value for value in values if value is not None), None)


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


def _fixed(file: FmuFile, name: str) -> bool:
    """Return True for a variable that cannot change."""
    variable = next(v for v in file.description.modelVariables if v.name == name)
    return variable.variability in ("constant", "fixed", "parameter")


def _input_starts(file: FmuFile, chosen: dict[str, Any]) -> FloatArray:
    """Return the start values of the inputs (nu,), in SI, those that the caller gives included."""
    from plants.fmu_variables import choose, starts

    ports = choose(file, chosen.get("inputs"), "input")
    values = np.array(starts(ports))
    names = [channel.name for one in ports for channel in one.channels]
    for name, value in dict(chosen.get("start") or {}).items():
        if name in names:
            values[names.index(name)] = float(value)
    return values


def _rows(
    plant: FmuPlant | IsolatedPlant, u: FloatArray, count: int, progress: Callable[[int, int], None] | None
) -> tuple[FloatArray, PlantError | None]:
    """Return the outputs (n, ny) from reset on, and what ended them early."""
    through = "feedthrough" in plant.abilities
    rows = [plant.reset(rng=np.random.default_rng(0))]  # an FMU draws nothing
    if not through:
        try:
            rest = plant.rollout(np.tile(u, (count - 1, 1)))
            return np.vstack([rows[0], rest]), None
        except PlantError:  # once more, step by step, to keep what comes before the end
            rows = [plant.reset(rng=np.random.default_rng(0))]
    try:
        if through:
            rows[0] = plant.output(u)
        for k in range(1, count):
            rows.append(plant.step(u))
            if progress is not None and k % 256 == 0:
                progress(k, count)
    except PlantError as error:
        return np.array(rows, dtype=np.float64), error
    return np.array(rows, dtype=np.float64), None


def _dominated(
    made: Callable[..., FmuPlant | IsolatedPlant], u: FloatArray, rows: FloatArray, tolerance: float
) -> list[str]:
    """Say where the FMU's own tolerance makes an error that can be seen."""
    try:
        with made(tolerance=0.01 * tolerance) as plant:
            finer, _ = _rows(plant, u, len(rows), None)
    except PlantError:
        return []
    if finer.shape != rows.shape:
        return [f"with a tolerance 100 times smaller than the FMU's {tolerance:g} the run ends elsewhere (--tolerance)"]
    spread = np.ptp(rows, axis=0)
    change = np.abs(finer - rows).max(axis=0)
    worst = float((change / np.maximum(spread, 1e-300))[spread > 0].max(initial=0.0))
    if worst < DOMINATES:
        return []
    return [
        f"the FMU's own tolerance {tolerance:g} moves an output by {100 * worst:.2g} % of its range: give a smaller "
        "one (--tolerance)"
    ]
