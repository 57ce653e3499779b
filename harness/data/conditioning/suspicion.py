"""Suspicions that take more than one column: input and output swapped, runs in other units than their siblings."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from harness.signals import FloatArray, Run, Trajectory

_LAGS = 6
_MOST = 4000
_DECIMATIONS = (1, 3, 10)
_ROWS = (
    200  # Fewer tell too little: of 24 stretches of 100 or 120 rows in open loop 3 were called swapped, of 150 none.
)
_FOLLOWS = 1.25
# Measured on the recordings and on a pendulum in open and closed loop, three noise levels: the larger gain of the right
# order was 1.12 to 8.4 (below 1.25 only for the coupled drives), that of the wrong one at most 1.16.


def swapped_in_and_out(trajectory: Trajectory, besides: Collection[int] = ()) -> list[str]:
    """Say so if the "input" follows the "output", and never the other way round.

    One-step predictions of each from its own past, with and without the past of the other (Granger, Econometrica
    37:424, 1969). In open loop only the output gains; in closed loop both do; if only the input gains, the columns are
    probably swapped. ``besides`` are outputs known to be right: a rate that is the derivative of its position is no
    input, and torques of an arm under feedback follow it.

    Examples
    --------
    >>> import numpy as np
    >>> from harness.signals import Channel, PlantSpec, Trajectory
    >>> u = np.random.default_rng(0).normal(size=(400, 1))
    >>> y = np.vstack([[[0.0]], np.cumsum(u, axis=0)[:-1] * 0.1])
    >>> spec = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.1)
    >>> swapped_in_and_out(Trajectory(np.arange(400) * 0.1, u, y, spec))
    []
    >>> len(swapped_in_and_out(Trajectory(np.arange(400) * 0.1, y, u, spec)))
    1
    """
    n = len(trajectory)
    if n < _ROWS or not trajectory.spec.nu:
        return []
    u, y = trajectory.u[:_MOST], trajectory.y[:_MOST]
    with np.errstate(over="ignore", invalid="ignore"):  # of a damaged row, which is said elsewhere
        spread = [float(column.std()) for column in (*u.T, *y.T)]
    if not (np.isfinite(spread).all() and all(spread)):
        return []
    notes = []
    for i, source in enumerate(trajectory.spec.inputs):
        for j, sink in enumerate(trajectory.spec.outputs):
            if j in besides:
                continue
            forward = [_gain(y[::d, j], u[::d, i]) for d in _DECIMATIONS if n >= 50 * d]
            backward = [_gain(u[::d, i], y[::d, j]) for d in _DECIMATIONS if n >= 50 * d]
            clear = any(b > _FOLLOWS and f < 0.85 * b for f, b in zip(forward, backward, strict=True))
            if clear and max(forward) < _FOLLOWS:
                notes.append(
                    f"{source.name} follows {sink.name}, and {sink.name} does not follow {source.name}: are the "
                    "columns of input and output swapped?"
                )
    return notes


def _gain(target: FloatArray, other: FloatArray) -> float:
    """Return by what factor the past of another signal shrinks the one-step prediction error of a signal."""
    if not np.ptp(target) or not np.ptp(other):  # perhaps only at the rows that are left
        return 1.0

    def lagged(values: FloatArray) -> FloatArray:
        scaled = (values - values.mean()) / values.std()
        return np.column_stack([scaled[_LAGS - lag : len(scaled) - lag] for lag in range(1, _LAGS + 1)])

    goal = ((target - target.mean()) / target.std())[_LAGS:]
    # of the triangular factor's last column: what the signal's own past leaves, and at its end what both pasts leave
    factor = np.asarray(np.linalg.qr(np.column_stack([lagged(target), lagged(other), goal]), mode="r"))
    left = factor[_LAGS:, -1]
    alone = float(np.linalg.norm(left)) / np.sqrt(len(goal))
    if alone < 1e-9:  # predicted perfectly by itself: says nothing
        return 1.0
    return float(alone / max(abs(left[-1]) / np.sqrt(len(goal)), 1e-12))


def units_between_runs(runs: Sequence[Run], records: Sequence[int] = ()) -> list[str]:
    """Say so if a signal is a thousand, or 57.3, times as large in one run as in the first.

    ``records`` tells which runs are pieces of one record: those share their units, however little one of them moves.
    """
    notes = []
    for kind, _, name, sizes in _sizes(runs, records):
        for number, size in enumerate(sizes[1:], start=1):
            if not sizes[0] or not size:
                continue
            ratio = size / sizes[0]
            for factor, text in ((1000.0, "a unit wrong by 1000"), (180.0 / np.pi, "degrees for radians")):
                if any(abs(ratio / f - 1.0) < 0.3 for f in (factor, 1.0 / factor)):
                    notes.append(f"{kind} {name} moves {ratio:.3g} times as much in run {number} as in run 0: {text}?")
                    break
    return notes


def swapped_runs(runs: Sequence[Run], records: Sequence[int] = ()) -> list[str]:
    """Say so if two signals seem to have changed places from the first run to another (pieces as above)."""
    table = _sizes(runs, records)
    notes = []
    for a in range(len(table)):
        for b in range(a + 1, len(table)):
            (_, _, name_a, sizes_a), (_, _, name_b, sizes_b) = table[a], table[b]
            for number in range(1, len(sizes_a)):
                here = (sizes_a[0], sizes_b[0], sizes_a[number], sizes_b[number])
                if min(here) <= 0 or not 0.1 > min(here[0] / here[1], here[1] / here[0]):
                    continue
                if all(0.5 < ratio < 2.0 for ratio in (here[2] / here[1], here[3] / here[0])):
                    notes.append(
                        f"{name_a} and {name_b} have changed sizes in run {number}: are their columns swapped?"
                    )
    return notes


def _sizes(runs: Sequence[Run], records: Sequence[int]) -> list[tuple[str, int, str, list[float]]]:
    """Return the standard deviation of every signal in every run, or in all pieces of every record."""
    spec = runs[0].trajectory.spec
    of = np.array(records or range(len(runs)))
    groups = [np.flatnonzero(of == number) for number in np.unique(of)]
    table = []
    for kind, channels in (("input", spec.inputs), ("output", spec.outputs)):
        for column, channel in enumerate(channels):
            values = [(run.trajectory.u if kind == "input" else run.trajectory.y)[:, column] for run in runs]
            with np.errstate(over="ignore", invalid="ignore"):  # of a damaged row, which is said elsewhere
                sizes = [float(np.std(np.concatenate([values[k] for k in group]))) for group in groups]
            sizes = [size if np.isfinite(size) else 0.0 for size in sizes]
            table.append((kind, column, channel.name, sizes))
    return table
