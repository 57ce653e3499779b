"""ARX models: the next output from past outputs and inputs, with order and lag by validation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import feedback_of, refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.estimate import Estimate
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.excitation import Columns, excited_lags, refuse_feedback
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import BIAS, LARGEST, coefficients_without, spread_of
from identifiers.common.one_step_estimate import foretold_output, least_squares_estimate
from identifiers.common.records import lagged, lagged_blocks, learnable, missing_notes, snapshot_sums, usable
from identifiers.common.regression import Solution, solve
from identifiers.common.scaling import EXACT, lively, sizes, together
from identifiers.common.stability import nearest_stable, stable_lags, told_of_stable
from identifiers.linear.arx_channels import arx_by_channel, arx_orders_of, channel_neighbours
from identifiers.linear.polynomials.orders import Counts

ORDERS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
# An order is kept only if it lowers the validated error by this much: below it the gain is chance.
_GAIN = 0.98
# A constant is missed where it lowers the mean square by so much, and chance would not do so once in a million.
_MISSED, _CHANCE = 1.05, 1e-6


@dataclass(frozen=True)
class Arx:
    """ARX model of one order for all channels, or of one for every pair; chosen by validation where none is given.

    Parameters
    ----------
    order : int, optional
        Number of past outputs and inputs. Without it the orders 1, 2, 3, 4, 6, 8, 12, 16, 24, 32 are tried and the one
        with the least one-step error on the last third of the records wins (Ljung 1999, sec. 16.4).
    delay : int, optional
        Samples that an input takes to reach an output, at least 1: inputs later than that are left out. Without it 1,
        or with no order either the largest that validation bears, but where past outputs foretell the input.
    offset : bool
        Fit a constant too.
    ridge : float
        Tikhonov weight, for records that do not excite all lags.
    stable : bool
        Nearest stable model where the fit is unstable.
    least_excitation : float
        As of ``least-squares``: inputs must depart from any law of the other regressors by so many times the noise
        that the law passes on. Not asked with a ridge.
    na, nb : int, list of int or list of lists, optional
        Past values of the outputs, and coefficients of the inputs: a number for all, one for each channel, or rows of
        outputs by columns of channels. With any of ``na``, ``nb``, ``nk`` what is not given is ``order``, or chosen by
        Schwarz's criterion.
    nk : int, list, list of lists or "auto", optional
        Delays, at least 1; ``"auto"`` finds each from the data, and the notes say how sure it is.
    """

    order: int | None = None
    delay: int | None = None
    offset: bool = True
    ridge: float = 0.0
    stable: bool = False
    least_excitation: float = 2.0
    na: Counts | None = None
    nb: Counts | None = None
    nk: Counts | Literal["auto"] | None = None

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a model whose state is the past outputs and inputs."""
        what = "arx"
        records, spec = learnable(trajectories, samples=4, what=what)
        refuse_law(records, what, self.least_excitation)
        if (self.na, self.nb, self.nk) != (None, None, None):
            return self._by_channel(records, missing_notes(trajectories, records), what)
        ladder: dict[str, Any] = {}
        order, delay = self.order, self.delay
        if order is None:
            order, delay, ladder = self._chosen(records, what)
        delay = 1 if delay is None else delay
        if order < 1 or not 1 <= delay <= order:
            raise FitError(
                f"{what}: order and delay",
                expected="order at least 1, delay from 1 to the order",
                got=f"order={order}, delay={delay}",
                remedy="raise the order, or lower the delay",
            )
        records, _ = usable(records, samples=order + 2, what=what)
        order, delay, solution = self._judged(records, order, delay, ladder, what)
        coefficients = _widened(solution.coefficients, spec, order, delay)
        notes = {"order": order, "delay": delay, **ladder, **missing_notes(trajectories, records)}
        own = order * spec.ny
        estimate = None
        if self.ridge == 0.0 and delay == 1:
            estimate = least_squares_estimate(records, solution, order, self.offset)
        kept = {} if estimate is None else {"estimate": estimate.to_dict()}
        model = lag_model(spec, coefficients, order, self.offset, {**notes, **solution_notes(solution), **kept})
        if self.stable and spectral_radius(model.a_matrix) >= 1.0:
            weights = 1.0 / sizes([record.y for record in records])
            factor = solution.factor * solution.scale
            coefficients = nearest_stable(solution.coefficients, factor, own, stable_lags, weights)
            notes = told_of_stable({**notes, **solution_notes(solution)}, solution, coefficients, weights)
            coefficients = _widened(coefficients, spec, order, delay)
            return lag_model(spec, coefficients, order, self.offset, notes)
        model = replace(model, notes={**model.notes, KEY: determined_bands(model.matrices, records)})
        return with_lag_neighbours(model, records, solution, order, self.offset, delay=delay, estimate=estimate)

    def _judged(
        self, records: list[Trajectory], order: int, delay: int, ladder: dict[str, Any], what: str
    ) -> tuple[int, int, Solution]:
        """Return order, delay and solution where the inputs tell the model; an order that was chosen is lowered to it.

        Validation bears any order of a few lines. Inputs that excite so many lags tell a model of half that order
        (Ljung 1999, theorem 13.1).
        """
        lags: int | None = None
        while True:
            try:
                solution = one_step(records, order, self.offset, self.ridge, what, delay=delay)
                if self.ridge == 0.0:
                    refuse_feedback(solution, Columns(records[0].spec, order, delay), self.least_excitation, what)
                return order, delay, solution
            except FitError:
                if self.order is not None:
                    raise
                if lags is None:
                    lags = excited_lags(records, 2 * order)
                    lags = 0 if lags >= 2 * order else lags  # rich inputs: it is no order that is too high
                below = {int(n): error for n, error in ladder["order_error"].items() if int(n) < order}
                errors = {n: error for n, error in below.items() if 2 * n <= lags}
                if not errors:
                    raise
                order = min(errors, key=lambda n: errors[n])
                delay = min(delay, order)

    def _by_channel(self, records: list[Trajectory], said: dict[str, Any], what: str) -> LinearModel:
        """Return the model whose channels have orders of their own."""
        spec = records[0].spec
        orders, notes = arx_orders_of(records, self.na, self.nb, self.nk, self.order, what)
        records, _ = usable(records, samples=orders.lags + 2, what=what)
        fitted = arx_by_channel(records, orders, self.offset, self.ridge, self.least_excitation, what)
        theta, solutions, estimate = fitted
        notes |= {"na": list(map(list, orders.na)), "nb": list(map(list, orders.nb)), "nk": list(map(list, orders.nk))}
        notes |= {
            "residual_rms": [float(one.residual_rms[0]) for one in solutions],
            "samples": solutions[0].rows,
            **said,
        }
        if self.stable and spectral_radius(lag_model(spec, theta, orders.lags, self.offset).a_matrix) >= 1.0:
            raise FitError(
                f"{what}: the model is unstable",
                expected="a stable one, as asked",
                got="a pole on or outside the unit circle",
                remedy="use prediction-error with structure arx and stable, or one order for all channels",
            )
        if estimate is not None:
            notes["estimate"] = estimate.to_dict()
        model = lag_model(spec, theta, orders.lags, self.offset, notes)
        model = replace(model, notes={**notes, KEY: determined_bands(model.matrices, records)})
        found = channel_neighbours(records, orders, theta, solutions, self.offset)
        if found is None:
            return model
        near = [lag_model(spec, one, orders.lags, self.offset).matrices for one in found[0]]
        return replace(model, spread=spread_of(near, factor=found[1], warning=found[2]))

    def _chosen(self, records: list[Trajectory], what: str) -> tuple[int, int, dict[str, Any]]:
        """Return order and delay that predict the last third of the records best, and the ladder of errors."""
        cuts = [(record[: 2 * len(record) // 3], record[2 * len(record) // 3 :]) for record in records]
        longest = max(min(len(head), len(tail)) for head, tail in cuts) - 2
        # All orders are judged on the same rows, those that the longest leaves.
        orders = [n for n in ORDERS if n <= max(1, longest // 3)]
        skip = orders[-1]
        delay = 1 if self.delay is None else self.delay
        found: dict[int, FloatArray] = {}
        for order in orders:
            if delay > order:
                continue
            held = self._held_out_errors(cuts, order, delay, skip, what)
            if held is None:
                break
            found[order] = held
        if not found:
            return 1, delay, {"order_error": {}}
        moves = lively(np.array(list(found.values())))
        errors = {order: together(held, moves) for order, held in found.items()}
        best, chosen = np.inf, 1
        for order, error in errors.items():
            if error < _GAIN * best:
                best, chosen = error, order
        if self.delay is None and not feedback_of(records).found:  # in a loop outputs foretell what inputs did
            for longer in range(2, chosen + 1):
                held = self._held_out_errors(cuts, chosen, longer, skip, what)
                if held is None or together(held, moves) > best * (1 + 1e-3):
                    break
                best, delay = min(best, together(held, moves)), longer
        return chosen, delay, {"order_error": {str(n): float(np.sqrt(e)) for n, e in errors.items()}}

    def _held_out_errors(
        self, cuts: Sequence[tuple[Trajectory, Trajectory]], order: int, delay: int, skip: int, what: str
    ) -> FloatArray | None:
        """Return one-step mean squares (ny,) on the parts held out, relative to each output; None if no fit."""
        fit = [head for head, _ in cuts if len(head) > order + 1]
        held = [tail for _, tail in cuts if len(tail) > skip + 1]
        if not fit or not held:
            return None
        try:
            theta = one_step(fit, order, self.offset, self.ridge, what, delay=delay).coefficients
        except FitError:
            return None
        wrong = [
            (record.y[order:] - design(record, order, self.offset, delay) @ theta)[skip - order :] for record in held
        ]
        return np.asarray(np.mean((np.concatenate(wrong) / sizes([record.y for record in held])) ** 2, axis=0))


def lag_model(
    spec: PlantSpec, coefficients: FloatArray, lags: int, offset: bool, notes: dict[str, Any] | None = None
) -> LinearModel:
    """Return the state-space form of ``y[k+1] = theta [lags of y, lags of u, 1]``.

    The state is ``[y[k], ..., y[k - lags + 1], u[k - 1], ..., u[k - lags + 1]]``.

    - ``coefficients`` (lags (ny + nu) + offset, ny)
    """
    ny, nu = spec.ny, spec.nu
    theta = coefficients.T
    past = lags * ny
    nx = past + (lags - 1) * nu
    a, b = np.zeros((nx, nx)), np.zeros((nx, nu))
    a[:ny, :past] = theta[:, :past]
    b[:ny] = theta[:, past : past + nu]
    a[:ny, past:] = theta[:, past + nu : past + lags * nu]
    a[ny:past, : past - ny] = np.eye(past - ny)
    if lags > 1:
        b[past : past + nu] = np.eye(nu)
        a[past + nu :, past : nx - nu] = np.eye((lags - 2) * nu)
    c = np.zeros((ny, nx))
    c[:, :ny] = np.eye(ny)
    state_offset = np.zeros(nx)
    if offset:
        state_offset[:ny] = theta[:, -1]
    direct = np.zeros((ny, nu))
    return LinearModel(
        spec, a, b, c, direct, c.T.copy(), state_offset, np.zeros(ny), burn_in=lags - 1, notes=notes or {}
    )


def design(record: Trajectory, lags: int, offset: bool, delay: int = 1) -> FloatArray:
    """Return the regressors of one record (N - lags, p)."""
    rows = _delayed(lagged(record, lags), record.spec, lags, delay)
    return np.hstack([rows, np.ones((rows.shape[0], 1))]) if offset else rows


def one_step(
    records: Sequence[Trajectory], lags: int, offset: bool, ridge: float, what: str, *, delay: int = 1
) -> Solution:
    """Solve for the next output from lagged outputs and inputs."""
    spec = records[0].spec
    names = Columns(spec, lags).names
    first = lags * spec.ny
    names = names[:first] + names[first + (delay - 1) * spec.nu :]
    return solve(
        lambda: _one_step_blocks(records, lags, offset, delay),
        what,
        ridge=ridge,
        names=names,
        sums=snapshot_sums(records, offset=offset) if lags == 1 else None,
    )


def with_lag_neighbours(
    model: LinearModel,
    records: Sequence[Trajectory],
    solution: Solution,
    lags: int,
    offset: bool,
    *,
    delay: int = 1,
    estimate: Estimate | None = None,
) -> LinearModel:
    """Return the model of :func:`lag_model` with what the regression finds without one stretch of the records each.

    - ``solution``: of :func:`one_step`
    - ``estimate``: of :func:`identifiers.common.one_step_estimate.least_squares_estimate`, where there is one: it has
      looked at the residuals already
    """
    found = None
    if len(model.a_matrix) <= LARGEST:
        found = coefficients_without(lambda: _one_step_blocks(records, lags, offset, delay), solution)
    if found is None:
        return model
    spec = records[0].spec
    if estimate is None:
        theta = _widened(solution.coefficients, spec, lags, delay)
        biased = foretold_output(records, theta, lags, offset) is not None
    else:
        biased = estimate.covariance is not None and estimate.intervals is None
    near = [lag_model(spec, _widened(one, spec, lags, delay), lags, offset).matrices for one in found[0]]
    return replace(model, spread=spread_of(near, factor=found[1], warning=BIAS if biased else ""))


def operating_point(records: Sequence[Trajectory], solution: Solution, lags: int, what: str) -> dict[str, str]:
    """Return a warning for the notes where a fit without a constant misses one: records about an operating point.

    - ``solution``: without the constant
    """
    from scipy.stats import chi2

    try:
        more = one_step(records, lags, True, 0.0, what)
    except FitError:  # the constant follows from the others
        return {}
    size = sizes([record.y for record in records])
    before, after = (np.maximum(one.residual_rms, EXACT * size) ** 2 for one in (solution, more))
    ratio = before / after
    worst = int(np.argmax(ratio))
    if ratio[worst] < _MISSED or chi2.sf(solution.rows * np.log(ratio[worst]), 1) > _CHANCE:
        return {}
    name = records[0].spec.outputs[worst].name
    return {
        "warning": f"a constant is missing ({name} stands about an operating point): offset = true makes the residual "
        f"{float(np.sqrt(1 / ratio[worst])):.2g} of this one"
    }


def _one_step_blocks(
    records: Sequence[Trajectory], lags: int, offset: bool, delay: int
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the regressors without inputs that are too late to count, and the next outputs."""
    spec = records[0].spec
    for phi, y in lagged_blocks(records, lags, offset=offset):
        yield _delayed(phi, spec, lags, delay), y


def solution_notes(solution: Solution) -> dict[str, Any]:
    """Return what a report should say of a regression."""
    return {
        "condition": solution.condition,
        "method": solution.method,
        "residual_rms": solution.residual_rms.tolist(),
        "samples": solution.rows,
    }


def _delayed(rows: FloatArray, spec: PlantSpec, lags: int, delay: int) -> FloatArray:
    """Return the regressors without the inputs that are too late to count."""
    first = lags * spec.ny
    return rows if delay == 1 else np.delete(rows, slice(first, first + (delay - 1) * spec.nu), axis=1)


def _widened(coefficients: FloatArray, spec: PlantSpec, lags: int, delay: int) -> FloatArray:
    """Return the coefficients with zeros for the inputs that were left out."""
    first = lags * spec.ny
    zeros = np.zeros(((delay - 1) * spec.nu, coefficients.shape[1]))
    return np.vstack([coefficients[:first], zeros, coefficients[first:]])
