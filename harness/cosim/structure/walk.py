"""The walk through nested systems: components, connectors, what drives what, values that are bound on the way.

Sections are those of the SSP 2.0.1 text.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.cosim.structure.conversion import LinearConversion, Unit, change_of_unit, named_unit
from harness.cosim.structure.flat import (
    Describe,
    FlatComponent,
    Way,
    dotted,
    named,
)
from harness.cosim.structure.model import (
    Component,
    Connector,
    Element,
    ElementWire,
    Mapped,
    Reference,
    SystemDescription,
    SystemElement,
    Value,
)
from harness.errors import InputError

Place = tuple[Way, str]  # A connector: the names of the systems and the component on the way to it, and its own.

SOURCES = {"output", "local", "calculatedParameter", "constant"}
SINKS = {"input", "parameter", "structuralParameter"}
FIXED = {"parameter", "structuralParameter"}
TEXTS = {"String", "Binary"}
NO_SIGNAL = {*TEXTS, "Clock"}
DICTIONARY = "\0dictionary:"


@dataclass(frozen=True)
class Hop:
    """One connection as it arrives at its sink: the units on the way to it, what is done there, and after it."""

    source: Place
    before: tuple[Unit | None, ...]
    unit: Unit | None
    change: LinearConversion | Mapped | None
    after: tuple[Unit | None, ...]
    suppress: bool
    ends: tuple[Connector, Connector]


class Walk:
    """What a walk through the systems of a file has met."""

    def __init__(self, description: SystemDescription, describe: Describe) -> None:
        self.path, self.describe = description.path, describe
        self.notes = list(description.notes)
        self.components: dict[Way, FlatComponent] = {}
        self.connectors: dict[Place, Connector] = {}
        self.physical: dict[Place, bool] = {}  # whether the FMU itself says what a variable is measured in
        self.from_of: dict[Place, list[Hop]] = {}
        self.sums: set[Place] = set()
        self.bindings: list[tuple[Way, Value]] = []
        self.dictionaries: list[tuple[Way, dict[str, dict[str, Connector]]]] = []
        self.files: dict[Path, dict[str, Any]] = {}
        self._visit(description.system, ())

    def _visit(self, system: SystemElement, way: Way) -> None:
        self.dictionaries.append((way, system.dictionaries))
        for name, entries in system.dictionaries.items():
            for entry in entries.values():
                self.connectors[(*way, DICTIONARY + name), entry.name] = entry
        for connector in system.connectors.values():
            self.connectors[way, connector.name] = connector
        self.sums |= {(way, name) for name in system.sums}
        self.bindings += [(way, value) for binding in system.bindings for value in binding]
        elements = {element.name: element for element in system.elements}
        for element in system.elements:
            if isinstance(element, SystemElement):
                self._visit(element, (*way, element.name))
            elif isinstance(element, Component):
                self._place(element, (*way, element.name))
        for wire in system.wires:
            self._connect(wire, way, elements)
        self.dictionaries.pop()

    def _place(self, component: Component, way: Way) -> None:
        """Note an FMU, its variables and the connectors declared for them."""
        assert component.fmu is not None
        if component.fmu not in self.files:
            try:
                self.files[component.fmu] = self.describe(component.fmu)
            except InputError as error:
                raise named(error, component.name, component.fmu, self.path) from error
        about = self.files[component.fmu]
        rows = {row["name"]: row for row in about["variables"]}
        name = "/".join(way).replace(".", "_")
        if any(one.name == name for one in self.components.values()):
            name = f"{name}#{len(self.components)}"
        made = FlatComponent(name, ".".join(way), component.fmu, about, rows, component.kind, component.step)
        self.components[way] = made
        missing = []
        for declared in component.connectors.values():
            if declared.name in rows:
                self.variable(way, declared)
            else:
                missing.append(declared.name)
        if missing:
            self.notes.append(f"connectors that the FMU of {made.label!r} does not have: {', '.join(missing)}")
        self.bindings += [(way, value) for binding in component.bindings for value in binding]

    def variable(self, way: Way, declared: Connector | None, name: str = "") -> Connector:
        """Return the connector of an FMU's variable: what it is stands in the FMU, its unit where the file says it."""
        name = name if declared is None else declared.name
        row = self.components[way].rows[name]
        place = way, name
        own = None
        if row["unit"] is not None and row["scale"] is not None:
            own = named_unit(row["unit"], row["si_unit"], row["scale"], row["offset"])
        unit = own if declared is None or declared.unit is None else declared.unit
        if own is not None and unit is not None and change_of_unit(unit, own) is None:
            raise InputError(
                "unit of a connector",
                expected=f"a unit that converts to {own}, as the FMU says",
                got=str(unit),
                remedy="correct the unit in the system's file",
                file=self.path,
                place=f"{self.components[way].label}.{name}",
            )
        self.physical[place] = own is not None
        items = row.get("items") or (None if declared is None else declared.items)
        found = Connector(name, str(row["causality"]), str(row["type"]), unit, items)
        self.connectors[place] = found
        return found

    def _end(self, way: Way, element: str | None, name: str, elements: dict[str, Element]) -> tuple[Place, Connector]:
        """Return one end of a connection."""
        inner = way if element is None else (*way, element)
        place = inner, name
        if place in self.connectors:
            return place, self.connectors[place]
        if inner in self.components and name in self.components[inner].rows:
            return place, self.variable(inner, None, name)
        found = elements.get(element or "")
        if isinstance(found, Reference) and name in found.connectors:
            for owner, dictionaries in reversed(self.dictionaries):
                if found.dictionary in dictionaries:
                    return ((*owner, DICTIONARY + found.dictionary), name), found.connectors[name]
            raise self.refused(f"signal dictionary of {element!r}", "one of an enclosing system", found.dictionary)
        what = "end of a connection"
        if inner in self.components:
            what = f"component {element!r} ({self.components[inner].path.name}): end of a connection"
        raise self.refused(what, "a declared connector", repr(dotted(inner, name)))

    def _connect(self, wire: ElementWire, way: Way, elements: dict[str, Element]) -> None:
        """Note which end drives which; the standard lets a connection be written either way round (sec. 5.2.4)."""
        ends = []
        for element, name in (wire.start, wire.end):
            place, connector = self._end(way, element, name, elements)
            if place not in self.connectors:
                raise self.refused("connector of a signal dictionary", "one of its entries", repr(name))
            ends.append((place, connector, _drives(connector, own=element is None)))
        (start, first, drives), (end, second, driven) = ends
        if drives is None:
            drives = driven is None or not driven
        if driven is None:
            driven = not drives
        if drives == driven:
            both = "sources" if drives else "sinks"
            raise self.refused("connection", "one source and one sink", f"two {both}, {first.name} and {second.name}")
        if not drives:
            start, first, end, second = end, second, start, first
        self._refuse_no_signals(first, second, wire)
        if end in self.from_of and end not in self.sums:
            raise self.refused("input driven twice", "one source", dotted(*end))
        before, after = self.connectors[start].unit, self.connectors[end].unit
        self.from_of.setdefault(end, []).append(
            Hop(
                start,
                (first.unit,) if first.unit is not before else (),
                after if second.unit is None else second.unit,
                wire.change,
                (after,) if second.unit is not None and second.unit is not after else (),
                wire.suppress,
                (first, second),
            )
        )

    def _refuse_no_signals(self, first: Connector, second: Connector, wire: ElementWire) -> None:
        """Refuse clocks, and texts that become something else on their way."""
        kinds = {one.type for one in (first, second)} & NO_SIGNAL
        alike = kinds <= TEXTS and len({first.type, second.type} - {None}) == 1
        if kinds and (not alike or wire.change is not None):
            one = first if first.type in kinds else second
            expected = "a text or bytes at both ends, as they are" if alike or kinds <= TEXTS else "no clocks"
            raise self.refused("connection", expected, f"{one.name!r} of {one.type}")

    def refused(self, what: str, expected: str, got: str) -> InputError:
        """Return what is wrong with the system's file."""
        return InputError(what, expected=expected, got=got, remedy="correct it in the system's file", file=self.path)


def _drives(connector: Connector, *, own: bool) -> bool | None:
    """Return whether a connector is a source as seen from inside the system; None if it is what is needed."""
    kind = connector.kind
    if kind in ("inout", "unspecified"):
        return None
    return (kind not in SINKS) != own
