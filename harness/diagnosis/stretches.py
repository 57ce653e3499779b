"""Long records: the search looks at stretches of them, and the parameters of its answer are refitted on all.

A search simulates thousands of times; what 20 000 samples cannot decide, it does not need 50 000 for.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np

from harness.diagnosis.forms import Fitted, Form
from harness.diagnosis.output_form import OutputForm
from harness.diagnosis.per_record import PER_RECORD
from harness.signals import Dataset, Run

__all__ = ["polished", "stretched"]

LONG = 40_000
"""Samples of the estimation records together, beyond which the search looks at stretches."""
LENGTH, COUNT = 5_000, 4


def stretched(dataset: Dataset, *, long: int = LONG, length: int = LENGTH, count: int = COUNT) -> Dataset:
    """Return a data set whose long estimation records are cut down to stretches; the other runs stay as they are.

    Beyond ``long`` samples together, every estimation record is cut into equal parts, ``count`` in all or one for each
    record, and the middle of each part is kept: ``length`` samples, less where there are more records than stretches.

    Parameters
    ----------
    dataset : Dataset
    long, length, count : int

    Returns
    -------
    Dataset
        The same one if its records are not long; else with a warning that says what was cut.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
    >>> record = Trajectory(np.arange(80) * 0.5, np.zeros((80, 1)), np.ones((80, 1)), spec)
    >>> short = stretched(Dataset("x", (Run(record),)), long=50, length=10, count=2)
    >>> [(len(one), float(one.t[0])) for one in short.estimation]
    [(10, 7.5), (10, 27.5)]
    """
    total = sum(len(one) for one in dataset.estimation)
    if total <= long:
        return dataset
    records = len(dataset.estimation)
    size = min(length, length * count // records)
    runs: list[Run] = []
    for run in dataset:
        n = len(run.trajectory)
        if run.use != "estimation" or n <= size:
            runs.append(run)
            continue
        pieces = max(1, min(round(count * n / total), n // size))
        edges = np.linspace(0, n, pieces + 1)
        for first, last in pairwise(edges):
            start = int(0.5 * (first + last - size))
            runs.append(replace(run, trajectory=run.trajectory[start : start + size]))
    seen = sum(run.use == "estimation" for run in runs)
    kept = sum(len(run.trajectory) for run in runs if run.use == "estimation")
    note = (
        f"the {total} estimation samples are many: effects are searched for, and estimation errors given, on {seen} "
        f"stretches of them, {kept} samples spread evenly"
    )
    return replace(dataset, runs=tuple(runs), warnings=(*dataset.warnings, note))


def polished(form: Form, fitted: Fitted, whole: Dataset) -> Fitted:
    """Return a model with its parameters refitted on whole records, seen on the stretches again.

    Parameters
    ----------
    form : Form
        Of the stretches.
    fitted : Fitted
    whole : Dataset
        With the records that the stretches were cut from.

    Returns
    -------
    Fitted
        The same model where that is not possible: the form does not simulate equations, an effect happens at an
        instant of its own in each record, or the simulation of a whole record diverges.
    """
    own = any(one.effect.name in PER_RECORD for one in fitted.effects)
    if type(form) is not OutputForm or own:
        return fitted
    full = copy.copy(form)
    full.records = {**form.records, "estimation": tuple(run.measured() for run in whole.estimation)}
    solution = full.refined(fitted)
    return fitted if solution is None else form.evaluate(fitted.effects, form.settled(fitted, solution))
