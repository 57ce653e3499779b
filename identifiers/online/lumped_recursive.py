"""Lumped parameters of a mechanism sample by sample: equations are rotated into the triangle of a QR factorisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import FitError, InputError
from harness.models.estimate import Estimate
from harness.options import check_options
from harness.protocols import Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.records import learnable, real_signals
from identifiers.mechanics.grey_box_model import GreyBoxModel, tuned_gain
from identifiers.mechanics.lumped import Form, Intersample, Lumped
from identifiers.mechanics.lumped_estimate import lumped_estimate, physical_estimate
from identifiers.mechanics.motion import noisier
from identifiers.mechanics.physical import recipe_for
from identifiers.online.rls_pass import rotated

if TYPE_CHECKING:
    from harness.physics import LumpedModel, System

WIDTH = 13  # Samples that a cubic spans, by default: two thirds of what a batch fit chooses at noise of a milliradian.
SPAN = 51  # Samples of a test function, as of the batch form.
NEWS, LEAST = 0.05, 20
"""The model that predicts is made anew after this share of new equations, and after so many at least: its parameters
move less in between."""
DETERMINED = 1e-8  # Relative size, columns at unit length, below which the triangle does not determine a direction.


@dataclass(frozen=True, eq=False)
class Context:
    """What does not change while a recursion runs."""

    system: System
    regression: LumpedModel
    first: GreyBoxModel
    positions: tuple[int, ...]
    rates: tuple[int | None, ...]  # Columns of the outputs.
    periods: tuple[float | None, ...]


@dataclass(frozen=True, eq=False)
class LumpedState:
    """What a recursion knows."""

    context: Context
    triangle: FloatArray  # (k, k + 1): ``[R z]``, R theta = z
    rows: int  # Equations so far, of all records
    effective: float  # The same, what was forgotten taken off
    made_at: float  # ``effective`` when the model was last made
    model: GreyBoxModel | None  # That predicts; None before the lumped parameters are determined
    x: FloatArray | None  # Its state
    last: FloatArray  # (ny,): Output
    # (w, ny), (w, nu): The last samples, angles unwrapped; ``u[i]`` led to ``y[i]``
    y: FloatArray
    u: FloatArray
    past: FloatArray  # (L, 1 + 3 n + 2 nu): The last instants whose motion is known: t, q, v, a, u, mean u
    seen: int  # Instants of this record
    clock: float

    @property
    def lumps(self) -> FloatArray | None:
        """Lumped parameters (k,); None while the equations do not determine them."""
        return _solved(self.triangle)

    @property
    def parameters(self) -> dict[str, float] | None:
        """Physical parameters of the model that predicts."""
        return None if self.model is None else dict(self.model.parameters)

    @property
    def estimate(self) -> Estimate:
        """The record of the lumped parameters."""
        from harness.physics.lumps.identifiability import determined

        names = self.context.regression.names
        decision, _, condition = determined(self.triangle[:, :-1], names, tolerance=DETERMINED)
        found = self.lumps
        values = dict(zip(names, np.full(len(names), np.nan) if found is None else found, strict=True))
        how = "no intervals: the noise in the regressor is not known while it runs (fit with intervals = 60)"
        return lumped_estimate(self.context.system, self.context.regression, values, None, how, decision, condition)


@dataclass(frozen=True)
class RecursiveLumped:
    """Lumped parameters of a mechanism by recursive least squares on its torque, energy or momentum form.

    Equations of a sample are made half a smoothing width after it and rotated into the triangle of a QR factorisation
    (Bierman 1977, *Factorization Methods for Discrete Sequential Estimation*, ch. IV; Golub & Van Loan 2013, sec.
    6.5.1): the same parameters as by the batch, without squaring the condition number. A model with the parameters so
    far predicts. Errors in the regressor bias it as they do the batch: ``intervals`` of :meth:`fit` take that off.

    Parameters
    ----------
    form : {"torque", "energy", "momentum"}
    model : str, optional
        As of :class:`identifiers.mechanics.lumped.Lumped`; so are ``window`` (by default ``width`` samples for energy,
        51 for momentum), ``known``, ``intersample`` and ``intervals`` (not with forgetting).
    forgetting : float
        Weight of all earlier equations at every instant, in (0, 1]; 1 forgets nothing.
    width : int
        Samples, odd, through which a cubic gives rates and accelerations.

    Examples
    --------
    >>> from harness.physics.models import pendulum
    >>> system = pendulum().system()
    >>> u = np.repeat(np.random.default_rng(0).normal(size=(60, 1)), 10, axis=0)
    >>> y = system.simulator(0.01, backend="casadi").rollout([0.2, 0.05, 1.3], [0.5, 0.0], u)
    >>> online = RecursiveLumped("momentum", "pendulum", width=5)
    >>> state = online.init(PlantSpec(system.inputs, system.outputs, 0.01), rng=np.random.default_rng(0))
    >>> state = online.start(state, y[0])
    >>> for k in range(599):
    ...     state = online.update(state, u[k], y[k + 1])
    >>> dict(zip(state.context.regression.names, state.lumps.round(2).tolist()))
    {'mgl': 1.3, 'J': 0.2, 'b': 0.05}
    """

    form: Form = "momentum"
    model: str | None = None
    window: float | None = None
    known: Mapping[str, float] | None = None
    intersample: Intersample = "zoh"
    forgetting: float = 1.0
    width: int = WIDTH
    intervals: int = 0

    def __post_init__(self) -> None:
        check_options(self, "lumped-recursive", forgetting="> 0, <= 1", width=">= 5")
        if self.width % 2 == 0 or (self.intervals and self.forgetting < 1):
            raise InputError(
                "options of lumped-recursive",
                expected="an odd width; no intervals where something is forgotten",
                got=f"forgetting {self.forgetting}, width {self.width}, intervals {self.intervals}",
                remedy="correct the options",
            )

    # ---- records as a whole --------------------------------------------------------------------------------------

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GreyBoxModel:
        """Return the mechanism with the parameters after all records, in their order.

        Raises
        ------
        FitError
            As :meth:`identifiers.mechanics.lumped.Lumped.fit`.
        """
        what = "lumped-recursive"
        records, spec = learnable(trajectories, samples=max(12, self.width + 4), what=what, inputs=False)
        context = self._context(spec)
        regression, system = context.regression, context.system
        k, n = regression.k, self._group(context)
        triangle, noise = np.zeros((k, k + 1)), []
        for record in records:
            rows = self.equations(context, record)
            triangle = rotated(triangle, rows, group=n, forgetting=self.forgetting)
            noise.append(self.equations(context, noisier(record, rng))[:, :k] - rows[:, :k])
        from harness.physics.lumps.identifiability import determined

        decision, _, condition = determined(triangle[:, :k], regression.names, np.concatenate(noise))
        theta = _solved(triangle)
        if theta is None or not decision.full:
            raise FitError(
                f"{what}: the motion does not determine all lumped parameters",
                expected=f"rank {k} ({', '.join(regression.names)})",
                got=str(decision),
                remedy="excite the plant more richly, or give known={...}",
            )
        batch = self._batch()
        values = dict(zip(regression.names, theta.tolist(), strict=True))
        recipe = context.first.recipe
        values, spread, how = batch.without_bias(system, recipe, regression, values, records, rng)
        parameters = {**regression.to_parameters(values), **batch.known_of(system)}
        batch.refuse_unphysical(system, regression, values, parameters, what)
        lumps = lumped_estimate(system, regression, values, spread, how, decision, condition)
        notes: dict[str, Any] = {
            "estimate": physical_estimate(system, regression, parameters, lumps).to_dict(),
            "lumped": lumps.to_dict(),
        }
        model = GreyBoxModel(spec, recipe, parameters, notes=notes)
        return replace(model, filter_gain=tuned_gain(model, records))

    def equations(self, context: Context, record: Trajectory) -> FloatArray:
        """Return the equations (M, k + 1) of a record, regressors and target, in the order in which they arise."""
        from harness.physics.fitting.smoothing import local_cubics

        dt, half = record.spec.sample_time, self.width // 2
        q, v, a = [], [], []
        smoothed = [
            local_cubics(signal if period is None else np.unwrap(signal, period=period), self.width, dt)
            for signal, period in zip(record.y.T, context.periods, strict=True)
        ]
        for p, r in zip(context.positions, context.rates, strict=True):
            q.append(smoothed[p][0])
            v.append(smoothed[p][1] if r is None else smoothed[r][0])
            a.append(smoothed[p][2] if r is None else smoothed[r][1])
        mean_u = np.vstack([record.u[:1], 0.5 * (record.u[1:] + record.u[:-1])])
        instants = np.column_stack([record.t, *q, *v, *a, record.u, mean_u])
        return self._rows(context, instants[half : len(record) - half])

    # ---- sample by sample ----------------------------------------------------------------------------------------

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> LumpedState:
        """Return the state before any data.

        Raises
        ------
        FitError
            If the model is no mechanism or a coordinate is not measured.
        """
        real_signals(spec, "lumped-recursive")
        context = self._context(spec)
        k = context.regression.k
        empty = np.zeros((0, 1 + 3 * len(context.positions) + 2 * spec.nu))
        return LumpedState(
            context, np.zeros((k, k + 1)), 0, 0.0, 0.0, None, None, np.zeros(spec.ny), np.zeros((0, spec.ny)),
            np.zeros((0, spec.nu)), empty, 0, 0.0,
        )  # fmt: skip

    def start(self, state: LumpedState, y: FloatArray) -> LumpedState:
        """Return the state after the first output of a record; equations stay, nothing reaches across."""
        y = np.asarray(y, dtype=float)
        nu = state.u.shape[1]
        begun = replace(
            state, last=y, y=y[None].copy(), u=np.full((1, nu), np.nan), past=state.past[:0], seen=0, clock=0.0, x=None
        )
        return replace(begun, x=self._placed(begun))

    def predict(self, state: LumpedState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output while the parameters are not determined."""
        if state.model is None or state.x is None:
            return state.last.copy()
        u = np.asarray(u, dtype=float)
        found: FloatArray = state.model.output(state.model.step(state.x, u), u)
        return found if np.isfinite(found).all() else state.last.copy()

    def update(self, state: LumpedState, u: FloatArray, y: FloatArray) -> LumpedState:
        """Return the state after ``u`` led to ``y``."""
        context = state.context
        u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
        whole = y.copy()
        for column, period in enumerate(context.periods):
            if period is not None:
                turn = whole[column] - state.y[-1, column]
                whole[column] = state.y[-1, column] + turn - period * np.round(turn / period)
        keep = self.width - 1
        ys = np.vstack([state.y[-keep:], whole])
        us = np.vstack([state.u[-keep:], u])
        after = replace(state, last=y, y=ys, u=us, clock=state.clock + context.first.spec.sample_time)
        after = replace(after, x=self._corrected(state, u, y))
        return self._learned(after) if len(ys) == self.width else after

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the same filter with the parameters of all equations of these records: best found."""
        spec = trajectories[0].spec
        fitted: GreyBoxModel | None
        try:
            found = replace(self, intervals=0, forgetting=1.0).fit(trajectories, rng=np.random.default_rng(0))
            fitted = replace(found, filter_gain=None)
        except FitError:  # too short to determine anything: the last output is held
            fitted = None
        losses = []
        state = self.init(spec, rng=np.random.default_rng(0))
        for record in trajectories:
            state = self.start(replace(state, model=fitted), record.y[0])
            for k in range(len(record) - 1):
                guess = self.predict(state, record.u[k])
                miss = residual(record.spec.outputs, record.y[k + 1], guess)
                losses.append(float(miss @ miss))
                state = replace(state, last=record.y[k + 1], x=self._corrected(state, record.u[k], record.y[k + 1]))
        return Hindsight(
            np.array(losses), exact=False, details={"parameters": {} if fitted is None else dict(fitted.parameters)}
        )

    # ---- inside --------------------------------------------------------------------------------------------------

    def _batch(self) -> Lumped:
        """Return the batch estimator of the same equations."""
        return Lumped(
            self.form, self.model, self.window, self.known, "local", self.intersample, estimator="unweighted",
            intervals=self.intervals,
        )  # fmt: skip

    def _context(self, spec: PlantSpec) -> Context:
        recipe = recipe_for(spec, "lumped-recursive", model=self.model)
        system = recipe.system(spec)
        batch = self._batch()
        regression = batch.regression_of(system)
        names = [channel.name for channel in spec.outputs]
        missing = [coordinate.name for coordinate in system.coordinates if coordinate.name not in names]
        if missing:
            raise FitError(
                "lumped parameters need every coordinate measured",
                expected=", ".join(coordinate.name for coordinate in system.coordinates),
                got=", ".join(names),
                remedy=f"measure {', '.join(missing)}, or use ekf",
            )
        rates = [
            next(
                (names.index(f"{coordinate.name}{s}") for s in ("_rate", "_dot") if f"{coordinate.name}{s}" in names),
                None,
            )
            for coordinate in system.coordinates
        ]
        first = GreyBoxModel(spec, recipe, {**system.values(), **batch.known_of(system)})
        positions = tuple(names.index(coordinate.name) for coordinate in system.coordinates)
        return Context(
            system, regression, first, positions, tuple(rates), tuple(channel.period for channel in spec.outputs)
        )

    def _group(self, context: Context) -> int:
        """Return the equations of one instant."""
        return 1 if self.form == "energy" else context.regression.n

    def _span(self, context: Context) -> tuple[int, int]:
        """Return how many instants an equation needs, and after how many the next one follows."""
        dt = context.first.spec.sample_time
        if self.form == "torque":
            return 1, 1
        if self.form == "energy":
            return 1 + max(1, self.width if self.window is None else round(self.window / dt)), 1
        samples = max(5, SPAN if self.window is None else round(self.window / dt))
        return samples, max(1, samples // 4)

    def _rows(self, context: Context, instants: FloatArray) -> FloatArray:
        """Return the equations (M, k + 1) of consecutive instants."""
        regression, n = context.regression, len(context.positions)
        nu = context.first.spec.nu
        t, q, v, a, u, mean_u = np.split(instants, np.cumsum([1, n, n, n, nu]), axis=1)
        t = t[:, 0]
        span, hop = self._span(context)
        if len(t) < span:
            return np.zeros((0, regression.k + 1))
        if self.form == "torque":
            phi, target = regression.torque_rows(t, q, v, a, u if self.intersample == "smooth" else mean_u)
        elif self.form == "energy":
            phi, target = regression.energy_rows(t, q, v, u, samples=span - 1, intersample=self.intersample)
        else:
            phi, target = regression.momentum_rows(
                t, q, v, u, samples=span, hop=hop, intersample=self.intersample
            )  # fmt: skip
        return np.column_stack([phi, target])

    def _learned(self, state: LumpedState) -> LumpedState:
        """Return the state after the equations that the last sample completed."""
        from harness.physics.fitting.smoothing import local_taps

        context, dt = state.context, state.context.first.spec.sample_time
        taps, half = local_taps(self.width)[0], self.width // 2
        value, rate, acceleration = taps @ state.y / np.array([1.0, dt, dt**2])[:, None]
        columns = list(zip(context.positions, context.rates, strict=True))
        q = [value[p] for p, _ in columns]
        v = [rate[p] if r is None else value[r] for p, r in columns]
        a = [acceleration[p] if r is None else rate[r] for p, r in columns]
        # u[i] led to y[i]: from the middle sample on the next one is held
        now, before = state.u[half + 1], state.u[half]
        mean_u = 0.5 * (now + before)
        instant = np.concatenate([[state.clock - half * dt], q, v, a, now, mean_u])
        span, hop = self._span(context)
        past = np.vstack([state.past[-(span - 1) :] if span > 1 else state.past[:0], instant])
        seen = state.seen + 1
        state = replace(state, past=past, seen=seen)
        if len(past) < span or (seen - span) % hop:
            return state
        rows = self._rows(context, past)
        triangle = rotated(state.triangle, rows, group=self._group(context), forgetting=self.forgetting)
        state = replace(
            state,
            triangle=triangle,
            rows=state.rows + len(rows),
            effective=self.forgetting * state.effective + len(rows),
        )
        return self._renewed(state)

    def _renewed(self, state: LumpedState) -> LumpedState:
        """Return the state with a model of the present parameters, where enough has changed."""
        k = len(state.triangle)
        due = state.rows >= 2 * k and (
            state.model is None or state.rows >= state.made_at + max(LEAST, NEWS * state.effective)
        )
        theta = _solved(state.triangle) if due else None
        if theta is None:
            return state
        context = state.context
        values = dict(zip(context.regression.names, theta.tolist(), strict=True))
        known = (state.model or context.first).parameters
        try:
            found = context.regression.to_parameters(values, start=known)
            model = context.first.with_parameters({**found, **self._batch().known_of(context.system)})
        except FitError:
            return state
        state = replace(state, model=model, made_at=float(state.rows))
        return state if state.x is not None else replace(state, x=self._placed(state))

    def _placed(self, state: LumpedState) -> FloatArray | None:
        """Return the model's state at the last output: measured coordinates and rates, rates else by differences."""
        if state.model is None:
            return None
        context, dt = state.context, state.context.first.spec.sample_time
        x = np.zeros(context.system.nx)
        for coordinate, p, r in zip(context.system.coordinates, context.positions, context.rates, strict=True):
            x[coordinate.q] = state.y[-1, p]
            if r is not None:
                x[coordinate.v] = state.y[-1, r]
            elif len(state.y) > 2:
                x[coordinate.v] = (state.y[-1, p] - state.y[-3, p]) / (2 * dt)
        return np.concatenate([x, [state.clock]])

    def _corrected(self, state: LumpedState, u: FloatArray, y: FloatArray) -> FloatArray | None:
        """Return the model's state after an output was seen."""
        if state.model is None or state.x is None:
            return None
        found = state.model.correct(state.model.step(state.x, u), u, y)
        return found if np.isfinite(found).all() else None


def _solved(triangle: FloatArray) -> FloatArray | None:
    """Return theta (k,) of ``[R z]``; None where R does not determine it."""
    k = len(triangle)
    R, z = triangle[:, :k], triangle[:, k]
    size = np.linalg.norm(R, axis=0)
    if not np.isfinite(triangle).all() or not np.all(size > 0):
        return None
    scaled = R / size
    singular = np.linalg.svd(scaled, compute_uv=False)
    if singular[-1] <= DETERMINED * singular[0]:
        return None
    return np.asarray(np.linalg.solve(scaled, z) / size, dtype=np.float64)
