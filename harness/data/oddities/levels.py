"""Values at which readings pile up or move in steps: rails and encoders."""

from __future__ import annotations

import numpy as np

from harness.data.oddities.held import runs_of_equal, step_of, stuck_rows
from harness.data.oddities.numbers import ODD
from harness.signals import Channel, FloatArray


def stuck(channel: Channel, values: FloatArray, dt: float, kind: str = "output") -> list[str]:
    """Say that a sensor stood still while it otherwise never does."""
    found = stuck_rows(values)
    if not found:
        return []
    starts, lengths = runs_of_equal(values)
    first, length = found[0]
    elsewhere = int(lengths[~np.isin(starts, [row for row, _ in found])].max())
    where = f"at {values[first]:g} {channel.unit} for {length} samples from sample {first} ({length * dt:g} s)"
    if len(found) > 1:
        spans = [rows for _, rows in found]
        least = f"{min(spans)} to " if min(spans) < max(spans) else ""
        where = f"in {len(found)} places for {least}{max(spans)} samples, first {where}"
    return [
        f"{kind} {channel.name} stands still {where} while elsewhere it does not for more than {elsewhere}: a stuck "
        "sensor or a drop-out?"
    ]


def saturated(channel: Channel, values: FloatArray, kind: str = "output") -> dict[float, str]:
    """Return the largest and the smallest value at which a sensor rests in several places, and what is to be said."""
    if np.unique(values[:2000]).size < 8 or coarse_step(values):
        return {}
    starts, lengths = runs_of_equal(values)
    notes = {}
    typical = float(np.percentile(lengths, 95))  # an encoder rests a while wherever the motion turns
    # a signal that settles or sticks arrives slowly, one that meets a rail would have gone on; at rest it began
    moves = np.diff(values)
    usual = float(np.median(np.abs(moves[moves != 0]))) if moves.any() else 0.0
    gone_on = np.array([0.0 if start < 4 else 3 * moves[start - 2] - 2 * moves[start - 3] for start in starts])
    arrived = np.abs(gone_on) >= ODD.on_its_way * usual
    arrived &= np.sign(gone_on) == np.where(values[starts] == values.max(), 1.0, -1.0)
    for limit, word in ((values.max(), "largest"), (values.min(), "smallest")):
        at = lengths[(values[starts] == limit) & arrived]
        if not at.size:
            continue
        inside = int(at.sum())
        if inside >= max(8, 0.003 * len(values)) and at.max() >= max(5, 5 * typical):
            notes[float(limit)] = (
                f"{kind} {channel.name} rests at its {word} value {limit:g} {channel.unit} for {inside} samples in "
                f"{at.size} places: a saturated sensor or an end stop?"
            )
    return notes


def coarse_step(values: FloatArray) -> float:
    """Return the step of readings that is larger than what else they scatter by; 0 if there is none.

    Examples
    --------
    >>> y = np.sin(0.01 * np.arange(1000.0))
    >>> coarse_step(y), round(coarse_step(np.round(y / 0.05) * 0.05), 12)
    (0.0, 0.05)
    """
    step = step_of(values)
    if not step or len(np.unique(values)) < 3:
        return 0.0
    moves = np.abs(np.diff(values))
    return step if float(np.percentile(moves, 75)) <= ODD.coarse * step else 0.0
