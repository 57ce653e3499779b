"""How likely the validation records are, given the estimation records: parameters are as uncertain as these leave them.

A motion that amplifies small errors (a pendulum near its top) turns an error of a parameter of one standard deviation
into any error of the prediction. Judged at the estimate alone the true law would lose there to any other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.forms.named import day_groups
from harness.diagnosis.search.compare import wrong_signs
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.compiled.kalman_pass import Filtered
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import LikelihoodFit, Point
from harness.signals import FloatArray

_MOST = 12
"""Steps; a record that is predicted needs one or two."""
_ENOUGH = 0.02
"""Log-likelihood below which a step is not taken: nothing is decided by a fiftieth."""
_HALVINGS = 6
_ALIVE = 1e-9
"""Share of the largest singular value below which an initial state moves nothing."""


@dataclass(frozen=True, eq=False)
class PredictiveDensity:
    """Where parameters and initial states are likeliest, given both uses, and what their uncertainty costs."""

    point: Point
    moved: FloatArray
    """(k,): How far the parameters went from those of the estimation records, along their spread, in standard
    deviations."""
    price: float  # To be taken from the log-likelihood of the validation records at ``point``
    density: float = np.nan  # The logarithm of what is left; not kept with a fit


def spread_of(
    best: LikelihoodFit, free: Sequence[str], own: Sequence[str], effects: Sequence[Placed] = ()
) -> FloatArray:
    """Return a square root of the covariance of parameters, (count, k), themselves and not their logarithms.

    What is 0 in truth lies a few deviations from a small estimate, and infinitely many of its logarithm.

    - ``best``: of the estimation records
    - ``own``: those among them that belong to a record, and are no knowledge about another one: rows of 0
    - ``effects``: of the fit, where what is a day's own may differ from the estimation records
    """
    groups = day_groups(effects)
    days = [[share * best.parameters[name] if name in names else 0.0 for name in free] for names, share in groups]
    return np.hstack([_known(best, free, own), np.reshape(days, (len(days), len(free))).T])


def day_values(effects: Sequence[Placed], values: Mapping[str, float], moved: FloatArray) -> dict[str, float]:
    """Return what is not as in ``values`` on the day of the validation records, as ``moved`` has it.

    Examples
    --------
    >>> from harness.effects.dictionary import builtin
    >>> from harness.effects.effect import Placed
    >>> friction = Placed(builtin()["coulomb_friction"], "theta")
    >>> levels = day_values([friction], {"coulomb_friction@theta.Fc": 0.1}, np.array([0.3, -2.0]))
    >>> round(levels["coulomb_friction@theta.Fc"], 6)
    0.04
    """
    days = day_groups(effects)
    changes = [share * part for part, (_, share) in zip(moved[len(moved) - len(days) :], days, strict=True)]
    return {
        name: float(values[name] * (1.0 + change))
        for change, (names, _) in zip(changes, days, strict=True)
        for name in names
        if change
    }


def _known(best: LikelihoodFit, free: Sequence[str], own: Sequence[str]) -> FloatArray:
    """Return a square root of the covariance that the estimation records leave, (count, k)."""
    rows = [best.names.index(name) for name in free]
    scale = np.where(best.logarithmic[rows], [best.parameters[name] for name in free], 1.0)
    covariance = best.covariance[np.ix_(rows, rows)] * np.outer(scale, scale)
    for k, name in enumerate(free):
        if name in own:
            covariance[k], covariance[:, k] = 0.0, 0.0
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = size > 0
    scale = np.where(known, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None])[:, values > 0])


def predicted(
    likelihood: Likelihood,
    start: Point,
    best: LikelihoodFit,
    free: Sequence[str],
    own: Sequence[str],
    effects: Sequence[Placed],
    enough: float = np.inf,
) -> PredictiveDensity:
    """Return the density of records given those of the estimation, on the same day or another one: the larger of both.

    Another day is asked only where the log-density on the same one is below ``enough``: it makes wrong laws likelier,
    too. A friction that would drive there, and not brake, is none of another day.
    """
    same = predictive(likelihood, start, free, spread_of(best, free, own))
    days = day_groups(effects)
    same = replace(same, moved=np.append(same.moved, np.zeros(len(days))))
    if not days or same.density >= enough:
        return same
    spread = spread_of(best, free, own, effects)
    other = predictive(likelihood, start, free, spread)
    if other.density > same.density:  # its noise was that of this day's friction
        parameters = likelihood.system.parameter_names
        belongs = [*(name for name in likelihood.names if name not in parameters), *own]
        settled = likelihood.maximise(other.point, free=belongs, exact=False).point
        shared = np.isin(parameters, [name for name in free if name not in own])
        anew = replace(settled, p=np.where(shared, start.p, settled.p))
        again = predictive(likelihood, anew, free, spread, other.moved)
        other = max(other, again, key=lambda found: found.density)
    levels = {**best.parameters, **day_values(effects, best.parameters, other.moved)}
    drives = any(wrong_signs(placed, levels) for placed in effects)
    return same if drives or same.density >= other.density else other


def predictive(
    likelihood: Likelihood,
    start: Point,
    free: Sequence[str],
    spread: FloatArray,
    moved: FloatArray | None = None,
) -> PredictiveDensity:
    """Return the density of records that parameters with a normal spread predict, by Laplace's approximation.

    ``log p(y) = max [log p(y | p, x0) - |moved|^2 / 2] - log det(I + J' J) / 2`` with the derivatives J of the whitened
    innovations along the spread, what the initial states can do taken out (Tierney & Kadane 1986, J. Am. Stat. Assoc.
    81:82, eq. 2.2). The maximum by Gauss-Newton steps.

    Raises FitError if the derivatives are not finite.

    - ``likelihood``: of the records that are predicted
    - ``start``: estimates, and initial states of these records
    - ``free``: parameters (count of them)
    - ``spread`` (count, k): a square root of the covariance
    - ``moved`` (k,): where along it the steps begin
    """
    system = likelihood.system
    places = np.array([system.parameter_names.index(name) for name in free], dtype=np.intp)
    low = np.array([system.parameters[k].minimum for k in places])
    high = np.array([system.parameters[k].maximum for k in places])
    count, states = likelihood.filter.parameter_count, likelihood.filter.start_size
    columns = np.concatenate([places, np.arange(count, count + states)]).astype(np.intp)
    first = start.p[places]

    def at(moved: FloatArray, x0: list[FloatArray]) -> Point:
        p = start.p.copy()
        p[places] = np.clip(first + spread @ moved, low, high)
        return replace(start, p=p, x0=x0)

    moved = np.zeros(spread.shape[1]) if moved is None else moved
    point, price = at(moved, start.x0), 0.0
    value = likelihood.nll(point) + 0.5 * float(moved @ moved)
    for number in range(_MOST + 1):
        paths = likelihood.filtered(point, columns=columns)
        if paths is None:
            break
        with np.errstate(all="ignore"):  # of a motion that a deviation takes out of all bounds
            parts = [_outside_starts(passed, len(places), spread) for passed in paths]
            matrix = np.eye(len(moved)) + sum(part.along.T @ part.along for part in parts)
        if not np.isfinite(matrix).all():
            raise FitError(
                "prediction of the validation records",
                expected="derivatives that are finite",
                got="a motion that amplifies everything",
                remedy="refit the model",
            )
        price = 0.5 * float(moved @ moved + np.linalg.slogdet(matrix)[1])
        gradient = moved + sum(part.along.T @ part.left for part in parts)
        step: FloatArray = np.asarray(-np.linalg.lstsq(matrix, gradient)[0], dtype=float)  # sizes differ by 1e16
        promise = 0.5 * (float(-gradient @ step) + sum(part.taken for part in parts))
        if promise < _ENOUGH or number == _MOST:
            break
        moves = [part.start(step) for part in parts]
        lost: list[float] = []
        for halving in range(_HALVINGS):
            share = 0.5**halving
            new = moved + share * step
            trial = at(new, [x + share * move for x, move in zip(point.x0, moves, strict=True)])
            better = likelihood.nll(trial) + 0.5 * float(new @ new)
            if better < value:
                point, moved, value = trial, new, better
                break
            lost.append(better - value)
            if not _may_gain(lost[-2:]):
                break
        if len(lost) > halving:
            break
    return PredictiveDensity(point, moved, price, 0.5 * float(moved @ moved) - value - price)


def _may_gain(lost: Sequence[float]) -> bool:
    """Return whether a shorter step may bring something, by the parabola through what two steps have lost.

    The second is half of the first. Gains are held fixed in the derivatives: where little is left, the likelihood may
    fall along the step from its beginning.

    Examples
    --------
    >>> _may_gain([0.50, 0.22]), _may_gain([54.8, 10.2])
    (False, True)
    """
    if len(lost) < 2 or not np.isfinite(lost).all():
        return True
    whole, half = lost
    slope, bend = 4.0 * half - whole, 2.0 * (whole - 2.0 * half)
    return slope < 0.0 and slope**2 > 4.0 * bend * _ENOUGH


@dataclass(frozen=True, eq=False)
class _Part:
    """A record's whitened innovations and derivatives along the spread, without what its initial state can do."""

    left: FloatArray
    along: FloatArray
    taken: float
    whole: tuple[FloatArray, FloatArray]
    solve: FloatArray

    def start(self, step: FloatArray) -> FloatArray:
        """Return the move of the initial state that goes with a step along the spread."""
        residual, along = self.whole
        return np.asarray(-self.solve @ (residual + along @ step))


def _outside_starts(passed: Filtered, count: int, spread: FloatArray) -> _Part:
    """Return a record's part of the least-squares problem, its initial state solved for."""
    assert passed.j is not None
    residual = whitened(passed.e, passed.s)
    j = whitened(passed.j, passed.s[..., None])
    along, starts = j[:, :count] @ spread, j[:, count:]
    size = np.linalg.norm(starts, axis=0)
    scale = np.where(size > 0, size, 1.0)
    u, s, vt = np.linalg.svd(starts / scale, full_matrices=False)
    alive = s > _ALIVE * s.max(initial=1e-300)
    u = u[:, alive]
    solve = (vt[alive].T / s[alive]) @ u.T / scale[:, None]
    inside = u.T @ residual
    return _Part(residual - u @ inside, along - u @ (u.T @ along), float(inside @ inside), (residual, along), solve)


def whitened(values: FloatArray, variance: FloatArray) -> FloatArray:
    """Return values (N, ny, ...) over their standard deviation, flat; what was not measured is 0."""
    scaled = np.where(np.isfinite(values), values, 0.0)
    scaled /= np.sqrt(variance)
    return np.asarray(scaled.reshape(scaled.shape[0] * scaled.shape[1], *scaled.shape[2:]))
