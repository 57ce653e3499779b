"""What is in a system, for a person or for JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.cosim.structure.flat import Describe
from harness.cosim.structure.flatten import flatten
from harness.cosim.structure.open import opened

__all__ = ["Describe", "describe_structure"]


def describe_structure(path: str | Path, describe: Describe) -> dict[str, Any]:
    """Return the components, connections, values and experiment of a system of FMUs.

    Parameters
    ----------
    path : path
        An SSP package or folder, or an OSP system structure.
    describe : callable
        Tells what is in an FMU.

    Returns
    -------
    dict
        ``file``, ``name``, ``experiment``, ``exchange``, ``components``, ``connections``, ``inputs``, ``outputs``
        and ``notes``.

    Raises
    ------
    InputError
        If it cannot be read, or needs what is not understood.
    """
    with opened(path) as found:
        description = found.description
        flat = flatten(description, describe)
    labels = {one.name: one.label for one in flat.components}

    def dotted(name: str) -> str:
        head, dot, tail = name.partition(".")
        return f"{labels.get(head, head)}{dot}{tail}"

    return {
        "file": str(path),
        "name": description.name,
        "experiment": {"startTime": description.start, "stopTime": description.stop, "stepSize": description.step},
        "exchange": description.exchange,
        "components": [
            {
                "name": one.label,
                "fmu": one.path.name,
                "fmi": one.about["fmi"],
                "tool": one.about["tool"],
                "platforms": one.about["platforms"],
                "values": {**one.parameters, **one.start},
            }
            for one in flat.components
        ],
        "connections": [
            {"from": dotted(wire.source), "to": dotted(wire.target), "change": _words(wire.chain)}
            for wire in flat.wires
        ],
        "inputs": [{"name": one.name, "si_unit": one.unit, "start": one.start} for one in flat.inputs],
        "outputs": [{"name": one.name, "from": dotted(one.source)} for one in flat.outputs],
        "notes": flat.notes,
    }


def _words(chain: Any) -> str:
    """Return what a chain does, in words."""
    line = chain.linear
    if line is None:
        return "table"
    if (line.factor, line.offset) == (1.0, 0.0):
        return ""
    return f"{line.factor:g} x" + (f" {line.offset:+g}" if line.offset else "")
