"""Rounding of readings: no derivative sees it, but the readings lie on a grid, on every record alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.fit import Fit, Form
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Accepted
from harness.effects.effect import Placed
from harness.resolution import quantisation_test
from harness.signals import Dataset, FloatArray


def with_rounding(
    form: Form,
    outcome: Outcome,
    dataset: Dataset,
    candidates: Sequence[Placed],
    policy: Policy = POLICY,
    *,
    noise_of: Callable[[Fit], FloatArray],
) -> Outcome:
    """Return what was found with the rounding of outputs that makes a part of the noise; not where it was taken back.

    Parameters
    ----------
    form : Form
    outcome : Outcome
    dataset : Dataset
    candidates : sequence of Placed
    policy : Policy
    noise_of : callable
        Gives the standard deviation of the noise of the readings in the data (ny,) that a fit has found.
    """
    names = [channel.name for channel in dataset.spec.outputs]
    for placed in () if outcome.withdrawn else candidates:
        if placed.effect.sampled != "quantise" or placed.at not in names:
            continue
        column = names.index(placed.at)
        readings = {
            use: np.concatenate([run.y[:, column] for run in runs])
            for use, runs in (("estimation", dataset.estimation), ("validation", dataset.validation))
        }
        tests = {use: quantisation_test(read) for use, read in readings.items()}
        step = tests["estimation"].step
        model = outcome.model
        noise = float(noise_of(model)[column])
        if not all(test.quantised for test in tests.values()) or step**2 / 12 < policy.rounding * noise**2:
            continue
        fit = form.fit([*model.effects, placed], [{**model.values, placed.name("step"): step}], model)
        if fit is None:
            continue
        gain = [-test.on_grid * len(readings[use]) * float(np.log(policy.chance)) for use, test in tests.items()]
        rounded = Accepted(placed, ((placed,),), gain[0], gain[1])
        outcome = replace(outcome, model=fit, accepted=(*outcome.accepted, rounded))
    return outcome
