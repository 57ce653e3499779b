"""A system of FMUs as an SSP 1.0 package: its components, their values, the wires between them and its own connectors.

The package holds two structures. ``SystemStructure.ssd`` has connectors of the system itself, in SI, and leaves units
to who reads it. :data:`OPEN_ENDS` is the same system for masters that know neither connectors of the system nor units
(libcosim): what comes from outside stays open at the components, and conversions are written out as factors.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from harness.data.whole_files import whole_file
from harness.errors import InputError
from harness.export.describe import xml_text
from harness.export.ssp_elements import SPACES, base_unit, child, unit_definitions
from harness.units import fits

OPEN_ENDS = "OpenEnds.ssd"  # Name of the structure without connectors of its own.
OSP = "http://opensimulationplatform.com/SSP/OSPAnnotations"
STEPS = 1000  # Steps of the system's own experiment where nothing says how long it is.
REALS = ("Real", "Float64", "Float32")
SAME = 4 * 2.0**-52  # A factor this close to one came out of unit factors that cancel.


@dataclass(frozen=True)
class WrittenPort:
    """A variable of an FMU: ``SI = scale * value + offset``, and the unit that the FMU states, if any."""

    name: str
    kind: str
    type: str
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    items: str = ""


@dataclass(frozen=True)
class WrittenComponent:
    """An FMU in the system: its file, its ports by name, its values (SI, with the SI unit) by name of the variable."""

    name: str
    file: Path
    ports: Mapping[str, WrittenPort]
    values: Mapping[str, tuple[Any, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Outer:
    """A connector of the system itself, in SI."""

    name: str
    kind: str
    unit: str
    type: str = "Real"


@dataclass(frozen=True)
class WrittenConnection:
    """From a component's port to another's; an element of "" is the system itself. ``target = factor source + offset``.

    Both in SI.
    """

    source: tuple[str, str]
    target: tuple[str, str]
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class WrittenSystem:
    """A whole system; ``step`` [s] is its communication step, ``parallel`` that all step with the last values."""

    name: str
    components: Sequence[WrittenComponent]
    wires: Sequence[WrittenConnection]
    outer: Sequence[Outer]
    step: float
    stop: float | None = None
    parallel: bool = True


def ports_of(description: Mapping[str, Any], names: Sequence[str]) -> dict[str, WrittenPort]:
    """Return ports of an FMU by name.

    Raises InputError if one is an array, or of a type that SSP 1.0 does not know.

    - ``description``: what :func:`harness.parts.files.describe_fmu` returns
    - ``names``: variables that are wanted
    """
    rows = {row["name"]: row for row in description["variables"]}
    found = {}
    for name in names:
        row = rows.get(name)
        if row is None or row["shape"]:
            raise InputError(
                f"connector {name!r} of {Path(description['file']).name}",
                expected="a scalar variable: SSP 1.0 knows no arrays",
                got="an element of an array" if row is None else f"an array of shape {row['shape']}",
                remedy="couple it in TOML",
            )
        kind = row["causality"] if row["causality"] in ("input", "output", "parameter") else "output"
        of_real = row["type"] in REALS and row["scale"] is not None
        scale, offset = (row["scale"], row["offset"]) if of_real else (1.0, 0.0)
        found[name] = WrittenPort(name, kind, _type(row["type"]), row["unit"], scale, offset)
    return found


def _type(kind: str) -> str:
    """Return the type of SSP 1.0 that holds one of FMI."""
    if kind in REALS:
        return "Real"
    if kind in ("Boolean", "String", "Binary"):
        return kind
    return "Integer"  # an enumeration as well: its number is what travels


def write_structure(system: WrittenSystem, target: Path) -> Path:
    """Write a system as an SSP package.

    Raises InputError if the file cannot be written.
    """
    with whole_file(target) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        stored: dict[Path, str] = {}
        for component in system.components:
            if component.file not in stored:
                stored[component.file] = f"resources/{component.name}.fmu"
                archive.write(component.file, stored[component.file])
        sources = {component.name: stored[component.file] for component in system.components}
        archive.writestr("SystemStructure.ssd", _described(system, sources, closed=True))
        archive.writestr(OPEN_ENDS, _described(system, sources, closed=False))
    return target


def _described(system: WrittenSystem, sources: Mapping[str, str], *, closed: bool) -> str:
    """Return a structure; ``closed`` with connectors of the system and units, else open and in plain numbers."""
    for prefix, space in (*SPACES.items(), ("osp", OSP)):
        ElementTree.register_namespace(prefix, space)
    root = child(None, "ssd:SystemStructureDescription", version="1.0", name=system.name)
    top = child(root, "ssd:System", name=system.name)
    if closed:
        outside = child(top, "ssd:Connectors")
        for one in system.outer:
            _connector(outside, WrittenPort(one.name, one.kind, one.type, one.unit), units=True)
    elements = child(top, "ssd:Elements")
    for component in system.components:
        _component(elements, component, sources[component.name], units=closed)
    ports = {(part.name, port.name): port for part in system.components for port in part.ports.values()}
    ports |= {("", one.name): WrittenPort(one.name, one.kind, one.type, one.unit) for one in system.outer}
    wires = child(top, "ssd:Connections")
    for wire in system.wires:
        ends = ports[wire.source], ports[wire.target]
        if closed and _converts(*ends):
            _wire(wires, wire, _after_units(wire, ends[1]), suppress=False)
        elif closed or "" not in (wire.source[0], wire.target[0]):
            _wire(wires, wire, _between(wire, *ends), suppress=True)
    if not len(wires):  # the schema knows no empty list of them
        top.remove(wires)
    unit_definitions(root, "ssd:Units")
    stop = STEPS * system.step if system.stop is None else system.stop
    experiment = child(root, "ssd:DefaultExperiment", startTime="0", stopTime=repr(float(stop)))
    if system.parallel or not closed:
        note = child(child(experiment, "ssd:Annotations"), "ssc:Annotation", type="com.opensimulationplatform")
        rules = ElementTree.SubElement(note, f"{{{OSP}}}Algorithm")
        ElementTree.SubElement(rules, f"{{{OSP}}}FixedStepAlgorithm", baseStepSize=repr(float(system.step)))
    return xml_text(root)


def _component(parent: Any, component: WrittenComponent, source: str, *, units: bool) -> None:
    """Add a component with its connectors and values."""
    node = child(parent, "ssd:Component", name=component.name, type="application/x-fmu-sharedlibrary", source=source)
    connectors = child(node, "ssd:Connectors")
    for port in component.ports.values():
        if port.kind in ("input", "output"):
            _connector(connectors, port, units=units)
    if not component.values:
        return
    binding = child(child(node, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    given = child(child(binding, "ssd:ParameterValues"), "ssv:ParameterSet", version="1.0", name="values")
    listed = child(given, "ssv:Parameters")
    for name, (value, unit) in component.values.items():
        port = component.ports.get(name, WrittenPort(name, "parameter", _type_of(value)))
        typed, stated = port.type, {}
        if typed == "Real" and not units:
            value = (float(value) - port.offset) / port.scale
        elif typed == "Real" and base_unit(unit) is not None:
            stated = {"unit": unit}
        shown = str(value).lower() if typed == "Boolean" else repr(float(value)) if typed == "Real" else str(value)
        child(child(listed, "ssv:Parameter", name=name), f"ssv:{typed}", value=shown, **stated)
    unit_definitions(given, "ssv:Units")


def _type_of(value: Any) -> str:
    """Return the type of SSP 1.0 for a value whose variable is not known."""
    if isinstance(value, bool):
        return "Boolean"
    return "String" if isinstance(value, str) else "Integer" if isinstance(value, int) else "Real"


def _connector(parent: Any, port: WrittenPort, *, units: bool) -> None:
    """Add a connector; without a unit that of the FMU's variable counts."""
    stated = {"unit": port.unit} if units and port.unit is not None and base_unit(port.unit) is not None else {}
    node = child(parent, "ssd:Connector", name=port.name, kind=port.kind)
    child(node, f"ssc:{port.type}", **(stated if port.type == "Real" else {}))


