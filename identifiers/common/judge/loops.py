"""Fits to a loop: what is wrong with the answer where outputs foretell inputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.algebra import column_norms, divisor, orthonormal, unit_columns
from harness.errors import FitError, HarnessError
from harness.judgement import NEW, Feedback
from harness.models.spread import Matrices, steps
from harness.models.whiteness import whiteness
from harness.scoring import predict
from harness.signals import FloatArray, Trajectory
from identifiers.common.lag_state import LagModel
from identifiers.common.neighbours import coefficients_without
from identifiers.common.records import lagged_blocks
from identifiers.common.regression import solve

ANSWERED = 0.05
"""Share of an input's unpredictable part that past outputs explain, from which on what is left of them biases it."""
COLOURED = 1e-3
"""Probability of errors so correlated, were they chance, from which on they count: of all outputs together."""
TAKEN = 0.5
"""What correlated errors would change of a prediction under inputs that answer nothing, over the change that is
predicted, from which on it is said: below it a model of too low an order still tells what the inputs do."""
MISTAKEN = 0.1
"""What the errors answer to unforeseen inputs, over what the outputs do, from which on it is said: where chance does
not explain it. None of 107 right fits to loops has any (benchmarks/feedback_judge.py, base 100)."""
UNCERTAIN = 0.35
"""Standard deviation of the first answers to an input, over these, from which on it is said: a fit of that errs by half
and more with a probability of 0.15. TAKEN and this were chosen on 147 records of benchmarks/feedback_judge.py (bases
100 and 300): some 30 of 2499 fits err by half and more and say nothing, 157 of 986 that do not are warned of; with
0.42 it would be 40 and 113."""
FIRST = 4  # Answers that are looked at: what later ones hold a controller, or a filter that sees outputs, makes up for.
LAGS = 4  # Samples by which an input may reach an output, and that outputs' past is long, in the tests of errors.
USED = 200  # Samples in which it is asked what a model uses of the past.


