"""Regression trees and forests on past outputs and inputs: a baseline that assumes nothing, extrapolates nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.judgement import refuse_undetermined
from harness.options import check_options
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.lag_state import LagModel, Standardisation, regression_data
from identifiers.common.records import learnable

FEW = 64  # Rows up to which all trees are walked at once: below it the calls cost, beyond it the memory.


@dataclass(frozen=True, eq=False)
class Tree:
    """A binary tree in arrays: node 0 is the root."""

    feature: npt.NDArray[np.intp]  # array (n,) of int: Column that a node asks for; -1 in a leaf
    threshold: FloatArray  # (n,): A row goes left if its value is not greater
    # array (n,) of int
    left: npt.NDArray[np.intp]
    right: npt.NDArray[np.intp]
    value: FloatArray  # (n, ny): Mean of the samples of a node

    def __call__(self, rows: FloatArray, start: npt.NDArray[np.intp] | None = None) -> FloatArray:
        """Return the values (n, ny) of rows (n, p), from the root or from a node for each row."""
        node = np.zeros(len(rows), dtype=np.intp) if start is None else start
        number = np.arange(len(rows))
        while True:
            feature = self.feature[node]
            inner = feature >= 0
            if not inner.any():
                return np.asarray(self.value[node])
            right = rows[number, feature] > self.threshold[node]
            node = np.where(inner, np.where(right, self.right[node], self.left[node]), node)


def grow_tree(rows: FloatArray, targets: FloatArray, *, leaf: int, features: int, rng: np.random.Generator) -> Tree:
    """Return a regression tree (Breiman, Friedman, Olshen and Stone 1984, *CART*, sec. 8.4).

    - ``rows`` (n, p)
    - ``targets`` (n, ny): scaled, since their squares are added
    - ``leaf``: least number of samples in a leaf
    - ``features``: columns that each split chooses from, drawn anew each time

    Examples
    --------
    >>> x = np.linspace(0, 1, 100)[:, None]
    >>> tree = grow_tree(x, np.where(x > 0.5, 2.0, -1.0), leaf=5, features=1, rng=np.random.default_rng(0))
    >>> tree(np.array([[0.2], [0.9]])).ravel().tolist()
    [-1.0, 2.0]
    """
    nodes: list[list[Any]] = []
    stack: list[tuple[npt.NDArray[np.intp], int, bool]] = [(np.arange(len(rows)), -1, False)]
    while stack:
        index, parent, is_right = stack.pop()
        number = len(nodes)
        if parent >= 0:
            nodes[parent][3 if is_right else 2] = number
        y = targets[index]
        nodes.append([-1, 0.0, -1, -1, y.mean(axis=0)])
        if len(index) < 2 * leaf or np.ptp(y, axis=0).max() == 0.0:
            continue
        columns = rng.choice(rows.shape[1], size=min(features, rows.shape[1]), replace=False)
        found = _best_split(rows[index][:, columns], y, leaf)
        if found is None:
            continue
        column, threshold = int(columns[found[0]]), found[1]
        nodes[number][0], nodes[number][1] = column, threshold
        right = rows[index, column] > threshold
        stack += [(index[right], number, True), (index[~right], number, False)]
    feature, threshold_, left, right_, value = zip(*nodes, strict=True)
    return Tree(
        np.array(feature, dtype=np.intp),
        np.array(threshold_),
        np.array(left, dtype=np.intp),
        np.array(right_, dtype=np.intp),
        np.array(value),
    )


def _best_split(x: FloatArray, y: FloatArray, leaf: int) -> tuple[int, float] | None:
    """Return column and threshold that lower the sum of squares most; None if nothing does."""
    n = len(x)
    order = np.argsort(x, axis=0, kind="stable")
    ordered = np.take_along_axis(x, order, axis=0)
    sums = np.cumsum(y[order], axis=0)  # (n, columns, ny)
    left = np.arange(1, n)[:, None, None]
    gain = np.sum(sums[:-1] ** 2 / left + (sums[-1] - sums[:-1]) ** 2 / (n - left), axis=2)
    gain[ordered[1:] == ordered[:-1]] = -np.inf
    gain[: leaf - 1] = gain[n - leaf :] = -np.inf
    best = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if not gain[best] > np.sum(y.sum(axis=0) ** 2) / n + 1e-12 * np.sum(y**2):
        return None
    row, column = int(best[0]), int(best[1])
    low, high = ordered[row, column], ordered[row + 1, column]
    middle = 0.5 * (low + high)
    return column, float(middle if middle < high else low)


@dataclass(frozen=True, eq=False)
class ForestModel(LagModel):
    """The mean of trees.

    Parameters
    ----------
    trees : tuple of Tree
        Of scaled regressors and targets (the change of the output, if ``increments``).
    variance : array (ny,)
        Of the one-step error of samples that a tree did not see.
    increments : bool
        The trees predict ``y[k+1] - y[k]``.
    """

    trees: tuple[Tree, ...]
    variance: FloatArray
    increments: bool
    kind = "forest"

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        flat = self.scaling.rows(rows).reshape(-1, rows.shape[-1])
        flat = np.where(np.isfinite(flat), flat, 0.0)
        if len(flat) > FEW:
            values = np.array([tree(flat) for tree in self.trees])
        else:  # a free run asks row by row: one walk through all trees at once
            whole, roots = self._joined
            values = whole(np.tile(flat, (len(roots), 1)), np.repeat(roots, len(flat)))
            values = values.reshape(len(roots), len(flat), -1)
        mean = np.mean(values, axis=0).reshape(*rows.shape[:-1], -1)
        mean = mean * self.scaling.y_std + (rows[..., : self.spec.ny] if self.increments else self.scaling.y_mean)
        return mean, np.broadcast_to(self.variance, mean.shape)

    @cached_property
    def _joined(self) -> tuple[Tree, npt.NDArray[np.intp]]:
        """Return all trees as one table of nodes, and the number of each root."""
        roots = np.cumsum([0, *(len(tree.feature) for tree in self.trees[:-1])]).astype(np.intp)
        joined = {
            name: np.concatenate([getattr(tree, name) for tree in self.trees])
            for name in ("feature", "threshold", "left", "right", "value")
        }
        shift = np.repeat(roots, [len(tree.feature) for tree in self.trees])
        for name in ("left", "right"):  # what a leaf has there is never asked for
            joined[name] = joined[name] + shift
        return Tree(**joined), roots


@dataclass(frozen=True)
class RandomForest(Excited):
    """Random forest on lagged outputs and inputs (Breiman 2001, *Machine Learning* 45:5); one tree is CART.

    Parameters
    ----------
    order : int
        Past outputs and inputs.
    trees : int
        1 grows one tree on all samples and columns; more are grown on samples drawn with replacement.
    leaf : int
        Least number of samples in a leaf.
    increments : bool
        Predict the change of the output: what a tree rounds off is then small beside the output.
    """

    order: int = 2
    trees: int = 30
    leaf: int = 5
    increments: bool = True

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> ForestModel:
        """Return the model; its errors come from the samples that a tree did not see."""
        what = "random-forest"
        check_options(self, what, order=">= 1", trees=">= 1", leaf=">= 1")
        records, spec = learnable(trajectories, samples=self.order + 2, what=what, inputs=False)
        refuse_undetermined(records, what, self.least_excitation)
        rows, later = regression_data(records, self.order)
        if len(rows) < 2 * self.leaf:
            raise FitError(
                f"{what}: too few samples",
                expected=f"{2 * self.leaf}, two leaves",
                got=str(len(rows)),
                remedy="record longer, or lower leaf",
            )
        targets = later - rows[:, : spec.ny] if self.increments else later
        fitted = Standardisation.of(rows, targets)
        if self.increments:
            fitted = Standardisation(fitted.x_mean, fitted.x_std, np.zeros(spec.ny), fitted.y_std)
        x, y = fitted.rows(rows), fitted.targets(targets)
        grown, total, seen = [], np.zeros_like(y), np.zeros(len(y))
        # A third of the columns is Breiman's choice for regression (2001, sec. 11).
        features = x.shape[1] if self.trees == 1 else max(1, -(-x.shape[1] // 3))
        for _ in range(self.trees):
            index = np.arange(len(x)) if self.trees == 1 else rng.integers(len(x), size=len(x))
            tree = grow_tree(x[index], y[index], leaf=self.leaf, features=features, rng=rng)
            grown.append(tree)
            out = np.ones(len(x), dtype=bool)
            out[index] = self.trees == 1
            total[out] += tree(x[out])
            seen[out] += 1
        judged = seen > 0
        # Samples that every tree drew cannot be judged; where none is left the spread of the targets stands in.
        wrong = y[judged] - total[judged] / seen[judged, None] if judged.any() else y
        variance = (np.mean(wrong**2, axis=0) + 1e-18) * fitted.y_std**2
        notes = {"leaves": int(sum((tree.feature < 0).sum() for tree in grown)), "samples": len(x)}
        return ForestModel(spec, self.order, fitted, tuple(grown), variance, self.increments, notes=notes)
