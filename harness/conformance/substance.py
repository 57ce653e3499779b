"""Checks that a model says something: it beats what needs no model, and inputs, data and the start matter to it.

Each looks at a survey of systems and asks that some of them show it, so that an estimator that fails on a few, or is
random, is not blamed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.conformance.results import NotApplicable, demand
from harness.conformance.running import alike, fit, one_step
from harness.conformance.subject import Subject, shown
from harness.conformance.workloads import Workload
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory, residual

MARGIN = 0.9  # Share of the trivial error below which a model counts as better: 10 % is beyond the luck of 240 samples.
GOOD = 0.05  # Free-run error, relative to the signal, of a model good enough for its start to be judged.
START = 10  # Samples after the burn-in at which a wrong initial state shows in every system that is drawn.


def beats_trivial(subject: Subject) -> None:
    """Demand that on one system at least a model predicts better than what needs none.

    Every output of some linear system must be predicted better than by the mean, by the last value and by the last two
    outputs without any input. Of identifiers that take no linear system only the mean is asked for, or the most
    frequent category: a hidden Markov model of few states loses to the likeliest successor and is sound. And every
    output of some system with several must be predicted better than by its mean, else columns are exchanged.
    """
    ratios: list[float] = []
    several: list[float] = []
    # White inputs, where they are taken: held ones hide that a model is a sample late. Angles sampled finely without
    # noise go on almost as they went, which no forest of 240 samples beats: there the mean is what must be beaten.
    white = any(kind.startswith("linear") for kind in subject.kinds)
    among = [w for w in subject.surveyed() if w.kind.startswith("linear") or not white or w.probe.spec.ny > 1]
    wide = any(w.probe.spec.ny > 1 for w in among)
    for workload in among:
        if min(ratios, default=np.inf) < MARGIN and (not wide or min(several, default=np.inf) < MARGIN):
            break  # shown once is shown
        try:
            model = subject.model(workload)
        except HarnessError:
            continue
        if workload.kind.startswith("linear") or not white:
            ratios.append(_against_trivial(model, workload, subject.predicted(workload), mean_only=not white))
        if workload.probe.spec.ny > 1:
            several.append(_against_trivial(model, workload, subject.predicted(workload), mean_only=True))
    demand(ratios, "every system of the survey is refused")
    demand(
        min(ratios) < MARGIN,
        f"on no {'linear ' if white else ''}system it predicts better than the mean, the last value, or the outputs "
        f"alone without the input: its least one-step error is {min(ratios):.2g} of theirs",
    )
    demand(
        not several or min(several) < MARGIN,
        f"on no system with several outputs all of them are predicted better than by their means (at best "
        f"{min(several, default=0.0):.2g} of that error): are columns exchanged?",
    )


def inputs_matter(subject: Subject) -> None:
    """Demand that every input changes the simulated outputs of some model."""
    seen: dict[int, bool] = {}
    most = max(workload.probe.spec.nu for workload in subject.surveyed())
    for workload in subject.survey():
        if sum(seen.values()) == most:
            break
        model, data = subject.model(workload), workload.probe.measured()
        for column in range(data.spec.nu):
            seen[column] = seen.get(column, False) or _reacts(model, data, column)
    if not seen:
        raise NotApplicable("the systems that it takes have no input")
    dead = [column for column, alive in seen.items() if not alive]
    demand(not dead, f"input {dead[0] if dead else ''} changes no simulated output of any model")


def data_matter(subject: Subject) -> None:
    """Demand that records of two systems with the same channels give two models."""
    groups: dict[Any, Workload] = {}
    compared = 0
    for workload in subject.survey():
        other = groups.setdefault(workload.probe.spec, workload)
        if other is workload:
            continue
        compared += 1
        if not alike(subject.model(workload), subject.model(other), workload.probe):
            return
    if not compared:
        raise NotApplicable("no two systems of the survey have the same channels")
    demand(False, "records of different systems give the same model: the data make no difference")


def initial_state_matters(subject: Subject) -> None:
    """Demand that a simulation starts where the record starts.

    Asked of models whose free run is good in the end: the record starts far from rest, so one that starts elsewhere is
    as wrong at first as the signal is large. Blamed if more than half of them are, and start alike whatever the outputs
    were (a start that is only a poor guess is no breach, nor are models that soon forget it).
    """
    verdicts: list[bool] = []
    for workload in subject.survey():
        if verdicts.count(False) >= len(subject.surveyed()) / 2:
            break
        model, data = subject.model(workload), workload.second.measured()
        wrong = _late_start(model, data)
        if wrong:
            elsewhere = Trajectory(data.t, data.u, data.y[::-1] + data.y.std(axis=0), data.spec)
            wrong = bool(np.array_equal(model.initial_state(data), model.initial_state(elsewhere)))
        if wrong is not None:
            verdicts.append(wrong)
    if not verdicts:
        raise NotApplicable("no model of the survey simulates well enough to judge its start")
    demand(
        sum(verdicts) <= len(verdicts) / 2,
        "simulations start elsewhere than the record: initial_state makes no use of its first outputs",
    )


def _against_trivial(model: Any, workload: Workload, predicted: FloatArray, *, mean_only: bool) -> float:
    """Return the largest ratio over the outputs of a model's one-step error to the least trivial one."""
    data = workload.probe.measured()
    skip = int(model.burn_in) + 2
    if len(data) - skip < 10:
        return np.inf
    own = _rms(data, predicted, skip)
    spec = data.spec
    if any(channel.kind == "category" for channel in spec.outputs):
        candidates = [_most_frequent(workload, data)]
    else:
        mean = np.broadcast_to(np.vstack([r.y for r in shown(workload)]).mean(axis=0), data.y.shape)
        candidates = [mean]
        if not mean_only:
            candidates += [np.vstack([data.y[:1], data.y[:-1]]), _from_outputs(workload, data), np.zeros_like(data.y)]
    trivial = np.min([_rms(data, np.asarray(guess), skip) for guess in candidates], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(own == 0.0, 0.0, own / trivial)
    return float(np.nan_to_num(ratio, nan=np.inf).max())


def _rms(data: Trajectory, predicted: FloatArray, skip: int) -> FloatArray:
    """Return the rms error of each output; on categories that of right or wrong."""
    wrong = residual(data.spec.outputs, data.y, predicted)[skip:]
    for column, channel in enumerate(data.spec.outputs):
        if channel.kind == "category":
            wrong[:, column] = wrong[:, column] != 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        result: FloatArray = np.sqrt(np.mean(wrong**2, axis=0))
    return result


def _from_outputs(workload: Workload, data: Trajectory) -> FloatArray:
    """Return predictions by least squares from the last two outputs, no input."""

    def rows(y: FloatArray) -> FloatArray:
        return np.hstack([y[1:-1], y[:-2], np.ones((len(y) - 2, 1))])

    records = [r.y for r in shown(workload)]
    G = np.linalg.lstsq(np.vstack([rows(y) for y in records]), np.vstack([y[2:] for y in records]), rcond=None)[0]
    return np.vstack([data.y[:2], rows(data.y) @ G])


def _most_frequent(workload: Workload, data: Trajectory) -> FloatArray:
    """Return the category that each output had most often, everywhere."""
    columns = []
    for seen in np.vstack([r.y for r in shown(workload)]).T:
        values, counts = np.unique(seen, return_counts=True)
        columns.append(np.full(len(data), values[np.argmax(counts)]))
    return np.column_stack(columns)


def _reacts(model: Any, data: Trajectory, column: int, steps: int = 25) -> bool:
    """Return True if a change of one input changes the simulated outputs."""
    steps = min(steps, len(data))
    u = data.u[:steps].copy()
    channel = data.spec.inputs[column]
    if channel.kind == "category":
        u[:, column] = (u[:, column] + 1) % channel.categories
    else:
        u[:, column] += float(data.u[:, column].std()) or 1.0
    x = np.asarray(model.initial_state(data[: max(int(model.burn_in), 1)]), dtype=float)
    plain, changed = _simulated(model, x, data.u[:steps]), _simulated(model, x, u)
    scale = float(np.abs(data.y).max()) or 1.0
    off = np.abs(changed - plain)
    return bool((off[np.isfinite(off)] > 1e-9 * scale).any())


def _simulated(model: Any, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return the outputs (N, ny) of a free run."""
    rows = []
    for held in u:
        rows.append(np.asarray(model.output(x, held), dtype=float))
        x = model.step(x, held)
    return np.array(rows)


def _late_start(model: Any, data: Trajectory) -> bool | None:
    """Return True if a good model is wrong at the start of a record, None if it is no good model."""
    if any(channel.kind != "real" for channel in data.spec.outputs):
        return None
    skip = int(model.burn_in)
    if len(data) < skip + 4 * START:
        return None
    # as a score does: the start is estimated from the whole record, so there is nothing to be forgiven
    with np.errstate(over="ignore", invalid="ignore"):
        miss = residual(
            data.spec.outputs, data.y, _simulated(model, np.asarray(model.initial_state(data), dtype=float), data.u)
        )
    late, early = slice(len(data) // 2, None), slice(skip, skip + START)
    spread = data.y[late].std(axis=0)
    if not (np.isfinite(miss).all() and (spread > 0).all()):
        return None
    if float((np.sqrt(np.mean(miss[late] ** 2, axis=0)) / spread).max()) > GOOD:
        return None
    size = np.sqrt(np.mean(data.y[early] ** 2, axis=0)) + 1e-12
    return bool((np.sqrt(np.mean(miss[early] ** 2, axis=0)) / size).max() > 0.5)


def stands_alone(subject: Subject) -> None:
    """Demand that a model predicts the same after the identifier was fitted to other data."""
    drawn = subject.surveyed()
    for workload, other in zip(drawn, drawn[1:] + drawn[:1], strict=True):
        if workload.probe.spec != other.probe.spec or workload is other:
            continue
        identifier = subject.factory()
        try:
            model = fit(identifier, shown(workload))
            before = one_step(model, workload.probe)
            fit(identifier, shown(other))
        except HarnessError:
            continue
        demand(
            np.array_equal(before, one_step(model, workload.probe), equal_nan=True),
            "a later fit changes an earlier model: they share an array",
        )
        return
    raise NotApplicable("no two systems of the survey have the same channels")
