"""Reading an FMU for the loop: its parameters, settable states, and the positions that force inputs move."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.blackbox.system import FmuCoordinate, FmuSystem
from harness.errors import HarnessError, InputError
from harness.physics.definition.parameters import Parameter
from harness.signals import Channel, FloatArray, PlantSpec

FORCES: dict[str, tuple[set[str], ...]] = {"rad": ({"N", "m"}, {"Nm"}), "m": ({"N"},)}
"""Units (as sets of their symbols) of the force on a coordinate of a unit."""
POSITIONS, ALIKE = 40, 0.05
"""Variables that are looked through for a position, and how far (of its motion) it may be off the integral of a speed:
the trapezoidal rule errs by less over samples that follow the motion."""
LOOK, NUDGE = 20, 0.01
"""Samples after which the start of a state has moved an output, and by how much it is moved [SI unit]."""


def fmu_system(path: str | Path, spec: PlantSpec, parameters: Mapping[str, Any] | None = None) -> FmuSystem:
    """Return an FMU as a nominal model for data of these channels.

    Its tunable parameters are calibrated: all whose start value is not 0 (a 0 switches something off), or, where
    ``parameters`` names any, those, be they tunable or fixed from the initialisation on. Bounds are the FMU's; a
    positive start value without bounds stays positive. Raises InputError if the file is no FMU, a name is no real
    parameter, or outputs depend directly on inputs.

    - ``path``: the FMU
    - ``spec``: channels and sample time of the data; names are the FMU's variables
    - ``parameters``: parameters to calibrate: a start value, or a :class:`harness.physics.Parameter` (bounds, fixed).
      Fixed ones are set and not calibrated.

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01)
    >>> system = fmu_system(mockup("pendulum"), spec)
    >>> [one.name for one in system.parameters if not one.fixed], system.coordinates[0].rate
    (['J', 'b', 'mgl', 'vs'], 'omega')
    """
    from harness import registry

    file = Path(path)
    if not file.is_file():
        raise InputError("no such FMU", expected="an FMU file", got="no file", remedy="check the path", file=path)
    names = [channel.name for channel in spec.inputs], [channel.name for channel in spec.outputs]
    options = {"path": file, "sample_time": spec.sample_time, "inputs": names[0], "outputs": names[1]}
    with registry.create("plants", "fmu", **options) as plant:
        if plant.spec.feedthrough:
            raise InputError(
                "an FMU as nominal model",
                expected="outputs that do not depend on the input of the same instant",
                got="direct feedthrough",
                remedy="measure other outputs",
                file=path,
            )
        described = plant.describe(file)
        units, notes = _units_of_data(described, spec)
        found = _tunable(described, dict(parameters or {}), file)
        shown: dict[str, str] = {}
        states = _settable(plant, described)
        guessed = [] if plant.spec.states else _exact(described)
        if plant.spec.states and states:  # named states are kept, whether they move an output or not
            shown = {output: state for output, state in _moving(plant, states)[1].items() if output != state}
        inputs = tuple(replace(one, unit=units.get(one.name, one.unit)) for one in plant.spec.inputs)
        outputs = tuple(
            replace(theirs, unit=units.get(theirs.name, theirs.unit), period=theirs.period or ours.period)
            for ours, theirs in zip(spec.outputs, plant.spec.outputs, strict=True)
        )
    if guessed:
        with registry.create("plants", "fmu", **options, states=guessed) as plant:
            states, shown = _moving(plant, _settable(plant, described))
    coordinates = _coordinates(described, inputs, outputs)
    driven = {coordinate.force for coordinate in coordinates}
    if looked := _unseen_positions(described, inputs, outputs, driven):
        asked = [*looked, *dict.fromkeys(name for positions in looked.values() for name in positions)]
        with registry.create("plants", "fmu", **options | {"outputs": asked}) as plant:
            coordinates += _integrals(plant, inputs, outputs, looked, driven)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    return FmuSystem(
        path=file,
        name=str(described["model"]),
        digest=digest,
        inputs=inputs,
        outputs=outputs,
        inner_states=states,
        parameters=found,
        coordinates=tuple(
            replace(coordinate, position=shown.get(coordinate.position, coordinate.position))
            for coordinate in coordinates
        ),
        shown=shown,
        notes=notes,
    )


def _units_of_data(described: dict[str, Any], spec: PlantSpec) -> tuple[dict[str, str], tuple[str, ...]]:
    """Give what the FMU declares no unit for that of the data, also in its description; return units and notes."""
    wanted = {one.name: one.unit for one in (*spec.inputs, *spec.outputs) if one.unit != "1"}
    rows = {row["name"]: row for row in described["variables"] if row["name"] in wanted and row["unit"] is None}
    for name, row in rows.items():
        row["si_unit"] = wanted[name]
    units = {name: wanted[name] for name in rows}
    told = ", ".join(f"{name} [{unit}]" for name, unit in units.items())
    return units, (f"the FMU declares no units of {told}: its numbers are taken as the data's",) if units else ()


def _tunable(described: Mapping[str, Any], given: dict[str, Any], path: Path) -> tuple[Parameter, ...]:
    """Return the tunable real parameters: fixed, unless they are named or nothing is named and they are not 0.

    What the FMU calls fixed holds from the initialisation on, which every run begins with: it counts where it is named.
    """
    rows = {
        variable["name"]: variable
        for variable in described["variables"]
        if variable["causality"] == "parameter"
        and (variable["variability"] == "tunable" or (variable["variability"] == "fixed" and variable["name"] in given))
        and variable["start"] is not None
        and not variable["shape"]
        and variable["type"] in ("Real", "Float64", "Float32")
    }
    for name in given:
        if name not in rows:
            raise InputError(
                "parameter to calibrate",
                expected=f"a real parameter of the FMU (tunable are {', '.join(rows) or 'none'})",
                got=repr(name),
                remedy="correct the name",
                file=path,
            )
    asked = any(not _given(value).get("fixed") for value in given.values())
    found = []
    for name, row in rows.items():
        said = _given(given[name]) if name in given else {}
        value = float(row["start"]) if said.get("value") is None else float(said["value"])
        fixed = bool(said.get("fixed")) if name in given else asked or value == 0.0
        low, high = _bounds(row, said, value)
        if fixed:  # a bound at 0 would have the fit take its logarithm
            low, high = -np.inf, np.inf
        try:
            found.append(Parameter(name, row["si_unit"] or "1", value, low, high, fixed=fixed))
        except InputError as error:
            raise error.located(file=path) from error
    for parameter in found:
        if not parameter.fixed and parameter.value == 0.0 and parameter.minimum == 0.0:
            raise InputError(
                f"start value of {parameter.name}",
                expected="a positive number (the parameter cannot be negative, so the fit works on its logarithm)",
                got="0",
                remedy="give a start value, or keep the parameter fixed",
                file=path,
            )
    return tuple(found)


def _bounds(row: Mapping[str, Any], said: Mapping[str, Any], value: float) -> tuple[float, float]:
    """Return the bounds of a parameter if it is free: the FMU's and those given; one that starts positive stays so."""
    lows = [float(one["minimum"]) for one in (row, said) if one.get("minimum") is not None]
    highs = [float(one["maximum"]) for one in (row, said) if one.get("maximum") is not None]
    low, high = max([-np.inf, *lows]), min([np.inf, *highs])
    return (0.0 if value > 0.0 and np.isinf(low) else low), high


