"""The first instant: parts that compute something from their inputs while they initialise, and what drives these.

A master sets the inputs of an FMU from the outputs that they are connected to while all FMUs initialise (FMI 2.0.5
sec. 4.2.4, Initialization Mode). Here a part is reset once more with what its inputs are then, for as long as that
moves something: once for each part without a loop, by fixed-point iteration in one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from harness.cosim.graph import PASSES
from harness.cosim.wiring import Part
from harness.signals import FloatArray

log = logging.getLogger(__name__)
TINY = np.finfo(float).tiny


def start_from_inputs(
    parts: Sequence[Part],
    signals: list[float],
    resting: Collection[int],
    reset: Callable[[Part, Mapping[str, float]], None],
    agree: Callable[[], None],
    tolerance: float,
) -> None:
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
        ``reset(part, inputs)`` resets a part with the values of its inputs by name, in SI.
    agree : callable
        Brings signals into agreement that act within the instant.
    tolerance : float
        Relative change of an input that counts as none.
    """
    before = {part.name: starts for part in parts if len(starts := _starts(part))}
    gap = np.inf if before else 0.0
    for count in range(PASSES):
        last, gap = gap, 0.0
        for part in parts:
            if part.name in before:
                old, new = before[part.name], part.read(signals)
                places = range(part.inputs.start, part.inputs.stop)
                new = np.where([place in resting for place in places], old, new)
                moved = np.abs(new - old) / np.maximum(np.maximum(np.abs(new), np.abs(old)), TINY)
                if moved.any():
                    before[part.name] = new
                    reset(part, {c.name: x for c, x in zip(part.plant.spec.inputs, new.tolist(), strict=True)})
                gap = max(gap, float(moved.max()))
        if gap <= tolerance:
            return
        agree()
        if count >= len(parts) and gap >= last:  # a loop, and no way towards its solution
            break
    log.warning("%s start from what depends on them, and do not agree: taken as they are", ", ".join(before))


def _starts(part: Part) -> FloatArray:
    """Return the values (nu,) that a part's inputs have while it initialises; (0,) where it starts from none."""
    starts = np.asarray(getattr(part.plant, "input_starts", ()), dtype=np.float64)
    return starts if len(starts) == part.plant.spec.nu else np.zeros(0)
