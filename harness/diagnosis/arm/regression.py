"""A regression on measured motion as a form of the search: residual torques with a coloured error by joint."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.policy import ARM_POLICY, POLICY, ArmPolicy
from harness.diagnosis.search.coloured import Before, Coloured, fitted_error
from harness.diagnosis.search.fit import Begun, Column, ColumnKind, Fit, InOneGo, Jump, Linearised, Suspect
from harness.diagnosis.systems import Parametrised, Starts
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.errors import HarnessError
from harness.physics.compiled.kalman_pass import Filtered
from harness.physics.definition.parameters import Parameter
from harness.signals import FloatArray

USES = ("estimation", "validation")
ROUNDS = 12
"""Times that parameters and errors are fitted in turn, at most."""
STEPS = 40
"""Steps from one start, at most."""
SETTLED = 1e-3
"""Change of the log-likelihood below which neither moves any more."""
EXACT = 1e-9
"""Smallest error, in units of the torque's standard deviation: rounding of a simulation."""
NEAR = 1e-6
"""Share of a bound's size, or of 1, within which a value lies on it."""
FARTHEST = 200.0
"""Logarithm beyond which a parameter is as good as infinite."""


Errors = Sequence[Sequence[Coloured]]
"""For every record those of every joint."""


class Equation(Protocol):
    """The equation of torques with some effects."""

    @property
    def system(self) -> Parametrised:
        """What has the parameters."""
        ...

    @property
    def hidden(self) -> int:
        """Number of values that are estimated beside the parameters: swings that estimation records may begin in."""
        ...

    def residual(self, p: FloatArray, use: str) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every record the residual torque (rows, n) and its derivatives by all parameters (rows, n, np)."""
        ...


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """By how much the residual torque changes, (rows, n, k) by use and record; see Column."""

    placed: Placed | None
    given: dict[str, float]
    names: tuple[str, ...]
    torque: dict[str, list[FloatArray]]
    kind: ColumnKind = "linear"


class TorqueRegression(Protocol):
    """What a regression is about: a model, which rows count, and what effects would change."""

    @property
    def nominal(self) -> Parametrised:
        """The nominal system."""
        ...

    @property
    def counts(self) -> Mapping[str, list[FloatArray]]:
        """By use, for every record 1 for the rows (rows, n) that are judged, else 0."""
        ...

    @property
    def size(self) -> FloatArray:
        """The rms of the torque of every joint that is judged (n,)."""
        ...

    @property
    def own(self) -> frozenset[str]:
        """Names of linear parameters that the validation records fit for themselves."""
        ...

    def equation(self, effects: Sequence[Placed]) -> Equation:
        """Return the equation with effects."""
        ...

    def changes(self, values: Mapping[str, float], candidates: Sequence[Placed]) -> list[TorqueChange]:
        """Return what candidates would change, at some values of the nominal parameters."""
        ...

    def free_torques(self) -> list[TorqueChange]:
        """Return what torques that are no effect would change, over position, speed and torque."""
        ...


@dataclass(frozen=True, eq=False)
class RegressionDetail:
    """What a regression keeps of a fit: by use and record its errors, residual torques (rows, n) and their columns."""

    errors: dict[str, Errors]
    residual: dict[str, list[FloatArray]]
    jacobian: dict[str, list[FloatArray]]


def regression_detail(fit: Fit) -> RegressionDetail:
    """Return what a regression keeps of a fit of its own."""
    assert isinstance(fit.detail, RegressionDetail)
    return fit.detail


@dataclass(frozen=True, eq=False)
class _FirstSteps:
    """The equation that is fitted, and where its first steps led: value, parameters, errors, whether they end there."""

    equation: Equation
    best: tuple[float, FloatArray, Errors, bool]


class RegressionForm(InOneGo):
    """Fits an equation of torques by maximum likelihood; see :class:`harness.diagnosis.search.fit.Form`.

    The error of every joint is Gaussian, stationary and autoregressive; its coefficients are estimated with the
    parameters, in turn (Cochrane & Orcutt 1949, J. Am. Stat. Assoc. 44:32, with the exact density of the first rows and
    of those behind a gap). How large it is, every record says itself: grease is warmer, or the path faster, on another
    day. How long it remembers is the same for all records, and told by those of the estimation.

    Parameters
    ----------
    regression : TorqueRegression
    policy : ArmPolicy
    """

    def __init__(self, regression: TorqueRegression, policy: ArmPolicy = ARM_POLICY) -> None:
        self.regression, self.policy = regression, policy
        self.nominal = regression.nominal
        self.laws = Dictionary.builtin()
        self._before = {
            use: [[Before.of(part[:, k], POLICY.order) for k in range(part.shape[1])] for part in parts]
            for use, parts in regression.counts.items()
        }
        equation = regression.equation(())
        first = equation.residual(equation.system.vector(), "estimation")
        spread = np.sqrt(np.mean(np.concatenate([r for r, _ in first]) ** 2, axis=0))
        self._floor = EXACT * np.maximum(spread, 1e-12)
        rough = tuple(Coloured(np.zeros(POLICY.order), float(max(size, 1e-12))) for size in spread)
        self._rough: Errors = [rough] * len(first)

    # ---- fits --------------------------------------------------------------------------------------------------------

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun | None:
        """See :class:`harness.diagnosis.search.fit.Form`; the steps of a regression are cheap."""
        del hope
        try:
            equation = self.regression.equation(effects)
        except HarnessError:  # two blocks that exclude each other
            return None
        known_errors = [self._rough]
        if base is not None:
            known = (base, self.without_memory(base))
            known_errors = [regression_detail(fit).errors["estimation"] for fit in known if fit is not None]
        best: tuple[float, FloatArray, Errors, bool] | None = None
        for start, errors in itertools.product(starts, known_errors):
            values = {**equation.system.values(), **start}
            p = np.array([values[name] for name in equation.system.parameter_names])
            trial = self._step(equation, p, errors)
            if trial is not None and (best is None or trial[0] > best[0]):
                best = trial
        if best is None:
            return None
        value, p, errors, _ = best
        names = equation.system.parameter_names
        return Begun(tuple(effects), value, dict(zip(names, map(float, p), strict=True)), _FirstSteps(equation, best))

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        del base
        assert isinstance(begun.detail, _FirstSteps)
        equation, (value, p, errors, converged) = begun.detail.equation, begun.detail.best
        for _ in range(ROUNDS):
            again = self._step(equation, p, errors)
            if again is None or again[0] < value:
                break
            gained, (value, p, errors, converged) = again[0] - value, again
            if gained < SETTLED:
                break
        return self._fitted(begun.effects, equation, p, errors, converged)

    def _step(self, equation: Equation, p: FloatArray, errors: Errors) -> tuple[float, FloatArray, Errors, bool] | None:
        """Fit the parameters with these errors, then the errors; None where the residual is not finite."""
        moved = self._parameters(equation, p, errors)
        if moved is None:
            return None
        p, converged = moved
        value, made = self._errors([r for r, _ in equation.residual(p, "estimation")], errors)
        return (value, p, made, converged) if np.isfinite(value) else None

    def _errors(self, residual: Sequence[FloatArray], errors: Errors) -> tuple[float, Errors]:
        """Return the log-likelihood of residuals (rows, n) of the estimation records, and the errors that reach it."""
        shared = [
            fitted_error(
                [r[:, k] / own[k].deviation for r, own in zip(residual, errors, strict=True)],
                [before[k] for before in self._before["estimation"]],
                POLICY.order, float(self._floor[k]) / error.deviation, error,
            )
            for k, error in enumerate(errors[0])
        ]  # fmt: skip
        made = self._sized(residual, "estimation", shared)
        return -sum(Filtered(e, s).nll for e, s in self._innovations(residual, "estimation", made)), made

    def _sized(self, residual: Sequence[FloatArray], use: str, shared: Sequence[Coloured]) -> Errors:
        """Return for every record errors of this memory, of the likeliest size that its residual (rows, n) has."""

        def sized(error: Coloured, values: FloatArray, before: Before, floor: float) -> Coloured:
            white = error.whitened(values, before)
            size = error.deviation * float(np.sqrt(white @ white / max(len(white), 1)))
            return replace(error, deviation=max(size, floor))

        return [
            tuple(sized(*each) for each in zip(shared, part.T, before, self._floor, strict=True))
            for part, before in zip(residual, self._before[use], strict=True)
        ]

    def at(self, fit: Fit) -> Fit | None:
        """Return another form's fit in this one: its effects and values, with the errors that they leave here."""
        equation = self.regression.equation(fit.effects)
        p = np.array([fit.values[name] for name in equation.system.parameter_names])
        residual = [r for r, _ in equation.residual(p, "estimation")]
        if not all(np.isfinite(part).all() for part in residual):
            return None
        made = self._errors(residual, regression_detail(fit).errors["estimation"])[1]
        return self._fitted(fit.effects, equation, p, made, fit.converged)

    def _parameters(self, equation: Equation, p0: FloatArray, errors: Errors) -> tuple[FloatArray, bool] | None:
        """Return the likeliest parameters with these errors, and whether the fit converged."""
        from scipy.optimize import least_squares

        parameters = equation.system.parameters
        free = [k for k, parameter in enumerate(parameters) if not parameter.fixed]
        if not free:
            return p0, True
        logs = np.array([parameters[k].minimum > 0 for k in free], dtype=bool)
        low, high = (np.array([getattr(parameters[k], side) for k in free]) for side in ("minimum", "maximum"))
        with np.errstate(divide="ignore", invalid="ignore"):
            low = np.where(logs, np.log(np.where(logs, low, 1.0)), low)
            high = np.where(logs, np.minimum(np.log(np.where(logs, high, 1.0)), FARTHEST), high)
            z0 = np.where(logs, np.log(np.where(logs, p0[free], 1.0)), p0[free])
        memory: dict[bytes, tuple[FloatArray, FloatArray]] = {}

        def inflated(z: FloatArray) -> FloatArray:
            p = p0.copy()
            p[free] = np.where(logs, np.exp(np.where(logs, z, 0.0)), z)
            return p

        def both(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            key = z.tobytes()
            if key not in memory:
                memory.clear()
                p = inflated(z)
                rows = equation.residual(p, "estimation")
                r = self.whitened([part for part, _ in rows], "estimation", errors)
                j = self.whitened([j[:, :, free] for _, j in rows], "estimation", errors)
                memory[key] = r, j * np.where(logs, p[free], 1.0)
            return memory[key]

        def residual(z: FloatArray) -> FloatArray:
            return both(z)[0]

        def jacobian(z: FloatArray) -> FloatArray:
            return both(z)[1]

        inside = np.clip(z0, low + NEAR * np.isfinite(low), high - NEAR * np.isfinite(high))
        try:
            with np.errstate(all="ignore"):
                solution = least_squares(
                    residual, inside, jac=jacobian, bounds=(low, high), x_scale="jac", max_nfev=STEPS
                )  # fmt: skip
        except (ValueError, np.linalg.LinAlgError):  # a residual that is not finite
            return None
        return inflated(solution.x), bool(solution.success)

    def _fitted(
        self, effects: Sequence[Placed], equation: Equation, p: FloatArray, estimated: Errors, converged: bool
    ) -> Fit | None:
        """Return the fit as the search wants it."""
        system = equation.system
        names = system.parameter_names
        free = [k for k, parameter in enumerate(system.parameters) if not parameter.fixed]
        rows = {use: equation.residual(p, use) for use in USES}
        residual = {use: [r for r, _ in parts] for use, parts in rows.items()}
        jacobian = {use: [j[:, :, free] for _, j in parts] for use, parts in rows.items()}
        if not all(np.isfinite(part).all() for parts in residual.values() for part in parts):
            return None
        own = self._own(tuple(names[k] for k in free))
        sized = self._sized(residual["validation"], "validation", estimated[0])
        residual["validation"], refitted = self._refitted(residual["validation"], jacobian["validation"], own, sized)
        errors = {"estimation": estimated, "validation": self._sized(residual["validation"], "validation", sized[0])}
        logs = [system.parameters[k].minimum > 0 for k in free]
        deviations = _deviations(self.whitened(jacobian["estimation"], "estimation", estimated))
        values = dict(zip(names, map(float, p), strict=True))
        bound = [names[k] for k in free if _on_bound(system.parameters[k], float(p[k]))]
        relative = [abs(p[k]) if log else 1.0 for k, log in zip(free, logs, strict=True)]

        innovations = {use: self._innovations(parts, use, errors[use]) for use, parts in residual.items()}

        return Fit(
            tuple(effects), system, values, tuple(names[k] for k in free),
            len(free) + equation.hidden + len(self._floor) * (POLICY.order + len(estimated)),
            {use: [-Filtered(e, s).terms for e, s in parts] for use, parts in innovations.items()},
            {names[k]: d / max(size, 1e-300) for k, d, size in zip(free, deviations, relative, strict=True)},
            frozenset(names[k] for k, log in zip(free, logs, strict=True) if log),
            converged, tuple(bound),
            own={names[free[k]]: values[names[free[k]]] + change for k, change in zip(own, refitted, strict=True)},
            innovations=innovations, detail=RegressionDetail(errors, residual, jacobian),
        )  # fmt: skip

    def change(self, fit: Fit, placed: Placed) -> float:
        """Return what an effect changes of the torque, at the joint where it weighs most: rms over the torque's rms."""
        less = self.regression.equation([effect for effect in fit.effects if str(effect) != str(placed)])
        p = np.array([fit.values[name] for name in less.system.parameter_names])
        bare = [r for r, _ in less.residual(p, "estimation")]
        changed = self._rms([a - b for a, b in zip(bare, regression_detail(fit).residual["estimation"], strict=True)])
        return float(np.max(changed / np.maximum(self.regression.size, 1e-300), initial=0.0))

    def left_out(self) -> list[str]:
        """Everything was tried."""
        return []

    def limited(self) -> bool:
        """Return False: a fit costs next to nothing."""
        return False

    def distance(self, fit: Fit, other: Fit) -> float:
        """Return by how much the torques of two fits differ, at the joint where they do most: rms over torque's rms."""
        pairs = zip(*(regression_detail(one).residual["estimation"] for one in (fit, other)), strict=True)
        apart = self._rms([a - b for a, b in pairs])
        return float(np.max(apart / np.maximum(self.regression.size, 1e-300), initial=0.0))

    def jumps(self, fit: Fit) -> list[Jump]:
        """Return nothing: no force is taken for a disturbance."""
        return []

    def damping(self, fit: Fit, at: str) -> None:
        """Return nothing: what brakes a joint is known by its torque only."""

    def _rms(self, parts: Sequence[FloatArray]) -> FloatArray:
        """Return the rms (n,) of torques (rows, n) over the rows of the estimation records that count."""
        counts = self.regression.counts["estimation"]
        squares = np.sum([np.sum(part**2 * own, axis=0) for part, own in zip(parts, counts, strict=True)], axis=0)
        return np.asarray(np.sqrt(squares / np.maximum(np.sum([own.sum(axis=0) for own in counts], axis=0), 1)))

    def _own(self, free: Sequence[str]) -> list[int]:
        """Return the places of the parameters that every use of the records fits for itself."""
        return [k for k, name in enumerate(free) if name in self.regression.own]

    def _refitted(
        self, residual: Sequence[FloatArray], jacobian: Sequence[FloatArray], own: Sequence[int],
        errors: Errors,
    ) -> tuple[list[FloatArray], FloatArray]:  # fmt: skip
        """Return validation residuals with their own parameters fitted there, and by how much these change."""
        if not own:
            return list(residual), np.zeros(0)
        columns = [part[:, :, own] for part in jacobian]
        white = self.whitened(columns, "validation", errors)
        change = np.asarray(
            np.linalg.lstsq(white, -self.whitened(residual, "validation", errors), rcond=1e-10)[0], float
        )
        return [r + j @ change for r, j in zip(residual, columns, strict=True)], change

    def whitened(self, parts: Sequence[FloatArray], use: str, errors: Errors) -> FloatArray:
        """Return residuals (rows, n, ...) whitened, joint by joint, in one array."""
        return np.concatenate(
            [
                error.whitened(part[:, k], before[k])
                for part, before, own in zip(parts, self._before[use], errors, strict=True)
                for k, error in enumerate(own)
            ]
        )

    def _innovations(
        self, residual: Sequence[FloatArray], use: str, errors: Errors
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every record the innovations (rows, n) and their variances, NaN where none counts."""
        found = []
        for part, before, own in zip(residual, self._before[use], errors, strict=True):
            e, s = np.full(part.shape, np.nan), np.ones(part.shape)
            for k, error in enumerate(own):
                rows = before[k].rows
                e[rows, k], s[rows, k] = error.innovations(part[:, k], before[k])
            found.append((e, s))
        return found

    # ---- what the score test needs -----------------------------------------------------------------------------------

    def linearised(self, fit: Fit) -> Linearised:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        detail = regression_detail(fit)
        own = self._own(fit.free)
        shared = [k for k in range(len(fit.free)) if k not in own]
        return Linearised(
            {use: self.whitened(detail.residual[use], use, detail.errors[use]) for use in USES},
            {use: self.whitened(detail.jacobian[use], use, detail.errors[use])[:, [*shared, *own]] for use in USES},
            tuple(fit.free[k] for k in shared),
        )

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return [self._answered(fit, change) for change in self.regression.changes(fit.values, candidates)]

    def without_memory(self, fit: Fit) -> Fit | None:
        """Return the fit with white errors of the same size at joints whose error remembers much of a record.

        An error with lines in its spectrum takes up whatever is left of a motion of a few sines, and no promise is left
        of an effect along that motion.
        """
        detail = regression_detail(fit)
        rows = max(len(part) for part in detail.residual["estimation"])
        shared = detail.errors["estimation"][0]
        long = [error.memory > EFFORT.memory * rows for error in shared]
        if not any(long):
            return None
        white = [
            Coloured(np.zeros(POLICY.order), 1.0) if out else error for error, out in zip(shared, long, strict=True)
        ]
        errors = {use: self._sized(parts, use, white) for use, parts in detail.residual.items()}
        return replace(fit, detail=replace(detail, errors=errors))

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """Return nothing: every effect on measured motion shows at first order."""
        del base, rival, candidates
        return []

    def test_functions(self, fit: Fit) -> list[Column]:
        """See :class:`harness.diagnosis.search.fit.Form`."""
        return [self._answered(fit, change) for change in self.regression.free_torques()]

    def _answered(self, fit: Fit, change: TorqueChange) -> Column:
        """Return what a change does to the whitened residual."""
        errors = regression_detail(fit).errors
        made = {use: self.whitened(change.torque[use], use, errors[use]) for use in USES}
        return Column(change.placed, change.given, change.names, made["estimation"], made["validation"], change.kind)


def _on_bound(parameter: Parameter, value: float) -> bool:
    """Return True for a value that lies on a bound of its parameter."""
    bounds = [side for side in (parameter.minimum, parameter.maximum) if np.isfinite(side)]
    return any(abs(value - side) <= 2 * NEAR * max(abs(side), 1.0) for side in bounds)


def _deviations(jacobian: FloatArray) -> FloatArray:
    """Return the standard deviations from the curvature; infinite where the data do not move a parameter."""
    size = np.linalg.norm(jacobian, axis=0)
    scale = np.where(size > 0, size, 1.0)
    _, singular, right = np.linalg.svd(jacobian / scale, full_matrices=False)
    alive = singular > 1e-7 * singular.max(initial=1e-300)
    error = np.sqrt(np.sum((right[alive] / singular[alive, None]) ** 2, axis=0)) / scale
    lost = np.sum(right[~alive] ** 2, axis=0) > 1e-6
    return np.asarray(np.where(lost | (size == 0), np.inf, error))
