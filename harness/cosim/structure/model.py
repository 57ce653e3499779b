"""The words of a system structure as plain records: what a file says, before anything is made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.cosim.structure.conversion import LinearConversion, Unit


@dataclass(frozen=True)
class Mapped:
    """A table of a transformation: ``kind`` is Boolean, Integer or Enumeration."""

    kind: str
    entries: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Connector:
    """A connector, or an entry of a signal dictionary; ``items`` are those of its enumeration."""

    name: str
    kind: str
    type: str | None = None
    unit: Unit | None = None
    items: Mapping[str, int] | None = None


@dataclass(frozen=True)
class Value:
    """A parameter's value as a file gives it; ``unit`` None where it gives none."""

    name: str
    value: Any
    unit: Unit | None = None
    change: LinearConversion | Mapped | None = None
    suppress: bool = False


Binding = tuple[Value, ...]  # The values that a parameter binding brings, after its prefix and its mapping.


@dataclass(frozen=True)
class ElementWire:
    """A connection; an element of None is the system itself."""

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    change: LinearConversion | Mapped | None = None
    suppress: bool = False


@dataclass
class Element:
    """Something in a system with a name, connectors and bindings."""

    name: str
    connectors: dict[str, Connector]
    bindings: list[Binding]


@dataclass
class Component(Element):
    """An FMU; ``fmu`` is None where the file brings no implementation. ``step`` [s] where the file gives it a rate."""

    fmu: Path | None = None
    source: str = ""
    kind: str | None = None
    step: float | None = None


@dataclass
class Reference(Element):
    """A reference to a signal dictionary."""

    dictionary: str = ""


@dataclass
class SystemElement(Element):
    """Elements and the wires between them; ``sums`` are own connectors that add up what is wired to them."""

    elements: list[Element] = field(default_factory=list)
    wires: list[ElementWire] = field(default_factory=list)
    dictionaries: dict[str, dict[str, Connector]] = field(default_factory=dict)
    sums: frozenset[str] = frozenset()


@dataclass
class SystemDescription:
    """A whole file: its system, its experiment [s], the exchange that its tool uses, and what was left aside."""

    path: Path
    name: str
    system: SystemElement
    start: float | None = None
    stop: float | None = None
    step: float | None = None
    exchange: str | None = None
    notes: list[str] = field(default_factory=list)
