"""Fisher scoring with Levenberg's damping: the maximum of a likelihood whose passes tell its first derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.kalman_pass import Filtered
from harness.physics.fitting.maximum import FIRST_DAMPING, LONGEST, LikelihoodFit
from harness.physics.fitting.secant import Here, Secant
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.kalman_pass import Pass
    from harness.physics.compiled.system import System
    from harness.physics.fitting.maximum import NoiseModel, Point

ENOUGH = 0.02  # A step that brings less than this much log-likelihood ends a fit: nothing is decided by a fiftieth.
_BROKEN = 1.0
"""A promise that no step keeps ends a fit at its maximum up to here: rivals tie within three times as much."""
_ROUGH = 0.3
"""Below this promise the derivatives of gains and variances count, and difference quotients are taken of all."""
_STALE = 0.05  # Log-likelihood gained since, from which on these are taken anew: it is a third of a standard error.
_SETTLED = 5  # Iterations after which a step is taken as typical of those to come.
_TOLD = 1e-12  # Curvature along a direction, over the largest, below which it is rounding: nothing is told along it.
_PARTLY = 1e-3  # Share of such a direction from which on an entry is undetermined.
_CORNERS = 3  # Parameters along which a likelihood may have a corner at once: limits of two outputs, and one to spare.
_SIDES = tuple(side * part for part in (1.0, 0.1, 0.01, 1e-3) for side in (1.0, -1.0))
"""Of a Newton step along one parameter, to both sides, that must all be worse on a corner."""
_KEPT = 0.5  # Share of its promise below which a step along a narrow valley is corrected for the bend of the valley.
_BENT = 0.75  # Length of a correction over that of the one before it, at most: beyond it they lead nowhere.
_LEAST_DAMPING = 1e-7
_MOST_DAMPING = 1e9


@dataclass(frozen=True, eq=False)
class Place:
    """A vector, minus the log-likelihood there, and the passes: none, and an infinite value, if one diverges."""

    z: FloatArray
    value: float
    passes: list[Filtered]


class Maximised(Protocol):
    """What is maximised: a likelihood over one vector of parameters, initial states and logarithms of the noise."""

    system: System
    noise_model: NoiseModel
    filter: Pass

    def layout(self) -> tuple[list[str], npt.NDArray[np.bool_], FloatArray, FloatArray]:
        """Return names, whether logarithmic, lower and upper bounds of the vector."""
        ...

    def place(self, z: FloatArray) -> Place:
        """Return a vector with its value and its passes."""
        ...

    def unpack(self, z: FloatArray) -> Point:
        """Return the point of a vector."""
        ...

    def jacobians(self, *given: Any, **how: Any) -> tuple[FloatArray, FloatArray]:
        """Return what chosen entries do to innovations and variances; see ``Likelihood.jacobians``."""
        ...


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Minus the log-likelihood about a place, to second order in the entries that are estimated."""

    by_e: FloatArray  # (n, K): What the entries do to innovations, over their deviations
    gradient: FloatArray  # (n,)
    matrix: FloatArray  # (n, n): Fisher's, in the last steps of free runs with what gradients told beyond it
    live: npt.NDArray[np.bool_]  # array of bool (n,): Entries that the gradient does not hold on a bound

    @property
    def finite(self) -> bool:
        """Whether all derivatives are."""
        return bool(np.isfinite(self.gradient).all() and np.isfinite(self.matrix).all())

    @cached_property
    def size(self) -> FloatArray:
        """What turns entries into standard deviations, each with the others held."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.matrix), 1e-12)))

    @cached_property
    def scaled(self) -> FloatArray:
        """The matrix in these units."""
        return np.asarray(self.matrix / np.outer(self.size, self.size))

    def promise(self, moved: FloatArray) -> float:
        """Return the log-likelihood that a step is to bring."""
        return -float(self.gradient @ moved + 0.5 * moved @ self.matrix @ moved)

    def whole_promise(self) -> float:
        """Return what an undamped step of the live entries is to bring."""
        return undamped(self.scaled[np.ix_(self.live, self.live)], (self.gradient / self.size)[self.live])

    def damped(self, slope: FloatArray, damping: float, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return Levenberg's step against a slope, within bounds of the step, in standard deviations."""
        return damped(self.scaled, slope / self.size, damping, self.live, low * self.size, high * self.size)


