"""What a signal's own past foretells of it, and the signal without that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

PAST = 8  # Samples of its own past that foretell what no input explains, which may wander.


def own_past(signals: Sequence[FloatArray], rows: Sequence[npt.NDArray[np.bool_]] | None = None) -> FloatArray:
    """Return the coefficients (PAST,) with which signals of one size foretell themselves, the same for all of them.

    - ``signals`` sequence of array (N_i,)
    - ``rows``: in which of them that is asked, each behind as many; all of those by default

    Examples
    --------
    >>> y = np.cos(0.3 * np.arange(200))
    >>> bool(np.abs(without_past(y[:, None], own_past([y]))[PAST:]).max() < 1e-6)
    True
    """
    where = [np.arange(PAST, len(one)) for one in signals] if rows is None else [np.flatnonzero(one) for one in rows]
    x = np.concatenate(
        [np.column_stack([one[k - j] for j in range(1, PAST + 1)]) for one, k in zip(signals, where, strict=True)]
    )
    target = np.concatenate([one[k] for one, k in zip(signals, where, strict=True)])
    size = float(np.abs(x).max(initial=0.0)) or 1.0
    return np.asarray(np.linalg.lstsq(x / size, target / size, rcond=1e-6)[0], dtype=np.float64)


def without_past(values: FloatArray, own: FloatArray) -> FloatArray:
    """Return signals (N, n) without what coefficients foretell; the first samples are not."""
    found = values.copy()
    for j, weight in enumerate(own, start=1):
        found[j:] -= weight * values[:-j]
    return found
