"""A coupling written in TOML as an SSP package, where all of its parts are FMUs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.errors import InputError
from harness.export.system_structure import (
    Outer,
    WrittenComponent,
    WrittenConnection,
    WrittenSystem,
    ports_of,
    write_structure,
)

KINDS = {"real": "Real", "boolean": "Boolean"}  # Types of SSP by kind of channel; all others are integers.


def write_coupling(path: Path, target: Path) -> Path:
    """Write a coupling as an SSP 1.0 package with two structures (:mod:`harness.export.system_structure`).

    Raises InputError if the coupling cannot be built, a part is no FMU, or it needs what SSP 1.0 does not know: delays,
    sums of wires, signals as lines, passes, an error bound, arrays.

    - ``path``: the TOML file
    - ``target``: the ``.ssp``

    Notes
    -----
    How its parts take turns is not in the file; ``order = "jacobi"`` stands in an annotation of the Open Simulation
    Platform with the communication step.
    """
    from harness import cosim
    from harness.parts.files import describe_fmu, make_part

    read = cosim.read_coupling(path)
    made: list[Any] = []

    def make(id: str, options: dict[str, Any]) -> Any:
        made.append(make_part(id, options))
        return made[-1]

    with cosim.couple(path, make) as coupled:
        _refuse_what_ssp_lacks(path, read, made)
        used: dict[str, list[str]] = {name: [] for name in read.parts}
        wires = [_wire(one.source, one.target, one.gain, one.offset) for one in read.connections]
        outer = [Outer(one.name, "input", one.unit, KINDS.get(one.kind, "Integer")) for one in coupled.spec.inputs]
        if not isinstance(read.inputs, dict):
            wires += [WrittenConnection(("", name), _end(name)) for name in read.inputs]
        for name, one in zip(read.outputs, coupled.spec.outputs, strict=True):
            outer.append(Outer(one.name, "output", one.unit, KINDS.get(one.kind, "Integer")))
            wires.append(WrittenConnection(_end(name), ("", one.name)))
        for wire in wires:
            for part, port in (wire.source, wire.target):
                if part and port not in used[part]:
                    used[part].append(port)
        components = []
        for (name, plant), ports in zip(zip(read.parts, made, strict=True), used.values(), strict=True):
            values = {**(plant.options.get("parameters") or {}), **(plant.options.get("start") or {})}
            values |= {key.partition(".")[2]: x for key, x in read.initial.items() if key.partition(".")[0] == name}
            described = describe_fmu(plant.file.path)
            units = {row["name"]: row["si_unit"] or "1" for row in described["variables"]}
            known = ports_of(described, [*ports, *(key for key in values if key not in ports)])
            components.append(
                WrittenComponent(
                    name, Path(plant.file.path), known, {key: (x, units[key]) for key, x in values.items()}
                )
            )
        step, parallel = coupled.spec.sample_time, read.order == "jacobi"
        return write_structure(WrittenSystem(path.stem, components, wires, outer, step, parallel=parallel), target)


def _refuse_what_ssp_lacks(path: Path, read: Any, made: list[Any]) -> None:
    """Refuse parts that are no FMU, and what a structure of SSP 1.0 cannot say."""
    others = [name for name, plant in zip(read.parts, made, strict=True) if not hasattr(plant, "file")]
    lacking = {
        "delay": [f"{one.source} -> {one.target}" for one in read.connections if one.delay],
        "add": [f"{one.source} -> {one.target}" for one in read.connections if one.add],
        "hold": [read.hold] if read.hold != "constant" else [],
        "iterations": [str(read.iterations)] if read.iterations != 1 else [],
        "error": [str(read.error)] if read.error is not None else [],
    }
    found = [f"{key} ({', '.join(places)})" for key, places in lacking.items() if places]
    if others or found:
        raise InputError(
            "a coupling as an SSP package",
            expected="parts that are FMUs, and nothing that SSP 1.0 does not know",
            got=", ".join([*(f"the part {name!r}" for name in others), *found]),
            remedy="run it from TOML, or put an FMU in its place (sysid export)",
            file=path,
        )


def _end(name: str) -> tuple[str, str]:
    part, _, port = name.partition(".")
    return part, port


def _wire(source: str, target: str, gain: float, offset: float) -> WrittenConnection:
    """Return a connection; a source without a part is an input of the whole."""
    return WrittenConnection(_end(source) if "." in source else ("", source), _end(target), gain, offset)
