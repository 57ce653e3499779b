"""What a fit to a closed loop has to say where the load hides the plant: its own spread, weighed by the input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.judgement import Feedback
from harness.models.spread import gains
from harness.signals import FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel

__all__ = ["hidden_by_load"]

HALF = 0.5
"""Uncertainty of the response, over the response itself and weighed by the input's power, from which on it is said."""
LINES = 64
"""Frequencies that are looked at, of the half circle."""


def hidden_by_load(
    model: LinearModel, records: Sequence[Trajectory], feedback: Feedback, notes: dict[str, Any]
) -> None:
    """Note a warning where outputs foretell the inputs and the fit scatters by half of the response.

    In a loop whose controller answers a load, inputs move mostly with the load, and what they do is told by the
    set-point alone (Ljung 1999, sec. 13.4: only the part of the input that the reference brings counts). The judge of
    feedback sees that something moves the input, and a fit exists; whether it means anything its spread says.

    Parameters
    ----------
    model : LinearModel
        With its spread, in the units of the records; without a spread nothing is said.
    records : sequence of Trajectory
    feedback : Feedback
        Of the records.
    notes : dict
        Gets the ``"warning"`` where it has none.
    """
    if not feedback.found or model.spread is None or "warning" in notes:
        return
    frequency = np.linspace(0.0, 0.5, LINES + 1)[1:]
    power = _power(records)
    middle = gains(model.matrices, frequency, 1.0)
    size = float(np.einsum("fyu,fu->", np.abs(middle) ** 2, power))
    with np.errstate(over="ignore", invalid="ignore"):
        away = [np.abs(gains(one, frequency, 1.0) - middle) ** 2 for one in model.spread.models]
        scatter = float(model.spread.factor * np.einsum("gfyu,fu->", np.array(away), power))
    share = np.sqrt(scatter / size) if size > 0 else float("inf")
    if share < HALF:
        return
    said = f"{100 * share:.0f} %" if np.isfinite(share) and share < 10 else "more than ten times itself"
    notes["warning"] = (
        f"the inputs answer the outputs (feedback), and what else moves them hardly shows in the load: the response is "
        f"uncertain by {said} where the input has its power; move the set-point more, or longer"
    )


def _power(records: Sequence[Trajectory]) -> FloatArray:
    """Return the power of the inputs at the lines (LINES, nu), each output counted alike."""
    total = np.zeros((LINES, records[0].spec.nu))
    for record in records:
        u = record.u - record.u.mean(axis=0)
        found = np.abs(np.fft.rfft(u, axis=0)) ** 2
        place = np.minimum((np.arange(len(found)) * 2 * LINES) // max(len(u), 1), LINES - 1)
        for line, row in zip(place, found, strict=True):
            total[line] += row
    return total
