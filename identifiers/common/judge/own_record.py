"""A model asked about the records that it was fitted to: a free run that leaves what their inputs do knows no plant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import orthonormal
from harness.errors import HarnessError
from harness.judgement import Feedback, moves
from harness.scoring import predict
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.loops import ANSWERED, COLOURED, percent
from identifiers.common.judge.own_past import PAST, own_past, without_past

Readings = npt.NDArray[np.bool_]  # Of a record, (N, ny).

RIGHT = 0.1
"""Error over what the inputs do, up to which a model is right: a fit of 90 % (1 - NRMSE). The test is whether a free
run errs by more, not whether it errs: of models that err by no more one in a thousand is warned of (``COLOURED``),
however long and clean the record."""
UNEXPLAINED = 0.7
"""What a free run leaves of an output over the output, from which on a model without an order says so: half of the
variance is none of the inputs', and such a model takes load or drift for states."""
WORTHLESS = 1.0  # The same of any model: beyond it the mean of the output foretells more.
NOTHING = 0.9
"""What a free run leaves of an output over the output, from which on it is asked whether the inputs move it at all: a
fifth of its variance, of inputs that do, shows in any record that is worth a fit."""
BY_CHANCE = 0.05  # Probability beyond which what inputs explain of an output tells nothing: the usual level of a test.
LAGS = 16  # Samples by which an input may reach an output in the test: twice as many.
EACH = 4  # Samples for each number of the test at least.
RUN_AWAY = 1e6
"""Times the largest output that an error of a free run is at most: beyond, squares overflow, and nothing is told."""
CHECKED, CHECKED_SLOWLY = 2_000, 500
"""Samples of a free run, and of a model that is not linear: some take half a millisecond for each."""


def doubt_of_own_record(
    model: Any, records: Sequence[Trajectory], feedback: Feedback, readings: Sequence[Readings]
) -> str | None:
    """Return what is wrong with a model whose free runs do not answer the inputs as its records do; empty if nothing.

    What a free run leaves of the outputs is load, noise and error of the model. Load and noise do not follow the inputs
    where these answer no outputs; so what inputs explain of it, its own past taken away (Cochrane & Orcutt 1949, J. Am.
    Stat. Assoc. 44:32), is error. That it is more than ``RIGHT`` of what inputs explain of the output is tested by the
    F of the regression, which is not central where the error is just that (Kendall & Stuart 1979, *Advanced Theory of
    Statistics* 2, sec. 24.32, with Patnaik's approximation, 1949, Biometrika 36:202). In a loop nothing is asked.

    - ``records``: that it was fitted to, what is no reading replaced by what its neighbours foretell
    - ``feedback``: of the records
    - ``readings`` sequence of array of bool (N, ny): which values of each record's outputs are readings: the others
      decide nothing
    - returns None where nothing could be asked
    """
    if feedback.found and feedback.share > ANSWERED:
        return None
    linear = getattr(model, "matrices", None) is not None
    kept, good, count = [], [], CHECKED if linear else CHECKED_SLOWLY
    first = int(model.burn_in) + LAGS + PAST
    if min(max(map(len, records)), count) <= 2 * first:  # of few samples only what a free run leaves is asked
        first = int(model.burn_in)
    for record, told in zip(records, readings, strict=True):
        if min(len(record), count) > 2 * first:
            kept.append(record[:count])
            good.append(told[:count])
            count -= len(record)
    try:
        with np.errstate(all="ignore"):
            left = [record.y - predict(model, record, None) for record in kept]
    except HarnessError:  # a model that runs freely over none of these records says so elsewhere
        return None
    if not left:
        return None
    most = RUN_AWAY * max(float(np.abs(record.y).max(initial=0.0)) for record in kept)
    if not all(np.isfinite(one).all() and np.abs(one).max(initial=0.0) <= most for one in (r[first:] for r in left)):
        return "a free run over the model's own estimation records diverges: do not simulate with it"
    doubts = [_doubt(kept, left, good, column, first, linear=linear) for column in range(records[0].spec.ny)]
    return next((doubt for doubt in doubts if doubt), "" if any(doubt is not None for doubt in doubts) else None)