@dataclass(frozen=True, eq=False)
class Step:
    """A step with more and more damping: where it is likelier (None: nowhere), and what it promised first and last."""

    place: Place | None
    promise: float
    first: float


class FisherScoring:
    """A search for the maximum of a likelihood by Fisher scoring with Levenberg's damping.

    First derivatives are those of the innovations; the last steps may count those of gains and variances, too.

    - ``at``: the best so far
    - ``damping``: of the next step, over the diagonal
    - ``least_raised``: from where it rises when a step fails, at least
    - ``valley``: whether the search is in a narrow valley that bends: long steps are corrected for the bend
    - ``last``: whether these are the last steps: what brings little ends the search
    - ``more``: what gains and variances add to the Jacobians; None if it is to be taken
    - ``seen``: value where that was taken
    - ``plain``: what a whole step promised there without it
    - ``gain``: log-likelihood that the last step brought
    - ``converged, beyond, message, count``: see :class:`LikelihoodFit`
    """

    def __init__(
        self, likelihood: Maximised, begin: Place, entries: npt.NDArray[np.intp], *, damping: float, exact: bool,
        near: bool,
    ) -> None:  # fmt: skip
        names, log, low, high = likelihood.layout()
        ny, latent = likelihood.filter.ny, likelihood.noise_model.latent
        self._likelihood, self._latent, self._entries = likelihood, latent, entries
        self._names, self._log = tuple(names[k] for k in entries), log[entries]
        self._low, self._high = low[entries], high[entries]
        self._longest = np.where(self._log, LONGEST, np.inf)
        self._noise_bounds = low[-ny:], high[-ny:]
        self._exact = exact and latent
        self._noise_follows = not latent and int((entries >= len(names) - ny).sum()) == ny
        self._matrix = np.eye(len(entries))
        self._deviations: FloatArray | None = None
        self._secant = None if latent else Secant(len(entries))
        self.at, self.damping, self.last, self.valley = begin, damping, near, False
        # free runs of parameters that these records hardly tell apart lie in a narrow valley: there damping rises from
        # where it held, and a short step that brings little is no end while a long one promises more
        self.least_raised = 1e-4 if latent else _LEAST_DAMPING
        self.more: tuple[FloatArray, FloatArray] | None = None
        self.seen, self.plain, self.gain = begin.value, np.inf, 0.0
        self.converged, self.beyond, self.message, self.count = False, False, "", 0

    def run(self, most: int, reach: float) -> None:
        """Take up to ``most`` steps; give up once steps like the last one would not come to ``reach``."""
        for count in range(1, most + 1):
            self.count = count
            with np.errstate(all="ignore"):
                model = self._quadratic()
            if not model.finite:
                self.message = "derivatives are not finite"
                return
            step = self._step(model)
            if step.place is None:
                if self._ends_without(step, model):
                    return
                continue
            self._take(step.place)
            if count >= _SETTLED and self.at.value - (most - count) * self.gain > reach:
                self.message, self.beyond = "its steps do not bring it within reach", True
                return
            if self._ends_with(step, model):
                return
        self.message = f"no maximum after {most} iterations"

    def _quadratic(self) -> Quadratic:
        """Return the expansion about the place; what is exact is taken in the last steps, and kept."""
        likelihood, at, entries = self._likelihood, self.at, self._entries
        by_e, by_s = likelihood.jacobians(at.z, at.passes, entries, False, self._deviations)
        if self.last and self._exact:
            if self.more is None:
                gradient, matrix = scored(at.passes, by_e, by_s)
                self.plain = undamped(matrix, gradient)
                whole = likelihood.jacobians(at.z, at.passes, entries, True, self._deviations)
                self.more, self.seen = (whole[0] - by_e, whole[1] - by_s), at.value
            by_e, by_s = by_e + self.more[0], by_s + self.more[1]
        gradient, self._matrix = scored(at.passes, by_e, by_s)
        self._deviations = 1.0 / np.sqrt(np.maximum(np.diag(self._matrix), 1e-300))
        z, matrix = at.z[entries], self._matrix
        if self._secant is not None:
            here = Here(z, at.value, gradient, matrix, (by_e, by_s))
            self._secant.learn(here, lambda derivatives: scored(at.passes, *derivatives, second=False)[0])
            matrix = self._secant.added_to(matrix) if self.last else matrix
        stuck = ((z <= self._low) & (gradient > 0)) | ((z >= self._high) & (gradient < 0))
        return Quadratic(by_e, gradient, matrix, ~stuck)

    def _step(self, model: Quadratic) -> Step:
        """Return a step that is damped until it raises the likelihood, or promises next to nothing."""
        entries, z = self._entries, self.at.z[self._entries]
        low, high = np.maximum(self._low - z, -self._longest), np.minimum(self._high - z, self._longest)
        promise, first, growth, heavy = np.inf, np.inf, 8.0, self.damping > FIRST_DAMPING
        while self.damping < _MOST_DAMPING:
            step = model.damped(model.gradient, self.damping, low, high) / model.size
            trial = self.at.z.copy()
            trial[entries] = np.clip(z + step, self._low, self._high)
            moved = trial[entries] - z
            promise = model.promise(moved)
            if heavy and 0 <= promise < ENOUGH:  # only a long step promises little where there is little
                self.damping, heavy = FIRST_DAMPING, False
                continue
            heavy = False
            first = promise if first == np.inf and promise >= 0 else first
            place = self._likelihood.place(trial)
            if self.valley and promise >= ENOUGH:
                place = self._around_the_bend(model, place, moved, self.at.value - _KEPT * promise)
            if place.value < self.at.value:
                return Step(place, promise, first)
            if 0 <= promise < ENOUGH:
                break
            self.damping, growth = max(self.damping, self.least_raised) * growth, 8.0 if self.valley else 32.0
        return Step(None, promise, first)

    def _around_the_bend(self, model: Quadratic, first: Place, moved: FloatArray, wanted: float) -> Place:
        """Return the best place of a step that is corrected until it keeps its promise, or bends too much for that.

        Along a narrow valley that bends, a step is as short as its straight part is. What its first order missed is
        taken back, all over the same derivatives: the geodesic acceleration of Transtrum & Sethna 2012
        (arXiv:1201.5885, sec. 2), of a whole step and more than once.
        """
        entries, z = self._entries, self.at.z[self._entries]
        low, high = np.maximum(self._low, z - self._longest), np.minimum(self._high, z + self._longest)
        best = place = first
        length = float(np.linalg.norm(moved * model.size))
        e, s = joined(self.at.passes)
        while place.passes and best.value > wanted:
            missed = (joined(place.passes)[0] - e) / np.sqrt(s) - moved @ model.by_e
            bent = model.by_e @ np.where(np.isfinite(missed), missed, 0.0)
            here = place.z[entries]
            turn = model.damped(bent, self.damping, low - here, high - here)
            if np.linalg.norm(turn) > _BENT * length:
                break
            length = float(np.linalg.norm(turn))
            trial = place.z.copy()
            trial[entries] = np.clip(here + turn / model.size, low, high)
            place = self._likelihood.place(trial)
            if not place.value < best.value:  # corrections that begin to lose do not come back
                break
            best = place
        return best

    def _take(self, place: Place) -> None:
        """Go to a likelier place."""
        if self._noise_follows:
            place = self._concentrated(place)
        self.gain, self.at = self.at.value - place.value, place
        self.damping = max(self.damping / 8.0, _LEAST_DAMPING)

    def _concentrated(self, place: Place) -> Place:
        """Return a place with the sensor noise of its free run at the maximum, in the passes too."""
        z, (low, high) = place.z.copy(), self._noise_bounds
        ny = len(low)
        rms = np.sqrt(np.nanmean(np.concatenate([passed.e for passed in place.passes]) ** 2, axis=0))
        z[-ny:] = np.clip(np.log(np.maximum(rms, 1e-300)), low, high)
        for passed in place.passes:
            passed.s = np.broadcast_to(np.exp(2 * z[-ny:]), passed.s.shape).copy()
        return Place(z, float(sum(passed.nll for passed in place.passes)), place.passes)

    def _ends_with(self, step: Step, model: Quadratic) -> bool:
        """Return whether a step that was taken is the last one; if not, decide how to go on."""
        if not self.last:
            self.last = max(self.gain, step.promise) < _ROUGH
            return False
        if self.gain >= ENOUGH:
            return False
        short = self.damping > 8.0 * _LEAST_DAMPING and not (self.valley and self._latent)
        by_fisher = replace(model, matrix=self._matrix)  # what was learned may be of elsewhere
        if short and not by_fisher.whole_promise() < _ROUGH:  # a narrow valley that bends: long steps, corrected for it
            self.valley, self.least_raised, self.damping = True, _LEAST_DAMPING, _LEAST_DAMPING
            return False
        self.converged = self.more is None or self.seen - self.at.value < _STALE
        self.more = None
        return self.converged

    def _ends_without(self, step: Step, model: Quadratic) -> bool:
        """Return whether a place that no step leads away from is the end; if not, decide how to go on."""
        if not self.last:
            self.last, self.damping = True, FIRST_DAMPING
            return False
        if self.more is not None and self.seen - self.at.value >= _STALE:
            self.more, self.damping = None, FIRST_DAMPING
            return False
        # where steps of the solver follow the motion, difference quotients may be rounding: without them then; where
        # they pass over a corner of a law, the likelihood is as rough as that
        self.converged = min(step.first, self.plain) < _BROKEN
        if not self.converged:
            self.converged, better = self._at_corner(model)
            if better is not None:
                self.gain, self.at = self.at.value - better.value, better
                if self.gain >= _BROKEN:
                    self.last, self.damping = False, FIRST_DAMPING
                    return False
                self.converged = True  # from corner to corner: what is left is as small as a promise that is not kept
        self.message = "" if self.converged else "no step raises the likelihood"
        return True

    def _at_corner(self, model: Quadratic) -> tuple[bool, Place | None]:
        """Return whether a place that no step leads away from is a maximum on a corner, or a likelier place beside it.

        Where a sample changes sides (a reading at its limit, say) the likelihood has a corner along one parameter, and
        a gradient there that no step keeps. It is a maximum if it falls to both sides of every such parameter, and the
        others, with these held, promise nothing.
        """
        gradient, rest = model.gradient, model.live.copy()
        curvature = np.maximum(np.diag(model.matrix), 1e-12)
        with np.errstate(over="ignore"):  # of a place far off its data
            promises = np.where(rest, 0.5 * gradient**2 / curvature, 0.0)
        for row in np.argsort(-promises)[:_CORNERS]:
            if promises[row] < ENOUGH:
                break
            k = self._entries[row]
            for part in _SIDES:
                trial = self.at.z.copy()
                step = part * abs(gradient[row]) / curvature[row]
                trial[k] = np.clip(trial[k] + step, self._low[row], self._high[row])
                place = self._likelihood.place(trial)
                if place.value < self.at.value - ENOUGH:
                    return False, place
            rest[row] = False
            if undamped(model.matrix[np.ix_(rest, rest)], gradient[rest]) < _BROKEN:
                return True, None
        return False, None

    def fit(self) -> LikelihoodFit:
        """Return what was found, with its covariance; what lies on a bound has none."""
        matrix, z = self._matrix, self.at.z[self._entries]
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
        near = 1e-6
        free = self._entries < self._likelihood.filter.parameter_count
        margin = np.where(self._log, near, near * np.maximum(np.abs(z), 1e-12))
        bound = (z <= self._low + margin) | (z >= self._high - margin)
        inner = ~bound
        covariance = np.zeros_like(matrix)
        undetermined = np.zeros(len(z), dtype=bool)
        if not np.isfinite(matrix).all():
            inner = np.zeros_like(bound)
        if inner.any():
            eigenvalues, vectors = np.linalg.eigh(matrix[np.ix_(inner, inner)] / np.outer(size[inner], size[inner]))
            told = eigenvalues > _TOLD * eigenvalues[-1]
            inverse = (vectors[:, told] / eigenvalues[told]) @ vectors[:, told].T
            covariance[np.ix_(inner, inner)] = inverse / np.outer(size[inner], size[inner])
            undetermined[inner] = (np.abs(vectors[:, ~told]) > _PARTLY).any(axis=1)

        def named(where: npt.NDArray[np.bool_]) -> tuple[str, ...]:
            return tuple(self._names[k] for k in np.flatnonzero(where))

        return LikelihoodFit(
            self._likelihood.system,
            self._likelihood.unpack(self.at.z),
            self.at.value,
            [passed.terms for passed in self.at.passes],
            self._names,
            covariance,
            self._log,
            self.converged,
            named(bound & (free | (z > self._low + margin))),
            self.count,
            self.message,
            list(self.at.passes),
            beyond=self.beyond,
            pace=0.0 if self.converged else self.gain,
            damping=self.damping,
            undetermined=named(undetermined),
        )


