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

__all__ = ["Ahead", "Bands", "banded", "held_out_runs", "misses", "told"]

Start = Callable[[Trajectory], FloatArray]

_LEVEL = 0.9
"""Share of the data that bands are made to hold; other levels follow from the normal distribution."""

_NINETY = 1.6449
"""Half width of the central 90 % of a normal distribution, in standard deviations."""

_STEPS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Steps ahead at which errors are measured, doubling: between them the spread is interpolated."""

_LEAST = math.ceil(_LEVEL / (1 - _LEVEL) - 1e-9)
"""Windows that do not overlap (9): with fewer no finite band holds 90 % for sure (Angelopoulos and Bates, sec. 1)."""

_LOOK_BACK, _FIRST = 300, 60
"""Samples before the held-out stretch from which the state at its begin is filtered, so that a slow filter has settled
as it has in a record that goes on (they were learned from, but only the state comes from there); and those of them from
which its first state is estimated."""

_RUNS = 600
"""Most windows that are run, evenly thinned."""

_LOST = 0.05
"""Share of held-out windows that may leave every bound: half of what a 90 % band may miss."""

_LEAST_SPREAD = 1e-6
"""Standard deviation of a prediction, relative to the size of the output, that no model may claim to be below."""

_LEAST_FACTOR = 1e-4
"""Of a deviation: bands that were ten thousand times too wide, or too narrow, were none."""

_BISECTIONS = 40
"""Halvings of the range of a factor: to many digits more than its scatter."""

_NEAR = 4
"""Steps ahead at which a model has to be worth something."""

_USELESS = 1.0
"""Standard deviations of the output: a spread beyond is worse than what the mean of the record says."""

_STEEPEST = 2.0
"""Power of the time with which the spread may grow beyond the longest held-out window: a constant force unknown."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """Held-out samples so many steps after the last output that was seen.

    Parameters
    ----------
    steps : int
    windows : int
        Windows of this length that do not overlap: what the samples are worth.
    x, u, y : array (n, nx), (n, nu), (n, ny)
        Predicted states, and inputs and outputs of the samples.
    """

    steps: int
    windows: int
    x: FloatArray
    u: FloatArray
    y: FloatArray

    @property
    def level(self) -> float:
        """Share of the errors below the bound of a new one: ``ceil((n + 1) 0.9) / n`` with n windows."""
        return min(1.0, math.ceil((self.windows + 1) * _LEVEL - 1e-9) / self.windows)


@dataclass(frozen=True, eq=False)
class Bands:
    """Standard deviation of a prediction by the steps since an output was seen, or a factor for the model's own.

    Split conformal prediction (Angelopoulos and Bates 2021, *A gentle introduction to conformal prediction*,
    arXiv 2107.07511, sec. 1; with a model's own deviation as scale sec. 2.3.2): at every horizon the bound below which
    ``ceil((n + 1) 0.9) / n`` of the errors on held-out data lie, n windows that do not overlap. New data of the same
    kind lie within it with 90 to ``90 + 100 / (n + 1)`` % on average; nothing is said of data of another kind. What
    follows each other in time is not exchangeable, so n counts windows and not samples. From fit to fit the share that
    lies within has a standard deviation of about ``0.3 / sqrt(n)``.

    Parameters
    ----------
    steps : array (H,)
        Increasing.
    spread : array (H, ny)
        In the units of the outputs, or without unit where it is a factor.
    """

    steps: FloatArray
    spread: FloatArray

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
            # Between two order statistics the larger is the bound (Angelopoulos and Bates, eq. 2).
            bound = np.quantile(np.where(np.isfinite(size), size, np.inf), one.level, axis=0, method="higher")
            held = np.where(np.isfinite(size), size, 0.0).max(axis=0)
            rows.append(np.maximum(np.where(np.isfinite(bound), bound, held) / _NINETY, least))
        spread = np.array(rows)
        steps = np.array([float(one.steps) for one in runs[: len(rows)]])
        return cls(steps, np.maximum.accumulate(spread) if growing else spread)

    @classmethod
    def scaling(cls, model: Any, runs: Sequence[Ahead], what: str) -> Bands:
        """Return the factors of a model's own deviations with which its 90 % intervals hold on held-out runs.

        Of a mixture the deviations of its parts are scaled, and their disagreement stays.

        Parameters
        ----------
        model : Model
            That predicts distributions; NaN where a run has diverged.
        runs : sequence of Ahead
        what : str
            Name of the identifier.

        Raises
        ------
        FitError
            As :meth:`of`.
        """
        scores = []
        for one in runs:
            told: NormalMixture = model.predictive(one.x, one.u)
            scores.append(_least_factors(told, one.y))
        return cls.of(runs, [_NINETY * score for score in scores], what, least=np.full(model.spec.ny, _LEAST_FACTOR),
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
        return {"steps": self.steps.tolist(), "spread": self.spread.tolist()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any] | None) -> Bands | None:
        """Return the bands of a description; None for none."""
        if content is None:
            return None
        return cls(*(np.array(content[name], dtype=float) for name in ("steps", "spread")))

    def note(self, sample_time: float) -> str:
        """Return in words how far ahead they hold."""
        return (
            f"bands were made to hold on held-out data up to {self.longest} steps ({self.longest * sample_time:.3g} s) "
            "ahead; beyond they are extrapolated"
        )


def held_out_runs(
    model: Model, records: Sequence[Trajectory], cuts: Sequence[int], start: Start | None = None
) -> list[Ahead]:
    """Return what a model predicts of the held-out ends of records, 1, 2, 4, ... steps ahead.

    Parameters
    ----------
    model : Model
    records : sequence of Trajectory
    cuts : sequence of int
        First held-out sample of each.
    start : callable, optional
        ``start(stretch) -> state`` (nx,) where a guess will do, as up to 300 samples are filtered before the first that
        counts; by default the model's own ``initial_state``.

    Returns
    -------
    list of Ahead
        Up to the longest horizon of which 9 windows fit into what is held out.
    """
    held = [len(record) - cut for record, cut in zip(records, cuts, strict=True)]
    horizons = [h for h in _STEPS if sum((length - 1) // h for length in held) >= _LEAST]
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
                found.append(Ahead(steps, windows, x, every_u[row], every_y[row]))
    return found


def _least_factors(told: NormalMixture, y: FloatArray) -> FloatArray:
    """Return the least factors (n, ny) of the deviations with which the 90 % intervals hold each y; NaN of none."""
    low, high = np.full(y.shape, np.log(_LEAST_FACTOR)), np.full(y.shape, np.log(1 / _LEAST_FACTOR))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        scaled = NormalMixture(told.means, told.stds * np.exp(middle)[..., None, :], told.outputs)
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

    Parameters
    ----------
    model : Model
        Whose state counts the steps since an output was seen.
    records : sequence of Trajectory
    cuts : sequence of int
        First held-out sample of each.
    size : array (ny,)
        Standard deviation of the outputs.
    what : str
        Name of the identifier.
    start : callable, optional
        As of :func:`held_out_runs`.

    Raises
    ------
    FitError
        If held-out free runs diverge, or predict one output worse than its mean does, a few steps ahead already.
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


def told(bands: Bands | None, what: str) -> Bands:
    """Return the bands of a model, or say that it has none.

    Raises
    ------
    InputError
        If there are none.
    """
    if bands is None:
        raise InputError(
            f"bands of a model of {what}",
            expected="a model whose fit held data out",
            got="one without bands",
            remedy="fit it anew",
        )
    return bands
