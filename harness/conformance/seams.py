"""Checks of how several records are treated: all are used, and nothing reaches across the seam between two."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.conformance.results import NotApplicable, demand
from harness.conformance.running import alike, fit, one_step
from harness.conformance.subject import Subject, shown
from harness.conformance.workloads import Workload, draw_workload
from harness.errors import HarnessError, InputError
from harness.signals import Trajectory

PIECES = (24, 48, 80, 240)
"""Lengths of the pieces [samples], the shortest that the identifier accepts; records are long enough."""
WORSE = 3.0
"""Factor by which a shuffled order may not spoil the predictions, in the median over the systems of a kind. Random and
order-dependent estimators stay below 1.4 on these systems; differences across the seams cost a factor of 4 to 15 on
some kind (measured in tests/conformance)."""
EXACT = 1e-6  # Error, relative to the outputs, below which a fit counts as exact whatever its order.


def no_seam_crossed(subject: Subject) -> None:
    """Demand that the order of records does not spoil a fit.

    A record is cut into pieces. In their natural order no seam contradicts the system; shuffled, every seam does. What
    is inside the pieces stays the same, so whoever looks at one piece at a time learns as much (random subsets,
    stochastic training and gradient steps in order included), and whoever differences or windows across the seams does
    not. Blamed if most systems of some kind say so: where the model is wrong anyway, a seam more does not show.
    """
    ratios: dict[str, list[float]] = {}
    for workload in subject.surveyed():
        found = ratios.get(workload.kind, [])
        if sum(ratio < WORSE for ratio in found) > subject.each / 2:
            continue  # most of this kind are sound: the others cannot turn the median
        spoilt = _spoilt(subject, workload)
        if spoilt is not None:
            ratios.setdefault(workload.kind, []).append(spoilt)
    if not ratios:
        raise NotApplicable("it takes no records short enough to be shuffled")
    kind, worst = max(((kind, float(np.median(found))) for kind, found in ratios.items()), key=lambda item: item[1])
    demand(
        worst < WORSE,
        f"shuffled pieces of a record give {worst:.3g} times the error of the same pieces in order ({kind}): something "
        "is differenced or windowed across the seam of two records",
    )


def all_records_used(subject: Subject) -> None:
    """Demand that a fit to two noisy records is not the fit to one of them alone."""
    looked = 0
    for workload in subject.survey(noise=1e-2):
        first, second = shown(workload)
        try:
            both = subject.model(workload)
            alone = [fit(subject.factory(), [record]) for record in (first, second)]
        except HarnessError:
            continue
        if alike(alone[0], alone[1], workload.probe):
            continue  # the data make no difference at all: another check says so
        looked += 1
        if not any(alike(both, model, workload.probe) for model in alone):
            return
    if not looked:
        raise NotApplicable("no record of the survey is enough by itself")
    demand(False, "two records give the model of one of them alone: the other is not learned from")


def _pieces(record: Trajectory, length: int) -> list[Trajectory]:
    """Return whole pieces of a record, one after the other, each with a time axis from 0."""
    cuts = range(0, len(record) - length + 1, length)
    t = np.arange(length, dtype=np.float64) * record.spec.sample_time
    return [Trajectory(t, record.u[k : k + length], record.y[k : k + length], record.spec) for k in cuts]


def _cut(workload: Workload, length: int) -> list[Trajectory]:
    return [piece for record in shown(workload) for piece in _pieces(record, length)]


def _accepted(subject: Subject, workload: Workload) -> tuple[list[Trajectory], Any] | None:
    """Return the shortest pieces that are accepted in their natural order and the model of them, or None."""
    for length in PIECES:
        source = workload
        if 3 * length > len(workload.first) + len(workload.second):
            try:
                source = draw_workload(workload.kind, workload.seed, 2 * length)
            except InputError:
                return None
        pieces = _cut(source, length)
        try:
            return pieces, fit(subject.factory(), pieces)
        except HarnessError:
            continue
    return None


def _spoilt(subject: Subject, workload: Workload) -> float | None:
    """Return the one-step error after a fit to shuffled pieces over that after a fit to ordered ones, or None."""
    try:
        subject.model(workload)
    except HarnessError:
        return None
    accepted = _accepted(subject, workload)
    if accepted is None:
        return None
    pieces, forth = accepted
    order = np.random.default_rng(workload.seed).permutation(len(pieces))
    try:
        mixed = fit(subject.factory(), [pieces[k] for k in order])
    except HarnessError:
        return 1.0
    if alike(forth, mixed, workload.probe, tolerance=EXACT):
        return 1.0
    natural, shuffled = _error(forth, workload.probe), _error(mixed, workload.probe)
    return shuffled / max(natural, EXACT)


def _error(model: Any, data: Trajectory) -> float:
    """Return the one-step error relative to the size of the outputs."""
    skip = int(model.burn_in) + 1
    difference = one_step(model, data)[skip:] - data.y[skip:]
    if not difference.size or not np.isfinite(difference).all():
        return float("inf")
    return float(np.sqrt(np.mean(difference**2)) / (data.y.std() or 1.0))
