"""Spectra of records by segments, as Welch's method sums them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from harness.resolution import resolution
from harness.signals import FloatArray, Trajectory

ABOVE = 4.0
"""Power over what louder lines leak and what rounding leaves, below which a line is not excited: a mean of 13 lines of
rounding alone is that large by chance never, white noise leaks 1/180 of its power."""
EXACT = 1e-10
"""Power over that of the loudest line, below which no log tells an input: six significant digits, whose steps differ
from reading to reading, leave 1e-16 to 1e-12 of it, a step of 1e5 samples has 1e-9 at its highest line."""


class SegmentSpectra(NamedTuple):
    """Sums over so many segments of ``u u*`` (F, nu, nu), ``y u*`` (F, ny, nu) and ``|y|^2`` (F, ny)."""

    uu: npt.NDArray[np.complex128]
    yu: npt.NDArray[np.complex128]
    yy: FloatArray
    segments: int
    power: float
    """Sum of the squares of the window."""
    samples: int
    """Of a segment."""

    def excited(self, records: Sequence[Trajectory], width: int = 1) -> npt.NDArray[np.bool_]:
        """Return at which lines each input (F, nu) has power of its own, in the mean over so many lines around.

        What a Hann window lets through from two lines away and further (Harris 1978, *Proc. IEEE* 66:51) is no power,
        nor is what rounding leaves: ``step^2 / 12`` of each sample at which the reading changes, and nothing new where
        it is held, as a staircase on a grid of levels is.

        - ``records``: whose spectra these are

        Examples
        --------
        >>> from harness.signals import Channel, PlantSpec
        >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
        >>> u = np.sin(0.2 * np.pi * np.arange(640))[:, None]
        >>> record = Trajectory(np.arange(640) * 0.1, u, 2.0 * u, spec)
        >>> np.flatnonzero(segment_spectra([record], 64).excited([record])).tolist()
        [5, 6, 7, 8]
        """
        power = np.real(np.einsum("fii->fi", self.uu))
        n, bins = self.samples, len(power)
        away = np.minimum(np.arange(n), n - np.arange(n)).astype(np.float64)
        lets = np.where(away >= 2, 1.0 / np.maximum(np.pi * away * (away**2 - 1), 1.0), 0.0) ** 2
        both = np.concatenate([power, power[n - bins : 0 : -1]])
        leaked = np.fft.irfft(np.fft.rfft(both, axis=0) * np.fft.rfft(lets)[:, None], n, axis=0)[:bins]
        steps = np.array([resolution([record.u[:, j] for record in records]) for j in range(power.shape[1])])
        change = np.mean(np.concatenate([np.diff(record.u, axis=0) != 0 for record in records]), axis=0)
        first = np.clip(np.arange(bins) - width // 2, 0, max(bins - width, 0))
        view = np.lib.stride_tricks.sliding_window_view
        around, leaked = (view(part, min(width, bins), axis=0).mean(axis=-1)[first] for part in (power, leaked))
        rounded = self.segments * self.power * change * steps**2 / 12.0
        return np.asarray(around > np.maximum(ABOVE * (leaked + rounded), EXACT * power.max(axis=0)))


def segment_spectra(records: Sequence[Trajectory], n: int) -> SegmentSpectra:
    """Return the spectra of records, summed over segments of n samples (Welch 1967): Hann windows, half overlap.

    Every record is taken by itself, its means away; none shorter than a segment has a part.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    >>> u = np.random.default_rng(0).normal(size=(64, 1))
    >>> found = segment_spectra([Trajectory(np.arange(64) * 0.1, u, 2.0 * u, spec)], 16)
    >>> found.segments, bool(np.allclose(found.yu, 2.0 * found.uu))
    (7, True)
    """
    spec, bins = records[0].spec, n // 2 + 1
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    uu = np.zeros((bins, spec.nu, spec.nu), dtype=np.complex128)
    yu = np.zeros((bins, spec.ny, spec.nu), dtype=np.complex128)
    yy, count = np.zeros((bins, spec.ny)), 0
    for record in records:
        starts = range(0, len(record) - n + 1, max(n // 2, 1))
        if not starts:
            continue
        fu, fy = (
            np.fft.rfft(np.stack([part[k : k + n] for k in starts]) * window[:, None], axis=1)
            for part in (record.u - record.u.mean(axis=0), record.y - record.y.mean(axis=0))
        )
        uu += np.einsum("sfi,sfj->fij", fu, fu.conj())
        yu += np.einsum("sfi,sfj->fij", fy, fu.conj())
        yy += np.sum(np.abs(fy) ** 2, axis=0)
        count += len(starts)
    return SegmentSpectra(uu, yu, yy, count, float(window @ window), n)
