"""A model asked about the records that it was fitted to: a free run that leaves what their inputs do knows no plant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.errors import HarnessError
from harness.judgement import Feedback, moves
from harness.scoring import predict
from harness.signals import FloatArray, Trajectory
from identifiers.common.judge.loops import ANSWERED, COLOURED, percent

__all__ = ["doubt_of_own_record"]

LEFT = 0.4
"""What a free run leaves of what the inputs do, over that, from which on it is said: of nonlinear fits to records that
drift (one plant) those that left less than 0.35 erred by less than half under fresh inputs, but for one."""
UNEXPLAINED = 0.7
"""What a free run leaves of an output over the output, from which on a model without an order says so: half of the
variance is none of the inputs', and such a model takes load or drift for states."""
PAST = 8
"""Samples of its own past that foretell what is left, which may wander."""
LAGS = 16
"""Samples by which an input may reach an output in the test: twice as many."""
EACH = 4
"""Samples for each number of the test at least."""
RUN_AWAY = 1e6
"""Times the largest output that an error of a free run is at most: beyond, squares overflow, and nothing is told."""
CHECKED = 2_000
"""Samples of a free run: some models take a millisecond for each."""


def doubt_of_own_record(model: Any, records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return what is wrong with a model whose free runs do not answer the inputs as its records do; empty if nothing.

    What a free run leaves of the outputs is load, noise and error of the model. Load and noise do not follow the inputs
    where these answer no outputs; so what inputs explain of it, its own past taken away (Cochrane & Orcutt 1949, J. Am.
    Stat. Assoc. 44:32), is error, where chance does not explain it (Ljung 1999, sec. 16.6). In a loop nothing is asked.

    Parameters
    ----------
    model : Model
    records : sequence of Trajectory
        That it was fitted to.
    feedback : Feedback
        Of the records.
    """
    if feedback.found and feedback.share > ANSWERED:
        return ""
    first = int(model.burn_in) + LAGS + PAST
    kept, count = [], CHECKED
    for record in records:
        if min(len(record), count) > 2 * first:
            kept.append(record[:count])
            count -= len(record)
    try:
        with np.errstate(all="ignore"):
            left = [record.y - predict(model, record, None) for record in kept]
    except HarnessError:  # a model that runs freely over none of these records says so elsewhere
        return ""
    if not left:
        return ""
    most = RUN_AWAY * max(float(np.abs(record.y).max(initial=0.0)) for record in kept)
    if not all(np.isfinite(one).all() and np.abs(one).max(initial=0.0) <= most for one in (r[first:] for r in left)):
        return "a free run over the records that the model was fitted to diverges: it is no model to simulate"
    without_order = getattr(model, "matrices", None) is None
    for column, channel in enumerate(records[0].spec.outputs):
        whole, rest = (np.concatenate([one[first:, column] for one in part]) for part in ([r.y for r in kept], left))
        if without_order and (size := float(whole.std())) > 0 and float(rest.std()) > UNEXPLAINED * size:
            return (
                f"a free run over the records that the model was fitted to errs by {percent(rest.std() / size)} of "
                f"{channel.name}, whose motion is mostly not the inputs': take a drift out, or use a linear model"
            )
        share, chance = _answered(kept, [one[:, column] - one[first:, column].mean() for one in left], column, first)
        if share > LEFT and chance < COLOURED / len(records[0].spec.outputs):
            return (
                f"a free run over the records that the model was fitted to leaves {percent(share)} of what the inputs "
                f"do to {channel.name} (probability {chance:.1g} by chance): take a drift or a level out, a better "
                "structure, or another method"
            )
    return ""


def _answered(
    records: Sequence[Trajectory], left: Sequence[FloatArray], column: int, first: int
) -> tuple[float, float]:
    """Return what inputs explain of what is left over what they explain of an output, and the chance of so much."""
    from scipy.stats import f

    own = _ahead(left, first)
    at_once = int(not records[0].spec.feedthrough)
    rows, wrong, whole = [], [], []
    for record, one in zip(records, left, strict=True):
        n, u = len(one), _filtered(record.u, own)
        rows.append(np.hstack([u[first - j : n - j] for j in range(at_once, LAGS + 1)]))
        wrong.append(_filtered(one[:, None], own)[first:])
        whole.append(_filtered(record.y[:, column, None], own)[first:])
    x, e, y = (np.concatenate(part) for part in (rows, wrong, whole))
    x, e, y = (part - part.mean(axis=0) for part in (x, e, y))
    if len(x) < EACH * x.shape[1]:
        return 0.0, 1.0
    length = np.linalg.norm(x, axis=0)
    base, values, _ = np.linalg.svd(x / np.where(length > 0, length, 1.0), full_matrices=False)
    base = base[:, values > 1e-8 * max(float(values[0]), 1e-300)]
    told, said = base.T @ e, base.T @ y
    power, answer, size = float(np.sum(e**2)), float(np.sum(told**2)), float(np.sum(said**2))
    free, count = base.shape[1], float(moves(e - base @ told)[0])
    if size == 0 or power == 0 or count <= 2 * free:
        return 0.0, 1.0
    ratio = answer / free / max((power - answer) / (count - free), 1e-300)
    return float(np.sqrt(answer / size)), float(f.sf(ratio, free, count - free))


def _ahead(left: Sequence[FloatArray], first: int) -> FloatArray:
    """Return the coefficients (PAST,) with which what is left foretells itself."""
    rows = [np.column_stack([one[first - j : len(one) - j] for j in range(1, PAST + 1)]) for one in left]
    x, target = np.concatenate(rows), np.concatenate([one[first:] for one in left])
    size = float(np.abs(x).max(initial=0.0)) or 1.0
    return np.asarray(np.linalg.lstsq(x / size, target / size, rcond=1e-6)[0], dtype=np.float64)


def _filtered(values: FloatArray, own: FloatArray) -> FloatArray:
    """Return signals (N, n) without what coefficients foretell; the first samples are not."""
    found = values.copy()
    for j, weight in enumerate(own, start=1):
        found[j:] -= weight * values[:-j]
    return found
