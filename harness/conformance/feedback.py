"""Checks that an identifier says of records that show nothing of its inputs that it cannot tell what they do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from harness.conformance.results import NotApplicable, demand
from harness.conformance.running import fit, one_step
from harness.conformance.subject import Subject
from harness.errors import HarnessError
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

SAMPLES = 500  # Of each of two records: enough for a judge to see a law, little enough for a slow fit.
NOISES = (0.0, 1e-4, 0.05)
"""Of the sensors, relative to the outputs: rounding, far below, and about as large as what a residual shows."""
HELD = 0.7  # Input that never moves.
REMEDY = (
    "refuse them (harness.judgement.refuse_law), or say so in the model's notes under 'warning', as the "
    "decorator @told of identifiers.common.judge.told does on fit"
)
RIGHT = 0.5
"""One-step error under fresh inputs, relative to that of the last value, of a model that knows the plant still."""

_A = np.array([[0.95, 0.2], [-0.1, 0.8]])
_B = np.array([[0.0], [1.0]])
_GAIN = np.array([[-0.3, -0.5]])
_SPEC = PlantSpec((Channel("u", "V"),), (Channel("q", "m"), Channel("v", "m")), 0.1)


def feedback_told(subject: Subject) -> None:
    """Demand a refusal, a warning in the model's notes, or the right answer, where only a controller moved the input.

    A model that does not answer its input says nothing of what the input does, and passes. Under ``u = K x``
    many plants give the same records, and a fit that names one of them names it by chance.
    :func:`harness.judgement.refuse_law` tells.
    """
    for noise in NOISES:
        records = [_record(seed, _GAIN, dither=0.0, noise=noise) for seed in (0, 1)]
        _demand_a_word(subject, records, f"u = K y, and nothing else moved u (noise {noise:g} of the outputs)")


def stillness_told(subject: Subject) -> None:
    """Demand the same where the inputs never move, and something else moves the plant."""
    records = [_record(seed, np.zeros((1, 2)), dither=0.0, noise=0.05, held=HELD) for seed in (0, 1)]
    _demand_a_word(subject, records, "the input never moved")


def _demand_a_word(subject: Subject, records: list[Trajectory], what: str) -> None:
    """Demand a refusal, a warning, a model that does not answer its input, or the right one."""
    if not any(kind.startswith("linear") for kind in subject.kinds):
        raise NotApplicable("it takes no linear system")
    fresh = _record(99, np.zeros((1, 2)), dither=1.0, noise=0.0)
    try:
        model = fit(subject.factory(), records)
    except HarnessError:
        return
    demand(
        _warned(model) or not _answers(model, fresh) or _error(model, fresh) < RIGHT,
        f"records in which {what}, give a model without a word: {REMEDY}",
    )


def _record(seed: int, gain: FloatArray, *, dither: float, noise: float, held: float = 0.0) -> Trajectory:
    """Return a record under ``u = gain x + held`` of true states, with a dither of that size beside it."""
    rng = np.random.default_rng([seed, 47])
    u, x = held + dither * rng.normal(size=(SAMPLES, 1)), np.zeros((SAMPLES, 2))
    for k in range(SAMPLES):
        u[k] += gain @ x[k]
        if k + 1 < SAMPLES:
            x[k + 1] = _A @ x[k] + _B @ u[k] + 0.1 * rng.normal(size=2) * (dither == 0)
    y = np.asarray(x + noise * x.std(axis=0) * rng.normal(size=x.shape), dtype=np.float64)
    return Trajectory(np.arange(SAMPLES, dtype=np.float64) * 0.1, u, y, _SPEC)


def _warned(model: Any) -> bool:
    """Return True if a model's notes hold a warning."""
    notes = getattr(model, "notes", {})
    return bool(notes.get("warning") or notes.get("warnings"))


def _answers(model: Any, data: Trajectory) -> bool:
    """Return True if a model's predictions depend on the input."""
    still = replace(data, u=np.zeros_like(data.u))
    return not np.array_equal(one_step(model, data), one_step(model, still), equal_nan=True)


def _error(model: Any, data: Trajectory) -> float:
    """Return the largest one-step error of an output, relative to that of its last value."""
    skip = int(model.burn_in) + 2
    own = np.mean((data.y - one_step(model, data))[skip:] ** 2, axis=0)
    last = np.mean(np.diff(data.y, axis=0)[skip - 1 :] ** 2, axis=0)
    return float(np.sqrt(np.nan_to_num(own / last, nan=np.inf)).max())
