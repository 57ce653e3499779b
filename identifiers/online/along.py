"""One pass of an online identifier over records, after which what it has learned is a model like any other."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_law
from harness.models.determined import KEY, determined_bands
from harness.protocols import OnlineIdentifier, Tracking
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.records import learnable, missing_notes

_ROUNDED = 1e-12  # Deviation over level of a signal that rests: what rounding leaves of a constant.


@dataclass(frozen=True, kw_only=True)
class OnePass(Excited, ABC):
    """Online identifier of linear models, which fits records by one pass over them."""

    called: ClassVar[str]  # Name of the identifier, for messages.

    @abstractmethod
    def waits(self, spec: PlantSpec) -> int:
        """Return how many samples have to be learned from, given the signals."""

    @abstractmethod
    def fitted(self, state: Any, records: list[Trajectory]) -> LinearModel:
        """Return the model of the state after records."""

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model after one pass over the records.

        Raises
        ------
        FitError
            If the records are shorter than what is waited for, or do not tell what the inputs do.
        """
        state, records = self.learned(trajectories, rng=rng)
        return told_of_pass(self.fitted(state, records), trajectories, records)

    def learned(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> tuple[Any, list[Trajectory]]:
        """Return what is known after records of real signals, in their order, and the records used.

        Raises
        ------
        FitError
            If there are fewer samples than are waited for, nothing moves, or a controller alone moves the inputs.
        """
        what, online = self.called, cast(OnlineIdentifier, self)
        records, spec = learnable(trajectories, samples=2, what=what)
        refuse_law(records, what, self.least_excitation)
        heard, samples = sum(len(record) - 1 for record in records), self.waits(spec)
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


class RunningLevel(NamedTuple):
    """About which levels signals (n,) move, and by how much, as they come (Welford 1962, *Technometrics* 4:419).

    Examples
    --------
    >>> standing = RunningLevel.blank(2)
    >>> for values in ([299.0, 0.0], [301.0, 0.0]):
    ...     standing = standing.heard(np.array(values))
    >>> standing.relative(np.array([302.0, 0.0])).tolist(), standing.size.tolist()
    ([2.0, 0.0], [1.0, 1.0])
    """

    level: FloatArray
    squares: FloatArray
    samples: int

    @classmethod
    def blank(cls, n: int) -> RunningLevel:
        """Return what is known of n signals before any sample."""
        return cls(np.zeros(n), np.zeros(n), 0)

    def heard(self, values: FloatArray) -> RunningLevel:
        """Return what is known after a further sample (n,)."""
        away = values - self.level
        level = self.level + away / (self.samples + 1)
        return RunningLevel(level, self.squares + away * (values - level), self.samples + 1)

    @property
    def size(self) -> FloatArray:
        """Deviation (n,) about the level; of a signal that rests its level, and 1 if that is nought too."""
        found = np.sqrt(self.squares / max(self.samples, 1))
        rests = found <= _ROUNDED * np.abs(self.level)
        return np.where(rests, np.where(self.level != 0, np.abs(self.level), 1.0), found)

    def relative(self, values: FloatArray) -> FloatArray:
        """Return values (..., n) about the level, in sizes."""
        found: FloatArray = (values - self.level) / self.size
        return found
