"""The frequencies over which records determine a linear model: elsewhere its order alone speaks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.models.spread import Matrices, gains, steps
from harness.signals import FloatArray, Trajectory

__all__ = ["KEY", "bands_of", "bands_words", "determined_bands", "gaps_words", "outside"]

KEY = "determined"
"""Where a model's notes hold its bands: by pair of channels, ``[[low, high], ...]`` in Hz."""
WIDTH = 2.0 ** (1.0 / 3.0)
"""Bands are thirds of an octave, over which responses hardly change but at sharp resonances."""
CLEAR = 3.0
"""|G|^2 over the variance of what a band alone says of it: reached by noise alone once in exp(3) = 20 bands."""
CONTRADICTED = 0.5
"""Share of the gain in a band, the model's or what the data make of it, that the residual may take back: beyond it the
data say something else."""
QUIET, FAINT = 1e-8, 1e-6
"""Powers, relative to those of output and input, below which a spectrum is rounding or leaks from other lines."""
LEAK = (0.35875, 0.48829, 0.14128, 0.01168)
"""A window from which no line leaks more than 1e-9 of its power beyond four bins (Harris 1978, Proc. IEEE 66:51, table
1, Blackman-Harris of 4 terms): with a shorter memory two lines fill what lies between them."""
SEGMENTS, LONGEST, ROWS, MEMORY = 6, 1024, 20_000, 400
"""Segments of a record at least, samples of one at most, samples looked at, samples of a response."""
MOST = 36
"""Pairs of input and output up to which a model says its bands."""
SAID = 6
"""Pairs whose bands a terminal shows."""


def determined_bands(matrices: Matrices, records: Sequence[Trajectory]) -> dict[str, list[list[float]]]:
    """Return by pair of output and input the frequencies [Hz] over which records alone tell the response.

    The records' spectra are averaged over thirds of an octave (Welch 1967), without the model but for its residual: a
    band is determined where the response stands out of what the noise leaves open given the power that the input has
    there beside the other inputs (Bendat & Piersol 2010, eq. 9.90), and the residual does not take half of it back.

    Parameters
    ----------
    matrices : (A, B, C, D)
    records : sequence of Trajectory
        That the model was fitted to.

    Returns
    -------
    dict
        ``{"y per u": [[low, high], ...]}``; empty where the records are too short to say, or the pairs too many.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    >>> rng, t = np.random.default_rng(0), np.arange(4000) * 0.1
    >>> u = np.sin(2 * np.pi * 0.5 * t)[:, None]
    >>> data = Trajectory(t, u, 2.0 * u + 0.1 * rng.normal(size=u.shape), spec)
    >>> gain = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.full((1, 1), 2.0))
    >>> [[low, high]] = determined_bands(gain, [data])["y per u"]
    >>> low < 0.5 < high < 0.9
    True
    """
    spec = records[0].spec
    if not spec.nu or spec.nu * spec.ny > MOST:
        return {}
    longest = max(map(len, records))
    n = int(min(LONGEST, 2 ** int(np.log2(max(longest / SEGMENTS, 1)))))
    if n < 16:
        return {}
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(n, spec.sample_time)[1:], dtype=np.float64)
    response = gains(matrices, frequency, spec.sample_time)
    suu, sru, noise, count = _spectra(records, n, matrices)
    edges = _edges(frequency)
    moved = _moved(records, frequency, edges)
    found = np.zeros((len(edges), spec.ny, spec.nu), dtype=bool)
    for band, (first, last) in enumerate(edges):
        lines = slice(first, last)
        inputs = suu[lines].sum(axis=0) * count
        weak = ~moved[band]
        scale = np.sqrt(np.maximum(np.real(np.diag(inputs)), 1e-300))
        own = np.real(np.diag(np.linalg.pinv(inputs / np.outer(scale, scale), rcond=1e-9, hermitian=True))) / scale**2
        variance = noise[lines].mean(axis=0)[:, None] * own
        size = np.abs(response[lines]).max(axis=0)
        explained = np.einsum("fij,fjj->ij", np.abs(response[lines]) ** 2, suu[lines]).real
        wrong = np.sum(np.conj(response[lines]) * sru[lines], axis=0) / np.maximum(explained, 1e-300)
        right = np.abs(wrong) < CONTRADICTED * np.minimum(np.abs(1.0 + wrong), 1.0)
        found[band] = (size**2 > CLEAR * variance) & ~weak & (own > 0) & right
    return {
        f"{output.name} per {given.name}": _merged(frequency, edges, found[:, row, column])
        for row, output in enumerate(spec.outputs)
        for column, given in enumerate(spec.inputs)
    }


