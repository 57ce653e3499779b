"""Belief compression: beliefs of a partially observed process as mixtures of a few typical ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

_SETTLED = 1e-7
"""Relative gain of the divergence in an iteration below which it ends."""


@dataclass(frozen=True, eq=False)
class BeliefCompression:
    """Beliefs (N, S) as mixtures: ``weights @ basis``.

    Parameters
    ----------
    basis : array (K, S)
        Typical beliefs; each sums to 1.
    weights : array (N, K)
        Each row sums to 1.
    divergence : float
        Mean Kullback-Leibler divergence of the mixtures from the beliefs, in nats.
    """

    basis: FloatArray
    weights: FloatArray
    divergence: float

    @property
    def beliefs(self) -> FloatArray:
        """The mixtures (N, S), themselves distributions."""
        return np.asarray(self.weights @ self.basis)


def compress_beliefs(
    beliefs: FloatArray, size: int, *, rng: np.random.Generator, iterations: int = 2000
) -> BeliefCompression:
    """Find the ``size`` typical beliefs whose mixtures are closest to the given ones.

    Beliefs that a process visits lie near a surface of few dimensions (Roy, Gordon and Thrun 2005, *JAIR* 23). Here the
    surface is flat and its points stay distributions: multiplicative updates of the Kullback-Leibler divergence (Lee
    and Seung 2001, *NIPS* 13, theorem 2), which keep the sums, started at visited beliefs that lie far apart.

    Parameters
    ----------
    beliefs : array (N, S)
        Each row sums to 1.
    size : int
        Number of typical beliefs, 1 to S.
    rng : numpy.random.Generator
        For the first of the starting beliefs.
    iterations : int
        At most.

    Raises
    ------
    InputError
        If the rows are no distributions or the size does not fit.

    Examples
    --------
    >>> corner = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.25, 0.25]])
    >>> compress_beliefs(corner, 2, rng=np.random.default_rng(0)).divergence < 1e-4
    True
    """
    b = np.asarray(beliefs, dtype=float)
    if b.ndim != 2 or (b < 0).any() or np.abs(b.sum(axis=1) - 1.0).max() > 1e-6:
        raise InputError(
            "beliefs", expected="rows (N, S) that sum to 1", got=f"shape {b.shape}", remedy="take HmmModel.beliefs"
        )
    if not 1 <= size <= b.shape[1]:
        raise InputError("size", expected=f"1 .. {b.shape[1]} (states)", got=str(size), remedy="correct it")
    chosen = [int(rng.integers(len(b)))]
    distance = np.abs(b - b[chosen[0]]).sum(axis=1)
    while len(chosen) < size:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.abs(b - b[chosen[-1]]).sum(axis=1))
    # Nothing starts at 0, which no multiplication leaves.
    basis = 0.99 * b[chosen] + 0.01 / b.shape[1]
    weights = np.full((len(b), size), 1.0 / size)
    last = np.inf
    for _ in range(iterations):
        weights = weights * ((b / np.maximum(weights @ basis, 1e-300)) @ basis.T)
        weights /= weights.sum(axis=1, keepdims=True)
        basis = basis * (weights.T @ (b / np.maximum(weights @ basis, 1e-300)))
        basis /= basis.sum(axis=1, keepdims=True)
        now = _divergence(b, weights @ basis)
        if last - now < _SETTLED * max(now, 1e-12):
            break
        last = now
    return BeliefCompression(basis, weights, _divergence(b, weights @ basis))


def _divergence(b: FloatArray, mixture: FloatArray) -> float:
    """Return the mean Kullback-Leibler divergence of the rows."""
    ratio = np.where(b > 0, b / np.maximum(mixture, 1e-300), 1.0)
    return float(np.maximum(np.sum(b * np.log(ratio), axis=1), 0.0).mean())
