"""Bands of free runs that hold: how far predictions so many steps ahead were off on held-out stretches of records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from harness.errors import FitError, InputError
from harness.models.distributions import NormalMixture
from harness.protocols import Model
from harness.signals import FloatArray, Trajectory, residual

Start = Callable[[Trajectory], FloatArray]

_LEVEL = 0.9  # Share of the data that bands are made to hold; other levels follow from the normal distribution.
_NINETY = 1.6449  # Half width of the central 90 % of a normal distribution, in standard deviations.

_STEPS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Steps ahead at which errors are measured, doubling: between them the spread is interpolated."""

_LEAST = math.ceil(_LEVEL / (1 - _LEVEL) - 1e-9)
"""Windows that do not overlap (9): with fewer no finite band holds 90 % for sure (Angelopoulos and Bates, sec. 1)."""

_TWICE = 2.0  # Standard errors that are told as what something is known to.
_MANY = 5  # Records from which on the scatter between records is looked at.

_LOOK_BACK, _FIRST = 300, 60
"""Samples before the held-out stretch from which the state at its begin is filtered, so that a slow filter has settled
as it has in a record that goes on (they were learned from, but only the state comes from there); and those of them from
which its first state is estimated."""

_RUNS = 600  # Most windows that are run, evenly thinned.
_LOST = 0.05  # Share of held-out windows that may leave every bound: half of what a 90 % band may miss.

_LEAST_SPREAD = 1e-6
"""Standard deviation of a prediction, relative to the size of the output, that no model may claim to be below."""

_LEAST_FACTOR = 1e-4  # Of a deviation: bands that were ten thousand times too wide, or too narrow, were none.
_BISECTIONS = 40  # Halvings of the range of a factor: to many digits more than its scatter.
_NEAR = 4  # Steps ahead at which a model has to be worth something.
_USELESS = 1.0  # Standard deviations of the output: a spread beyond is worse than what the mean of the record says.

