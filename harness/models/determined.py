"""The frequencies over which records determine a linear model: elsewhere its order alone speaks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import unit_columns
from harness.judgement import feedback_of
from harness.models.arx_orders import EQUATIONS, LagTriangle
from harness.models.arx_orders import MEMORY as LAGS
from harness.models.other_orders import agreeing
from harness.models.spread import Matrices, gains, steps
from harness.signals import FloatArray, Trajectory

ASKED = 5_000  # Samples in which feedback is looked for.
ANSWERED = 0.05
"""Share of an input's unpredictable part that past outputs explain, from which on a record counts as a loop's."""
Complex = npt.NDArray[np.complex128]


def innovations(records: Sequence[Trajectory]) -> list[FloatArray] | None:
    """Return what a long ARX model leaves of the outputs (N, ny) of every record, None where no loop is closed.

    The first samples, which it needs, are zeros.
    """
    spec, some, left = records[0].spec, [], ASKED
    for record in records:
        if left > 0:
            some.append(record[:left])
            left -= len(record)
    feedback = feedback_of(some)
    first = int(not spec.feedthrough)
    columns = 1 + LAGS * spec.ny + (LAGS + 1 - first) * spec.nu
    if not feedback.found or feedback.share < ANSWERED or sum(map(len, some)) < EQUATIONS * columns:
        return None
    whole = LagTriangle.of(some, LAGS, first, LAGS)
    chosen = whole.columns(LAGS, [(first, LAGS)] * spec.nu)
    theta = np.linalg.lstsq(whole.triangle[:, chosen], whole.triangle[:, whole.targets], rcond=1e-10)[0]
    return [_left(record, np.asarray(theta, dtype=np.float64), first) for record in records]


def _left(record: Trajectory, theta: FloatArray, first: int) -> FloatArray:
    """Return the errors one step ahead (N, ny) of the coefficients that LagTriangle's columns have."""
    n, found = len(record), np.zeros_like(record.y)
    if n <= LAGS:
        return found
    columns = [np.ones((n - LAGS, 1)), *(record.y[LAGS - j : n - j] for j in range(1, LAGS + 1))]
    columns += [record.u[LAGS - j : n - j] for j in range(first, LAGS + 1)]
    found[LAGS:] = record.y[LAGS:] - np.hstack(columns) @ theta
    return found


def without(both: Complex, crossed: Complex, nu: int) -> tuple[Complex, Complex]:
    """Return spectra of inputs (F, nu, nu), and of rests with them (F, ny, nu), without what is new in the outputs.

    What moves the inputs beside the controller is what is left of them: the part that tells what they do, at the noise
    that there is (Ljung 1999, eq. 13.53).

    - ``both`` (F, nu + ny, nu + ny): of the inputs and innovations together
    - ``crossed`` (F, ny, nu + ny): of the rests with them
    """
    told, new = both[:, :nu, nu:], both[:, nu:, nu:]
    size = np.sqrt(np.maximum(np.einsum("fii->fi", new).real, 1e-300))
    inverse: Any = np.linalg.pinv(new / size[:, :, None] / size[:, None, :], rcond=1e-9, hermitian=True)
    inverse = inverse / size[:, :, None] / size[:, None, :]
    back = np.conj(np.swapaxes(told, 1, 2))
    return both[:, :nu, :nu] - told @ inverse @ back, crossed[:, :, :nu] - crossed[:, :, nu:] @ inverse @ back


