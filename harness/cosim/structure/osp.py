"""System structures of the Open Simulation Platform (``OspSystemStructure.xml``, version 0.1)."""

from __future__ import annotations

import math
import posixpath
from dataclasses import dataclass
from typing import Any

from harness.cosim.structure.conversion import LinearConversion
from harness.cosim.structure.elements import children, first, local
from harness.cosim.structure.model import (
    Component,
    Connector,
    Element,
    ElementWire,
    SystemDescription,
    SystemElement,
    Value,
)
from harness.cosim.structure.package import PROXIED, FolderPackage, InFmu, on_this_machine, parsed
from harness.errors import InputError
from harness.trust import names_fmu

OSP = "OspSystemStructure"
MOST = 10_000  # Inputs of a sum, before it counts as a slip.


def read_osp(package: FolderPackage, name: str) -> SystemDescription:
    """Return the structure that an OSP system file declares.

    The file's algorithm, if it is another than ``fixedStep``, and its power bonds are passed over with a note. Groups
    of variables are those of ``MODEL_OspModelDescription.xml`` beside the FMU or beside the structure, where ``MODEL``
    is the name of the FMU's model; two groups are connected group by group and variable by variable, in their order.
    Raises InputError if it is no such file, or holds what is no FMU or names a group that no description has.
    """
    root = parsed(package, name)
    if local(root) != OSP:
        raise _refused(package, "root element", OSP, local(root))
    notes: list[str] = []
    elements: list[Element] = []
    for child in children(root, "Simulators", "Simulator"):
        elements.append(_simulator(package, name, child, notes))
    for child in children(root, "Functions", "LinearTransformation"):
        elements.append(_linear(package, child))
    for child in children(root, "Functions", "Sum"):
        elements.append(_sum(package, child))
    groups: dict[str, tuple[_Group, ...]] = {}
    for child in children(root, "Functions", "VectorSum"):
        made, groups[made.name] = _vector_sum(package, child)
        elements.append(made)
    wires: list[ElementWire] = []
    for child in children(root, "Connections"):
        for wire in child:
            ends = [(end.get("simulator") or end.get("function"), end.get("name")) for end in wire]
            if len(ends) != 2 or None in ends[0] or None in ends[1]:
                raise _refused(package, local(wire), "two ends with names", f"{len(ends)} ends")
            if "Group" in local(wire):
                first_group, second = (_group(package, name, elements, groups, *end) for end in ends)
                wires += _joined(package, (ends[0][0], first_group), (ends[1][0], second))
            else:
                wires.append(ElementWire(ends[0], ends[1]))
            if wire.get("powerBond") is not None and "power bonds are connected as plain signals" not in notes:
                notes.append("power bonds are connected as plain signals")
    algorithm = (first(root, "Algorithm").text or "").strip() if first(root, "Algorithm") is not None else "fixedStep"
    if algorithm != "fixedStep":
        notes.append(f"the file's algorithm {algorithm!r} is not run: the step is fixed at its base step")
    found = SystemDescription(
        package.path, name, SystemElement("", {}, [], elements, wires), exchange="jacobi", notes=notes
    )
    found.start, found.stop, found.step = (
        _number(package, root, key) for key in ("StartTime", "EndTime", "BaseStepSize")
    )
    return found


@dataclass(frozen=True)
class _Group:
    """A group of variables, and the groups in it."""

    name: str
    variables: tuple[str, ...]
    groups: tuple[_Group, ...] = ()


def _group(
    package: FolderPackage,
    beside: str,
    elements: list[Element],
    known: dict[str, tuple[_Group, ...]],
    owner: str,
    name: str,
) -> _Group:
    """Return a group by its name, at whatever depth; descriptions are read once."""
    if owner not in known:
        component = next((one for one in elements if one.name == owner), None)
        if not isinstance(component, Component):
            raise _refused(package, f"group {name!r}", "one of a simulator or a VectorSum", repr(owner))
        known[owner] = _described(package, beside, component)
    waiting = list(known[owner])
    for one in waiting:  # grows while it is walked through
        if one.name == name:
            return one
        waiting += one.groups
    listed = ", ".join(repr(one.name) for one in known[owner]) or "none"
    raise _refused(package, f"group {name!r} of {owner!r}", f"one of its groups ({listed})", "none of this name")


