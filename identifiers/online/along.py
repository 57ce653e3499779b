"""One pass of an online identifier over records, after which what it has learned is a model like any other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_law
from harness.models.determined import KEY, determined_bands
from harness.protocols import OnlineIdentifier, Tracking
from harness.signals import PlantSpec, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.records import missing_notes, moving, real_signals, usable

__all__ = ["along", "learned", "told_of_pass"]


def learned(
    online: OnlineIdentifier,
    trajectories: Sequence[Trajectory],
    what: str,
    *,
    rng: np.random.Generator,
    least: Callable[[PlantSpec], int],
) -> tuple[Any, list[Trajectory]]:
    """Return what an online identifier knows after records of real signals, in their order, and the records used.

    Parameters
    ----------
    online : OnlineIdentifier
        With ``least_excitation``, as of ``least-squares``.
    trajectories : sequence of Trajectory
        A hole ends a record.
    what : str
        Name of the identifier, for messages.
    rng : numpy.random.Generator
    least : callable
        Samples that have to be learned from, given the signals.

    Raises
    ------
    FitError
        If there are fewer samples, nothing moves, or a controller alone moves the inputs.
    """
    records, spec = usable(trajectories, samples=2, what=what)
    real_signals(spec, what)
    moving(records, what)
    refuse_law(records, what, online.least_excitation)  # type: ignore[attr-defined]
    heard, samples = sum(len(record) - 1 for record in records), least(spec)
    if heard < samples:
        raise FitError(
            f"{what}: records too short",
            expected=f"at least {samples} samples to learn from",
            got=str(heard),
            remedy="record longer, or lower the order or burn_in",
        )
    return along(online, online.init(spec, rng=rng), records), records


def along(online: OnlineIdentifier, state: Any, records: Sequence[Trajectory]) -> Any:
    """Return the state of an online identifier after records.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> from identifiers.online.rls import RecursiveLeastSquares
    >>> spec, u = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.array([[1.0], [-1.0], [2.0], [0.0]])
    >>> record = Trajectory(np.arange(4.0), u, np.array([[0.0], [2.0], [-1.0], [3.5]]), spec)
    >>> online = RecursiveLeastSquares(order=1, offset=False, burn_in=2)
    >>> along(online, online.init(spec, rng=np.random.default_rng(0)), [record]).coefficients.ravel().round(6)
    array([0.5, 2. ])
    """
    for record in records:
        state = online.start(state, record.y[0])
        if isinstance(online, Tracking):
            state = online.track(state, record.u[:-1], record.y[1:])[1]
            continue
        for u, y in zip(record.u[:-1], record.y[1:], strict=True):
            state = online.update(state, u, y)
    return state


def told_of_pass(model: LinearModel, trajectories: Sequence[Trajectory], records: Sequence[Trajectory]) -> LinearModel:
    """Return a model whose notes say how it came to be, and at which frequencies the records determine it."""
    notes = {
        **model.notes,
        "samples": sum(len(record) - 1 for record in records),
        **missing_notes(trajectories, records),
        KEY: determined_bands(model.matrices, records),
    }
    return replace(model, notes=notes)
