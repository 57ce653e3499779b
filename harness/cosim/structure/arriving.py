"""What arrives at a connector: the sources behind it, each as one chain of units and transformations."""

from __future__ import annotations

from dataclasses import dataclass

from harness.cosim.structure.conversion import Chain, IntegerConversion, LinearConversion, Unit, change_of_unit
from harness.cosim.structure.flat import (
    REALS,
    dotted,
)
from harness.cosim.structure.model import (
    Connector,
    Mapped,
)
from harness.cosim.structure.walk import Hop, Place, Walk
from harness.errors import InputError


@dataclass(frozen=True)
class Term:
    """A part of what arrives somewhere: where it comes from, what became of it, and the unit it is in."""

    origin: Place
    chain: Chain
    unit: Unit | None
    extra: bool = False


class Arriving:
    """Terms by connector; ``inferred`` holds the units that connectors without one are read in."""

    def __init__(self, walk: Walk) -> None:
        self.walk = walk
        self.inferred: dict[Place, list[Unit]] = {}
        self.known: dict[Place, list[Term]] = {}

    def at(self, place: Place) -> list[Term]:
        """Return what arrives at, or comes out of, a connector."""
        if place not in self.known:
            self.known[place] = []  # what feeds itself through connectors alone carries nothing
            self.known[place] = self._terms(place)
        return self.known[place]

    def _terms(self, place: Place) -> list[Term]:
        way, _ = place
        unit = self.walk.connectors[place].unit
        if place not in self.walk.from_of:
            chain = Chain()
            if way in self.walk.components and self.walk.physical[place] and unit is not None:
                chain = chain.then(unit.from_si)
            return [Term(place, chain, unit)]
        found = [self._through(term, hop) for hop in self.walk.from_of[place] for term in self.at(hop.source)]
        if place in self.walk.sums:  # what is added later on counts once
            found = [
                term if at == 0 else Term(term.origin, term.chain, term.unit, True) for at, term in enumerate(found)
            ]
        return found

    def _through(self, term: Term, hop: Hop) -> Term:
        """Return a term after one connection: first units, then the transformation (sec. 4.4.2)."""
        for unit in (*hop.before, hop.unit):
            term = self._in_unit(term, unit, hop)
        if isinstance(hop.change, LinearConversion):
            for end in hop.ends:
                if end.type not in (*REALS, None):
                    raise self.walk.refused(
                        "LinearTransformation", "real numbers at both ends", f"{end.name!r}: {end.type}"
                    )
            term = self.step(term, hop.change)
        elif hop.change is not None:
            term = self.step(term, self.table(hop.change, *hop.ends))
        for unit in hop.after:
            term = self._in_unit(term, unit, hop)
        return term

    def _in_unit(self, term: Term, unit: Unit | None, hop: Hop) -> Term:
        """Return a term in another unit; where one side says none, the number goes through as it is."""
        if unit is None:
            return term
        if term.unit is None and term.chain == Chain():
            self.inferred.setdefault(term.origin, []).append(unit)
        if term.unit is None or hop.suppress:
            return Term(term.origin, term.chain, unit, term.extra)
        change = change_of_unit(term.unit, unit)
        if change is None:
            raise InputError(
                "units of a connection",
                expected=f"a source in a unit that converts to {unit}",
                got=str(term.unit),
                remedy="correct the units, or set suppressUnitConversion in the system's file",
                file=self.walk.path,
                place=f"{dotted(*hop.source)} -> {hop.ends[1].name}",
            )
        after = self.step(term, change)
        return Term(term.origin, after.chain, unit, term.extra)

    def step(self, term: Term, step: LinearConversion | IntegerConversion) -> Term:
        """Return a term after one more step; to what is added later no offset is added twice."""
        if term.extra and isinstance(step, LinearConversion):
            step = LinearConversion(step.factor)
        elif term.extra:
            raise self.walk.refused("sum", "linear transformations after it", "a table")
        return Term(term.origin, term.chain.then(step), term.unit, term.extra)

    def table(self, change: Mapped, source: Connector, target: Connector) -> IntegerConversion:
        """Return the numbers of a mapping transformation."""
        for end in (source, target):
            if end.type in REALS:
                raise self.walk.refused(
                    f"{change.kind}MappingTransformation", "no real numbers", f"{end.name!r}: {end.type}"
                )
        numbers: list[tuple[float, float]] = []
        for one, other in change.entries:
            numbers.append((self._item(change.kind, one, source), self._item(change.kind, other, target)))
        return IntegerConversion(tuple(numbers))

    def _item(self, kind: str, text: str, end: Connector) -> float:
        """Return the number that an entry of a mapping stands for."""
        if kind == "Boolean" and text.strip() in ("true", "1", "false", "0"):
            return float(text.strip() in ("true", "1"))
        if kind == "Enumeration":
            if end.items is not None and text in end.items:
                return float(end.items[text])
            known = ", ".join(end.items or ()) or "an enumeration"
            raise self.walk.refused(f"entry of a mapping at {end.name!r}", known, repr(text))
        try:
            return float(int(text))
        except ValueError:
            raise self.walk.refused(f"entry of a mapping at {end.name!r}", f"a value of {kind}", repr(text)) from None