KEY = "determined"  # Where a model's notes hold its bands: by pair of channels, ``[[low, high], ...]`` in Hz.
WIDTH = 2.0 ** (1.0 / 3.0)  # Bands are thirds of an octave, over which responses hardly change but at sharp resonances.
CLEAR = 12.0
"""|G|^2 over the variance of what a band alone says of it, which then errs by half once in exp(12 / 4) = 20 bands."""
CONTRADICTED = 0.25
"""Share of the gain in a band, the model's or what the data make of it, that the residual may take back: beyond it the
data say something else."""
QUIET, FAINT = 1e-8, 1e-6
"""Powers, relative to those of output and input, below which a spectrum is rounding or leaks from other lines."""
LEAK = (0.35875, 0.48829, 0.14128, 0.01168)
"""A window from which no line leaks more than 1e-9 of its power beyond four bins (Harris 1978, Proc. IEEE 66:51, table
1, Blackman-Harris of 4 terms): with a shorter memory two lines fill what lies between them."""
AVERAGES, ALONE = 2, 1e-3
"""Averages of spectra for each input at least, and share of its power by which an input departs from the others: below
it windows leak."""
LIT, APART, SMOOTH = 1e-2, 3, 0.3
"""Share of the mean power of a band from which on a line counts, samples of the spectrum on either side of which it is
the largest, and share of its power two samples away that a smooth spectrum has at least: a line leaks 0.04 there."""
SEGMENTS, LONGEST, ROWS, MEMORY = 6, 1024, 20_000, 400
"""Segments of a record at least, samples of one at most, samples looked at, samples of a response."""
MOST = 36  # Pairs of input and output up to which a model says its bands.
SAID = 6  # Pairs whose bands a terminal shows.


