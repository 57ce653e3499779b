"""Linear least squares over many rows: normal equations in blocks, QR where they are not accurate enough."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import FitError
from harness.judgement import dependence_text
from harness.signals import FloatArray
from identifiers.common.normal import NormalEquations

# The Gram matrix squares the condition number: beyond this (of scaled columns) half of the digits are gone.
_GRAM_LIMIT = 1e5
Blocks = Callable[[], Iterable[tuple[FloatArray, FloatArray]]]


@dataclass(frozen=True, eq=False)
class Solution:
    """What a regression found, and what a decision on rank needs."""

    coefficients: FloatArray  # (p, m)
    singular_values: FloatArray  # (p,): Of the regressors with columns scaled to unit length
    residual_rms: FloatArray  # (m,)
    rows: int
    method: str  # How it was solved
    factor: FloatArray  # (p, p): R with ``R' R`` the Gram matrix of the scaled columns
    scale: FloatArray  # (p,): Length of each column

    @property
    def condition(self) -> float:
        """Condition number of the regressors with columns scaled to unit length."""
        low = float(self.singular_values[-1])
        return float(self.singular_values[0]) / low if low > 0 else float("inf")


def solve(
    blocks: Blocks,
    what: str,
    *,
    ridge: float = 0.0,
    rank_tolerance: float = 1e-11,
    least_norm: bool = False,
    names: Sequence[str] = (),
    sums: NormalEquations | None = None,
) -> Solution:
    """Solve ``min ||Y - Phi C||`` for rows that come in blocks.

    Raises FitError if the columns are linearly dependent (with neither a ridge nor ``least_norm``), or there are fewer
    rows than columns.

    - ``blocks``: returns the blocks ``(Phi (n, p), Y (n, m))`` anew each time: a badly conditioned problem is read
      twice
    - ``what``: for messages
    - ``ridge``: tikhonov weight relative to the mean squared column length
    - ``rank_tolerance``: relative to the largest singular value of the scaled columns
    - ``least_norm``: answer dependent columns with the solution of least norm instead of refusing them
    - ``names``: names of the columns, so that a refusal can say which of them depend on each other
    - ``sums``: those of the blocks, where they are known already
    """
    gram = right = square = None
    rows = 0
    if sums is not None:
        gram, right, square, rows = sums.gram, sums.right, sums.square, sums.rows
    else:
        for phi, y in blocks():
            if gram is None or right is None or square is None:
                gram = np.zeros((phi.shape[1], phi.shape[1]))
                right = np.zeros((phi.shape[1], y.shape[1]))
                square = np.zeros(y.shape[1])
            gram += phi.T @ phi
            right += phi.T @ y
            square += np.einsum("ij,ij->j", y, y)
            rows += phi.shape[0]
    if gram is None or right is None or square is None or rows < gram.shape[0]:
        columns = 0 if gram is None else gram.shape[0]
        raise FitError(
            f"{what}: fewer equations than unknowns",
            expected=f"at least {columns} samples",
            got=str(rows),
            remedy="record longer, or use fewer features",
        )
    scale = np.sqrt(np.diag(gram))
    if not np.isfinite(scale).all():
        raise FitError(f"{what}: regressors overflow", expected="finite", got="inf", remedy="scale the signals")
    scale = np.where(scale > 0, scale, 1.0)
    scaled = gram / np.outer(scale, scale)
    if ridge > 0:
        scaled = scaled + ridge * np.eye(scaled.shape[0])
    squares, vectors = np.linalg.eigh(scaled)
    values = np.sqrt(np.clip(squares[::-1], 0.0, None))
    if values[-1] * _GRAM_LIMIT > values[0]:
        coefficients = np.linalg.solve(scaled, right / scale[:, None]) / scale[:, None]
        factor = values[:, None] * vectors[:, ::-1].T
        lost = square - 2 * np.einsum("ij,ij->j", coefficients, right)
        lost = lost + np.einsum("ij,ij->j", coefficients, gram @ coefficients)
        # Below this the difference of squares is rounding: read the residual off the data.
        if np.all(lost > 1e-10 * square):
            return Solution(coefficients, values, np.sqrt(lost / rows), rows, "normal equations", factor, scale)
        rms = _residual(blocks, coefficients)
        return Solution(coefficients, values, rms, rows, "normal equations", factor, scale)
    return _by_qr(blocks, scale, ridge, rows, what, rank_tolerance, least_norm, names)


def _by_qr(
    blocks: Blocks,
    scale: FloatArray,
    ridge: float,
    rows: int,
    what: str,
    tolerance: float,
    least_norm: bool,
    names: Sequence[str],
) -> Solution:
    """Solve by a QR factorisation updated block by block (Golub & Van Loan 2013, sec. 6.5)."""
    p = scale.size
    waiting: list[FloatArray] = []
    rows_waiting = 0
    for phi, y in blocks():
        waiting.append(np.hstack([phi / scale, y]))
        rows_waiting += len(phi)
        if rows_waiting >= 4 * waiting[0].shape[1]:  # short records together: each update costs a whole triangle
            waiting, rows_waiting = [np.asarray(np.linalg.qr(np.vstack(waiting), mode="r"))], 0
    triangle = np.asarray(np.linalg.qr(np.vstack(waiting), mode="r"))
    r, z = triangle[:p, :p], triangle[:p, p:]
    if ridge > 0:
        q, r = np.linalg.qr(np.vstack([r, np.sqrt(ridge) * np.eye(p)]))
        z = q[:p].T @ z
    left, values, right = np.linalg.svd(r)
    if values[-1] <= tolerance * values[0] and least_norm:
        kept = values > tolerance * values[0]
        some = right[kept].T @ ((left[:, kept].T @ z) / values[kept, None]) / scale[:, None]
        method = f"QR, least norm (rank {int(kept.sum())} of {p})"
        return Solution(some, values, _residual(blocks, some), rows, method, r, scale)
    if values[-1] <= tolerance * values[0]:
        rank = int(np.sum(values > tolerance * values[0]))
        law = f": {dependence_text(right[-1] / scale, scale, names)}" if len(names) >= p else ""
        raise FitError(
            f"{what}: the data do not determine the model",
            expected=f"rank {p} of {p} regressors",
            got=f"rank {rank} of {p} (singular values {values[0]:.3g} to {values[-1]:.3g}){law}",
            remedy="excite the plant beyond what its controller commands, or use fewer features",
        )
    coefficients = (right.T @ ((left.T @ z) / values[:, None])) / scale[:, None]
    rms = _residual(blocks, coefficients)
    return Solution(coefficients, values, rms, rows, "QR (ill-conditioned)", r, scale)


def _residual(blocks: Blocks, coefficients: FloatArray) -> FloatArray:
    """Return the rms of ``Y - Phi C`` of each column."""
    total = np.zeros(coefficients.shape[1])
    rows = 0
    for phi, y in blocks():
        miss = y - phi @ coefficients
        total += np.einsum("ij,ij->j", miss, miss)
        rows += phi.shape[0]
    rms: FloatArray = np.sqrt(total / rows)
    return rms
