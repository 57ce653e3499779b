"""Algebraic loops: Newton's method on the signals of a cycle, with a Jacobian by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from harness.signals import FloatArray

PASSES = 50
NUDGE = 1e-7  # of a signal, relative; about the root of the rounding error


def newton(miss: Callable[[FloatArray], FloatArray], start: FloatArray, tolerance: float) -> FloatArray | None:
    """Return the values (n,) at which ``miss`` is zero, or None where they are not found.

    Parameters
    ----------
    miss : callable
        From values (n,) to how far they are from agreeing (n,).
    start : array (n,)
        Where to begin.
    tolerance : float
        Relative to one more than the size of each value.

    Examples
    --------
    >>> root = newton(lambda x: x**2 - 2.0, np.array([1.0]), 1e-12)
    >>> root is not None and float(root[0].round(9))
    1.414213562
    >>> newton(lambda x: x**2 + 1.0, np.array([1.0]), 1e-12) is None
    True
    """
    values, gap = start.copy(), miss(start)
    for _ in range(PASSES):
        scale = 1.0 + np.abs(values)
        if np.all(np.abs(gap) <= tolerance * scale):
            return values
        jacobian = np.empty((len(values), len(values)))
        for j in range(len(values)):
            nudged = values.copy()
            nudged[j] += NUDGE * scale[j]
            jacobian[:, j] = (miss(nudged) - gap) / (NUDGE * scale[j])
        values = values + np.linalg.lstsq(jacobian, -gap, rcond=None)[0]
        gap = miss(values)
    return None
