"""A lower sample rate for records without a moving input, sampled far above the band of their motion.

A free swing recorded at 1 kHz says no more about the plant than the same swing at 100 Hz, and costs ten times as much
in every refit. An input that moves between two kept samples could not be given to a model any more, so records with
one stay as they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.motion import motion_band
from harness.signals import Dataset, FloatArray, Run, Trajectory

__all__ = ["thinned_dataset", "white_keeping_filter"]

ROLL_OFF = 0.5
SPAN = 8
"""Half length of the filter, in new samples."""


def thinned_dataset(dataset: Dataset) -> Dataset:
    """Return a data set at a lower sample rate where nothing is lost by it, with a warning that says so.

    Parameters
    ----------
    dataset : Dataset
        Records whose inputs, if there are any, never move; others are returned as they are.

    Returns
    -------
    Dataset
        Outputs low-passed by a zero-phase filter and decimated to about 40 samples in a period of the motion. The ends
        that the filter cannot reach are cut. White sensor noise stays white.
    """
    inputs = np.concatenate([run.trajectory.u for run in dataset])
    if np.ptp(inputs, axis=0).any():
        return dataset
    dt = dataset.spec.sample_time
    runs = [run.trajectory for run in dataset]
    band = max(motion_band(run.y[:, j], dt)[0] for run in runs for j in range(run.spec.ny) if np.ptp(run.y[:, j]) > 0)
    factor = min(
        int(1 / (DATA_POLICY.per_period * band * dt)), min(len(run) for run in runs) // (DATA_POLICY.fewest + 2 * SPAN)
    )
    if factor < 2:
        return dataset
    spec = replace(dataset.spec, sample_time=factor * dt)
    taps = white_keeping_filter(factor)
    thin = tuple(Run(_thinned(run.trajectory, taps, factor, spec), run.use, run.label) for run in dataset)
    # the filter passes this share of the power of white noise
    noise = {name: value * float(np.sqrt(np.sum(taps**2))) for name, value in dataset.noise.items()}
    words = (
        f"nothing drives the plant and its motion lies below {band:.3g} Hz: records low-passed and taken at "
        f"{1 / (factor * dt):.4g} Hz instead of {1 / dt:.4g} Hz"
    )
    return replace(dataset, runs=thin, noise=noise, warnings=(*dataset.warnings, words))


def white_keeping_filter(factor: int) -> FloatArray:
    """Return taps (16 * factor + 1,) of a low-pass: every ``factor``-th sample of white noise stays white.

    The square root of a raised cosine: the squares of its pass bands, moved by the new sampling frequency, add up to a
    constant (Proakis, Digital Communications, section 9.2).

    Examples
    --------
    >>> taps = white_keeping_filter(4)
    >>> float(round(taps.sum(), 6)), float(abs(round((taps[:-4] * taps[4:]).sum() / (taps**2).sum(), 2)))
    (1.0, 0.0)
    """
    t = np.arange(-SPAN * factor, SPAN * factor + 1) / factor
    b = ROLL_OFF
    with np.errstate(divide="ignore", invalid="ignore"):
        taps = (np.sin(np.pi * t * (1 - b)) + 4 * b * t * np.cos(np.pi * t * (1 + b))) / (
            np.pi * t * (1 - (4 * b * t) ** 2)
        )
    taps[t == 0] = 1 - b + 4 * b / np.pi
    edge = np.isclose(np.abs(t), 1 / (4 * b))
    quarter = np.pi / (4 * b)
    taps[edge] = b / np.sqrt(2) * ((1 + 2 / np.pi) * np.sin(quarter) + (1 - 2 / np.pi) * np.cos(quarter))
    return np.asarray(taps / taps.sum())


def _thinned(record: Trajectory, taps: FloatArray, factor: int, spec: object) -> Trajectory:
    """Return a record low-passed and decimated, without the ends that the filter does not reach."""
    from scipy.signal import fftconvolve

    columns = []
    for j, channel in enumerate(record.spec.outputs):
        raw = record.y[:, j]
        if channel.period is not None:
            raw = np.unwrap(raw, period=channel.period)
        columns.append(fftconvolve(raw, taps, mode="valid")[::factor])
    y = np.stack(columns, axis=1)
    first = (len(taps) - 1) // 2
    rows = slice(first, first + (len(y) - 1) * factor + 1, factor)
    return Trajectory(record.t[rows], record.u[rows], y, spec)  # type: ignore[arg-type]
