"""Linear models from measured states, by least squares and by criteria that bear noise on states, outliers, bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_law
from harness.models.determined import KEY, determined_bands
from harness.models.estimate import Estimate
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray, Trajectory
from identifiers.common.excitation import Columns, Dependence, nearly_dependent, refuse_feedback
from identifiers.common.judge.told import told
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import GROUPS, along_covariance, spread_of
from identifiers.common.one_step_estimate import jackknife_estimate, least_squares_estimate
from identifiers.common.records import learnable, missing_notes
from identifiers.common.regression import Solution
from identifiers.common.scaling import sizes
from identifiers.common.stability import clip_eigenvalues, convex_stable, nearest_stable, told_of_stable
from identifiers.linear.arx import (
    Arx,
    design,
    lag_model,
    one_step,
    operating_point,
    solution_notes,
    with_lag_neighbours,
)
from identifiers.linear.directions import lively_channels

__all__ = ["Arx", "LinearModel", "StateLeastSquares"]


@dataclass(frozen=True)
class StateLeastSquares:
    """Linear model from measured states: ``y[k+1] = A y[k] + B u[k] + a`` by least squares, rank-aware.

    Under pure state feedback the input is a linear function of the state and A and B cannot be told apart; sensor
    noise then makes the rank full while the answer is wrong. So the data are refused when their least excited direction
    is no larger than the equation's own residual. Sensor noise alone gives a ratio below 1 there; noise of ratio r
    biases the answer by about 1 / r^2 in that direction.

    Parameters
    ----------
    offset : bool
        Fit a constant too.
    method : {"ls", "iv", "tls", "l1", "linf"}
        Least squares; instrumental variables or total least squares, which white noise on the outputs does not bias
        where it biases least squares at any length of the record; least sum of absolute errors, which bears outliers;
        least sum over samples of the largest component of the error.
    stable : bool or "convex"
        Nearest stable model where the fit is unstable (:func:`identifiers.common.stability.nearest_stable`, a local
        search), or that of a convex program (:func:`identifiers.common.stability.convex_stable`). The notes say how far
        from the fit it is, in its own equation error.
    scaled : bool
        Compare the components of ``linf`` relative to the size of their output; by default as they are, so that this
        one criterion depends on the units of the outputs.
    least_excitation : float
        Every combination of states and inputs must move by so many times the noise that it carries, else the data are
        refused, whatever the method (:mod:`identifiers.common.excitation`). 0 refuses only what is exactly dependent.
    intervals : int, optional
        Groups of the jackknife that gives intervals (:mod:`identifiers.common.one_step_estimate`); by default 20 for
        ``iv``
        and ``tls``, none for ``l1`` and ``linf``, which are a linear program each time; ``ls`` needs none. 0: no
        intervals but those of ``ls``. The record is ``harness.models.estimate.estimate_of(model)``.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.array([[1.0], [-1.0], [2.0], [0.5], [0.0]])
    >>> y = np.zeros((5, 1))
    >>> for k in range(4):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> data = Trajectory(np.arange(5.0), u, y, spec)
    >>> model = StateLeastSquares().fit([data], rng=np.random.default_rng(0))
    >>> model.a_matrix.round(12).tolist(), model.b_matrix.round(12).tolist()
    ([[0.5]], [[2.0]])
    """

    offset: bool = False
    method: Literal["ls", "iv", "tls", "l1", "linf"] = "ls"
    stable: bool | Literal["convex"] = False
    scaled: bool = False
    least_excitation: float = 2.0
    intervals: int | None = None

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a model whose state is the output."""
        what = "least-squares"
        records, spec = learnable(trajectories, samples=2, what=what)
        refuse_law(records, what, self.least_excitation)
        if self.stable not in (False, True, "convex"):
            raise FitError(
                f"{what}: stable", expected="true, false, convex", got=repr(self.stable), remedy="correct it"
            )
        if self.method not in ("ls", "iv", "tls", "l1", "linf"):
            raise FitError(
                f"{what}: method", expected="ls, iv, tls, l1 or linf", got=repr(self.method), remedy="use one of these"
            )
        columns = Columns(spec)
        solution = one_step(records, 1, self.offset, 0.0, what)
        dependent = nearly_dependent(solution, columns, self.least_excitation, what, records=records)
        refuse_feedback(solution, columns, self.least_excitation, what)
        coefficients = self._coefficients(records, solution, what)
        notes = {
            **solution_notes(solution),
            **missing_notes(trajectories, records),
            "method": self.method if self.method != "ls" else solution.method,
        }
        if not self.offset:
            notes |= operating_point(records, solution, 1, what)
        if dependent and not (self.method == "iv" and dependent.strong):
            notes["warning"] = "; ".join([_biased(dependent, self.method), *filter(None, [notes.get("warning")])])
        estimate = self._estimate(records, solution, coefficients, what)
        if self.stable and spectral_radius(coefficients[: spec.ny]) >= 1.0:
            weights = 1.0 / sizes([record.y for record in records])
            factor, fitted = solution.factor * solution.scale, coefficients
            if self.stable == "convex":
                coefficients = convex_stable(coefficients, factor, spec.ny, weights)
            else:
                coefficients = nearest_stable(coefficients, factor, spec.ny, clip_eigenvalues, weights)
            notes = told_of_stable(notes, solution, coefficients, weights, fitted)
        elif estimate is not None:  # of the nearest stable model the spread of the fit says nothing
            notes["estimate"] = estimate.to_dict()
        model = lag_model(spec, coefficients, 1, self.offset, notes)
        notes[KEY] = determined_bands(model.matrices, records)
        if "stabilized" in notes:
            return model
        if self.method == "ls":
            return with_lag_neighbours(model, records, solution, 1, self.offset, estimate=estimate)
        if estimate is None or estimate.covariance is None:
            return model
        found, share = along_covariance(coefficients.T.ravel(), estimate.covariance)
        near = [lag_model(spec, one.reshape(spec.ny, -1).T, 1, self.offset).matrices for one in found]
        groups = float((self.intervals or GROUPS) - 1)
        return replace(model, spread=spread_of(near, factor=share, freedom=groups, method=estimate.method))

    def _estimate(
        self, records: list[Trajectory], solution: Solution, coefficients: FloatArray, what: str
    ) -> Estimate | None:
        """Return the record of the estimate, as far as the method has one."""
        if self.method == "ls":
            return least_squares_estimate(records, solution, 1, self.offset)
        groups = self.intervals if self.intervals is not None else GROUPS * (self.method in ("iv", "tls"))
        if groups < 2:
            return None

        def refit(some: list[Trajectory]) -> FloatArray:
            return self._coefficients(some, solution, what)

        return jackknife_estimate(records, solution, coefficients, refit, groups)

    def _coefficients(self, records: list[Trajectory], solution: Solution, what: str) -> FloatArray:
        """Return the coefficients (p, ny) under the criterion chosen."""
        from identifiers.common import criteria

        if self.method == "ls":
            return solution.coefficients
        if self.method == "iv":
            return criteria.instrumental_variables(records, self.offset, what)
        if self.method == "tls":
            return _total(records, self.offset, what)
        x = np.concatenate([design(record, 1, self.offset) for record in records])
        y = np.concatenate([record.y[1:] for record in records])
        if self.method == "l1":
            return criteria.absolute_deviations(x, y, what)
        size = sizes([y]) if self.scaled else np.ones(y.shape[1])
        return criteria.largest_components(x, y / size, what) * size


