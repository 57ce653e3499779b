"""Stretches of a logged input that hold a word for "nothing" while the plant went on as if there were a command."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from harness.data.oddities.foretold import foretold
from harness.data.oddities.held import runs_of_equal
from harness.data.oddities.leaps import STRIDES
from harness.data.oddities.numbers import ODD
from harness.data.oddities.spikes import is_word, spikes_of
from harness.signals import FloatArray

Stretch = tuple[npt.NDArray[np.intp], FloatArray, bool]


def dropouts_of(outputs: FloatArray, u: FloatArray, column: int) -> list[Stretch]:
    """Return the rows of each drop-out of an input, what a line across it reads there, and whether the outputs tell.

    A stretch counts if its value is 0, -1 or nines, and the outputs went on as if the input had stayed where it was
    before and after: a prediction with a line across the stretch is far likelier than with what was logged. Where the
    outputs do not decide, it may be one if the input jumps into it and out of it as it does nowhere else.

    - ``outputs`` (N, ny)
    - ``u`` (N, nu)

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> u, y = np.repeat(rng.uniform(1.0, 2.0, 12), 50), np.zeros(600)
    >>> for k in range(599):
    ...     y[k + 1] = 0.9 * y[k] + u[k] + 1e-2 * rng.standard_normal()
    >>> logged = u.copy()
    >>> logged[210:230] = 0.0
    >>> [(int(rows[0]), len(rows), told) for rows, _, told in dropouts_of(y[:, None], logged[:, None], 0)]
    [(210, 20, True)]
    >>> dropouts_of(y[:, None], u[:, None], 0)
    []
    """
    values = u[:, column]
    starts, lengths = runs_of_equal(values)
    ends = starts + lengths
    word = np.array([is_word(float(value)) for value in values[starts]], dtype=bool)
    inside = (starts > 0) & (ends < len(values))
    asked = np.flatnonzero(word & inside & (lengths > ODD.order))
    if not asked.size or lengths[asked].sum() > ODD.most * len(values):
        return []
    mended, odd = u.copy(), np.zeros(len(values), dtype=bool)
    for k in asked:
        rows = np.arange(starts[k], ends[k])
        mended[rows, column] = np.interp(rows, [rows[0] - 1, ends[k]], values[[rows[0] - 1, ends[k]]])
        odd[rows] = True
    felt = [foretold(y, mended, odd, smooth=True) for y in outputs.T if np.mean(np.diff(y) != 0.0) >= 0.5]
    change = u - mended
    moves = np.abs(np.diff(values))
    elsewhere = moves[~(odd[1:] | odd[:-1])]
    largest = float(elsewhere.max(initial=0.0))
    lively = np.mean(elsewhere > 0.0) > 0.5
    found = []
    for k in asked:
        rows = np.arange(starts[k], ends[k])
        window = rows[ODD.order :]  # a smooth answer is right once all its lags lie in the stretch
        power = product = 0.0
        for one in felt:
            # what is not foretold of a plant is now small, now large: its mean square counts
            scale = np.maximum(one.scale[window], np.sqrt(np.mean(one.error[~odd] ** 2)))
            answer = one.answer(change)[window] / scale
            power += float(answer @ answer)
            product += float(answer @ (one.error[window] / scale))
        lost = 0.5 * power - product  # log-likelihood of a plant that felt nothing of the drop over one that felt all
        sudden = lively and min(moves[rows[0] - 1], moves[ends[k] - 1]) > STRIDES * largest
        if lost > ODD.felt or (sudden and lost > -ODD.felt):
            found.append((rows, mended[rows, column], lost > ODD.felt))
    return found


def without(u: FloatArray, rows: npt.NDArray[np.intp]) -> FloatArray:
    """Return an input (N,) with what its neighbours foretell in some rows, a line where these are a stretch.

    Examples
    --------
    >>> without(np.array([1.0, 1.0, 0.0, 0.0, 4.0]), np.array([2, 3])).tolist()
    [1.0, 1.0, 2.0, 3.0, 4.0]
    """
    mended, spikes = u.copy(), spikes_of(u, np.zeros((len(u), 0)))
    alone = np.intersect1d(rows, spikes.rows)
    mended[alone] = spikes.mended[alone]
    others, sound = np.setdiff1d(rows, alone), np.setdiff1d(np.arange(len(u)), rows)
    mended[others] = np.interp(others, sound, u[sound])
    return mended
