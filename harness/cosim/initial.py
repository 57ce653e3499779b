"""The first instant: parts that compute something from their inputs while they initialise, and what drives these.

A master sets the inputs of an FMU from the outputs that they are connected to while all FMUs initialise (FMI 2.0.5
sec. 4.2.4, Initialization Mode): once for each part without a loop, by fixed-point iteration in one. Where a loop has
no fixed point that is reached so, the parts in it begin at their own start values.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, cast

import numpy as np

from harness.cosim.graph import PASSES
from harness.cosim.wiring import Part
from harness.signals import FloatArray

TINY = np.finfo(float).tiny
Put = Callable[[Part, FloatArray], None]


def initialise(
    parts: Sequence[Part],
    signals: list[float],
    wired: Collection[int],
    put: Put,
    agree: Callable[[], None],
    tolerance: float,
) -> list[str]:
    """Drive parts that initialise with what their inputs are connected to, until nothing moves.

    - ``parts``: those whose plants have ``drive`` and were entered
    - ``signals``: the common list of signals, which holds the outputs of all others
    - ``wired``: places of inputs that do not rest at their own start values
    - ``put``: ``put(part, y)`` stores outputs among the signals
    - ``agree``: brings the signals of other parts into agreement that act within the instant
    - ``tolerance``: relative change of an input that counts as none
    - returns the parts that begin at their own start values, as nothing else agrees
    """
    own = {part.name: np.asarray(cast(Any, part.plant).input_starts, dtype=np.float64) for part in parts}
    for part in parts:
        put(part, cast(Any, part.plant).drive(own[part.name]))
    agree()
    driven, stuck = list(parts), list[str]()
    while moving := _settled(driven, own, signals, wired, put, agree, tolerance):
        for part in moving:
            put(part, cast(Any, part.plant).drive(own[part.name]))
            driven.remove(part)
            stuck.append(part.name)
        agree()
    return stuck


def _settled(
    parts: Sequence[Part],
    own: Mapping[str, FloatArray],
    signals: list[float],
    wired: Collection[int],
    put: Put,
    agree: Callable[[], None],
    tolerance: float,
) -> list[Part]:
    """Drive parts with their inputs until nothing moves; returns those that still do where there is no end."""
    before, gap, moving = dict(own), np.inf, list[Part]()
    for count in range(PASSES):
        last, gap, moving = gap, 0.0, []
        for part in parts:
            old, new = before[part.name], part.read(signals)
            places = range(part.inputs.start, part.inputs.stop)
            new = np.where([place in wired for place in places], new, old)
            moved = float(np.max(np.abs(new - old) / np.maximum(np.maximum(np.abs(new), np.abs(old)), TINY)))
            if moved > 0.0:
                before[part.name] = new
                put(part, cast(Any, part.plant).drive(new))
            if moved > tolerance:
                moving.append(part)
            gap = max(gap, moved)
        if not moving or (count >= len(parts) and gap >= last):  # the latter: a loop, and no way to its solution
            break
        agree()
    return moving
