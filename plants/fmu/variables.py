"""Variables of an FMU: chosen by name, turned into channels, grouped by type for fast access, shown as a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, did_you_mean
from harness.signals import Channel, FloatArray
from plants.fmu.archive import FmuFile, Kind, read_fmu
from plants.fmu.units import si_conversion

REALS = frozenset({"Real", "Float64", "Float32"})
INTEGERS = frozenset(
    {"Integer", "Enumeration", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64"}
)


@dataclass(frozen=True, eq=False)
class FmuPort:
    """One variable of an FMU with its channels (several for an array) and its way to SI."""

    variable: Any
    channels: tuple[Channel, ...]
    scale: float
    offset: float
    complaint: str | None

    @property
    def size(self) -> int:
        """Number of scalars."""
        return len(self.channels)


def port(file: FmuFile, variable: Any) -> FmuPort:
    """Return a variable as channels in SI.

    Raises
    ------
    InputError
        If it is a string, binary or clock, which no channel can carry.
    """
    if variable.type not in REALS | INTEGERS and variable.type != "Boolean":
        raise InputError(
            f"variable {variable.name!r} cannot be a signal",
            expected="a real, integer, boolean or enumeration",
            got=str(variable.type),
            remedy="leave it out of inputs and outputs; strings can be set as parameters",
            file=file.path,
        )
    shape = tuple(int(n) for n in variable.shape or ())
    names = [variable.name]
    if shape:
        names = [f"{variable.name}[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(*shape)]
    if variable.type == "Boolean":
        return FmuPort(variable, tuple(Channel(n, "1", 0.0, 1.0, "boolean") for n in names), 1.0, 0.0, None)
    declared = variable.declaredType
    if variable.type == "Enumeration":
        values = [int(item.value) for item in declared.items] if declared is not None else []
        if values and min(values) >= 0:
            kind: Literal["category", "integer"] = "category"
            low, high = float(min(values)), float(max(values))
        else:
            kind, low, high = "integer", -np.inf, np.inf
        return FmuPort(variable, tuple(Channel(n, "1", low, high, kind) for n in names), 1.0, 0.0, None)
    low, high = (_limit(variable, declared, side) for side in ("min", "max"))
    if variable.type in INTEGERS:
        return FmuPort(variable, tuple(Channel(n, "1", low, high, "integer") for n in names), 1.0, 0.0, None)
    unit = variable.unit or (declared.unit if declared is not None else None)
    definition = next((u for u in file.description.unitDefinitions if u.name == unit), None)
    found = si_conversion(unit, definition)
    low, high = found.scale * low + found.offset, found.scale * high + found.offset
    made = tuple(Channel(n, found.unit, min(low, high), max(low, high)) for n in names)
    complaint = None if found.complaint is None else f"{variable.name}: {found.complaint}"
    return FmuPort(variable, made, found.scale, found.offset, complaint)


def resize(file: FmuFile, parameters: object) -> None:
    """Give arrays the shapes that structural parameters among the given ones make (FMI 3.0.2 sec. 2.4.7.5)."""
    given = parameters if isinstance(parameters, Mapping) else {}
    known = file.variables
    sizes = {
        name: value
        for name, value in given.items()
        if name in known and known[name].causality == "structuralParameter" and isinstance(value, int | float)
    }
    for variable in known.values() if sizes else ():
        if variable.dimensions:
            ends = [(one.start, one.variable) for one in variable.dimensions]
            shape = [start if by is None else sizes.get(by.name, by.start) for start, by in ends]
            variable.shape = tuple(int(size) for size in shape)
    if sizes:
        described = file.description
        counted = {
            "numberOfContinuousStates": described.derivatives,
            "numberOfEventIndicators": described.eventIndicators,
        }
        for name, unknowns in counted.items():
            setattr(described, name, int(sum(np.prod(one.variable.shape or ()) for one in unknowns)))


def _limit(variable: Any, declared: Any, side: Literal["min", "max"]) -> float:
    """Return a declared limit; infinite where none is declared or it is no number."""
    text = getattr(variable, side) or (getattr(declared, side) if declared is not None else None)
    default = -np.inf if side == "min" else np.inf
    try:
        value = default if text is None else float(str(text).split()[0])
    except (ValueError, IndexError):
        return default
    return default if np.isnan(value) else value


def choose(file: FmuFile, names: Sequence[str] | None, causality: Literal["input", "output"]) -> tuple[FmuPort, ...]:
    """Return the inputs or outputs of a plant.

    Parameters
    ----------
    file : FmuFile
        The FMU.
    names : sequence of str, optional
        Names of variables; default: all of that causality that a channel can carry. Outputs may be any variable.
    causality : {"input", "output"}
        What is wanted.

    Raises
    ------
    InputError
        If a name is unknown or appears twice, or an input is not an input; the message lists those that there are.
    """
    variables = file.variables
    if names is None:
        able = REALS | INTEGERS | {"Boolean"}
        chosen = [v for v in variables.values() if v.causality == causality and v.type in able]
        return tuple(port(file, v) for v in chosen if v.alias is None)
    if not isinstance(names, str) and len(names) == 1:
        names = str(names[0])
    if isinstance(names, str):
        names = _listed(names, variables)
    found = []
    for name in names:
        variable = variables.get(name)
        if variable is None or (causality == "input" and variable.causality != "input"):
            listed = [n for n, v in variables.items() if v.causality == causality]
            raise unknown(file, f"{causality}s", name, listed if causality == "input" else list(variables))
        found.append(port(file, variable))
    if len(set(names)) != len(list(names)):
        raise InputError(
            f"{causality} chosen twice", expected="each once", got=", ".join(names), remedy="remove one", file=file.path
        )
    return tuple(found)


def _listed(text: str, known: Collection[str]) -> list[str]:
    """Return the names that one text gives: that of a variable, or several with commas, perhaps in brackets.

    Examples
    --------
    >>> _listed("x[1,2]", {"x[1,2]"}), _listed("[x[1,2], v]", {"v"})
    (['x[1,2]'], ['x[1,2]', 'v'])
    """
    if text in known:
        return [text]
    inside = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    names = [name.strip(" \"'") for name in re.split(r",(?![^\[]*\])", inside)]
    return names if all(names) else [text]


def starts(ports: Iterable[FmuPort], given: Mapping[str, Any]) -> list[float]:
    """Return the start values of all channels in SI, those ``given`` first; 0 where the description gives none."""
    values: list[float] = []
    for one in ports:
        own = np.ravel(given.get(one.variable.name, ())).tolist()
        words = own or str(one.variable.start or "").split()
        raw = [{"true": 1.0, "false": 0.0}.get(word) if word in ("true", "false") else _number(word) for word in words]
        listed = [0.0 if value is None else one.scale * value + one.offset for value in raw] or [0.0]
        values += (listed * one.size)[: one.size]
    return values


def own_values(ports: Iterable[FmuPort], u: FloatArray) -> dict[str, Any]:
    """Return inputs (nu,) in SI as values of scalar variables, by name, in the FMU's own types and units."""
    kinds: dict[str, Callable[[float], Any]] = {"Boolean": bool, "Integer": round, "Enumeration": round}
    return {
        one.variable.name: kinds.get(one.variable.type, float)((float(value) - one.offset) / one.scale)
        for one, value in zip(ports, u, strict=True)
    }


