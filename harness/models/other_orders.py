"""What models of other orders say between the lines of an input, where no record speaks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from harness.algebra import column_norms
from harness.signals import FloatArray

ORDERS = (1, 2, 3, 4, 6, 8)  # Of the models that are asked.
DRAWS = 20  # Of coefficients that the lines bear as well, of each order.
BEARS = 0.25  # Share of the gain by which a model may depart at the lines and still say what lies between them.
DEPARTS = 0.25
"""Root mean square of the draws' departures, relative to the gain, up to which an order agrees: a normal one departs by
half in 5 % of draws."""
LEAKS, MOST = 4, 150  # Neighbours to which a line leaks, and lines that orders are fitted to at most.
EXACT = 1e-3  # Standard deviation of a response, relative to it, below which it counts as known exactly.

Told = npt.NDArray[np.bool_]
Complex = npt.NDArray[np.complex128]


def agreeing(response: Complex, deviation: FloatArray, turn: Complex, lit: Told) -> Told:
    """Return where (F,) all orders that bear out a response at the lines of an input say the same between them.

    Rational functions of some orders are fitted to the response at the lines and drawn from what its uncertainty there
    leaves open (Levy 1959, IRE Trans. AC-4:37; Sanathanan & Koerner 1963, IEEE TAC 8:56), dependent directions by
    coefficients of size 1: common factors of numerator and denominator change no response, what vanishes at the lines
    does.

    - ``response`` (F,): of the model, from an input to an output
    - ``deviation`` (F,): its standard deviation as the records tell it, where the input has lines
    - ``turn`` (F,): ``exp(2 pi i f)``, f in cycles per sample
    - ``lit`` array of bool (F,): where the input has lines
    """
    found = np.ones(len(turn), dtype=bool)
    if not lit.any():
        return found
    lines, between = _lines(lit), np.flatnonzero(~lit)
    size = np.maximum(np.abs(response), 1e-300)
    deviation = np.maximum(deviation, EXACT * size)
    asked = np.append(lines, between)
    for others in _responses(response[lines], deviation[lines], turn[lines], turn[asked]):
        with np.errstate(all="ignore"):
            apart = np.abs(others - response[asked]) / size[asked]
            if apart[0, : len(lines)].max() < BEARS:
                found[between] &= np.sqrt(np.mean(apart[:, len(lines) :] ** 2, axis=0)) < DEPARTS
    return found


def _lines(lit: Told) -> npt.NDArray[np.int_]:
    """Return the middle of short stretches that are lit, and every fourth of longer ones: at most so many lines."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lit, [False]]).astype(int)))
    found: list[int] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        found += range(start + (min(stop - start, LEAKS) - 1) // 2, stop, LEAKS)
    return np.array(found[:: 1 + len(found) // MOST])


def _responses(response: Complex, deviation: FloatArray, lines: Complex, turn: Complex) -> Iterator[Complex]:
    """Yield the responses (1 + draws, F) of one order after another, the likeliest first."""
    rng = np.random.default_rng(0)
    for order in ORDERS:
        late = np.arange(1.0, order + 1)
        back = lines[:, None] ** -late
        rows: Complex = np.hstack([-response[:, None] * back, back, np.ones((len(lines), 1))])
        weight = 1.0 / deviation
        for _ in range(2):  # once to learn the denominator
            weighed, target = _real(rows * weight[:, None]), _real(response * weight)
            length = column_norms(weighed)
            left, values, right = np.linalg.svd(weighed / length, full_matrices=True)
            left, values = left[:, : len(values)], np.pad(values, (0, len(right) - len(values)))
            kept = values > 1e-10 * values[0]
            seen = np.zeros(len(right))
            seen[: left.shape[1]] = left.T @ target
            middle = np.where(kept, seen / np.where(kept, values, 1.0), 0.0)
            theta = right.T @ middle / length
            weight = 1.0 / (deviation * np.maximum(np.abs(1.0 + back @ theta[:order]), 1e-3))
        open_by = np.minimum(1.0 / np.maximum(values, 1e-300), float(np.linalg.norm(target)))
        chance = np.vstack([np.zeros(len(right)), rng.normal(size=(DRAWS, len(right)))])
        drawn = (middle + open_by * chance) @ right / length
        back = turn[:, None] ** -late
        below = 1.0 + drawn[:, :order] @ back.T
        yield (drawn[:, order : 2 * order] @ back.T + drawn[:, -1:]) / np.where(below == 0, 1e-300, below)


def _real(rows: Complex) -> FloatArray:
    """Return real and imaginary parts below each other."""
    return np.concatenate([rows.real, rows.imag])
