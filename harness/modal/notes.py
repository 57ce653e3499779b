"""What records of a structure cannot tell, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.judgement import feedback_of
from harness.modal.poles import Mode
from harness.modal.subspace import FEWEST, Ladder
from harness.signals import Trajectory

FAINT = 1e-3
"""Power of an input at a frequency, over its largest, below which the input does not count as exciting there."""
TONE = 5e-4
"""Damping ratio below which a mode without input is taken for a steady tone: no structure has so little."""


def notes_of(
    records: Sequence[Trajectory], shown: Ladder, identifier: str | None, passing: int, modes: Sequence[Mode]
) -> list[str]:
    """Return sentences on inputs, lengths and modes that the records leave undetermined.

    Parameters
    ----------
    records : sequence of Trajectory
    shown : Ladder
        Of the records.
    identifier : str or None
        None for the subspace fit of this room.
    passing : int
        Rows of poles that are no modes.
    modes : sequence of Mode
    """
    spec = records[0].spec
    notes = []
    if len({channel.unit for channel in spec.outputs}) > 1:
        notes.append("the outputs have several units: shapes are over the standard deviation of each")
    if identifier is None and not shown.known:
        notes.append(
            f"no intervals: the records make {len(shown.shifted)} stretches of several windows, fewer than "
            f"{FEWEST + 1}; record longer, or give a smaller window"
        )
    if identifier is not None:
        notes.append(
            "the intervals hold what chance does to this identifier, not what it leaves out: dmdc takes noise of the "
            "outputs for motion"
        )
    if identifier is not None and any(not np.isfinite(mode.pole.frequency_deviation) for mode in modes):
        notes.append("a mode without an interval was not found again when a stretch was left out")
    if spec.nu:
        low, high = _excited(records)
        notes.append(
            f"the inputs hold power from {low:.3g} to {high:.3g} Hz: a mode outside, or one that no input reaches, is "
            "found only if something else moves it"
        )
        if identifier is None and feedback_of(records).found:
            notes.append(
                "past outputs foretell the input (feedback): frequencies and damping here have the bias of noise, "
                "which no interval holds"
            )
    else:
        notes.append(
            "no input: shapes have no scale, a mode that the surroundings do not excite or no sensor sees is not here, "
            "and a resonance or a tone of the excitation passes for a mode"
        )
        tones = [f"{mode.frequency:.4g}" for mode in modes if mode.damping_interval[1] < TONE]
        if tones:
            notes.append(f"at {', '.join(tones)} Hz nothing is damped: a tone of a machine rather than a mode")
    if passing:
        notes.append(f"{passing} rows of poles changed with the order and count as no modes (grey in the diagram)")
    return notes


def _excited(records: Sequence[Trajectory]) -> tuple[float, float]:
    """Return between which frequencies [Hz] any of the inputs has power."""
    from scipy.signal import welch

    longest = max(records, key=len)
    low, high = np.inf, 0.0
    for column in longest.u.T:
        length = min(max(len(column) // 8, 64), len(column))
        frequency, power = welch(column, 1.0 / longest.spec.sample_time, nperseg=length)
        held = frequency[power > FAINT * power.max()] if power.max() > 0 else frequency[:0]
        if held.size:
            low, high = min(low, float(held[0])), max(high, float(held[-1]))
    return (low, high) if high > 0 else (0.0, 0.0)