def unknown(file: FmuFile, what: str, name: object, known: Sequence[str]) -> InputError:
    """Return the error for a name that the FMU does not have, with the nearest that it has."""
    listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
    return InputError(
        f"unknown name in {what}",
        expected=f"names among {listed or '(none)'}",
        got=repr(name),
        remedy=did_you_mean(str(name), known, "run 'sysid list FILE.fmu'"),
        file=file.path,
    )


def channels(ports: Iterable[FmuPort]) -> tuple[Channel, ...]:
    """Return the channels of all ports, in order."""
    return tuple(channel for one in ports for channel in one.channels)


def states_of(file: FmuFile) -> tuple[FmuPort, ...]:
    """Return the continuous states that the description names (a derivative points to its state), else nothing."""
    ordered = [u.variable for u in file.description.derivatives if u.variable is not None]
    if not ordered:
        ordered = [v for v in file.description.modelVariables if v.derivative is not None]
    states = []
    for derivative in ordered:
        if derivative.derivative is None or isinstance(derivative.derivative, str):
            return ()
        states.append(derivative.derivative)
    return tuple(port(file, state) for state in states if state.type in REALS)


def feeds_through(file: FmuFile, inputs: Sequence[FmuPort], outputs: Sequence[FmuPort]) -> tuple[bool, bool]:
    """Return whether a chosen output depends directly on a chosen input, and whether the description tells."""
    given = {id(one.variable) for one in inputs}
    names = {one.variable.name for one in inputs}
    wanted = {one.variable.name for one in outputs}
    told = file.version > 1 or not inputs  # DirectDependency of FMI 1.0 is not read; without, all may (sec. 3.3)
    for unknown_ in file.description.outputs:
        if unknown_.variable is None or unknown_.variable.name not in wanted:
            continue
        if unknown_.dependencies is None:
            told = told and not inputs
        elif any(id(d) in given or d.name in names for d in unknown_.dependencies):
            return True, True
    return False, told


