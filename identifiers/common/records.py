"""What every identifier asks of the records it is given, refused in words where it is missing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.normal import NormalEquations

SEAMS = "equations with a missing reading are left out"  # What most fits do about missing readings.

# Numbers of a block of regressors: 0.8 MB, which stays in a processor's second-level cache.
_CACHE = 100_000


def usable(
    trajectories: Sequence[Trajectory], *, samples: int, what: str, holes: Literal["seams", "kept"] = "seams"
) -> tuple[list[Trajectory], PlantSpec]:
    """Return the records long enough to be used, and their common spec.

    What stands where a reading is missing is never taken for one: a hole ends a record. Raises FitError if there is no
    record of that length, or the records speak different languages.

    - ``samples``: least number of samples of a record; shorter ones are left out
    - ``what``: name of the identifier, for messages
    - ``holes`` {"seams", "kept"}: ``"kept"`` for a fit that passes over missing readings itself
    """
    if not trajectories:
        raise FitError(f"{what}: no records", expected="at least one", got="none", remedy="give estimation data")
    spec = trajectories[0].spec
    for number, record in enumerate(trajectories):
        if record.spec != spec:
            raise FitError(
                f"{what}: record {number} speaks another language than record 0",
                expected=str(spec),
                got=str(record.spec),
                remedy="fit records of one plant at one sample time",
            )
    long_enough = [record.measured() for record in trajectories if len(record) >= samples]
    if not long_enough:
        raise FitError(
            f"{what}: records too short",
            expected=f"at least {samples} samples in one uninterrupted record",
            got=f"{max(map(len, trajectories))}",
            remedy="record longer, or lower the order",
        )
    return long_enough if holes == "kept" else without_holes(long_enough, samples=samples, what=what), spec


def learnable(
    trajectories: Sequence[Trajectory],
    *,
    samples: int,
    what: str,
    inputs: bool = True,
    holes: Literal["seams", "kept"] = "seams",
) -> tuple[list[Trajectory], PlantSpec]:
    """Return :func:`usable` records of :func:`real_signals` that are :func:`moving`, and their common spec.

    Raises FitError if there are none.
    """
    records, spec = usable(trajectories, samples=samples, what=what, holes=holes)
    real_signals(spec, what)
    moving(records, what, inputs=inputs)
    return records, spec


def without_holes(trajectories: Sequence[Trajectory], *, samples: int, what: str) -> list[Trajectory]:
    """Return the stretches of the records in which every output was read, each a record of its own.

    For fits to windows of all signals: a window with a missing reading is no equation, and a hole is a seam. Raises
    FitError if no stretch is so long.

    - ``trajectories``: what stands where a reading is missing is not looked at
    - ``samples``: least number of samples of a stretch
    - ``what``: name of the identifier, for messages

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> hole = np.arange(6)[:, None] == 2
    >>> whole = Trajectory(np.arange(6.0), np.ones((6, 1)), np.ones((6, 1)), spec, missing=hole)
    >>> [len(part) for part in without_holes([whole], samples=2, what="example")]
    [2, 3]
    """
    parts: list[Trajectory] = []
    for record in trajectories:
        if record.missing is None:
            parts.append(record)
            continue
        read = np.concatenate([[False], ~record.missing.any(axis=1), [False]]).astype(int)
        edges = np.flatnonzero(np.diff(read))
        parts += [record[int(low) : int(high)] for low, high in zip(edges[::2], edges[1::2], strict=True)]
    long_enough = [part for part in parts if len(part) >= samples]
    if not long_enough:
        raise FitError(
            f"{what}: no stretch without a missing reading is long enough",
            expected=f"at least {samples} samples in a row with all outputs read",
            got=f"{max(map(len, parts), default=0)}",
            remedy="lower the order, leave out an output that is seldom read, bring a record that was resampled to "
            "more samples than it has readings onto a coarser grid ([resample] sample_time), or use prediction-error",
        )
    return long_enough


def filled(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the records with a straight line between the readings where one is missing, still marked as missing.

    For whatever only scales, starts or judges; a fit passes over what is marked.
    """
    found = []
    for record in trajectories:
        if record.missing is None:
            found.append(record)
            continue
        y, k = record.y.copy(), np.arange(len(record))
        for column, gone in enumerate(record.missing.T):
            if gone.any():
                y[gone, column] = np.interp(k[gone], k[~gone], y[~gone, column]) if not gone.all() else 0.0
        found.append(replace(record, y=y))
    return found


