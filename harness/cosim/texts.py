"""Texts and bytes between parts of a coupling: they travel beside the numbers, at communication instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

from harness.cosim.wiring import Connection
from harness.errors import InputError
from harness.protocols import Plant


class Speaks(Protocol):
    """A plant with variables that are no numbers: their types by name, and how they are read and set."""

    text_inputs: Mapping[str, str]
    text_outputs: Mapping[str, str]

    def texts(self, names: Sequence[str]) -> list[str | bytes]:
        """Return the present values of some outputs."""

    def put_texts(self, values: Mapping[str, str | bytes]) -> None:
        """Set inputs for the step to come."""


@dataclass(frozen=True)
class Texts:
    """The wires of a coupling that carry texts: source and target, each a plant and the name of its variable."""

    wires: tuple[tuple[Any, str, Any, str], ...]

    def move(self) -> None:
        """Set every target to what its source has now: all are read before any is set."""
        values = [source.texts([name])[0] for source, name, _, _ in self.wires]
        for (_, _, target, name), value in zip(self.wires, values, strict=True):
            target.put_texts({name: value})


def split(parts: Mapping[str, Plant], connections: Sequence[Connection]) -> tuple[list[Connection], Texts | None]:
    """Return the connections that carry numbers, and those that carry texts; None if there are none of these.

    Raises InputError if a text is connected to what is none, in more ways than one, or is to be changed on its way.
    """
    numbers, wires, driven = [], list[tuple[Any, str, Any, str]](), set[str]()
    for one in connections:
        source, of_source = _end(parts, one.source, "text_outputs")
        target, of_target = _end(parts, one.target, "text_inputs")
        if of_source is None and of_target is None:
            numbers.append(one)
            continue
        place = f"{one.source} -> {one.target}"
        if of_source != of_target:
            raise InputError(
                "connection of a text",
                expected="variables of one type at both ends",
                got=f"{of_source or 'a number'} to {of_target or 'a number'}",
                remedy="connect texts with texts, bytes with bytes",
                place=place,
            )
        if one.gain != 1.0 or one.offset != 0.0 or one.delay or one.add or one.transform is not None:
            raise InputError(
                "connection of a text",
                expected="none of gain, offset, delay, add",
                got="one of them",
                remedy="leave it out: a text is carried as it is",
                place=place,
            )
        if one.target in driven:
            raise InputError(
                "input driven twice", expected="one source", got="two", remedy="remove one connection", place=place
            )
        driven.add(one.target)
        wires.append((source, one.source.partition(".")[2], target, one.target.partition(".")[2]))
    return numbers, Texts(tuple(wires)) if wires else None


def _end(parts: Mapping[str, Plant], name: str, side: str) -> tuple[Speaks | None, str | None]:
    """Return the plant and the type of one end where it is no number."""
    head, _, tail = name.partition(".")
    plant = parts.get(head)
    kind = getattr(plant, side, {}).get(tail)
    return cast("Speaks | None", plant), kind
