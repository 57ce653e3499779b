"""Readings that the rows about them contradict: spikes, words for "nothing", glitches of a logged input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter
from scipy.stats import chi2, norm

from harness.data.oddities.foretold import Foretold, foretold
from harness.data.oddities.numbers import ODD
from harness.signals import FloatArray

_PASSES = 20  # Rounds of the search, each on what the last one left.
_LEVER = 3.0
"""Distance from the middle, over the range of nine tenths of the readings, from which one bends no prediction."""
_FAR = 1e6  # Squared error over its variance beyond which it is no matter how far.
_USUAL = 1e-3  # Chance that errors as usual are taken for an answer to a glitch: it then stays as it was logged.
_BESIDE = 1e-3  # Spike over a larger one beside it below which it is what the estimate of that one leaves.
_LOOKED_AT, _WRITTEN = 500, 12  # Readings whose digits are counted, and digits beyond which nobody wrote them.
_MOSTLY = 0.9  # Rows of one word after which the outputs go on as usual, from which on none was felt.


@dataclass(frozen=True, eq=False)
class Spikes:
    """Odd readings of one signal."""

    rows: npt.NDArray[np.intp]  # array of int
    mended: FloatArray  # (N,): The signal with what the neighbours foretell in these rows


def spikes_of(y: FloatArray, u: FloatArray) -> Spikes:
    """Return the readings of a signal that the rows before and after them contradict.

    A wrong reading leaves its own pattern in the errors of a prediction: its size in its row, and what it spoils in the
    predictions of the next ones. A kick of the plant leaves one error, and the motion goes on from there. Readings
    count as odd if their pattern explains nearly all of the errors about them, and far better than as many kicks do
    (additive and innovational outliers: Fox 1972, J. R. Stat. Soc. B 34:350; Chen & Liu 1993).

    - ``y`` (N,)
    - ``u`` (N, nu): what may move it; nu may be 0

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y = np.sin(0.1 * np.arange(400.0)) + 0.01 * rng.standard_normal(400)
    >>> y[200] += 0.5
    >>> found = spikes_of(y, np.zeros((400, 0)))
    >>> found.rows.tolist(), bool(abs(found.mended[200] - np.sin(20.0)) < 0.03)
    ([200], True)
    """
    mended, odd = y.copy(), np.zeros(len(y), dtype=bool)
    nothing = Spikes(np.zeros(0, dtype=np.intp), y)
    if len(y) < ODD.fewest or np.mean(np.diff(y) != 0.0) < 0.5:
        return nothing
    bound = ODD.heavy * float(norm.isf(0.5 * ODD.rate / len(y)))
    smallest = np.maximum(ODD.smallest * float(np.subtract(*np.percentile(y, [90, 10]))), 2.0 * last_digits(y))
    refused = np.zeros(len(y), dtype=bool)
    for _ in range(_PASSES):
        found = foretold(mended, u, odd | _gross(mended, u))
        size, sure = _sizes(found)
        sure = np.where((np.abs(size) >= smallest) & ~refused, sure, 0.0)
        n, fresh = len(found.own), False
        while (top := int(np.argmax(sure))) >= 0 and sure[top] > bound:
            near = slice(max(top - n, 0), top + n + 1)
            rows, change = _together(found, top)
            if rows.size:
                mended[rows] -= change
                odd[rows] = True
                fresh = True
                refused[max(top - 4 * n, 0) : top + 4 * n] = False  # beside others they may be told apart now
            else:
                refused[near] = True
            sure[near] = 0.0
        if odd.mean() > ODD.most:
            return nothing
        if not fresh:
            break
    for _ in range(3):  # once more with what the rest foretells, neighbours together
        found = foretold(mended, u, odd)
        change = _again(found, y, mended, odd)
        sure = np.abs(change) * np.linalg.norm(found.pattern) / found.scale
        around = maximum_filter1d(np.abs(change), 2 * len(found.own) + 1)
        odd = (sure > bound) & (np.abs(change) >= np.maximum(smallest, _BESIDE * around))
        mended = np.where(odd, y - change, y)
    crowd = np.convolve(odd, np.ones(len(found.own) + 1), mode="same") > ODD.together
    odd &= ~maximum_filter1d(crowd, 2 * len(found.own) + 1)  # so many beside each other are a stretch
    return Spikes(np.flatnonzero(odd), np.where(odd, mended, y))


def last_digits(y: FloatArray) -> FloatArray:
    """Return what the last digit of each reading counts (N,); 0 where readings have as many digits as numbers hold.

    An instrument that writes three digits rounds 0.998 to 0.001 and 1.02 to 0.01.

    Examples
    --------
    >>> last_digits(np.array([0.998, 1.02, -12.4])).round(3).tolist(), last_digits(np.array([1 / 3, 2.0])).tolist()
    ([0.001, 0.01, 0.1], [0.0, 0.0])
    """
    shown = y[:: max(len(y) // _LOOKED_AT, 1)]
    most = max(len(f"{abs(one):.14e}".partition("e")[0].replace(".", "").rstrip("0")) for one in shown.tolist())
    if most > _WRITTEN:
        return np.zeros(len(y))
    return np.asarray(10.0 ** (np.floor(np.log10(np.maximum(np.abs(y), 1e-300))) - most + 1))


def _gross(y: FloatArray, u: FloatArray) -> npt.NDArray[np.bool_]:
    """Return the readings that are so far off that they would decide the prediction of the next ones.

    What follows an input that is as far off is an answer to it.
    """

    def far(values: FloatArray) -> npt.NDArray[np.bool_]:
        low, middle, high = np.percentile(values, [5, 50, 95])
        found = np.abs(values - middle) > _LEVER * (high - low)
        return found if found.mean() <= ODD.most else np.zeros(len(values), dtype=bool)

    found = far(y)
    for column in u.T:
        pushed = lfilter(np.ones(2 * ODD.order + 1), [1.0], far(column).astype(float)) > 0.5
        found &= ~pushed
    return found


def _again(found: Foretold, y: FloatArray, mended: FloatArray, odd: npt.NDArray[np.bool_]) -> FloatArray:
    """Return how wrong the odd readings are (N,), those near each other estimated together."""
    n, pattern = len(found.own), found.pattern
    error = found.error + lfilter(pattern, [1.0], y - mended)
    rows = np.flatnonzero(odd)
    change = np.zeros(len(y))
    for group in np.split(rows, np.flatnonzero(np.diff(rows) > n) + 1):
        if group.size:
            first, last = group[0], min(group[-1] + n + 1, len(y))
            columns = _columns(pattern, group, first, last)
            change[group] = np.linalg.lstsq(columns, error[first:last], rcond=None)[0]
    return change


def _sizes(found: Foretold) -> tuple[FloatArray, FloatArray]:
    """Return for every row how wrong its reading would be, and over its standard error."""
    pattern = found.pattern
    weight = float(pattern @ pattern)
    size = lfilter(pattern, [1.0], found.error[::-1])[::-1] / weight
    size[: len(found.own)] = 0.0  # of these rows nothing was foretold
    size[len(size) - 1 :] = 0.0  # nothing follows the last one: a kick is as likely
    return size, np.abs(size) * np.sqrt(weight) / found.scale


def _together(found: Foretold, top: int) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the odd rows about a place and how wrong they are; none if kicks explain the errors as well."""
    n, count = len(found.own), len(found.error)
    first, last = max(top - n, n), min(top + 2 * n + 1, count)
    window = found.error[first:last] / found.scale[top]
    candidates = np.arange(max(top - 2 * n, n), last)
    columns = _columns(found.pattern, candidates, first, last)
    chosen: list[int] = []
    left, values = window, np.zeros(0)
    sizes = np.linalg.norm(columns, axis=0)
    while len(chosen) < ODD.together:
        gain = np.abs(columns.T @ left) / sizes
        gain[chosen] = 0.0
        chosen.append(int(np.argmax(gain)))
        values = np.linalg.lstsq(columns[:, chosen], window, rcond=None)[0]
        left = window - columns[:, chosen] @ values
        noise = float(len(window))
        remains = max(float(left @ left) - noise, 0.0)
        kicks = np.sort(window**2)[: len(window) - len(chosen)].sum()
        whole = float(window @ window)
        if remains <= ODD.unexplained * max(whole - noise, 0.0) and float(left @ left) <= ODD.rival * float(kicks):
            rows = candidates[chosen]
            return rows, np.asarray(values * found.scale[top])
    return np.zeros(0, dtype=np.intp), np.zeros(0)


