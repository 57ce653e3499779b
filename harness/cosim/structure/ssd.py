"""System structure descriptions (SSD) of SSP 1.0 and 2.0, with what they contain and refer to.

Sections are those of the SSP 2.0.1 text. Annotations and geometry are passed over; of annotations only the step and
the master of OMSimulator and of the Open Simulation Platform are taken as a suggestion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from harness.cosim.structure.conversion import BARE, LinearConversion, Unit, undefined_unit, unit_of
from harness.cosim.structure.elements import children, first, local, truth
from harness.cosim.structure.model import (
    Component,
    Connector,
    Element,
    ElementWire,
    Mapped,
    Reference,
    SystemDescription,
    SystemElement,
)
from harness.cosim.structure.package import PROXIED, Package, ZipPackage, on_this_machine, parsed
from harness.cosim.structure.values import read_bindings
from harness.errors import InputError
from harness.trust import names_fmu

SSD = "SystemStructure.ssd"
FMU = "application/x-fmu-sharedlibrary"
PACKAGE = ("application/x-ssp-package", "application/ssp+zip")
DEFINITION = "application/x-ssp-definition"
SOURCES = {"output", "local", "calculatedParameter", "constant"}
SINKS = {"input", "parameter", "structuralParameter"}
KINDS = SOURCES | SINKS | {"inout", "unspecified"}
DEEPEST = 5  # Systems of other files inside each other, before it counts as a trap.
IMPLEMENTATIONS = {"CoSimulation": "cs", "ModelExchange": "me"}
TRANSFORMATIONS = ("BooleanMapping", "IntegerMapping", "EnumerationMapping")


@dataclass
class SsdReader:
    """Reads one file, and those that it refers to; ``opened`` are the packages inside, for the caller to close."""

    package: Package
    name: str = SSD
    depth: int = 1
    opened: list[Package] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    units: dict[str, Unit] = field(default_factory=dict)
    enumerations: dict[str, dict[str, int]] = field(default_factory=dict)

    def read(self) -> SystemDescription:
        """Return the structure that the file declares.

        Raises InputError if it breaks the standard, or uses what is not understood.
        """
        root = parsed(self.package, self.name)
        if local(root) != "SystemStructureDescription":
            raise self.refused("root element", "SystemStructureDescription", local(root))
        if self.need(root, "version") not in ("1.0", "1.1", "2.0"):
            raise self.refused("version of SSP", "1.0 or 2.0", repr(root.get("version")))
        self.root = root
        self.units = self.defined_units(root)
        self.enumerations = self.defined_items(root)
        top = first(root, "System")
        if top is None:
            raise self.refused("system", "a System", "none")
        found = SystemDescription(self.package.path, root.get("name") or self.name, self.system(top), notes=self.notes)
        experiment = first(root, "DefaultExperiment")
        if experiment is not None:
            found.start, found.stop = (self.number(experiment, key) for key in ("startTime", "stopTime"))
        found.step, found.exchange = suggested(root)
        return found

    def system(self, element: Any, name: str | None = None) -> SystemElement:
        """Return a system and all inside."""
        elements: list[Element] = []
        for child in children(element, "Elements", "Component"):
            elements.append(self.component(child))
        for child in children(element, "Elements", "System"):
            elements.append(self.system(child))
        for child in children(element, "Elements", "SignalDictionaryReference"):
            own = self.need(child, "name")
            elements.append(Reference(own, self.connectors(child), [], self.need(child, "dictionary")))
        own = element.get("name") or "" if name is None else name
        names = [one.name for one in elements]
        if twice := next((one for one in names if names.count(one) > 1), None):
            raise self.refused(f"elements of system {own!r}", "different names", f"{twice!r} twice")
        dictionaries = {}
        for child in children(element, "SignalDictionaries", "SignalDictionary"):
            dictionaries[self.need(child, "name")] = self.dictionary(child)
        wires = [self.wire(child) for child in children(element, "Connections", "Connection")]
        return SystemElement(
            own, self.connectors(element), read_bindings(self, element, None), elements, wires, dictionaries
        )

    def component(self, element: Any) -> Element:
        """Return a component: an FMU, or the system of another file or of another place in this one."""
        name = self.need(element, "name")
        source, kind = element.get("source"), (element.get("type") or FMU).partition(";")[0].strip()
        connectors = self.connectors(element)
        if source is None:
            self.notes.append(f"component {name!r} has no implementation: what it drives rests at its start value")
            return SystemElement(name, connectors, read_bindings(self, element, None))
        given, source = source, on_this_machine(source)
        if source != given and PROXIED not in self.notes:
            self.notes.append(PROXIED)
        uri = urlparse(source)
        if not uri.path and uri.fragment:
            return self._joined(element, name, connectors, self._same_file(uri.fragment, name))
        package = uri.path.lower().endswith(".ssp") and kind in (*PACKAGE, FMU)
        definition = uri.path.lower().endswith(".ssd") and kind in (DEFINITION, FMU)
        if not (package or definition or (names_fmu(uri.path) and kind == FMU)):
            raise self.refused(
                f"component {name!r}", "an FMU (.fmu), a package (.ssp) or a system (.ssd)", f"{source!r}, {kind}"
            )
        inside = self.package.named(source, self.name, f"component {name!r}")
        if package or definition:
            return self._joined(element, name, connectors, self._other_file(name, inside, uri.fragment, package))
        chosen = element.get("implementation") or "any"
        if chosen not in (*IMPLEMENTATIONS, "any"):
            raise self.refused(f"implementation of component {name!r}", ", ".join(IMPLEMENTATIONS), repr(chosen))
        place = self.package.file(inside)
        bindings = read_bindings(self, element, place)
        return Component(name, connectors, bindings, place, source, IMPLEMENTATIONS.get(chosen))

    def _joined(self, element: Any, name: str, connectors: dict[str, Connector], inner: SystemElement) -> SystemElement:
        """Return a system in place of a component; the component's bindings count after its own (sec. 5.2.2)."""
        return replace(
            inner,
            name=name,
            connectors={**connectors, **inner.connectors},
            bindings=[*inner.bindings, *read_bindings(self, element, None)],
        )

    def _same_file(self, fragment: str, name: str) -> SystemElement:
        self._deeper(name)
        found = next((e for e in self.root.iter() if local(e) == "System" and e.get("id") == fragment), None)
        if found is None:
            raise self.refused(f"component {name!r}", "the id of a system in this file", f"#{fragment}")
        self.depth += 1
        try:
            return self.system(found)
        finally:
            self.depth -= 1

    def _other_file(self, name: str, inside: str, fragment: str, package: bool) -> SystemElement:
        self._deeper(name)
        source: Package = self.package
        if package:
            source = ZipPackage(self.package.file(inside))
            self.opened.append(source)
        file = (fragment or SSD) if package else inside
        if package and not source.has(file):
            raise self.refused(f"component {name!r}", f"{file} in {inside}", "none")
        try:
            return SsdReader(source, file, self.depth + 1, self.opened, self.notes).read().system
        except InputError as error:  # the unpacked package is gone when the user reads this
            raise InputError(
                f"component {name!r} ({Path(inside).name}): {error.what}",
                expected=error.expected,
                got=error.got,
                remedy=error.remedy,
                file=self.package.path,
                place=error.place,
            ) from error

    def _deeper(self, name: str) -> None:
        if self.depth >= DEEPEST:
            raise InputError(
                "packages inside packages",
                expected=f"at most {DEEPEST}, one in another",
                got=f"more, at component {name!r}",
                remedy="do not trust it",
                file=self.package.path,
            )

    def connectors(self, element: Any) -> dict[str, Connector]:
        """Return the connectors of an element."""
        found: dict[str, Connector] = {}
        for child in children(element, "Connectors", "Connector"):
            one = self.connector(child, child.get("kind") or "unspecified")
            if one.kind not in KINDS:
                raise self.refused(f"kind of connector {one.name!r}", ", ".join(sorted(KINDS)), repr(one.kind))
            found[one.name] = one
        return found

    def connector(self, element: Any, kind: str) -> Connector:
        """Return a connector or a dictionary entry with its type."""
        name = self.need(element, "name")
        for child in element:
            word = local(child)
            if word in ("Annotations", "ConnectorGeometry", "Dimension", "MetaData", "Signature"):
                continue
            if word == "Clock" and child.get("name") is not None:  # names a clock; is no type
                continue
            unit, items = child.get("unit"), None
            if word == "Enumeration":
                items = self.enumerations.get(child.get("name") or "")
            return Connector(name, kind, word, None if unit is None else self.unit(unit, self.units), items)
        return Connector(name, kind)

    def dictionary(self, element: Any) -> dict[str, Connector]:
        """Return the entries of a signal dictionary, written here or in a file of its own (SSB)."""
        source = element.get("source")
        content = first(element, "SignalDictionary")
        if source is not None:
            file = self.package.named(source, self.name, f"signal dictionary {element.get('name')!r}")
            content = parsed(self.package, file)
        scope = SsdReader(self.package, self.name, notes=self.notes)
        scope.units = {**self.units, **self.defined_units(content)} if content is not None else self.units
        scope.enumerations = {**self.enumerations, **(self.defined_items(content) if content is not None else {})}
        return {entry.get("name"): scope.connector(entry, "inout") for entry in children(content, "DictionaryEntry")}

    def wire(self, element: Any) -> ElementWire:
        """Return a connection."""
        # OMSimulator writes an empty name for the system itself
        start = element.get("startElement") or None, self.need(element, "startConnector")
        end = element.get("endElement") or None, self.need(element, "endConnector")
        if element.get("startIndices") is not None or element.get("endIndices") is not None:
            raise self.refused(
                f"connection of {start[1]} and {end[1]}",
                "whole arrays (the standard does not say whether indices count from 0 or from 1)",
                "startIndices or endIndices",
            )
        return ElementWire(start, end, self.change(element), truth(element.get("suppressUnitConversion")))

    def change(self, element: Any) -> LinearConversion | Mapped | None:
        """Return the transformation of a connection or a mapping entry."""
        for child in element:
            word = local(child)
            if word == "LinearTransformation":
                factor, offset = self.number(child, "factor"), self.number(child, "offset")
                made = LinearConversion(1.0 if factor is None else factor, 0.0 if offset is None else offset)
                if not (math.isfinite(made.factor) and math.isfinite(made.offset)):
                    raise self.refused(word, "finite numbers", f"{made.factor:g}, {made.offset:g}")
                return made
            if word.removesuffix("Transformation") in TRANSFORMATIONS:
                entries = [(self.need(e, "source"), self.need(e, "target")) for e in children(child, "MapEntry")]
                if len({source for source, _ in entries}) < len(entries):
                    raise self.refused(word, "one entry for each source", "a source twice")
                return Mapped(word.partition("Mapping")[0], tuple(entries))
        return None

    def unit(self, text: str, units: dict[str, Unit]) -> Unit | None:
        """Return the unit that a name means in this file; None for a bare number."""
        if text.strip() in BARE:
            return None
        if text in units:
            return units[text]
        found = undefined_unit(text)
        means = "taken by its name" if found is not None else "numbers are taken as they are"
        said = f"unit {text!r} is not defined in {self.name}: {means}"
        if said not in self.notes:
            self.notes.append(said)
        return found

    def defined_units(self, element: Any) -> dict[str, Unit]:
        """Return the units that a file defines."""
        found = {}
        for child in children(element, "Units", "Unit"):
            base = first(child, "BaseUnit")
            powers, factor, offset = {}, 1.0, 0.0
            if base is not None:
                powers = {n: self.number(base, n) or 0.0 for n in base.attrib if n not in ("factor", "offset")}
                given, shift = self.number(base, "factor"), self.number(base, "offset")
                factor, offset = (1.0 if given is None else given), (0.0 if shift is None else shift)
            if factor == 0 or not (math.isfinite(factor) and math.isfinite(offset)):
                raise self.refused(f"unit {child.get('name')!r}", "a finite factor that is not 0", f"{factor:g}")
            name = self.need(child, "name")
            found[name] = unit_of(name, powers, factor, offset)
        return found

    def defined_items(self, element: Any) -> dict[str, dict[str, int]]:
        """Return the enumerations that a file defines."""
        found: dict[str, dict[str, int]] = {}
        for child in children(element, "Enumerations", "Enumeration"):
            items = found.setdefault(self.need(child, "name"), {})
            for item in children(child, "Item"):
                value = self.number(item, "value")
                if value is None or not value.is_integer():
                    raise self.refused(f"item of {child.get('name')!r}", "a whole number", repr(item.get("value")))
                items[self.need(item, "name")] = int(value)
        return found

    def number(self, element: Any, name: str) -> float | None:
        """Return a number, None where there is none."""
        text = element.get(name)
        try:
            value = None if text is None else float(text)
        except ValueError:
            raise self.refused(f"{name} of {local(element)}", "a number", repr(text)) from None
        if value is not None and math.isnan(value):
            raise self.refused(f"{name} of {local(element)}", "a number", repr(text))
        return value

    def need(self, element: Any, name: str) -> str:
        """Return an attribute that the standard requires."""
        text: str | None = element.get(name)
        if text is None:
            raise self.refused(local(element), f"the attribute {name}", "none")
        return text

    def refused(self, what: str, expected: str, got: str) -> InputError:
        """Return the error for something in this file."""
        return InputError(
            what,
            expected=expected,
            got=got,
            remedy=f"correct it in {self.name}",
            file=self.package.path,
            place=self.name,
        )


def suggested(root: Any) -> tuple[float | None, str | None]:
    """Return the step [s] and the exchange of the tool that wrote a file, from its annotations."""
    for element in root.iter():
        word = local(element)
        text = element.get("stepSize" if word == "FixedStepMaster" else "baseStepSize")
        if word in ("FixedStepMaster", "FixedStepAlgorithm") and text is not None:
            try:
                step = float(text)
            except ValueError:
                continue
            if step > 0:
                return step, "jacobi"  # both let every component step with the values of the last instant
    return None, None
