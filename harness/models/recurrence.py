"""States of ``x[k+1] = A x[k] + w[k]`` in blocks: the one loop behind filters and free runs of linear models."""

from __future__ import annotations

import numpy as np

from harness.signals import FloatArray

SHORT = 256  # Steps below which one step after the other is as fast as blocks.

LARGEST = 1e6
"""Most that A to the length of a block may enlarge: beyond, ends of blocks would lose digits that steps keep."""


def recurrence(a: FloatArray, x: FloatArray, w: FloatArray) -> FloatArray:
    """Return the states ``x[0] = x, x[k+1] = A x[k] + w[k]`` of several runs.

    A long run is cut into blocks that run beside each other, from rest first, and, once the powers of A have led from
    block to block, from their own first states: about ``2 sqrt(N)`` steps instead of N.

    - ``a`` (nx, nx)
    - ``x`` (M, nx): first states
    - ``w`` (M, N, nx): what is added at each step; the last row is not used
    - returns array (M, N, nx)

    Examples
    --------
    >>> recurrence(np.array([[0.5]]), np.array([[8.0]]), np.ones((1, 4, 1))).ravel().tolist()
    [8.0, 5.0, 3.5, 2.75]
    """
    m, n, nx = w.shape
    states = np.empty((m, n, nx))
    transposed = np.ascontiguousarray(a.T)
    length = int(np.sqrt(n / m))  # as many steps within blocks as there are from block to block
    blocks = n // length if n >= SHORT and length > 1 else 0
    power = np.linalg.matrix_power(transposed, length) if blocks > 1 else np.full((nx, nx), np.inf)
    if not np.abs(power).max(initial=0.0) <= LARGEST:
        _steps(transposed, np.broadcast_to(x, (m, nx)), w, states)
        return states
    whole = blocks * length
    inside = w[:, :whole].reshape(m, blocks, length, nx)
    ends = np.zeros((m, blocks, nx))
    for k in range(length):
        ends = ends @ transposed + inside[:, :, k]
    starts = np.empty((m, blocks + 1, nx))
    _steps(power, np.broadcast_to(x, (m, nx)), np.concatenate([ends, ends[:, :1]], axis=1), starts)
    pieces = np.empty((m * blocks, length, nx))
    _steps(transposed, starts[:, :-1].reshape(-1, nx), inside.reshape(-1, length, nx), pieces)
    states[:, :whole] = pieces.reshape(m, whole, nx)
    _steps(transposed, starts[:, -1], w[:, whole:], states[:, whole:])
    return states


def _steps(transposed: FloatArray, x: FloatArray, w: FloatArray, states: FloatArray) -> None:
    """Fill in the states (M, N, nx), one step after the other."""
    for k in range(w.shape[1]):
        states[:, k] = x
        x = x @ transposed + w[:, k]
