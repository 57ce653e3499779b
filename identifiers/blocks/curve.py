"""A static curve: a cubic spline over equidistant knots, straight beyond its ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from harness.signals import FloatArray

_DEGREE = 3


@dataclass(frozen=True)
class Knots:
    """Where a curve is bent: ``count`` cubic B-splines (de Boor 1978, ch. IX) from ``low`` to ``high``.

    Examples
    --------
    >>> knots = Knots(-1.0, 1.0, 6)
    >>> line = np.linalg.lstsq(knots.basis(np.linspace(-1, 1, 50)), np.linspace(-2, 2, 50))[0]
    >>> knots.values(line, np.array([-3.0, 0.5, 2.0])).round(6)
    array([-6.,  1.,  4.])
    """

    # Beyond them a curve goes on straight
    low: float
    high: float
    count: int  # Basis functions, at least 4

    @property
    def places(self) -> FloatArray:
        """The knots, those at the ends repeated."""
        inner = np.linspace(self.low, self.high, self.count - _DEGREE + 1)
        return np.concatenate([np.full(_DEGREE, self.low), inner, np.full(_DEGREE, self.high)])

    def basis(self, x: FloatArray) -> FloatArray:
        """Return the basis functions (N, count) at x (N,)."""
        inside = np.clip(x, self.low, self.high)
        values: FloatArray = BSpline.design_matrix(inside, self.places, _DEGREE).toarray()
        for end in (self.low, self.high):
            out = x < end if end == self.low else x > end
            if out.any():
                values[out] += (x[out] - end)[:, None] * self._slopes(end)
        return values

    def values(self, coefficients: FloatArray, x: FloatArray) -> FloatArray:
        """Return the curve at x, of any shape."""
        inside = np.clip(x, self.low, self.high)
        spline = BSpline(self.places, coefficients, _DEGREE)
        found: FloatArray = spline(inside) + (x - inside) * spline(inside, nu=1)
        return found

    def slopes(self, coefficients: FloatArray, x: FloatArray) -> FloatArray:
        """Return the slope of the curve at x."""
        found: FloatArray = BSpline(self.places, coefficients, _DEGREE)(np.clip(x, self.low, self.high), nu=1)
        return found

    def _slopes(self, end: float) -> FloatArray:
        """Return the slopes (count,) of the basis functions at one end."""
        found: FloatArray = BSpline(self.places, np.eye(self.count), _DEGREE)(end, nu=1)
        return found
