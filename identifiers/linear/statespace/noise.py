"""The colour of the noise: autoregressions of what a plant leaves of its outputs, their length by Schwarz's rule."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.signals import FloatArray
from identifiers.linear.statespace.model import Errors, Piece

MOST = 6  # Length of an autoregression, at most.
INSIDE = 0.97  # Largest modulus of a pole of the noise at the start of a search.
EXACT = 1e-24  # Mean square, of outputs of size 1, that counts as rounding.


def noise_of(errors: Sequence[Errors], pieces: Sequence[Piece], most: int = MOST) -> FloatArray:
    """Return the coefficients (ny, p) of the noise that a plant leaves, one length for all outputs.

    - ``pieces``: which readings there are
    """
    ny = errors[0].left.shape[1]
    grams = [_gram(errors, pieces, output, most) for output in range(ny)]
    judged: list[float] = []
    found: list[FloatArray] = []
    for lags in range(most + 1):
        value, coefficients = 0.0, np.zeros((ny, lags))
        for output, (gram, rows) in enumerate(grams):
            theta = np.linalg.lstsq(gram[1 : lags + 1, 1 : lags + 1], gram[1 : lags + 1, 0], rcond=1e-12)[0]
            left = max(float(gram[0, 0] - theta @ gram[1 : lags + 1, 0]), 0.0) / max(rows, 1)
            value += rows / 2 * np.log(left + EXACT) + lags / 2 * np.log(max(rows, 2))
            coefficients[output] = -theta
        judged.append(value)
        found.append(coefficients)
    return np.array([_settled(one) for one in found[int(np.argmin(judged))]])


def _gram(errors: Sequence[Errors], pieces: Sequence[Piece], output: int, most: int) -> tuple[FloatArray, int]:
    """Return sums of products of what is left, now and so many samples before, and the number of rows."""
    gram, count = np.zeros((most + 1, most + 1)), 0
    for one, piece in zip(errors, pieces, strict=True):
        v, index = one.left[:, output], np.arange(most, len(one.left))
        if piece.read is not None:
            index = index[np.all([piece.read[index - j, output] for j in range(most + 1)], axis=0)]
        rows = np.column_stack([v[index - j] for j in range(most + 1)])
        gram += rows.T @ rows
        count += len(rows)
    return gram, count


def _settled(coefficients: FloatArray) -> FloatArray:
    """Return an autoregression whose poles lie inside."""
    radius = float(np.abs(np.roots(np.concatenate([[1.0], coefficients]))).max(initial=0.0))
    shrink = INSIDE / radius if radius > INSIDE else 1.0
    return np.asarray(coefficients * shrink ** np.arange(1, coefficients.size + 1), dtype=np.float64)
