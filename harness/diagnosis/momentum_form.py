"""The momentum balance of the measured motion, whitened: where an unmeasured force disturbs the plant.

A disturbance that no sensor sees makes the error of a free run ring at the plant's own resonance. In the balance of
momentum it is only a coloured force, the same one at any angle and speed; filtered by an autoregression it becomes
white, and then the statistics of the loop hold as they stand (Ljung, System Identification, section 7.6: a prefilter
that whitens the residual makes least squares efficient). Judged here is what follows from the measured motion and the
inputs: forces, blocks whose states can be simulated along them, small errors of a coordinate's sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from harness.diagnosis.claiming import Claiming
from harness.diagnosis.equation import Equations, bump_rows
from harness.diagnosis.equation_form import EquationForm
from harness.diagnosis.forms import Fitted, fit_here
from harness.diagnosis.motion import Motion
from harness.effects.claimed import ClaimedForce, claimable
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.signals import Dataset, FloatArray, Trajectory

__all__ = ["MomentumForm", "autoregression", "filtered"]

ORDER = 3
"""Of the autoregression at most: a longer one would learn the missing effect itself and filter it away."""
DETAIL = 0.003
"""Share of the change of momentum below which a force, beyond what the parameters take up, may be a trace of smoothing.
A quarter-size effect has 0.6 % to 2 % of it; on cart-poles without any effect the traces had up to 0.17 %."""
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

    def judges(self, placed: Placed) -> bool:
        """Return True for what exerts a force that follows from the measured motion and the inputs.

        Not for a common factor of all forces, which no balance can know.
        """
        return super().judges(placed) or (placed.effect.name != "input_gain" and claimable(self.nominal, placed))

    def equations(self, effects: Sequence[Placed]) -> Equations:
        """Return the whitened equation form with effects, made once."""
        key = tuple(str(one) for one in effects)
        if key not in self._equations:
            claimed = [one for one in effects if not super(MomentumForm, self).judges(one)]
            if claimed:
                inner = self.equations([one for one in effects if one not in claimed])
                system = compose(self.nominal, effects, sizes=self.sizes)
                claims = tuple(ClaimedForce(inner.system, one, self.sizes.get(one.at, {})) for one in claimed)
                self._equations[key] = Claiming(system, None, None, None, inner, claims, self.averaged)
            else:
                plain = super().equations(effects)
                parts = {one.name: getattr(plain, one.name) for one in fields(Equations)}
                self._equations[key] = _Whitened(**parts, white=self.white)
        return self._equations[key]

    def white(self, rows: FloatArray) -> FloatArray:
        """Return rows (N, n, ...) of the balance, filtered and over their spread."""
        lost = max(one.size for one in self.filters)
        parts = [filtered(rows[:, k], phi, lost) / self.spread[k] for k, phi in enumerate(self.filters)]
        return np.stack(parts, axis=1)

    def rest(self, values: Mapping[str, float]) -> float:
        """Return the rms of the residual of the nominal model over that of the change of momentum, unfiltered.

        The largest over the coordinates; ``values`` are the parameters.
        """
        plain, p = self.equations(()), self.nominal.vector(values)
        sides = zip(*(plain.balance(motion, p) for motion in self.motions["estimation"]), strict=True)
        left, moved = (np.mean(np.concatenate(side) ** 2, axis=0) for side in sides)
        return float(np.sqrt(np.max(left / np.maximum(moved, 1e-300))))

    def noise_share(
        self,
        dataset: Dataset,
        noise: Sequence[float],
        rng: np.random.Generator,
        values: Mapping[str, float] | None = None,
    ) -> float:
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
        values : mapping, optional
            Parameters of the nominal model; those of :attr:`start` if not given.
        """
        runs = tuple(
            replace(run, trajectory=_noisier(run.trajectory, noise, rng)) for run in dataset.runs if run.use != "test"
        )
        other = EquationForm(self.nominal, replace(dataset, runs=runs), sizes=self.sizes, shape="weak")
        noisier = [
            replace(theirs, factor=mine.factor)
            for theirs, mine in zip(other.motions["estimation"], self.motions["estimation"], strict=True)
        ]
        plain, p = self.equations(()), self.nominal.vector(self.start.values if values is None else values)
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
        reasons = []
        for one in added:
            without = [other for other in fitted.effects if str(other) != str(one)]
            share = self.apart(fitted, fit_here(self, without, [fitted.values]))
            if share < DETAIL:
                reasons.append(
                    f"beyond what the parameters take up, its force is {share:.2%} of the change of momentum: a detail "
                    "of the smoothed motion"
                )
        return reasons

    def apart(self, one: Fitted, other: Fitted) -> float:
        """Return how far two fitted models are apart on the estimation motions, as a share of the change of momentum.

        The rms of the difference of their forces, unfiltered; the largest over the coordinates.
        """
        sides = []
        for model in (one, other):
            equations = self.equations(model.effects)
            p = equations.system.vector(model.values)
            sides.append([equations.balance(motion, p)[0] for motion in self.motions["estimation"]])
        return self.share([a - b for a, b in zip(*sides, strict=True)])

    def alike(self, one: Fitted, other: Fitted, added: Sequence[Placed]) -> bool:
        """Return True if another model differs by a detail, and by less than half of what ``added`` does in the one."""
        apart = self.apart(one, other)
        if apart >= DETAIL:
            return False
        without = [effect for effect in one.effects if str(effect) not in {str(gone) for gone in added}]
        return apart < 0.5 * self.apart(one, fit_here(self, without, [one.values]))

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
