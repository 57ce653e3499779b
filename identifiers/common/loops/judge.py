"""One judge of fits to a loop: whether the answer is biased, or hidden by the load, where outputs foretell inputs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from harness.errors import HarnessError
from harness.judgement import Feedback, feedback_of
from harness.models.spread import gains
from harness.scoring import predict
from harness.signals import FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.one_step_estimate import whiteness

__all__ = ["ANSWERED", "COLOURED", "doubt_of_loop", "hidden_by_load", "loop_told"]

ANSWERED = 0.1
"""Share of an input's unpredictable part that past outputs explain, from which on what is left of them biases it."""
NEW = 0.01
"""What an input's own past leaves of it, below which nobody answers anything: a sweep of 2000 samples leaves 1e-5, a
loop that is moved from outside by a tenth of its input 0.14 and more."""
COLOURED = 1e-3
"""Probability of errors so correlated, were they chance, from which on they count: of all outputs together."""
HALF = 0.5
"""Uncertainty of the response, over the response itself and weighed by the input's power, from which on it is said."""
LINES = 64
"""Frequencies that are looked at, of the half circle."""
CHECKED = 5_000
"""Samples that are looked at."""
LAGS = 4
"""Samples by which an input may reach an output, and that outputs' past is long, in the test of what inputs do."""

Fit = TypeVar("Fit", bound=Callable[..., Any])


