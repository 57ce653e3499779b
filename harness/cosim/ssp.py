"""Systems of other tools as coupled plants: SSP packages and folders, and OSP system structures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.cosim.description import CHANGEABLE, Make
from harness.cosim.master import Coupled
from harness.cosim.structure.flat import Describe, FlatComponent, FlatSystem, named
from harness.cosim.structure.flatten import flatten
from harness.cosim.structure.model import SystemDescription
from harness.cosim.structure.open import open_structure
from harness.cosim.watched import made
from harness.cosim.wiring import Connection, ShownOutput
from harness.errors import InputError, refuse_unknown
from harness.protocols import Plant
from harness.signals import Channel

SYSTEM_OPTIONS = (*CHANGEABLE, "parameters", "start_time", "solver_tolerance", "within")
"""What may be said about a system from outside."""
SAMPLES = 500  # Steps of a run where neither the system nor an FMU suggests a step.
INTEGERS = ("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")


def couple_ssp(
    path: str | Path, make: Make, describe: Describe, *, changes: Mapping[str, Any] | None = None
) -> Coupled:
    """Build the plant that a system of FMUs describes.

    Nested systems, and packages inside packages, are flattened (``system/component``). Connectors of the outermost
    system become the inputs and outputs of the plant; without output connectors every output of every FMU is shown.

    Parameters
    ----------
    path : path
        An ``.ssp`` package, a folder with ``SystemStructure.ssd``, or an ``OspSystemStructure.xml``.
    make : callable
        ``make("fmu", {"path": ..., ...}) -> Plant``.
    describe : callable
        Tells what is in an FMU.
    changes : mapping, optional
        How the parts are stepped, as in :func:`harness.cosim.couple` (the sample time is also that of the FMUs), and
        ``parameters`` (values by hierarchical name, in SI, that go before those of the file), ``start_time`` [s],
        ``solver_tolerance`` of the FMUs, and ``within``, the folder that the files of an unpacked system may lie in.

    Raises
    ------
    InputError
        If the file is unsafe to unpack, breaks its standard, uses what is not understood here, or units disagree.

    Notes
    -----
    The coupled plant's ``warnings`` say what was passed over; its ``input_starts`` are the start values of its inputs.
    What was unpacked is removed when it is closed.
    """
    path, changed = Path(path), dict(changes or {})
    refuse_unknown("option of a system", changed, SYSTEM_OPTIONS, remedy="change the rest in the file", file=path)
    parameters, start = changed.pop("parameters", None), changed.pop("start_time", None)
    tolerance = changed.pop("solver_tolerance", None)
    opened = open_structure(path, within=changed.pop("within", None))
    parts: dict[str, Plant] = {}
    try:
        description = opened.description
        flat = flatten(description, describe, parameters=parameters)
        if not flat.components:
            raise InputError(
                "a system without FMUs", expected="at least one", got="none", remedy="export it again", file=path
            )
        step, notes = _step(description, flat, changed.get("sample_time"))
        first = description.start if start is None else start
        shared = {"start_time": first or 0.0, **({} if tolerance is None else {"tolerance": tolerance})}
        for component in flat.components:
            parts[component.name] = _made(component, make, _own_step(component, step, notes), shared, path)
        changed["sample_time"] = step
        changed.setdefault("order", description.exchange or "gauss-seidel")
        coupled = _coupled(flat, parts, changed)
        coupled.after_close(opened.close)
        warnings = tuple(text for part in parts.values() for text in getattr(part, "warnings", ()))
        coupled.warnings = (*flat.notes, *notes, *dict.fromkeys(warnings))
        coupled.input_starts = tuple(one.start for one in flat.inputs)
        return coupled
    except BaseException as error:
        for plant in parts.values():
            plant.close()
        opened.close()
        if isinstance(error, InputError):
            raise error.located(file=path) from error
        raise


def _step(description: SystemDescription, flat: FlatSystem, asked: float | None) -> tuple[float, list[str]]:
    """Return the communication step [s]: as asked, as the file says, or the finest that an FMU suggests."""
    if asked is not None:
        return asked, []
    if description.step is not None:
        return description.step, []
    suggested = [one.about["experiment"]["stepSize"] for one in flat.components]
    finest = min((step for step in suggested if step), default=None)
    if finest is not None:
        return float(finest), []
    length = (description.stop if description.stop is not None else 1.0) - (description.start or 0.0)
    step = float(f"{length / SAMPLES:.6g}")
    return step, [f"neither the system nor an FMU suggests a step: {step:g} s is taken (--step)"]


def _own_step(component: FlatComponent, step: float, notes: list[str]) -> float:
    """Return the step [s] of a component: a multiple of the communication step, near what the file says."""
    if component.step is None:
        return step
    found = max(1, round(component.step / step)) * step
    if abs(found - component.step) > 1e-9 * step:
        wanted = f"its step of {component.step:g} s is no multiple of {step:g} s"
        notes.append(f"{component.label!r} steps every {found:g} s: {wanted}")
    return found


def _made(component: FlatComponent, make: Make, step: float, shared: Mapping[str, Any], path: Path) -> Plant:
    """Return one component as a plant with its values; an input that nothing drives keeps its start value."""
    options: dict[str, Any] = {
        "path": str(component.path),
        "sample_time": step,
        "inputs": list(component.inputs),
        "parameters": dict(component.parameters),
        "start": dict(component.start),
        **shared,
    }
    if component.outputs:
        options["outputs"] = list(component.outputs)
    if component.kind is not None:
        options["kind"] = component.kind
    try:
        return made(make, "fmu", options, component.label)
    except InputError as error:
        raise named(error, component.label, component.path, path) from error


def _coupled(flat: FlatSystem, parts: dict[str, Plant], changes: dict[str, Any]) -> Coupled:
    """Connect the parts."""
    channels = {
        f"{name}.{channel.name}": channel
        for name, part in parts.items()
        for channel in (*part.spec.inputs, *part.spec.outputs)
    }
    wires = []
    for wire in flat.wires:
        line = wire.chain.linear
        if line is None:
            wires.append(Connection(wire.source, wire.target, add=wire.add, gain_unit=None, transform=wire.chain))
        else:
            wires.append(
                Connection(wire.source, wire.target, line.factor, add=wire.add, gain_unit=None, offset=line.offset)
            )
    inputs: dict[str, str | Channel] = {}
    for one in flat.inputs:
        lent = [channels[w.target] for w in flat.wires if w.source == one.name and not w.chain.steps]
        inputs[one.name] = (
            replace(lent[0], name=one.name)
            if lent and lent[0].unit == one.unit
            else Channel(one.name, one.unit, kind="integer" if one.type in INTEGERS else "real")
        )
    shown: list[str | ShownOutput] = []
    for out in flat.outputs:
        channel = channels.get(out.source) or inputs.get(out.source)
        assert isinstance(channel, Channel)
        own = replace(channel, name=out.name) if out.unit is None else Channel(out.name, out.unit)
        shown.append(ShownOutput(out.source, own, None if not out.chain.steps else out.chain))
    return Coupled(parts, wires, inputs=inputs, outputs=shown, **changes)