def undamped(matrix: FloatArray, gradient: FloatArray) -> float:
    """Return what a whole Gauss-Newton step promises."""
    return 0.5 * float(gradient @ np.linalg.pinv(matrix, rcond=_TOLD, hermitian=True) @ gradient)


def damped(
    matrix: FloatArray,
    gradient: FloatArray,
    damping: float,
    live: npt.NDArray[np.bool_],
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Return Levenberg's step of the live entries within bounds; what would go beyond stays there, and others follow.

    A logarithm of something that the data hardly tell wants long steps. If it alone were shortened, the step of the
    others would be that for a place where it never comes.
    """
    step = np.zeros(len(gradient))
    free = live.copy()
    for _ in range(3):
        inner = matrix[np.ix_(free, free)] + (damping + 1e-12) * np.eye(int(free.sum()))
        right = gradient[free] + matrix[np.ix_(free, ~free)] @ step[~free]
        step[free] = -np.linalg.solve(inner, right)
        beyond = free & ((step < low) | (step > high))
        step = np.clip(step, low, high)
        if not beyond.any():
            break
        free &= ~beyond
    return step


def joined(found: list[Filtered]) -> tuple[FloatArray, FloatArray]:
    """Return innovations and variances of all records, one after the other."""
    e = np.concatenate([passed.e.ravel() for passed in found])
    return e, np.concatenate([passed.s.ravel() for passed in found])


def scored(
    found: list[Filtered], by_e: FloatArray, by_s: FloatArray, *, second: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return gradient and Fisher matrix for derivatives of innovations, over their deviations, and log variances.

    Record by record: an initial state moves one of many. The matrix stays 0 if nobody asks for it (``second``).
    """
    gradient, matrix = np.zeros(len(by_e)), np.zeros((len(by_e), len(by_e)))
    first = 0
    for passed in found:
        here = slice(first, first + passed.e.size)
        normal = (np.where(np.isfinite(passed.e), passed.e, 0.0) / np.sqrt(passed.s)).ravel()
        for by, left, share in ((by_e, normal, 1.0), (by_s, 1.0 - normal**2, 0.5)):
            rows = np.flatnonzero(by[:, here].any(axis=1))
            part = by[:, here] if len(rows) == len(by) else by[rows, here]
            gradient[rows] += share * (part @ left)
            if second:
                matrix[np.ix_(rows, rows)] += share * (part @ part.T)
        first = here.stop
    return gradient, matrix