def describe(path: str | Path) -> dict[str, Any]:
    """Return the description of an FMU, for a person or for JSON.

    Raises InputError if it is no FMU or cannot be read.

    - ``path``: the ``.fmu`` file
    - returns ``file``, ``model``, ``description``, ``fmi``, ``tool``, ``platforms``, ``kinds`` (abilities by kind),
      ``experiment``, ``problems``, and ``variables``: rows with name, type, causality, variability, initial, unit,
      si_unit (``SI = scale * value + offset``), start, minimum, maximum, shape, items (of an enumeration), alias,
      derivative_of, description

    Examples
    --------
    >>> from plants.mockups import mockup
    >>> [row["name"] for row in describe(mockup("pendulum"))["variables"] if row["causality"] == "output"]
    ['theta', 'omega']
    """
    file = read_fmu(path)
    d = file.description
    complaints = []
    rows = []
    for variable in d.modelVariables:
        si: str | None = None
        scale: float | None = None
        offset: float | None = None
        low: float | None = None
        high: float | None = None
        if variable.type in REALS | INTEGERS | {"Boolean"}:
            one = port(file, variable)
            if one.complaint is not None:
                complaints.append(one.complaint)
            if one.channels:
                first = one.channels[0]
                if variable.type in REALS:
                    si, scale, offset = first.unit, one.scale, one.offset
                low = float(first.minimum) if np.isfinite(first.minimum) else None
                high = float(first.maximum) if np.isfinite(first.maximum) else None
        declared = variable.declaredType
        rows.append(
            {
                "name": variable.name,
                "type": variable.type,
                "causality": variable.causality,
                "variability": variable.variability,
                "initial": variable.initial,
                "unit": variable.unit or (declared.unit if declared is not None else None),
                "si_unit": si,
                "scale": scale,
                "offset": offset,
                "display_unit": variable.displayUnit or (declared.displayUnit if declared is not None else None),
                "start": variable.start,
                "minimum": low,
                "maximum": high,
                "shape": list(variable.shape or ()),
                "items": None
                if declared is None or not declared.items
                else {str(item.name): int(item.value) for item in declared.items},
                "alias": variable.alias is not None,
                "derivative_of": None if variable.derivative is None else variable.derivative.name,
                "description": variable.description,
            }
        )
    experiment = d.defaultExperiment
    return {
        "file": str(file.path),
        "model": d.modelName,
        "description": d.description,
        "fmi": d.fmiVersion,
        "tool": d.generationTool,
        "platforms": list(file.platforms),
        "kinds": {{"cs": "co-simulation", "me": "model exchange"}[kind]: _abilities(file, kind) for kind in file.kinds},
        "experiment": {
            name: _number(getattr(experiment, name, None))
            for name in ("startTime", "stopTime", "stepSize", "tolerance")
        },
        "states": d.numberOfContinuousStates,
        "event_indicators": d.numberOfEventIndicators,
        "problems": [*file.problems, *complaints],
        "variables": rows,
    }


def _abilities(file: FmuFile, kind: Kind) -> dict[str, Any]:
    """Return the abilities of one kind by readable names."""
    i = file.interface(kind)
    found: dict[str, Any] = {
        "identifier": i.modelIdentifier,
        "get and set state": bool(i.canGetAndSetFMUstate),
        "serialise state": bool(i.canSerializeFMUstate),
        "directional derivatives": file.offers_slopes(kind),
        "once per process": bool(i.canBeInstantiatedOnlyOncePerProcess),
        "needs its tool": bool(i.needsExecutionTool),
    }
    if kind == "cs":
        found["variable step"] = bool(i.canHandleVariableCommunicationStepSize)
        found["fixed internal step"] = _number(i.fixedInternalStepSize)
        found["event mode"] = bool(i.hasEventMode)
        found["early return"] = bool(i.mightReturnEarlyFromDoStep)
    return found


def _number(text: Any) -> float | None:
    """Return a number, or None where the description does not give one."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
