"""System structures of the Open Simulation Platform (``OspSystemStructure.xml``, version 0.1)."""

from __future__ import annotations

import math
from typing import Any

from harness.cosim.structure.conversion import Linear
from harness.cosim.structure.elements import children, first, local
from harness.cosim.structure.model import Component, Connector, Description, Element, System, Value, Wire
from harness.cosim.structure.package import FolderPackage, parsed
from harness.errors import InputError
from harness.trust import names_fmu

__all__ = ["OSP", "read_osp"]

OSP = "OspSystemStructure"
MOST = 10_000
"""Inputs of a sum, before it counts as a slip."""


def read_osp(package: FolderPackage, name: str) -> Description:
    """Return the structure that an OSP system file declares.

    The file's algorithm, if it is another than ``fixedStep``, and its power bonds are passed over with a note.

    Raises
    ------
    InputError
        If it is no such file, or holds what is no FMU or needs a description beside the FMU (variable groups).
    """
    root = parsed(package, name)
    if local(root) != OSP:
        raise _refused(package, "root element", OSP, local(root))
    notes: list[str] = []
    elements: list[Element] = []
    for child in children(root, "Simulators", "Simulator"):
        elements.append(_simulator(package, name, child))
    for child in children(root, "Functions", "LinearTransformation"):
        elements.append(_linear(package, child))
    for child in children(root, "Functions", "Sum"):
        elements.append(_sum(package, child))
    for child in children(root, "Functions", "VectorSum"):
        raise _refused(package, f"function {child.get('name')!r}", "LinearTransformation or Sum", "a VectorSum")
    wires: list[Wire] = []
    for child in children(root, "Connections"):
        for wire in child:
            if "Group" in local(wire):
                expected = "connections of variables (groups need an OspModelDescription beside the FMU)"
                raise _refused(package, "connection", expected, local(wire))
            ends = [(end.get("simulator") or end.get("function"), end.get("name")) for end in wire]
            if len(ends) != 2 or None in ends[0] or None in ends[1]:
                raise _refused(package, local(wire), "two ends with names", f"{len(ends)} ends")
            wires.append(Wire(ends[0], ends[1]))
            if wire.get("powerBond") is not None and "power bonds are connected as plain signals" not in notes:
                notes.append("power bonds are connected as plain signals")
    algorithm = (first(root, "Algorithm").text or "").strip() if first(root, "Algorithm") is not None else "fixedStep"
    if algorithm != "fixedStep":
        notes.append(f"the file's algorithm {algorithm!r} is not run: the step is fixed at its base step")
    found = Description(package.path, name, System("", {}, [], elements, wires), exchange="jacobi", notes=notes)
    found.start, found.stop, found.step = (
        _number(package, root, key) for key in ("StartTime", "EndTime", "BaseStepSize")
    )
    return found


def _simulator(package: FolderPackage, name: str, element: Any) -> Component:
    """Return an FMU of the file."""
    own, source = element.get("name"), element.get("source")
    if own is None or source is None:
        raise _refused(package, "Simulator", "a name and a source", "none")
    if not names_fmu(source) or source.startswith("proxyfmu:"):
        raise _refused(package, f"simulator {own!r}", "an FMU in a file", repr(source))
    place = package.file(package.named(source, name, f"simulator {own!r}"))
    values = []
    for child in children(element, "InitialValues", "InitialValue"):
        for typed in child:
            values.append(Value(child.get("variable") or "", _typed(package, typed)))
            break
    return Component(own, {}, [tuple(values)], place, source, "cs", _attribute(package, element, "stepSize"))


def _typed(package: FolderPackage, element: Any) -> Any:
    """Return an initial value in its type."""
    kind, text = local(element), element.get("value") or ""
    try:
        if kind == "Real":
            return float(text)
        if kind == "Integer":
            return int(text)
    except ValueError:
        raise _refused(package, "initial value", f"of type {kind}", repr(text)) from None
    return text.strip() in ("true", "1") if kind == "Boolean" else text


def _linear(package: FolderPackage, element: Any) -> System:
    """Return a linear function as a system of one wire."""
    factor, offset = (_attribute(package, element, key) for key in ("factor", "offset"))
    change = Linear(1.0 if factor is None else factor, 0.0 if offset is None else offset)
    ends = {"in": Connector("in", "input"), "out": Connector("out", "output")}
    return System(element.get("name") or "", ends, [], [], [Wire((None, "in"), (None, "out"), change)])


def _sum(package: FolderPackage, element: Any) -> System:
    """Return a sum as a system whose output adds up its inputs."""
    count = int(_attribute(package, element, "inputCount") or 0)
    if not 0 < count <= MOST:
        raise _refused(package, f"sum {element.get('name')!r}", f"1 to {MOST} inputs", str(count))
    names = [f"in[{at}]" for at in range(count)]
    ends = {name: Connector(name, "input") for name in names} | {"out": Connector("out", "output")}
    wires = [Wire((None, name), (None, "out")) for name in names]
    return System(element.get("name") or "", ends, [], [], wires, sums=frozenset({"out"}))


def _attribute(package: FolderPackage, element: Any, name: str) -> float | None:
    """Return a finite number of an attribute; None where there is none."""
    text = element.get(name)
    try:
        value = None if text is None else float(text)
    except ValueError:
        value = math.nan
    if value is not None and not math.isfinite(value):
        raise _refused(package, f"{name} of {local(element)}", "a finite number", repr(text))
    return value


def _number(package: FolderPackage, root: Any, name: str) -> float | None:
    """Return a number of the file's head."""
    element = first(root, name)
    if element is None:
        return None
    try:
        return float(element.text or "")
    except ValueError:
        raise _refused(package, name, "a number", repr(element.text)) from None


def _refused(package: FolderPackage, what: str, expected: str, got: str) -> InputError:
    return InputError(what, expected=expected, got=got, remedy="correct the file", file=package.path)
