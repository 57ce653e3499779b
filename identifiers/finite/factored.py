"""Factored finite processes: each output's next category depends on a few outputs and inputs, found by counting."""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.models.distributions import Categories
from harness.scoring import same_language
from harness.signals import SAY_CATEGORIES, Channel, FloatArray, PlantSpec, Trajectory
from identifiers.common.described import Described
from identifiers.common.records import usable


@dataclass(frozen=True, eq=False)
class Factor:
    """How one output moves."""

    parents: tuple[int, ...]  # Numbers of the channels it depends on, outputs first, then inputs
    table: FloatArray  # (K_parent, ..., K): Probability of the next category, given those of the parents in order
    visits: FloatArray  # (K_parent, ...): Samples behind each row; unvisited rows are the prior (uniform)


@dataclass(frozen=True, eq=False)
class FactoredModel(Described):
    """A finite process of several factors; the state of the model is the distribution of every factor, side by side.

    One step from a measured state is exact. Over several steps the factors are taken as independent at every step
    (the projection of Boyen and Koller 1998, *UAI*, on single factors).

    Parameters
    ----------
    spec : PlantSpec
        Category channels only.
    factors : tuple of Factor
        One for each output.
    """

    spec: PlantSpec
    factors: tuple[Factor, ...]
    kind = "factored"
    burn_in: ClassVar[int] = 0
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def parents(self) -> dict[str, tuple[str, ...]]:
        """Names of the channels that each output depends on."""
        names = [channel.name for channel in (*self.spec.outputs, *self.spec.inputs)]
        return {
            channel.name: tuple(names[i] for i in factor.parents)
            for channel, factor in zip(self.spec.outputs, self.factors, strict=True)
        }

    @property
    def findings(self) -> tuple[str, ...]:
        """What each output depends on, and how many of its rows were never seen."""
        said = []
        for (name, parents), factor in zip(self.parents.items(), self.factors, strict=True):
            never = int((factor.visits == 0).sum())
            rows = f", {never} of {factor.visits.size} rows never seen" if never else ""
            said.append(f"{name} depends on {', '.join(parents) or 'nothing'}{rows}")
        return tuple(said)

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the distributions (nx,) that are certain of the first outputs."""
        same_language(self.spec, data)
        return self._certain(data.y[0])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the most probable category of each factor (..., ny)."""
        return np.stack([np.argmax(part, axis=-1) for part in self._parts(x)], axis=-1).astype(float)

    def predictive(self, x: FloatArray, u: FloatArray) -> Categories:
        """Return the distribution of each factor."""
        return Categories(tuple(self._parts(x)))

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the distributions (..., nx) one step later."""
        parts = self._parts(np.asarray(x, dtype=float))
        lead = parts[0].shape[:-1]
        inputs = np.broadcast_to(u, (*lead, self.spec.nu)).astype(np.intp)
        parts += [np.eye(c.categories)[inputs[..., i]] for i, c in enumerate(self.spec.inputs)]
        new = []
        for factor in self.factors:
            letters = string.ascii_letters[: len(factor.parents)]
            subscripts = ",".join([f"{letters}Z", *(f"...{letter}" for letter in letters)])
            row = np.einsum(f"{subscripts}->...Z", factor.table, *(parts[i] for i in factor.parents))
            new.append(np.broadcast_to(row, (*lead, row.shape[-1])))
        return np.concatenate(new, axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the distributions (..., nx) that are certain of the outputs just seen."""
        return self._certain(np.broadcast_to(y, (*np.shape(x)[:-1], self.spec.ny)))

    def _parts(self, x: FloatArray) -> list[FloatArray]:
        """Return the distribution of each factor."""
        cuts = np.cumsum([channel.categories for channel in self.spec.outputs])[:-1]
        return list(np.split(np.asarray(x, dtype=float), cuts, axis=-1))

    def _certain(self, y: FloatArray) -> FloatArray:
        parts = [np.eye(c.categories)[np.asarray(y)[..., i].astype(np.intp)] for i, c in enumerate(self.spec.outputs)]
        return np.concatenate(parts, axis=-1)


