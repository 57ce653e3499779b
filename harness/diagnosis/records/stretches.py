"""Long records: the search looks at stretches of them; plants that cannot be simulated freely for long: at windows.

A search simulates thousands of times; what 20 000 samples cannot decide, it does not need 50 000 for.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.signals import Dataset, FloatArray, Oddity, Run


def stretched(
    dataset: Dataset,
    *,
    use: str = "estimation",
    long: int = DATA_POLICY.long,
    length: int = DATA_POLICY.stretch,
    count: int = DATA_POLICY.stretches,
) -> Dataset:
    """Return a data set whose long records of a use are cut down to stretches; the other runs stay as they are.

    Beyond ``long`` samples together, every such record is cut into equal parts, ``count`` in all or one for each
    record, and the middle of each part is kept: ``length`` samples, less where there are more records than stretches.

    - ``use`` {"estimation", "validation"}
    - returns the same one if its records are not long; else with a warning that says what was cut

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
    >>> record = Trajectory(np.arange(80) * 0.5, np.zeros((80, 1)), np.ones((80, 1)), spec)
    >>> short = stretched(Dataset("x", (Run(record),)), long=50, length=10, count=2)
    >>> [(len(run), float(run.t[0])) for run in short.estimation]
    [(10, 7.5), (10, 27.5)]
    """
    whole = dataset.using(use)  # type: ignore[arg-type]
    total, records = sum(len(run) for run in whole), len(whole)
    if total <= long:
        return dataset
    size = min(length, length * count // records)
    runs: list[Run] = []
    for run in dataset:
        n = len(run.trajectory)
        if run.use != use or n <= size:
            runs.append(run)
            continue
        pieces = max(1, min(round(count * n / total), n // size))
        edges = np.linspace(0, n, pieces + 1)
        for first, last in pairwise(edges):
            start = int(0.5 * (first + last - size))
            runs.append(replace(run, trajectory=run.trajectory[start : start + size]))
    seen = sum(run.use == use for run in runs)
    kept = sum(len(run.trajectory) for run in runs if run.use == use)
    note = (
        f"the {total} {use} samples are many: effects are judged on {seen} stretches of them, {kept} samples spread "
        "evenly; free runs are compared on whole records"
    )
    return replace(dataset, runs=tuple(runs), warnings=(*dataset.warnings, note))


def cut_alike(
    references: Sequence[Mapping[str, FloatArray]], whole: Dataset, short: Dataset
) -> Sequence[Mapping[str, FloatArray]]:
    """Return signals of the runs of a data set for the stretches that were cut from it.

    - ``references``: for each run of ``whole`` signals by name, arrays (N,)
    - ``whole, short``: before and after :func:`stretched`
    - returns those of each run of ``short``; the signals unchanged where its runs are no stretches of the others
    """
    if len(references) != len(whole.runs):
        return references
    matching: list[Mapping[str, FloatArray]] = []
    sources = zip(whole.runs, references, strict=True)
    source = next(sources, None)
    for piece in short.runs:
        first = None
        while source is not None and (first := _place(piece, source[0])) is None:
            source = next(sources, None)
        if source is None or first is None:
            return references
        matching.append({name: signal[first : first + len(piece.trajectory)] for name, signal in source[1].items()})
    return matching


def _place(piece: Run, run: Run) -> int | None:
    """Return the sample of a run at which a stretch of it begins; None if it is no stretch of this run."""
    if piece.use != run.use:
        return None
    first = round(float(piece.trajectory.t[0] - run.trajectory.t[0]) / run.trajectory.spec.sample_time)
    inside = 0 <= first <= len(run.trajectory) - len(piece.trajectory)
    same = inside and np.array_equal(run.trajectory.y[first : first + len(piece.trajectory)], piece.trajectory.y)
    return first if same else None


def parted(dataset: Dataset) -> Dataset:
    """Return a data set whose records end where a position leaps, or an input is not known; others begin behind.

    - ``dataset``: one that was examined, see :func:`harness.data.oddities.examined`; what was found moves to the pieces

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((), (Channel("q"),), 0.5)
    >>> record = Trajectory(np.arange(80) * 0.5, np.zeros((80, 0)), np.ones((80, 1)), spec)
    >>> odd = Oddity("leap", 0, "q", (30,), ""), Oddity("spike", 0, "q", (10, 40), "")
    >>> pieces = parted(Dataset("x", (Run(record),), oddities=odd))
    >>> [len(run.trajectory) for run in pieces], [(one.kind, one.run, one.rows) for one in pieces.oddities]
    ([30, 50], [('spike', 0, (10,)), ('leap', 1, (0,)), ('spike', 1, (10,))])
    >>> lost = Oddity("dropout", 0, "u", tuple(range(30, 40)), "")
    >>> [float(run.trajectory.t[0]) for run in parted(Dataset("x", (Run(record),), oddities=(lost,)))]
    [0.0, 20.0]
    """
    cuts: dict[int, set[int]] = {}
    unknown: set[tuple[int, int]] = set()
    for odd in dataset.oddities or ():
        if odd.kind == "leap":
            cuts.setdefault(odd.run, set()).update(odd.rows)
        elif odd.kind == "dropout":
            cuts.setdefault(odd.run, set()).update((odd.rows[0], odd.rows[-1] + 1))
            unknown.add((odd.run, odd.rows[0]))
    if not cuts:
        return dataset
    runs: list[Run] = []
    moved: list[Oddity] = []
    for number, run in enumerate(dataset):
        for a, b in itertools.pairwise([0, *sorted(cuts.get(number, ())), len(run.trajectory)]):
            if (number, a) in unknown:
                continue
            for odd in dataset.oddities or ():
                rows = tuple(row - a for row in odd.rows if a <= row < b)
                if odd.run == number and (rows or (a == 0 and not odd.rows)):
                    moved.append(replace(odd, run=len(runs), rows=rows))
            runs.append(replace(run, trajectory=run.trajectory[a:b]))
    return replace(dataset, runs=tuple(runs), oddities=tuple(moved))


def counted(dataset: Dataset) -> Dataset:
    """Return a data set in which of filtered readings only those count that say something new; see :func:`parted`.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((), (Channel("q"),), 0.5)
    >>> record = Trajectory(np.arange(6) * 0.5, np.zeros((6, 0)), np.ones((6, 1)), spec)
    >>> odd = Oddity("filtered", 0, "q", (1, 2, 4, 5), "")
    >>> counted(Dataset("x", (Run(record),), oddities=(odd,))).runs[0].trajectory.readings.ravel().tolist()
    [1.0, nan, nan, 1.0, nan, nan]
    """
    runs = list(dataset.runs)
    for odd in dataset.oddities or ():
        if odd.kind == "filtered":
            record = runs[odd.run].trajectory
            missing = np.zeros(record.y.shape, dtype=bool) if record.missing is None else record.missing.copy()
            missing[list(odd.rows), [one.name for one in record.spec.outputs].index(odd.channel)] = True
            runs[odd.run] = replace(runs[odd.run], trajectory=replace(record, missing=missing))
    return replace(dataset, runs=tuple(runs))


def told_of_whole(whole: Dataset, pieces: Dataset, kinds: Sequence[str]) -> Dataset:
    """Return a data set with what was found in the pieces of it since :func:`parted`, instead of what was known of it.

    - ``kinds``: of what was found since; it stands in no row

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((), (Channel("q"),), 0.5)
    >>> record = Trajectory(np.arange(80) * 0.5, np.zeros((80, 0)), np.arange(80.0)[:, None], spec)
    >>> whole = Dataset("x", (Run(record, "test"), Run(record)), oddities=(Oddity("leap", 1, "q", (30,), ""),))
    >>> found = replace(parted(whole), oddities=(Oddity("shift", 2, "u", (), "late"),))
    >>> [(odd.kind, odd.run) for odd in told_of_whole(whole, found, ("shift",)).oddities]
    [('leap', 1), ('shift', 1)]
    """
    since = [
        replace(odd, run=next(k for k, run in enumerate(whole) if _place(pieces.runs[odd.run], run) is not None))
        for odd in pieces.oddities or ()
        if odd.kind in kinds
    ]
    return replace(whole, oddities=(*(odd for odd in whole.oddities or () if odd.kind not in kinds), *since))


def windowed(dataset: Dataset, seconds: float | None) -> Dataset:
    """Return a data set whose estimation and validation records are cut into windows, each a record of its own.

    - ``seconds``: length of a window [s]; None leaves the records whole
    """
    if seconds is None:
        return dataset
    length = max(round(seconds / dataset.spec.sample_time), 2)
    runs: list[Run] = []
    for run in dataset:
        n = len(run.trajectory)
        if run.use == "test" or n < 2 * length:
            runs.append(run)
            continue
        edges = [*range(0, n - length + 1, length)]
        runs += [
            replace(run, trajectory=run.trajectory[first:last])
            for first, last in zip(edges, [*edges[1:], n], strict=True)
        ]
    return replace(dataset, runs=tuple(runs))


def uncut(dataset: Dataset, column: int, ceiling: float, *, count: int = DATA_POLICY.stretches) -> Dataset | None:
    """Return the longest pieces of each use that lie below the ceiling of a sensor, each a record of its own.

    What a sensor cuts off it did not measure.

    - ``column``: the output
    - ``ceiling``: readings of this size or more are cut off
    - ``count``: pieces of each use
    - returns None if a use has no piece of ``DATA_POLICY.shortest`` samples

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
    >>> y = np.where(np.arange(200) // 20 == 3, 1.0, 0.5)[:, None]
    >>> record = Trajectory(np.arange(200) * 0.5, np.zeros((200, 1)), y, spec)
    >>> pieces = uncut(Dataset("x", (Run(record), Run(record, "validation"))), 0, 0.9)
    >>> [(len(run), float(run.t[0])) for run in pieces.estimation]
    [(60, 0.0), (120, 40.0)]
    """
    runs: list[Run] = []
    for use in ("estimation", "validation"):
        pieces = []
        for run in dataset.runs:
            if run.use != use:
                continue
            below = np.abs(run.trajectory.y[:, column]) < ceiling
            edges = np.flatnonzero(np.diff(np.concatenate([[False], below, [False]]).astype(int)))
            pieces += [
                replace(run, trajectory=run.trajectory[first:last])
                for first, last in zip(edges[::2], edges[1::2], strict=True)
                if last - first >= DATA_POLICY.shortest
            ]
        longest = sorted(pieces, key=lambda piece: -len(piece.trajectory))[:count]
        if not longest:
            return None
        runs += [piece for piece in pieces if piece in longest]
    return replace(dataset, runs=tuple(runs))


def about_lines(records: Sequence[FloatArray], samples: int | None = None, degree: int = 1) -> FloatArray:
    """Return the mean square of signals about a straight line through each window (n,).

    Over a short window a line follows most of a slow motion: what no model is needed for explains nothing.

    - ``records`` sequence of array (N, n)
    - ``samples``: of a window; whole records without
    - ``degree``: 0 for a constant in each window in the place of a line

    Examples
    --------
    >>> t = np.arange(100.0)[:, None]
    >>> bool(about_lines([3.0 * t])[0] < 1e-20), about_lines([3.0 * t + (-1.0) ** t], 50).round(2).tolist()
    (True, [1.0])
    """
    total, count = np.zeros(records[0].shape[1]), 0
    for y in records:
        length = len(y) if samples is None else min(len(y), samples)
        line = np.vander(np.arange(length, dtype=float), degree + 1, increasing=True)
        for first in range(0, len(y) - length + 1, length):
            part = y[first : first + length]
            left = part - line @ np.linalg.lstsq(line, part, rcond=None)[0]
            total += (left**2).sum(axis=0)
            count += length
    return np.asarray(total / max(count, 1))
