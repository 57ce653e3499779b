"""The start of a record cut from a running plant with a dead time: what acted before its first row is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.signals import Dataset, FloatArray, Run, Trajectory


def with_known_starts(dataset: Dataset) -> Dataset:
    """Return the data set with the readings left out that inputs before a record still decide, and say so.

    A plant at rest is no exception: its input was 0, or what holds it there, and not what stands in the first row.

    Notes
    -----
    The initial state is fitted, so a plant without dead time has no such readings.
    """
    if not dataset.spec.nu:
        return dataset
    dead = max(dead_times(dataset.estimation), default=0)
    if dead < 2:  # one sample is that of a held input
        return dataset
    runs = tuple(_cut(run, dead) for run in dataset)
    note = (
        f"a dead time of about {dead} samples: what the inputs were before a record is unknown, and its first {dead} "
        "readings count as missing"
    )
    return replace(dataset, runs=runs, warnings=(*dataset.warnings, note))


def dead_times(records: Sequence[Trajectory]) -> tuple[int, ...]:
    """Return for every input after how many samples the outputs answer, by least squares over dead times.

    An ARX model of a few lags beside every dead time of one input, the others without, is fitted to all outputs. The
    one with the least loss counts among those whose loss is clearly less than without dead time (Ljung 1999, sec. 4.2
    and 16.4) and beside which later inputs tell nothing, by Schwarz' criterion (ibid., sec. 16.4): a mode that the
    model has no lags for wants inputs of long ago too, and those of just now all the same. The input of the same row is
    among these: where it acts at once and comes in steps of even length, the step before foretells it.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.normal(size=400), np.zeros(400)
    >>> for k in range(8, 400):
    ...     y[k] = 0.8 * y[k - 1] + u[k - 8]
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> dead_times([Trajectory(np.arange(400.0), u[:, None], y[:, None], spec)])
    (8,)
    """
    spec, lags = records[0].spec, DATA_POLICY.dead_lags
    most = min(DATA_POLICY.longest_dead, min(map(len, records)) // 10)
    rows = [np.arange(most + lags, len(record)) for record in records]
    target = np.concatenate([record.y[k] for record, k in zip(records, rows, strict=True)])
    past = np.concatenate(
        [
            np.hstack([np.ones((len(k), 1)), *(record.y[k - lag] for lag in range(1, lags + 1))])
            for record, k in zip(records, rows, strict=True)
        ]
    )

    def inputs(column: int, dead: int) -> FloatArray:
        parts = [
            np.stack([record.u[k - dead - lag, column] for lag in range(lags)], axis=1)
            for record, k in zip(records, rows, strict=True)
        ]
        return np.concatenate(parts)

    size = np.where(target.std(axis=0) > 0, target.std(axis=0), 1.0)
    found = []
    for column in range(spec.nu):
        others = [inputs(other, 0) for other in range(spec.nu) if other != column]
        known, _ = np.linalg.qr(np.hstack([past, *others]))
        left = (target - known @ (known.T @ target)) / size

        def loss(own: FloatArray, known: FloatArray = known, left: FloatArray = left) -> float:
            own = own - known @ (known.T @ own)
            return float(np.sum((left - own @ np.linalg.lstsq(own, left, rcond=None)[0]) ** 2))

        soon = np.hstack([inputs(column, 0), inputs(column, 1)[:, -1:]])
        losses = {dead: loss(inputs(column, dead)) for dead in range(most + 1)}
        clear = [dead for dead in losses if losses[dead] < DATA_POLICY.clearer * min(losses[0], losses[1])]
        dearer = len(target) ** (-lags / len(target))  # what the later inputs have to bring the loss down by
        alone = (
            dead for dead in sorted(clear, key=losses.__getitem__)
            if loss(np.hstack([inputs(column, dead), soon])) >= dearer * losses[dead]
        )  # fmt: skip
        found.append(next(alone, 1))
    return tuple(found)


def _cut(run: Run, dead: int) -> Run:
    """Return a run whose first readings are missing; itself where hardly more would be left."""
    record = run.trajectory
    if len(record) <= 2 * dead:
        return run
    missing = record.missing.copy() if record.missing is not None else np.zeros(record.y.shape, dtype=bool)
    missing[:dead] = True
    return replace(run, trajectory=replace(record, missing=missing))