@dataclass(frozen=True)
class FactoredCounting:
    """Transition probabilities of a process with several category outputs, and what each output depends on.

    The parents of an output are those given, or are added one by one as long as one lowers the Bayesian information
    criterion (Schwarz 1978, *Ann. Stat.* 6) of its table.

    Parameters
    ----------
    parents : mapping, optional
        Names of outputs and inputs that an output depends on, by output name.
    prior : float
        Pseudo-counts for each next category, for the table only.
    most : int
        Parents at most; a table grows by a factor with each.

    Examples
    --------
    >>> coin = dict(kind="category", minimum=0, maximum=1)
    >>> spec = PlantSpec((), (Channel("a", **coin), Channel("b", **coin)), 1.0)
    >>> a = np.random.default_rng(0).integers(2, size=200)
    >>> y = np.column_stack([a, np.roll(a, 1)]).astype(float)  # b repeats what a was
    >>> model = FactoredCounting().fit([Trajectory(np.arange(200.0), np.zeros((200, 0)), y, spec)],
    ...                                rng=np.random.default_rng(0))
    >>> model.parents
    {'a': (), 'b': ('a',)}
    """

    parents: Mapping[str, Sequence[str]] | None = None
    prior: float = 0.0
    most: int = 4

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> FactoredModel:
        """Return the model; unvisited rows are counted in its notes."""
        what = "factored-counting"
        records, spec = usable(trajectories, samples=2, what=what, holes="kept")
        channels = (*spec.outputs, *spec.inputs)
        if any(channel.kind != "category" or not np.isfinite(channel.maximum) for channel in channels):
            raise FitError(
                f"{what} needs finite processes",
                expected="category outputs and inputs",
                got=str(spec),
                remedy=SAY_CATEGORIES,
            )
        now = np.concatenate([np.hstack([record.y[:-1], record.u[:-1]]) for record in records]).astype(np.intp)
        later = np.concatenate([record.y[1:] for record in records]).astype(np.intp)
        sizes = [channel.categories for channel in channels]
        factors = []
        for i, channel in enumerate(spec.outputs):
            chosen = self._given(channel, channels) if self.parents else self._found(now, later[:, i], sizes, i)
            counts = _counts(now, later[:, i], sizes, chosen, sizes[i])
            visits = counts.sum(axis=-1)
            weights = counts + self.prior
            total = weights.sum(axis=-1, keepdims=True)
            table = np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / sizes[i])
            factors.append(Factor(chosen, table, visits))
        model = FactoredModel(spec, tuple(factors))
        notes = {
            "parents": {name: list(names) for name, names in model.parents.items()},
            "unvisited": {c.name: int((f.visits == 0).sum()) for c, f in zip(spec.outputs, factors, strict=True)},
        }
        return FactoredModel(spec, tuple(factors), notes=notes)

    def _given(self, channel: Channel, channels: Sequence[Channel]) -> tuple[int, ...]:
        """Return the numbers of the parents that the user named."""
        names = [channel.name for channel in channels]
        wanted = list((self.parents or {}).get(channel.name, ()))
        if not set(wanted) <= set(names):
            raise FitError(
                f"factored-counting: parents of {channel.name!r}",
                expected=f"names among {', '.join(names)}",
                got=", ".join(map(str, wanted)),
                remedy="correct option parents",
            )
        return tuple(sorted(names.index(name) for name in wanted))

    def _found(
        self, now: npt.NDArray[np.intp], later: npt.NDArray[np.intp], sizes: Sequence[int], own: int
    ) -> tuple[int, ...]:
        """Return the parents that lower the criterion, added greedily."""
        chosen: tuple[int, ...] = ()
        best = _criterion(_counts(now, later, sizes, chosen, sizes[own]))
        while len(chosen) < self.most:
            tried = [tuple(sorted((*chosen, i))) for i in range(len(sizes)) if i not in chosen]
            scores = [_criterion(_counts(now, later, sizes, parents, sizes[own])) for parents in tried]
            if not tried or min(scores) >= best:
                break
            best, chosen = min(scores), tried[int(np.argmin(scores))]
        return chosen


def _counts(
    now: npt.NDArray[np.intp], later: npt.NDArray[np.intp], sizes: Sequence[int], parents: tuple[int, ...], own: int
) -> FloatArray:
    """Return how often each next category followed each combination of the parents (K_parent, ..., K)."""
    shape = (*(sizes[i] for i in parents), own)
    index = np.ravel_multi_index((*(now[:, i] for i in parents), later), shape)
    return np.bincount(index, minlength=int(np.prod(shape))).astype(float).reshape(shape)


def _criterion(counts: FloatArray) -> float:
    """Return the Bayesian information criterion of a table, in nats: the smaller the better."""
    total = counts.sum(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        likelihood = float(np.sum(np.where(counts > 0, counts * np.log(counts / total), 0.0)))
    free = (total > 0).sum() * (counts.shape[-1] - 1)
    return 0.5 * float(free) * float(np.log(max(counts.sum(), 2.0))) - likelihood
