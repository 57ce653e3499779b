"""Prediction-error method with free initial states: output error, ARMAX, Box-Jenkins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import feedback_of, refuse_undetermined
from harness.models.determined import KEY, determined_bands
from harness.scoring import equation_error, simulation_error
from harness.signals import FloatArray, Trajectory
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import spread_of, steps_without
from identifiers.common.observers import innovation_form
from identifiers.common.records import moving, real_signals, usable
from identifiers.common.scaling import scaled
from identifiers.common.stability import RADIUS
from identifiers.linear.ho_kalman import realize
from identifiers.linear.polynomial import Orders, Part, Polynomials, block_form, errors_and_gradients
from identifiers.linear.polynomial_estimate import Fitted, prediction_error_estimate, whiteness

__all__ = ["PredictionError"]

LADDER = (1, 2, 3, 4, 6)
# Another order must lower the validated error by this much.
_GAIN = 0.98
# Errors below this fraction of the outputs are rounding: no reason for another order.
_ROUNDING = 1e-7
# Memory of the long regression that a start is realized from, at least.
_MEMORY = 12
# Relative gain of the loss below which the search has arrived, and rounds after which it gives up.
_ARRIVED, _ROUNDS = 1e-9, 60
# Time constants of C and D that a record holds at least.
_MEMORIES = 5.0
# Starts whose denominators are nearer than this are one.
_SAME = 1e-3
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
        measured = records
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
        notes[KEY] = determined_bands(model.in_units(scaling).matrices, measured)
        model = replace(model, notes=notes)
        return (model if "stabilized" in notes else self._with_spread(model, fits)).in_units(scaling)

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
        model = innovation_form(spec, a, b, c, d, k, np.zeros(len(a)), level_of, notes=notes)
        return model, fits

    def _with_spread(self, model: LinearModel, fits: Sequence[Fitted]) -> LinearModel:
        """Return the model with the fits without one stretch of the records each, one step of the search away."""
        moves = [fit.moves for fit in fits]
        count = min(0 if own is None else len(own) for own in moves)
        near, nu = [], model.spec.nu
        for group in range(count):
            others = [
                Polynomials.of(fit.model.vector + own[group], fit.model.orders, nu)
                for fit, own in zip(fits, moves, strict=True)
                if own is not None
            ]
            a, b, c, d, _, _ = block_form(others, nu)
            more = len(model.a_matrix) - len(a)  # states that hold the last innovation, which no input reaches
            near.append((np.pad(a, (0, more)), np.pad(b, ((0, more), (0, 0))), np.pad(c, ((0, 0), (0, more))), d))
        return replace(model, spread=spread_of(near, warning=str(model.notes.get("warning", ""))))

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
        end = _best([_search(first, parts, self.offset) for first in starts])
        if orders.nf and (orders.nc or orders.nd):
            end = _needed(end, orders, parts, self.offset)
        cost, model, miss, gradients, arrived = end
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
        rms, moves = float(np.sqrt(cost / rows)), steps_without(gradients, miss)
        own = None if moves is None else moves[:, :count]
        return Fitted(model, covariance, rms, whiteness(residuals), values, arrived, spare, stabilized, own)


def _starting_models(parts: Sequence[Part], orders: Orders, offset: bool) -> list[Polynomials]:
    """Return where the search begins: several, of which the best end is taken."""
    level = float(np.concatenate([part.y for part in parts]).mean()) if offset else 0.0
    nu, none = parts[0].u.shape[1], np.zeros(0)
    realized = _realized(parts, orders, level)
    if orders.nf == 0:
        firsts = [_hannan(parts, orders, level)]
        for f, b in realized:  # white noise on the output: C is A
            c = np.zeros(orders.nc)
            c[: min(f.size, orders.nc)] = _inside(f)[: orders.nc]
            firsts.append(Polynomials(orders, f, b, _inside(c), none, none, level))
        return firsts
    quiet = replace(orders, nc=0, nd=0)
    found = [_steiglitz(parts, orders, level, refine) for refine in (True, False)] + realized
    firsts = [Polynomials(quiet, none, b.reshape(nu, orders.nb), none, none, _inside(f), level) for f, b in found]
    if not (orders.nc or orders.nd):
        return firsts
    # The best model with white noise on the output comes first: with a noise model it can only become better.
    _, best, _, _, _ = _best([_search(first, parts, offset) for first in firsts])
    return [_with_noise(first, orders, parts) for first in _distinct([best, *firsts])]


def _distinct(models: Sequence[Polynomials]) -> list[Polynomials]:
    """Return the models without those that begin where an earlier one does."""
    kept: list[Polynomials] = []
    for model in models:
        if all(np.abs(model.f - other.f).max(initial=0.0) > _SAME for other in kept):
            kept.append(model)
    return kept


def _with_noise(quiet: Polynomials, orders: Orders, parts: Sequence[Part]) -> Polynomials:
    """Return an output-error model with the C and D that its residuals tell (Hannan & Rissanen 1982)."""
    blank = [(np.zeros(quiet.orders.start_x), np.zeros(quiet.orders.start_z)) for _ in parts]
    residual, gradients = errors_and_gradients(quiet, blank, parts)
    starts = gradients[:, quiet.vector.size :]
    if starts.shape[1]:  # what happened before the records is not noise
        residual = residual - starts @ np.linalg.lstsq(starts, residual, rcond=1e-9)[0]
    pieces = np.split(residual, np.cumsum([part.y.size for part in parts])[:-1])
    noise = _hannan(
        [Part(np.zeros((piece.size, 0)), piece) for piece in pieces],
        Orders(na=orders.nd, nc=orders.nc, delay=orders.delay),
        0.0,
    )
    return replace(quiet, orders=orders, c=noise.c, d=_inside(noise.a))


def _realized(parts: Sequence[Part], orders: Orders, level: float) -> list[tuple[FloatArray, FloatArray]]:
    """Return F and B (nu, nb) of the system of this order that a long one-step regression shows (OKID, Ho-Kalman).

    Steiglitz and McBride's iteration may end anywhere where sampling is fast; a realization of the response does not
    depend on a start. Empty where the records are too short for it, or do not excite so much.
    """
    n, delay = max(orders.nf, orders.na), orders.delay
    nu = parts[0].u.shape[1]
    lags = int(min(max(4 * n, _MEMORY), min(part.y.size for part in parts) // (4 * (nu + 1))))
    if not n or lags <= n:
        return []
    blocks = [_long_rows(part, lags, level) for part in parts]
    x, y = np.concatenate([rows for rows, _ in blocks]), np.concatenate([target for _, target in blocks])
    theta = np.linalg.lstsq(x, y, rcond=1e-10)[0]
    seen, pushed = theta[:lags], theta[lags:].reshape(lags + 1, nu)
    length = 4 * lags
    markov = np.zeros((length, nu))
    for k in range(length):
        markov[k] = pushed[k] if k <= lags else 0.0
        few = min(k, lags)
        markov[k] += seen[:few] @ markov[k - 1 :: -1][:few] if few else 0.0
    if not (np.abs(markov) < 1e9).all():
        return []
    try:
        a = realize(markov[1:, None, :], order=n)[0]
    except FitError:
        return []
    f = np.real(np.poly(np.linalg.eigvals(a)))
    settled = np.concatenate([[1.0], _inside(f[1:])])
    b = np.array([np.convolve(settled, markov[: delay + orders.nb, i])[delay : delay + orders.nb] for i in range(nu)])
    return [(settled[1:], b)]


def _long_rows(part: Part, lags: int, level: float) -> tuple[FloatArray, FloatArray]:
    """Return the rows ``[y[k-1], ..., y[k-p], u[k], u[k-1], ..., u[k-p]]`` and ``y[k]`` of one record."""
    y, index = part.y - level, np.arange(lags, part.y.size)
    columns = [y[index - j] for j in range(1, lags + 1)]
    columns += [part.u[index - j, i] for j in range(lags + 1) for i in range(part.u.shape[1])]
    return np.column_stack(columns), y[lags:]


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


def _needed(end: _End, orders: Orders, parts: Sequence[Part], offset: bool) -> _End:
    """Return the end of a search with a noise model, or the same without one where its gain is chance.

    Without noise that is coloured C and D may be any common factor: at the edge of the unit circle it follows the
    record's slow chances by its free start, and foretells nothing.
    """
    none, model = np.zeros(0), end[1]
    quiet = replace(model, orders=replace(orders, nc=0, nd=0), c=none, d=none)
    plain = _search(quiet, parts, offset)
    rows, free = sum(part.y.size for part in parts), orders.nc + orders.nd + len(parts) * orders.start_z
    if rows * np.log(plain[0] / max(end[0], 1e-300)) > free * np.log(rows):  # Schwarz 1978
        return end
    blank = replace(plain[1], orders=orders, c=np.zeros(orders.nc), d=np.zeros(orders.nd))
    return _search(blank, parts, offset, rounds=0)


def _settled(model: Polynomials) -> Polynomials:
    """Return the model with its poles inside the unit circle: a start among the stable ones."""
    return replace(model, a=_inside(model.a), d=_inside(model.d), f=_inside(model.f))


def _search(
    first: Polynomials, parts: Sequence[Part], offset: bool, radius: float = np.inf, rounds: int = _ROUNDS
) -> _End:
    """Return the least sum of squares that is reached, where, errors and gradients there, and whether it has arrived.

    No model with a pole beyond the radius is taken, and no noise model that remembers the start through the record:
    with the free start it would fit the record's slow chances.
    """
    orders, nu = first.orders, parts[0].u.shape[1]
    count, nx, nz = first.vector.size, orders.start_x, orders.start_z
    # An integrator is a root at 1: over a record its free run may grow by so much.
    longest = max(part.y.size for part in parts)
    furthest, forgotten = 1.0 + 1.0 / longest, max(1.0 - _MEMORIES / longest, 0.5)

    def split(vector: FloatArray) -> tuple[Polynomials, Starts]:
        states = vector[count:].reshape(len(parts), nx + nz)
        return Polynomials.of(vector, orders, nu), [(row[:nx], row[nx:]) for row in states]

    def evaluated(vector: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        model, starts = split(vector)
        of_f, of_c, of_d = model.radii
        if of_f > furthest or max(of_c, of_d) > forgotten or model.slowest > radius:
            return np.inf, np.zeros(0), np.zeros((0, 0))
        with np.errstate(over="ignore", invalid="ignore"):
            miss, gradients = errors_and_gradients(model, starts, parts)
        if not offset:
            gradients[:, count - 1] = 0.0
        cost = float(miss @ miss)
        return (cost if np.isfinite(cost) else np.inf), miss, gradients

    if max(first.radii[1:]) > forgotten:  # well inside: roots that meet are known to a root of rounding
        first = replace(first, c=_inside(first.c, 0.99 * forgotten), d=_inside(first.d, 0.99 * forgotten))
    if first.radii[0] > furthest:
        first = replace(first, f=_inside(first.f))
    vector = np.concatenate([first.vector, np.zeros(len(parts) * (nx + nz))])
    cost, miss, gradients = evaluated(vector)
    if not gradients.size:  # no start of a model that is allowed
        return np.inf, first, miss, gradients, False
    # The initial states are linear in the errors: solve for them first.
    if gradients.shape[1] > count:
        vector[count:] -= np.linalg.lstsq(gradients[:, count:], miss, rcond=1e-9)[0]
        cost, miss, gradients = evaluated(vector)
    damping, arrived = 1e-3, rounds == 0
    power = float(np.sum(np.concatenate([part.y for part in parts]) ** 2))
    for _ in range(rounds):
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