def _doubt(
    records: Sequence[Trajectory],
    left: Sequence[FloatArray],
    readings: Sequence[Readings],
    column: int,
    first: int,
    *,
    linear: bool,
) -> str | None:
    """Return what is wrong with what free runs leave of an output; empty if nothing, None if nothing can be asked."""
    name, limit = records[0].spec.outputs[column].name, WORTHLESS if linear else UNEXPLAINED
    taken = [told[:, column] & (np.arange(len(told)) >= first) for told in readings]
    rest, whole = (
        np.concatenate([one[rows, column] for one, rows in zip(part, taken, strict=True)])
        for part in (left, [record.y for record in records])
    )
    if not len(rest):
        return None
    share = float(rest.std() / whole.std()) if whole.std() > 0 else 0.0
    if share > NOTHING and (chance := _idle(records, column, taken)) > BY_CHANCE:
        return (
            f"nothing shows that the inputs move {name}: chance alone correlates them as much (probability "
            f"{chance:.2g}), and a free run leaves {percent(share)} of it: move them more, or record what does"
        )
    if share > limit:
        return (
            f"a free run over the model's own estimation records errs by {percent(share)} of "
            f"{name}, most of whose motion does not come from the inputs: remove a drift, or use a linear model"
            if limit < WORTHLESS
            else f"a free run over the model's own estimation records errs by more than {name} moves "
            f"({percent(share)}): its mean predicts better; use another method, or a longer record"
        )
    answered = _answered(records, [one[:, column] - rest.mean() for one in left], column, first, taken)
    if answered is None:
        return None
    share, chance = answered
    if share <= RIGHT or chance >= COLOURED / len(records[0].spec.outputs):
        return ""
    return (
        f"a free run over the model's own estimation records leaves {percent(share)} of what the inputs "
        f"do to {name} (probability {chance:.1g} if it were {percent(RIGHT)}): remove a drift or an offset, "
        "or use a better structure or another method"
    )


def _answered(
    records: Sequence[Trajectory],
    left: Sequence[FloatArray],
    column: int,
    first: int,
    taken: Sequence[npt.NDArray[np.bool_]],
) -> tuple[float, float] | None:
    """Return what inputs explain of what is left over what they explain of an output, and the chance of so much.

    The chance is that of a model whose error is ``RIGHT``. None where the readings are too few to tell.
    """
    from scipy.stats import f

    whole = [_unbroken(rows) for rows in taken]
    if sum(int(rows.sum()) for rows in whole) < EACH * LAGS * records[0].spec.nu:
        return None
    left = [np.where(rows, one, 0.0) for one, rows in zip(left, taken, strict=True)]
    own = own_past(left, whole)
    at_once = int(not records[0].spec.feedthrough)
    regressors, wrong, seen = [], [], []
    for record, one, rows in zip(records, left, whole, strict=True):
        u = without_past(record.u, own)
        where = np.flatnonzero(rows)
        regressors.append(np.hstack([u[where - j] for j in range(at_once, LAGS + 1)]))
        wrong.append(without_past(one[:, None], own)[where])
        seen.append(without_past(record.y[:, column, None], own)[where])
    x, e, y = (np.concatenate(part) for part in (regressors, wrong, seen))
    x, e, y = (part - part.mean(axis=0) for part in (x, e, y))
    base = orthonormal(x, 1e-8)
    told, said = base.T @ e, base.T @ y
    power, answer, size = float(np.sum(e**2)), float(np.sum(told**2)), float(np.sum(said**2))
    free, count = base.shape[1], float(moves(e - base @ told)[0])
    if size == 0 or power == 0 or count <= 2 * free:
        return None
    noise = max((power - answer) / (count - free), 1e-300)
    beyond = RIGHT**2 * size / noise / free  # noncentrality for each degree of freedom
    chance = f.sf(
        answer / free / noise / (1.0 + beyond), free * (1.0 + beyond) ** 2 / (1.0 + 2.0 * beyond), count - free
    )
    return float(np.sqrt(answer / size)), float(chance)


def _idle(records: Sequence[Trajectory], column: int, taken: Sequence[npt.NDArray[np.bool_]]) -> float:
    """Return the probability of the largest correlation of an output with an input by chance; 0 if nothing is asked.

    Up to a quarter of a record before, each without what its own past foretells of it (Box & Jenkins 1976, *Time Series
    Analysis*, sec. 11.1).
    """
    from scipy.signal import correlate
    from scipy.special import erfc

    rows, lags = [_unbroken(one) for one in taken], min(map(len, records)) // 4
    count = sum(int(one.sum()) for one in rows)

    def own(signals: Sequence[FloatArray]) -> list[FloatArray]:
        past = own_past(signals, rows)
        whole = [without_past(one[:, None], past)[:, 0] for one in signals]
        level = sum(float(one[k].sum()) for one, k in zip(whole, rows, strict=True)) / count
        return [np.where(k, one - level, 0.0) for one, k in zip(whole, rows, strict=True)]

    if count <= EACH * PAST:
        return 0.0
    largest, y = 0.0, own([record.y[:, column] for record in records])
    for k in range(records[0].spec.nu):
        u = own([record.u[:, k] for record in records])
        sums = sum(correlate(b, a, method="fft")[len(a) - 1 :][: lags + 1] for a, b in zip(u, y, strict=True))
        power = sum(float(a @ a) for a in u) * sum(float(b @ b) for b in y)
        largest = max(largest, float(np.abs(sums).max()) / np.sqrt(power) if power > 0 else 0.0)
    each = float(erfc(largest * np.sqrt(0.5 * count)))
    return -float(np.expm1((lags + 1) * records[0].spec.nu * np.log1p(-min(each, 1.0 - 1e-16))))


def _unbroken(taken: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the rows that are readings, as are all whose past is asked for."""
    found = taken.copy()
    for j in range(1, PAST + 1):
        found[j:] &= taken[:-j]
        found[:j] = False
    return found
