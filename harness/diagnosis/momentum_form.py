"""The momentum balance of the measured motion, whitened: where an unmeasured force disturbs the plant.

A disturbance that no sensor sees makes the error of a free run ring at the plant's own resonance. In the balance of
momentum it is only a coloured force, the same one at any angle and speed; filtered by an autoregression it becomes
white, and then the statistics of the loop hold as they stand (Ljung, System Identification, section 7.6: a prefilter
that whitens the residual makes least squares efficient). Only forces that follow from the measured motion and the
inputs can be judged here, no hidden states and no sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from harness.diagnosis.equation import Equations, bump_rows
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, fit_here
from harness.diagnosis.motion import Motion
from harness.effects.effect import Placed
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["MomentumForm", "autoregression", "filtered"]

ORDER = 3
"""Of the autoregression at most: a longer one would learn the missing effect itself and filter it away."""
DETAIL = 0.005
"""Share of the change of momentum below which a force may be a trace of smoothing. A quarter-size effect has 1 % to 2 %
of it; on cart-poles without any effect the traces had up to 0.4 %."""
FINER = 2
"""Bumps are this much shorter than those of the screen: corners of a law tell it from others."""


def autoregression(series: Sequence[FloatArray], order: int) -> FloatArray:
    """Return the coefficients (k,) of the autoregression of records (N_i,), k at most ``order``, chosen by the BIC.

    A record shorter than four times the order lowers it.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = np.zeros(4000)
    >>> for k in range(1, 4000):
    ...     x[k] = 0.8 * x[k - 1] + rng.standard_normal()
    >>> np.round(autoregression([x], 3), 1).tolist()
    [0.8]
    """
    order = min(order, min(len(one) for one in series) // 4)
    past = np.concatenate([_lagged(one, order) for one in series])
    now = np.concatenate([one[order:] for one in series])
    best, chosen = np.inf, np.zeros(0)
    for count in range(order + 1):
        phi = np.linalg.lstsq(past[:, :count], now, rcond=None)[0] if count else np.zeros(0)
        power = float(np.mean((now - past[:, :count] @ phi) ** 2))
        score = now.size * np.log(max(power, 1e-300)) + count * np.log(now.size)
        if score < best:
            best, chosen = score, phi
    return chosen


def filtered(rows: FloatArray, phi: FloatArray, lost: int | None = None) -> FloatArray:
    """Return rows (N, ...) less what an autoregression predicts of each from those before; the first ``lost`` go."""
    first = phi.size if lost is None else lost
    white = np.array(rows[first:])
    for k, weight in enumerate(phi, start=1):
        white -= weight * rows[first - k : len(rows) - k]
    return white


def _noisier(record: Trajectory, noise: Sequence[float], rng: np.random.Generator) -> Trajectory:
    """Return a record with white noise added to its outputs."""
    return replace(record, y=record.y + np.asarray(noise) * rng.standard_normal(record.y.shape))


def _lagged(series: FloatArray, order: int) -> FloatArray:
    """Return the past (N - order, order) of a series (N,), the last sample first."""
    if order == 0:
        return np.zeros((len(series), 0))
    return np.column_stack([series[order - k : len(series) - k] for k in range(1, order + 1)])


@dataclass(frozen=True, eq=False)
class _Whitened(Equations):
    """Equations whose residual passes through the filters of a form."""

    white: Any = None

    def residual(
        self, motion: Motion, p: FloatArray, form: Any = "strong", columns: Sequence[int] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residual and its derivatives."""
        r, j = super().residual(motion, p, form, columns)
        return self.white(r), self.white(j)


