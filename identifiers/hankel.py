"""Leading singular vectors of a block Hankel matrix that is never formed: products by FFT, subspace iteration."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

__all__ = ["leading_singular_vectors"]

# Below this size the dense decomposition is faster.
_DENSE = 250
_ROUNDS = 40


def leading_singular_vectors(
    markov: FloatArray, rows: int, columns: int, count: int
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the leading singular triplets of ``H[i, j] = markov[i + j]``.

    Subspace iteration from a random start (Halko, Martinsson & Tropp 2011, SIAM Review 53:217, algorithm 4.4), carried
    on until the singular values stand still to rounding.

    Parameters
    ----------
    markov : array (rows + columns - 1, ny, nu)
    rows, columns : int
        Number of block rows and block columns.
    count : int
        Number of triplets.

    Returns
    -------
    (U (rows ny, count), s (count,), V' (count, columns nu)), or None where a dense decomposition is the better way: the
    matrix is small, or the iteration has not settled (no gap after the leading values).

    Examples
    --------
    >>> G = 0.9 ** np.arange(599)[:, None, None]
    >>> found = leading_singular_vectors(G, 300, 300, 1)
    >>> float(found[1][0].round(9)) == float((0.9 ** (2 * np.arange(300))).sum().round(9))
    True
    """
    from scipy.fft import irfft, next_fast_len, rfft

    length, ny, nu = markov.shape
    width = count + 8
    if min(rows * ny, columns * nu) < max(_DENSE, 4 * width) or length != rows + columns - 1:
        return None
    size = next_fast_len(length + max(rows, columns), real=True)
    spectrum = rfft(markov, size, axis=0)

    def times(v: FloatArray) -> FloatArray:
        """Return H v: a correlation of the sequence with v, which is a convolution with v reversed in time."""
        blocks = v.reshape(columns, nu, -1)[::-1]
        out = irfft(spectrum @ rfft(blocks, size, axis=0), size, axis=0)[columns - 1 : columns - 1 + rows]
        return np.ascontiguousarray(out).reshape(rows * ny, -1)

    def transposed_times(w: FloatArray) -> FloatArray:
        """Return H' w."""
        blocks = w.reshape(rows, ny, -1)[::-1]
        out = irfft(spectrum.transpose(0, 2, 1) @ rfft(blocks, size, axis=0), size, axis=0)[
            rows - 1 : rows - 1 + columns
        ]
        return np.ascontiguousarray(out).reshape(columns * nu, -1)

    # The start is part of the algorithm, not of the data: always the same.
    basis = np.linalg.qr(times(np.random.default_rng(0).normal(size=(columns * nu, width))))[0]
    before = np.zeros(count)
    for _ in range(_ROUNDS):
        right = np.linalg.qr(transposed_times(basis))[0]
        basis, triangle = np.linalg.qr(times(right))
        inner, values, outer = np.linalg.svd(triangle)
        if not values[0] > 0:
            return None
        if np.all(np.abs(values[:count] - before) <= 4e-15 * values[0]):
            return basis @ inner[:, :count], values[:count], outer[:count] @ right.T
        before = values[:count].copy()
    return None