def _total(records: Sequence[Trajectory], offset: bool, what: str) -> FloatArray:
    """Return the total-least-squares coefficients (p, ny): 0 for outputs of noise alone.

    Every state has one direction of past and next outputs without motion; of an output of noise alone both are noise,
    and such directions would be taken for those of the states.
    """
    from identifiers.common import criteria

    lively = lively_channels(records)
    if lively.all():
        return criteria.total_least_squares(records, offset, what)
    spec = records[0].spec
    outputs = tuple(channel for channel, alive in zip(spec.outputs, lively, strict=True) if alive)
    spec = replace(spec, outputs=outputs)
    kept = [Trajectory(one.t, one.u, one.y[:, lively], spec) for one in records]
    some = criteria.total_least_squares(kept, offset, what)
    theta = np.zeros((len(lively) + len(some) - len(outputs), len(lively)))
    theta[np.ix_(np.concatenate([lively, np.ones(len(some) - len(outputs), dtype=bool)]), lively)] = some
    return theta


def _biased(dependent: Dependence, method: str) -> str:
    """Return the warning of a combination of states that moves by no more than the noise of the sensors."""
    said = f"{dependent.text} but for noise of the sensors, which biases {method} in that direction"
    if method == "iv":
        return f"{said}: earlier samples tell it from chance, but little more; excite the plant faster"
    return f"{said} by as much as it finds there; earlier samples tell it without: use method iv"
