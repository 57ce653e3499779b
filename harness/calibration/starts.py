"""Where the states of a model begin: which starts the records can tell, and a first guess of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.calibration.runs import FreeRuns
from harness.errors import InputError
from harness.signals import FloatArray, Trajectory

__all__ = ["Told", "told_states"]

LOOK = 200
"""Samples within which the start of a state must have moved an output."""
NUDGE = 1e-2
"""By how much a start is moved, relative to its value, or [SI unit]."""
SEEN = 1e-7
"""Share of the nudge, in the unit of the output, below which an output counts as not moved."""


@dataclass(frozen=True)
class Told:
    """A state whose start moves an output; ``shown`` is the output that shows it as it is, None where none does."""

    row: int
    start: float
    shown: int | None


def told_states(
    runs: FreeRuns, p: FloatArray, starts: Sequence[float], records: Sequence[Trajectory], fixed: Mapping[str, float]
) -> list[Told]:
    """Return the states whose starts can be estimated from records.

    Parameters
    ----------
    runs : FreeRuns
        Of a model with all states that come into question.
    p : array (np,)
    starts : sequence of float
        Where they start by themselves.
    records : sequence of Trajectory
        The first excites.
    fixed : mapping
        Starts that the caller gave: they are known.
    """
    u = records[0].u[:LOOK]
    found = []
    for row, (channel, start) in enumerate(zip(runs.system.states, starts, strict=True)):
        if channel.name in fixed:
            continue
        nudge = NUDGE * max(1.0, abs(start))
        try:
            still = runs.simulate(p, {channel.name: start}, u)
            change = runs.simulate(p, {channel.name: start + nudge}, u) - still
        except InputError:  # its start is the model's own affair
            continue
        if not np.isfinite(change).all() or np.abs(change).max(initial=0.0) <= SEEN * nudge:
            continue
        shows = [
            k
            for k, output in enumerate(runs.system.outputs)
            if abs(change[0, k] - nudge) < 1e-6 * nudge and output.unit == channel.unit
        ]
        found.append(Told(row, float(start), shows[0] if shows else None))
    return found