def _given(entry: Any) -> dict[str, Any]:
    """Return what is said of a parameter: a number, a Parameter, or a mapping of its fields."""
    if isinstance(entry, Mapping):
        return dict(entry)
    if isinstance(entry, Parameter):
        return {"value": entry.value, "minimum": entry.minimum, "maximum": entry.maximum, "fixed": entry.fixed}
    return {"value": float(entry)}


def _settable(plant: Any, described: Mapping[str, Any]) -> tuple[Channel, ...]:
    """Return the states whose start values the FMU lets us set, one by one."""
    rng = np.random.default_rng(0)
    kept: list[Channel] = []
    known = {variable["name"]: variable for variable in described["variables"]}
    for channel in plant.spec.states or plant.spec.outputs:
        try:
            plant.reset(rng=rng, x0={channel.name: float(known[channel.name]["start"] or 0.0)})
        except (HarnessError, KeyError, ValueError):
            continue
        kept.append(channel)
    plant.reset(rng=rng)
    return tuple(kept)


def _exact(described: Mapping[str, Any]) -> list[str]:
    """Return what may be a state where the description names none: continuous variables that begin where they say."""
    return [
        variable["name"]
        for variable in described["variables"]
        if variable["causality"] in ("local", "output")
        and variable["variability"] == "continuous"
        and variable["initial"] == "exact"
        and not variable["shape"]
        and variable["type"] in ("Real", "Float64", "Float32")
    ]


def _moving(plant: Any, states: Sequence[Channel]) -> tuple[tuple[Channel, ...], dict[str, str]]:
    """Return the states whose start moves an output, and by output the state that it shows as it is."""
    rng = np.random.default_rng(0)
    quiet = np.zeros((LOOK, plant.spec.nu))

    def run(x0: Mapping[str, float]) -> FloatArray:
        first = plant.reset(rng=rng, x0=x0)
        return np.vstack([first, plant.rollout(quiet)])

    plant.reset(rng=rng)
    begun = dict(zip([state.name for state in plant.spec.states], plant.truth().tolist(), strict=True))
    kept: list[Channel] = []
    shown: dict[str, str] = {}
    try:
        unmoved = run({})
    except HarnessError:  # it cannot be looked at without input
        return (), {}
    for state in states:
        try:
            moved = run({state.name: begun[state.name] + NUDGE}) - unmoved
        except HarnessError:
            continue
        if not np.abs(moved).max(initial=0.0) > 1e-6 * NUDGE:
            continue
        kept.append(state)
        for output, change in zip(plant.spec.outputs, moved[0], strict=True):
            if abs(change - NUDGE) < 1e-6 * NUDGE and output.unit == state.unit:
                shown[output.name] = state.name
    return tuple(kept), shown


