"""Torque logs of an arm that cannot be what the joints did: stuck, saturated, constant or chattering.

A torque is the input of the arm, but it is measured like an output: so what is asked of any sensor is asked of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.data.oddities.levels import saturated, stuck
from harness.diagnosis.policy import ARM_POLICY
from harness.diagnosis.records.motion import ORDER, motion_band
from harness.signals import FloatArray, Run, Trajectory

BLOCK = 100


def check_torques(runs: Sequence[Run]) -> list[str]:
    """Return what is to be said about the torques of the records of an arm.

    Parameters
    ----------
    runs : sequence of Run
        Inputs are the torques, the first outputs the positions of the same joints.
    """
    notes = []
    for number, run in enumerate(runs):
        record = run.trajectory
        dt, n = record.spec.sample_time, record.spec.nu
        moving = [record.y[:, k] for k in range(min(n, record.spec.ny)) if np.ptp(record.y[:, k]) > 0]
        band = max((motion_band(y, dt)[0] for y in moving), default=0.0)
        for k in range(n):
            notes += [f"run {number} ({run.use}): {text}" for text in _torque(record, k, band)]
    return notes


def chatter(torque: FloatArray, sample_time: float, band: float) -> tuple[float, float]:
    """Return for how much of the time a torque swings fast between two levels, and how fast.

    Noise that feedback puts on a torque is as fast, but spreads like noise; a limit cycle stays near its amplitude.

    Parameters
    ----------
    torque : array (N,)
    sample_time : float
        [s]
    band : float
        Band of the motion [Hz].

    Returns
    -------
    (float, float)
        Share of the blocks of 100 samples in which the part above four times the band is loud and flat in its
        distribution; frequency of its strongest line there [Hz].

    Examples
    --------
    >>> t = np.arange(2000) * 0.005
    >>> slow = 20 * np.sin(2 * np.pi * 0.4 * t)
    >>> share, frequency = chatter(slow + 8 * np.sign(np.sin(2 * np.pi * 33 * t)), 0.005, 0.5)
    >>> round(share, 1), round(frequency)
    (1.0, 34)
    >>> dry_friction, noise = 8 * np.sign(np.cos(2 * np.pi * 0.4 * t)), np.random.default_rng(0).normal(0, 8, 2000)
    >>> [chatter(slow + fast, 0.005, 0.5)[0] for fast in (dry_friction, noise)]
    [0.0, 0.0]
    """
    from scipy import signal

    moved = torque - torque.mean()
    size = float(np.sqrt(np.mean(moved**2)))
    corner = 2 * ARM_POLICY.faster * band * sample_time
    count = len(moved) // BLOCK
    if not size > 0 or not 0 < corner < 0.9 or not count:
        return 0.0, 0.0
    sos = signal.butter(ORDER, corner, "highpass", output="sos")
    fast = signal.sosfiltfilt(sos, moved, padlen=min(int(8 / corner), len(moved) - 1))
    blocks = fast[: count * BLOCK].reshape(count, BLOCK)
    square = np.mean(blocks**2, axis=1).clip(1e-300)
    swings = (square > (ARM_POLICY.loud * size) ** 2) & (np.mean(blocks**4, axis=1) < ARM_POLICY.flat * square**2)
    power = (np.abs(np.fft.rfft(blocks[swings] * np.hanning(BLOCK), axis=1)) ** 2).sum(axis=0)
    return float(np.mean(swings)), float(np.argmax(power)) / (BLOCK * sample_time)


def _torque(record: Trajectory, k: int, band: float) -> list[str]:
    """Return what is to be said about one torque of one record."""
    channel, values, dt = record.spec.inputs[k], record.u[:, k], record.spec.sample_time
    if not np.ptp(values):
        return [f"torque {channel.name} is constant ({values[0]:g} {channel.unit}): not measured, or not driven?"]
    notes = [*stuck(channel, values, dt, "torque"), *saturated(channel, values, "torque").values()]
    share, frequency = chatter(values, dt, band)
    if share > ARM_POLICY.often:
        notes.append(
            f"torque {channel.name} chatters for {100 * share:.0f} % of the time near {frequency:.3g} Hz, where the "
            "joint hardly follows: a limit cycle of the controller? Friction at that joint is not to be trusted"
        )
    return notes
