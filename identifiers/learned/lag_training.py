"""One-step networks on lagged outputs and inputs, and their training: what an affine fit leaves, many at once."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from harness.rng import stream
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.bands import Bands, held_out_runs
from identifiers.common.judge.excited import Excited
from identifiers.common.lag_state import LagModel, Standardisation, regression_data
from identifiers.common.reach import Reach
from identifiers.learned.ensemble import Ensemble, own_spread
from identifiers.learned.training import Trained, need_torch, one_thread, train


@dataclass(frozen=True, eq=False)
class LagNetwork(LagModel):
    """The change of the output is an affine function of lagged outputs and inputs plus a network of them; abstract.

    A subclass says :meth:`change`, ``kind`` and how its tables are stored.
    """

    affine: FloatArray  # (p + 1, ny): In scaled numbers
    variance: FloatArray  # (ny,): Of the one-step error on held-out samples
    reach: Reach | None  # Where the data lie, in scaled rows: beyond them the variance grows

    @abstractmethod
    def change(self, x: FloatArray) -> FloatArray:
        """Return the scaled addition (..., ny) of the network at scaled rows (..., p)."""

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        x = self.scaling.rows(rows)
        change = self.change(x) + x @ self.affine[:-1] + self.affine[-1]
        mean = rows[..., : self.spec.ny] + self.scaling.y_mean + change * self.scaling.y_std
        variance = np.broadcast_to(self.variance, mean.shape)
        return mean, variance if self.reach is None else variance + self.reach.std(x) ** 2


M = TypeVar("M", bound=LagNetwork)
E = TypeVar("E", bound=Ensemble)

_RIDGE = 1e-8
"""Of the affine fit, relative to the number of rows: keeps it real where regressors depend on one another."""

_LEAST_STD = 1e-9
"""Standard deviation of a prediction, relative to the size of the output, that no model may claim to be below."""


@dataclass(frozen=True, eq=False)
class LagTask:
    """What a network learns: the part of the next output's change that an affine function of the rows leaves."""

    spec: PlantSpec
    order: int  # Lags
    scaling: Standardisation
    # (n, p), (n, ny): Scaled rows, and the leftover over its size
    x: FloatArray
    wanted: FloatArray
    # The same of the held-out last fifth of every record
    held_x: FloatArray
    held_wanted: FloatArray
    affine: FloatArray  # (p + 1, ny): In scaled numbers
    size: FloatArray  # (ny,): Of the leftover, in scaled numbers
    # Held-out rows and next outputs in their units
    kept: FloatArray
    kept_later: FloatArray
    records: Sequence[Trajectory]
    cuts: Sequence[int]  # First held-out sample of each

    def train(
        self,
        tables: Sequence[FloatArray],
        network: Callable[[Any, Sequence[Any], Any], Any],
        how: Trained,
        *,
        rng: np.random.Generator,
        what: str,
    ) -> tuple[list[FloatArray], list[list[float]]]:
        """Return the trained tables (members, ...) and the held-out losses.

        - ``tables`` sequence of array (members, ...)
        - ``network``: ``network(torch, tables, rows (members, n, p))`` returns (members, n, ny)
        - ``what``: name of the identifier
        """
        torch = need_torch(what)
        members = len(tables[0])
        with one_thread(torch):
            tensors = [torch.tensor(table, requires_grad=True) for table in tables]
            inside, wanted = torch.from_numpy(self.x), torch.from_numpy(self.wanted)
            held_inside = torch.from_numpy(self.held_x)[None].expand(members, -1, -1)
            held_wanted = torch.from_numpy(self.held_wanted)[None]

            def loss(index: Any) -> Any:
                return ((network(torch, tensors, inside[index]) - wanted[index]) ** 2).mean(dim=(1, 2)).sum()

            def held_out() -> Any:
                return ((network(torch, tensors, held_inside) - held_wanted) ** 2).mean(dim=(1, 2))

            history = train(torch, tensors, loss, held_out, len(self.x), how, rng=rng, members=members, title=what)
            return [tensor.detach().numpy() for tensor in tensors], history

    def banded(self, drafts: Sequence[M]) -> tuple[M, ...]:
        """Return the members with bands that hold on the held-out rows and widen beyond the data."""
        each = np.array([draft.ahead(self.kept)[0] for draft in drafts])
        spread = own_spread(self.kept_later - each.mean(axis=0), each.var(axis=0))
        variance = np.maximum(spread, _LEAST_STD * drafts[0].y_size) ** 2
        changes = [self.wanted, self.held_wanted]
        rows, left = np.vstack([self.x, self.held_x]), np.vstack(changes) * self.size * self.scaling.y_std
        reach = Reach.of(rows, left, rng=stream("reach"))
        return tuple(replace(draft, variance=variance, reach=reach) for draft in drafts)

    def far(self, ensemble: E, what: str) -> E:
        """Return the ensemble with bands that hold on held-out data also several steps ahead.

        - ``ensemble``: of members from :meth:`banded`
        - ``what``: name of the identifier
        """
        runs = held_out_runs(ensemble, self.records, self.cuts)
        if not runs:
            return ensemble
        bands = Bands.scaling(ensemble, runs, what)
        notes = {**ensemble.notes, "bands": bands.note(self.spec.sample_time)}
        return replace(ensemble, members=tuple(replace(m, bands=bands) for m in ensemble.members), notes=notes)


def lag_task(trajectories: Sequence[Trajectory], order: int, what: str, asks: Excited) -> LagTask:
    """Return the task that records pose; raises FitError if they cannot be learned from.

    - ``order``: past outputs and inputs
    - ``what``: name of the identifier, for messages
    """
    records, spec = asks.asked(trajectories, samples=max(10, 2 * order + 6), what=what)
    cuts = [len(record) - max(len(record) // 5, order + 2) for record in records]
    rows, later = regression_data([record[:cut] for record, cut in zip(records, cuts, strict=True)], order)
    kept, kept_later = regression_data([record[cut:] for record, cut in zip(records, cuts, strict=True)], order)
    scaling = Standardisation.of(rows, later - rows[:, : spec.ny])
    x, y = scaling.rows(rows), scaling.targets(later - rows[:, : spec.ny])
    held_x, held_y = scaling.rows(kept), scaling.targets(kept_later - kept[:, : spec.ny])
    design = np.hstack([x, np.ones((len(x), 1))])
    gram = design.T @ design + _RIDGE * len(x) * np.eye(design.shape[1])
    affine = np.asarray(np.linalg.solve(gram, design.T @ y), dtype=float)
    left, held_left = y - design @ affine, held_y - held_x @ affine[:-1] - affine[-1]
    size = np.maximum(left.std(axis=0), 1e-12)
    return LagTask(spec, order, scaling, x, left / size, held_x, held_left / size, affine, size, kept, kept_later,
                   records, cuts)  # fmt: skip
