"""Spectra of records by segments, as Welch's method sums them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray, Trajectory


class SegmentSpectra(NamedTuple):
    """Sums over so many segments of ``u u*`` (F, nu, nu), ``y u*`` (F, ny, nu) and ``|y|^2`` (F, ny)."""

    uu: npt.NDArray[np.complex128]
    yu: npt.NDArray[np.complex128]
    yy: FloatArray
    segments: int
    power: float
    """Sum of the squares of the window."""


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
    return SegmentSpectra(uu, yu, yy, count, float(window @ window))
