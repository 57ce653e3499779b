"""Normal equations of a regression, summed in blocks, and their solution."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.algebra import divisor
from harness.signals import FloatArray

Blocks = Iterable[tuple[FloatArray, FloatArray]]
# Squared condition number beyond which the Gram matrix has lost all digits.
_POOR = 1e-12
# The estimate is one of the 1-norm, up to the number of columns off: so far above the limit no direction is lost.
_SAFE = 1e3


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """``gram`` (p, p), ``right`` (p, m), ``square`` (m,) of a regression, summed over ``rows`` rows in blocks."""

    gram: FloatArray
    right: FloatArray
    square: FloatArray
    rows: int

    @classmethod
    def of(cls, blocks: Blocks, p: int, m: int) -> NormalEquations:
        """Return the sums over blocks ``(Phi (p, n), target (m, n))``; memory stays that of one block."""
        gram, right, square, rows = np.zeros((p, p)), np.zeros((p, m)), np.zeros(m), 0
        for phi, target in blocks:
            gram += phi @ phi.T
            right += phi @ target.T
            square += np.einsum("ij,ij->i", target, target)
            rows += phi.shape[1]
        return cls(gram, right, square, rows)

    @classmethod
    def sum(cls, pieces: Sequence[NormalEquations], weights: npt.NDArray[np.int_]) -> NormalEquations:
        """Return the sum of pieces, each counted so many times."""
        used = [(piece, int(weight)) for piece, weight in zip(pieces, weights, strict=True) if weight]
        gram, right, square = (np.zeros_like(getattr(pieces[0], name)) for name in ("gram", "right", "square"))
        rows = 0
        for piece, weight in used:
            gram += weight * piece.gram
            right += weight * piece.right
            square += weight * piece.square
            rows += weight * piece.rows
        return cls(gram, right, square, rows)

    @classmethod
    def in_pieces(cls, blocks: Blocks, p: int, m: int) -> list[NormalEquations]:
        """Return the sums of stretches of 64 rows dealt out to 20 pieces; their sum is :meth:`of`."""
        count, size = 20, 64
        parts: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in range(count)]
        sums = [cls(np.zeros((p, p)), np.zeros((p, m)), np.zeros(m), 0) for _ in range(count)]
        place = 0
        for phi, target in blocks:
            for start in range(0, phi.shape[1], size):
                parts[place % count].append((phi[:, start : start + size], target[:, start : start + size]))
                place += 1
            for index, waiting in enumerate(parts):
                if waiting:
                    both = (np.hstack([block[0] for block in waiting]), np.hstack([block[1] for block in waiting]))
                    sums[index] = cls.sum([sums[index], cls.of([both], p, m)], np.ones(2, dtype=int))
                    waiting.clear()
        return [piece for piece in sums if piece.rows]


def scaled_equations(equations: NormalEquations) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Gram matrix and right-hand side of columns scaled to unit length, and their lengths."""
    size = divisor(np.sqrt(np.diag(equations.gram)))
    return equations.gram / np.outer(size, size), equations.right / size[:, None], size


def solved(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of normal equations with unit diagonal; that of least norm where they are dependent.

    By Cholesky factorisation where LAPACK's estimate of the condition number allows, else by eigenvalues.
    """
    from scipy.linalg.lapack import dpocon, dpotrf, dpotrs

    factor, fault = dpotrf(gram, lower=1, clean=0)
    if fault == 0:
        norm = float(np.abs(gram).sum(axis=0).max(initial=0.0))
        if dpocon(factor, norm, uplo="L")[0] > _SAFE * _POOR:
            return np.asarray(dpotrs(factor, right, lower=1)[0], dtype=np.float64)
    values, vectors = np.linalg.eigh(gram)
    good = values > _POOR * values[-1]
    found: FloatArray = vectors[:, good] @ ((vectors[:, good].T @ right).T / values[good]).T
    return found
