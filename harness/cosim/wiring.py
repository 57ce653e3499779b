"""The wiring of a coupling: parts laid out in common arrays, connections checked by name and unit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Literal

import numpy as np

from harness.errors import InputError
from harness.protocols import Plant
from harness.signals import Channel, FloatArray
from harness.units import convert, fits


@dataclass(frozen=True)
class Connection:
    """One wire: ``source`` drives ``target``.

    Parameters
    ----------
    source, target : str
        ``"part.output"`` or the bare name of an external input; ``"part.input"``.
    gain : float
        Factor on the signal; units of one kind are converted by themselves.
    gain_unit : str or None
        Unit of the gain where the two ends measure different things, ``"1/m"`` from a position to a bare number; None
        to take the numbers in SI as they are, whatever they measure.
    delay : int
        Delay in communication steps; before it has passed, the source's first value is seen.
    add : bool
        True to add to what other connections bring to the same target; without it a second wire is refused.
    offset : float
        Added to what arrives, in SI.
    transform : callable, optional
        From the source's number in SI to the target's, in place of gain, offset and units.
    """

    source: str
    target: str
    gain: float = 1.0
    delay: int = 0
    add: bool = False
    gain_unit: str | None = "1"
    offset: float = 0.0
    transform: Callable[[float], float] | None = None


@dataclass(frozen=True)
class ShownOutput:
    """An output of the whole: ``"part.output"`` or an external input, its channel, and what is done to the number."""

    source: str
    channel: Channel
    transform: Callable[[float], float] | None = None


@dataclass(eq=False)
class Part:
    """A plant in the coupling: where its signals lie in the common arrays, and when it is due."""

    name: str
    plant: Plant
    inputs: slice
    outputs: slice
    every: int
    held: FloatArray = field(default_factory=lambda: np.array(()))
    read: Callable[[list[float]], FloatArray] = field(default=lambda signals: np.array(signals))
    """Makes the inputs out of the common list of signals."""

    @property
    def feeds_through(self) -> bool:
        """True if an output of the part depends on an input of the same instant."""
        return self.plant.spec.feedthrough


@dataclass(eq=False)
class Wire:
    """A checked connection between slots of the common list of signals.

    The list holds the outputs of all parts, then the external inputs, then one slot for each delayed wire with what
    comes out of its delay line now; so every wire, late or not, reads one slot.
    """

    source: int
    slot: int
    external: bool
    target: int
    factor: float
    shift: float
    delay: int
    transform: Callable[[float], float] | None = None
    memory: deque[float] = field(default_factory=deque)


def channel_of(parts: Sequence[Part], name: str, side: Literal["inputs", "outputs"]) -> Channel:
    """Return the channel behind ``"part.signal"``, or refuse the name."""
    head, _, tail = name.partition(".")
    for part in parts:
        if part.name == head:
            channels: tuple[Channel, ...] = getattr(part.plant.spec, side)
            for channel in channels:
                if channel.name == tail:
                    return channel
            raise InputError(
                f"unknown signal of part {head!r}",
                expected=f"one of its {side}: {', '.join(c.name for c in channels) or 'none'}",
                got=repr(tail),
                remedy="correct the name",
                place=name,
            )
    raise InputError(
        "unknown part",
        expected=f"one of {', '.join(p.name for p in parts)}",
        got=repr(head),
        remedy="write part.signal",
        place=name,
    )


def locate(parts: Sequence[Part], name: str, side: Literal["inputs", "outputs"]) -> int:
    """Return the place of a signal in the common array."""
    channel = channel_of(parts, name, side)
    part = next(p for p in parts if p.name == name.partition(".")[0])
    start: int = getattr(part, side).start
    channels: tuple[Channel, ...] = getattr(part.plant.spec, side)
    return start + channels.index(channel)


def check_wires(parts: Sequence[Part], connections: Sequence[Connection], external: Sequence[Channel]) -> list[Wire]:
    """Return the wires, or refuse a name, a unit, an input driven twice or left open."""
    by_name = {channel.name: i for i, channel in enumerate(external)}
    ny = sum(part.plant.spec.ny for part in parts)
    wires: list[Wire] = []
    driven: dict[int, Connection] = {}
    for one in connections:
        outside = one.source in by_name
        source = external[by_name[one.source]] if outside else channel_of(parts, one.source, "outputs")
        target = channel_of(parts, one.target, "inputs")
        place = locate(parts, one.target, "inputs")
        if place in driven and not (one.add and driven[place].add):
            raise InputError(
                "input driven twice",
                expected=f"one source for {one.target}",
                got=f"{driven[place].source} and {one.source}",
                remedy="remove one connection, or set add=True on both",
                place=f"{one.source} -> {one.target}",
            )
        driven[place] = one
        unit = target.unit if one.gain_unit is None else _product(source.unit, one.gain_unit)
        if one.gain_unit is not None and not fits(unit, target.unit):
            raise InputError(
                "units of a connection",
                expected=f"a source in a unit that converts to {target.unit!r}",
                got=f"{source.unit!r}" + (f" with a gain in {one.gain_unit!r}" if one.gain_unit != "1" else ""),
                remedy="connect signals of one kind, or give the gain a unit (gain_unit)",
                place=f"{one.source} -> {one.target}",
            )
        if one.delay < 0:
            raise InputError("delay", expected=">= 0 steps", got=str(one.delay), remedy="correct it")
        shift, end = convert(np.array([0.0, 1.0]), unit, target.unit)
        where = ny + by_name[one.source] if outside else locate(parts, one.source, "outputs")
        slot = where if one.delay == 0 else ny + len(external) + sum(wire.delay > 0 for wire in wires)
        factor, added = one.gain * float(end - shift), float(shift) + one.offset
        wires.append(Wire(where, slot, outside, place, factor, added, one.delay, one.transform))
    for part in parts:
        for offset, channel in enumerate(part.plant.spec.inputs):
            if part.inputs.start + offset not in driven:
                raise InputError(
                    "input left open",
                    expected=f"a connection to {part.name}.{channel.name}",
                    got="none",
                    remedy="connect it, or make it an external input",
                )
        first, last = part.inputs.start, part.inputs.stop
        own = sorted((wire for wire in wires if first <= wire.target < last), key=lambda wire: wire.target)
        part.read = _reader(
            [(one.target - first, one.slot, one.factor, one.shift, one.transform) for one in own], last - first
        )
    return wires


def reader(slots: Sequence[int]) -> Callable[[list[float]], FloatArray]:
    """Return a function that picks slots out of the common list into a new array; the fastest for their number."""
    if len(slots) == 1:
        only = slots[0]
        return lambda signals: np.array((signals[only],))
    if not slots:
        return lambda signals: np.zeros(0)
    pick = itemgetter(*slots)
    return lambda signals: np.array(pick(signals))


def shower(taps: Sequence[tuple[int, Callable[[float], float] | None]]) -> Callable[[list[float]], FloatArray]:
    """Return a function that makes the outputs of the whole from the slot of each and the transform of its number."""
    if all(transform is None for _, transform in taps):
        return reader([slot for slot, _ in taps])
    lines = [(slot, _same if transform is None else transform) for slot, transform in taps]
    return lambda signals: np.array([transform(signals[slot]) for slot, transform in lines])


def _same(x: float) -> float:
    return x


Tap = tuple[int, int, float, float, Callable[[float], float] | None]
"""Input, slot, factor, shift and transformation of a wire."""


def _reader(taps: Sequence[Tap], count: int) -> Callable[[list[float]], FloatArray]:
    """Return what makes the inputs of a part out of the common list, the taps being in order of input."""
    straight = all(transform is None for *_, transform in taps)
    plain = straight and all(factor == 1.0 and shift == 0.0 for _, _, factor, shift, _ in taps)
    if len(taps) == count and plain:
        return reader([slot for _, slot, *_ in taps])
    if len(taps) == count == 1 and straight:
        _, only, scale, offset, _ = taps[0]
        return lambda signals: np.array((scale * signals[only] + offset,))
    if len(taps) == count and straight:
        lines = [(slot, factor, shift) for _, slot, factor, shift, _ in taps]
        return lambda signals: np.array([factor * signals[slot] + shift for slot, factor, shift in lines])

    def add(signals: list[float]) -> FloatArray:
        values = [0.0] * count
        for i, slot, factor, shift, transform in taps:
            values[i] += factor * signals[slot] + shift if transform is None else transform(signals[slot])
        return np.array(values)

    return add


def _product(unit: str, gain: str) -> str:
    """Return the unit of a signal times a gain."""
    if gain.strip() in ("", "1"):
        return unit
    return gain if unit.strip() in ("", "1", "-") else f"({unit}) * ({gain})"


def place(parts: Mapping[str, Plant], step: float) -> list[Part]:
    """Lay the parts' signals out in common arrays, and count their steps in communication steps."""
    placed: list[Part] = []
    nu = ny = 0
    for name, plant in parts.items():
        if not name or "." in name:
            raise InputError("name of a part", expected="a name without a dot", got=repr(name), remedy="rename it")
        ratio = plant.spec.sample_time / step
        every = round(ratio)
        if every < 1 or abs(ratio - every) > 1e-9 * every:
            raise InputError(
                f"sample time of part {name!r}",
                expected=f"an integer multiple of the communication step {step:g} s",
                got=f"{plant.spec.sample_time:g} s",
                remedy="choose a communication step that divides the sample times of all parts",
            )
        spec = plant.spec
        placed.append(Part(name, plant, slice(nu, nu + spec.nu), slice(ny, ny + spec.ny), every))
        nu, ny = nu + spec.nu, ny + spec.ny
    return placed
