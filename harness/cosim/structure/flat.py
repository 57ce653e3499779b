"""What a system is once it is laid flat: FMUs with the values that they start from, wires, inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.cosim.structure.conversion import Chain
from harness.errors import InputError

Describe = Callable[[Path], dict[str, Any]]
"""Tells what is in an FMU: rows of variables with unit, scale and offset to SI, and its experiment."""

Way = tuple[str, ...]
REALS = {"Real", "Float64", "Float32"}


@dataclass
class FlatComponent:
    """An FMU: what it is asked for, and the values that it starts from, in SI."""

    name: str
    label: str
    path: Path
    about: dict[str, Any]
    rows: dict[str, dict[str, Any]]
    kind: str | None = None
    step: float | None = None
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    parameters: dict[str, Any] = field(default_factory=dict)
    start: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FlatWire:
    """``component.output`` or an input of the system, to ``component.input``."""

    source: str
    target: str
    chain: Chain
    add: bool = False


@dataclass(frozen=True)
class FlatInput:
    """An input of the whole: its SI unit, the value it starts from in SI, and the type the file gives it."""

    name: str
    unit: str
    start: float
    type: str | None


@dataclass(frozen=True)
class FlatOutput:
    """An output of the whole: where it comes from; ``unit`` None where it is the source's own channel."""

    name: str
    source: str
    chain: Chain
    unit: str | None


@dataclass
class FlatSystem:
    """Everything that stepping needs."""

    components: list[FlatComponent]
    wires: list[FlatWire]
    inputs: list[FlatInput]
    outputs: list[FlatOutput]
    notes: list[str]


def named(error: InputError, component: str, fmu: Path, path: Path) -> InputError:
    """Return an error that says in which component of a system it arose: the unpacked FMU is gone when it is read."""
    remedy = error.remedy
    if str(fmu) in remedy and path.is_file() and path.suffix.lower() == ".ssp":
        remedy = f"unzip {path.name}, mend {fmu.name} there ({remedy.replace(str(fmu), fmu.name)}), run the folder"
    return InputError(
        f"component {component!r} ({fmu.name}): {error.what}",
        expected=error.expected,
        got=error.got,
        remedy=remedy,
        file=path,
        place=error.place,
    )


def dotted(way: Way, name: str) -> str:
    """Return the hierarchical name of something on its way."""
    return ".".join((*way, name))


def channels_of(name: str, shape: Sequence[int]) -> list[str]:
    """Return the channels of a variable: its own name, or one for each element of an array."""
    if not shape:
        return [name]
    return [f"{name}[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(*shape)]


def members(name: str, count: int) -> list[str]:
    """Return the names of so many numbers of one name, counted from 1."""
    return [name] if count == 1 else [f"{name}[{at + 1}]" for at in range(count)]


def each(value: Any, chain: Chain) -> Any:
    """Return a number, or each of a list, after a chain; what is no number stays."""
    if chain == Chain() or isinstance(value, str | bytes):
        return value
    if isinstance(value, list):
        return [each(one, chain) for one in value]
    return chain(float(value))


def start_of(row: dict[str, Any]) -> float | None:
    """Return a variable's own start value in SI."""
    words = str(row["start"] or "").split()
    if not words:
        return None
    if words[0] in ("true", "false"):
        return float(words[0] == "true")
    try:
        value = float(words[0])
    except ValueError:
        return None
    return value if row["scale"] is None else row["scale"] * value + row["offset"]
