"""Frequency responses by the local polynomial method: sharp resonances keep their height, and leakage is modelled.

Around each frequency the response and the transient, which the ends of a record leave in every line of its spectrum,
are parabolas over some lines (Pintelon, Schoukens, Vandersteen and Barbe 2010, *Mech. Syst. Signal Process.* 24:573,
sec. 4). How many lines is chosen at each frequency: as many as do not move the response beyond its own uncertainty.
A resonance narrower than half the narrowest window (13 lines of one record with one input: in Hz, 6 over its length in
seconds) is still told too low.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from harness.algebra import column_norms, orthonormal
from harness.frequency.segments import segment_spectra
from harness.signals import FloatArray, Trajectory

ORDER = 2  # Of the polynomials, as the authors advise: even orders have no larger bias than the odd ones below.
SPARE = 7  # Lines beyond the unknowns in the narrowest window: fewer leave the noise, and the band, unknown.
WIDER = (1.0, 2.0, 4.0, 8.0)  # Windows that are tried, over the narrowest.
APART = 2.0
"""Standard deviations by which a wider window's response may leave that of a narrower one (Goldenshluger and Nemirovski
1997: intersection of confidence intervals)."""
POINTS = 160  # Frequencies on a logarithmic scale, and as many on a linear one: more are not seen in a picture.

ComplexArray = npt.NDArray[np.complex128]


def local_polynomial(
    records: Sequence[Trajectory],
) -> tuple[FloatArray, ComplexArray, FloatArray, FloatArray, float] | None:
    """Return frequencies (F,) [Hz], response (F, ny, nu), variance of it (F, ny, nu), coherence (F, ny), median lines.

    The variance is infinite where no record has power of an input in the narrowest window.

    - ``records``: of one sample time; each has a transient of its own
    - returns None where the records are too short
    """
    spec = records[0].spec
    spectra: list[tuple[FloatArray, ComplexArray, ComplexArray]] = []
    for record in records:
        u, y = (
            np.fft.rfft(values - values.mean(axis=0), axis=0) / np.sqrt(len(record)) for values in (record.u, record.y)
        )
        lines = np.asarray(np.fft.rfftfreq(len(record), spec.sample_time)[1:], dtype=np.float64)
        spectra.append((lines, u[1:], y[1:]))
    unknown = (ORDER + 1) * (spec.nu + len(records))
    narrow = int(np.ceil((unknown + SPARE) / len(records)))
    if min(len(one[0]) for one in spectra) < narrow:
        return None
    longest = max((one[0] for one in spectra), key=len)
    count = len(longest)
    picked = np.unique(np.concatenate([np.geomspace(1, count, POINTS), np.linspace(1, count, POINTS)]).round()) - 1
    frequency = longest[picked.astype(int)]
    nf, ny, nu = len(frequency), spec.ny, spec.nu
    response = np.zeros((nf, ny, nu), dtype=np.complex128)
    variance, coherence, used = np.zeros((nf, ny, nu)), np.zeros((nf, ny)), np.zeros(nf)
    for k, at in enumerate(frequency):
        kept: list[tuple[ComplexArray, FloatArray]] = []
        for wider in WIDER:
            width = int(narrow * wider)
            if width > min(len(one[0]) for one in spectra):
                break
            found = _fit(spectra, float(at), width)
            if any((np.abs(found[0] - g) > APART * np.sqrt(v)).any() for g, v in kept):
                break
            kept.append(found[:2])
            (response[k], variance[k], coherence[k]), used[k] = found, width * len(records)
    lit = np.zeros((nf, nu), dtype=bool)
    for record, (lines, *_) in zip(records, spectra, strict=True):
        found_lit = segment_spectra([record], len(record)).excited([record], narrow)[1:]
        lit |= found_lit[np.abs(lines[:, None] - frequency).argmin(axis=0)]
    variance = np.where(lit[:, None, :], variance, np.inf)
    return frequency, response, variance, coherence, float(np.median(used))


def _fit(
    spectra: Sequence[tuple[FloatArray, ComplexArray, ComplexArray]], at: float, width: int
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return the response at a frequency (ny, nu), its variance, and the coherence (ny,) over the window."""
    regressors, targets = [], []
    nu = spectra[0][1].shape[1]
    for number, (lines, u, y) in enumerate(spectra):
        middle = int(np.searchsorted(lines, at))
        first = int(np.clip(middle - width // 2, 0, len(lines) - width))
        rows = slice(first, first + width)
        away = (lines[rows] - at) / (lines[1] - lines[0]) / width
        powers = away[:, None] ** np.arange(ORDER + 1)
        driven = (u[rows][:, :, None] * powers[:, None, :]).reshape(width, -1)
        transient = np.zeros((width, len(spectra) * (ORDER + 1)), dtype=np.complex128)
        transient[:, number * (ORDER + 1) : (number + 1) * (ORDER + 1)] = powers
        regressors.append(np.hstack([driven, transient]))
        targets.append(y[rows])
    matrix, target = np.vstack(regressors), np.vstack(targets)
    size = column_norms(matrix)
    left, singular, right = np.linalg.svd(matrix / size, full_matrices=False)
    inverse = np.where(singular > 1e-10 * singular[0], 1.0 / np.maximum(singular, 1e-300), 0.0)
    solution = (right.conj().T * inverse) @ (left.conj().T @ target) / size[:, None]
    residual = target - matrix @ solution
    noise = np.sum(np.abs(residual) ** 2, axis=0) / max(len(target) - matrix.shape[1], 1)
    spread = np.sum(np.abs(right.conj().T * inverse) ** 2, axis=1) / size**2
    places = np.arange(nu) * (ORDER + 1)
    # a line that is not excited says nothing of the response
    dark = np.sum(np.abs(right[singular <= 1e-10 * singular[0]][:, places]) ** 2, axis=0) > 1e-6
    variance = noise[:, None] * np.where(dark, np.inf, spread[places])[None, :]
    # of what the transients leave: these explain what leaks into a line, whatever the inputs do
    alone = orthonormal(np.real(matrix[:, nu * (ORDER + 1) :]), 1e-10)
    power = np.sum(np.abs(target - alone @ (alone.T @ target)) ** 2, axis=0)
    explained = 1.0 - noise * (len(target) - alone.shape[1]) / np.maximum(power, 1e-300)
    return solution[places].T, variance, np.clip(explained, 0.0, 1.0)
