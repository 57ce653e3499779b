"""What every identifier asks of the records it is given, refused in words where it is missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory

__all__ = ["lagged", "moving", "real_signals", "usable"]


def usable(trajectories: Sequence[Trajectory], *, samples: int, what: str) -> tuple[list[Trajectory], PlantSpec]:
    """Return the records long enough to be used, and their common spec.

    Parameters
    ----------
    trajectories : sequence of Trajectory
    samples : int
        Least number of samples of a record; shorter ones are left out.
    what : str
        Name of the identifier, for messages.

    Raises
    ------
    FitError
        If there is no record of that length, or the records speak different languages.
    """
    if not trajectories:
        raise FitError(f"{what}: no records", expected="at least one", got="none", remedy="give estimation data")
    spec = trajectories[0].spec
    for number, one in enumerate(trajectories):
        if one.spec != spec:
            raise FitError(
                f"{what}: record {number} speaks another language than record 0",
                expected=str(spec),
                got=str(one.spec),
                remedy="fit records of one plant at one sample time",
            )
    long_enough = [one.measured() for one in trajectories if len(one) >= samples]
    if not long_enough:
        raise FitError(
            f"{what}: records too short",
            expected=f"at least {samples} samples in one uninterrupted record",
            got=f"{max(map(len, trajectories))}",
            remedy="record longer, or lower the order",
        )
    return long_enough, spec


def real_signals(spec: PlantSpec, what: str) -> None:
    """Refuse category channels, whose numbers are only names.

    Raises
    ------
    FitError
        If an input or output is a category.
    """
    names = [channel.name for channel in (*spec.inputs, *spec.outputs) if channel.kind == "category"]
    if names:
        raise FitError(
            f"{what} cannot learn from categories",
            expected="real signals",
            got=f"category channels {', '.join(names)}",
            remedy="use mdp-counting for finite processes",
        )


def moving(trajectories: Sequence[Trajectory], what: str, *, inputs: bool = True) -> None:
    """Refuse records in which no output moves, or an input never does.

    Raises
    ------
    FitError
        If there is nothing to learn from.
    """
    y = np.concatenate([one.y for one in trajectories])
    if np.all(np.ptp(y, axis=0) == 0.0):
        raise FitError(
            f"{what}: the outputs never move", expected="moving outputs", got="constants", remedy="excite the plant"
        )
    if not inputs or trajectories[0].spec.nu == 0:
        return
    u = np.concatenate([one.u for one in trajectories])
    still = [c.name for c, span in zip(trajectories[0].spec.inputs, np.ptp(u, axis=0), strict=True) if span == 0.0]
    if still:
        raise FitError(
            f"{what}: an input never moves",
            expected="exciting inputs",
            got=f"constant {', '.join(still)}",
            remedy="excite every input, or leave it out",
        )


def lagged(trajectory: Trajectory, lags: int) -> FloatArray:
    """Return the rows ``[y[k], ..., y[k - lags + 1], u[k], ..., u[k - lags + 1]]`` for k = lags - 1 .. N - 2.

    Parameters
    ----------
    trajectory : Trajectory
        One record: no row reaches across a seam.
    lags : int
        At least 1.

    Returns
    -------
    array (N - lags, lags * (ny + nu))
        Row i belongs to the next output ``y[lags + i]``.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> lagged(Trajectory(np.arange(4.0), np.ones((4, 1)), np.arange(4.0)[:, None], spec), 2).tolist()
    [[1.0, 0.0, 1.0, 1.0], [2.0, 1.0, 1.0, 1.0]]
    """
    n = len(trajectory)
    parts = [trajectory.y[lags - 1 - j : n - 1 - j] for j in range(lags)]
    parts += [trajectory.u[lags - 1 - j : n - 1 - j] for j in range(lags)]
    return np.hstack(parts)
