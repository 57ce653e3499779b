"""A system laid flat: its FMUs with the values that they start from, and the wires between them.

Numbers on wires are those of the connectors, in the connectors' units; each wire ends as one chain from SI to SI.
Sections are those of the SSP 2.0.1 text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.cosim.structure.conversion import Chain, Linear, Table, Unit, change_of_unit, named_unit
from harness.cosim.structure.flat import (
    REALS,
    Describe,
    FlatComponent,
    FlatInput,
    FlatOutput,
    FlatSystem,
    FlatWire,
    Way,
    channels_of,
    dotted,
    each,
    members,
    named,
    start_of,
)
from harness.cosim.structure.model import (
    Component,
    Connector,
    Description,
    Element,
    Mapped,
    Reference,
    System,
    Value,
    Wire,
)
from harness.errors import InputError

__all__ = ["flatten"]

Place = tuple[Way, str]
"""A connector: the names of the systems and the component on the way to it, and its own."""

SOURCES = {"output", "local", "calculatedParameter", "constant"}
SINKS = {"input", "parameter", "structuralParameter"}
FIXED = {"parameter", "structuralParameter"}
TEXTS = {"String", "Binary"}
NO_SIGNAL = {*TEXTS, "Clock"}
DICTIONARY = "\0dictionary:"


@dataclass(frozen=True)
class _Hop:
    """One connection as it arrives at its sink: the units on the way to it, what is done there, and after it."""

    source: Place
    before: tuple[Unit | None, ...]
    unit: Unit | None
    change: Linear | Mapped | None
    after: tuple[Unit | None, ...]
    suppress: bool
    ends: tuple[Connector, Connector]


@dataclass(frozen=True)
class _Term:
    """A part of what arrives somewhere: where it comes from, what became of it, and the unit it is in."""

    origin: Place
    chain: Chain
    unit: Unit | None
    extra: bool = False


def flatten(description: Description, describe: Describe, *, parameters: dict[str, Any] | None = None) -> FlatSystem:
    """Return a system laid flat.

    Parameters
    ----------
    description : Description
        What the file says.
    describe : callable
        Tells what is in an FMU.
    parameters : dict, optional
        Values by hierarchical name in SI, which go before those of the file.

    Raises
    ------
    InputError
        If the system breaks the standard, or needs what is not understood here.
    """
    return _Flattening(description, describe).result(parameters or {})


class _Flattening:
    """The walk through the systems."""

    def __init__(self, description: Description, describe: Describe) -> None:
        self.path, self.top, self.describe = description.path, description.system, describe
        self.notes = list(description.notes)
        self.components: dict[Way, FlatComponent] = {}
        self.connectors: dict[Place, Connector] = {}
        self.physical: dict[Place, bool] = {}  # whether the FMU itself says what a variable is measured in
        self.from_of: dict[Place, list[_Hop]] = {}
        self.sums: set[Place] = set()
        self.bindings: list[tuple[Way, Value]] = []
        self.values: dict[Place, tuple[Any, Unit | None]] = {}
        self.inferred: dict[Place, list[Unit]] = {}
        self.known: dict[Place, list[_Term]] = {}
        self.dictionaries: list[tuple[Way, dict[str, dict[str, Connector]]]] = []
        self.files: dict[Path, dict[str, Any]] = {}

    def result(self, parameters: dict[str, Any]) -> FlatSystem:
        """Return the flat system."""
        self._visit(self.top, ())
        self._bind(parameters)
        wires: list[FlatWire] = []
        for place in [one for one in self.from_of if one[0] in self.components]:
            wires += self._wires_to(place)
        inputs = self._inputs(wires)
        outputs = self._outputs() or self._everything()
        order = {name: at for at, name in enumerate(one.name for one in inputs)}
        return FlatSystem(
            list(self.components.values()),
            [self._from_outside(wire) if wire.source in order else wire for wire in wires],
            inputs,
            [self._shown_from_outside(one) if one.source in order else one for one in outputs],
            self.notes,
        )

    # the walk

    def _visit(self, system: System, way: Way) -> None:
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
            if isinstance(element, System):
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
                self._variable(way, declared)
            else:
                missing.append(declared.name)
        if missing:
            self.notes.append(f"connectors that the FMU of {made.label!r} does not have: {', '.join(missing)}")
        self.bindings += [(way, value) for binding in component.bindings for value in binding]

    def _variable(self, way: Way, declared: Connector | None, name: str = "") -> Connector:
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
            return place, self._variable(inner, None, name)
        found = elements.get(element or "")
        if isinstance(found, Reference) and name in found.connectors:
            for owner, dictionaries in reversed(self.dictionaries):
                if found.dictionary in dictionaries:
                    return ((*owner, DICTIONARY + found.dictionary), name), found.connectors[name]
            raise self._refused(f"signal dictionary of {element!r}", "one of an enclosing system", found.dictionary)
        what = "end of a connection"
        if inner in self.components:
            what = f"component {element!r} ({self.components[inner].path.name}): end of a connection"
        raise self._refused(what, "a declared connector", repr(dotted(inner, name)))

    def _connect(self, wire: Wire, way: Way, elements: dict[str, Element]) -> None:
        """Note which end drives which; the standard lets a connection be written either way round (sec. 5.2.4)."""
        ends = []
        for element, name in (wire.start, wire.end):
            place, connector = self._end(way, element, name, elements)
            if place not in self.connectors:
                raise self._refused("connector of a signal dictionary", "one of its entries", repr(name))
            ends.append((place, connector, _drives(connector, own=element is None)))
        (start, first, drives), (end, second, driven) = ends
        if drives is None:
            drives = driven is None or not driven
        if driven is None:
            driven = not drives
        if drives == driven:
            both = "sources" if drives else "sinks"
            raise self._refused("connection", "one source and one sink", f"two {both}, {first.name} and {second.name}")
        if not drives:
            start, first, end, second = end, second, start, first
        self._refuse_no_signals(first, second, wire)
        if end in self.from_of and end not in self.sums:
            raise self._refused("input driven twice", "one source", dotted(*end))
        before, after = self.connectors[start].unit, self.connectors[end].unit
        self.from_of.setdefault(end, []).append(
            _Hop(
                start,
                (first.unit,) if first.unit is not before else (),
                after if second.unit is None else second.unit,
                wire.change,
                (after,) if second.unit is not None and second.unit is not after else (),
                wire.suppress,
                (first, second),
            )
        )

    def _refuse_no_signals(self, first: Connector, second: Connector, wire: Wire) -> None:
        """Refuse clocks, and texts that become something else on their way."""
        kinds = {one.type for one in (first, second)} & NO_SIGNAL
        alike = kinds <= TEXTS and len({first.type, second.type} - {None}) == 1
        if kinds and (not alike or wire.change is not None):
            one = first if first.type in kinds else second
            expected = "a text or bytes at both ends, as they are" if alike or kinds <= TEXTS else "no clocks"
            raise self._refused("connection", expected, f"{one.name!r} of {one.type}")

    # what arrives where

    def _arriving(self, place: Place) -> list[_Term]:
        """Return what arrives at, or comes out of, a connector."""
        if place not in self.known:
            self.known[place] = []  # what feeds itself through connectors alone carries nothing
            self.known[place] = self._terms(place)
        return self.known[place]

    def _terms(self, place: Place) -> list[_Term]:
        way, _ = place
        unit = self.connectors[place].unit
        if place not in self.from_of:
            chain = Chain()
            if way in self.components and self.physical[place] and unit is not None:
                chain = chain.then(unit.from_si)
            return [_Term(place, chain, unit)]
        found = [self._through(term, hop) for hop in self.from_of[place] for term in self._arriving(hop.source)]
        if place in self.sums:  # what is added later on counts once
            found = [
                term if at == 0 else _Term(term.origin, term.chain, term.unit, True) for at, term in enumerate(found)
            ]
        return found

    def _through(self, term: _Term, hop: _Hop) -> _Term:
        """Return a term after one connection: first units, then the transformation (sec. 4.4.2)."""
        for unit in (*hop.before, hop.unit):
            term = self._in_unit(term, unit, hop)
        if isinstance(hop.change, Linear):
            for end in hop.ends:
                if end.type not in (*REALS, None):
                    raise self._refused(
                        "LinearTransformation", "real numbers at both ends", f"{end.name!r}: {end.type}"
                    )
            term = self._step(term, hop.change)
        elif hop.change is not None:
            term = self._step(term, self._table(hop.change, *hop.ends))
        for unit in hop.after:
            term = self._in_unit(term, unit, hop)
        return term

    def _in_unit(self, term: _Term, unit: Unit | None, hop: _Hop) -> _Term:
        """Return a term in another unit; where one side says none, the number goes through as it is."""
        if unit is None:
            return term
        if term.unit is None and term.chain == Chain():
            self.inferred.setdefault(term.origin, []).append(unit)
        if term.unit is None or hop.suppress:
            return _Term(term.origin, term.chain, unit, term.extra)
        change = change_of_unit(term.unit, unit)
        if change is None:
            raise InputError(
                "units of a connection",
                expected=f"a source in a unit that converts to {unit}",
                got=str(term.unit),
                remedy="correct the units, or set suppressUnitConversion in the system's file",
                file=self.path,
                place=f"{dotted(*hop.source)} -> {hop.ends[1].name}",
            )
        after = self._step(term, change)
        return _Term(term.origin, after.chain, unit, term.extra)

    def _step(self, term: _Term, step: Linear | Table) -> _Term:
        if term.extra and isinstance(step, Linear):
            step = Linear(step.factor)
        elif term.extra:
            raise self._refused("sum", "linear transformations after it", "a table")
        return _Term(term.origin, term.chain.then(step), term.unit, term.extra)

    def _table(self, change: Mapped, source: Connector, target: Connector) -> Table:
        """Return the numbers of a mapping transformation."""
        for end in (source, target):
            if end.type in REALS:
                raise self._refused(
                    f"{change.kind}MappingTransformation", "no real numbers", f"{end.name!r}: {end.type}"
                )
        numbers: list[tuple[float, float]] = []
        for one, other in change.entries:
            numbers.append((self._item(change.kind, one, source), self._item(change.kind, other, target)))
        return Table(tuple(numbers))

    def _item(self, kind: str, text: str, end: Connector) -> float:
        """Return the number that an entry of a mapping stands for."""
        if kind == "Boolean" and text.strip() in ("true", "1", "false", "0"):
            return float(text.strip() in ("true", "1"))
        if kind == "Enumeration":
            if end.items is not None and text in end.items:
                return float(end.items[text])
            known = ", ".join(end.items or ()) or "an enumeration"
            raise self._refused(f"entry of a mapping at {end.name!r}", known, repr(text))
        try:
            return float(int(text))
        except ValueError:
            raise self._refused(f"entry of a mapping at {end.name!r}", f"a value of {kind}", repr(text)) from None

    # the flat wires

    def _wires_to(self, place: Place) -> list[FlatWire]:
        """Return the wires that end at a variable of an FMU; what never changes becomes its value instead."""
        way, name = place
        component, row = self.components[way], self.components[way].rows[name]
        unit = self.connectors[place].unit
        found: list[FlatWire] = []
        terms = [term for term in self._arriving(place) if term.origin != place]
        if row["type"] in TEXTS:
            return self._texts_to(place, terms)
        for term in terms:
            chain = term.chain
            if self.physical[place] and unit is not None:
                chain = self._step(term, unit.to_si).chain
            origin_way, origin_name = term.origin
            fixed = self._is_fixed(term.origin)
            if fixed and term.origin in self.values:
                self._set(component, row, each(self._number(term.origin), chain))
            elif not fixed and row["causality"] in FIXED:
                raise self._refused(
                    f"parameter {dotted(way, name)!r}", "a value that is known at the start", dotted(*term.origin)
                )
            elif not fixed:
                if name not in component.inputs:
                    component.inputs.append(name)
                for source, target in self._pairs(term.origin, place):
                    found.append(FlatWire(source, target, chain, len(terms) > 1))
                if origin_way in self.components and origin_name not in self.components[origin_way].outputs:
                    self.components[origin_way].outputs.append(origin_name)
        return found

    def _texts_to(self, place: Place, terms: Sequence[_Term]) -> list[FlatWire]:
        """Return the wires that carry texts to a variable of an FMU; what comes from outside is its start value."""
        way, name = place
        component, found = self.components[way], []
        if component.rows[name]["shape"]:
            raise self._refused("connection of a text", "one text", f"the array {dotted(*place)}")
        for term in terms:
            origin_way, origin_name = term.origin
            if origin_way in self.components:
                found.append(
                    FlatWire(f"{self.components[origin_way].name}.{origin_name}", f"{component.name}.{name}", Chain())
                )
            elif term.origin in self.values:
                self._set(component, component.rows[name], self.values[term.origin][0])
        return found

    def _is_fixed(self, origin: Place) -> bool:
        """Return True for a connector that nothing drives while the system runs."""
        way, _ = origin
        if way in self.components:
            return False
        return bool(way) or self.connectors[origin].kind in FIXED

    def _pairs(self, source: Place, sink: Place) -> list[tuple[str, str]]:
        """Return the channels of two ends, one to one."""
        into = self._channels(sink)
        outof = self._channels(source) if source[0] in self.components else members(source[1], len(into))
        if len(into) != len(outof):
            raise self._refused(
                f"connection to {dotted(*sink)}", f"{len(into)} values", f"{len(outof)} of {dotted(*source)}"
            )
        return list(zip(outof, into, strict=True))

    def _channels(self, place: Place) -> list[str]:
        """Return the channels of a variable of an FMU, as ``component.channel``."""
        component = self.components[place[0]]
        return [f"{component.name}.{one}" for one in channels_of(place[1], component.rows[place[1]]["shape"])]

    def _inputs(self, wires: Sequence[FlatWire]) -> list[FlatInput]:
        """Return the inputs of the whole: those of its connectors that reach an FMU or an output."""
        used = {wire.source for wire in wires}
        ways = {term.origin for place in self.from_of if not place[0] for term in self._arriving(place)}
        found = []
        for (way, name), connector in self.connectors.items():
            if way or connector.kind in (*FIXED, *SOURCES) or ((), name) in self.from_of or connector.type in TEXTS:
                continue
            members = [one for one in used if one == name or one.startswith(f"{name}[")]
            if not members and ((), name) in ways:
                members = [name]
            unit = self._outer_unit(((), name))
            given = self.values.get(((), name))
            for at, member in enumerate(sorted(members, key=lambda one: [wire.source for wire in wires].index(one))):
                if given is not None:
                    values = np.ravel(np.asarray(given[0], dtype=float))
                    start = float(values[min(at, len(values) - 1)])
                    start = start if unit is None else unit.to_si(start)
                else:
                    start = self._start_of(member, wires, unit)
                found.append(FlatInput(member, "1" if unit is None else unit.si, start, connector.type))
        return found

    def _outer_unit(self, place: Place) -> Unit | None:
        """Return the unit of a connector of the whole: its own, or that of what it is wired to where that is one."""
        unit = self.connectors[place].unit
        if unit is not None:
            return unit
        found = self.inferred.get(place, [])
        if found and all(found[0].same_as(one) for one in found):
            return found[0]
        if found:
            texts = " and ".join(sorted({one.text for one in found}))
            self.notes.append(f"{dotted(*place)} drives {texts}: its numbers are taken as they are")
        return None

    def _start_of(self, member: str, wires: Sequence[FlatWire], unit: Unit | None) -> float:
        """Return the start value in SI that an input takes over from the first FMU it drives."""
        wire = next((one for one in wires if one.source == member), None)
        if wire is None:
            return 0.0
        part, _, channel = wire.target.partition(".")
        component = next(one for one in self.components.values() if one.name == part)
        name = channel if channel in component.rows else channel.rpartition("[")[0]
        row = component.rows[name]
        value = component.start.get(name)
        if value is None:
            value = start_of(row)
        line = wire.chain.linear
        if isinstance(value, bool):
            value = float(value)
        if not isinstance(value, int | float) or line is None or line.factor == 0:
            return 0.0
        number = (value - line.offset) / line.factor
        return number if unit is None else unit.to_si(number)

    def _from_outside(self, wire: FlatWire) -> FlatWire:
        """Return a wire from an input of the whole, whose channel is in SI."""
        return FlatWire(wire.source, wire.target, self._after_si(wire.source, wire.chain), wire.add)

    def _shown_from_outside(self, one: FlatOutput) -> FlatOutput:
        return FlatOutput(one.name, one.source, self._after_si(one.source, one.chain), one.unit)

    def _after_si(self, source: str, chain: Chain) -> Chain:
        name = source if ((), source) in self.connectors else source.rpartition("[")[0]
        unit = self._outer_unit(((), name))
        made = Chain() if unit is None else Chain().then(unit.from_si)
        for step in chain.steps:
            made = made.then(step)
        return made

    def _outputs(self) -> list[FlatOutput]:
        """Return the outputs of the outermost system."""
        found, silent, texts = [], [], []
        for (way, name), connector in self.connectors.items():
            if way or ((), name) not in self.from_of:
                if not way and connector.kind == "output":
                    silent.append(name)
                continue
            terms = self._arriving(((), name))
            moving = [term for term in terms if not self._is_fixed(term.origin)]
            if len(terms) != 1 or not moving:
                silent.append(name)
                continue
            term = moving[0]
            origin_way, origin_name = term.origin
            if connector.type in TEXTS or self.connectors[term.origin].type in TEXTS:
                texts.append(name)
                continue
            unit = connector.unit or term.unit
            chain = term.chain if unit is None else self._step(term, unit.to_si).chain
            if origin_way in self.components:
                component = self.components[origin_way]
                if origin_name not in component.outputs:
                    component.outputs.append(origin_name)
                sources = self._channels(term.origin)
                plain = chain == Chain() and self.physical[term.origin]
            else:
                sources, plain = [origin_name], False
            for label, source in zip(members(name, len(sources)), sources, strict=True):
                found.append(FlatOutput(label, source, chain, None if plain else "1" if unit is None else unit.si))
        if texts:
            self.notes.append(f"texts and bytes are carried but not recorded: {', '.join(texts)}")
        if silent:
            self.notes.append(f"outputs of the system that nothing drives: {', '.join(silent)}")
        return found

    def _everything(self) -> list[FlatOutput]:
        """Return the outputs of all FMUs, for a system that shows none itself."""
        found = []
        for way, component in self.components.items():
            names = [n for n, row in component.rows.items() if row["causality"] == "output" and not row["alias"]]
            names = [name for name in names if component.rows[name]["type"] not in NO_SIGNAL]
            component.outputs += [name for name in names if name not in component.outputs]
            for name in names:
                for channel in self._channels((way, name)):
                    label = f"{component.label}.{channel.partition('.')[2]}"
                    found.append(FlatOutput(label, channel, Chain(), None))
        return found

    # the values

    def _bind(self, parameters: dict[str, Any]) -> None:
        """Hand out values: those of outer systems and later bindings go last and win (sec. 5.2.2)."""
        unheard: dict[str, None] = {}
        for way, value in sorted(self.bindings, key=lambda one: -len(one[0])):
            if not self._give(way, value, given=False):
                unheard[dotted(way, value.name)] = None
        for name, content in parameters.items():
            if not self._give((), Value(name, content), given=True):
                known = [f"{c.label}.{n}" for c in self.components.values() for n in c.rows]
                raise self._refused(f"parameter {name!r}", "COMPONENT.NAME" if len(known) > 9 else ", ".join(known), "")
        if unheard:
            listed = ", ".join(list(unheard)[:8]) + (", ..." if len(unheard) > 8 else "")
            self.notes.append(f"values that name nothing in the system, passed over as the standard says: {listed}")

    def _give(self, way: Way, value: Value, *, given: bool) -> bool:
        """Set every variable of a name (several may share it); returns whether there is one."""
        hits = 0
        for place, connector in list(self.connectors.items()):
            if place[0] in self.components or place[0][: len(way)] != way or DICTIONARY in "".join(place[0]):
                continue
            if dotted(place[0][len(way) :], place[1]) == value.name:
                unit = connector.unit or value.unit
                content = value.value if not given or unit is None else each(value.value, Chain().then(unit.from_si))
                landed = self._landed(value, content, connector, unit)
                self.values[place] = (landed, unit)
                hits += 1
        for inner, component in self.components.items():
            if inner[: len(way)] != way:
                continue
            head = "".join(f"{name}." for name in inner[len(way) :])
            name = value.name.removeprefix(head)
            if not value.name.startswith(head) or name not in component.rows:
                continue
            place, row = (inner, name), component.rows[name]
            connector = self.connectors.get(place) or self._variable(inner, None, name)
            if given:
                self._set(component, row, value.value)
            else:
                landed = self._landed(value, value.value, connector, connector.unit)
                if self.physical[place] and connector.unit is not None:
                    landed = each(landed, Chain().then(connector.unit.to_si))
                self._set(component, row, landed)
            hits += 1
        return hits > 0

    def _landed(self, value: Value, content: Any, target: Connector, unit: Unit | None) -> Any:
        """Return a value at its target: units first, then the transformation (sec. 7.1)."""
        if value.unit is not None and unit is not None and not value.suppress:
            change = change_of_unit(value.unit, unit)
            if change is None:
                raise self._refused(
                    f"unit of parameter {value.name!r}", f"one that converts to {unit}", str(value.unit)
                )
            content = each(content, Chain().then(change))
        if isinstance(value.change, Linear):
            if target.type not in (*REALS, None):
                raise self._refused("LinearTransformation", "a real number", f"{value.name!r}: {target.type}")
            return each(content, Chain().then(value.change))
        if value.change is not None:
            return self._mapped(value.change, content, target)
        return content

    def _mapped(self, change: Mapped, content: Any, target: Connector) -> Any:
        """Return a parameter's value after a mapping transformation."""
        if isinstance(content, list):
            return [self._mapped(change, one, target) for one in content]
        if isinstance(content, str) or change.kind == "Enumeration":
            return dict(change.entries).get(str(content), content)
        source = Connector(target.name, "", None, None, target.items)
        found = self._table(change, source, source)(float(content))
        return bool(found) if isinstance(content, bool) else int(found) if isinstance(content, int) else found

    def _number(self, place: Place) -> Any:
        """Return the value of a connector; an item of an enumeration as its number where it is known."""
        content, _ = self.values[place]
        items = self.connectors[place].items
        return items[content] if isinstance(content, str) and items and content in items else content

    def _set(self, component: FlatComponent, row: dict[str, Any], value: Any) -> None:
        group = component.parameters if row["causality"] in FIXED else component.start
        if row["type"] in REALS or not isinstance(value, float) or not value.is_integer():
            group[row["name"]] = value
        else:
            group[row["name"]] = int(value)

    def _refused(self, what: str, expected: str, got: str) -> InputError:
        return InputError(what, expected=expected, got=got, remedy="correct it in the system's file", file=self.path)


def _drives(connector: Connector, *, own: bool) -> bool | None:
    """Return whether a connector is a source as seen from inside the system; None if it is what is needed."""
    kind = connector.kind
    if kind in ("inout", "unspecified"):
        return None
    return (kind not in SINKS) != own
