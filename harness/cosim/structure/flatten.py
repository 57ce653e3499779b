"""A system laid flat: its FMUs with the values that they start from, and the wires between them.

Numbers on wires are those of the connectors, in the connectors' units; each wire ends as one chain from SI to SI.
Sections are those of the SSP 2.0.1 text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from harness.cosim.structure.arriving import Arriving, Term
from harness.cosim.structure.binding import Bound
from harness.cosim.structure.conversion import Chain, Unit
from harness.cosim.structure.flat import (
    Describe,
    FlatInput,
    FlatOutput,
    FlatSystem,
    FlatWire,
    channels_of,
    dotted,
    each,
    members,
    start_of,
)
from harness.cosim.structure.model import SystemDescription
from harness.cosim.structure.walk import FIXED, NO_SIGNAL, SOURCES, TEXTS, Place, Walk

Led = TypeVar("Led", FlatWire, FlatOutput)


def flatten(
    description: SystemDescription, describe: Describe, *, parameters: dict[str, Any] | None = None
) -> FlatSystem:
    """Return a system laid flat.

    Raises InputError if the system breaks the standard, or needs what is not understood here.

    - ``description``: what the file says
    - ``describe``: tells what is in an FMU
    - ``parameters``: values by hierarchical name in SI, which go before those of the file
    """
    return _Flattening(description, describe).result(parameters or {})


class _Flattening:
    """The wires, inputs and outputs of the whole."""

    def __init__(self, description: SystemDescription, describe: Describe) -> None:
        self.walk = Walk(description, describe)
        self.arriving = Arriving(self.walk)
        self.bound = Bound(self.walk, self.arriving)

    def result(self, parameters: dict[str, Any]) -> FlatSystem:
        """Return the flat system."""
        self.bound.bind(parameters)
        wires: list[FlatWire] = []
        for place in [one for one in self.walk.from_of if one[0] in self.walk.components]:
            wires += self._wires_to(place)
        inputs = self._inputs(wires)
        outputs = self._outputs() or self._everything()
        order = {name: at for at, name in enumerate(one.name for one in inputs)}
        return FlatSystem(
            list(self.walk.components.values()),
            [self._from_outside(one) if one.source in order else one for one in wires],
            inputs,
            [self._from_outside(one) if one.source in order else one for one in outputs],
            self.walk.notes,
        )

    def _wires_to(self, place: Place) -> list[FlatWire]:
        """Return the wires that end at a variable of an FMU; what never changes becomes its value instead."""
        way, name = place
        component, row = self.walk.components[way], self.walk.components[way].rows[name]
        unit = self.walk.connectors[place].unit
        found: list[FlatWire] = []
        terms = [term for term in self.arriving.at(place) if term.origin != place]
        if row["type"] in TEXTS:
            return self._texts_to(place, terms)
        for term in terms:
            chain = term.chain
            if self.walk.physical[place] and unit is not None:
                chain = self.arriving.step(term, unit.to_si).chain
            origin_way, origin_name = term.origin
            fixed = self._is_fixed(term.origin)
            if fixed and term.origin in self.bound.values:
                self.bound.put(component, row, each(self.bound.number(term.origin), chain))
            elif not fixed and row["causality"] in FIXED:
                raise self.walk.refused(
                    f"parameter {dotted(way, name)!r}", "a value that is known at the start", dotted(*term.origin)
                )
            elif not fixed:
                if name not in component.inputs:
                    component.inputs.append(name)
                for source, target in self._pairs(term.origin, place):
                    found.append(FlatWire(source, target, chain, len(terms) > 1))
                if origin_way in self.walk.components and origin_name not in self.walk.components[origin_way].outputs:
                    self.walk.components[origin_way].outputs.append(origin_name)
        return found

    def _texts_to(self, place: Place, terms: Sequence[Term]) -> list[FlatWire]:
        """Return the wires that carry texts to a variable of an FMU; what comes from outside is its start value."""
        way, name = place
        component, found = self.walk.components[way], []
        if component.rows[name]["shape"]:
            raise self.walk.refused("connection of a text", "one text", f"the array {dotted(*place)}")
        for term in terms:
            origin_way, origin_name = term.origin
            if origin_way in self.walk.components:
                found.append(
                    FlatWire(
                        f"{self.walk.components[origin_way].name}.{origin_name}", f"{component.name}.{name}", Chain()
                    )
                )
            elif term.origin in self.bound.values:
                self.bound.put(component, component.rows[name], self.bound.values[term.origin][0])
        return found

    def _is_fixed(self, origin: Place) -> bool:
        """Return True for a connector that nothing drives while the system runs."""
        way, _ = origin
        if way in self.walk.components:
            return False
        return bool(way) or self.walk.connectors[origin].kind in FIXED

    def _pairs(self, source: Place, sink: Place) -> list[tuple[str, str]]:
        """Return the channels of two ends, one to one."""
        into = self._channels(sink)
        outof = self._channels(source) if source[0] in self.walk.components else members(source[1], len(into))
        if len(into) != len(outof):
            raise self.walk.refused(
                f"connection to {dotted(*sink)}", f"{len(into)} values", f"{len(outof)} of {dotted(*source)}"
            )
        return list(zip(outof, into, strict=True))

    def _channels(self, place: Place) -> list[str]:
        """Return the channels of a variable of an FMU, as ``component.channel``."""
        component = self.walk.components[place[0]]
        return [f"{component.name}.{one}" for one in channels_of(place[1], component.rows[place[1]]["shape"])]

    def _inputs(self, wires: Sequence[FlatWire]) -> list[FlatInput]:
        """Return the inputs of the whole: those of its connectors that reach an FMU or an output."""
        used = {wire.source for wire in wires}
        ways = {term.origin for place in self.walk.from_of if not place[0] for term in self.arriving.at(place)}
        found = []
        for (way, name), connector in self.walk.connectors.items():
            if (
                way
                or connector.kind in (*FIXED, *SOURCES)
                or ((), name) in self.walk.from_of
                or connector.type in TEXTS
            ):
                continue
            members = [one for one in used if one == name or one.startswith(f"{name}[")]
            if not members and ((), name) in ways:
                members = [name]
            unit = self._outer_unit(((), name))
            given = self.bound.values.get(((), name))
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
        unit = self.walk.connectors[place].unit
        if unit is not None:
            return unit
        found = self.arriving.inferred.get(place, [])
        if found and all(found[0].same_as(one) for one in found):
            return found[0]
        if found:
            texts = " and ".join(sorted({one.text for one in found}))
            self.walk.notes.append(f"{dotted(*place)} drives {texts}: its numbers are taken as they are")
        return None

    def _start_of(self, member: str, wires: Sequence[FlatWire], unit: Unit | None) -> float:
        """Return the start value in SI that an input takes over from the first FMU it drives."""
        wire = next((one for one in wires if one.source == member), None)
        if wire is None:
            return 0.0
        part, _, channel = wire.target.partition(".")
        component = next(one for one in self.walk.components.values() if one.name == part)
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

    def _from_outside(self, one: Led) -> Led:
        """Return what comes from an input of the whole, whose channel is in SI."""
        return replace(one, chain=self._after_si(one.source, one.chain))

    def _after_si(self, source: str, chain: Chain) -> Chain:
        name = source if ((), source) in self.walk.connectors else source.rpartition("[")[0]
        unit = self._outer_unit(((), name))
        made = Chain() if unit is None else Chain().then(unit.from_si)
        for step in chain.steps:
            made = made.then(step)
        return made

    def _outputs(self) -> list[FlatOutput]:
        """Return the outputs of the outermost system."""
        found, silent, texts = [], [], []
        for (way, name), connector in self.walk.connectors.items():
            if way or ((), name) not in self.walk.from_of:
                if not way and connector.kind == "output":
                    silent.append(name)
                continue
            terms = self.arriving.at(((), name))
            moving = [term for term in terms if not self._is_fixed(term.origin)]
            if len(terms) != 1 or not moving:
                silent.append(name)
                continue
            term = moving[0]
            origin_way, origin_name = term.origin
            if connector.type in TEXTS or self.walk.connectors[term.origin].type in TEXTS:
                texts.append(name)
                continue
            unit = connector.unit or term.unit
            chain = term.chain if unit is None else self.arriving.step(term, unit.to_si).chain
            if origin_way in self.walk.components:
                component = self.walk.components[origin_way]
                if origin_name not in component.outputs:
                    component.outputs.append(origin_name)
                sources = self._channels(term.origin)
                plain = chain == Chain() and self.walk.physical[term.origin]
            else:
                sources, plain = [origin_name], False
            for label, source in zip(members(name, len(sources)), sources, strict=True):
                found.append(FlatOutput(label, source, chain, None if plain else "1" if unit is None else unit.si))
        if texts:
            self.walk.notes.append(f"texts and bytes are carried but not recorded: {', '.join(texts)}")
        if silent:
            self.walk.notes.append(f"outputs of the system that nothing drives: {', '.join(silent)}")
        return found

    def _everything(self) -> list[FlatOutput]:
        """Return the outputs of all FMUs, for a system that shows none itself."""
        found = []
        for way, component in self.walk.components.items():
            names = [n for n, row in component.rows.items() if row["causality"] == "output" and not row["alias"]]
            names = [name for name in names if component.rows[name]["type"] not in NO_SIGNAL]
            component.outputs += [name for name in names if name not in component.outputs]
            for name in names:
                for channel in self._channels((way, name)):
                    label = f"{component.label}.{channel.partition('.')[2]}"
                    found.append(FlatOutput(label, channel, Chain(), None))
        return found
