"""Ports, coordinates and blocks: the small parts of a system that effects work with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from harness.signals import Channel

PortKind = Literal["input", "coordinate", "output", "base", "process", "mass"]


@dataclass(frozen=True)
class Port:
    """A place where an effect can act."""

    kind: PortKind
    name: str
    unit: str


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate: where it stands in the state, and the unit of the force that works on it.

    ``q`` and ``v`` are indices into ``System.x``; ``force`` is the index into ``generalized_forces``.
    """

    name: str
    unit: str
    force_unit: str
    q: int
    v: int
    force: int


@dataclass(frozen=True)
class SampledBlock:
    """An effect on samples rather than on equations.

    ``kind`` is ``"input_delay"`` (column ``index`` of u), ``"output_delay"`` (column ``index`` of y) or
    ``"quantise"`` (column ``index`` of y); ``parameter`` is the full name of its parameter: a delay in s, or the step
    of the quantiser in the unit of the output. The simulator carries it out and knows its derivative (a quantiser's is
    taken as 0). ``before`` is the full name of a hidden state of an input delay: by how much what went in before the
    record was off its first value; without it, nothing.
    """

    kind: Literal["input_delay", "output_delay", "quantise"]
    index: int
    parameter: str
    before: str = ""


@dataclass(frozen=True)
class Hidden:
    """A state that an effect brings: its channel, its derivative and where it starts.

    ``initial`` is an SX in the system's x (coordinates, rates), u and p, or None for 0.
    """

    channel: Channel
    symbol: Any
    derivative: Any
    initial: Any = None


@dataclass(frozen=True, eq=False)
class BodyTerm:
    """What one body adds to the mass matrix and to the generalized forces, for effects such as a payload.

    ``coordinates`` are the indices of the coordinates that move it. Adding ``k * mass_matrix`` and ``k * forces`` is
    the same as making the body ``1 + k`` times as heavy.
    """

    coordinates: tuple[int, ...]
    mass_matrix: Any
    forces: Any
