"""Parameter bindings of an element: values (SSV), their mapping (SSM), inline or in files of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from harness.cosim.structure.conversion import LinearConversion, Unit
from harness.cosim.structure.elements import children, first, local, truth
from harness.cosim.structure.model import Binding, Mapped, Value
from harness.cosim.structure.package import InFmu, Package, parsed
from harness.errors import InputError

VALUES, MAPPING = "application/x-ssp-parameter-set", "application/x-ssp-parameter-mapping"
REALS = ("Real", "Float64", "Float32")


class BindingReader(Protocol):
    """What reading a binding asks of the reader of the file that it stands in."""

    package: Package
    name: str
    notes: list[str]
    units: dict[str, Unit]

    def change(self, element: Any) -> LinearConversion | Mapped | None:
        """Return the transformation of a mapping entry."""

    def unit(self, text: str, units: dict[str, Unit]) -> Unit | None:
        """Return the unit that a name means."""

    def defined_units(self, element: Any) -> dict[str, Unit]:
        """Return the units that a file defines."""

    def need(self, element: Any, name: str) -> str:
        """Return an attribute that the standard requires."""

    def refused(self, what: str, expected: str, got: str) -> InputError:
        """Return the error for something in the file."""


def read_bindings(reader: BindingReader, element: Any, fmu: Path | None) -> list[Binding]:
    """Return the bindings of an element in their order; of two at one level the later counts (SSP 2.0 sec. 5.2.2).

    - ``reader``: of the file that holds the element
    - ``element``: a component or a system
    - ``fmu``: the component's FMU, for values that lie in it (``sourceBase="component"``)
    """
    found = []
    for binding in children(element, "ParameterBindings", "ParameterBinding"):
        kind = binding.get("type") or VALUES
        if kind != VALUES:
            raise reader.refused("type of a parameter binding", VALUES, repr(kind))
        content = _content(reader, binding, fmu, "ParameterSet", first(binding, "ParameterValues", "ParameterSet"))
        prefix = binding.get("prefix") or ""
        given = {} if content is None else _given(reader, content, prefix)
        mapping = first(binding, "ParameterMapping")
        if mapping is None:
            found.append(tuple(given.values()))
            continue
        inline = first(mapping, "ParameterMapping")
        entries = _content(reader, mapping, fmu, "ParameterMapping", inline)
        mapped: dict[str, Value] = {}
        missing = []
        for entry in children(entries, "MappingEntry"):
            source, target = reader.need(entry, "source"), reader.need(entry, "target")
            if source not in given:
                missing.append(source)
                continue
            if target in mapped:
                raise reader.refused("parameter mapping", "one source for each target", f"{target!r} twice")
            one, suppress = given[source], truth(entry.get("suppressUnitConversion"))
            mapped[target] = Value(target, one.value, one.unit, reader.change(entry), suppress)
        if missing:
            names = list(dict.fromkeys(missing))
            listed = ", ".join(map(repr, names[:8])) + (", ..." if len(names) > 8 else "")
            reader.notes.append(f"a parameter mapping names what its values do not hold: {listed}")
        found.append(tuple(mapped.values()))
    return found


def _content(reader: BindingReader, element: Any, fmu: Path | None, expected: str, inline: Any) -> Any:
    """Return the root of what an element holds inline or refers to."""
    source = element.get("source")
    if source is None:
        return inline
    if element.get("sourceBase") == "component":
        if fmu is None:
            raise reader.refused("sourceBase", "SSD, as the element is no FMU", "component")
        root = parsed(InFmu(fmu, reader.package.path), source)
    else:
        file = reader.package.named(source, reader.name, "a parameter binding")
        root = parsed(reader.package, file)
    if local(root) != expected:
        raise reader.refused(source, f"a {expected}", local(root))
    return root


def _given(reader: BindingReader, content: Any, prefix: str) -> dict[str, Value]:
    """Return the values of a parameter set by their names."""
    units: dict[str, Unit] = {**reader.units, **reader.defined_units(content)}
    found = {}
    for parameter in children(content, "Parameters", "Parameter"):
        name = prefix + reader.need(parameter, "name")
        typed = [child for child in parameter if child.get("value") is not None or len(child)]
        if not typed:
            raise reader.refused(f"parameter {name!r}", "a value", "none")
        value = _value(reader, name, typed[0], any(True for _ in children(parameter, "Dimension")))
        text = typed[0].get("unit")
        found[name] = Value(name, value, None if text is None else reader.unit(text, units))
    return found


def _value(reader: BindingReader, name: str, element: Any, array: bool) -> Any:
    """Return a value in its type; a list for an array."""
    kind, text = local(element), element.get("value")
    if text is None:
        texts = [child.text or child.get("value") or "" for child in children(element, "Value")]
        return texts if array or len(texts) != 1 else texts[0]
    if kind in ("String", "Enumeration"):
        return [text] if array else text
    words = text.split()
    try:
        if kind in REALS:
            values: list[Any] = [float(word) for word in words]
        elif kind == "Boolean":
            values = [{"true": True, "1": True, "false": False, "0": False}[word] for word in words]
        elif kind == "Binary":
            values = [bytes.fromhex(text)]
        else:
            values = [int(word) for word in words]
    except (ValueError, KeyError):
        raise reader.refused(f"value of parameter {name!r}", f"of type {kind}", repr(text)) from None
    if not values:
        raise reader.refused(f"value of parameter {name!r}", f"of type {kind}", repr(text))
    return values if array or len(values) > 1 else values[0]
