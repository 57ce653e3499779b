"""Choosing terms of a regression from its normal equations: LASSO path, best subset, ensembles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb, log

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray
from identifiers.common.normal import NormalEquations, scaled_equations, solved

BoolArray = npt.NDArray[np.bool_]
Rule = Callable[[NormalEquations], tuple[FloatArray, BoolArray]]
# Up to so many subsets of one size all are tried; beyond that terms are exchanged until no exchange helps.
_EXHAUSTIVE = 5000
# Penalties of the path, from the one that empties the model down to this fraction of it.
_PENALTIES, _LEAST = 60, 1e-5


def lasso_path(gram: FloatArray, right: FloatArray, penalties: FloatArray) -> FloatArray:
    """Return coefficients (len(penalties), p) that minimise ``c' G c / 2 - c' r + penalty |c|_1``.

    Coordinate descent with warm starts (Friedman, Hastie & Tibshirani 2010, J. Stat. Softw. 33:1, sec. 2.2), columns of
    unit length.

    - ``gram`` (p, p): of columns of unit length
    - ``right`` (p,)
    - ``penalties`` (L,): falling

    Examples
    --------
    >>> lasso_path(np.eye(2), np.array([3.0, -1.0]), np.array([2.0, 0.5])).tolist()
    [[1.0, 0.0], [2.5, -0.5]]
    """
    p = right.size
    found, own = np.zeros((penalties.size, p)), np.zeros(p)
    residual = right.copy()  # r - G c
    size = float(np.abs(right).max(initial=0.0))
    for index, penalty in enumerate(penalties):
        everyone = True
        for _ in range(1000):
            moved = 0.0
            for j in range(p) if everyone else np.flatnonzero(own):
                if gram[j, j] == 0.0:
                    continue
                pull = residual[j] + gram[j, j] * own[j]
                new = np.sign(pull) * max(abs(pull) - penalty, 0.0) / gram[j, j]
                step = new - own[j]
                if step != 0.0:
                    residual -= gram[:, j] * step
                    own[j] = new
                    moved = max(moved, abs(step))
            if moved <= 1e-7 * size:
                if everyone:
                    break
                everyone = True
            else:
                everyone = False
        found[index] = own
    return found


def lasso(equations: NormalEquations) -> tuple[FloatArray, BoolArray]:
    """Return coefficients (p, m) and support: on the LASSO path the one of least extended BIC, fitted anew.

    Tibshirani 1996 (J. R. Stat. Soc. B 58:267); least squares on the chosen terms takes the shrinkage away (Belloni &
    Chernozhukov 2013, Bernoulli 19:521).

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(4, 300))
    >>> one = NormalEquations.of([(phi, 2.0 * phi[1:2] + 0.1 * np.random.default_rng(1).normal(size=(1, 300)))], 4, 1)
    >>> lasso(one)[1].ravel().tolist()
    [False, True, False, False]
    """
    gram, right, size = scaled_equations(equations)
    p, m = right.shape
    coefficients, support = np.zeros((p, m)), np.zeros((p, m), dtype=bool)
    for column in range(m):
        highest = float(np.abs(right[:, column]).max(initial=0.0))
        if highest == 0.0:
            continue
        path = lasso_path(gram, right[:, column], highest * np.geomspace(1.0, _LEAST, _PENALTIES))
        candidates = {tuple(np.flatnonzero(row).tolist()) for row in path}
        best = min(candidates, key=lambda keep: _bic(gram, right[:, column], equations, column, list(keep)))
        _fill(coefficients, support, gram, right, column, _needed(gram, right[:, column], equations, column, best))
    return coefficients / size[:, None], support


def best_subset(equations: NormalEquations, most: int = 12) -> tuple[FloatArray, BoolArray]:
    """Return coefficients (p, m) and support of the subset of least extended BIC, of up to ``most`` terms.

    Of every size all subsets are tried while there are at most 5000; beyond that the best of the size before gets the
    term that helps most, and terms are exchanged one by one until no exchange helps (Miller 2002, *Subset Selection in
    Regression*, sec. 3.4), which finds the best subset in most cases but not by proof.

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(6, 200))
    >>> one = NormalEquations.of([(phi, phi[1:2] - 3.0 * phi[4:5])], 6, 1)
    >>> best_subset(one)[0].ravel().round(9).tolist()
    [0.0, 1.0, 0.0, 0.0, -3.0, 0.0]
    """
    gram, right, size = scaled_equations(equations)
    p, m = right.shape
    alive = np.flatnonzero(np.diag(equations.gram) > 0).tolist()
    coefficients, support = np.zeros((p, m)), np.zeros((p, m), dtype=bool)
    for column in range(m):
        target = right[:, column]
        keep: list[int] = []
        best, best_keep = _bic(gram, target, equations, column, []), keep
        for count in range(1, min(most, len(alive)) + 1):
            if comb(len(alive), count) <= _EXHAUSTIVE:
                keep = _best_of_all(gram, target, alive, count)
            else:
                keep = _exchanged(gram, target, alive, keep)
            value = _bic(gram, target, equations, column, keep)
            if value < best:
                best, best_keep = value, keep
            if _explained(gram, target, keep) >= (1 - 1e-14) * equations.square[column]:
                break
        _fill(coefficients, support, gram, right, column, sorted(best_keep))
    return coefficients / size[:, None], support


@dataclass(frozen=True, eq=False)
class ResampledTerms:
    """What a rule chooses from resampled data: inclusion (p, m) is the share of samples in which a term was chosen."""

    coefficients: FloatArray
    support: BoolArray
    inclusion: FloatArray
    spread: FloatArray


def ensemble(pieces: Sequence[NormalEquations], rule: Rule, count: int, rng: np.random.Generator) -> ResampledTerms:
    """Return the terms that a rule chooses in most bootstrap samples, fitted anew on all data.

    Whole pieces of the records are drawn with replacement, as samples near each other in time are not independent
    (Fasel, Kutz, Brunton & Brunton 2022, Proc. R. Soc. A 478:20210904; Kunsch 1989). Only the sums of every piece are
    kept: memory does not grow with the records.

    Parameters
    ----------
    pieces : sequence of NormalEquations
        Of stretches of the records.
    rule : callable
        ``rule(equations) -> coefficients, support``.
    count : int
        Number of samples.
    rng : numpy.random.Generator

    Returns
    -------
    Ensemble
        ``spread`` (p, m): standard deviation of each coefficient over the samples, 0 counted where it was left out.
    """
    found = []
    for _ in range(count):
        weights = np.bincount(rng.integers(len(pieces), size=len(pieces)), minlength=len(pieces))
        found.append(rule(NormalEquations.sum(pieces, weights)))
    inclusion = np.mean([support for _, support in found], axis=0)
    spread = np.std([coefficients for coefficients, _ in found], axis=0)
    whole = NormalEquations.sum(pieces, np.ones(len(pieces), dtype=int))
    gram, right, size = scaled_equations(whole)
    coefficients, support = np.zeros_like(right), np.zeros(right.shape, dtype=bool)
    for column in range(right.shape[1]):
        _fill(coefficients, support, gram, right, column, np.flatnonzero(inclusion[:, column] >= 0.5).tolist())
    return ResampledTerms(coefficients / size[:, None], support, inclusion, spread)


def _needed(
    gram: FloatArray, target: FloatArray, equations: NormalEquations, column: int, keep: Sequence[int]
) -> list[int]:
    """Return terms without those whose loss lowers the BIC: once fitted anew, the path's own may be rounding."""
    kept, value = list(keep), _bic(gram, target, equations, column, list(keep))
    while kept:
        fewer = [[i for i in kept if i != j] for j in kept]
        values = [_bic(gram, target, equations, column, some) for some in fewer]
        if min(values) > value:
            break
        kept, value = fewer[int(np.argmin(values))], min(values)
    return kept


