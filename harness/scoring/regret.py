"""Regret of online identifiers: their loss beyond that of the best fixed model of the same class in hindsight.

Hazan 2016, *Introduction to Online Convex Optimization*, eq. 1.1; for recursive least squares it grows as
``d n sigma^2 ln T`` with d parameters for each of n outputs (Vovk 2001; Cesa-Bianchi & Lugosi 2006, sec. 11.7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.errors import FitError
from harness.protocols import Growth, Hindsight, OnlineIdentifier, Tracking
from harness.signals import FloatArray, PlantSpec, Trajectory, residual

SETTLED = 2
"""Burn-ins after which a curve is held against the law of theory: the first estimates err by more than it says."""


@dataclass(frozen=True, eq=False)
class Regret:
    """Loss of an online identifier beyond that of the best fixed predictor of its class.

    Parameters
    ----------
    losses, hindsight : array (M,)
        Loss at each predicted sample of the stream: of the identifier, and of the batch minimiser of the whole stream.
    exact : bool
        False where the batch minimiser is only the best that was found.
    steps, curve : array (P,)
        ``curve[i]`` is R[n], the loss over the first ``n = steps[i]`` samples beyond that of the best fixed model of
        these n samples (not of the whole stream).
    scale : array (ny,)
        Sizes of the outputs: losses are in units of their variances. Ones where the losses are raw.
    details : dict
        What the identifier states: prior, burn-in, coefficients of the minimiser.
    growth : Growth, optional
        How theory lets the regret grow; None where no theorem says.
    """

    losses: FloatArray
    hindsight: FloatArray
    exact: bool
    steps: FloatArray = field(default_factory=lambda: np.zeros(0))
    curve: FloatArray = field(default_factory=lambda: np.zeros(0))
    scale: FloatArray = field(default_factory=lambda: np.ones(1))
    details: dict[str, Any] = field(default_factory=dict)
    growth: Growth | None = None

    @property
    def cumulative(self) -> FloatArray:
        """Loss so far beyond that of the whole stream's minimiser (M,); :attr:`curve` has R[n] itself."""
        total: FloatArray = np.cumsum(self.losses - self.hindsight)
        return total

    @property
    def total(self) -> float:
        """Regret over the whole stream."""
        return float(self.cumulative[-1])

    @property
    def average(self) -> float:
        """Regret for each sample; goes to zero for an identifier that learns."""
        return self.total / self.losses.size

    def slope(self, burn_in: int) -> float:
        """Return the slope of R[n] over ln n from ``burn_in`` samples on (least squares over the curve).

        Raises
        ------
        FitError
            If fewer than three points of the curve lie there.
        """
        late = (self.steps >= burn_in) & np.isfinite(self.curve)
        if int(late.sum()) < 3:
            raise FitError(
                "slope of the regret",
                expected="at least 3 points of the curve after the burn-in",
                got=str(int(late.sum())),
                remedy="score a longer stream, ask for more points, or shorten the burn-in",
            )
        return float(np.polyfit(np.log(self.steps[late]), self.curve[late], 1)[0])

    @property
    def theory(self) -> FloatArray:
        """The law of theory at :attr:`steps` (P,): its rise as the theory says it, its level that of the curve.

        Where theory gives no factor, both are fitted to the curve and only the shape can be compared; NaN where there
        is no theorem, or fewer than three points after the burn-in.
        """
        fitted = self._fitted()
        if fitted is None or self.growth is None:
            return np.full(self.steps.size, np.nan)
        level, rise = fitted
        law, late = self.growth.of(self.steps), self._late()
        if self.growth.factor is not None:
            rise = self.growth.factor * self._unit
            level = float(np.mean(self.curve[late] - rise * law[late]))
        return np.asarray(level + rise * law)

    @property
    def over_theory(self) -> float | None:
        """How fast the curve rises, over what theory says; None where theory gives no factor."""
        fitted = self._fitted()
        if fitted is None or self.growth is None or not self.growth.factor or not self._unit > 0:
            return None
        return fitted[1] / (self.growth.factor * self._unit)

    @property
    def _unit(self) -> float:
        """Loss of the minimiser for a sample, after the burn-in."""
        skipped = int(self.details.get("burn_in", 0))
        return float(np.mean(self.hindsight[skipped:])) if self.hindsight.size > skipped else float("nan")

    def _late(self) -> NDArray[np.bool_]:
        """Return which points of the curve (P,) lie well after the burn-in."""
        return (self.steps > SETTLED * int(self.details.get("burn_in", 0))) & np.isfinite(self.curve)

    def _fitted(self) -> tuple[float, float] | None:
        """Return level and rise of the law that fit the curve best; None where it cannot be fitted."""
        late = self._late()
        if self.growth is None or int(late.sum()) < 3:
            return None
        if self.growth.law == "bounded":
            return 0.0, float(np.mean(self.curve[late]))
        rise, level = np.polyfit(self.growth.of(self.steps[late]), self.curve[late], 1)
        return float(level), float(rise)


