"""Recursive polynomial models: ARX, ARMAX and output error, sample by sample, with forgetting and a guard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.models.estimate import Estimate
from harness.options import check_options
from harness.protocols import Growth, Hindsight
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from harness.units import quotient
from identifiers.common.linear_model import LinearModel
from identifiers.common.observers import innovation_form
from identifiers.common.records import moving, real_signals
from identifiers.common.scaling import Scaling, sizes
from identifiers.linear.polynomials.model import Orders, Polynomials, block_form
from identifiers.linear.polynomials.orders import Counts, orders_by_output
from identifiers.linear.prediction_error import PredictionError
from identifiers.online.along import OnePass

PRIOR = 100.0  # Variance of every coefficient before any data, of signals at the size that they have in the burn-in.
LEARNS, SETTLES = 0.05, 0.98
"""Forgetting begins at 1 - LEARNS and rises to its value by this factor: first gradients are poor (Ljung 1999,
eq. 11.55 and sec. 11.5)."""
HALVINGS = 12  # Of a step that would leave the region where C or F is stable.


@dataclass(frozen=True, eq=False)
class OutputFilter:
    """What the recursion of one output knows, of centred signals at unit size."""

    theta: FloatArray  # (p,): a or f, b input by input, c, and a constant
    covariance: FloatArray  # (p, p): P, that of theta over the innovations' variance but for forgetting
    # (n,), (m,): Newest first: outputs (of output error: the model's own), residuals (ARMAX)
    y: FloatArray
    inner: FloatArray
    slopes: FloatArray  # (m, p): Gradients of the last predictions, newest first
    errors: FloatArray
    """(4,): Sums with forgetting: weighted squared errors, weights, squared weights, degrees of freedom used."""
    guarded: int = 0  # Samples at which the guard kept the covariance from growing
    rejected: int = 0  # Steps that were halved to nothing, for they left the stable region

    @property
    def variance(self) -> float:
        """Of the innovations."""
        squares, weights, _, used = self.errors
        return float(squares / max(weights - used, 1.0)) if weights > 0 else float("inf")

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations of constant coefficients (p,): the root of ``s^2 P sum w^2 / sum w`` with weights w."""
        _, weights, squares, _ = self.errors
        share = squares / weights if weights > 0 else 1.0
        return np.asarray(np.sqrt(self.variance * share * np.diag(self.covariance)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class RecursiveState:
    """What a recursive polynomial model knows."""

    spec: PlantSpec
    orders: tuple[Orders, ...]  # One for each output
    filters: tuple[OutputFilter, ...]  # Empty during the burn-in
    u: FloatArray  # (L, nu): Inputs of the present record, newest first, scaled
    last: FloatArray  # (ny,): Output seen last
    # Samples of the present record, and of all records
    seen: int
    learned: int
    tape: tuple[tuple[FloatArray | None, FloatArray], ...]
    """Samples of the burn-in: the input or None at a seam, and the output."""
    # (nu + ny,): Of inputs and outputs in the burn-in
    centre: FloatArray
    size: FloatArray

    @property
    def names(self) -> list[str]:
        """Names of the coefficients, output by output, without the constants."""
        found = []
        for output, own in zip(self.spec.outputs, self.orders, strict=True):
            first = "f" if own.nf else "a"
            found += [f"{output.name}: {first}{j}" for j in range(1, (own.nf[0] if own.nf else own.na) + 1)]
            for given, nb, nk in zip(self.spec.inputs, own.nb, own.nk, strict=True):
                found += [f"{output.name}: b{j} of {given.name}" for j in range(nk, nk + nb)]
            found += [f"{output.name}: c{j}" for j in range(1, own.nc + 1)]
        return found

    @property
    def coefficients(self) -> tuple[FloatArray, FloatArray]:
        """The coefficients (k,) in the units of the channels and their standard deviations; NaN during the burn-in."""
        if not self.filters:
            nothing = np.full(len(self.names), np.nan)
            return nothing, nothing
        nu, values, spread = self.spec.nu, [], []
        for i, (own, one) in enumerate(zip(self.orders, self.filters, strict=True)):
            gains = [np.full(nb, self.size[nu + i] / self.size[j]) for j, nb in enumerate(own.nb)]
            scale = np.concatenate([np.ones(_past(own)), *gains, np.ones(own.nc)])
            values.append(one.theta[: scale.size] * scale)
            spread.append(one.deviations[: scale.size] * scale)
        return np.concatenate(values), np.concatenate(spread)

    @property
    def trace(self) -> float:
        """Trace of the covariances, over that before any data: near 0 once all is known, 1 where nothing is."""
        if not self.filters:
            return 1.0
        return float(np.mean([np.trace(one.covariance) / (PRIOR * one.theta.size) for one in self.filters]))

    @property
    def guarded(self) -> int:
        """Samples at which some covariance was kept from growing."""
        return max((one.guarded for one in self.filters), default=0)


@dataclass(frozen=True)
class RecursiveOptions:
    """Options of :class:`RecursivePolynomial`, which says what they mean."""

    structure: Literal["arx", "armax", "oe"] = "armax"
    order: int = 2
    na: int | list[int] | None = None
    nb: Counts | None = None
    nc: int | list[int] | None = None
    nf: int | None = None
    nk: Counts | None = None
    method: Literal["gradient", "pseudo-linear"] = "gradient"
    forgetting: float = 1.0
    burn_in: int | None = None


@dataclass(frozen=True)
class RecursivePolynomial(RecursiveOptions, OnePass):
    """Recursive ARX, ARMAX or output-error model, as an online identifier.

    Recursive prediction errors (Ljung 1999, eq. 11.41 to 11.44): ``theta += P psi e / (lambda + psi' P psi)`` with psi
    the gradient of the prediction, of ARMAX (recursive maximum likelihood) and output error filtered by the present
    estimate of 1/C or 1/F; with ``method="pseudo-linear"`` psi is the regressor itself: extended least squares (RELS;
    Soderstrom & Stoica 1989, sec. 9.4), and Landau's method for output error. A step that would make C or F unstable is
    halved until it does not. Forgetting begins lower and rises to its value. Every output has a model of its own.

    Where the inputs do not excite, forgetting makes the covariance grow without end (wind-up), and the first noise then
    throws the estimate anywhere: while the trace is at that of the prior nothing is forgotten.

    Parameters
    ----------
    structure : {"arx", "armax", "oe"}
    order : int
        Of all polynomials that no option below gives.
    na, nb, nc, nf, nk : int, list, optional
        As of ``prediction-error``; delays are at least 1, and F is one for all inputs.
    method : {"gradient", "pseudo-linear"}
    forgetting : float
        In (0, 1]; 1 forgets nothing. The memory is about 1 / (1 - forgetting) samples.
    burn_in : int, optional
        Samples that are waited for before the first prediction by the model, which give the size of the signals; until
        then the last output is held. By default 20, and four times the coefficients of an output.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> online, rng = RecursivePolynomial(order=1), np.random.default_rng(0)
    >>> state, y, before = online.start(online.init(spec, rng=rng), np.zeros(1)), 0.0, 0.0
    >>> for u, e in rng.normal(size=(3000, 2)) * [1.0, 0.3]:
    ...     y, before = 0.8 * y + u + e + 0.5 * before, e
    ...     state = online.update(state, np.array([u]), np.array([y]))
    >>> dict(zip(state.names, state.coefficients[0].round(1).tolist()))
    {'y: a1': -0.8, 'y: b1 of u': 1.0, 'y: c1': 0.5}
    """

    called = "recursive-polynomial"

    def waits(self, spec: PlantSpec) -> int:
        """Return the samples of the burn-in."""
        return self._waits_for(self._orders(spec, self.called))

    def fitted(self, state: RecursiveState, records: list[Trajectory]) -> LinearModel:
        """Return the model of the state after records, its coefficients in the notes."""
        model, spec = self.model(state), state.spec
        values, deviations = state.coefficients
        units = []
        for output, own in zip(spec.outputs, state.orders, strict=True):
            gains = [
                quotient(output.unit, c.unit) for c, nb in zip(spec.inputs, own.nb, strict=True) for _ in range(nb)
            ]
            units += ["1"] * _past(own) + gains + ["1"] * own.nc
        estimate = Estimate(
            tuple(state.names),
            tuple(units),
            values,
            np.diag(deviations**2),
            method="no interval: the deviations of a recursion hold for coefficients that stay as they are",
        )
        return replace(model, notes={"estimate": estimate.to_dict()})

    def model(self, state: RecursiveState) -> LinearModel:
        """Return the model of a state after the burn-in, in innovation form."""
        nu, found, offset = state.spec.nu, [], []
        for own, one in zip(state.orders, state.filters, strict=True):
            past, tail = _past(own), one.theta[:-1]
            first, gains, noise = np.split(tail, np.cumsum([past, sum(own.nb)]))
            ordered = [gains, noise, first] if own.nf else [first, gains, noise]
            level = one.theta[-1] if own.nf else 0.0
            found.append(Polynomials.of(np.concatenate([*ordered, [level]]), own))
            offset.append(0.0 if own.nf else one.theta[-1])
        a, b, c, d, k, level_of = block_form(found)
        constant = c.T @ np.array(offset)  # the constant of an equation enters where the output is made
        scaled = innovation_form(state.spec, a, b, c, d, k, constant, level_of, burn_in=_reach(state.orders))
        model = scaled.in_units(Scaling(state.size[:nu], state.size[nu:]))
        return replace(
            model,
            state_offset=model.state_offset - model.b_matrix @ state.centre[:nu],
            output_offset=model.output_offset + state.centre[nu:],
        )

    def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> RecursiveState:
        """Return the state before any data."""
        what = "recursive-polynomial"
        check_options(self, what, order=">= 1", forgetting="> 0, <= 1", burn_in=">= 1")
        real_signals(spec, what)
        if spec.nu == 0 and self.structure == "oe":
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use structure armax")
        orders = self._orders(spec, what)
        width = spec.nu + spec.ny
        return RecursiveState(
            spec,
            orders,
            (),
            np.zeros((_reach(orders), spec.nu)),
            np.zeros(spec.ny),
            0,
            0,
            (),
            np.zeros(width),
            np.ones(width),
        )

    def start(self, state: RecursiveState, y: FloatArray) -> RecursiveState:
        """Return the state after the first output of a record; what was learned stays, the past does not."""
        y = np.array(y, dtype=float)
        if not state.filters:
            return replace(state, tape=(*state.tape, (None, y)), last=y, seen=1)
        return self._begun(replace(state, last=y), y)

    def predict(self, state: RecursiveState, u: FloatArray) -> FloatArray:
        """Return the output (ny,) that ``u`` leads to; the last output during the burn-in and the first lags."""
        if not self._knows(state):
            return np.array(state.last)
        nu = state.spec.nu
        late = _pushed(state.u, (np.asarray(u, dtype=float) - state.centre[:nu]) / state.size[:nu])
        guess = np.array(
            [_regressor(own, one, late) @ one.theta for own, one in zip(state.orders, state.filters, strict=True)]
        )
        found: FloatArray = state.centre[nu:] + state.size[nu:] * guess
        return found

    def update(self, state: RecursiveState, u: FloatArray, y: FloatArray) -> RecursiveState:
        """Return the state after ``u`` led to ``y``."""
        u, y = np.array(u, dtype=float), np.array(y, dtype=float)
        new = replace(state, last=y, learned=state.learned + 1)
        if state.filters:
            return self._learned(new, u, y)
        new = replace(new, tape=(*state.tape, (u, y)), seen=state.seen + 1)
        return self._scaled(new) if new.learned >= self._waits_for(new.orders) else new

    def hindsight(self, trajectories: Sequence[Trajectory]) -> Hindsight:
        """Return the losses of the batch prediction-error model of these orders, with the same held predictions.

        ``exact`` is False: the sum of squares is not convex, and the initial states of the records are not free here.
        """
        spec = trajectories[0].spec
        what = "recursive-polynomial"
        moving(trajectories, what)
        orders = self._orders(spec, what)
        given = {"na": self.na, "nb": self.nb, "nc": self.nc, "nf": self.nf, "nk": 1 if self.nk is None else self.nk}
        given = {name: value for name, value in given.items() if value is not None}
        batch = PredictionError(structure=self.structure, order=self.order, least_excitation=0.0, **given)  # type: ignore[arg-type]
        if spec.nu == 0:
            raise FitError(f"{what}: hindsight without inputs", expected="an input", got="none", remedy="use rls")
        model = batch.fit(list(trajectories), rng=np.random.default_rng(0))
        waits, reach, losses, learned = self._waits_for(orders), _reach(orders), [], 0
        for record in trajectories:
            x = model.initial_state(record[: max(reach, 1)])
            guesses = record.y[:-1].copy()
            for k in range(len(record) - 1):
                x = model.step(model.correct(x, record.u[k], record.y[k]), record.u[k])
                if learned >= waits and k + 1 >= reach:
                    guesses[k] = model.output(x, record.u[k])
                learned += 1
            losses.append(residual(spec.outputs, record.y[1:], guesses) ** 2)
        each = np.concatenate(losses)
        details = {"burn_in": waits, "polynomials": model.notes["polynomials"], "prior": PRIOR}
        # Pseudo-linear regression converges, but its covariance is not the least: the law holds, not the factor.
        count = float(np.mean([_past(own) + sum(own.nb) + own.nc + 1 for own in orders]))
        growth = Growth.of_least_squares(count, self.forgetting)
        if self.method == "pseudo-linear" and self.structure != "arx":
            growth = replace(growth, factor=None)
        return Hindsight(each.sum(axis=1), exact=False, details=details, per_output=each, growth=growth)

    def _orders(self, spec: PlantSpec, what: str) -> tuple[Orders, ...]:
        """Return the orders of every output."""
        given: dict[str, Counts | None] = {"na": self.na, "nb": self.nb, "nc": self.nc, "nf": self.nf, "nk": self.nk}
        found = tuple(orders_by_output(self.structure, spec, given, self.order, what))
        if any(nk < 1 for own in found for nk in own.nk):
            raise FitError(f"{what}: nk", expected="delays of at least 1", got=str(self.nk), remedy="raise them")
        return found

    def _waits_for(self, orders: Sequence[Orders]) -> int:
        return self.burn_in or max(20, 4 * max(_past(own) + sum(own.nb) + own.nc + 1 for own in orders))

    def _knows(self, state: RecursiveState) -> bool:
        """Return True if the present record is long enough for the model's lags."""
        return bool(state.filters) and state.seen >= _reach(state.orders)

    def _scaled(self, state: RecursiveState) -> RecursiveState:
        """Return the state at the end of the burn-in: sizes are known, and the recursion runs over what came so far."""
        inputs = np.array([u for u, _ in state.tape if u is not None])
        outputs = np.array([y for _, y in state.tape])
        centre = np.concatenate([inputs.mean(axis=0), outputs.mean(axis=0)])
        size = np.concatenate([sizes([inputs - inputs.mean(axis=0)]), sizes([outputs - outputs.mean(axis=0)])])
        filters = []
        for own in state.orders:
            p, m = _past(own) + sum(own.nb) + own.nc + 1, own.nf[0] if own.nf else own.nc
            zeros = np.zeros(p)
            filters.append(
                OutputFilter(
                    zeros, PRIOR * np.eye(p), np.zeros(_past(own)), np.zeros(own.nc), np.zeros((m, p)), np.zeros(4)
                )
            )
        now = replace(state, filters=tuple(filters), tape=(), centre=centre, size=size)
        for u, y in state.tape:
            now = self._begun(now, y) if u is None else self._learned(now, u, y)
        return now

    def _begun(self, state: RecursiveState, y: FloatArray) -> RecursiveState:
        """Return the state after the first output of a record."""
        nu = state.spec.nu
        first = (y - state.centre[nu:]) / state.size[nu:]
        filters = tuple(
            replace(
                one,
                y=_pushed(np.zeros_like(one.y), first[i]),
                inner=np.zeros_like(one.inner),
                slopes=np.zeros_like(one.slopes),
            )
            for i, one in enumerate(state.filters)
        )
        return replace(state, filters=filters, u=np.zeros_like(state.u), seen=1)

    def _learned(self, state: RecursiveState, u: FloatArray, y: FloatArray) -> RecursiveState:
        """Return the state after a sample, sizes known."""
        nu = state.spec.nu
        late = _pushed(state.u, (u - state.centre[:nu]) / state.size[:nu])
        seen = (y - state.centre[nu:]) / state.size[nu:]
        knows = self._knows(state)
        filters = []
        for own, one, value in zip(state.orders, state.filters, seen, strict=True):
            filters.append(self._step(own, one, late, float(value)) if knows else replace(one, y=_pushed(one.y, value)))
        return replace(state, filters=tuple(filters), u=late, seen=state.seen + 1)

    def _step(self, own: Orders, one: OutputFilter, late: FloatArray, y: float) -> OutputFilter:
        """Return the recursion of one output after a sample."""
        row = _regressor(own, one, late)
        tail = _tail(own, one.theta)
        psi = row.copy()
        if self.method == "gradient" and tail.size:  # the constant of an output error is added behind 1/F
            psi -= tail @ one.slopes
            if own.nf:
                psi[-1] = row[-1]
        miss = y - float(row @ one.theta)
        weights = float(one.errors[1])
        factor = self.forgetting * (1.0 - LEARNS * SETTLES**weights) if own.nf or own.nc else self.forgetting
        most = PRIOR * one.theta.size
        guard = factor < 1.0 and weights > 0 and float(np.trace(one.covariance)) >= factor * most
        factor = 1.0 if guard else factor
        ahead = one.covariance @ psi
        spread = factor + float(psi @ ahead)
        covariance = (one.covariance - np.outer(ahead, ahead) / spread) / factor
        covariance = (covariance + covariance.T) / 2
        theta, step = one.theta + ahead * (miss / spread), ahead * (miss / spread)
        halved = 0
        while halved < HALVINGS and not _stable(_tail(own, theta)):
            halved += 1
            theta = one.theta + step * 0.5**halved
        lost = not _stable(_tail(own, theta))
        theta = one.theta if lost else theta
        after = float(row @ theta)
        # of a sum with forgetting: e^2 lambda / (lambda + psi' P psi) is what the sum of squares grows by
        gained = np.array([miss**2 * factor / spread, 1.0, 1.0, (spread - factor) / spread])
        errors = one.errors * np.array([factor, factor, factor**2, factor]) + gained
        past = after - theta[-1] if own.nf else y
        return OutputFilter(
            theta,
            covariance,
            _pushed(one.y, past),
            _pushed(one.inner, y - after),
            _pushed(one.slopes, psi),
            errors,
            one.guarded + int(guard),
            one.rejected + int(lost),
        )


def _past(own: Orders) -> int:
    """Return the number of past outputs (of output error: the model's own) in a regressor."""
    return own.nf[0] if own.nf else own.na


def _reach(orders: Sequence[Orders]) -> int:
    """Return the samples of a record that the models' lags take."""
    inputs = [nb + nk - 1 for own in orders for nb, nk in zip(own.nb, own.nk, strict=True) if nb]
    return max([1, *map(_past, orders), *inputs])


def _regressor(own: Orders, one: OutputFilter, late: FloatArray) -> FloatArray:
    """Return the regressor (p,) of the next output; ``late`` (L, nu) begins with the input that leads to it."""
    inputs = [late[nk - 1 : nk - 1 + nb, i] for i, (nb, nk) in enumerate(zip(own.nb, own.nk, strict=True))]
    return np.concatenate([-one.y, *inputs, one.inner, [1.0]])


def _tail(own: Orders, theta: FloatArray) -> FloatArray:
    """Return the polynomial that gradients are filtered by: F or C, nothing of ARX."""
    if own.nf:
        return theta[: own.nf[0]]
    return theta[theta.size - 1 - own.nc : -1]


def _stable(coefficients: FloatArray) -> bool:
    """Return True if ``1 + c1 q^-1 + ...`` has its roots inside the unit circle (Jury 1964, by step-down)."""
    now = np.concatenate([[1.0], coefficients])
    while now.size > 1:
        last = now[-1]
        if not abs(last) < 1.0:
            return False
        now = (now[:-1] - last * now[:0:-1]) / (1.0 - last**2)
    return True


def _pushed(buffer: FloatArray, value: Any) -> FloatArray:
    """Return a buffer, newest first, with a value more."""
    if not len(buffer):
        return buffer
    new = np.empty_like(buffer)
    new[0] = value
    new[1:] = buffer[:-1]
    return new
