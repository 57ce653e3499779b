"""Sparse regression on a library of functions (SINDy): few terms, found by sequentially thresholded least squares."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from harness.algebra import divisor
from harness.errors import FitError
from harness.judgement import refuse_law
from harness.models.estimate import Estimate, RankDecision
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.units import quotient
from identifiers.common.excitation import refuse_feedback_of_records
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.library import Library
from identifiers.common.normal import NormalEquations, scaled_equations, solved
from identifiers.common.observers import alpha_beta_gains, best_gain
from identifiers.common.one_step_estimate import DEPENDENT, LARGEST, LEVEL
from identifiers.common.records import learnable
from identifiers.sparse.derivatives import Derivative, derivative_rows, measured_motion, unwrapped
from identifiers.sparse.narx import last_fit
from identifiers.sparse.selection import best_subset, ensemble, lasso
from identifiers.sparse.sparse_model import SparseModel

__all__ = ["NormalEquations", "SparseModel", "Stlsq", "eliminate", "stlsq"]

Time = Literal["continuous", "discrete"]

_BLOCK = 8192


def stlsq(
    equations: NormalEquations, threshold: float | FloatArray, *, ridge: float = 0.0, iterations: int = 20
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return coefficients (p, m) and their support by sequentially thresholded least squares.

    Brunton, Proctor & Kutz 2016 (PNAS 113:3932, algorithm 1), with the threshold on what a term contributes: a term is
    dropped when its root mean square over the data is below ``threshold`` times that of the target. So the answer does
    not depend on the units.

    Parameters
    ----------
    equations : NormalEquations
    threshold : float or array (m,)
        Relative to the root mean square of each target.
    ridge : float
        Tikhonov weight on columns scaled to unit length.
    iterations : int
        At most so many rounds.

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(3, 200))
    >>> one = NormalEquations.of([(phi, 2.0 * phi[1:2])], 3, 1)
    >>> stlsq(one, 0.01)[0].ravel().round(12).tolist()
    [0.0, 2.0, 0.0]
    """
    gram, right, size = scaled_equations(equations)
    p, m = right.shape
    limit = threshold * np.sqrt(equations.square)
    coefficients, support = np.zeros((p, m)), np.zeros((p, m), dtype=bool)
    for column in range(m):
        keep = np.diag(equations.gram) > 0.0
        for _ in range(iterations):
            if not keep.any():
                break
            part = gram[np.ix_(keep, keep)] + ridge * np.eye(int(keep.sum()))
            own = solved(part, right[keep, column])
            # columns have unit length: a coefficient is the length of its term's contribution
            smaller = keep.copy()
            smaller[keep] = np.abs(own) > limit[column]
            if np.array_equal(smaller, keep):
                break
            keep = smaller
        if keep.any():
            coefficients[keep, column] = solved(gram[np.ix_(keep, keep)], right[keep, column])
        support[:, column] = keep
    return coefficients / size[:, None], support