def doubt_of_loop(model: Any, records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return what is wrong with a model of a loop, in words; empty where nothing shows.

    Errors one step ahead that are correlated in time hold a part of the load, and the inputs answer it: the model is
    biased, as one of too low an order is. Nor must they be correlated with what moves the inputs beside the controller,
    the part of them that nothing before foretells: else the model takes something else for what the inputs do. Chance
    makes each test fail in one of a thousand fits to what the model can hold (Ljung 1999, sec. 16.6 and 13.4), and it
    counts where it is a large part of what the inputs do. What is left is chance: where inputs move mostly with the
    load, only the part of them that something else brings tells what they do (Ljung 1999, sec. 13.4), and how well it
    does the scatter of the first answers to an input says.

    - ``records``: that it was fitted to
    - ``feedback``: of the records
    """
    if not feedback.found or feedback.share <= ANSWERED or feedback.unforeseen < NEW:
        return ""
    first = max(int(model.burn_in), LAGS) + LAGS
    kept = [record for record in records if len(record) > 2 * first + LAGS]
    ahead: list[FloatArray] = []
    try:
        with np.errstate(all="ignore"):
            ahead = [predict(model, record, 1)[first:] for record in kept]
    except HarnessError:  # a model that predicts nothing of these records says so elsewhere
        return ""
    if not ahead or not all(np.isfinite(one).all() for one in ahead):
        return ""
    errors = [record.y[first:] - one for record, one in zip(kept, ahead, strict=True)]
    chances = np.array([whiteness([one[:, i] for one in errors]) for i in range(model.spec.ny)])
    told = chances < COLOURED / model.spec.ny
    if told.any() and (taken := float(_taken_back(model, kept, errors, first)[told].max())) > TAKEN:
        return (
            f"residuals are correlated in time (probability {chances.min():.1g} by chance). Under feedback (past "
            f"outputs predict the input) this biases the response to the inputs by {percent(taken)}: raise the order, "
            "model the noise (prediction-error), or move the set-point more"
        )
    mistaken, chance = _mistaken(kept, errors, ahead, first)
    if mistaken > MISTAKEN:
        return (
            f"the part of the inputs that the controller does not set explains residuals of {percent(mistaken)} of the "
            f"response to them (probability {chance:.1g} by chance): the model mistakes the loop for the plant; use "
            "another method, or move the set-point more"
        )
    scatter = _scatter(model, kept)
    if scatter > UNCERTAIN:
        return (
            "the inputs respond to the outputs (feedback), and what else moves them hardly shows beside the load: the "
            f"first samples of the response are uncertain by {percent(scatter)}; move the set-point more, or longer"
        )
    return ""


def percent(share: float) -> str:
    """Return a share in words."""
    return f"{100 * share:.0f} %" if np.isfinite(share) and share < 10 else "more than ten times"


def _mistaken(
    records: Sequence[Trajectory], errors: Sequence[FloatArray], ahead: Sequence[FloatArray], first: int
) -> tuple[float, float]:
    """Return what errors answer to the unforeseen inputs over what outputs do, where it is most, and its chance.

    0 where chance explains it.
    """
    from scipy.stats import chi2

    spec = records[0].spec
    unforeseen = _unforeseen(records, first - LAGS)
    at_once = int(not spec.feedthrough)
    rows = []
    for moved, wrong in zip(unforeseen, errors, strict=True):
        n = len(wrong)
        rows.append(np.hstack([moved[LAGS - j : LAGS - j + n] for j in range(at_once, LAGS + 1)]))
    x, e, y = (np.concatenate(part) for part in (rows, errors, ahead))
    x, e, y = (part - part.mean(axis=0) for part in (x, e, y))
    left = orthonormal(x, 1e-8)
    power = np.sum(e**2, axis=0)
    answers, whole = left.T @ e, left.T @ (y + e)
    shares = np.sum(answers**2, axis=0) / divisor(power)
    chances = spec.ny * chi2.sf(len(e) * shares, left.shape[1])
    size = np.sqrt(np.sum(answers**2, axis=0) / np.maximum(np.sum(whole**2, axis=0), 1e-300))
    size = np.where(chances < COLOURED, size, 0.0)
    worst = int(np.argmax(size))
    return float(size[worst]), float(min(1.0, chances[worst]))


def _taken_back(model: Any, records: Sequence[Trajectory], errors: Sequence[FloatArray], first: int) -> FloatArray:
    """Return what the past tells of errors over the change that is predicted (ny,), were inputs to answer nothing.

    A linear law of the last outputs and inputs is fitted to the errors, and both are asked with the inputs in an order
    drawn by chance: in the loop itself what a model takes for outputs and for inputs may cancel.
    """
    rng = np.random.default_rng(0)
    seen, asked, size = [], [], []
    for record in records:
        mixed = replace(record, u=record.u[rng.permutation(len(record))])
        seen.append(_past(record, first))
        asked.append(_past(mixed, first))
        with np.errstate(all="ignore"):
            size.append(predict(model, mixed, 1)[first:] - record.y[first - 1 : -1])
    x = np.concatenate(seen)
    length = column_norms(x)
    law = np.linalg.lstsq(x / length, np.concatenate(errors), rcond=1e-12)[0]
    with np.errstate(all="ignore"):
        wrong = np.mean((np.concatenate(asked) / length @ law) ** 2, axis=0)
        share = np.sqrt(wrong / np.mean(np.concatenate(size) ** 2, axis=0))
    return np.asarray(np.where(np.isfinite(share), share, np.inf), dtype=np.float64)


def _past(record: Trajectory, first: int) -> FloatArray:
    """Return what a record's samples from the first on may follow from, and a constant."""
    n, at_once = len(record), int(not record.spec.feedthrough)
    columns = [record.y[first - j : n - j] for j in range(1, LAGS + 1)]
    columns += [record.u[first - j : n - j] for j in range(at_once, LAGS + 1)]
    return np.hstack([*columns, np.ones((n - first, 1))])


def _scatter(model: Any, records: Sequence[Trajectory]) -> float:
    """Return the standard deviation of the first answers to an input over these, of the output where it is most.

    A model without neighbours gets those of a linear regression on what it uses of as many lags, no better known than
    which it can be; one of several modes has fewer samples for each. 0 where nothing tells.
    """
    size = np.concatenate([record.u for record in records]).std(axis=0)
    count = FIRST + LAGS + int(model.burn_in)
    spread = getattr(model, "spread", None)
    if spread is not None:
        with np.errstate(all="ignore"):
            middle = _answers(model.matrices, count)
            near = np.array([_answers(one, count) for one in spread.models])
        factor = float(spread.factor)
    else:
        if (found := _near(model, records)) is None:
            return 0.0
        middle, near = (np.array([_pulses(one, records[0].spec.nu, count) for one in part]) for part in found[:2])
        middle, factor = middle[0], found[2] * float(model.notes.get("modes", 1))
    begins = int(np.argmax(np.any(middle != 0, axis=(1, 2))))
    taken = slice(begins, begins + FIRST)
    with np.errstate(all="ignore"):
        wrong = factor * np.sum(((near - middle)[:, taken] * size) ** 2, axis=(0, 1, 3))
        whole = np.sum((middle[taken] * size) ** 2, axis=(0, 2))
        share = np.sqrt(wrong / whole)
    return float(np.where(np.isnan(share), np.inf if wrong.any() else 0.0, share).max())


def _near(model: Any, records: Sequence[Trajectory]) -> tuple[FloatArray, FloatArray, float] | None:
    """Return the linear law (1, p, ny) of what a model uses, its neighbours (G, p, ny) and their factor, or None."""
    ny, lags = records[0].spec.ny, int(getattr(model, "lags", 1))
    rows = [phi for phi, _ in lagged_blocks(records, lags, offset=True)]
    used = _used(model, np.concatenate(rows)[:USED])
    law, near, factor = np.zeros((1, rows[0].shape[1], ny)), np.zeros((0, rows[0].shape[1], ny)), 1.0
    for output in range(ny):
        columns = np.flatnonzero(used[:, output])

        def blocks(columns: Any = columns, output: int = output) -> Iterator[tuple[FloatArray, FloatArray]]:
            return ((phi[:, columns], y[:, [output]]) for phi, y in lagged_blocks(records, lags, offset=True))

        try:
            solution = solve(blocks, "loop", least_norm=True)
        except FitError:
            return None
        if (found := coefficients_without(blocks, solution)) is None:
            return None
        others, factor = found
        near = near if len(near) else np.zeros((len(others), *law.shape[1:]))
        law[0, columns, output], near[:, columns, output] = solution.coefficients[:, 0], others[:, :, 0]
    return law, near, factor


def _used(model: Any, rows: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which regressors, and the constant, an output follows (p, ny): all where a model does not say.

    The inputs of the sample before always count: where a model leaves one out, the load may hide what it does.
    """
    ny, used = model.spec.ny, np.ones((rows.shape[1], model.spec.ny), dtype=bool)
    if not isinstance(model, LagModel):
        return used
    middle, first = model.ahead(rows[:, :-1])[0], model.lags * ny
    for column in (*range(first), *range(first + model.spec.nu, rows.shape[1] - 1)):
        moved = rows[:, :-1].copy()
        moved[:, column] = np.roll(moved[:, column], len(rows) // 2)
        used[column] = np.any(model.ahead(moved)[0] != middle, axis=0)
    return used


def _answers(matrices: Matrices, count: int) -> FloatArray:
    """Return the first answers (count, ny, nu) to a pulse."""
    return steps(matrices, count + 1, "impulse")


def _pulses(theta: FloatArray, nu: int, count: int) -> FloatArray:
    """Return the answers (count + 1, ny, nu) to a pulse of ``y[k+1] = theta' [y[k], ..., u[k], ..., 1]``."""
    ny = theta.shape[1]
    lags = (len(theta) - 1) // (ny + nu)
    own = theta[: lags * ny].reshape(lags, ny, ny)
    given = theta[lags * ny : lags * (ny + nu)].reshape(lags, nu, ny)
    found = np.zeros((count + 1, ny, nu))
    for k in range(1, count + 1):
        found[k] = given[k - 1].T if k <= lags else 0.0
        for j in range(1, min(lags, k - 1) + 1):
            found[k] += own[j - 1].T @ found[k - j]
    return found


def _unforeseen(records: Sequence[Trajectory], first: int) -> list[FloatArray]:
    """Return the part of the inputs (N - first, nu) that inputs and outputs before do not foretell, linearly."""
    known, now = [], []
    for record in records:
        n = len(record)
        columns = [record.u[first - j : n - j] for j in range(1, LAGS + 1)]
        columns += [record.y[first - j : n - j] for j in range(int(record.spec.feedthrough), LAGS + 1)]
        known.append(np.hstack([*columns, np.ones((n - first, 1))]))
        now.append(record.u[first:])
    x, u = np.concatenate(known), np.concatenate(now)
    x = unit_columns(x)
    left = u - x @ np.linalg.lstsq(x, u, rcond=1e-10)[0]
    return np.split(left, np.cumsum([len(one) for one in now])[:-1])