def _columns(pattern: FloatArray, rows: npt.NDArray[np.intp], first: int, last: int) -> FloatArray:
    """Return what a wrong reading in each of some rows leaves in the errors from one row to another."""
    places = np.arange(first, last)[:, None] - rows
    inside = (places >= 0) & (places < len(pattern))
    return np.asarray(np.where(inside, pattern[np.clip(places, 0, len(pattern) - 1)], 0.0))


def alike(y: FloatArray, rows: npt.NDArray[np.intp]) -> list[tuple[float | None, npt.NDArray[np.intp]]]:
    """Return odd rows in groups: those that read the same value, and the rest with None.

    A sensor with coarse steps reads the same value twice by chance, and reads it in ordinary rows as well: what odd
    rows share is a group of its own only where it is too rare elsewhere for that.

    Examples
    --------
    >>> y = np.array([0.1, 9999.0, 0.2, 9999.0, 7.0])
    >>> [(value, list(map(int, rows))) for value, rows in alike(y, np.array([1, 3, 4]))]
    [(9999.0, [1, 3]), (None, [4])]
    """
    from scipy.stats import binom

    values, counts = np.unique(y[rows], return_counts=True)
    ordinary, often = np.unique(np.delete(y, rows), return_counts=True)
    places = np.minimum(np.searchsorted(ordinary, values), max(ordinary.size - 1, 0))
    known = np.where(ordinary[places] == values, often[places], 0) if ordinary.size else np.zeros(values.size)
    by_chance = ordinary.size * binom.sf(counts - 1, rows.size, known / max(y.size - rows.size, 1))
    words = [
        float(value)
        for value, count, chance in zip(values, counts, np.atleast_1d(by_chance), strict=True)
        if (count > 1 and chance < ODD.by_chance) or is_word(float(value))
    ]
    groups: list[tuple[float | None, npt.NDArray[np.intp]]] = [(word, rows[y[rows] == word]) for word in words]
    rest = rows[~np.isin(y[rows], words)]
    return [*groups, (None, rest)] if rest.size else groups


