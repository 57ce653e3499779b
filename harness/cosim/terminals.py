"""Connections of terminals: one line of a coupling for all variables that belong together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from harness.cosim.wiring import Connection
from harness.errors import InputError
from harness.fmi.terminals import Terminal, joined, read_terminals
from harness.protocols import Plant


def expanded(
    connections: Sequence[Connection], parts: Mapping[str, Plant], files: Mapping[str, Path]
) -> list[Connection]:
    """Return connections with those of terminals written out, variable by variable.

    Parameters
    ----------
    connections : sequence of Connection
        One whose ends are ``"part.terminal"`` joins two terminals; which end drives which is told by the variables.
    parts : mapping of str to Plant
    files : mapping of str to Path
        The FMUs among the parts.

    Raises
    ------
    InputError
        If a terminal is connected to what is none, the two do not fit, or two variables are no output and input.
    """
    known: dict[str, dict[str, Terminal]] = {}

    def terminal(end: str, side: str) -> Terminal | None:
        name, _, tail = end.partition(".")
        if name not in files or tail in _names(parts[name], side):
            return None
        if name not in known:
            known[name] = read_terminals(files[name])
        return known[name].get(tail)

    found: list[Connection] = []
    for one in connections:
        first, second = terminal(one.source, "outputs"), terminal(one.target, "inputs")
        if first is None and second is None:
            found.append(one)
            continue
        place = f"{one.source} -> {one.target}"
        if first is None or second is None:
            raise InputError(
                "connection of a terminal",
                expected="a terminal at both ends",
                got=f"a variable or an unknown name at {one.source if first is None else one.target}",
                remedy="connect terminal with terminal, or the variables one by one",
                place=place,
            )
        if one.gain != 1.0 or one.offset != 0.0 or one.add or one.gain_unit != "1":
            raise InputError(
                "connection of a terminal",
                expected="no gain, offset or add: it holds for all of its variables",
                got="one of them",
                remedy="connect the variables one by one",
                place=place,
            )
        ends = one.source.partition(".")[0], one.target.partition(".")[0]
        pairs = joined(first, second)
        if not pairs:
            raise InputError(
                "connection of a terminal",
                expected="a member that both ends have",
                got="none",
                remedy="connect the variables one by one",
                place=place,
            )
        for pair in pairs:
            there, back = (
                ((ends[0], pair.first), (ends[1], pair.second)),
                ((ends[1], pair.second), (ends[0], pair.first)),
            )
            way = next((way for way in (there, back) if _drives(parts, *way)), None)
            if way is None:
                raise InputError(
                    f"variables of a terminal ({pair.place})",
                    expected="an output at one end and an input at the other",
                    got=f"{ends[0]}.{pair.first} and {ends[1]}.{pair.second}",
                    remedy="connect the variables one by one, or choose them (options: inputs, outputs)",
                    place=place,
                )
            (source, name), (target, other) = way
            found += [
                Connection(f"{source}.{a}", f"{target}.{b}", pair.gain, one.delay)
                for a, b in zip(
                    _elements(parts[source], name, "outputs"), _elements(parts[target], other, "inputs"), strict=True
                )
            ]
    return found


def _drives(parts: Mapping[str, Plant], source: tuple[str, str], target: tuple[str, str]) -> bool:
    """Return True if a variable is an output, the other an input, and both of one size."""
    out, into = _elements(parts[source[0]], source[1], "outputs"), _elements(parts[target[0]], target[1], "inputs")
    return bool(out) and len(out) == len(into)


def _elements(plant: Plant, name: str, side: str) -> list[str]:
    """Return the channels of a variable: itself, or the elements of an array; none if it is not on this side."""
    return [one for one in _names(plant, side) if one == name or one.startswith(f"{name}[")]


def _names(plant: Plant, side: str) -> list[str]:
    """Return the numbers and texts that a part has on one side."""
    texts = getattr(plant, "text_outputs" if side == "outputs" else "text_inputs", {})
    return [*(channel.name for channel in getattr(plant.spec, side)), *texts]
