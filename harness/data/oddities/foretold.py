"""What the rows before foretell of a reading: a linear prediction that a few odd readings do not bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter
from scipy.signal import lfilter

from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

_GAUSS = 1.4826  # Standard deviation over the median of the sizes, of Gaussian errors.
_PASSES = 3  # Fits, each without the rows that the one before took for odd.
_ROWS = 6000  # Rows that a prediction is fitted to, spread evenly: it has some 20 numbers.
_BEYOND = 4.0  # Errors over their scale that bend no fit.
_ROUNDING = 1e-9  # Scale of the errors over the spread of the signal, at least: below it everything is rounding.


@dataclass(frozen=True, eq=False)
class Foretold:
    """A prediction ``y[k] = sum a_i y[k-i] + sum b_j u[k-j] + c`` and what it misses."""

    own: FloatArray  # (n,): a, of the 1st to n-th reading before
    other: FloatArray  # (n + 1, nu): b, of this row's inputs to those n rows before
    error: FloatArray  # (N,): What it misses; 0 in the first n rows
    scale: FloatArray  # (N,): Standard deviation of that about each row, from medians: odd readings hardly move it

    @property
    def pattern(self) -> FloatArray:
        """What a reading that is 1 too large leaves in the errors of this row and the next ones (n + 1,)."""
        return np.concatenate([[1.0], -self.own])

    def answer(self, change: FloatArray) -> FloatArray:
        """Return the change (N,) of the prediction by a change of the inputs (N, nu)."""
        return np.asarray(sum(lfilter(self.other[:, k], [1.0], change[:, k]) for k in range(change.shape[1])))


def foretold(
    y: FloatArray, u: FloatArray, odd: npt.NDArray[np.bool_] | None = None, *, smooth: bool = False
) -> Foretold:
    """Return the prediction of a signal from its past and from inputs, odd rows left out.

    - ``y`` (N,)
    - ``u`` (N, nu): nu may be 0
    - ``odd`` array of bool (N,): rows that say nothing, of the signal or of an input
    - ``smooth``: True for inputs that are smooth over these rows: they tell what all lags do together, and no more is
      asked

    Examples
    --------
    >>> found = foretold(np.sin(0.1 * np.arange(400.0)), np.zeros((400, 0)))
    >>> bool(np.abs(found.error).max() < 1e-8)
    True
    """
    n = min(ODD.order, max(len(y) // 40, 1))
    sound = np.ones(len(y), dtype=bool) if odd is None or odd.all() else ~odd
    size = float(np.std(y[sound])) or 1.0
    mean = float(np.mean(y[sound]))
    scaled = (y - mean) / size
    spread = np.std(u, axis=0)
    inputs = (u - u.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    columns = [scaled[n - i : len(y) - i] for i in range(1, n + 1)]
    lags = np.linspace(-1.0, 1.0, n + 1)
    basis = np.column_stack([np.ones(n + 1), lags]) if smooth else np.eye(n + 1)
    for k in range(u.shape[1]):
        late = np.column_stack([inputs[n - j : len(y) - j, k] for j in range(n + 1)])
        columns += list((late @ basis).T)
    matrix = np.column_stack([*columns, np.ones(len(y) - n)])
    goal = scaled[n:]
    good = np.ones(len(goal), dtype=bool)
    if odd is not None:
        touched = lfilter(np.ones(n + 1), [1.0], odd.astype(float)) > 0.5
        good = ~touched[n:]
    if good.sum() < 2 * matrix.shape[1]:
        good[:] = True
    used = good
    for _ in range(_PASSES):
        rows = np.flatnonzero(used)[:: -(-int(used.sum()) // _ROWS)]
        values = np.linalg.lstsq(matrix[rows], goal[rows], rcond=1e-11)[0]
        error = goal - matrix @ values
        width = _GAUSS * float(np.median(np.abs(error[good])))
        kept = good & (np.abs(error) <= _BEYOND * max(width, _ROUNDING))
        if kept.sum() < 0.5 * good.sum() or np.array_equal(kept, used):
            break
        used = kept
    whole = np.concatenate([np.zeros(n), error])
    local = _GAUSS * median_filter(np.abs(whole), size=min(ODD.local, len(whole)), mode="nearest")
    scale = np.maximum(local, max(width, _ROUNDING))
    other = basis @ values[n:-1].reshape(u.shape[1], basis.shape[1]).T / np.where(spread > 0, spread, 1.0)
    parts = (values[:n], other * size, whole * size, scale * size)
    return Foretold(*(np.asarray(part, dtype=float) for part in parts))
