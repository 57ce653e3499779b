"""SSP packages (System Structure and Parameterization 1.0) as coupled plants: FMUs, connections, parameter values."""

from __future__ import annotations

import shutil
import tempfile
import weakref
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.cosim.description import CHANGEABLE, Make
from harness.cosim.master import Coupled
from harness.cosim.ssp_structure import Component, Structure, read_structure
from harness.cosim.wiring import Connection
from harness.errors import InputError
from harness.fmi.archive import check_entries
from harness.protocols import Plant
from harness.units import fits

__all__ = ["couple_ssp"]


DEEPEST = 5
"""Packages inside packages, before it counts as a trap."""


def couple_ssp(
    path: str | Path,
    make: Make,
    *,
    changes: Mapping[str, Any] | None = None,
    values: Mapping[str, Any] | None = None,
    depth: int = 1,
) -> Coupled:
    """Build the plant that an SSP package describes.

    Components are FMUs inside the package; nested systems are flattened (``system/component``), and a component that
    is itself a package becomes one part. Connectors of the
    outermost system become the inputs and outputs of the plant. Without output connectors every output is shown.

    Parameters
    ----------
    path : path
        The ``.ssp`` file.
    make : callable
        ``make("fmu", {"path": ..., ...}) -> Plant``.
    changes : mapping, optional
        How the parts are stepped, as in :func:`harness.cosim.couple`; the sample time is also that of the FMUs.
    values : mapping, optional
        Values of parameters by ``component.parameter``, in SI; they go before those of the package.
    depth : int
        How many packages this one stands in, itself included.

    Raises
    ------
    InputError
        If the archive is unsafe to unpack, breaks the standard, uses what is not understood here, or units disagree.

    Notes
    -----
    Units: a connector that declares a unit must agree in kind with the FMU's variable; values of parameters are
    converted from their unit, or taken in SI where they declare none. The folder with the unpacked FMUs is removed
    when the coupled plant is closed.
    """
    path = Path(path)
    unknown = sorted(set(changes or {}) - set(CHANGEABLE))
    if unknown:
        raise InputError(
            "option of a package",
            expected=f"one of {', '.join(CHANGEABLE)}",
            got=", ".join(unknown),
            remedy="change the rest in the package",
            file=path,
        )
    structure = read_structure(path)
    _set_values(structure, values or {}, path)
    folder = Path(tempfile.mkdtemp(prefix="sysid-ssp-"))
    parts: dict[str, Plant] = {}
    try:
        _unpack(path, structure, folder)
        for component in structure.components:
            step = (changes or {}).get("sample_time")
            if component.source.endswith(".ssp"):
                parts[component.name] = _nested(component, folder, make, step, path, depth)
            else:
                parts[component.name] = _made(component, structure, folder, make, step, path)
        _check_units(path, structure, parts)
        return _coupled(structure, parts, dict(changes or {}), folder)
    except BaseException as error:
        for plant in parts.values():
            plant.close()
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, InputError):
            raise error.located(file=path) from error
        raise


def _coupled(structure: Structure, parts: dict[str, Plant], changes: dict[str, Any], folder: Path) -> Coupled:
    """Connect the parts; the coupled plant owns the folder."""
    outputs = dict(structure.outputs)
    units = {f"{name}.{c.name}": c.unit for name, p in parts.items() for c in (*p.spec.inputs, *p.spec.outputs)}
    wires = []
    for source, target, gain in structure.wires:
        # an FMU that declares no unit for an end takes or gives the number as it is
        ends = units.get(source, "1"), units.get(target, "1")
        bare = "." in source and "1" in ends and ends[0] != ends[1]
        unit = "1" if not bare else ends[1] if ends[0] == "1" else f"1/({ends[0]})"
        wires.append(Connection(source, target, gain, gain_unit=unit))
    lenders = {name: target for target, name in reversed([(w.target, w.source) for w in wires if "." not in w.source])}
    shown = list(outputs.values()) or [f"{name}.{c.name}" for name, part in parts.items() for c in part.spec.outputs]
    coupled = Coupled(parts, wires, inputs=lenders, outputs=shown, labels=list(outputs) or None, **changes)
    cleaner = weakref.finalize(coupled, shutil.rmtree, folder, ignore_errors=True)
    coupled.after_close(cleaner)
    return coupled


