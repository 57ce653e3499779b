"""Extended and unscented Kalman filters: state and parameters of a physical model, learned while they predict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harness.errors import FitError
from harness.models.estimate import Estimate
from harness.options import check_options, options_of
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.records import real_signals, usable
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.physical import recipe_for
from identifiers.mechanics.surprise import Surprise

if TYPE_CHECKING:
    from harness.physics import System

ALPHA, BETA = 0.5, 2.0
"""Spread of the sigma points, and the weight of a normal prior (Wan & van der Merwe 2000, eq. 15)."""


@dataclass(frozen=True, eq=False)
class FilterState:
    """What a filter knows."""

    stepper: Stepper  # The model
    # (m,), (m, m): Of the states, then the parameters (those that cannot be negative as logarithms)
    mean: FloatArray
    covariance: FloatArray
    seen: int  # Samples so far, of all records
    clock: float  # Time in the present record [s]
    spread: FloatArray  # (m - nx,): Standard deviations of the parameters at the start
    surprise: Surprise  # How wrong predictions are, beside how wrong they say they are

    @property
    def noise(self) -> FloatArray:
        """Variance of the sensors (ny,), as far as it is known."""
        return self.surprise.noise

    @property
    def parameters(self) -> dict[str, float]:
        """Present values, those that are not fitted too."""
        p = self.stepper.values(self.mean)
        return dict(zip(self.stepper.system.parameter_names, p.tolist(), strict=True))

    @property
    def estimate(self) -> Estimate:
        """The record of the parameters."""
        stepper, n = self.stepper, self.stepper.system.nx
        theta = self.mean[n:]
        p = np.where(stepper.logarithmic, np.exp(theta), theta)
        derivative = np.where(stepper.logarithmic, p, 1.0)
        covariance = self.covariance[n:, n:] * np.outer(derivative, derivative)
        units = tuple(stepper.system.parameter(name).unit for name in stepper.names)
        how = "no intervals: the covariance of a filter forgets that the model was linearised"
        return Estimate(stepper.names, units, p, covariance, method=how)


class Stepper:
    """One sample of a physical model with its derivatives, parameters as states."""

    def __init__(self, system: System, dt: float, fixed: Sequence[str]) -> None:
        from harness.physics.compiled.simulator import default_substeps

        self.system, self.dt = system, dt
        self.steps = default_substeps(system, dt, system.vector())
        chosen = [parameter for parameter in system.parameters if not parameter.fixed and parameter.name not in fixed]
        self.names = tuple(parameter.name for parameter in chosen)
        self.rows = [system.parameter_names.index(name) for name in self.names]
        self.logarithmic = np.array([parameter.positive and parameter.value > 0 for parameter in chosen], dtype=bool)

    def __reduce__(self) -> tuple[Any, ...]:
        known = set(self.names)
        return Stepper, (self.system, self.dt, [n for n in self.system.parameter_names if n not in known])

    def values(self, mean: FloatArray) -> FloatArray:
        """Return the parameters (np,) of a mean."""
        p = self.system.vector()
        theta = mean[self.system.nx :]
        p[self.rows] = np.where(self.logarithmic, np.exp(np.clip(theta, -50, 50)), theta)
        return p

    def start(self) -> FloatArray:
        """Return the parameters of the model as filter states."""
        p = self.system.vector()[self.rows]
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, p, 1.0)), p)

    @cached_property
    def functions(self) -> tuple[Any, Any, Any, Any]:
        """Return step, output and their derivatives as CasADi functions of (z, u, t)."""
        import casadi as ca

        system = self.system
        z, u, t = ca.SX.sym("z", system.nx + len(self.names)), ca.SX.sym("u", system.nu), ca.SX.sym("t")
        x, theta = z[: system.nx], z[system.nx :]
        p = ca.SX(system.vector())
        for place, row in enumerate(self.rows):
            p[row] = ca.exp(theta[place]) if self.logarithmic[place] else theta[place]
        upright = system.upright(ca.vertcat(system.f, system.h))
        both = ca.Function("f", [system.x, system.u, system.p, system.t], [upright[: system.nx], upright[system.nx :]])
        h = self.dt / self.steps
        now, clock = x, t
        for _ in range(self.steps):
            k1 = both(now, u, p, clock)[0]
            k2 = both(now + h / 2 * k1, u, p, clock + h / 2)[0]
            k3 = both(now + h / 2 * k2, u, p, clock + h / 2)[0]
            k4 = both(now + h * k3, u, p, clock + h)[0]
            now, clock = now + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), clock + h
        after, seen = ca.vertcat(now, theta), both(x, u, p, t)[1]
        options = {"cse": True}
        return (
            ca.Function("step", [z, u, t], [after], options),
            ca.Function("output", [z, u, t], [seen], options),
            ca.Function("step_jacobian", [z, u, t], [after, ca.jacobian(after, z)], options),
            ca.Function("output_jacobian", [z, u, t], [seen, ca.jacobian(seen, z)], options),
        )


@dataclass(frozen=True)
class OnlineGreyBox:
    """Joint estimation of the state and the parameters of a physical model, sample by sample.

    Parameters that cannot be negative are filtered as logarithms. The sensors' variances are learned from products of
    residuals before and after each correction, whose mean they are (Mehra 1970, IEEE Trans. Autom. Control 15:175).

    Parameters
    ----------
    kind : {"ekf", "ukf"}
        Linearised at the mean (Ljung 1979, IEEE Trans. Autom. Control 24:36), or sigma points (Julier & Uhlmann 2004,
        Proc. IEEE 92:401).
    model : str, optional
        A built-in model or ``FILE.py:NAME``; by default the built-in one with the signals of the records.
    options : mapping
        For the model's function.
    start_values : mapping (``start`` of the factories)
        Values where some parameters start; the model's otherwise.
    fixed : tuple of str
        Parameters that keep their value.
    doubt : float
        Relative standard deviation of the parameters at the start.
    walk : float
        Relative standard deviation by which the parameters may change in a second, for plants that drift.
    disturbance : float
        Standard deviation of an unknown force on the coordinates, in units of their acceleration over a second.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> system = pendulum().system()
    >>> u = np.repeat(np.random.default_rng(0).normal(size=(60, 1)), 10, axis=0)
    >>> y = system.simulator(0.02, backend="casadi").rollout([0.2, 0.05, 1.3], [0.5, 0.0], u)
    >>> online = ekf("pendulum")
    >>> state = online.init(PlantSpec(system.inputs, system.outputs, 0.02), rng=np.random.default_rng(0))
    >>> state = online.start(state, y[0])
    >>> for k in range(599):
    ...     state = online.update(state, u[k], y[k + 1])
    >>> abs(state.parameters["J"] - 0.2) < 0.01
    True
    """

    kind: Literal["ekf", "ukf"] = "ekf"
    model: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    start_values: Mapping[str, float] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    doubt: float = 0.5
    walk: float = 0.0
    disturbance: float = 1e-3

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the physical model with the parameters learned in one pass over the records, in their order.

        Raises
        ------
        InputError, FitError
            As :meth:`init`; also if the filter diverges.
        """
        records, spec = usable(trajectories, samples=2, what=self.kind)
        state = self.init(spec, rng=rng)
        for record in records:
            state = self.start(state, record.y[0])
            for k in range(len(record) - 1):
                state = self.update(state, record.u[k], record.y[k + 1])
        if not np.isfinite(state.mean).all():
            raise FitError(
                f"{self.kind} diverged",
                expected="finite states and parameters",
                got="NaN or infinity",
                remedy="give start values nearer to the plant (start=...), or less doubt",
            )
        recipe = recipe_for(spec, self.kind, model=self.model, options=dict(self.options))
        model = GreyBoxModel(spec, recipe, state.parameters, notes={"estimate": state.estimate.to_dict()})
        return replace(model, filter_gain=tuned_gain(model, records))

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> FilterState:
        """Return the state before any data.

        Raises InputError if an option is out of range; FitError if the model does not speak like the records.
        """
        check_options(self, self.kind, doubt="> 0", walk=">= 0", disturbance=">= 0")
        real_signals(spec, self.kind)
        recipe = recipe_for(spec, self.kind, model=self.model, options=dict(self.options))
        system = recipe.system(spec)
        if self.start_values:
            system = system.with_parameters(dict(self.start_values))
        stepper = Stepper(system, spec.sample_time, self.fixed)
        theta = stepper.start()
        spread = np.where(stepper.logarithmic, self.doubt, self.doubt * np.maximum(np.abs(theta), 0.1))
        n = system.nx
        covariance = np.diag(np.concatenate([np.ones(n), spread**2]))
        mean = np.concatenate([np.zeros(n), theta])
        return FilterState(stepper, mean, covariance, 0, 0.0, spread, Surprise.none(spec.ny))

    def start(self, state: FilterState, y: FloatArray) -> FilterState:
        """Return the state after the first output of a record: the parameters stay, the states are read off it."""
        system, n = state.stepper.system, state.stepper.system.nx
        mean = np.concatenate([np.zeros(n), state.mean[n:]])
        u = np.zeros(system.nu)
        jacobian = state.stepper.functions[3](mean, u, 0.0)[1].full()[:, :n]
        surprise = state.surprise.begun(y)
        back = np.linalg.pinv(jacobian)
        miss = y - state.stepper.functions[1](mean, u, 0.0).full()[:, 0]
        mean[:n] = back @ miss
        covariance = np.zeros_like(state.covariance)
        covariance[n:, n:] = state.covariance[n:, n:]
        # what the first output does not show is unknown to 1 in its unit
        unseen = np.eye(n) - back @ jacobian
        covariance[:n, :n] = unseen @ unseen.T + back @ np.diag(surprise.noise) @ back.T
        return replace(state, mean=mean, covariance=covariance, clock=0.0, surprise=surprise)

    def predict(self, state: FilterState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to."""
        step, output = state.stepper.functions[:2]
        after = step(state.mean, u, state.clock)
        found: FloatArray = output(after, u, state.clock + state.stepper.dt).full()[:, 0]
        return found

    def update(self, state: FilterState, u: FloatArray, y: FloatArray) -> FilterState:
        """Return the state after ``u`` led to ``y``."""
        moved = self._extended(state, u) if self.kind == "ekf" else self._unscented(state, u)
        mean, covariance, seen, cross, spread = moved
        channels = state.stepper.system.outputs
        miss = residual(channels, y, seen)
        factor, surprise = state.surprise.heard(channels, y).factor(miss, spread)
        total = spread + np.diag(surprise.noise)
        gain = np.linalg.solve(total, cross.T).T
        surprise = surprise.learned(miss, miss - spread @ np.linalg.solve(total, miss))
        smaller = covariance - gain @ total @ gain.T
        smaller = 0.5 * (smaller + smaller.T) + 1e-15 * np.diag(np.diag(covariance))
        mean, smaller = self._forgotten(state, mean + gain @ miss, smaller, factor)
        clock = state.clock + state.stepper.dt
        return replace(state, mean=mean, covariance=smaller, seen=state.seen + 1, clock=clock, surprise=surprise)

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the same filter with the parameters of a batch output-error fit: best found."""
        from identifiers.mechanics.grey_box import OutputError

        fitted = OutputError(self.model, dict(self.options), (), tuple(self.fixed), dict(self.start_values)).fit(
            trajectories, rng=np.random.default_rng(0)
        )
        known = replace(self, start_values=fitted.parameters, fixed=tuple(fitted.parameters))
        state = known.init(trajectories[0].spec, rng=np.random.default_rng(0))
        losses = []
        for record in trajectories:
            state = known.start(state, record.y[0])
            for k in range(len(record) - 1):
                miss = residual(record.spec.outputs, record.y[k + 1], known.predict(state, record.u[k]))
                losses.append(float(miss @ miss))
                state = known.update(state, record.u[k], record.y[k + 1])
        return Hindsight(np.array(losses), exact=False, details={"parameters": dict(fitted.parameters)})

    # ---- inside --------------------------------------------------------------------------------------------------

    def _forgotten(
        self, state: FilterState, mean: FloatArray, covariance: FloatArray, factor: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance with all knowledge but the prior of the parameters divided by a factor.

        Stabilised forgetting (Kulhavy & Zarrop 1993, Int. J. Control 58:905): what the motion does not show goes back
        to where it started, instead of anywhere.
        """
        if factor <= 1.0:
            return mean, covariance
        n, prior = state.stepper.system.nx, np.diag(state.spread**2) / (1 - 1 / factor)
        covariance = factor * covariance
        cross = covariance[:, n:]
        gain = np.linalg.solve(cross[n:] + prior, cross.T).T
        covariance = covariance - gain @ cross.T
        return mean + gain @ (state.stepper.start() - mean[n:]), 0.5 * (covariance + covariance.T)

    def _drift(self, state: FilterState) -> FloatArray:
        """Return the variance (m,) that a sample adds."""
        stepper, n = state.stepper, state.stepper.system.nx
        added = np.zeros(state.mean.size)
        for coordinate in stepper.system.coordinates:
            added[coordinate.v] = self.disturbance**2 * stepper.dt
        size = np.where(stepper.logarithmic, 1.0, np.maximum(np.abs(state.mean[n:]), 0.1))
        added[n:] = (self.walk * size) ** 2 * stepper.dt
        return added

    def _extended(self, state: FilterState, u: FloatArray) -> tuple[FloatArray, ...]:
        """Return mean, covariance, output, cross covariance and output covariance one sample later, linearised."""
        stepper = state.stepper
        after, jacobian = (matrix.full() for matrix in stepper.functions[2](state.mean, u, state.clock))
        covariance = jacobian @ state.covariance @ jacobian.T + np.diag(self._drift(state))
        seen, sight = (matrix.full() for matrix in stepper.functions[3](after, u, state.clock + stepper.dt))
        cross = covariance @ sight.T
        return after[:, 0], covariance, seen[:, 0], cross, sight @ cross

    def _unscented(self, state: FilterState, u: FloatArray) -> tuple[FloatArray, ...]:
        """Return the same from sigma points."""
        stepper, m = state.stepper, state.mean.size
        spread = ALPHA**2 * m
        size = np.sqrt(np.maximum(np.diag(state.covariance), 1e-300))
        scaled = state.covariance / np.outer(size, size) + 1e-12 * np.eye(m)
        root = size[:, None] * np.linalg.cholesky(scaled) * np.sqrt(spread)
        points = np.column_stack([state.mean, state.mean[:, None] + root, state.mean[:, None] - root])
        weights = np.full(2 * m + 1, 1 / (2 * spread))
        weights[0] = 1 - m / spread
        second = weights.copy()
        second[0] += 1 - ALPHA**2 + BETA
        step, output = stepper.functions[:2]
        after = step.map(2 * m + 1)(points, np.tile(u[:, None], 2 * m + 1), state.clock).full()
        later = state.clock + stepper.dt
        seen = output.map(2 * m + 1)(after, np.tile(u[:, None], 2 * m + 1), later).full()
        mean, middle = after @ weights, seen @ weights
        away, off = after - mean[:, None], seen - middle[:, None]
        covariance = (away * second) @ away.T + np.diag(self._drift(state))
        return mean, covariance, middle, (away * second) @ off.T, (off * second) @ off.T


def ekf(
    model: str | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    start: Mapping[str, float] | None = None,
    fixed: tuple[str, ...] = (),
    doubt: float = 0.5,
    walk: float = 0.0,
    disturbance: float = 1e-3,
) -> OnlineGreyBox:
    """Return the extended Kalman filter for state and parameters; options as of :class:`OnlineGreyBox`."""
    return OnlineGreyBox("ekf", model, options or {}, start or {}, fixed, doubt, walk, disturbance)


@options_of(ekf)
def ukf(model: str | None = None, **options: Any) -> OnlineGreyBox:
    """Return the unscented Kalman filter for state and parameters; options as of :class:`OnlineGreyBox`."""
    return replace(ekf(model, **options), kind="ukf")