def missing_notes(
    trajectories: Sequence[Trajectory], used: Sequence[Trajectory] | None = None, how: str = SEAMS
) -> dict[str, Any]:
    """Return the notes of a model on missing readings; empty where none is.

    - ``trajectories``: as they were given
    - ``used``: stretches that were used, where not all samples were
    - ``how``: what the fit did about them
    """
    gone = sum(0 if record.missing is None else int(record.missing.sum()) for record in trajectories)
    if not gone:
        return {}
    said: dict[str, Any] = {"readings": gone, "how": how}
    if used is not None:
        said["samples_left_out"] = sum(map(len, trajectories)) - sum(map(len, used))
        said["stretches"] = len(used)
    return {"missing": said}


def real_signals(spec: PlantSpec, what: str) -> None:
    """Refuse category channels, whose numbers are only names.

    Raises FitError if an input or output is a category.
    """
    names = [channel.name for channel in (*spec.inputs, *spec.outputs) if channel.kind == "category"]
    if names:
        whole = len(names) == spec.nu + spec.ny
        counting = "mdp-counting" if spec.ny == 1 and spec.nu < 2 else "factored-counting"
        raise FitError(
            f"{what} cannot learn from categories",
            expected="real signals",
            got=f"category channels {', '.join(names)}",
            remedy=f"use {counting}, which counts transitions" if whole else "leave these channels out",
        )


def moving(trajectories: Sequence[Trajectory], what: str, *, inputs: bool = True) -> None:
    """Refuse records in which no output moves, or an input never does.

    Raises FitError if there is nothing to learn from.
    """
    if not _moved([record.y for record in trajectories]).any():
        raise FitError(
            f"{what}: the outputs never move", expected="moving outputs", got="constants", remedy="excite the plant"
        )
    if not inputs or trajectories[0].spec.nu == 0:
        return
    moved = _moved([record.u for record in trajectories])
    still = [channel.name for channel, moves in zip(trajectories[0].spec.inputs, moved, strict=True) if not moves]
    if still:
        raise FitError(
            f"{what}: an input never moves",
            expected="exciting inputs",
            got=f"constant {', '.join(still)}",
            remedy="excite every input, or leave it out",
        )


def _moved(parts: Sequence[FloatArray]) -> npt.NDArray[np.bool_]:
    """Return which columns ever differ from their first row; reads no further than it must."""
    first = parts[0][0]
    moved = np.zeros(first.shape, dtype=bool)
    for part in parts:
        for start in range(0, len(part), 4096):
            moved |= (part[start : start + 4096] != first).any(axis=0)
            if moved.all():
                return moved
    return moved


def lagged(trajectory: Trajectory, lags: int) -> FloatArray:
    """Return the rows ``[y[k], ..., y[k - lags + 1], u[k], ..., u[k - lags + 1]]`` for k = lags - 1 .. N - 2.

    - ``trajectory``: one record: no row reaches across a seam
    - ``lags``: at least 1
    - returns array (N - lags, lags * (ny + nu)): row i belongs to the next output ``y[lags + i]``

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> lagged(Trajectory(np.arange(4.0), np.ones((4, 1)), np.arange(4.0)[:, None], spec), 2).tolist()
    [[1.0, 0.0, 1.0, 1.0], [2.0, 1.0, 1.0, 1.0]]
    """
    return _rows(trajectory, lags, 0, len(trajectory) - lags, ())


