"""Excitation signals of one channel: multisine, PRBS, chirp, steps, band-limited noise.

Each function returns N samples with peak (or, where said, rms) exactly or on average one; the scenarios scale them.
"""

from __future__ import annotations

import functools
import math
from typing import Literal

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

HIGHEST_ORDER = 32


def crest_factor(signal: FloatArray) -> float:
    """Return peak over rms of a signal (N,).

    Examples
    --------
    >>> round(crest_factor(np.sin(2 * np.pi * np.arange(1000) / 1000)), 4)
    1.4142
    """
    rms = float(np.sqrt(np.mean(np.square(signal))))
    return float(np.max(np.abs(signal)) / rms) if rms > 0 else math.inf


def lines_of_band(
    period: int, sample_time: float, band: tuple[float, float], grid: Literal["full", "odd"] = "full"
) -> FloatArray:
    """Return the spectral lines of a period that lie in a band.

    Raises InputError if no line lies in the band.

    - ``period``: samples of one period; line k has the frequency ``k / (period * sample_time)``
    - ``sample_time``: seconds
    - ``band`` (low, high): hz, both included
    - ``grid`` {"full", "odd"}: all lines, or only the odd ones (even nonlinearities then show on the empty lines)
    - returns line numbers, between 1 and ``(period - 1) // 2``

    Examples
    --------
    >>> lines_of_band(100, 0.01, (1.0, 4.0)).astype(int).tolist()
    [1, 2, 3, 4]
    """
    low, high = band
    k = np.arange(1, (period - 1) // 2 + 1)
    frequency = k / (period * sample_time)
    tolerance = 1e-9 * max(high, 1.0 / (period * sample_time))
    chosen = k[(frequency >= low - tolerance) & (frequency <= high + tolerance)]
    if grid == "odd":
        chosen = chosen[chosen % 2 == 1]
    if chosen.size == 0:
        raise InputError(
            "empty band",
            expected=f"a band that holds a line k / {period * sample_time:g} s below {0.5 / sample_time:g} Hz",
            got=f"{low:g} to {high:g} Hz",
            remedy="widen the band or lengthen the period",
        )
    return chosen.astype(float)


def multisine(
    n: int, period: int, lines: FloatArray, *, rng: np.random.Generator, crest: float | None = None, tries: int = 400
) -> FloatArray:
    """Return a random-phase multisine with equal amplitudes and a peak of exactly one.

    Raises InputError if a line is outside the period's spectrum.

    - ``n``: samples; the signal repeats every ``period`` samples exactly, bit for bit
    - ``period``: samples of one period
    - ``lines`` array of int: line numbers that carry energy, between 1 and ``(period - 1) // 2``
    - ``rng``: draws the phases
    - ``crest``: crest factor wanted: the phases are improved, by clipping in time and restoring the amplitudes in
      frequency in turn, until it is reached (1.5 is usual for 100 lines; random phases give about 3)
    - ``tries``: improvement steps before the best one found is taken
    - returns array (n,)

    Notes
    -----
    The improvement is the one of van der Ouderaa, Schoukens & Renneboog, IEEE Trans. Instrum. Meas. 37 (1988) 145.

    Examples
    --------
    >>> s = multisine(200, 100, np.array([1, 2, 3]), rng=np.random.default_rng(0))
    >>> bool(np.array_equal(s[:100], s[100:])), float(np.abs(s).max())
    (True, 1.0)
    """
    index = np.asarray(lines, dtype=int)
    if index.size == 0 or index.min() < 1 or index.max() > (period - 1) // 2:
        raise InputError(
            "lines of a multisine",
            expected=f"line numbers from 1 to {(period - 1) // 2} for a period of {period} samples",
            got="none" if index.size == 0 else f"{index.min()} to {index.max()}",
            remedy="choose a band below half the sampling frequency",
        )

    def in_time(phases: FloatArray) -> FloatArray:
        spectrum = np.zeros(period // 2 + 1, dtype=complex)
        spectrum[index] = np.exp(1j * phases)
        return np.asarray(np.fft.irfft(spectrum, period), dtype=float)

    best = in_time(rng.uniform(0, 2 * np.pi, index.size))
    trial = best
    for attempt in range(0 if crest is None else tries):
        if crest_factor(best) <= (crest or math.inf):
            break
        level = 0.75 + 0.2 * attempt / tries  # gently: a harder or faster schedule ends in a worse minimum
        peak = np.abs(trial).max()
        trial = in_time(np.angle(np.fft.rfft(np.clip(trial, -level * peak, level * peak))[index]))
        if crest_factor(trial) < crest_factor(best):
            best = trial
    return np.resize(best / np.abs(best).max(), n)


@functools.cache
def primitive_polynomial(order: int) -> int:
    """Return the lowest primitive polynomial over GF(2) of an order, its coefficients as the bits of an integer.

    A polynomial is primitive if x has the full order 2^n - 1 modulo it, which is proved here by powers of x at the
    prime factors of 2^n - 1; so no table of taps has to be trusted. Raises InputError if the order is not from 2 to 32.

    Examples
    --------
    >>> [bin(primitive_polynomial(n)) for n in (2, 3, 4)]
    ['0b111', '0b1011', '0b10011']
    """
    if not 2 <= order <= HIGHEST_ORDER:
        raise InputError(
            "order of a PRBS", expected=f"2 to {HIGHEST_ORDER}", got=str(order), remedy="choose an order in that range"
        )
    full = 2**order - 1
    cofactors = [full // prime for prime in _prime_factors(full)]
    for low in range(1, 2**order, 2):
        polynomial = (1 << order) | low
        if _power_of_x(full, polynomial) == 1 and all(_power_of_x(c, polynomial) != 1 for c in cofactors):
            return polynomial
    raise AssertionError("every order has a primitive polynomial")


def prbs(n: int, order: int, *, rng: np.random.Generator | None = None, hold: int = 1, shift: int = 0) -> FloatArray:
    """Return a maximal-length pseudo-random binary sequence of +1 and -1.

    Parameters
    ----------
    n : int
        Samples.
    order : int
        Bits of the shift register, 2 to 32; the sequence repeats after ``(2**order - 1) * hold`` samples.
    rng : numpy.random.Generator, optional
        Draws the register's start; without it all bits start at one.
    hold : int
        Samples that each bit is held.
    shift : int
        Bits by which the sequence is advanced (sequences far apart are nearly uncorrelated).

    Returns
    -------
    array (n,)
        Its periodic autocorrelation (hold 1) is L at lag 0 and -1 at any other, L = 2**order - 1.

    Raises
    ------
    InputError
        If the order or ``hold`` is out of range.

    Notes
    -----
    Golomb, *Shift Register Sequences* (1967). With polynomial x^n + sum x^i the recurrence is
    b[k+n] = xor of b[k+i]; as only low powers occur, it is worked off in blocks of n - max(i) bits.

    Examples
    --------
    >>> prbs(7, 3).astype(int).tolist()
    [1, 1, 1, -1, -1, 1, -1]
    """
    if hold < 1:
        raise InputError("hold of a PRBS", expected="at least 1 sample", got=str(hold), remedy="correct it")
    polynomial = primitive_polynomial(order)
    powers = [i for i in range(order) if polynomial >> i & 1]
    period = 2**order - 1
    start = np.ones(order, dtype=np.uint8)
    if rng is not None:
        register = int(rng.integers(1, 2**order))
        start = np.array([register >> i & 1 for i in range(order)], dtype=np.uint8)
    wanted = -(-n // hold)
    shift %= period
    length = min(period, shift + wanted)
    bits = np.empty(max(length, order), dtype=np.uint8)
    bits[:order] = start
    done, block = order, order - max(powers)
    while done < length:
        m = min(block, length - done)
        new = np.zeros(m, dtype=np.uint8)
        for i in powers:
            new ^= bits[done - order + i : done - order + i + m]
        bits[done : done + m] = new
        done += m
    sequence = bits[np.arange(shift, shift + wanted) % period] if shift + wanted > length else bits[shift:length]
    return np.repeat(2.0 * sequence.astype(float)[:wanted] - 1.0, hold)[:n]


def chirp(
    n: int,
    sample_time: float,
    band: tuple[float, float],
    *,
    law: Literal["linear", "logarithmic"] = "linear",
    phase: float = 0.0,
    rotate: float = 0.0,
) -> FloatArray:
    """Return a sine whose frequency sweeps a band once over the record.

    Raises InputError if the band is not within 0 and half the sampling frequency, or the law is unknown.

    - ``n, sample_time``: samples, and seconds between them
    - ``band`` (first, last): hz; a falling sweep has ``first > last``
    - ``law`` {"linear", "logarithmic"}: how the frequency moves; ``"logarithmic"`` spends equal time in each octave
    - ``phase``: rad at the first sample
    - ``rotate``: fraction of the record by which the sweep is rotated (it then starts inside the band and wraps around,
      with a continuous phase): lets several inputs sweep at once without being alike

    Examples
    --------
    >>> s = chirp(1000, 0.001, (10.0, 10.0))
    >>> bool(np.allclose(s, np.sin(2 * np.pi * 10 * np.arange(1000) * 0.001)))
    True
    """
    first, last = band
    lowest = 0.0 if law == "linear" else 1e-12
    if not (lowest <= min(band) and max(band) <= 0.5 / sample_time) or law not in ("linear", "logarithmic"):
        raise InputError(
            "band of a chirp",
            expected=f"law linear or logarithmic, frequencies {'from' if lowest == 0 else 'above'} 0 to "
            f"{0.5 / sample_time:g} Hz",
            got=f"{law}, {first:g} to {last:g} Hz",
            remedy="keep the sweep below half the sampling frequency",
        )
    duration = n * sample_time

    def cycles(t: FloatArray) -> FloatArray:
        if law == "linear" or first == last:
            return first * t + 0.5 * (last - first) / duration * t**2
        rate = math.log(last / first) / duration
        return np.asarray(first * np.expm1(rate * t) / rate, dtype=float)

    t: FloatArray = np.arange(n, dtype=np.float64) * sample_time + (rotate % 1.0) * duration
    whole = float(cycles(np.array([duration]))[0])
    return np.sin(phase + 2 * np.pi * (cycles(t % duration) + np.where(t >= duration, whole, 0.0)))


def steps(
    n: int, dwell: int, *, rng: np.random.Generator, levels: int | None = None, jitter: float = 0.5
) -> FloatArray:
    """Return random levels within [-1, 1], each held for a random time.

    - ``n``: samples
    - ``dwell``: mean samples of one level
    - ``rng``: draws levels and times
    - ``levels``: number of equidistant levels; without it the level is uniform
    - ``jitter``: the time is uniform within ``dwell * (1 -+ jitter)``

    Examples
    --------
    >>> np.unique(steps(500, 10, rng=np.random.default_rng(0), levels=3)).tolist()
    [-1.0, 0.0, 1.0]
    """
    if dwell < 1 or not 0 <= jitter < 1 or (levels is not None and levels < 2):
        raise InputError(
            "steps",
            expected="dwell >= 1 sample, 0 <= jitter < 1, levels >= 2",
            got=f"dwell {dwell}, jitter {jitter}, levels {levels}",
            remedy="correct the option",
        )
    signal = np.empty(n)
    k = 0
    previous = math.nan
    while k < n:
        hold = max(1, round(dwell * (1 + jitter * float(rng.uniform(-1, 1)))))
        level = float(rng.uniform(-1, 1))
        if levels is not None:
            grid = np.linspace(-1, 1, levels)
            level = float(rng.choice(grid[grid != previous]))
        signal[k : k + hold] = level
        previous, k = level, k + hold
    return signal


def staircase(n: int, levels: int) -> FloatArray:
    """Return an even staircase from -1 up to 1 and down again, once over the record.

    Examples
    --------
    >>> staircase(8, 3).tolist()
    [-1.0, -1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]
    """
    if levels < 2:
        raise InputError("staircase", expected="at least 2 levels", got=str(levels), remedy="correct it")
    grid = np.linspace(-1, 1, levels)
    order = np.concatenate([grid, grid[-2:0:-1]])
    return np.asarray(order[np.arange(n) * order.size // n], dtype=float)


def band_noise(n: int, sample_time: float, band: tuple[float, float], *, rng: np.random.Generator) -> FloatArray:
    """Return Gaussian noise of rms one (in expectation) within a band, stationary from the first sample.

    It is cut from a periodic process twice as long whose spectral lines are independent complex Gaussians: no filter
    has to settle, and the ends of the record are not tied to each other. Raises InputError if the band holds no
    spectral line.

    - ``n, sample_time``: samples, and seconds between them
    - ``band`` (low, high): hz
    - ``rng``: draws the lines

    Examples
    --------
    >>> s = band_noise(20000, 0.01, (0.0, 5.0), rng=np.random.default_rng(0))
    >>> bool(0.9 < s.std() < 1.1)
    True
    """
    period = 2 * n + 1
    lines = lines_of_band(period, sample_time, band).astype(int)
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    draws = rng.standard_normal((2, lines.size))
    spectrum[lines] = (draws[0] + 1j * draws[1]) * period / (2 * math.sqrt(lines.size))
    return np.asarray(np.fft.irfft(spectrum, period)[:n], dtype=float)


def _prime_factors(number: int) -> list[int]:
    """Return the distinct prime factors by trial division (2^32 - 1 at most)."""
    found, divisor = [], 2
    while divisor * divisor <= number:
        if number % divisor == 0:
            found.append(divisor)
            while number % divisor == 0:
                number //= divisor
        divisor += 1
    return [*found, number] if number > 1 else found


def _power_of_x(exponent: int, modulus: int) -> int:
    """Return x^exponent modulo a polynomial over GF(2), polynomials as bits."""
    order = modulus.bit_length() - 1
    result, base = 1, 2 if order > 1 else 2 ^ modulus
    while exponent:
        if exponent & 1:
            result = _product(result, base, modulus, order)
        base = _product(base, base, modulus, order)
        exponent >>= 1
    return result


def _product(a: int, b: int, modulus: int, order: int) -> int:
    """Return the product of two polynomials over GF(2), reduced."""
    result = 0
    while b:
        if b & 1:
            result ^= a
        b >>= 1
        a <<= 1
        if a >> order & 1:
            a ^= modulus
    return result