_STEEPEST = 2.0
"""Power of the time with which the spread may grow beyond the longest held-out window: a constant force unknown."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """Held-out samples so many steps after the last output that was seen."""

    steps: int
    windows: int  # Windows of this length that do not overlap: what the samples are worth
    # (n, nx), (n, nu), (n, ny): Predicted states, and inputs and outputs of the samples
    x: FloatArray
    u: FloatArray
    y: FloatArray
    which: npt.NDArray[np.intp] | None = None  # array of int (n,): Number of the record of each

    @property
    def level(self) -> float:
        """Share of the errors below the bound of a new one: ``(n + 1) 0.9 / n`` with n windows."""
        return min(1.0, (self.windows + 1) * _LEVEL / self.windows)


@dataclass(frozen=True, eq=False)
class Bands:
    """Standard deviation of a prediction by the steps since an output was seen, or a factor for the model's own.

    Split conformal prediction (Angelopoulos and Bates 2021, *A gentle introduction to conformal prediction*,
    arXiv 2107.07511, sec. 1; with a model's own deviation as scale sec. 2.3.2): at every horizon the bound below which
    ``(n + 1) 0.9 / n`` of the errors on held-out data lie, n windows that do not overlap; between two errors it is
    interpolated, so that 90 % of new data of the same kind lie within it on average, and not up to ``100 / (n + 1)`` %
    more. Nothing is said of data of another kind. What follows each other in time is not exchangeable, so n counts
    windows and not samples. From fit to fit the share that lies within has a standard deviation of about
    ``0.3 / sqrt(n)``, or that of the records' own shares over the root of their number where they are unlike.
    """

    steps: FloatArray  # (H,): Increasing
    spread: FloatArray  # (H, ny): In the units of the outputs, or without unit where it is a factor
    error: float = math.nan
    """Standard error of the share that lies within, by the scatter between the held-out records; NaN of fewer than
    5."""

    @classmethod
    def of(
        cls, runs: Sequence[Ahead], misses: Sequence[FloatArray], what: str, *, least: FloatArray, growing: bool = True
    ) -> Bands:
        """Return the bands that hold on held-out runs.

        Parameters
        ----------
        runs : sequence of Ahead
        misses : sequence of array (n, ny)
            Errors of each, or errors over the model's own deviation; NaN where a run has diverged.
        what : str
            Name of the identifier.
        least : array (ny,)
            No spread is below it.
        growing : bool
            Let a spread never fall with the steps: of errors in units, not of factors.

        Raises
        ------
        FitError
            If more than one in twenty held-out windows diverges at the first of the horizons, or none is there. Where
            they diverge further ahead the bands end before.

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> runs = [Ahead(k, 4000, *np.zeros((3, 4000, 1))) for k in (1, 4)]
        >>> misses = [k * rng.normal(size=(4000, 1)) for k in (1, 4)]
        >>> bands = Bands.of(runs, misses, "example", least=np.zeros(1))
        >>> bands.at(np.array([1.0, 2.0, 4.0, 8.0]))[:, 0].round(1).tolist()
        [1.0, 2.0, 4.0, 8.0]
        """
        if not runs:
            raise FitError(
                f"{what}: too little is held out for honest bands",
                expected=f"{_LEAST} held-out samples",
                got="fewer",
                remedy="record longer",
            )
        rows: list[FloatArray] = []
        for one, miss in zip(runs, misses, strict=True):
            size = np.abs(miss)
            lost = float(np.mean(~np.isfinite(size).all(axis=1)))
            if lost > _LOST and rows:
                break  # further ahead nothing vouches for them
            if lost > _LOST:
                raise FitError(
                    f"{what}: free runs over held-out data diverge",
                    expected=f"at most {100 * _LOST:g} % of those of {one.steps} steps",
                    got=f"{100 * lost:.0f} %",
                    remedy="record more, train longer, or use another identifier",
                )
            held = np.where(np.isfinite(size), size, 0.0).max(axis=0)
            # A run that diverged counts as one beyond all others, which have an end.
            bound = np.quantile(np.where(np.isfinite(size), size, 2.0 * held), one.level, axis=0)
            rows.append(np.maximum(np.minimum(bound, held) / _NINETY, least))
        spread = np.array(rows)
        steps = np.array([float(one.steps) for one in runs[: len(rows)]])
        spread = np.maximum.accumulate(spread) if growing else spread
        return cls(steps, spread, _scatter(runs, misses, spread))

    @classmethod
    def scaling(cls, model: Any, runs: Sequence[Ahead], what: str) -> Bands:
        """Return the factors of a model's own deviations with which its 90 % intervals hold on held-out runs.

        Of a mixture the deviations of its parts are scaled; their disagreement shrinks with them and does not grow.
        Raises FitError as :meth:`of`.

        - ``model``: that predicts distributions; NaN where a run has diverged
        - ``what``: name of the identifier
        """
        return cls.crossed([(model, runs)], what)

    @classmethod
    def crossed(cls, folds: Sequence[tuple[Any, Sequence[Ahead]]], what: str) -> Bands:
        """Return the factors of :meth:`scaling` from several models, each with the runs over what it has not seen.

        As cross-conformal prediction does (Vovk 2015, *Ann. Math. Artif. Intell.* 74:9, sec. 3), so that all data
        vouch for the bands of a model that is fitted to all of them: as far ahead as nine windows fit into all parts.

        Raises
        ------
        FitError
            As :meth:`of`.
        """
        merged: list[Ahead] = []
        scores: list[FloatArray] = []
        for level in range(max((len(runs) for _, runs in folds), default=0)):
            each = [(model, runs[level]) for model, runs in folds if len(runs) > level]
            joined = _joined([one for _, one in each])
            if joined.windows < _LEAST:
                break
            merged.append(joined)
            factors = [_least_factors(model.predictive(one.x, one.u), one.y) for model, one in each]
            scores.append(np.concatenate(factors))
        ny = folds[0][0].spec.ny if folds else 0
        return cls.of(merged, [_NINETY * score for score in scores], what, least=np.full(ny, _LEAST_FACTOR),
                      growing=False)  # fmt: skip

    @property
    def longest(self) -> int:
        """Steps ahead up to which held-out data vouch for the bands."""
        return int(self.steps[-1])

    def at(self, since: FloatArray) -> FloatArray:
        """Return the spread (..., ny) so many steps (...) after an output was seen.

        Beyond the longest held-out window it grows on by the power of the last doubling, of which nothing vouches.
        """
        known, wanted = np.log(self.steps), np.log(np.maximum(np.asarray(since, dtype=float), 1.0))
        beyond = np.maximum(wanted - known[-1], 0.0)
        columns = []
        for column in np.log(self.spread.T):
            power = 0.0
            if len(known) > 1:
                power = float(np.clip((column[-1] - column[-2]) / (known[-1] - known[-2]), 0.0, _STEEPEST))
            columns.append(np.exp(np.interp(wanted, known, column) + power * beyond))
        return np.stack(columns, axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        error = self.error if math.isfinite(self.error) else None
        return {"steps": self.steps.tolist(), "spread": self.spread.tolist(), "error": error}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any] | None) -> Bands | None:
        """Return the bands of a description; None for none."""
        if content is None:
            return None
        steps, spread = (np.array(content[name], dtype=float) for name in ("steps", "spread"))
        error = content.get("error")
        return cls(steps, spread, math.nan if error is None else float(error))

    def note(self, sample_time: float) -> str:
        """Return in words how far ahead they hold."""
        return (
            f"bands were made to hold on held-out data up to {self.longest} steps ({self.longest * sample_time:.3g} s) "
            "ahead; beyond they are extrapolated"
            + (
                f"; held-out parts differ so much that the share within is known to {100 * _TWICE * self.error:.2g} %"
                if math.isfinite(self.error)
                else ""
            )
        )


def held_out_runs(
    model: Model,
    records: Sequence[Trajectory],
    cuts: Sequence[int],
    start: Start | None = None,
    least: int = _LEAST,
) -> list[Ahead]:
    """Return what a model predicts of the held-out ends of records, 1, 2, 4, ... steps ahead.

    - ``cuts``: first held-out sample of each
    - ``start``: ``start(stretch) -> state`` (nx,) where a guess will do, as up to 300 samples are filtered before the
      first that counts; by default the model's own ``initial_state``
    - ``least``: windows that have to fit into what is held out: 9, or fewer where these are joined with those of other
      models
    - returns one for each, up to the longest horizon of which as many windows fit
    """
    held = [len(record) - cut for record, cut in zip(records, cuts, strict=True)]
    horizons = [h for h in _STEPS if sum((length - 1) // h for length in held) >= least]
    if not horizons:
        return []
    states, which, sample = _filtered(model, records, cuts, start or model.initial_state)
    keep = np.linspace(0, len(which) - 1, min(_RUNS, len(which))).astype(np.intp)
    x, which, sample = states[keep], which[keep], sample[keep]
    first = np.concatenate([[0], np.cumsum([len(record) for record in records])[:-1]])
    ends = np.array([len(record) for record in records])[which]
    every_u, every_y = (np.concatenate([getattr(record, name) for record in records]) for name in ("u", "y"))
    found = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for steps in range(1, horizons[-1] + 1):
            inside = sample + steps < ends
            x, which, sample, ends = x[inside], which[inside], sample[inside], ends[inside]
            row = first[which] + sample + steps
            x = model.step(x, every_u[row - 1])
            if steps in horizons:
                windows = sum((length - 1) // steps for length in held)
                found.append(Ahead(steps, windows, x, every_u[row], every_y[row], which))
    return found


def held_out_folds(lengths: Sequence[int], folds: int) -> list[list[tuple[int, int, int, int]]]:
    """Return what each of some folds holds out: record, its first sample, the first one that counts, and the end.

    Whole records in turn where there are as many as folds, else a stretch in turn of every record. At the begin of a
    record samples count only after those that a first state takes.

    - ``lengths``: samples of the records

    Examples
    --------
    >>> held_out_folds([100, 100, 100], 2)
    [[(0, 0, 60, 100), (2, 0, 60, 100)], [(1, 0, 60, 100)]]
    >>> held_out_folds([300], 3)
    [[(0, 0, 60, 100)], [(0, 100, 100, 200)], [(0, 200, 200, 300)]]
    """
    found: list[list[tuple[int, int, int, int]]] = []
    for fold in range(folds):
        if len(lengths) >= folds:
            spans = [(k, 0, n) for k, n in enumerate(lengths) if k % folds == fold]
        else:
            spans = [(k, fold * n // folds, (fold + 1) * n // folds) for k, n in enumerate(lengths)]
        found.append([(k, begin, begin or min(_FIRST, 3 * end // 4), end) for k, begin, end in spans])
    return found


def _joined(parts: Sequence[Ahead]) -> Ahead:
    """Return held-out samples of several models as one; records of different models are different ones."""
    which, shift = [], 0
    for one in parts:
        own = np.zeros(len(one.y), dtype=np.intp) if one.which is None else one.which
        which.append(own + shift)
        shift += int(own.max(initial=0)) + 1
    u, y = (np.concatenate([getattr(one, name) for one in parts]) for name in ("u", "y"))
    x = parts[0].x if len(parts) == 1 else np.zeros((len(y), 0))  # states of different models have no common meaning
    return Ahead(parts[0].steps, sum(one.windows for one in parts), x, u, y, np.concatenate(which))


def _scatter(runs: Sequence[Ahead], misses: Sequence[FloatArray], spread: FloatArray) -> float:
    """Return the standard error of the share within bands, from the shares (R,) of the records; NaN of too few."""
    counted: dict[int, list[float]] = {}
    for one, miss, size in zip(runs, misses, spread, strict=False):
        if one.which is None:
            return math.nan
        inside = np.mean(np.abs(miss) <= _NINETY * size, axis=1)
        for number in np.unique(one.which):
            counted.setdefault(int(number), []).append(float(inside[one.which == number].mean()))
    shares = np.array([np.mean(values) for values in counted.values()])
    return float(shares.std(ddof=1) / math.sqrt(len(shares))) if len(shares) >= _MANY else math.nan


def drawn_together(told: NormalMixture, factor: FloatArray) -> NormalMixture:
    """Return a mixture whose parts stand nearer to their mean by a factor (..., ny), where it is below 1.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> two = NormalMixture(np.array([[0.0], [4.0]]), np.ones((2, 1)), [Channel("y")])
    >>> drawn_together(two, np.array([0.5])).means.ravel().tolist()
    [1.0, 3.0]
    """
    if told.means.shape[-2] == 1:
        return told
    middle = told.means.mean(axis=-2, keepdims=True)
    near = np.minimum(np.asarray(factor, dtype=float), 1.0)[..., None, :]
    return NormalMixture(middle + near * (told.means - middle), told.stds, told.outputs)


def _least_factors(told: NormalMixture, y: FloatArray) -> FloatArray:
    """Return the least factors (n, ny) of the deviations with which the 90 % intervals hold each y; NaN of none."""
    low, high = np.full(y.shape, np.log(_LEAST_FACTOR)), np.full(y.shape, np.log(1 / _LEAST_FACTOR))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        factor = np.exp(middle)
        wide = NormalMixture(told.means, told.stds * factor[..., None, :], told.outputs)
        scaled = drawn_together(wide, factor)
        holds = scaled.covered(y, _LEVEL) > 0
        low, high = np.where(holds, low, middle), np.where(holds, middle, high)
    lost = ~np.isfinite(told.mean) | (high > np.log(1 / _LEAST_FACTOR) - 1e-9)
    return np.asarray(np.where(lost, np.nan, np.exp(high)))


def _filtered(
    model: Model, records: Sequence[Trajectory], cuts: Sequence[int], start: Start
) -> tuple[FloatArray, npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return filtered states (n, nx) at the held-out samples, their records and their places in them."""
    begins = np.array([max(0, cut - _LOOK_BACK) for cut in cuts])
    ends, edges = np.array([len(record) for record in records]), np.array(cuts)
    x = np.array([start(record[begin : begin + _FIRST]) for record, begin in zip(records, begins, strict=True)])
    states, which, sample = [], [], []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(int((ends - begins).max())):
            at = np.minimum(begins + k, ends - 1)
            u = np.array([record.u[i] for record, i in zip(records, at, strict=True)])
            y = np.array([record.y[i] for record, i in zip(records, at, strict=True)])
            x = model.correct(x, u, y)
            now = np.flatnonzero((begins + k >= edges) & (begins + k < ends))
            states.append(x[now])
            which.append(now)
            sample.append(at[now])
            x = model.step(x, u)
    return np.concatenate(states), np.concatenate(which), np.concatenate(sample)


def misses(model: Model, run: Ahead) -> FloatArray:
    """Return measured minus predicted (n, ny) of a held-out run, wrapped on periodic channels."""
    return residual(model.spec.outputs, run.y, model.output(run.x, run.u))


B = TypeVar("B", bound=Any)


def banded(
    model: B,
    records: Sequence[Trajectory],
    cuts: Sequence[int],
    size: FloatArray,
    what: str,
    start: Start | None = None,
) -> B:
    """Return a model, a frozen dataclass with ``bands`` and ``notes``, with bands that hold on held-out data.

    Raises FitError if held-out free runs diverge, or predict one output worse than its mean does, a few steps ahead
    already.

    - ``model``: whose state counts the steps since an output was seen
    - ``cuts``: first held-out sample of each
    - ``size`` (ny,): standard deviation of the outputs
    - ``what``: name of the identifier
    - ``start``: as of :func:`held_out_runs`
    """
    runs = held_out_runs(model, records, cuts, start)
    wrong = [misses(model, one) for one in runs]
    bands = Bands.of(runs, wrong, what, least=_LEAST_SPREAD * size)
    near = next((row for steps, row in zip(bands.steps, bands.spread, strict=True) if steps >= _NEAR), bands.spread[-1])
    if (near > _USELESS * size).any():
        worst = int(np.argmax(near / size))
        raise FitError(
            f"{what} does not describe these data",
            expected=f"held-out errors of {model.spec.outputs[worst].name} {_NEAR} steps ahead below its standard "
            f"deviation, {size[worst]:.3g}",
            got=f"{near[worst]:.3g}",
            remedy="train longer (steps), measure more, or use another identifier",
        )
    return replace(model, bands=bands, notes={**model.notes, "bands": bands.note(model.spec.sample_time)})


def refuse_share(share: float, what: str) -> None:
    """Refuse a share of the records that leaves nothing to learn from, or nothing to judge with.

    Raises InputError if it is not between 0 and 1.
    """
    if not 0 < share < 1:
        raise InputError(
            f"option held_out of {what}", expected="a share between 0 and 1", got=f"{share:g}", remedy="0.2 is usual"
        )


def told(bands: Bands | None, what: str) -> Bands:
    """Return the bands of a model, or say that it has none.

    Raises InputError if there are none.
    """
    if bands is None:
        raise InputError(
            f"bands of a model of {what}",
            expected="a model whose fit held data out",
            got="one without bands",
            remedy="fit it anew",
        )
    return bands