def _unpack(path: Path, structure: Structure, folder: Path) -> None:
    """Extract the FMUs of the components, and nothing else."""
    with zipfile.ZipFile(path) as archive:
        check_entries(path, archive)
        names = set(archive.namelist())
        for component in structure.components:
            if component.source not in names:
                raise InputError(
                    f"source of component {component.name!r}",
                    expected="an FMU inside the package",
                    got=repr(component.source),
                    remedy="put it into resources/ and export the package again",
                    file=path,
                )
            try:
                archive.extract(component.source, folder)
            # RuntimeError: a member under a password, or packed by a method that zipfile does not know
            except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
                raise InputError(
                    f"source of component {component.name!r}",
                    expected="a sound zip archive",
                    got=f"{type(error).__name__}: {error}",
                    remedy="copy or export the package again",
                    file=path,
                    place=component.source,
                ) from error


def _made(
    component: Component, structure: Structure, folder: Path, make: Make, sample_time: float | None, path: Path
) -> Plant:
    """Return one component as a plant with its parameter values; an input that nothing drives keeps its start value."""
    options: dict[str, Any] = {"path": str(folder / component.source)}
    if sample_time is not None:
        options["sample_time"] = sample_time
    driven = {target for _, target, _ in structure.wires}
    options["inputs"] = [
        name
        for name, (side, _) in component.connectors.items()
        if side == "input" and f"{component.name}.{name}" in driven
    ]
    if shown := [name for name, (side, _) in component.connectors.items() if side == "output"]:
        options["outputs"] = shown
    if component.parameters:
        options["parameters"] = dict(component.parameters)
    if component.start:
        options["start"] = dict(component.start)
    try:
        return make("fmu", options)
    except InputError as error:
        raise _named(error, component, path) from error


def _named(error: InputError, component: Component, path: Path) -> InputError:
    """Return an error that says in which component of a package it arose."""
    return InputError(
        f"component {component.name!r} ({Path(component.source).name}): {error.what}",
        expected=error.expected,
        got=error.got,
        remedy=error.remedy,
        file=path,
        place=error.place,
    )


def _nested(component: Component, folder: Path, make: Make, sample_time: float | None, path: Path, depth: int) -> Plant:
    """Return a package inside the package as one part."""
    if depth >= DEEPEST:
        raise InputError(
            "packages inside packages",
            expected=f"at most {DEEPEST}, one in another",
            got=f"more, at component {component.name!r}",
            remedy="do not trust it",
            file=path,
        )
    changes = {} if sample_time is None else {"sample_time": sample_time}
    values = {**component.parameters, **component.start}
    try:
        return couple_ssp(folder / component.source, make, changes=changes, values=values, depth=depth + 1)
    except InputError as error:  # the unpacked package is gone when the user reads this
        raise _named(error, component, path) from error


def _set_values(structure: Structure, values: Mapping[str, Any], path: Path) -> None:
    """Hand values that come from outside to the components."""
    for name, value in values.items():
        owners = [c for c in structure.components if name.startswith(c.name.replace("/", ".") + ".")]
        if not owners:
            known = ", ".join(c.name.replace("/", ".") for c in structure.components)
            raise InputError(
                "parameter value", expected=f"COMPONENT.NAME of {known}", got=repr(name), remedy="correct it", file=path
            )
        owners[0].parameters[name[len(owners[0].name) + 1 :]] = value


def _check_units(path: Path, structure: Structure, parts: Mapping[str, Plant]) -> None:
    """Refuse a connector whose declared unit measures something else than the FMU's variable."""
    for component in structure.components:
        spec = parts[component.name].spec
        units = {channel.name: channel.unit for channel in (*spec.inputs, *spec.outputs)}
        for name, (_, unit) in component.connectors.items():
            if unit is not None and name in units and units[name] != "1" and not fits(unit, units[name]):
                raise InputError(
                    "unit of a connector",
                    expected=f"a unit that converts to {units[name]!r}, as the FMU says",
                    got=repr(unit),
                    remedy="correct the unit in SystemStructure.ssd",
                    file=path,
                    place=f"{component.name}.{name}",
                )