def _converts(source: WrittenPort, target: WrittenPort) -> bool:
    """Return whether a reader converts the number of one connector into the unit of the other."""
    if source.unit is None or target.unit is None or None in (base_unit(source.unit), base_unit(target.unit)):
        return False
    return fits(source.unit, target.unit)


def _after_units(wire: WrittenConnection, target: WrittenPort) -> tuple[float, float]:
    """Return factor and offset on the converted number, in the unit of the target (SSP 1.0, LinearTransformation)."""
    return wire.factor, (wire.offset + (wire.factor - 1.0) * target.offset) / target.scale


def _between(wire: WrittenConnection, source: WrittenPort, target: WrittenPort) -> tuple[float, float]:
    """Return factor and offset from the number of one FMU to that of the other."""
    factor = wire.factor * source.scale / target.scale
    offset = (wire.factor * source.offset + wire.offset - target.offset) / target.scale
    return 1.0 if abs(factor - 1.0) < SAME else factor, offset


def _wire(parent: Any, wire: WrittenConnection, change: tuple[float, float], *, suppress: bool) -> None:
    """Add a connection; of an empty element the system itself is meant."""
    (source, output), (target, connector) = wire.source, wire.target
    ends = {"startElement": source, "startConnector": output, "endElement": target, "endConnector": connector}
    given = {key: value for key, value in ends.items() if value}
    if suppress:
        given["suppressUnitConversion"] = "true"
    node = child(parent, "ssd:Connection", **given)
    factor, offset = change
    if (factor, offset) != (1.0, 0.0):
        child(node, "ssc:LinearTransformation", factor=repr(float(factor)), offset=repr(float(offset)))
