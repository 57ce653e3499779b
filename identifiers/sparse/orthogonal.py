"""Forward selection by error reduction ratios: orthogonal least squares on normal equations (FROLS)."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, log
from typing import Literal

import numpy as np

from harness.signals import FloatArray
from identifiers.common.normal import NormalEquations, scaled_equations, solved

Criterion = Literal["ebic", "bic", "aic"]

# A column of which the chosen ones leave less than this share of its square follows from them: the Gram matrix has
# squared its rounding, and 1e-9 is a hundred times what that leaves of 16 digits (Chen, Billings & Luo 1989
# ask for such a limit on w'w).
_FOLLOWS = 1e-9
# A square that is lost below this share of the target's is rounding.
_LOST = 1e-13


@dataclass(frozen=True, eq=False)
class SelectionPath:
    """Terms in the order in which they were chosen.

    Parameters
    ----------
    order : tuple of int
    ratios : array (k,)
        Error reduction ratio of each: the share of the target's square that it explains beyond those before.
    """

    order: tuple[int, ...]
    ratios: FloatArray

    def lost(self, count: int) -> float:
        """Return the share of the target's square that so many terms leave."""
        return max(1.0 - float(self.ratios[:count].sum()), _LOST)


def frols(equations: NormalEquations, column: int, most: int) -> SelectionPath:
    """Return the terms that explain most of a target, each beyond those before.

    Forward regression with orthogonal least squares (Chen, Billings & Luo 1989, Int. J. Control 50:1873, sec. 3;
    Billings 2013, *Nonlinear System Identification*, ch. 3): of all columns, made orthogonal to those chosen, the
    one of the largest error reduction ratio ``(w'y)^2 / (w'w y'y)`` is next. Here on the Gram matrix, as a Cholesky
    factorisation with that pivot: memory and time do not grow with the records.

    - ``column``: of the target
    - ``most``: terms at most

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(6, 200))
    >>> one = NormalEquations.of([(phi, phi[1:2] - 3.0 * phi[4:5])], 6, 1)
    >>> frols(one, 0, 6).order
    (4, 1)
    """
    gram, right, _ = scaled_equations(equations)
    p, square = len(gram), float(equations.square[column])
    left, pull = np.diag(gram).copy(), right[:, column].copy()
    factor = np.zeros((p, min(most, p)))
    order: list[int] = []
    ratios: list[float] = []
    while len(order) < factor.shape[1] and square > 0 and 1.0 - sum(ratios) > _LOST:
        gains = np.where(left > _FOLLOWS, pull**2 / np.maximum(left, _FOLLOWS), 0.0)
        best = int(np.argmax(gains))
        if gains[best] <= _LOST * square:
            break
        k, pivot = len(order), float(np.sqrt(left[best]))
        made = (gram[:, best] - factor[:, :k] @ factor[best, :k]) / pivot
        step = float(pull[best]) / pivot
        factor[:, k] = made
        pull = pull - step * made
        left = left - made**2
        left[best] = 0.0
        order.append(best)
        ratios.append(float(gains[best]) / square)
    return SelectionPath(tuple(order), np.array(ratios))


def helpful(equations: NormalEquations, column: int, keep: list[int], count: int) -> list[int]:
    """Return so many terms of the largest error reduction ratio beyond those that are kept.

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(6, 200))
    >>> one = NormalEquations.of([(phi, phi[1:2] - 3.0 * phi[4:5])], 6, 1)
    >>> helpful(one, 0, [4], 1)
    [1]
    """
    gram, right, _ = scaled_equations(equations)
    left, pull = np.diag(gram).copy(), right[:, column].copy()
    if keep:
        values, vectors = np.linalg.eigh(gram[np.ix_(keep, keep)])
        good = values > _FOLLOWS * values[-1]
        cross = gram[:, keep] @ (vectors[:, good] / np.sqrt(values[good]))
        seen = (vectors[:, good] / np.sqrt(values[good])).T @ right[keep, column]
        left, pull = left - np.einsum("ij,ij->i", cross, cross), pull - cross @ seen
    gains = np.where(left > _FOLLOWS, pull**2 / np.maximum(left, _FOLLOWS), 0.0)
    gains[keep] = 0.0
    best = np.argsort(-gains, kind="stable")[:count]
    return [int(j) for j in best if gains[j] > 0.0]


def lost_share(equations: NormalEquations, column: int, keep: list[int]) -> float:
    """Return the share of a target's square that some terms leave, never less than rounding.

    Examples
    --------
    >>> phi = np.eye(3)
    >>> round(lost_share(NormalEquations.of([(phi, np.array([[3.0, 4.0, 0.0]]))], 3, 1), 0, [1]), 12)
    0.36
    """
    gram, right, _ = scaled_equations(equations)
    square = float(equations.square[column])
    seen = float(right[keep, column] @ solved(gram[np.ix_(keep, keep)], right[keep, column])) if keep else 0.0
    return max(1.0 - seen / square, _LOST) if square > 0 else _LOST


def criterion_value(lost: float, terms: int, rows: int, choices: int, criterion: Criterion) -> float:
    """Return a criterion of the number of terms, less is better: N ln(lost) and a price of each term.

    ``"aic"`` asks 2 (Akaike 1974), ``"bic"`` ln N (Schwarz 1978), ``"ebic"`` counts beside that how many sets of so
    many terms there were to choose from (Chen & Chen 2008, Biometrika 95:759): a dictionary of hundreds asks for it.

    - ``lost``: share of the square that is left
    - ``terms, rows, choices``: terms chosen, equations, and terms to choose from
    - ``criterion`` {"ebic", "bic", "aic"}

    Examples
    --------
    >>> round(criterion_value(0.5, 2, 100, 10, "bic") - criterion_value(0.5, 1, 100, 10, "bic"), 3)
    4.605
    """
    price = 2.0 * terms if criterion == "aic" else terms * log(rows)
    if criterion == "ebic":
        price += 2.0 * log(comb(choices, terms))
    return rows * log(max(lost, 1e-300)) + price
