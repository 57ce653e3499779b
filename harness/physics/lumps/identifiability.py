"""Which parameters a regression determines: rank and dependent combinations by QR with column pivoting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.models.estimate import SHARE, RankDecision
from harness.signals import FloatArray

NOISE_RATIO = 1.5
"""A direction of the parameters counts as determined where the regressor moves by more than this many times what its
noise alone makes. Below, more than 4/9 of its energy is noise, and least squares shrinks the parameter to less than
5/9 of the truth (attenuation, Fuller 1987, *Measurement Error Models*, eq. 1.1.7)."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What the columns of a regressor tell apart."""

    names: tuple[str, ...]  # One for each column
    rank: int
    kept: tuple[int, ...]
    """Columns that are determined, in their own order; fitted alone they stand for the combinations."""
    combinations: tuple[str, ...]  # What each kept column stands for: ``"I1 + 0.5 m2"``
    sizes: FloatArray  # Diagonal of R, columns scaled to norm 1, in pivoting order
    gap: float  # Ratio of the last kept to the first dropped (infinite at full rank)
    unseen: tuple[str, ...]  # Columns that are zero: parameters without any effect on these rows
    dropped: tuple[int, ...]  # Columns that are sums of kept ones
    shares: FloatArray
    """(kept, dropped): Column ``dropped[j]`` is ``sum_i shares[i, j]`` times column ``kept[i]``: fitted alone,
    parameter ``kept[i]`` stands for itself plus ``sum_j shares[i, j]`` times parameter ``dropped[j]``."""

    def __str__(self) -> str:
        text = f"rank {self.rank} of {len(self.names)}: {', '.join(self.combinations)}"
        return text + (f"; without effect: {', '.join(self.unseen)}" if self.unseen else "")


