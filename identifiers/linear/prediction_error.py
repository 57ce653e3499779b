"""Prediction-error method with free initial states: output error, ARMAX, Box-Jenkins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import feedback_of, refuse_undetermined
from harness.scoring import equation_error, simulation_error
from harness.signals import FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.observers import innovation_form
from identifiers.common.records import moving, real_signals, usable
from identifiers.common.scaling import scaled
from identifiers.common.stability import RADIUS
from identifiers.linear.polynomial import Orders, Part, Polynomials, block_form, errors_and_gradients
from identifiers.linear.polynomial_estimate import Fitted, prediction_error_estimate, whiteness

__all__ = ["PredictionError"]

LADDER = (1, 2, 3, 4, 6)
# Another order must lower the validated error by this much.
_GAIN = 0.98
# Errors below this fraction of the outputs are rounding: no reason for another order.
_ROUNDING = 1e-7
# Relative gain of the loss below which the search has arrived, and rounds after which it gives up.
_ARRIVED, _ROUNDS = 1e-9, 60
# Refinements of a starting model by filtering with its own denominator.
_STEIGLITZ = 12
# Gradients that depend on others up to this share of the largest singular value: what numpy.linalg.pinv leaves out.
_LOST = 1e-15
# Cost, model, errors and gradients at the end of a search, and whether it arrived.
_End = tuple[float, Polynomials, FloatArray, FloatArray, bool]
Starts = list[tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class PredictionError:
    """Polynomial model by minimising its one-step prediction errors, the initial state of every record free.

    ``A y = B/F u + C/D e`` with ``"oe"``: F and B (white noise on the output; the model is fitted to free runs),
    ``"armax"``: A, B, C, ``"bj"``: B, F, C, D (Ljung 1999, *System Identification*, sec. 4.2, 7.2 and 10.2), by
    Levenberg and Marquardt's method with exact gradients. Output error and Box-Jenkins start from Steiglitz & McBride's
    iteration, ARMAX from Hannan & Rissanen's two stages; of several starts the best end is taken. Each output has
    polynomials of its own.

    Parameters
    ----------
    structure : {"oe", "armax", "bj"}
    order : int, optional
        Of all polynomials. By default one of 1, 2, 3, 4, 6, by the error on the last third of the records: of free runs
        for output error, one step ahead for the others.
    delay : int
        Samples that an input takes to reach an output: 0 with feedthrough, else 1 or more.
    offset : bool
        Fit a constant level of each output too.
    stable : bool
        Where an output's model is unstable, search it again among those with all poles within radius 0.999.
    least_excitation : float
        0 fits also what moves under a controller alone (:mod:`harness.judgement`), from which no model can learn what
        the inputs do.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng = np.random.default_rng(0)
    >>> u, x = rng.normal(size=(600, 1)), np.zeros((600, 1))
    >>> for k in range(599):
    ...     x[k + 1] = 0.8 * x[k] + u[k]
    >>> data = Trajectory(np.arange(600.0), u, x + 0.2 * rng.normal(size=(600, 1)), spec)
    >>> PredictionError(order=1).fit([data], rng=rng).eigenvalues.real.round(2)
    array([0.8])
    """

    structure: Literal["oe", "armax", "bj"] = "oe"
    order: int | None = None
    delay: int = 1
    offset: bool = True
    stable: bool = False
    least_excitation: float = 2.0

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model in innovation form; an output-error model has no filter gain."""
        what = "prediction-error"
        fine = self.structure in ("oe", "armax", "bj") and self.delay >= 0
        if not fine or (self.order is not None and self.order < 1):
            raise FitError(
                f"{what}: options",
                expected="structure oe, armax or bj, order >= 1, delay >= 0",
                got=f"structure={self.structure}, order={self.order}, delay={self.delay}",
                remedy="correct the options",
            )
        records, spec = usable(trajectories, samples=4 * (self.order or 1) + 4, what=what)
        real_signals(spec, what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        moving(records, what)
        refuse_undetermined(records, what, self.least_excitation)
        records, scaling = scaled(records)
        notes: dict[str, Any] = {"structure": self.structure}
        order = self.order
        if order is None:
            order, notes["order_error"] = self._chosen(records, what)
        model, fits = self._fitted(records, order, what)
        feedback = feedback_of(records)
        notes["feedback_share"] = feedback.share
        if feedback.found and self.structure == "oe":
            notes["warning"] = "outputs foretell the input (feedback): output error is biased unless noise is white"
        rms = (np.array(model.notes["residual_rms"]) * scaling.outputs).tolist()
        notes = {**notes, **model.notes, "order": order, "residual_rms": rms}
        estimate = prediction_error_estimate(spec, fits, scaling)
        # about a biased answer, or one on the edge of what is allowed, the spread of the fit says nothing
        if estimate is not None and "warning" not in notes and "stabilized" not in notes:
            notes["estimate"] = estimate.to_dict()
        return replace(model.in_units(scaling), notes=notes)

    def _chosen(self, records: Sequence[Trajectory], what: str) -> tuple[int, dict[str, float]]:
        """Return the order that does best on the last third of the records."""
        fit = [record[: 2 * len(record) // 3] for record in records]
        held = [record[2 * len(record) // 3 :] for record in records]
        errors: dict[str, float] = {}
        best = (np.inf, 1)
        for order in LADDER:
            learn, judge = [o for o in fit if len(o) > 8 * order], [o for o in held if len(o) > 4 * order]
            if not learn or not judge:
                break
            model, _ = self._fitted(learn, order, what)
            score = simulation_error if self.structure == "oe" else equation_error
            wrong = [score(model, record, burn_in=2 * order).rms for record in judge]
            error = float(np.sqrt(np.mean(np.square(wrong))))
            errors[str(order)] = error if np.isfinite(error) else 1e300
            if error < _GAIN * best[0] and best[0] > _ROUNDING:
                best = (error, order)
        return best[1], errors

    def _fitted(self, records: Sequence[Trajectory], order: int, what: str) -> tuple[LinearModel, list[Fitted]]:
        """Return the model of one order, of scaled records, and the fit of every output."""
        spec = records[0].spec
        fits = [
            self._one_output([Part(record.u, record.y[:, column]) for record in records], order, what)
            for column in range(spec.ny)
        ]
        found = [fit.model for fit in fits]
        moved = {"stabilized": True} if any(fit.stabilized for fit in fits) else {}
        a, b, c, d, k, level_of = block_form(found, spec.nu)
        notes = {
            "residual_rms": [fit.rms for fit in fits],
            "converged": all(fit.arrived for fit in fits),
            "polynomials": [
                {name: np.asarray(getattr(model, name)).tolist() for name in ("a", "b", "c", "d", "f", "level")}
                for model in found
            ],
            "standard_errors": [fit.errors for fit in fits],
            **moved,
        }
        return innovation_form(spec, a, b, c, d, k, np.zeros(len(a)), level_of, notes=notes), fits

    def _orders(self, n: int) -> Orders:
        """Return the degrees of a structure."""
        if self.structure == "oe":
            return Orders(nb=n, nf=n, delay=self.delay)
        if self.structure == "armax":
            return Orders(na=n, nb=n, nc=n, delay=self.delay)
        return Orders(nb=n, nc=n, nd=n, nf=n, delay=self.delay)

    def _one_output(self, parts: Sequence[Part], order: int, what: str) -> Fitted:
        """Return polynomials, their covariance, and how the search ended."""
        orders, nu = self._orders(order), parts[0].u.shape[1]
        count = orders.na + nu * orders.nb + orders.nc + orders.nd + orders.nf + 1
        rows = sum(part.y.size for part in parts)
        free = count + len(parts) * (orders.start_x + orders.start_z)
        if rows <= free:
            raise FitError(
                f"{what}: fewer equations than unknowns",
                expected=f"more than {free} samples",
                got=str(rows),
                remedy="record longer, or lower the order",
            )
        starts = _starting_models(parts, orders, self.offset)
        cost, model, miss, gradients, arrived = _best([_search(first, parts, self.offset) for first in starts])
        stabilized = self.stable and model.slowest >= 1.0
        if stabilized:
            starts = [_settled(first) for first in (model, *starts)]
            cost, model, miss, gradients, arrived = _best([_search(s, parts, self.offset, RADIUS) for s in starts])
        spare = max(rows - free, 1)
        length = np.linalg.norm(gradients, axis=0)
        kept = length > 0  # a level that is not fitted has no gradient
        length = np.where(kept, length, 1.0)
        _, values, right = np.linalg.svd(gradients[:, kept] / length[kept], full_matrices=False)
        inverse = np.zeros((length.size,) * 2)
        good = values > _LOST * values[0]
        inverse[np.ix_(kept, kept)] = (right[good].T / values[good] ** 2) @ right[good]
        covariance = cost / spare * (inverse / np.outer(length, length))[:count, :count]
        residuals = np.split(miss, np.cumsum([part.y.size for part in parts])[:-1])
        return Fitted(
            model, covariance, float(np.sqrt(cost / rows)), whiteness(residuals), values, arrived, spare, stabilized
        )


def _starting_models(parts: Sequence[Part], orders: Orders, offset: bool) -> list[Polynomials]:
    """Return where the search begins."""
    level = float(np.concatenate([part.y for part in parts]).mean()) if offset else 0.0
    nu = parts[0].u.shape[1]
    if orders.nf == 0:
        return [_hannan(parts, orders, level)]
    firsts = []
    for refine in (True, False):
        f, b = _steiglitz(parts, orders, level, refine)
        c, d = np.zeros(orders.nc), np.zeros(orders.nd)
        first = Polynomials(orders, np.zeros(0), b.reshape(nu, orders.nb), c, d, _inside(f), level)
        if orders.nc or orders.nd:
            quiet = replace(first, orders=replace(orders, nc=0, nd=0), c=np.zeros(0), d=np.zeros(0))
            blank = [(np.zeros(quiet.orders.start_x), np.zeros(quiet.orders.start_z)) for _ in parts]
            residual = errors_and_gradients(quiet, blank, parts)[0]
            noise = _hannan(
                [Part(np.zeros((residual.size, 0)), residual)],
                Orders(na=orders.nd, nc=orders.nc, delay=orders.delay),
                0.0,
            )
            first = replace(first, c=noise.c, d=_inside(noise.a))
        firsts.append(first)
    return firsts


def _steiglitz(parts: Sequence[Part], orders: Orders, level: float, refine: bool) -> tuple[FloatArray, FloatArray]:
    """Return F and B by least squares on signals filtered by 1/F, again and again (Steiglitz & McBride 1965)."""
    from scipy.signal import lfilter

    nu, n, nb = parts[0].u.shape[1], orders.nf, orders.nb
    f, b = np.zeros(n), np.zeros(nu * nb)
    for _ in range(_STEIGLITZ if refine else 1):
        bottom = np.concatenate([[1.0], _inside(f)])
        rows, targets = [], []
        for part in parts:
            y = lfilter([1.0], bottom, part.y - level)
            u = lfilter([1.0], bottom, part.u, axis=0)
            first = max(n, nb + orders.delay - 1)
            index = np.arange(first, y.size)
            lagged = [-y[index - j] for j in range(1, n + 1)]
            lagged += [u[index - orders.delay - j, i] for i in range(nu) for j in range(nb)]
            rows.append(np.column_stack(lagged))
            targets.append(y[first:])
        theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=1e-10)[0]
        f, b = theta[:n], theta[n:]
    return f, b


def _hannan(parts: Sequence[Part], orders: Orders, level: float) -> Polynomials:
    """Return A, B, C by two regressions, a long one for the innovations first (Hannan & Rissanen 1982)."""
    nu = parts[0].u.shape[1]
    shortest = min(part.y.size for part in parts)
    long = max(orders.na, orders.nc, min(6 * max(orders.na, orders.nc, 1), shortest // 4, 40))
    innovations: list[FloatArray] = []
    for lags, with_noise in ((long, False), (orders.na, True)):
        rows, targets, places = [], [], []
        first = max(long + orders.nc if with_noise else lags, orders.nb + orders.delay - 1, 1)
        for number, part in enumerate(parts):
            y = part.y - level
            if y.size <= first:
                continue
            index = np.arange(first, y.size)
            columns = [-y[index - j] for j in range(1, lags + 1)]
            nb = orders.nb if with_noise or not nu else max(orders.nb, min(lags, first - orders.delay + 1))
            columns += [part.u[index - orders.delay - j, i] for i in range(nu) for j in range(nb)]
            if with_noise:
                columns += [innovations[number][index - j] for j in range(1, orders.nc + 1)]
            rows.append(np.column_stack(columns) if columns else np.zeros((index.size, 0)))
            targets.append(y[first:])
            places.append(number)
        theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=1e-10)[0]
        if not with_noise:
            innovations = [np.zeros(part.y.size) for part in parts]
            for number, row, target in zip(places, rows, targets, strict=True):
                innovations[number][first:] = target - row @ theta
    a, b, c = np.split(theta, [orders.na, orders.na + nu * orders.nb])
    none = np.zeros(0)
    return Polynomials(orders, a, b.reshape(nu, orders.nb), _inside(c), none, none, level)


def _inside(coefficients: FloatArray, radius: float = 0.98) -> FloatArray:
    """Return a polynomial with its roots outside the unit circle mirrored, and none beyond the radius."""
    if not coefficients.size:
        return coefficients
    roots = np.roots(np.concatenate([[1.0], coefficients]))
    moduli = np.abs(roots)
    roots = np.where(moduli > 1.0, roots / np.where(moduli > 0, moduli, 1.0) ** 2, roots)
    moduli = np.abs(roots)
    roots = np.where(moduli > radius, roots / np.where(moduli > 0, moduli, 1.0) * radius, roots)
    return np.pad(np.real(np.poly(roots))[1:], (0, coefficients.size - roots.size))


def _best(ends: Sequence[_End]) -> _End:
    """Return the end of least cost."""
    return min(ends, key=lambda end: end[0])


def _settled(model: Polynomials) -> Polynomials:
    """Return the model with its poles inside the unit circle: a start among the stable ones."""
    return replace(model, a=_inside(model.a), d=_inside(model.d), f=_inside(model.f))


def _search(first: Polynomials, parts: Sequence[Part], offset: bool, radius: float = np.inf) -> _End:
    """Return the least sum of squares that is reached, where, errors and gradients there, and whether it has arrived.

    No model with a pole beyond the radius is taken.
    """
    orders, nu = first.orders, parts[0].u.shape[1]
    count, nx, nz = first.vector.size, orders.start_x, orders.start_z
    # An integrator is a root at 1: over a record its free run may grow by so much.
    furthest = 1.0 + 1.0 / max(part.y.size for part in parts)

    def split(vector: FloatArray) -> tuple[Polynomials, Starts]:
        states = vector[count:].reshape(len(parts), nx + nz)
        return Polynomials.of(vector, orders, nu), [(row[:nx], row[nx:]) for row in states]

    def evaluated(vector: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        model, starts = split(vector)
        of_f, of_c = model.radii
        if of_f > furthest or of_c >= 1.0 or model.slowest > radius:
            return np.inf, np.zeros(0), np.zeros((0, 0))
        with np.errstate(over="ignore", invalid="ignore"):
            miss, gradients = errors_and_gradients(model, starts, parts)
        if not offset:
            gradients[:, count - 1] = 0.0
        cost = float(miss @ miss)
        return (cost if np.isfinite(cost) else np.inf), miss, gradients

    vector = np.concatenate([first.vector, np.zeros(len(parts) * (nx + nz))])
    cost, miss, gradients = evaluated(vector)
    # The initial states are linear in the errors: solve for them first.
    if gradients.shape[1] > count:
        vector[count:] -= np.linalg.lstsq(gradients[:, count:], miss, rcond=1e-9)[0]
        cost, miss, gradients = evaluated(vector)
    damping, arrived = 1e-3, False
    power = float(np.sum(np.concatenate([part.y for part in parts]) ** 2))
    for _ in range(_ROUNDS):
        length = np.linalg.norm(gradients, axis=0)
        length = np.where(length > 0, length, 1.0)
        scaled_gradients = gradients / length
        gram, right = scaled_gradients.T @ scaled_gradients, scaled_gradients.T @ miss
        gained = 0.0
        while damping < 1e8:
            move = np.linalg.solve(gram + damping * np.eye(len(gram)), -right) / length
            then, other_miss, other_gradients = evaluated(vector + move)
            if then < cost:
                gained = cost - then
                vector, cost, miss, gradients = vector + move, then, other_miss, other_gradients
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        if gained <= _ARRIVED * cost or cost <= 1e-20 * power:
            arrived = True
            break
        damping = min(damping, 1e6)
    return cost, split(vector)[0], miss, gradients, arrived