class MomentumForm(EquationForm):
    """Compare whitened momentum residuals; see :class:`harness.diagnosis.forms.Form`.

    Parameters
    ----------
    nominal : System
        All of its coordinates are measured.
    dataset : Dataset
    sizes : mapping
        Sizes of the data by port, for start values.
    values : mapping
        Parameters to begin the nominal fit with.

    Attributes
    ----------
    filters : tuple of array
        Coefficients of the autoregression of each coordinate's balance.
    spread : array (n,)
        Standard deviation of what they leave [force unit].
    start : Fitted
        The nominal model, fitted.
    """

    def __init__(
        self,
        nominal: Any,
        dataset: Dataset,
        *,
        sizes: Mapping[str, Mapping[str, float]],
        values: Mapping[str, float],
    ) -> None:
        super().__init__(nominal, dataset, sizes=sizes, shape="weak")
        self.motions = {
            use: tuple(replace(one, factor=max(one.factor // FINER, 1)) for one in motions)
            for use, motions in self.motions.items()
        }
        count = len(self.columns)
        self.filters: tuple[FloatArray, ...] = (np.zeros(0),) * count
        self.spread: FloatArray = np.ones(count)
        self.start = fit_here(self, (), [values])
        for _ in range(2):
            p = nominal.vector(self.start.values)
            rough = [self.equations(()).balance(motion, p)[0] for motion in self.motions["estimation"]]
            self.filters = tuple(autoregression([one[:, k] for one in rough], ORDER) for k in range(count))
            self.spread = np.ones(count)
            left = np.concatenate([self.white(one) for one in rough])
            self.spread = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-300)
            self.start = fit_here(self, (), [self.start.values])

    def equations(self, effects: Sequence[Placed]) -> Equations:
        """Return the whitened equation form with effects, made once."""
        key = tuple(str(one) for one in effects)
        if key not in self._equations:
            plain = super().equations(effects)
            parts = {one.name: getattr(plain, one.name) for one in fields(Equations)}
            self._equations[key] = _Whitened(**parts, white=self.white)
        return self._equations[key]

    def white(self, rows: FloatArray) -> FloatArray:
        """Return rows (N, n, ...) of the balance, filtered and over their spread."""
        lost = max(one.size for one in self.filters)
        parts = [filtered(rows[:, k], phi, lost) / self.spread[k] for k, phi in enumerate(self.filters)]
        return np.stack(parts, axis=1)

    def noise_share(self, dataset: Dataset, noise: Sequence[float], rng: np.random.Generator) -> float:
        """Return the rms of the sensors' noise in the balance over that of the change of momentum, unfiltered.

        It is measured: as much noise again is added to the readings. The largest over the coordinates; where it is not
        small, least squares on the balance is biased (errors in variables) and finds forces that are not there.

        Parameters
        ----------
        dataset : Dataset
        noise : sequence of float
            Standard deviation of each output.
        rng : Generator
            Source of the added noise.
        """
        runs = tuple(
            replace(run, trajectory=_noisier(run.trajectory, noise, rng)) for run in dataset.runs if run.use != "test"
        )
        other = EquationForm(self.nominal, replace(dataset, runs=runs), sizes=self.sizes, shape="weak")
        noisier = [
            replace(theirs, factor=mine.factor)
            for theirs, mine in zip(other.motions["estimation"], self.motions["estimation"], strict=True)
        ]
        plain, p = self.equations(()), self.nominal.vector(self.start.values)
        power = []
        for motions in (self.motions["estimation"], noisier):
            parts = [plain.balance(motion, p) for motion in motions]
            power.append([np.mean(np.concatenate(side) ** 2, axis=0) for side in zip(*parts, strict=True)])
        (left, moved), (more, _) = power
        return float(np.sqrt(np.max(np.maximum(more - left, 0.0) / np.maximum(moved, 1e-300))))

    def details(self, fitted: Fitted, added: Sequence[Placed]) -> list[str]:
        """Return a reason for each added effect whose force is no more than a detail of the smoothed motion.

        Smoothing and averaging leave some thousandths of the change of momentum; where no sensor's noise and no
        disturbance hides them, they look like a law.
        """
        names = {str(one) for one in added}
        without = [one for one in fitted.effects if str(one) not in names]
        less = self.equations(without)
        q = less.system.vector({k: fitted.values[k] for k in less.system.parameter_names})
        reasons = []
        for one in added:
            full = self.equations([*without, one])
            p = full.system.vector({k: fitted.values[k] for k in full.system.parameter_names})
            motions = self.motions["estimation"]
            share = self.share([full.balance(m, p)[0] - less.balance(m, q)[0] for m in motions])
            if share < DETAIL:
                reasons.append(f"its force is {share:.2%} of the change of momentum: a detail of the smoothed motion")
        return reasons

    def share(self, forces: Sequence[FloatArray]) -> float:
        """Return the rms of averaged forces (rows_i, n) on the estimation motions over that of the change of momentum.

        The largest over the coordinates.
        """
        plain, p = self.equations(()), self.nominal.vector(self.start.values)
        change = np.concatenate([plain.balance(motion, p)[1] for motion in self.motions["estimation"]])
        size = np.sqrt(np.mean(np.concatenate(list(forces)) ** 2, axis=0))
        return float(np.max(size / np.maximum(np.sqrt(np.mean(change**2, axis=0)), 1e-300)))

    def averaged(self, columns: FloatArray, motion: Motion) -> FloatArray:
        """Return columns (N, n, k) of forces as the residual is: over bumps, filtered."""
        count, n, k = columns.shape
        return self.white(bump_rows(columns.reshape(count, n * k), motion).reshape(-1, n, k))