def _explained(gram: FloatArray, target: FloatArray, keep: list[int]) -> float:
    """Return the part of the target's square that some terms explain."""
    if not keep:
        return 0.0
    return float(target[keep] @ solved(gram[np.ix_(keep, keep)], target[keep]))


def _best_of_all(gram: FloatArray, target: FloatArray, alive: list[int], count: int) -> list[int]:
    """Return the terms that explain most, of all subsets of one size."""
    picks = np.array(list(combinations(alive, count)))
    inner = gram[picks[:, :, None], picks[:, None, :]] + 1e-13 * np.eye(count)
    wanted = target[picks]
    explained = np.sum(wanted * np.linalg.solve(inner, wanted[:, :, None])[:, :, 0], axis=1)
    return [int(j) for j in picks[int(np.argmax(explained))]]


def _bic(gram: FloatArray, target: FloatArray, equations: NormalEquations, column: int, keep: list[int]) -> float:
    """Return the extended BIC ``N ln lost + k ln N + 2 ln C(p, k)``; what is lost is never below rounding.

    Chen & Chen 2008 (Biometrika 95:759): the last part counts how many subsets of k terms there were to choose from.
    """
    square = float(equations.square[column])
    lost = max(square - _explained(gram, target, keep), 1e-13 * square)
    choices = 2.0 * log(comb(target.size, len(keep)))
    return equations.rows * log(max(lost, 1e-300)) + len(keep) * log(equations.rows) + choices


def _exchanged(gram: FloatArray, target: FloatArray, alive: list[int], keep: list[int]) -> list[int]:
    """Return one term more, then the best after exchanges of one for one."""
    keep = [*keep, _helpful(gram, target, alive, keep)]
    best = _explained(gram, target, keep)
    for _ in range(20):
        improved = False
        for place in range(len(keep)):
            others = keep[:place] + keep[place + 1 :]
            trial = [*others, _helpful(gram, target, alive, others)]
            value = _explained(gram, target, trial)
            if value > best * (1 + 1e-12):
                keep, best, improved = trial, value, True
        if not improved:
            break
    return keep


def _helpful(gram: FloatArray, target: FloatArray, alive: list[int], keep: list[int]) -> int:
    """Return the term that explains most of what others leave."""
    free = [j for j in alive if j not in keep]
    if not keep:
        return max(free, key=lambda j: float(target[j] ** 2 / gram[j, j]))
    inner, cross = gram[np.ix_(keep, keep)], gram[np.ix_(keep, free)]
    both = np.linalg.lstsq(inner, np.column_stack([cross, target[keep]]), rcond=1e-12)[0]
    residual = target[free] - cross.T @ both[:, -1]
    left = gram[free, free] - np.einsum("ij,ij->j", cross, both[:, :-1])
    gain = np.where(left > 1e-10, residual**2 / np.maximum(left, 1e-10), 0.0)
    return free[int(np.argmax(gain))]


def _fill(
    coefficients: FloatArray, support: BoolArray, gram: FloatArray, right: FloatArray, column: int, keep: list[int]
) -> None:
    """Set one column of the answer."""
    if keep:
        coefficients[keep, column] = solved(gram[np.ix_(keep, keep)], right[keep, column])
        support[keep, column] = True
