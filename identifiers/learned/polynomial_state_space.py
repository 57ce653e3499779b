"""Polynomial nonlinear state-space models (PNLSS), fitted by the simulation error of whole records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.errors import FitError
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.learned.polynomial_pass import PolynomialTables
from identifiers.learned.recurrent_fit import FittedStart, Problem, cascade, descend_from, subspace_start
from identifiers.learned.recurrent_model import RecurrentEnsemble, own_member, vouched

_MOST_ORDER, _MOST_DEGREE = 4, 3
"""Tried where none is given: beyond, the coefficients of all monomials outnumber what records of some thousand tell."""

_WORTH = 0.95
"""A larger model must bring the held-out error below this share of the smaller one's: an rms over some hundred samples
is no surer than some percent, and the descent ends where the held-out error is least, which flatters more coefficients.
"""

_EXACT = 1e-6
"""A held-out error below this share of the outputs' size is what rounding and the end of the descent leave."""

_ROWS_EACH = 3  # Learned numbers for each coefficient, at least, of a size that nobody asked for.

_ALIKE = 1.2
"""Held-out error over the learned one up to which the model learns from all samples anew: where it is more, the
coefficients are too many, and the descent that was stopped by what is held out is worth more than a fifth of the data.
"""

_LINEAR_SHARE = 1e-3
"""Share of the ridge for linear terms: enough to hold directions in which only the coordinates of the state turn."""


@dataclass(frozen=True, eq=False)
class _Grown:
    """A layout and where the descent to its coefficients ended."""

    layout: PolynomialTables
    fitted: FittedStart


@dataclass(frozen=True)
class PolynomialStateSpace(Excited):
    """``x+ = A x + B u + E zeta(x, u)``, ``y = C x + D u + F eta(x, u)``, zeta and eta monomials, by simulation error.

    The polynomial nonlinear state-space model of Paduart, Lauwers, Swevers, Smolders, Schoukens & Pintelon 2010
    (Automatica 46, 647-656). It begins as a linear subspace model; its free run, and then that of models whose degree
    rises by one each time, is fitted to the whole records by Levenberg and Marquardt's method with exact derivatives,
    which compiled code carries along (their sec. 4.2), with the initial state of every record among the unknowns.
    Constants are terms too. Order and degree that are not given are chosen on the last fifth of every record, which is
    held out and simulated on from what came before; a model that errs there hardly more than where it learned is then
    fitted to all samples. A model whose free run over a record diverges is none: the one of lower degree stands.
    Polynomials grow without bound: beyond the amplitudes of the data a free run can diverge. Without a C compiler the
    runs are those of numpy, some forty times slower.

    Parameters
    ----------
    order : int, optional
        States; by default the one from 1 to 4 that errs least on what is held out.
    degree : int, optional
        Of the polynomials of the state; by default the one from 1 (linear) to 3 that errs least there.
    outside : int, optional
        Degree of the polynomials of the output; by default that of the state.
    direct : bool
        Let y[k] depend on u[k]; always so for a plant with feedthrough.
    crossed : bool
        Inputs enter the nonlinear terms.
    ridge : float
        Cost of the squares of the nonlinear coefficients, in those of scaled output errors.
    iterations : int
        At most, for each degree.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u, y = np.random.default_rng(0).normal(size=(600, 1)), np.zeros((600, 1))
    >>> for k in range(599):
    ...     y[k + 1] = 0.6 * y[k] + 0.3 * u[k] - 0.05 * y[k] ** 3
    >>> data = Trajectory(np.arange(600.0), u, y, spec)
    >>> model = PolynomialStateSpace(order=1, outside=1).fit([data], rng=np.random.default_rng(0))
    >>> model.notes["degree"], bool(model.notes["held-out rms"][0] < 1e-4)
    (3, True)
    """

    order: int | None = None
    degree: int | None = None
    outside: int | None = None
    direct: bool = False
    crossed: bool = True
    ridge: float = 1e-3
    iterations: int = 100

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> RecurrentEnsemble:
        """Return the model; order, degree and held-out error stand in its notes."""
        what = "polynomial-state-space"
        check_options(self, what, order=">= 1", degree=">= 1", outside=">= 1", iterations=">= 1", ridge=">= 0")
        records, spec = self.asked(trajectories, samples=5 * ((self.order or 1) + 4), what=what)
        problems = Problem.scaled(records)
        best: _Grown | None = None
        for order in range(1, _MOST_ORDER + 1) if self.order is None else (self.order,):
            now = self._of_order(spec, problems, order, rng)
            if best is not None and (now is None or not _better(now, best)):
                if order > 2:  # a second-order plant may need both of its states at once
                    break
                continue
            best = now
        if best is None:
            raise FitError(
                f"{what}: every free run diverges",
                expected="a plant whose free run stays near the data",
                got="no finite one",
                remedy="use neural-state-space, which is trained on short windows",
            )
        return self._finished(spec, best, problems, records)

    def _of_order(
        self, spec: PlantSpec, problems: Sequence[Problem], order: int, rng: np.random.Generator
    ) -> _Grown | None:
        """Return the model of some order whose degree is best on what is held out, or None where all diverge."""
        best: _Grown | None = None
        last: _Grown | None = None
        for layout in self._layouts(spec, order):
            if best is not None and self.degree is None and not _told(layout, problems):
                break
            theta, starts = _linear(layout, problems, rng) if last is None else _next(last, layout)
            weight = self.ridge * np.where(layout.nonlinear(), 1.0, _LINEAR_SHARE)
            free = np.ones(layout.count, dtype=bool)
            found = descend_from(layout, problems, theta, starts, weight, free, self.iterations)
            if not np.isfinite(found.held_out):
                break
            last = _Grown(layout, found)
            asked = self.degree is not None and layout.degree == self.degree
            if best is None or asked or _better(last, best):
                best = last
        return best

    def _layouts(self, spec: PlantSpec, order: int) -> Iterator[PolynomialTables]:
        """Yield the layouts of some order, by degree."""
        for degree in range(1, (self.degree or _MOST_DEGREE) + 1):
            outside = degree if self.outside is None else min(degree, self.outside)
            direct = self.direct or spec.feedthrough
            yield PolynomialTables(order, spec.nu, spec.ny, degree, outside, direct, self.crossed)

    def _finished(
        self, spec: PlantSpec, best: _Grown, problems: Sequence[Problem], records: Sequence[Trajectory]
    ) -> RecurrentEnsemble:
        """Return the chosen model, fitted to all samples; what it says of its errors was measured on held-out ones."""
        layout, fitted = best.layout, best.fitted
        held = vouched(spec, layout, [fitted], problems, records, "polynomial-state-space")
        held.notes.update(order=layout.nx, degree=layout.degree)
        if fitted.held_out > _ALIKE * fitted.error:
            return held
        weight = self.ridge * np.where(layout.nonlinear(), 1.0, _LINEAR_SHARE)
        whole = [replace(problem, held_out=0.0) for problem in problems]
        free = np.ones(layout.count, dtype=bool)
        again = descend_from(layout, whole, fitted.theta, fitted.starts, weight, free, self.iterations)
        if not np.isfinite(again.error):
            return held
        known = held.members[0]
        told = {name: getattr(known, name) for name in ("spread", "reach", "bands")}
        member = replace(own_member(spec, layout, again, whole, records), **told)
        return RecurrentEnsemble(spec, (member,), held.notes)