def bands_of(model: Any) -> dict[str, list[list[float]]] | None:
    """Return the bands that a fitted model carries, None where it says nothing of them."""
    notes = getattr(model, "notes", None)
    found = notes.get(KEY) if isinstance(notes, Mapping) else None
    return {str(pair): [list(map(float, band)) for band in bands] for pair, bands in found.items()} if found else None


def bands_words(bands: Mapping[str, Sequence[Sequence[float]]]) -> str:
    """Return the bands in words, pairs of the same bands together.

    Examples
    --------
    >>> bands_words({"y per u": [[0.0, 2.0]], "z per u": []})
    'y per u from 0 to 2 Hz; z per u nowhere'
    """
    said = []
    for pair, own in bands.items():
        ranges = " and ".join(f"from {low:.3g} to {high:.3g} Hz" for low, high in own)
        said.append(f"{pair} {ranges or 'nowhere'}")
    return "; ".join(said)


def gaps_words(bands: Mapping[str, Sequence[Sequence[float]]] | None, sample_time: float) -> str:
    """Return in words where alone a model is determined, empty where it is so at all frequencies or does not say.

    Examples
    --------
    >>> gaps_words({"y per u": [[0.0, 2.0]]}, 0.1)
    'its data determine y per u from 0 to 2 Hz; elsewhere its order alone speaks'
    >>> gaps_words({"y per u": [[0.0, 5.0]]}, 0.1)
    ''
    """
    whole = 0.5 * (1.0 - 1e-3) / sample_time
    some = {pair: own for pair, own in (bands or {}).items() if not (len(own) == 1 and own[0][1] >= whole)}
    if not some:
        return ""
    first = dict(list(some.items())[:SAID])
    more = f" (and {len(some) - SAID} more pairs)" if len(some) > SAID else ""
    return f"its data determine {bands_words(first)}{more}; elsewhere its order alone speaks"


