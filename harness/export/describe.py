"""modelDescription.xml of an exported model: FMI 2.0, from which that of FMI 3.0 is derived."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

from harness.errors import InputError, printable

RIGHTS = (
    "The equations and values of this model (sources/model.c, modelDescription.xml) belong to whoever made it.\n"
    "The interface around them (sources/fmi.c, sources/fmi2.h or fmi3.h) is part of sysid-harness, under this licence:"
)
"""What stands above the licence in an exported FMU."""


@dataclass(frozen=True)
class FmuVariable:
    """One variable of an FMU."""

    name: str
    role: Literal["input", "output", "state", "parameter"]
    """{"input", "output", "state", "parameter"}: A state's start value can be set before the first step; a parameter at
    any time."""
    unit: str
    start: float = 0.0
    minimum: float = -math.inf
    maximum: float = math.inf


_ROLES = {
    "input": {"causality": "input", "variability": "continuous"},
    "output": {"causality": "output", "variability": "continuous", "initial": "calculated"},
    "state": {"causality": "local", "variability": "continuous", "initial": "exact"},
    "parameter": {"causality": "parameter", "variability": "tunable"},
}


def describe(
    name: str,
    text: str,
    token: str,
    variables: Sequence[FmuVariable],
    *,
    sample_time: float,
    direct: Sequence[int] = (),
) -> ElementTree.Element:
    """Return the description of a co-simulation FMU.

    Raises InputError if two variables have one name, which FMI forbids.

    - ``name, text``: of the model
    - ``token``: names this version of the model
    - ``variables``: inputs, then outputs, then the others: value references count from 1
    - ``sample_time``: [s], the step that is suggested
    - ``direct``: inputs (counted from 0) on which the outputs of the same instant depend

    Examples
    --------
    >>> root = describe("gain", "y = 2 u", "0", [FmuVariable("u", "input", "V"), FmuVariable("y", "output", "V")],
    ...                 sample_time=0.1, direct=[0])
    >>> root.find("ModelStructure/Outputs/Unknown").attrib
    {'index': '2', 'dependencies': '1'}
    """
    known: set[str] = set()
    for variable in variables:
        if variable.name in known:
            raise InputError(
                "names of an FMU's variables",
                expected="inputs, outputs and parameters with names of their own",
                got=f"{variable.name!r} twice",
                remedy="rename one of them in the model",
            )
        known.add(variable.name)
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=name,
        guid=f"{{{token}}}",
        description=text,
        generationTool="sysid-harness",
        variableNamingConvention="flat",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier(name),
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys([*(variable.unit for variable in variables), "s"]):
        units.append(_unit(unit))
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize=repr(float(sample_time)))
    listed = ElementTree.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables, start=1):
        node = ElementTree.SubElement(
            listed, "ScalarVariable", {"name": variable.name, **_ROLES[variable.role], "valueReference": str(reference)}
        )
        numbers = {"unit": variable.unit}
        if variable.role != "output":
            numbers["start"] = repr(float(variable.start))
        for key, bound in (("min", variable.minimum), ("max", variable.maximum)):
            if math.isfinite(bound):
                numbers[key] = repr(float(bound))
        ElementTree.SubElement(node, "Real", numbers)
    structure = ElementTree.SubElement(root, "ModelStructure")
    rows = [row for row, variable in enumerate(variables, start=1) if variable.role == "output"]
    if rows:
        outputs = ElementTree.SubElement(structure, "Outputs")
        unknowns = ElementTree.SubElement(structure, "InitialUnknowns")
        for row in rows:
            dependencies = " ".join(str(1 + column) for column in direct)
            ElementTree.SubElement(outputs, "Unknown", index=str(row), dependencies=dependencies)
            ElementTree.SubElement(unknowns, "Unknown", index=str(row))
    return root


def identifier(name: str) -> str:
    """Return a C identifier for a model's name.

    Examples
    --------
    >>> identifier("cart-pole")
    'cart_pole'
    """
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return text if text and not text[0].isdigit() else f"m_{text}"


def _unit(unit: str) -> ElementTree.Element:
    """Return the definition of a unit in the base units that FMI knows (FMI 2.0.5, sec. 2.2.2)."""
    from harness.units import base_units

    node = ElementTree.Element("Unit", name=unit)
    base, factor, offset = base_units(unit)
    attributes = {name: str(power) for name, power in base.items() if power == int(power)}
    if len(attributes) == len(base):
        if factor != 1.0:
            attributes["factor"] = repr(factor)
        if offset != 0.0:
            attributes["offset"] = repr(offset)
        ElementTree.SubElement(node, "BaseUnit", attributes)
    return node


def xml_text(root: ElementTree.Element) -> str:
    r"""Return a document as text that every reader of XML takes: control characters, unknown to XML, are spelled out.

    Examples
    --------
    >>> print(xml_text(ElementTree.Element("a", name="b" + chr(27))).splitlines()[1])
    <a name="b\x1b" />
    """
    for element in root.iter():
        element.attrib.update({key: printable(value) for key, value in element.attrib.items()})
        element.text = printable(element.text) if element.text else element.text
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)
