"""Block Hankel matrices that are never formed: products by FFT, leading singular triplets by block Lanczos."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

# Up to so many block rows or columns a product with the matrix itself is faster than one by FFT.
_DENSE = 250
# Blocks of the Krylov space before the matrix counts as one without a gap after the leading values.
_BLOCKS = 24
# Residual of a triplet relative to the largest singular value: what a dense decomposition leaves too.
_TOLERANCE = 8e-15


class Hankel:
    """``H[i, j] = markov[i + j]``, blocks (ny, nu).

    - ``markov`` (rows + columns - 1, ny, nu)
    - ``rows, columns``: number of block rows and block columns

    Examples
    --------
    >>> H = Hankel(np.arange(4.0)[:, None, None], 2, 3)
    >>> H.dense().tolist(), H.times(np.eye(3)).round(9).tolist() == H.dense().tolist()
    ([[0.0, 1.0, 2.0], [1.0, 2.0, 3.0]], True)
    """

    def __init__(self, markov: FloatArray, rows: int, columns: int) -> None:
        length, self.ny, self.nu = markov.shape
        if length != rows + columns - 1:
            raise ValueError(f"{rows} + {columns} - 1 Markov parameters expected, got {length}")
        self.markov, self.rows, self.columns = markov, rows, columns
        self.large = min(rows, columns) >= _DENSE

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, not counted in blocks."""
        return self.rows * self.ny, self.columns * self.nu

    def dense(self) -> FloatArray:
        """Return the matrix (rows ny, columns nu)."""
        return self._matrix

    def times(self, v: FloatArray) -> FloatArray:
        """Return ``H v`` for v (columns nu, k): a correlation of the sequence with v."""
        if not self.large:
            return np.asarray(self._matrix @ v)
        return self._correlated(self._spectrum, v.reshape(self.columns, self.nu, -1)).reshape(self.rows * self.ny, -1)

    def back(self, w: FloatArray) -> FloatArray:
        """Return ``H' w`` for w (rows ny, k)."""
        if not self.large:
            return np.asarray(self._matrix.T @ w)
        turned = self._spectrum.transpose(0, 2, 1)
        return self._correlated(turned, w.reshape(self.rows, self.ny, -1)).reshape(self.columns * self.nu, -1)

    @functools.cached_property
    def _matrix(self) -> FloatArray:
        blocks = np.lib.stride_tricks.sliding_window_view(self.markov, self.columns, axis=0)
        return np.ascontiguousarray(blocks.transpose(0, 1, 3, 2)).reshape(self.shape)

    @functools.cached_property
    def _size(self) -> int:
        """Length of the transforms: what wraps around falls on samples that are not wanted."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(len(self.markov), real=True))

    @functools.cached_property
    def _spectrum(self) -> npt.NDArray[np.complex128]:
        from scipy.fft import rfft

        return np.asarray(rfft(self.markov, self._size, axis=0), dtype=np.complex128)

    def _correlated(self, spectrum: npt.NDArray[np.complex128], blocks: FloatArray) -> FloatArray:
        """Return the convolution with blocks reversed in time, where all of them lie within the sequence."""
        from scipy.fft import irfft, rfft

        out = irfft(spectrum @ rfft(blocks[::-1], self._size, axis=0), self._size, axis=0)
        return np.ascontiguousarray(out[len(blocks) - 1 : len(self.markov)])


def leading_triplets(matrix: Hankel, count: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the leading singular triplets of a block Hankel matrix.

    Block Lanczos bidiagonalisation with full reorthogonalisation (Golub, Luk & Overton 1981, ACM Trans. Math. Softw.
    7:149) from a random start, carried on until ``||H' u - s v||`` of every triplet is rounding: as accurate as a dense
    decomposition.

    - ``count``: number of triplets

    - returns (U (rows ny, count), s (count,), V' (count, columns nu)), or None where a dense decomposition is the
      better way: the matrix is small beside ``count``, or the iteration does not settle (no gap after the leading
      values)

    Examples
    --------
    >>> G = 0.9 ** np.arange(599)[:, None, None]
    >>> values = leading_triplets(Hankel(G, 300, 300), 1)[1]
    >>> float(values[0].round(9)) == float((0.9 ** (2 * np.arange(300))).sum().round(9))
    True
    """
    from scipy.linalg.lapack import dgesdd

    n, m = matrix.shape
    most = min(_BLOCKS, min(n, m) // (2 * count))
    left, right = np.empty((n, most * count)), np.empty((m, (most + 1) * count))
    small = np.zeros((most * count, most * count))  # U' H V, known block by block
    # The start is part of the algorithm, not of the data: always the same.
    v = right[:, :count] = _orthonormal(np.random.default_rng(0).normal(size=(m, count)))
    for block in range(most):
        before, own, after = slice(0, block * count), slice(0, (block + 1) * count), (block + 1) * count
        here, there = slice(block * count, after), slice(after, after + count)
        w = matrix.times(v)
        if block:
            shares = left[:, before].T @ w
            w = w - left[:, before] @ shares
            again = left[:, before].T @ w
            w = w - left[:, before] @ again
            small[before, here] = shares + again
        u = left[:, here] = _orthonormal(w)
        small[here, here] = u.T @ w
        z = matrix.back(u)
        for _ in range(2):
            z = z - right[:, own] @ (right[:, own].T @ z)
        v = right[:, there] = _orthonormal(z)
        if block < 2:  # nothing has settled after so few
            continue
        inner, values, outer, fault = dgesdd(small[own, own])
        if fault or not values[0] > 0:
            return None
        residual = (v.T @ z) @ inner[here, :count]
        if np.einsum("ij,ij->j", residual, residual).max() <= (_TOLERANCE * values[0]) ** 2:
            return left[:, own] @ inner[:, :count], values[:count], outer[:count] @ right[:, own].T
    return None


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of tall columns, by LAPACK without ceremony: the matrices are small and many."""
    from scipy.linalg.lapack import dgeqrf, dorgqr

    factored, tau, _, _ = dgeqrf(columns)
    return np.asarray(dorgqr(factored, tau, overwrite_a=1)[0], dtype=np.float64)