def loop_told(fit: Fit) -> Fit:
    """Return a ``fit`` whose model warns where the records come from a loop and it cannot be what the inputs do.

    Nothing is asked where the identifier's ``least_excitation`` is 0, or the fit warns already.
    """

    @functools.wraps(fit)
    def told(self: Any, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        model = fit(self, trajectories, rng=rng)
        notes = model.notes
        if self.least_excitation <= 0 or notes.get("warning") or notes.get("warnings"):
            return model
        records = _some(trajectories)
        if not records or records[0].spec.nu == 0:
            return model
        feedback = feedback_of(records)
        doubt = doubt_of_loop(model, records, feedback)
        said: dict[str, Any] = {"warning": doubt} if doubt else {}
        if not said and isinstance(model, LinearModel) and feedback.share > ANSWERED:
            hidden_by_load(model, records, feedback, said)
        return replace(model, notes={**notes, **said}) if said else model

    return cast(Fit, told)


def doubt_of_loop(model: Any, records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return what is wrong with a model of a loop, in words; empty where nothing shows.

    Two tests of its errors one step ahead, which only chance makes fail in one of a thousand fits to what the model can
    hold (Ljung 1999, sec. 16.6 and 13.4). Errors that are correlated in time hold a part of the load, and the inputs
    answer it: the model is biased, as one of too low an order is. And errors must not be correlated with what moves the
    inputs beside the controller, the part of them that nothing before foretells: else the model takes something else
    for what the inputs do.

    Parameters
    ----------
    model : Model
    records : sequence of Trajectory
        That it was fitted to.
    feedback : Feedback
        Of the records.
    """
    if not feedback.found or feedback.share <= ANSWERED or feedback.unforeseen < NEW:
        return ""
    first = max(int(model.burn_in), LAGS) + LAGS
    kept = [record for record in records if len(record) > 2 * first + LAGS]
    errors = []
    try:
        with np.errstate(all="ignore"):
            errors = [(record.y - predict(model, record, 1))[first:] for record in kept]
    except HarnessError:  # a model that predicts nothing of these records says so elsewhere
        return ""
    if not errors or not all(np.isfinite(one).all() for one in errors):
        return ""
    ny = errors[0].shape[1]
    chance = min(whiteness([one[:, i] for one in errors]) for i in range(ny))
    if chance < COLOURED / ny:
        return (
            f"residuals are correlated in time (probability {chance:.1g} by chance), which in a loop (past outputs "
            "foretell the input) biases what the inputs do: raise the order, model the noise (prediction-error), or "
            "move the set-point more"
        )
    share, chance = _answered_wrongly(kept, errors, first)
    if chance < COLOURED:
        return (
            f"what moves the inputs beside the controller explains {100 * share:.0f} % of the residuals (probability "
            f"{chance:.1g} by chance): the model takes something else for what the inputs do; use another method, or "
            "move the set-point more"
        )
    return ""


def _answered_wrongly(records: Sequence[Trajectory], errors: Sequence[FloatArray], first: int) -> tuple[float, float]:
    """Return how much of the errors the unforeseen inputs explain, of the output where it is most, and its chance."""
    from scipy.stats import chi2

    spec = records[0].spec
    unforeseen = _unforeseen(records, first - LAGS)
    at_once = int(not spec.feedthrough)
    rows, target = [], []
    for moved, wrong in zip(unforeseen, errors, strict=True):
        n = len(wrong)
        rows.append(np.hstack([moved[LAGS - j : LAGS - j + n] for j in range(at_once, LAGS + 1)]))
        target.append(wrong)
    x, e = np.concatenate(rows), np.concatenate(target)
    x = x - x.mean(axis=0)
    length = np.linalg.norm(x, axis=0)
    left, values, _ = np.linalg.svd(x / np.where(length > 0, length, 1.0), full_matrices=False)
    left = left[:, values > 1e-8 * max(float(values[0]), 1e-300)]
    e = e - e.mean(axis=0)
    power = np.sum(e**2, axis=0)
    shares = np.sum((left.T @ e) ** 2, axis=0) / np.where(power > 0, power, 1.0)
    worst = float(shares.max())
    return worst, min(1.0, spec.ny * float(chi2.sf(len(e) * worst, left.shape[1])))


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
    length = np.linalg.norm(x, axis=0)
    x = x / np.where(length > 0, length, 1.0)
    left = u - x @ np.linalg.lstsq(x, u, rcond=1e-10)[0]
    return np.split(left, np.cumsum([len(one) for one in now])[:-1])


def _some(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records without holes, up to so many samples in all."""
    some, left = [], CHECKED
    for record in trajectories:
        if left > 0 and record.missing is None:
            some.append(record[:left])
            left -= len(record)
    return some


def hidden_by_load(
    model: LinearModel, records: Sequence[Trajectory], feedback: Feedback, notes: dict[str, Any]
) -> None:
    """Note a warning where outputs foretell the inputs and the fit scatters by half of the response.

    In a loop whose controller answers a load, inputs move mostly with the load, and what they do is told by the
    set-point alone (Ljung 1999, sec. 13.4: only the part of the input that the reference brings counts). The judge of
    feedback sees that something moves the input, and a fit exists; whether it means anything its spread says.

    Parameters
    ----------
    model : LinearModel
        With its spread, in the units of the records; without a spread nothing is said.
    records : sequence of Trajectory
    feedback : Feedback
        Of the records.
    notes : dict
        Gets the ``"warning"`` where it has none.
    """
    if not feedback.found or feedback.unforeseen < NEW or model.spread is None or "warning" in notes:
        return
    frequency = np.linspace(0.0, 0.5, LINES + 1)[1:]
    power = _power(records)
    middle = gains(model.matrices, frequency, 1.0)
    size = float(np.einsum("fyu,fu->", np.abs(middle) ** 2, power))
    with np.errstate(over="ignore", invalid="ignore"):
        away = [np.abs(gains(one, frequency, 1.0) - middle) ** 2 for one in model.spread.models]
        scatter = float(model.spread.factor * np.einsum("gfyu,fu->", np.array(away), power))
    share = np.sqrt(scatter / size) if size > 0 else float("inf")
    if share < HALF:
        return
    said = f"{100 * share:.0f} %" if np.isfinite(share) and share < 10 else "more than ten times itself"
    notes["warning"] = (
        f"the inputs answer the outputs (feedback), and what else moves them hardly shows in the load: the response is "
        f"uncertain by {said} where the input has its power; move the set-point more, or longer"
    )


def _power(records: Sequence[Trajectory]) -> FloatArray:
    """Return the power of the inputs at the lines (LINES, nu), each output counted alike."""
    total = np.zeros((LINES, records[0].spec.nu))
    for record in records:
        u = record.u - record.u.mean(axis=0)
        found = np.abs(np.fft.rfft(u, axis=0)) ** 2
        place = np.minimum((np.arange(len(found)) * 2 * LINES) // max(len(u), 1), LINES - 1)
        for line, row in zip(place, found, strict=True):
            total[line] += row
    return total
