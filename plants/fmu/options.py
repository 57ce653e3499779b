"""The options of an FMU plant checked against its description, and brought into the FMU's own types and units."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping, Sequence
from typing import Any

from harness.errors import InputError
from harness.options import outside
from plants.fmu.archive import FmuFile, Kind
from plants.fmu.variables import INTEGERS, REALS, port, unknown


def encode(file: FmuFile, variable: Any, value: Any, scale: float = 1.0, offset: float = 0.0) -> Any:
    """Return a Python value as the FMU's type, or refuse it.

    - ``file``: for the message
    - ``variable``: what is set
    - ``value``: in SI; a string for enumerations may be the item's name
    - ``scale, offset``: SI = scale * (value of the FMU) + offset
    """
    wanted = 1
    for n in variable.shape or ():
        wanted *= int(n)
    if variable.shape:
        import numpy as np

        items = np.asarray(value, dtype=object).ravel().tolist()
        if len(items) == 1 and wanted > 1:
            items = items * wanted
        if len(items) != wanted and variable.dimensions:
            raise _unfit(file, variable, f"{wanted} values", f"{len(items)}")
        return [_scalar(file, variable, item, scale, offset) for item in items]
    return _scalar(file, variable, value, scale, offset)


def _unfit(file: FmuFile, variable: Any, expected: str, got: str) -> InputError:
    return InputError(
        f"value of {variable.name!r}", expected=expected, got=got, remedy="correct the value", file=file.path
    )


def _scalar(file: FmuFile, variable: Any, value: Any, scale: float, offset: float) -> Any:
    """Return one value as the FMU's type."""
    kind = variable.type
    if hasattr(value, "item"):
        value = value.item()
    if kind == "String":
        if not isinstance(value, str):
            raise _unfit(file, variable, "a text", repr(value))
        return value
    if kind == "Binary":
        try:
            return bytes.fromhex(value) if isinstance(value, str) else bytes(memoryview(value))
        except (ValueError, TypeError):
            raise _unfit(file, variable, "bytes, or pairs of hexadecimal digits", repr(value)) from None
    if kind == "Enumeration" and isinstance(value, str):
        items = variable.declaredType.items if variable.declaredType is not None else []
        found = [int(item.value) for item in items if item.name == value]
        if not found:
            raise _unfit(file, variable, f"one of {', '.join(str(i.name) for i in items)}", repr(value))
        return found[0]
    if kind == "Boolean":
        if value in (True, False, 0, 1):
            return bool(value)
        raise _unfit(file, variable, "true or false", repr(value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _unfit(file, variable, "a number", repr(value))
    if kind in ("Real", "Float64", "Float32"):
        if value != value or value in (float("inf"), float("-inf")):
            raise _unfit(file, variable, "a finite number", repr(value))
        return (float(value) - offset) / scale
    if float(value) != int(value):
        raise _unfit(file, variable, "a whole number", repr(value))
    return int(value)


log = logging.getLogger("plants.fmu.plant")
BOUNDED = REALS | (INTEGERS - {"Enumeration"})  # Types of variables that may declare min and max.


def refused(file: FmuFile, what: str, expected: str, got: str, remedy: str, place: str | None = None) -> InputError:
    """Return the error for something that does not fit the FMU."""
    return InputError(what, expected=expected, got=got, remedy=remedy, file=file.path, place=place)


def chosen_kind(file: FmuFile, kind: Kind | None) -> Kind:
    """Return co-simulation or model exchange, as asked or as the FMU prefers."""
    if kind is None:
        return file.kinds[0]
    if kind not in file.kinds:
        raise refused(file, "kind", f"one of {', '.join(file.kinds)}", repr(kind), "choose another", "kind")
    return kind


def check_event_mode(file: FmuFile, kind: Kind, *, event_mode: bool, early_return: bool) -> None:
    """Refuse event mode and early return where there is no such thing."""
    offered = bool(getattr(file.interface(kind), "hasEventMode", False)) and file.version == 3 and kind == "cs"
    if event_mode and not offered:
        got = f"FMI {file.version}, kind {kind!r}" + ("" if file.version < 3 else ", without hasEventMode")
        raise refused(file, "event mode", "FMI 3.0 co-simulation with hasEventMode", got, "leave it off", "event_mode")
    if early_return and not (file.version == 3 and kind == "cs"):
        got = f"FMI {file.version}, kind {kind!r}"
        raise refused(file, "early return", "FMI 3.0 co-simulation", got, "leave it off", "early_return")


def default(file: FmuFile, name: str) -> float | None:
    """Return a number of the FMU's default experiment."""
    text = getattr(file.description.defaultExperiment, name, None)
    return None if text is None else float(text)


def count_substeps(file: FmuFile, sample_time: float, step: float | None) -> int:
    """Return the number of communication steps in a sample."""
    if step is None:
        return 1
    ratio = sample_time / step if step > 0 else 0.0
    if not (ratio >= 1 - 1e-9 and abs(ratio - round(ratio)) < 1e-6 * ratio):
        expected = f"a divisor of the sample time {sample_time:g} s"
        raise refused(file, "step", expected, f"{step!r} s", "choose sample_time / n", "step")
    return round(ratio)


def complaints(file: FmuFile, kind: Kind, step: float, units: Sequence[str], *, told: bool) -> tuple[str, ...]:
    """Return the complaints about the FMU that a user should know, and log them.

    - ``file, kind``: the FMU, and how it is used
    - ``step``: communication step [s]
    - ``units``: what is odd about units
    - ``told``: whether the outputs tell what they depend on
    """
    found = [*file.problems, *units]
    if not told:
        found.append("outputs do not tell what they depend on: taken as without direct feedthrough")
    clocks = [v.name for v in file.description.modelVariables if v.type == "Clock"]
    if clocks:
        listed = ", ".join(clocks[:5]) + (", ..." if len(clocks) > 5 else "")
        found.append(f"clocks are not activated from outside, nor recorded: {listed}")
    fixed = getattr(file.interface(kind), "fixedInternalStepSize", None)
    if fixed:
        ratio = step / float(fixed)
        if abs(ratio - round(ratio)) > 1e-6 * max(ratio, 1.0) or round(ratio) < 1:
            found.append(f"the communication step is no multiple of the FMU's internal step {float(fixed):g} s")
    for text in found:
        log.info("%s: %s", file.path.name, text)
    return tuple(found)


def encoded(file: FmuFile, values: object, what: str, causalities: Sequence[str] | None) -> dict[str, Any]:
    """Return values as the FMU's own types and units; unknown or unsettable names are refused."""
    if not isinstance(values, Mapping):
        got = f"{type(values).__name__} {values!r}"
        remedy = f"write {what}.NAME=VALUE, or {what}={{NAME=VALUE}}"
        raise refused(file, f"option {what}", "values by name", got, remedy, what)
    known = _settable(file, what, None if causalities is None else tuple(causalities))
    found = {}
    for name, value in values.items():
        if name not in known:
            raise unknown(file, what, name, list(known))
        variable = known[name]
        scale, offset = _to_si(file, name)
        found[name] = encode(file, variable, value, scale, offset)
    return found


def out_of_bounds(file: FmuFile, values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what is to be said of values (SI, by name) outside the min and max that the FMU declares for them."""
    found = []
    for name, value in values.items():
        variable = file.variables[name]
        if variable.type not in BOUNDED:
            continue
        channel = next(iter(port(file, variable).channels), None)
        if channel is not None:
            found.append(outside(name, value, channel.minimum, channel.maximum, channel.unit))
    return tuple(text for text in found if text is not None)


@functools.lru_cache(maxsize=16)
def _settable(file: FmuFile, what: str, causalities: tuple[str, ...] | None) -> dict[str, Any]:
    """Return the variables that an option may set, by name; asked at every start of a run."""
    if causalities is not None:
        return {n: v for n, v in file.variables.items() if v.causality in causalities and v.variability != "constant"}
    known = {n: v for n, v in file.variables.items() if _has_start(v, file.version)}
    return {n: v for n, v in known.items() if what != "x0" or v.causality in ("output", "local")}


@functools.lru_cache(maxsize=1024)
def _to_si(file: FmuFile, name: str) -> tuple[float, float]:
    """Return scale and offset of a variable's way to SI; what is no real number has none."""
    variable = file.variables[name]
    if variable.type not in ("Real", "Float64", "Float32"):
        return 1.0, 0.0
    found = port(file, variable)
    return found.scale, found.offset


def _has_start(variable: Any, version: int) -> bool:
    """Return True if a variable can be set before the initialisation."""
    if variable.causality in ("independent", "calculatedParameter") or variable.variability == "constant":
        return False
    if version == 1:
        return variable.start is not None
    return variable.causality == "input" or variable.initial in ("exact", "approx")
