"""Calibrated values handed on: an SSV, and a copy of the FMU or the SSP that starts from them.

A binary holds the start values that it was compiled with, and tools differ in whether they set those of the
description. The copy of an FMU therefore names in :data:`STARTS` what was changed: sysid sets those values itself.
"""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from harness.data.whole_files import whole_file, write_text
from harness.errors import InputError
from harness.export.describe import xml_text
from harness.export.ssp_elements import SPACES, base_unit, child, unit_definitions
from harness.export.system_structure import OPEN_ENDS
from harness.fmi.archive import STARTS
from harness.parts.files import describe_fmu

Values = Mapping[str, float]

DESCRIPTION, STRUCTURE = "modelDescription.xml", "SystemStructure.ssd"
VALUES = "resources/calibrated.ssv"


def write_ssv(values: Values, units: Mapping[str, str], path: str | Path) -> Path:
    """Write values by name as a parameter set of SSP 1.0 in SI units.

    Names are those of the FMU's variables; of a system ``component.parameter``, for a binding of the whole system.
    Raises InputError if the file cannot be written.
    """
    path = Path(path)
    write_text(path, _values(values, units))
    return path


def _values(values: Values, units: Mapping[str, str]) -> str:
    """Return the parameter set."""
    for prefix, space in SPACES.items():
        ElementTree.register_namespace(prefix, space)
    root = child(None, "ssv:ParameterSet", version="1.0", name="calibrated")
    listed = child(root, "ssv:Parameters")
    for name, value in values.items():
        unit = units.get(name)
        stated = {} if unit is None or unit == "1" or base_unit(unit) is None else {"unit": unit}
        child(child(listed, "ssv:Parameter", name=name), "ssv:Real", value=repr(float(value)), **stated)
    unit_definitions(root, "ssv:Units")
    return xml_text(root)


def write_model(model: Path, kind: str, values: Values, units: Mapping[str, str], path: str | Path) -> Path:
    """Write a copy of an FMU or an SSP package with values by name as its start values.

    Raises InputError if the name does not suit the model, the model is no package, or the file cannot be written.

    - ``kind``: ``fmu``, or that of a system
    - ``values, units``: in SI; units are those of the values
    - ``path``: ``.fmu`` for an FMU, ``.ssp`` for an SSP package
    """
    path = Path(path)
    wanted = ".fmu" if kind == "fmu" else ".ssp"
    if path.suffix != wanted:
        raise InputError(
            "copy of the model", expected=f"a name that ends in {wanted}", got=str(path), remedy="rename it"
        )
    if not model.is_file() or not zipfile.is_zipfile(model):
        raise InputError(
            "copy of the model", expected="a package (.fmu, .ssp)", got=str(model), remedy="write an SSV (--ssv)"
        )
    if kind == "fmu":
        added = {STARTS: json.dumps({"names": sorted(values)}).encode()}
        _copied(model, path, {DESCRIPTION: lambda root: _with_starts(root, model, values)}, added)
    else:
        changes = {STRUCTURE: _with_binding, OPEN_ENDS: lambda root: _with_values(root, model, values)}
        _copied(model, path, changes, {VALUES: _values(values, units).encode()})
    return path


def _copied(source: Path, target: Path, changes: Mapping[str, Callable[[Any], None]], added: dict[str, bytes]) -> None:
    """Copy an archive, some XML files changed and some files added."""
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    with whole_file(target) as scratch:
        with zipfile.ZipFile(source) as old, zipfile.ZipFile(scratch, "w", zipfile.ZIP_DEFLATED) as new:
            for entry in old.infolist():
                content = old.read(entry)
                if entry.filename in added:
                    continue
                if entry.filename in changes:
                    root = etree.fromstring(content, parser)
                    changes[entry.filename](root)
                    content = etree.tostring(root.getroottree(), encoding="UTF-8", xml_declaration=True)
                new.writestr(entry, content)
            for place, content in added.items():
                new.writestr(place, content)


def _with_starts(root: Any, model: Path, values: Values) -> None:
    """Set the start attributes, in the units of the FMU."""
    rows = {row["name"]: row for row in describe_fmu(model)["variables"]}
    variables = {node.get("name"): node for node in root.find("ModelVariables")}
    for name, value in values.items():
        row, node = rows[name], variables.get(name)
        if node is None:
            raise InputError(
                f"start value of {name!r}",
                expected="a name that is there once",
                got="one made up for it",
                remedy="write an SSV",
            )
        typed = node if node.tag != "ScalarVariable" else node[0]
        typed.set("start", repr((float(value) - (row["offset"] or 0.0)) / (row["scale"] or 1.0)))


def _with_values(root: Any, model: Path, values: Values) -> None:
    """Set the values of components of :data:`OPEN_ENDS`, in the units of their FMUs: its readers know no others."""

    def within(place: Any, element: str, **attributes: str) -> Any:
        prefix, _, tag = element.partition(":")
        whole = f"{{{SPACES[prefix]}}}{tag}"
        named = (
            one for one in place if one.tag == whole and one.get("name") == attributes.get("name", one.get("name"))
        )
        found = next(named, None)
        if found is None:
            found = place.makeelement(whole, attributes)
            place.append(found)
        return found

    for component in root.iter(f"{{{SPACES['ssd']}}}Component"):
        start = f"{component.get('name')}."
        own = {name.removeprefix(start): value for name, value in values.items() if name.startswith(start)}
        if not own:
            continue
        with tempfile.TemporaryDirectory(prefix="sysid-copy-") as scratch, zipfile.ZipFile(model) as archive:
            described = describe_fmu(archive.extract(component.get("source"), scratch))
        rows = {row["name"]: row for row in described["variables"]}
        binding = within(within(component, "ssd:ParameterBindings"), "ssd:ParameterBinding")
        given = within(within(binding, "ssd:ParameterValues"), "ssv:ParameterSet", version="1.0", name="values")
        for name, value in own.items():
            typed = within(within(within(given, "ssv:Parameters"), "ssv:Parameter", name=name), "ssv:Real")
            typed.set("value", repr((float(value) - (rows[name]["offset"] or 0.0)) / (rows[name]["scale"] or 1.0)))


def _with_binding(root: Any) -> None:
    """Add a binding to the whole system, after those that it has: it goes before all others."""
    system = next(node for node in root if isinstance(node.tag, str) and node.tag.endswith("}System"))
    space = system.tag[: system.tag.index("}") + 1]
    bindings = system.find(f"{space}ParameterBindings")
    if bindings is None:
        bindings = system.makeelement(f"{space}ParameterBindings")
        first = [f"{space}{name}" for name in ("Connectors", "ElementGeometry")]
        system.insert(sum(node.tag in first for node in system), bindings)
    place = bindings.makeelement(f"{space}ParameterBinding")
    place.set("source", VALUES)
    bindings.append(place)