def eliminate(equations: NormalEquations, threshold: float | FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return coefficients (p, m) and their support by leaving out one term at a time.

    Always the term goes whose loss raises the residual least, as long as the residual stays below ``threshold`` times
    the target or 1.22 times the residual of the full library, both in the root mean square. Nearly dependent functions
    are told apart where plain thresholding keeps them all, large and cancelling each other. (Backward elimination;
    Miller 2002, *Subset Selection in Regression*, sec. 3.2.)

    Parameters
    ----------
    equations : NormalEquations
    threshold : float or array (m,)
        Relative to the root mean square of each target.

    Examples
    --------
    >>> phi = np.random.default_rng(0).normal(size=(3, 200))
    >>> phi[2] = phi[1] + 1e-3 * phi[0]
    >>> one = NormalEquations.of([(phi, 2.0 * phi[1:2])], 3, 1)
    >>> eliminate(one, 0.01)[0].ravel().round(9).tolist()
    [0.0, 2.0, 0.0]
    """
    gram, right, size = scaled_equations(equations)
    p, m = right.shape
    coefficients, support = np.zeros((p, m)), np.zeros((p, m), dtype=bool)
    start, limit = _independent(gram), threshold * np.sqrt(equations.square)
    for column in range(m):
        square = float(equations.square[column])
        keep = list(start)
        inverse = np.linalg.inv(gram[np.ix_(keep, keep)])
        own = inverse @ right[keep, column]
        floor = max(square - float(own @ right[keep, column]), 0.0)
        spent = floor
        while len(keep) > 0:
            costs = own**2 / np.diag(inverse)
            cheapest = int(np.argmin(costs))
            cost = float(costs[cheapest])
            if spent + cost > max(1.5 * floor, limit[column] ** 2):
                break
            spent += cost
            others = [i for i in range(len(keep)) if i != cheapest]
            row = inverse[cheapest, others] / inverse[cheapest, cheapest]
            own = own[others] - own[cheapest] * row
            inverse = inverse[np.ix_(others, others)] - np.outer(row, inverse[cheapest, others])
            keep = [keep[i] for i in others]
        if keep:
            coefficients[keep, column] = solved(gram[np.ix_(keep, keep)], right[keep, column])
        support[keep, column] = True
    return coefficients / size[:, None], support


def _independent(gram: FloatArray) -> list[int]:
    """Return columns, simplest first, that are independent of those before (Cholesky factorisation, row by row)."""
    kept: list[int] = []
    factor = np.zeros_like(gram)
    for j in range(gram.shape[0]):
        k = len(kept)
        row = np.zeros(k)
        for i in range(k):
            row[i] = (gram[kept[i], j] - factor[i, :i] @ row[:i]) / factor[i, i]
        remaining = gram[j, j] - float(row @ row)
        if remaining > 1e-11:
            factor[k, :k], factor[k, k] = row, np.sqrt(remaining)
            kept.append(j)
    return kept


@dataclass(frozen=True)
class Stlsq(Excited):
    """SINDy-style identification: sparse equations in a library of polynomials, sines and cosines.

    Parameters
    ----------
    degree : int
        Monomials of states and inputs up to this degree.
    threshold : float
        A term is dropped when what only it explains (under the classical rule: what it contributes) is below this
        fraction of the derivative, or in discrete time of the change from sample to sample, in the root mean square.
    order : int, optional
        1: the outputs are the states; 2: the outputs are positions, their second derivatives are identified and the
        rates belong to the state. By default the order whose model predicts ten steps ahead better on the estimation
        records (1 where an output's rate is measured too, or time is discrete).
    derivative : {"weak", "smooth", "difference"}
        How derivatives are taken: weak form (bears noise), local cubics, central differences.
    half : int, optional
        Half width of the weak form's test functions in samples.
    time : {"continuous", "discrete"}
        With ``"discrete"`` the library gives the next output itself; no derivative is taken.
    harmonics : int
        Sines and cosines of so many multiples of every angle (a periodic output).
    trigonometric : bool
        Sines and cosines of every output, periodic or not.
    rule : {"eliminate", "threshold", "lasso", "subset"}
        Terms leave one by one, always the one that is missed least (:func:`eliminate`), which bears nearly dependent
        functions; or all those below the threshold at once, the classical rule (:func:`stlsq`); or the model of least
        extended BIC on the LASSO path (:func:`identifiers.sparse.selection.lasso`); or the best subset of up to 12
        terms
        (:func:`identifiers.sparse.selection.best_subset`). The last two take no threshold.
    ensemble : int
        Repeat the choice on so many bootstrap samples of stretches of the records and keep what most of them choose;
        the notes hold the inclusion probability of every term that any chose. 0: choose once, from all data.
    ridge : float
        Tikhonov weight of the classical rule while terms are dropped; the last fit is without it.
    iterations : int
        At most so many rounds of the classical rule.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((), (Channel("x"),), 0.01)
    >>> t = np.arange(500) * 0.01
    >>> x = 1.0 / (1.0 + 9.0 * np.exp(-t))
    >>> data = Trajectory(t, np.zeros((500, 0)), x[:, None], spec)
    >>> model = Stlsq(degree=3, order=1).fit([data], rng=np.random.default_rng(0))
    >>> model.support, model.coefficients.round(4).ravel().tolist()
    ((('x', 'x^2'),), [0.0, 1.0, -1.0, 0.0])
    """

    degree: int = 2
    threshold: float = 0.01
    order: int | None = None
    derivative: Derivative = "weak"
    half: int | None = None
    time: Time = "continuous"
    harmonics: int = 1
    trigonometric: bool = False
    rule: Literal["eliminate", "threshold", "lasso", "subset"] = "eliminate"
    ensemble: int = 0
    ridge: float = 1e-6
    iterations: int = 20

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> SparseModel:
        """Return the sparse model; its equations and what was dropped stand in its notes."""
        what = "stlsq"
        self._check(what)
        records, spec = learnable(trajectories, samples=3 if self.time == "discrete" else 8, what=what)
        refuse_law(records, what, self.least_excitation)
        refuse_feedback_of_records(records, self.order or 1, self.least_excitation, what)
        if self.time == "discrete" or self.order is not None or _rates_measured(spec):
            return self._told(self._fitted(records, spec, self.order or 1, what, rng), spec)
        models = [self._fitted(records, spec, order, what, rng) for order in (1, 2)]
        errors = [_ahead_error(model, records) for model in models]
        best = 0 if errors[0] <= 1.05 * errors[1] else 1
        notes = {**models[best].notes, "order_error": {"1": _json(errors[0]), "2": _json(errors[1])}}
        return replace(models[best], notes=notes)

    def _told(self, model: SparseModel, spec: PlantSpec) -> SparseModel:
        """Return the model with a warning, if it is in discrete time and an input is in none of its equations."""
        terms = " ".join(term for chosen in model.support for term in chosen)
        idle = [c.name for c in spec.inputs if not re.search(rf"(?<!\w){re.escape(c.name)}(?!\w)", terms)]
        if self.time != "discrete" or not idle:
            return model
        text = (
            f"{' and '.join(idle)} is in no equation: what it does within one sample lies below the noise of the "
            'outputs; where it does move the plant, time = "continuous" or slower samples show it'
        )
        return replace(model, notes={**model.notes, "warning": text})

    def _check(self, what: str) -> None:
        """Refuse options that make no sense."""
        orders = ">= 1, <= 2" if self.time == "continuous" else ">= 1, <= 1"
        least = {"degree": ">= 1", "harmonics": ">= 1", "half": ">= 2", "ridge": ">= 0", "ensemble": ">= 0"}
        check_options(self, what, **least, order=orders, threshold=">= 0, < 1")

    def _library(self, spec: PlantSpec, order: int) -> Library:
        names = [c.name for c in spec.outputs]
        names += [f"{name}'" for name in names] if order == 2 else []
        names += [c.name for c in spec.inputs]
        angles = tuple(
            i for i, c in enumerate(spec.outputs) if (c.period is not None or self.trigonometric) and c.kind == "real"
        )
        return Library(tuple(names), self.degree, angles, self.harmonics)

    def _blocks(
        self, records: Sequence[Trajectory], library: Library, order: int
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield rows (p, n) and targets (ny, n), record by record."""

        def functions(arguments: FloatArray) -> FloatArray:
            return library.rows(list(arguments))

        for record in records:
            if self.time == "continuous":
                yield from derivative_rows(record, functions, order=order, method=self.derivative, half=self.half)
                continue
            y = unwrapped(record)
            for low in range(0, len(record) - 1, _BLOCK):
                high = min(low + _BLOCK, len(record) - 1)
                yield functions(np.hstack([y[low:high], record.u[low:high]]).T), y[low + 1 : high + 1].T

    def _estimate(
        self,
        records: Sequence[Trajectory],
        library: Library,
        coefficients: FloatArray,
        support: npt.NDArray[np.bool_],
        order: int,
        rank: int,
        condition: float,
    ) -> Estimate | None:
        """Return the record of the chosen terms, None beyond 200; intervals in discrete time, of white residuals.

        A derivative from samples errs by more than its residuals say: by the input's hold, and by noise in functions.
        """
        spec = records[0].spec
        chosen = [(row, column) for column in range(spec.ny) for row in np.flatnonzero(support[:, column])]
        if len(chosen) > LARGEST:
            return None
        targets, units = _targets(spec, order, self.time)
        rates = [quotient(c.unit, "s") for c in spec.outputs] if order == 2 else []
        arguments = [c.unit for c in spec.outputs] + rates + [c.unit for c in spec.inputs]
        by = library.units(arguments)
        values = np.array([coefficients[row, column] for row, column in chosen], dtype=float)
        covariance, half, why = self._scatter(records, library, values, support)
        return Estimate(
            tuple(f"{targets[column]} on {library.names[row]}" for row, column in chosen),
            tuple(quotient(units[column], by[row]) for row, column in chosen),
            values,
            covariance,
            None if half is None else np.column_stack([values - half, values + half]),
            LEVEL,
            why,
            RankDecision(rank, len(library), rule=f"singular values above {DEPENDENT:g} of the largest"),
            condition,
        )

    def _scatter(
        self, records: Sequence[Trajectory], library: Library, values: FloatArray, support: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray | None, FloatArray | None, str]:
        """Return covariance and half widths of the chosen terms' coefficients, None where there are none, and why."""
        from scipy.stats import t

        none = "no interval: the terms were chosen from the same data, and their regressors are noisy"
        if self.time != "discrete" or any(c.period is not None for c in records[0].spec.outputs) or not values.size:
            return None, None, none
        lists = [np.flatnonzero(column).tolist() for column in support.T]
        fits = [last_fit(records, library, one, output, 1, 0) for output, one in enumerate(lists) if one]
        again = np.concatenate([fit.theta for fit in fits])
        if not np.allclose(again, values, rtol=1e-6, atol=1e-9 * np.abs(values).max()):
            return None, None, "no interval: the rule shrinks what it keeps"
        covariance, place = np.zeros((values.size, values.size)), 0
        for fit in fits:
            rows = slice(place, place + fit.theta.size)
            covariance[rows, rows], place = fit.covariance, place + fit.theta.size
        if not all(fit.white for fit in fits):
            why = "no interval: the residuals are correlated in time, as noise on the outputs leaves them, or rounding"
            return covariance, None, why
        free = max(sum(len(record) - 1 for record in records) - support.sum(axis=0).max(), 1)
        why = (
            "least squares of the chosen terms, white residuals; that other terms might be the true ones is not counted"
        )
        return covariance, float(t.ppf(0.5 + LEVEL / 2, free)) * np.sqrt(np.clip(np.diag(covariance), 0.0, None)), why

    def _choose(self, equations: NormalEquations, threshold: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return coefficients and support by the rule."""
        if self.rule == "threshold":
            return stlsq(equations, threshold, ridge=self.ridge, iterations=self.iterations)
        if self.rule == "lasso":
            return lasso(equations)
        if self.rule == "subset":
            return best_subset(equations)
        return eliminate(equations, threshold)

    def _thresholds(self, records: Sequence[Trajectory]) -> FloatArray:
        """Return the threshold of each target (ny,).

        In discrete time the next output is mostly the present one, and what a model is asked for is the change: the
        threshold is relative to that, where it is the smaller.
        """
        least = np.full(records[0].spec.ny, self.threshold)
        if self.time == "continuous":
            return least
        y = [unwrapped(record) for record in records]
        change = sum(np.sum(np.diff(part, axis=0) ** 2, axis=0) for part in y)
        size = sum(np.sum(part[1:] ** 2, axis=0) for part in y)
        return np.asarray(least * np.sqrt(np.minimum(change / np.maximum(size, 1e-300), 1.0)))

    def _fitted(
        self, records: Sequence[Trajectory], spec: PlantSpec, order: int, what: str, rng: np.random.Generator
    ) -> SparseModel:
        """Return the model of one order."""
        library = self._library(spec, order)
        blocks = self._blocks(records, library, order)
        pieces = [] if not self.ensemble else NormalEquations.in_pieces(blocks, len(library), spec.ny)
        if pieces:
            equations = NormalEquations.sum(pieces, np.ones(len(pieces), dtype=int))
        else:
            equations = NormalEquations.of(blocks, len(library), spec.ny)
        if equations.rows < len(library):
            raise FitError(
                f"{what}: fewer equations than functions",
                expected=f"at least {len(library)} rows",
                got=str(equations.rows),
                remedy="record longer, or lower the degree",
            )
        if not (np.isfinite(equations.gram).all() and np.isfinite(equations.right).all()):
            raise FitError(f"{what}: functions overflow", expected="finite", got="inf", remedy="scale the signals")
        inclusion: dict[str, list[dict[str, float]]] = {}
        thresholds = self._thresholds(records)
        if pieces:
            found = ensemble(pieces, lambda some: self._choose(some, thresholds), self.ensemble, rng)
            coefficients, support = found.coefficients, found.support
            inclusion["inclusion"] = [
                {name: float(share) for name, share in zip(library.names, column, strict=True) if share > 0}
                for column in found.inclusion.T
            ]
        else:
            coefficients, support = self._choose(equations, thresholds)
        scaled = np.sqrt(np.clip(np.diag(equations.gram), 1e-300, None))
        values = np.linalg.eigvalsh(equations.gram / np.outer(scaled, scaled))
        lost = equations.square - 2 * np.einsum("ij,ij->j", coefficients, equations.right)
        lost += np.einsum("ij,ij->j", coefficients, equations.gram @ coefficients)
        notes = {
            "terms": [int(n) for n in support.sum(axis=0)],
            "candidates": len(library),
            "condition": float(np.sqrt(values[-1] / max(values[0], 1e-32))),
            "residual": (np.sqrt(np.clip(lost, 0, None)) / np.sqrt(np.clip(equations.square, 1e-300, None))).tolist(),
            "rows": equations.rows,
            **inclusion,
        }
        dependent = int(np.sum(values > DEPENDENT**2 * values[-1]))
        estimate = self._estimate(records, library, coefficients, support, order, dependent, notes["condition"])
        if estimate is not None:
            notes["estimate"] = estimate.to_dict()
        model = SparseModel(
            spec, library, coefficients.T, order, self.time, _range(records, order), _identity(spec, order), notes=notes
        )
        if order == 1:
            return model
        starts = [model.initial_state(record[: min(len(record), 200)]) for record in records]
        gains = alpha_beta_gains(spec.ny, spec.sample_time)
        return replace(model, filter_gain=best_gain(gains, model.step, model.output, starts, records))


def _targets(spec: PlantSpec, order: int, time: str) -> tuple[list[str], list[str]]:
    """Return names and units of what the equations give: the next outputs, their rates, or their accelerations."""
    if time == "discrete":
        return [f"{c.name}[k+1]" for c in spec.outputs], [c.unit for c in spec.outputs]
    marks = "'" * order
    return [f"{c.name}{marks}" for c in spec.outputs], [
        quotient(c.unit, "s" if order == 1 else "s^2") for c in spec.outputs
    ]


def _identity(spec: PlantSpec, order: int) -> FloatArray:
    """Return the filter gain that takes a measured state as it is."""
    return np.vstack([np.eye(spec.ny)] * 1 + [np.zeros((spec.ny, spec.ny))] * (order - 1))


def _range(records: Sequence[Trajectory], order: int) -> FloatArray:
    """Return the largest size of each state on the estimation records: far beyond it a run counts as diverged."""
    sizes = []
    for record in records:
        y, rates = measured_motion(record, order)
        sizes.append(np.abs(np.hstack([y, rates])).max(axis=0))
    size: FloatArray = np.max(sizes, axis=0)
    return divisor(size)


def _rates_measured(spec: PlantSpec) -> bool:
    """Return True if some output is the rate of another by its name."""
    names = {c.name for c in spec.outputs}
    return any(f"{name}{suffix}" in names for name in names for suffix in ("_rate", "_dot")) or any(
        f"d{name}" in names for name in names
    )


def _ahead_error(model: SparseModel, records: Sequence[Trajectory]) -> float:
    """Return the error of predictions ten steps ahead, relative to the outputs' spread."""
    from harness.scoring import predict
    from harness.signals import residual

    total, count, steps = 0.0, 0, 10
    spread = divisor(np.concatenate([record.y for record in records]).std(axis=0))
    for record in records[:4]:
        part = record[: min(len(record), 400)]
        skip = min(len(part) - 1, steps + 20)
        guess = predict(model, part, steps)[skip:]
        wrong = residual(part.spec.outputs, part.y[skip:], guess) / spread
        total += float(np.sum(wrong**2))
        count += wrong.size
    error = float(np.sqrt(total / max(count, 1)))
    return error if np.isfinite(error) else float("inf")


def _json(value: float) -> float | None:
    """Return a number that JSON can hold."""
    return value if np.isfinite(value) else None