def _coordinates(
    described: Mapping[str, Any], inputs: Sequence[Channel], outputs: Sequence[Channel]
) -> tuple[FmuCoordinate, ...]:
    """Return the positions that force inputs move: by unit, in the order of the inputs, where they pair up."""
    rows = [variable for variable in described["variables"] if variable["type"] in ("Real", "Float64", "Float32")]
    measured = [channel.name for channel in outputs]
    found: list[FmuCoordinate] = []
    for unit, forces in FORCES.items():
        drives = [row for row, channel in enumerate(inputs) if _symbols(channel.unit) in forces]
        moved = [channel.name for channel in outputs if channel.unit == unit]
        if len(moved) != len(drives):
            moved = [
                variable["name"]
                for variable in rows
                if variable["causality"] == "output" and variable["si_unit"] == unit
            ]
            moved.sort(key=lambda name: name not in measured)
        if not drives or len(moved) != len(drives):
            continue
        for row, position in zip(drives, moved, strict=True):
            rate = _rate(rows, position, unit, alone=len(moved) == 1)
            found.append(FmuCoordinate(position, unit, inputs[row].unit, position, rate, row))
    return tuple(found)


def _unseen_positions(
    described: Mapping[str, Any], inputs: Sequence[Channel], outputs: Sequence[Channel], driven: set[int]
) -> dict[str, list[str]]:
    """Return, for speeds that are measured where no position is an output, the variables that may be their positions.

    As many speeds as there are force inputs that move nothing yet; states first, as the description marks them.
    """
    found: dict[str, list[str]] = {}
    for unit, forces in FORCES.items():
        drives = [row for row, channel in enumerate(inputs) if row not in driven and _symbols(channel.unit) in forces]
        speeds = [channel.name for channel in outputs if channel.unit == f"{unit}/s"]
        if not drives or len(speeds) != len(drives):
            continue
        rows = [variable for variable in described["variables"]
                if variable["type"] in ("Real", "Float64", "Float32") and not variable["shape"]
                and (variable["si_unit"] == unit or variable["unit"] is None)
                and variable["causality"] in ("local", "output")
                and variable["variability"] == "continuous"]  # fmt: skip
        states = {variable["derivative_of"] for variable in described["variables"]}
        rows.sort(key=lambda variable: variable["name"] not in states)
        if rows:
            found |= {speed: [str(variable["name"]) for variable in rows[:POSITIONS]] for speed in speeds}
    return found


def _integrals(
    plant: Any,
    inputs: Sequence[Channel],
    outputs: Sequence[Channel],
    looked: Mapping[str, Sequence[str]],
    driven: set[int],
) -> tuple[FmuCoordinate, ...]:
    """Return coordinates whose position moves as the integral of a measured speed while the inputs push."""
    names = [channel.name for channel in plant.spec.outputs]
    units = {channel.name: channel.unit for channel in outputs}
    free = [row for row in range(len(inputs)) if row not in driven]
    try:
        first = plant.reset(rng=np.random.default_rng(0), x0={})
        y = np.vstack([first, plant.rollout(np.ones((LOOK, plant.spec.nu)))])
    except HarnessError:  # it cannot be looked at
        return ()
    found = []
    for speed, positions in looked.items():
        unit = units[speed].removesuffix("/s")
        row = next((k for k in free if _symbols(inputs[k].unit) in FORCES[unit]), None)
        v = y[:, names.index(speed)]
        gone = plant.spec.sample_time * np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]))])
        for name in positions if row is not None else ():
            moved = y[:, names.index(name)] - y[0, names.index(name)]
            size = float(np.abs(moved).max())
            if size > 0.0 and np.abs(moved - gone).max() <= ALIKE * size:
                assert row is not None
                found.append(FmuCoordinate(name, unit, inputs[row].unit, name, speed, row))
                free.remove(row)
                break
    return tuple(found)


def _symbols(unit: str) -> set[str]:
    """Return the symbols of a product of units."""
    return set(unit.replace("*", " ").split())


def _rate(rows: Sequence[Mapping[str, Any]], position: str, unit: str, *, alone: bool) -> str | None:
    """Return the variable that is the rate of a position: the only one of its unit, or the declared derivative."""
    rates = [
        variable
        for variable in rows
        if (variable["si_unit"] == f"{unit}/s" or (variable["unit"] is None and variable["derivative_of"] == position))
        and variable["causality"] in ("output", "local")
    ]
    declared = [str(variable["name"]) for variable in rates if variable["derivative_of"] == position]
    states = [str(variable["name"]) for variable in rates if variable["derivative_of"] is None]
    if alone and len(states) == 1:
        return states[0]
    return declared[0] if declared else None
