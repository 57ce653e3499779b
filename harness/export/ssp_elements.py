"""Elements of SSP files: names with their spaces, units by their powers of the base units."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from harness.errors import InputError
from harness.units import base_units

SSP = "http://ssp-standard.org/SSP1/"
SPACES = {
    "ssd": f"{SSP}SystemStructureDescription",
    "ssc": f"{SSP}SystemStructureCommon",
    "ssv": f"{SSP}SystemStructureParameterValues",
}


def base_unit(unit: str) -> dict[str, str] | None:
    """Return the attributes of a BaseUnit of SSP 1.0; None if the unit is not known or has no whole powers."""
    try:
        powers, factor, offset = base_units(unit)
    except InputError:
        return None
    if any(power != int(power) for power in powers.values()):
        return None
    attributes = {name: str(int(power)) for name, power in powers.items()}
    return (
        attributes
        | ({} if factor == 1.0 else {"factor": repr(factor)})
        | ({} if offset == 0.0 else {"offset": repr(offset)})
    )


def unit_definitions(parent: Any, tag: str) -> None:
    """Define the units that are used inside an element."""
    used = dict.fromkeys(unit for element in parent.iter() if (unit := element.get("unit")) is not None)
    if used:
        node = child(parent, tag)
        for unit in used:
            child(child(node, "ssc:Unit", name=unit), "ssc:BaseUnit", **(base_unit(unit) or {}))


def child(parent: Any, tag: str, **attributes: str) -> Any:
    """Return a new element."""
    prefix, _, name = tag.partition(":")
    full = f"{{{SPACES[prefix]}}}{name}"
    return ElementTree.Element(full, attributes) if parent is None else ElementTree.SubElement(parent, full, attributes)