def is_word(value: float) -> bool:
    """Return True for values that stand for "nothing": 0, -1, and rows of nines."""
    text = f"{abs(value):g}"
    return value in (0.0, -1.0) or (len(text) >= 3 and set(text) <= {"9", "."})


def unfelt(
    outputs: FloatArray, u: FloatArray, column: int, spikes: Spikes
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the odd rows of an input that no output felt, and those that the record does not decide.

    Outputs are foretold twice, with the input as it was logged and as its neighbours foretell it. A glitch of the log
    is one that the outputs would have to show and do not: without it they are as well foretold as elsewhere.

    - ``outputs`` (N, ny)
    - ``u`` (N, nu)
    - ``column``: of the input
    - ``spikes``: its odd readings
    """
    gained, strange = np.zeros(len(u)), np.zeros(len(u))
    mended, told = u.copy(), 0
    mended[:, column] = spikes.mended
    odd = np.zeros(len(u), dtype=bool)
    odd[spikes.rows] = True
    for y in outputs.T:
        if np.mean(np.diff(y) != 0.0) < 0.5:
            continue
        found = foretold(y, mended, odd, smooth=True)
        logged = found.error - found.answer(u - mended)
        usual = np.minimum((found.error / found.scale) ** 2, _FAR)
        gained += 0.5 * (np.minimum((logged / found.scale) ** 2, _FAR) - usual)
        strange += usual
        told += 1
    width = ODD.order + 1
    after = np.array([gained[row : row + width].sum() for row in spikes.rows])
    usual_most = ODD.heavy * float(chi2.isf(_USUAL, width * max(told, 1)))
    as_usual = np.array([strange[row : row + width].sum() <= usual_most for row in spikes.rows], dtype=bool)
    after = np.where(as_usual, after, -np.inf)
    clear = after > ODD.felt
    groups = alike(u[:, column], spikes.rows)
    for value, rows in groups:  # rows of one word are one matter
        member = np.isin(spikes.rows, rows)
        if value is not None and after[member & as_usual].sum() > ODD.felt and as_usual[member].mean() > _MOSTLY:
            clear |= member
    return spikes.rows[clear], spikes.rows[~clear & (np.abs(after) <= ODD.felt)]
