"""What stands in SystemStructure.ssd: read by fmpy, flattened to components and the wires between them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.errors import InputError
from harness.fmi.archive import check_entries, has_document_type
from harness.units import base_units

__all__ = ["Component", "Structure", "read_structure"]

SSD = "SystemStructure.ssd"
FMU, PACKAGE = "application/x-fmu-sharedlibrary", ("application/x-ssp-package", "application/ssp+zip")
LARGEST_TEXT = 64 << 20  # bytes of an XML file
BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")

Place = tuple[tuple[str, ...], str]
"""A connector: the names of the systems and the component on the way to it, and its own."""


@dataclass
class Component:
    """An FMU (or package) in the package: connectors as name -> (input | output, unit or None), values in SI."""

    name: str
    source: str
    connectors: dict[str, tuple[str, str | None]]
    parameters: dict[str, Any] = field(default_factory=dict)
    start: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Structure:
    """Components; wires as (source, target, gain); outputs as name -> ``component.output``."""

    components: tuple[Component, ...]
    wires: tuple[tuple[str, str, float], ...]
    outputs: dict[str, str]


def read_structure(path: Path) -> Structure:
    """Read the structure of an SSP package without unpacking anything.

    Raises
    ------
    InputError
        If the file is missing, no package, unsafe to unpack, breaks the standard, or uses what is not understood.
    """
    if not path.is_file():
        raise InputError("no such package", expected="an .ssp file", got="no file", remedy="check the path", file=path)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = check_entries(path, archive)
            if SSD not in archive.namelist():
                raise InputError("not an SSP package", expected=SSD, got="none", remedy="export it again", file=path)
            for entry in entries:
                if entry.filename.endswith((".ssd", ".ssv", ".ssm", ".ssb")):
                    _refuse_doctype(path, archive, entry)
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise InputError(
            "not an SSP package",
            expected=f"a zip archive with {SSD}",
            got=str(error) or type(error).__name__,
            remedy="export or download it again",
            file=path,
        ) from error
    from fmpy.ssp.ssd import read_ssd

    try:
        with path.open("rb") as file:  # given the path, fmpy leaves the file open when it fails
            described = read_ssd(file)
        with zipfile.ZipFile(path) as archive:
            details = _details(archive.read(SSD))
    except Exception as error:
        raise InputError(
            SSD,
            expected="a system structure of version 1.0",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            remedy="export it again",
            file=path,
        ) from error
    return _Flattening(path, described, *details).result()


def _refuse_doctype(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """Refuse XML that could define entities, or is too large to be a description."""
    if entry.file_size > LARGEST_TEXT:
        got = f"{entry.file_size >> 20} MiB"
        raise InputError(
            entry.filename, expected=f"at most {LARGEST_TEXT >> 20} MiB", got=got, remedy="shrink it", file=path
        )
    if has_document_type(archive.read(entry)):
        raise InputError(
            entry.filename, expected="no document type", got="a DOCTYPE", remedy="do not trust it", file=path
        )


def _details(text: bytes) -> tuple[dict[Place, str], dict[tuple[Place, Place], tuple[float, float]]]:
    """Return what fmpy leaves out: units of connectors, and linear transformations of connections."""
    from fmpy.ssp.ssd import etree, ns

    units: dict[Place, str] = {}
    changes: dict[tuple[Place, Place], tuple[float, float]] = {}

    def visit(element: Any, way: tuple[str, ...]) -> None:
        for connector in element.findall("ssd:Connectors/ssd:Connector", namespaces=ns):
            for real in connector.findall("ssc:Real", namespaces=ns):
                if real.get("unit") is not None:
                    units[way, connector.get("name")] = real.get("unit")
        for child in element.findall("ssd:Elements/*", namespaces=ns):
            visit(child, (*way, child.get("name")))
        for wire in element.findall("ssd:Connections/ssd:Connection", namespaces=ns):
            for change in wire.findall("ssc:LinearTransformation", namespaces=ns):
                start = _end(way, wire.get("startElement"), wire.get("startConnector"))
                end = _end(way, wire.get("endElement"), wire.get("endConnector"))
                changes[start, end] = (float(change.get("factor", "1")), float(change.get("offset", "0")))

    visit(etree.fromstring(text).find("ssd:System", namespaces=ns), ())
    return units, changes


def _end(way: tuple[str, ...], element: str | None, connector: str) -> Place:
    """Return one end of a connection inside the system at ``way``."""
    return ((*way, element) if element is not None else way), connector


class _Flattening:
    """The walk through the systems of a package."""

    def __init__(self, path: Path, described: Any, units: dict[Place, str], changes: Any) -> None:
        self.path, self.system = path, described.system
        self.changes = changes
        self.defined = {unit.name: unit for unit in described.units}
        self.units = {place: self._unit(text) for place, text in units.items()}
        self.components: dict[tuple[str, ...], Component] = {}
        self.kinds: dict[Place, str] = {}
        self.from_of: dict[Place, tuple[Place, float]] = {}
        self.values: list[tuple[tuple[str, ...], dict[str, tuple[Any, str | None]]]] = []

    def result(self) -> Structure:
        """Return the flat structure."""
        self._visit(self.system, ())
        for way, values in self.values:
            self._give(way, values)
        wires: list[tuple[str, str, float]] = []
        for way, component in self.components.items():
            for name, (kind, _) in component.connectors.items():
                if kind == "input":
                    source, gain = self._origin((way, name))
                    if source is not None:
                        wires.append((self._name(source), f"{component.name}.{name}", gain))
        outputs = {}
        for connector in self.system.connectors:
            if connector.kind == "output":
                source, gain = self._origin(((), connector.name))
                if source is None or gain != 1.0 or source[0] not in self.components:
                    raise self._refused(
                        f"output {connector.name!r} of the system", "a plain connection to a component", "another"
                    )
                outputs[connector.name] = self._name(source)
        return Structure(tuple(self.components.values()), tuple(wires), outputs)

    def _name(self, place: Place) -> str:
        return f"{self.components[place[0]].name}.{place[1]}" if place[0] else place[1]

    def _visit(self, system: Any, way: tuple[str, ...]) -> None:
        from fmpy.ssp import ssd

        for connector in system.connectors:
            self.kinds[way, connector.name] = connector.kind
        self._bind(system, way)
        for element in system.elements:
            own = (*way, element.name)
            if isinstance(element, ssd.System):
                self._visit(element, own)
            elif isinstance(element, ssd.Component):
                kind = element.type or FMU
                source = str(element.source)
                package = source.endswith(".ssp") and kind in (*PACKAGE, FMU)
                if not package and not (source.endswith(".fmu") and kind == FMU):
                    expected = "an FMU (.fmu) or a package (.ssp)"
                    raise self._refused(f"component {element.name!r}", expected, f"{source!r}, {kind}")
                if "." in element.name or "/" in element.name:
                    raise self._refused("name of a component", "a name without '.' and '/'", repr(element.name))
                connectors = {}
                for connector in element.connectors:
                    self.kinds[own, connector.name] = connector.kind
                    if connector.kind in ("input", "output"):
                        connectors[connector.name] = (connector.kind, self.units.get((own, connector.name)))
                self.components[own] = Component("/".join(own), str(element.source), connectors)
                self._bind(element, own)
            else:
                raise self._refused(f"element {element.name!r}", "components and systems", "a signal dictionary")
        for wire in system.connections:
            self._connect(
                _end(way, wire.startElement, wire.startConnector), _end(way, wire.endElement, wire.endConnector), way
            )

    def _connect(self, start: Place, end: Place, way: tuple[str, ...]) -> None:
        """Note which end drives which; the standard lets a connection be written either way round."""
        for place in (start, end):
            if place not in self.kinds:
                raise self._refused(
                    "end of a connection", "a declared connector", repr(".".join((*place[0], place[1])))
                )
        factor, offset = self.changes.get((start, end), (1.0, 0.0))
        drives = {"output": True, "input": False}
        # seen from inside, a system's own input is a source and its output a sink
        sources = [
            drives.get(self.kinds[place], self.kinds[place] == "inout") != (place[0] == way) for place in (start, end)
        ]
        if sources[0] == sources[1]:
            raise self._refused("connection", "one source and one sink", f"{start[1]} and {end[1]}")
        source, sink = (start, end) if sources[0] else (end, start)
        if sink in self.from_of:
            raise self._refused("input driven twice", "one source", ".".join((*sink[0], sink[1])))
        if offset:
            raise self._refused("transformation of a connection", "a factor", f"an offset of {offset:g}")
        self.from_of[sink] = (source, factor)

    def _origin(self, place: Place) -> tuple[Place | None, float]:
        """Follow the wires back to a component's output or an input of the outermost system."""
        gain = 1.0
        seen = {place}
        while place in self.from_of:
            place, factor = self.from_of[place]
            gain *= factor
            if place[0] in self.components or not place[0]:
                return place, gain
            if place in seen:
                break
            seen.add(place)
        return None, gain

    def _bind(self, element: Any, way: tuple[str, ...]) -> None:
        """Collect the values of the parameter bindings; those of outer systems go first and win."""
        for binding in element.parameterBindings:
            values: dict[str, tuple[Any, str | None]] = {}
            for group in binding.parameterValues:
                for one in group.parameters:
                    values[(binding.prefix or "") + one.name] = (_value(one), one.unit)
            if binding.parameterMapping:  # then only what it maps is meant
                given, values = values, {}
                for entry in (e for mapping in binding.parameterMapping for e in mapping.mappingEntries):
                    if entry.source not in given:
                        raise self._refused("source of a parameter mapping", ", ".join(given), repr(entry.source))
                    value, unit = given[entry.source]
                    if entry.transformation is not None:
                        value = float(entry.transformation.factor) * value + float(entry.transformation.offset)
                    values[entry.target] = (value, unit)
            self.values.insert(0, (way, values))

    def _give(self, way: tuple[str, ...], values: dict[str, tuple[Any, str | None]]) -> None:
        """Hand values to the components, in SI; a system's names are ``component.parameter``."""
        for name, (value, unit) in values.items():
            target, rest = way, name
            while target not in self.components:
                head, dot, tail = rest.partition(".")
                inner = (*target, head)
                if not dot or not any(place[: len(inner)] == inner for place in self.components):
                    raise self._refused("parameter value", "a name component.parameter", repr(name))
                target, rest = inner, tail
            if unit is not None and isinstance(value, float):
                known = self.defined.get(unit)
                factor, offset = (known.factor, known.offset) if known is not None else base_units(unit)[1:]
                value = factor * value + offset
            component = self.components[target]
            kind = self.kinds.get((target, rest), "parameter")
            (component.parameters if kind in ("parameter", "structuralParameter") else component.start)[rest] = value

    def _unit(self, text: str) -> str:
        """Return what a unit measures, in our words: by its definition in the package where there is one."""
        unit = self.defined.get(text)
        if unit is None:
            return text.replace(".", " ")
        powers = [f"{name}**{getattr(unit, name)}" for name in BASE if getattr(unit, name)]
        return " * ".join(powers) or "1"

    def _refused(self, what: str, expected: str, got: str) -> InputError:
        return InputError(what, expected=expected, got=got, remedy=f"correct it in {SSD}", file=self.path, place=SSD)


def _value(parameter: Any) -> Any:
    """Return a parameter's value in its type."""
    text = parameter.value
    if parameter.type == "Real":
        return float(text)
    if parameter.type == "Integer":
        return int(text)
    if parameter.type == "Boolean":
        return text in ("true", "1")
    return text