def _described(package: FolderPackage, beside: str, component: Component) -> tuple[_Group, ...]:
    """Return the groups that the description of an FMU holds."""
    assert component.fmu is not None
    model = parsed(InFmu(component.fmu, package.path), "modelDescription.xml").get("modelName") or ""
    file = f"{model}_OspModelDescription.xml"
    near = posixpath.dirname(posixpath.join(posixpath.dirname(beside), component.source))
    places = [posixpath.normpath(posixpath.join(folder, file)) for folder in (near, posixpath.dirname(beside))]
    place = next((one for one in places if package.has(one)), None)
    if place is None:
        raise _refused(package, f"groups of {component.name!r}", f"{file} beside its FMU", "no such file")
    tags = ("Variable", "UnitDefinitions")

    def read(element: Any) -> _Group:
        inner = tuple(read(child) for child in element if local(child) not in tags)
        names = [child.get("ref") for child in children(element, "Variable")]
        if None in names or element.get("name") is None:
            raise _refused(package, f"{place}: {local(element)}", "a name, and variables with a ref", "none")
        return _Group(element.get("name"), tuple(names), inner)

    return tuple(read(child) for groups in children(parsed(package, place), "VariableGroups") for child in groups)


def _joined(package: FolderPackage, start: tuple[str, _Group], end: tuple[str, _Group]) -> list[ElementWire]:
    """Return the wires between two groups: first those of the groups in them, then their own, by their order."""
    (one, a), (other, b) = start, end
    sizes = (len(a.groups), len(a.variables)), (len(b.groups), len(b.variables))
    if sizes[0] != sizes[1]:
        said = [f"{groups} groups and {variables} variables" for groups, variables in sizes]
        raise _refused(package, f"connection of {one}.{a.name} and {other}.{b.name}", f"two of {said[0]}", said[1])
    inner = [_joined(package, (one, x), (other, y)) for x, y in zip(a.groups, b.groups, strict=True)]
    own = [ElementWire((one, x), (other, y)) for x, y in zip(a.variables, b.variables, strict=True)]
    return [wire for some in inner for wire in some] + own


def _vector_sum(package: FolderPackage, element: Any) -> tuple[SystemElement, tuple[_Group, ...]]:
    """Return a sum of vectors as a system, and its groups ``in[0]``, ``in[1]``, ... and ``out``."""
    name = element.get("name") or ""
    counts = [int(_attribute(package, element, key) or 0) for key in ("inputCount", "dimension")]
    if min(counts) < 1 or counts[0] * counts[1] > MOST:
        raise _refused(package, f"sum {name!r}", f"1 to {MOST} numbers", " x ".join(map(str, counts)))
    groups = [
        _Group(group, tuple(f"{group}[{at}]" for at in range(counts[1])))
        for group in (*(f"in[{at}]" for at in range(counts[0])), "out")
    ]
    out = groups[-1].variables
    ends = {one: Connector(one, "input") for group in groups[:-1] for one in group.variables}
    wires = [
        ElementWire((None, x), (None, y)) for group in groups[:-1] for x, y in zip(group.variables, out, strict=True)
    ]
    both = ends | {one: Connector(one, "output") for one in out}
    return SystemElement(name, both, [], [], wires, sums=frozenset(out)), tuple(groups)


def _simulator(package: FolderPackage, name: str, element: Any, notes: list[str]) -> Component:
    """Return an FMU of the file."""
    own, source = element.get("name"), element.get("source")
    if own is None or source is None:
        raise _refused(package, "Simulator", "a name and a source", "none")
    given, source = source, on_this_machine(source)
    if source != given and PROXIED not in notes:
        notes.append(PROXIED)
    if not names_fmu(source) or "://" in source:
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


def _linear(package: FolderPackage, element: Any) -> SystemElement:
    """Return a linear function as a system of one wire."""
    factor, offset = (_attribute(package, element, key) for key in ("factor", "offset"))
    change = LinearConversion(1.0 if factor is None else factor, 0.0 if offset is None else offset)
    ends = {"in": Connector("in", "input"), "out": Connector("out", "output")}
    return SystemElement(element.get("name") or "", ends, [], [], [ElementWire((None, "in"), (None, "out"), change)])


def _sum(package: FolderPackage, element: Any) -> SystemElement:
    """Return a sum as a system whose output adds up its inputs."""
    count = int(_attribute(package, element, "inputCount") or 0)
    if not 0 < count <= MOST:
        raise _refused(package, f"sum {element.get('name')!r}", f"1 to {MOST} inputs", str(count))
    names = [f"in[{at}]" for at in range(count)]
    ends = {name: Connector(name, "input") for name in names} | {"out": Connector("out", "output")}
    wires = [ElementWire((None, name), (None, "out")) for name in names]
    return SystemElement(element.get("name") or "", ends, [], [], wires, sums=frozenset({"out"}))


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
