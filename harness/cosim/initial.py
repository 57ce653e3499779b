"""The first instant: parts that compute something from their inputs while they initialise, and what drives these.

A master sets the inputs of an FMU from the outputs that they are connected to while all FMUs initialise (FMI 2.0.5
sec. 4.2.4, Initialization Mode). Here a part is reset once more with what its inputs are then, for as long as that
moves something: once for each part without a loop, by fixed-point iteration in one. Where a loop has no fixed point
that is reached so, the parts in it begin at their own start values.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from harness.cosim.graph import PASSES
from harness.cosim.wiring import Part
from harness.signals import FloatArray

TINY = np.finfo(float).tiny
Reset = Callable[[Part, FloatArray], None]


def start_from_inputs(
    parts: Sequence[Part],
    signals: list[float],
    resting: Collection[int],
    reset: Reset,
    agree: Callable[[], None],
    tolerance: float,
) -> list[str]:
    """Reset the parts that tell the start values of their inputs (``input_starts``) with what drives them.

    Parameters
    ----------
    parts : sequence of Part
        All parts, reset, with their outputs in the signals.
    signals : list of float
        The common list of signals, kept up to date by ``reset`` and ``agree``.
    resting : collection of int
        Places of inputs that rest at their own start values.
    reset : callable
        ``reset(part, u)`` resets a part with the values of its inputs (nu,), in SI.
    agree : callable
        Brings signals into agreement that act within the instant.
    tolerance : float
        Relative change of an input that counts as none.

    Returns
    -------
    list of str
        The parts that begin at their own start values, as nothing else agrees.
    """
    own = {part.name: starts for part in parts if len(starts := _starts(part))}
    takers, stuck = [part for part in parts if part.name in own], []
    while moving := _settled(takers, own, signals, resting, reset, agree, tolerance):
        for part in moving:
            reset(part, own[part.name])
            takers.remove(part)
            stuck.append(part.name)
        agree()
    return stuck


def _settled(
    takers: Sequence[Part],
    own: Mapping[str, FloatArray],
    signals: list[float],
    resting: Collection[int],
    reset: Reset,
    agree: Callable[[], None],
    tolerance: float,
) -> list[Part]:
    """Reset parts with their inputs until nothing moves; returns those that still do where there is no end."""
    before, gap, moving = dict(own), np.inf, list[Part]()
    for count in range(PASSES):
        last, gap, moving = gap, 0.0, []
        for part in takers:
            old, new = before[part.name], part.read(signals)
            places = range(part.inputs.start, part.inputs.stop)
            new = np.where([place in resting for place in places], old, new)
            moved = float(np.max(np.abs(new - old) / np.maximum(np.maximum(np.abs(new), np.abs(old)), TINY)))
            if moved > 0.0:
                before[part.name] = new
                reset(part, new)
            if moved > tolerance:
                moving.append(part)
            gap = max(gap, moved)
        if not moving or (count >= len(takers) and gap >= last):  # the latter: a loop, and no way to its solution
            break
        agree()
    return moving


def _starts(part: Part) -> FloatArray:
    """Return the values (nu,) that a part's inputs have while it initialises; (0,) where it starts from none."""
    starts = np.asarray(getattr(part.plant, "input_starts", ()), dtype=np.float64)
    return starts if len(starts) == part.plant.spec.nu else np.zeros(0)
