"""How far the data of a learned function reach, and how fast its error grows beyond them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray
from identifiers.common.described import Described

_CENTRES = 200  # Rows that stand for the data, each as far as can be from those before it: the edge is among the first.
_ROWS = 4000  # Most rows that are looked at: evenly thinned.
_INSIDE = 0.99  # Share of the data that counts as inside, so that bands there stay what held-out data made them.
_FOLDS = 10  # Stretches in time, every second of which makes a half: rows that follow each other are alike.

_DOUBLE = 0.5
"""Of the radius of the data: the rehearsal learns within it and predicts up to the whole, so it doubles the reach."""

_LEAST = 0.2
"""Share of the rows that the rehearsal learns from at least: in many dimensions few lie within half the radius."""

_EDGE = 0.95  # Share of the rows within the radius.

_FEATURES, _RIDGE = 60, 1e-4
"""Random tanh features of the rehearsal, and their ridge for each row: a network whose first layer is not trained."""

_AFFINE_RIDGE = 1e-9  # Of its affine part: what is affine is extrapolated exactly.


@dataclass(frozen=True, eq=False)
class Reach(Described):
    """Where the rows of a learned function lie, and the standard deviation of its error for each unit beyond.

    Held-out data say nothing about what happens outside. So it is rehearsed: a network with a random first layer learns
    from the inner half of the data and predicts the rest; how its error grows with the distance is taken for how the
    learned function's error will grow beyond all data, which is as far again. Nothing guarantees it: a plant may do
    something outside (a stop, a wall) of which the data show no sign.
    """

    centres: FloatArray  # (m, p): Rows that stand for the data, scaled to sizes about 1
    inside: float  # Distance to the nearest centre up to which a row counts as inside
    growth: FloatArray
    """(ny,): Standard deviation of the error for each unit of distance beyond ``inside``, in the units of the
    targets."""

    @classmethod
    def of(cls, rows: FloatArray, targets: FloatArray, *, rng: np.random.Generator) -> Reach:
        """Return the reach of scaled rows (n, p) with targets (n, ny).

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> rows = rng.normal(size=(500, 1))
        >>> reach = Reach.of(rows, rows**3, rng=rng)
        >>> within, beyond = reach.std(np.array([[0.5], [6.0]]))[:, 0]
        >>> float(within), bool(beyond > 10)
        (0.0, True)
        """
        keep = slice(None, None, max(1, len(rows) // _ROWS))
        rows, targets = rows[keep], targets[keep]
        radius = np.sqrt(np.sum((rows - rows.mean(axis=0)) ** 2, axis=1))
        limit = max(_DOUBLE * float(np.quantile(radius, _EDGE)), float(np.quantile(radius, _LEAST)))
        inner: npt.NDArray[np.bool_] = np.asarray(radius <= limit)
        growth = np.zeros(targets.shape[1])
        if 2 < inner.sum() < len(rows):
            errors, floor = _rehearsed(rows, targets, inner, rng)
            part = cls._without_growth(rows[inner], growth)
            far = part.beyond(rows[~inner])
            if far.any():
                growth = np.sqrt(np.sum(np.maximum(errors**2 - floor, 0.0), axis=0) / np.sum(far**2))
        whole = cls._without_growth(rows, growth)
        return cls(whole.centres, whole.inside, growth)

    @classmethod
    def _without_growth(cls, rows: FloatArray, growth: FloatArray) -> Reach:
        """Return centres and distance of rows."""
        from scipy.spatial import cKDTree

        # Rows that are centres themselves lie at distance 0: how far new ones lie, halves tell of each other.
        fold = np.arange(len(rows)) * _FOLDS // len(rows) % 2 == 0
        halves = [
            cKDTree(spread_out(rows[part], _CENTRES)).query(rows[~part])[0] for part in (fold, ~fold) if part.any()
        ]
        return cls(spread_out(rows, _CENTRES), float(np.quantile(np.concatenate(halves), _INSIDE)), growth)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.centres)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name in self.__dataclass_fields__}

    def beyond(self, rows: FloatArray) -> FloatArray:
        """Return the distances (...) of scaled rows (..., p) beyond the data; 0 inside, NaN where a row has a NaN."""
        rows = np.asarray(rows, dtype=float)
        known: npt.NDArray[np.bool_] = np.asarray(np.isfinite(rows).all(axis=-1))
        distance = self._tree.query(np.where(known[..., None], rows, 0.0))[0]
        return np.where(known, np.maximum(distance - self.inside, 0.0), np.nan)

    def std(self, rows: FloatArray) -> FloatArray:
        """Return the standard deviation (..., ny) that distance adds to the error at scaled rows (..., p)."""
        return np.asarray(self.beyond(rows)[..., None] * self.growth)


def spread_out(rows: FloatArray, count: int) -> FloatArray:
    """Return so many rows, each as far as can be from those before it (Gonzalez 1985, *Theor. Comput. Sci.* 38:293)."""
    chosen = [int(np.argmin(np.sum((rows - rows.mean(axis=0)) ** 2, axis=1)))]
    nearest = np.sum((rows - rows[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(count, len(rows)) and nearest.max() > 0:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.sum((rows - rows[chosen[-1]]) ** 2, axis=1))
    return np.asarray(rows[chosen])


def _rehearsed(
    rows: FloatArray, targets: FloatArray, inner: npt.NDArray[np.bool_], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (m, ny) at the outer rows of what the inner ones taught, and its mean square inside (ny,)."""
    centre, size = rows[inner].mean(axis=0), np.maximum(rows[inner].std(axis=0), 1e-9)
    scaled = (rows - centre) / size
    turn = rng.normal(size=(rows.shape[1], _FEATURES)) / np.sqrt(rows.shape[1])
    hidden = np.tanh(scaled @ turn + rng.normal(size=_FEATURES))
    design = np.hstack([hidden, scaled, np.ones((len(rows), 1))])
    known = design[inner]
    price = np.where(np.arange(design.shape[1]) < _FEATURES, _RIDGE, _AFFINE_RIDGE) * len(known)
    gram = known.T @ known + np.diag(price)
    missed = targets - design @ np.linalg.solve(gram, known.T @ targets[inner])
    return missed[~inner], np.mean(missed[inner] ** 2, axis=0)
