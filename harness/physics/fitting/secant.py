"""What Fisher's matrix leaves out of the curvature of a likelihood, learned from gradients along the steps taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

_LEAST_KEPT = 0.1
"""Of Fisher's curvature along a direction, the least that is kept: what was learned elsewhere makes no step endless."""


@dataclass(frozen=True, eq=False)
class Here:
    """A place: entries (n,), the value, its gradient (n,), Fisher's matrix (n, n), and the derivatives behind them."""

    z: FloatArray
    value: float
    gradient: FloatArray
    matrix: FloatArray
    derivatives: tuple[FloatArray, FloatArray]


class Secant:
    """The second derivatives of innovations, weighted by these, as NL2SOL has them.

    Along a narrow valley that bends, Fisher's matrix promises what no long step keeps: a search creeps. The gradients
    at both ends of a step tell what is missing, without a pass more (Dennis, Gay & Welsch 1981, ACM Trans. Math. Softw.
    7:348, sec. 3: the update of least change, sized first). It counts while it foretold the last step better than
    Fisher's matrix alone. Gradients have to be whole: those of a filter leave out what parameters do to variances.
    """

    def __init__(self, count: int) -> None:
        self._more = np.zeros((count, count))
        self._last: Here | None = None
        self._better = False

    def learn(self, here: Here, gradient_by: Callable[[tuple[FloatArray, FloatArray]], FloatArray]) -> None:
        """Learn of the step that led here; ``gradient_by`` tells the gradient here by the derivatives of there."""
        last, self._last = self._last, here
        if last is None or not np.isfinite(here.matrix).all():
            return
        step = here.z - last.z
        change = here.gradient - last.gradient
        along = float(change @ step)
        if not along > 1e-12 * float(np.linalg.norm(change) * np.linalg.norm(step)):
            return
        gain = last.value - here.value
        fisher = -float(last.gradient @ step + 0.5 * step @ last.matrix @ step)
        held = self._more @ step
        known = float(step @ held)
        self._better = abs(fisher - 0.5 * known - gain) < abs(fisher - gain)
        wanted = here.gradient - gradient_by(last.derivatives)
        if known != 0.0:
            sized = min(abs(float(step @ wanted) / known), 1.0)
            self._more, held = sized * self._more, sized * held
        missing = wanted - held
        self._more = self._more + (np.outer(missing, change) + np.outer(change, missing)) / along
        self._more -= float(missing @ step) / along**2 * np.outer(change, change)

    def added_to(self, fisher: FloatArray) -> FloatArray:
        """Return the matrix (n, n) with what was learned, positive along every direction, where that counts."""
        if not self._better:
            return fisher
        size = np.sqrt(np.maximum(np.diag(fisher), 1e-12))
        scaled = fisher / np.outer(size, size)
        values, vectors = np.linalg.eigh(scaled + self._more / np.outer(size, size))
        plain = np.maximum(np.einsum("ij,ij->j", vectors, scaled @ vectors), 0.0)
        values = np.where(values > 0, np.maximum(values, _LEAST_KEPT * plain), np.maximum(-values, plain))
        return np.asarray((vectors * values) @ vectors.T * np.outer(size, size))