def identifiability(rows: FloatArray, names: Sequence[str], *, tolerance: float = 1e-8) -> Identifiability:
    """Return rank and dependent columns of a regressor (Gautier 1991, numerical base parameters).

    Raises InputError if the number of names is not that of the columns.

    - ``rows`` (M, k): the regressor
    - ``names``: one for each column
    - ``tolerance``: a column counts as dependent if what is new in it is smaller than this, relative to its norm

    Examples
    --------
    >>> x = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, 2.0], [1.0, 1.0, 4.0]])
    >>> print(identifiability(x, ["a", "b", "c"]))
    rank 2 of 3: a + 2*c, b + 2*c
    """
    from scipy.linalg import qr, solve_triangular

    rows = np.asarray(rows, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise InputError(
            "names of a regressor",
            expected=f"{rows.shape[-1]}, one for each column",
            got=str(len(names)),
            remedy="name every column",
        )
    norms = np.linalg.norm(rows, axis=0)
    largest = norms.max(initial=0.0)
    seen = [k for k in range(len(names)) if norms[k] > 1e-14 * largest and norms[k] > 0]
    unseen = tuple(names[k] for k in range(len(names)) if k not in seen)
    if not seen:
        return Identifiability(tuple(names), 0, (), (), np.zeros(0), np.inf, unseen, (), np.zeros((0, 0)))
    scaled = rows[:, seen] / norms[seen]
    if scaled.shape[0] > 4 * scaled.shape[1]:
        scaled = np.linalg.qr(scaled, mode="r")  # tall: the pivoting sees the same inner products
    # Among equally good columns the first is kept: a tiny preference, so that names do not depend on rounding.
    preferred = scaled * (1.0 - 1e-7 * np.arange(len(seen)))
    r, pivots = qr(preferred, mode="r", pivoting=True)
    sizes = np.abs(np.diag(r[: min(r.shape)]))
    rank = int(np.sum(sizes > tolerance))
    gap = float(sizes[rank - 1] / sizes[rank]) if 0 < rank < len(sizes) and sizes[rank] > 0 else np.inf
    order = np.argsort(pivots[:rank])
    kept = [int(pivots[index]) for index in order]
    dropped = [k for k in range(len(seen)) if k not in kept]
    share = np.zeros((len(kept), len(dropped)))
    if dropped:
        q, upper = np.linalg.qr(scaled[:, kept])
        share = solve_triangular(upper, q.T @ scaled[:, dropped])
        share *= norms[seen][dropped] / norms[seen][kept][:, None]
    combinations = []
    for row, column in enumerate(kept):
        text = names[seen[column]]
        for place, other in enumerate(dropped):
            size = share[row, place] * norms[seen][column] / norms[seen][other]
            if abs(size) > 1e-6:
                text += _term(share[row, place], names[seen[other]])
        combinations.append(text)
    order_of = tuple(seen[column] for column in kept), tuple(seen[column] for column in dropped)
    return Identifiability(tuple(names), rank, order_of[0], tuple(combinations), sizes, gap, unseen, order_of[1], share)


def determined(
    rows: FloatArray, names: Sequence[str], noise: FloatArray | None = None, *, tolerance: float = 1e-8
) -> tuple[RankDecision, FloatArray, float]:
    """Return which directions of the parameters a regressor determines, relative to the noise that is in it.

    - ``rows, names`` array (M, k), sequence of str: the regressor and its columns
    - ``noise`` (any, k): what errors change in the rows: those of a record with as much noise again, minus the rows;
      and those of another smoothing, minus the rows, below
    - ``tolerance``: numerical floor: least singular value, columns at unit length

    Returns
    -------
    decision : RankDecision
    kept : array (k, rank)
        Columns span the determined directions, in parameters times the lengths of the columns of ``rows``.
    condition : float
        Of the rows, columns at unit length; infinite if one is zero.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.normal(size=(400, 2))
    >>> exact = np.column_stack([x, 2 * x[:, 1]])
    >>> rows, again = (exact + 1e-6 * rng.normal(size=exact.shape) for _ in range(2))
    >>> print(determined(rows, ["a", "b", "c"], again - exact)[0])
    rank 2 of 3 (1.5 times the errors in the regressor); not determined: c and b only in proportion: c may fall
    by 0.5 for each 1 of b
    """
    lengths = np.linalg.norm(rows, axis=0)
    size = np.where(lengths > 0, lengths, 1.0)
    upper = np.linalg.qr(rows / size, mode="r")
    limit: FloatArray = tolerance * np.eye(len(names))
    rule = f"a tolerance of {tolerance:g}"
    if noise is not None:
        limit = np.asarray(np.linalg.qr(np.vstack([NOISE_RATIO * noise / size, limit]), mode="r"))
        rule = f"{NOISE_RATIO:g} times the errors in the regressor"
    # How far each direction stands above what counts as nothing, without squaring (generalised singular values).
    inverse = np.linalg.inv(limit)
    _, sizes, vectors = np.linalg.svd(upper @ inverse, full_matrices=True)
    sizes = np.concatenate([sizes, np.zeros(len(names) - sizes.size)])
    vectors, weak = inverse @ vectors.T, sizes <= 1.0
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    singular = np.linalg.svd(upper, compute_uv=False)
    full = singular.size == len(names) and singular[-1] > 0 and bool(np.all(lengths > 0))
    condition = float(singular[0] / singular[-1]) if full else float("inf")
    null = np.linalg.qr(vectors[:, weak])[0] if weak.any() else np.zeros((len(names), 0))
    kept = np.linalg.svd(null, full_matrices=True)[0][:, null.shape[1] :] if weak.any() else np.eye(len(names))
    return RankDecision.of(names, null, lengths, np.sum(null**2, axis=1) > SHARE**2, rule), kept, condition


def _term(factor: float, name: str) -> str:
    """Return `` + 2*c``."""
    sign, size = (" + ", factor) if factor > 0 else (" - ", -factor)
    body = f"({name})" if " " in name else name
    return sign + (body if abs(size - 1) < 1e-9 else f"{size:.6g}*{body}")