def _told(layout: PolynomialTables, problems: Sequence[Problem]) -> bool:
    """Return True if the records hold enough numbers for the coefficients."""
    rows = sum(problem.cut * problem.y.shape[1] for problem in problems)
    return bool(_ROWS_EACH * layout.count <= rows)


def _better(larger: _Grown, smaller: _Grown) -> bool:
    """Return True if a larger model errs so much less on what is held out that it is worth its coefficients."""
    return larger.fitted.held_out < _WORTH * smaller.fitted.held_out and smaller.fitted.held_out > _EXACT


def _linear(
    layout: PolynomialTables, problems: Sequence[Problem], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of a linear model to begin with, and initial states: a subspace model, or lags."""
    nx, nu = layout.nx, layout.nu
    found = subspace_start(problems, nx, rng, direct=layout.direct)
    start = np.zeros(nx)
    if found is None:
        a, b, c, start = cascade(problems, nx, rng)
        d = np.zeros((c.shape[0], nu))
    else:
        a, b, c, d = found
    theta = np.zeros(layout.count)
    tables = layout.tables(theta)
    tables["W"][1 : 1 + nx + nu] = np.vstack([(a - np.eye(nx)).T, b.T])
    tables["V"][1 : 1 + nx] = c.T
    if layout.direct:
        tables["V"][1 + nx : 1 + nx + nu] = d.T
    return theta, np.tile(start, (len(problems), 1))


def _next(last: _Grown, layout: PolynomialTables) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients and initial states of a lower degree as those of a higher one."""
    return last.layout.grown(last.fitted.theta, layout), last.fitted.starts