def regret(
    online: OnlineIdentifier,
    trajectories: Sequence[Trajectory],
    *,
    rng: np.random.Generator,
    scaled: bool = True,
    points: int = 24,
) -> Regret:
    """Run an online identifier over records and compare it with the best fixed predictor of its class.

    The loss is the squared error summed over the outputs, each relative to its standard deviation over the stream (on a
    category output: 1 for a wrong answer). Every prediction is made before the output is shown.

    Parameters
    ----------
    online : OnlineIdentifier
    trajectories : sequence of Trajectory
        The stream; the identifier is told of each seam.
    rng : numpy.random.Generator
    scaled : bool
        False leaves the losses in the outputs' own units, squared.
    points : int
        Lengths n, evenly spaced in ln n, at which R[n] is taken against the best fixed model of the first n samples;
        each costs one batch fit. 0 leaves the curve out.

    Raises
    ------
    FitError
        If there is nothing to predict, or the hindsight losses do not belong to the same samples.
    """
    if not trajectories or all(len(record) < 2 for record in trajectories):
        raise FitError("an empty stream", expected="at least 2 samples", got="fewer", remedy="record more")
    spec = trajectories[0].spec
    state = online.init(spec, rng=rng)
    rows: list[FloatArray] = []
    for record in trajectories:
        state = online.start(state, record.y[0])
        if isinstance(online, Tracking):
            guesses, state = online.track(state, record.u[:-1], record.y[1:])
            rows.append(_losses(spec, record.y[1:], guesses))
            continue
        for k in range(len(record) - 1):
            guess = np.asarray(online.predict(state, record.u[k]), dtype=float)
            rows.append(_losses(spec, record.y[k + 1], guess)[None])
            state = online.update(state, record.u[k], record.y[k + 1])
    own = np.concatenate(rows)
    best = online.hindsight(trajectories)
    if best.losses.shape != (len(own),):
        raise FitError(
            "hindsight of the online identifier",
            expected=f"one loss for each predicted sample, shape {(len(own),)}",
            got=str(best.losses.shape),
            remedy="let hindsight() predict the same samples, y[1:] of every record",
        )
    scale = _scale(trajectories) if scaled and (spec.ny == 1 or best.per_output is not None) else np.ones(spec.ny)
    losses = own @ scale**-2.0
    steps, curve = _curve(online, trajectories, losses, scale, points)
    return Regret(losses, _total(best, scale), best.exact, steps, curve, scale, best.details, best.growth)


def _losses(spec: PlantSpec, measured: FloatArray, guess: FloatArray) -> FloatArray:
    """Return the squared error of each output (..., ny), categories counted as right or wrong."""
    miss = residual(spec.outputs, measured, guess)
    for column, channel in enumerate(spec.outputs):
        if channel.kind == "category":
            miss[..., column] = miss[..., column] != 0.0
    return miss * miss


def _scale(trajectories: Sequence[Trajectory]) -> FloatArray:
    """Return the standard deviation of each output over the stream; 1 of categories and of outputs that stand still."""
    channels = trajectories[0].spec.outputs
    size = np.ones(len(channels))
    for i, channel in enumerate(channels):
        if channel.kind == "category":
            continue
        parts = [record.y[:, i] for record in trajectories]
        if channel.period is not None:
            parts = [np.unwrap(part, period=channel.period) for part in parts]
        spread = float(np.std(np.concatenate(parts)))
        size[i] = spread if spread > 0 else 1.0
    return size


def _total(best: Hindsight, scale: FloatArray) -> FloatArray:
    """Return the losses of the minimiser in scaled outputs (M,)."""
    if best.per_output is not None:
        return np.asarray(np.asarray(best.per_output, dtype=float) @ scale**-2.0)
    return np.asarray(best.losses, dtype=float) / (scale[0] ** 2 if scale.size == 1 else 1.0)


def _curve(
    online: OnlineIdentifier, trajectories: Sequence[Trajectory], losses: FloatArray, scale: FloatArray, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return lengths n and R[n]; lengths at which no batch model can be had are left out."""
    if points < 1:
        return np.zeros(0), np.zeros(0)
    total = np.cumsum(losses)
    steps, curve = [], []
    for n in np.unique(np.geomspace(1, losses.size, points).round().astype(int)):
        try:
            best = online.hindsight(_first(trajectories, int(n)))
        except FitError:
            continue
        steps.append(float(n))
        curve.append(float(total[n - 1] - _total(best, scale).sum()))
    return np.array(steps), np.array(curve)


def _first(trajectories: Sequence[Trajectory], n: int) -> list[Trajectory]:
    """Return the part of a stream that holds its first n predicted samples."""
    found: list[Trajectory] = []
    for record in trajectories:
        if n <= 0:
            break
        part = record[: n + 1]
        found.append(part)
        n -= len(part) - 1
    return found