def outside(bands: Sequence[Sequence[float]], frequency: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which frequencies (F,) are in none of the bands.

    Examples
    --------
    >>> outside([[0.0, 1.0]], np.array([0.5, 2.0])).tolist()
    [False, True]
    """
    inside = np.zeros(np.shape(frequency), dtype=bool)
    for low, high in bands:
        inside |= (frequency >= low) & (frequency <= high)
    return ~inside


def _spectra(
    records: Sequence[Trajectory], n: int, matrices: Matrices
) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128], FloatArray, float]:
    """Return averages of U U* (F, nu, nu), R U* (F, ny, nu) and |R|^2 (F, ny), and independent averages.

    R is what the model leaves of the output.
    """
    spec, window = records[0].spec, np.hanning(n + 1)[:-1, None]
    suu = np.zeros((n // 2, spec.nu, spec.nu), dtype=np.complex128)
    sru = np.zeros((n // 2, spec.ny, spec.nu), dtype=np.complex128)
    noise, size = np.zeros((n // 2, spec.ny)), np.zeros(spec.ny)
    count, left = 0, ROWS
    for record in records:
        part = record[: min(len(record), max(left, n))]
        left -= len(part)
        if len(part) < n:
            continue
        rest, y0, u0 = _left_over(matrices, part), part.y - part.y.mean(axis=0), part.u - part.u.mean(axis=0)
        for start in range(0, len(part) - n + 1, n // 2):
            u = np.fft.rfft(window * u0[start : start + n], axis=0)[1:]
            suu += u[:, :, None] * np.conj(u[:, None, :])
            r = np.fft.rfft(window * rest[start : start + n], axis=0)[1:]
            sru += r[:, :, None] * np.conj(u[:, None, :])
            noise += np.abs(r) ** 2
            size += np.mean(np.abs(np.fft.rfft(window * y0[start : start + n], axis=0)[1:]) ** 2, axis=0)
            count += 1
        if left <= 0:
            break
    found = max(count, 1)
    return suu / found, sru / found, np.maximum(noise, QUIET * size) / found, 9.0 / 11.0 * found


def _moved(records: Sequence[Trajectory], frequency: FloatArray, edges: Sequence[tuple[int, int]]) -> npt.NDArray[Any]:
    """Return in which bands (B, nu) the inputs have power that does not leak from other lines of a record."""
    found = np.zeros((len(edges), records[0].spec.nu), dtype=bool)
    half, left = frequency[0] / 2, ROWS
    for record in records:
        part = record.u[: max(left, 0)]
        left -= len(part)
        if len(part) < 2 * len(frequency):
            continue
        phase = 2 * np.pi * np.arange(len(part)) / len(part)
        window = sum((-1) ** j * weight * np.cos(j * phase) for j, weight in enumerate(LEAK))
        power = np.abs(np.fft.rfft((part - part.mean(axis=0)) * np.reshape(window, (-1, 1)), axis=0)) ** 2
        lines = np.fft.rfftfreq(len(part), record.spec.sample_time)
        for band, (first, last) in enumerate(edges):
            low = 0.0 if first == 0 else frequency[first] - half
            inside = power[(lines >= low) & (lines <= frequency[last - 1] + half)]
            found[band] |= (inside >= FAINT * power.max(axis=0)).any(axis=0) & power.any(axis=0)
    return found


def _left_over(matrices: Matrices, record: Trajectory) -> FloatArray:
    """Return what a free run leaves of the outputs (N, ny), from the start that fits best and about its mean."""
    from scipy.signal import fftconvolve

    a, b, c, d = matrices
    count = min(len(record), MEMORY)
    with np.errstate(over="ignore", invalid="ignore"):
        pulse = steps((a, b, c, d), count, "impulse")
        u = record.u - record.u.mean(axis=0)
        forced = sum(fftconvolve(u[:, None, j], pulse[:, :, j], axes=0) for j in range(record.spec.nu))
        rest: FloatArray = record.y - np.asarray(forced)[: len(record)]
        rest = rest - rest.mean(axis=0)
        free = np.empty((count, *c.shape))
        power = c
        for k in range(count):
            free[k] = power
            power = power @ a
    if not (np.isfinite(rest).all() and np.isfinite(free).all()):  # a model that grows: nothing is left to compare
        return np.asarray(record.y - record.y.mean(axis=0), dtype=np.float64)
    if len(a):
        rows, target = free.reshape(-1, len(a)), rest[:count].reshape(-1)
        length = np.linalg.norm(rows, axis=0)
        rows = rows / np.where(length > 0, length, 1.0)
        rest[:count] -= (rows @ np.linalg.lstsq(rows, target, rcond=1e-8)[0]).reshape(count, -1)
    return np.asarray(rest, dtype=np.float64)


def _edges(frequency: FloatArray) -> list[tuple[int, int]]:
    """Return first and last line (exclusive) of each third of an octave, of one line at least."""
    found, first = [], 0
    while first < len(frequency):
        last = max(first + 1, int(np.searchsorted(frequency, frequency[first] * WIDTH)))
        found.append((first, last))
        first = last
    return found


def _merged(frequency: FloatArray, edges: Sequence[tuple[int, int]], told: npt.NDArray[np.bool_]) -> list[list[float]]:
    """Return ranges [Hz] of neighbouring bands; the lowest begins at 0, where a response is smooth."""
    half = frequency[0] / 2
    found: list[list[float]] = []
    for band, (first, last) in enumerate(edges):
        if not told[band]:
            continue
        low = 0.0 if first == 0 else float(frequency[first] - half)
        high = float(frequency[last - 1] + half)
        if found and low <= found[-1][1] * (1 + 1e-9):
            found[-1][1] = high
        else:
            found.append([low, high])
    if found:
        found[-1][1] = min(found[-1][1], float(frequency[-1]))
    return found