def recent(past: FloatArray, lags: int, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return ``[y[k], ..., y[k - lags + 1], u[k - 1], ..., u[k - lags + 1]]`` of every sample, begun with a past.

    - ``past`` (p,): the same at the first sample, whose own output is not looked at
    - ``u, y`` (N, nu), (N, ny)
    - returns array (N, p)

    Examples
    --------
    >>> recent(np.array([0.0, 7, 8]), 2, np.array([[1.0], [2]]), np.array([[3.0], [4]])).tolist()
    [[3.0, 7.0, 8.0], [4.0, 3.0, 1.0]]
    """
    n, ny, nu = len(y), y.shape[1], u.shape[1]
    y = np.concatenate([past[ny : lags * ny].reshape(lags - 1, ny)[::-1], y])
    u = np.concatenate([past[lags * ny :].reshape(lags - 1, nu)[::-1], u[:-1]])
    starts = range(lags - 1, -1, -1)
    return np.hstack([*(y[k : k + n] for k in starts), *(u[k : k + n] for k in starts[1:])])


def lagged_blocks(
    trajectories: Sequence[Trajectory],
    lags: int,
    *,
    offset: bool = False,
    direct: bool = False,
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield regressors and next outputs of one-step equations in blocks, so that memory stays bounded.

    - ``trajectories``: no row reaches across a seam
    - ``lags``: as of :func:`lagged`
    - ``offset``: with a last column of ones
    - ``direct``: with the inputs of the instant that is predicted, after the lags

    - yields (array (n, p), array (n, ny))
    """
    spec = trajectories[0].spec
    size = max(256, _CACHE // max(1, lags * (spec.ny + spec.nu)))
    for record in trajectories:
        for start in range(0, len(record) - lags, size):
            stop = min(start + size, len(record) - lags)
            extra: list[FloatArray] = [record.u[start + lags : stop + lags]] if direct else []
            if offset:
                extra.append(np.ones((stop - start, 1)))
            yield _rows(record, lags, start, stop, extra), record.y[start + lags : stop + lags]


def snapshot_sums(trajectories: Sequence[Trajectory], *, offset: bool = False) -> NormalEquations:
    """Return the sums of ``y[k+1] = theta' [y[k], u[k], 1]``, whose rows need not be put together.

    - ``trajectories``: no pair reaches across a seam
    - ``offset``: with a last column of ones

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> one = Trajectory(np.arange(3.0), np.ones((3, 1)), np.array([[1.0], [2.0], [4.0]]), spec)
    >>> sums = snapshot_sums([one])
    >>> sums.gram.tolist(), sums.right.tolist(), sums.square.tolist(), sums.rows
    ([[5.0, 3.0], [3.0, 2.0]], [[10.0], [6.0]], [20.0], 2)
    """
    spec = trajectories[0].spec
    ny, nu = spec.ny, spec.nu
    p = ny + nu + int(offset)
    gram, right, square, rows = np.zeros((p, p)), np.zeros((p, ny)), np.zeros(ny), 0
    states, inputs = slice(0, ny), slice(ny, ny + nu)
    size = max(256, _CACHE // (ny + nu))
    for record in trajectories:
        own = np.zeros((ny, ny))
        for start in range(0, len(record) - 1, size):
            stop = min(start + size, len(record) - 1)
            y, u, after = record.y[start:stop], record.u[start:stop], record.y[start + 1 : stop + 1]
            own += y.T @ y
            gram[states, inputs] += y.T @ u
            gram[inputs, inputs] += u.T @ u
            right[states] += y.T @ after
            right[inputs] += u.T @ after
            if offset:
                gram[states, -1] += y.sum(axis=0)
                gram[inputs, -1] += u.sum(axis=0)
                right[-1] += after.sum(axis=0)
        gram[states, states] += own
        square += _moved_squares(np.diag(own), record.y)
        rows += max(0, len(record) - 1)
    gram[inputs, states] = gram[states, inputs].T
    if offset:
        gram[-1, :-1] = gram[:-1, -1]
        gram[-1, -1] = rows
    return NormalEquations(gram, right, square, rows)


def _moved_squares(before: FloatArray, y: FloatArray) -> FloatArray:
    """Return the sums of squares of all outputs but the first, from those of all but the last."""
    if not len(y):
        return np.zeros_like(before)
    moved: FloatArray = before - y[0] ** 2 + y[-1] ** 2
    # a record that falls from a large start: the difference would be rounding
    poor = moved < 1e-3 * before
    moved[poor] = np.einsum("ij,ij->j", y[1:, poor], y[1:, poor])
    return moved


def _rows(record: Trajectory, lags: int, start: int, stop: int, extra: Sequence[FloatArray]) -> FloatArray:
    """Return rows start .. stop - 1 of the regressors, filled column by column into one array."""
    ny, nu = record.spec.ny, record.spec.nu
    width = lags * (ny + nu) + sum(part.shape[1] for part in extra)
    rows = np.empty((stop - start, width))
    for j in range(lags):
        past = slice(start + lags - 1 - j, stop + lags - 1 - j)
        rows[:, j * ny : (j + 1) * ny] = record.y[past]
        rows[:, lags * ny + j * nu : lags * ny + (j + 1) * nu] = record.u[past]
    column = lags * (ny + nu)
    for part in extra:
        rows[:, column : column + part.shape[1]] = part
        column += part.shape[1]
    return rows