def determined_bands(matrices: Matrices, records: Sequence[Trajectory]) -> dict[str, list[list[float]]]:
    """Return by pair of output and input the frequencies [Hz] over which records alone tell the response.

    The records' spectra are averaged over thirds of an octave (Welch 1967), without the model but for its residual: a
    band is determined where the response stands out of what the noise leaves open given the power that the input has
    there beside the other inputs (Bendat & Piersol 2010, eq. 9.90), and the residual does not take half of it back.

    - ``matrices`` (A, B, C, D)
    - ``records``: that the model was fitted to
    - returns ``{"y per u": [[low, high], ...]}``; empty where the records are too short to say, or the pairs too many

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
    fine, owner = _fine(frequency, longest)
    moved, lit = _moved(records, frequency, edges, fine)
    found = np.zeros((len(edges), spec.ny, spec.nu), dtype=bool)
    for band, (first, last) in enumerate(edges):
        lines = slice(first, last)
        own = _own(suu[lines], count)
        variance = noise[lines].mean(axis=0)[:, None] / np.maximum(own, 1e-300)
        size = np.abs(response[lines]).max(axis=0)
        explained = np.einsum("fij,fjj->ij", np.abs(response[lines]) ** 2, suu[lines]).real
        wrong = np.sum(np.conj(response[lines]) * sru[lines], axis=0) / np.maximum(explained, 1e-300)
        right = np.abs(wrong) < CONTRADICTED * np.minimum(np.abs(1.0 + wrong), 1.0)
        found[band] = (size**2 > CLEAR * variance) & moved[band] & (own > 0) & right
    told = np.repeat(found, [last - first for first, last in edges], axis=0)[owner]
    unlit = told & ~lit[:, None]
    if unlit.any():
        turn, whole = np.exp(2j * np.pi * fine * spec.sample_time), gains(matrices, fine, spec.sample_time)
        for row, column in zip(*np.nonzero(unlit.any(axis=0)), strict=True):
            power = np.maximum(np.real(suu[:, column, column]) * count, 1e-300)
            deviation = np.sqrt(noise[:, row] / power)[owner]
            told[:, row, column] &= agreeing(whole[:, row, column], deviation, turn, lit[:, column])
        told &= ~_turning(told, whole, gains(matrices, fine[:-1] + fine[1] / 2, spec.sample_time))
    return {
        f"{output.name} per {given.name}": _merged(fine, told[:, row, column])
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
    'its data determine y per u from 0 to 2 Hz; elsewhere only its order does'
    >>> gaps_words({"y per u": [[0.0, 5.0]]}, 0.1)
    ''
    """
    whole = 0.5 * (1.0 - 1e-3) / sample_time
    some = {pair: own for pair, own in (bands or {}).items() if not (len(own) == 1 and own[0][1] >= whole)}
    if not some:
        return ""
    first = dict(list(some.items())[:SAID])
    more = f" (and {len(some) - SAID} more pairs)" if len(some) > SAID else ""
    return f"its data determine {bands_words(first)}{more}; elsewhere only its order does"


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

    R is what the model leaves of the output; in a loop, U is what moves the inputs beside the controller.
    """
    spec, window, new = records[0].spec, np.hanning(n + 1)[:-1, None], innovations(records)
    wide = spec.nu if new is None else spec.nu + spec.ny
    suu = np.zeros((n // 2, wide, wide), dtype=np.complex128)
    sru = np.zeros((n // 2, spec.ny, wide), dtype=np.complex128)
    noise, size = np.zeros((n // 2, spec.ny)), np.zeros(spec.ny)
    count, left = 0, ROWS
    for number, record in enumerate(records):
        part = record[: min(len(record), max(left, n))]
        left -= len(part)
        if len(part) < n:
            continue
        rest, y0, u0 = _left_over(matrices, part, n), part.y - part.y.mean(axis=0), part.u - part.u.mean(axis=0)
        if new is not None:
            u0 = np.hstack([u0, new[number][: len(part)]])
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
    if new is not None:
        suu, sru = without(suu, sru, spec.nu)
    return suu / found, sru / found, np.maximum(noise, QUIET * size) / found, 9.0 / 11.0 * found


def _fine(frequency: FloatArray, longest: int) -> tuple[FloatArray, npt.NDArray[np.int_]]:
    """Return frequencies (F,) of the whole record from 0 on, finer than a segment's, and the next of these."""
    step = int(max(min(2 ** int(np.log2(longest)), LONGEST) // (2 * len(frequency)), 1))
    fine = np.arange(step * len(frequency) + 1) * frequency[0] / step
    return fine, np.clip(np.rint(np.arange(len(fine)) / step).astype(int) - 1, 0, len(frequency) - 1)


def _moved(
    records: Sequence[Trajectory], frequency: FloatArray, edges: Sequence[tuple[int, int]], fine: FloatArray
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return in which bands (B, nu) the inputs have power that leaks from no other line, and where lines (F, nu).

    They are where a record's spectrum is largest, or changes less than a line's own leakage, and no small share of the
    band's power.
    """
    from scipy.ndimage import binary_closing, binary_opening, maximum_filter1d

    found = np.zeros((len(edges), records[0].spec.nu), dtype=bool)
    lit = np.zeros((len(fine), records[0].spec.nu), dtype=bool)
    half, left = frequency[0] / 2, ROWS
    for record in records:
        part = record.u[: max(left, 0)]
        left -= len(part)
        if len(part) < 2 * len(frequency):
            continue
        phase = 2 * np.pi * np.arange(len(part)) / len(part)
        window = sum((-1) ** j * weight * np.cos(j * phase) for j, weight in enumerate(LEAK))
        window = np.reshape(window, (-1, 1))
        level = (window * part).sum(axis=0) / window.sum()  # what is left of it would be a line at 0
        power = np.abs(np.fft.rfft((part - level) * window, axis=0)) ** 2
        lines = np.fft.rfftfreq(len(part), record.spec.sample_time)
        place = np.clip(np.rint(lines / fine[1]).astype(int), 0, len(fine) - 1)
        peak, near = power >= maximum_filter1d(power, 2 * APART + 1, axis=0), np.pad(power, ((2, 2), (0, 0)))
        smooth = peak | (power >= SMOOTH * np.maximum(near[4:], near[:-4]))
        peak = (peak | binary_opening(smooth, np.ones((APART + 1, 1), dtype=bool))) & (power > 0)
        for band, (first, last) in enumerate(edges):
            low = 0.0 if first == 0 else frequency[first] - half
            seen = (lines >= low) & (lines <= frequency[last - 1] + half)
            inside = power[seen]
            found[band] |= (inside >= FAINT * power.max(axis=0)).any(axis=0) & power.any(axis=0)
            least = np.maximum(LIT * inside.mean(axis=0), FAINT * power.max(axis=0))
            np.logical_or.at(lit, place[seen], peak[seen] & (inside >= least))
    closed = binary_closing(np.pad(lit, ((APART, APART), (0, 0))), np.ones((APART + 1, 1), dtype=bool))
    return found, closed[APART:-APART] | lit


def _turning(
    told: npt.NDArray[np.bool_], at: npt.NDArray[np.complex128], between: npt.NDArray[np.complex128]
) -> npt.NDArray[np.bool_]:
    """Return where (F, ny, nu) a line by itself lies on a slope of the model so steep that its neighbourhood is none.

    The responses are ``at`` the frequencies, and half way ``between`` them.
    """
    beside = np.pad(told, ((1, 1), (0, 0), (0, 0)))
    before, after = np.concatenate([at[:1], between]), np.concatenate([between, at[-1:]])
    steep = np.maximum(np.abs(before - at), np.abs(after - at)) > CONTRADICTED * np.abs(at)
    return np.asarray(steep & ~(beside[:-2] & beside[2:]), dtype=np.bool_)


def _own(power: npt.NDArray[np.complex128], count: float) -> FloatArray:
    """Return the power (nu,) of each input that the others do not tell, summed over the lines (F, nu, nu) of a band.

    Lines are taken by few together, over which a late copy of an input hardly turns, and averages are many enough.
    """
    nu, own = power.shape[-1], np.zeros(power.shape[-1])
    if nu == 1:
        return np.asarray(count * power.real.sum(axis=0)[0], dtype=np.float64)
    few = int(np.ceil(AVERAGES * nu / max(count, 1.0)))
    for start in range(0, len(power), few):
        inputs = power[start : start + few].sum(axis=0)
        for j in range(nu):
            others = np.delete(np.arange(nu), j)
            size = np.sqrt(np.maximum(np.diag(inputs).real[others], 1e-300))
            told = np.linalg.lstsq(
                inputs[np.ix_(others, others)] / np.outer(size, size), inputs[others, j] / size, rcond=1e-9
            )[0]
            left = float((inputs[j, j] - np.conj(inputs[others, j] / size) @ told).real)
            own[j] += count * left * (left > ALONE * inputs[j, j].real)
    return own


def _left_over(matrices: Matrices, record: Trajectory, n: int) -> FloatArray:
    """Return what a free run leaves of the outputs (N, ny), from the start that fits best and about its mean.

    The start is heard for a segment of n samples at most: a mode that hardly dies away would take a line with it.
    """
    from scipy.signal import fftconvolve

    a, b, c, d = matrices
    count = min(len(record), MEMORY)
    with np.errstate(over="ignore", invalid="ignore"):
        pulse = steps((a, b, c, d), count, "impulse")
        u = record.u - record.u.mean(axis=0)
        forced = sum(fftconvolve(u[:, None, j], pulse[:, :, j], axes=0) for j in range(record.spec.nu))
        rest: FloatArray = record.y - np.asarray(forced)[: len(record)]
        rest = rest - rest.mean(axis=0)
        heard = min(count, n)
        free = np.empty((heard, *c.shape))
        power = c
        for k in range(heard):
            free[k] = power
            power = power @ a
    if not (np.isfinite(rest).all() and np.isfinite(free).all()):  # a model that grows: nothing is left to compare
        return np.asarray(record.y - record.y.mean(axis=0), dtype=np.float64)
    if len(a):
        rows, target = free.reshape(-1, len(a)), rest[:heard].reshape(-1)
        rows = unit_columns(rows)
        rest[:heard] -= (rows @ np.linalg.lstsq(rows, target, rcond=1e-8)[0]).reshape(heard, -1)
    return np.asarray(rest, dtype=np.float64)


def _edges(frequency: FloatArray) -> list[tuple[int, int]]:
    """Return first and last line (exclusive) of each third of an octave, of one line at least."""
    found, first = [], 0
    while first < len(frequency):
        last = max(first + 1, int(np.searchsorted(frequency, frequency[first] * WIDTH)))
        found.append((first, last))
        first = last
    return found


def _merged(frequency: FloatArray, told: npt.NDArray[np.bool_]) -> list[list[float]]:
    """Return ranges [Hz] of neighbouring frequencies of a grid from 0 on."""
    half = frequency[1] / 2
    found: list[list[float]] = []
    for line in np.flatnonzero(told):
        low, high = float(max(frequency[line] - half, 0.0)), float(frequency[line] + half)
        if found and low <= found[-1][1] * (1 + 1e-9):
            found[-1][1] = high
        else:
            found.append([low, high])
    if found:
        found[-1][1] = min(found[-1][1], float(frequency[-1]))
    return found
