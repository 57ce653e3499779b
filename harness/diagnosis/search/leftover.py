"""What a free force over position, speed, input or time could still predict of the innovations of a model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.coloured import coloured_likelihood
from harness.diagnosis.search.compare import drifts
from harness.diagnosis.search.fit import Column, Fit, Form, Linearised
from harness.diagnosis.search.scores import projected
from harness.signals import FloatArray

PRIORS = tuple(float(prior) for prior in np.geomspace(1e-2, 1e6, 17))
"""Variances of the coefficients that are tried, in units of what the innovations can tell."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A free force over one axis.

    Attributes
    ----------
    name : str
        Where it acts and over what, such as ``theta over theta_rate``.
    evidence : float
        Logarithm of its evidence on the estimation records against no such force, smoothness chosen by it.
    validation, error : float
        What the same force gains on the validation records, and the standard error over blocks.
    knots : tuple of str
    values : array (k,)
        The force at the knots.
    drifts : bool
        True for a force that changes through every record.
    imitated : bool
        True where an error of free runs that remembers explains as much as it does.
    """

    name: str
    evidence: float
    validation: float
    error: float
    knots: tuple[str, ...]
    values: FloatArray
    drifts: bool = False
    imitated: bool = False

    @property
    def total(self) -> float:
        """Both uses together."""
        return self.evidence + self.validation

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "axis": self.name,
            "evidence": self.evidence,
            "validation": self.validation,
            "standard_error": self.error,
            "knots": list(self.knots),
            "values": [float(value) for value in self.values],
        }


@dataclass(frozen=True, eq=False)
class Leftover:
    """All axes, best first."""

    axes: tuple[Axis, ...]
    policy: Policy = POLICY
    free_run: bool = False
    """True for errors of free runs: they last, so what the estimation records say alone is overstated."""

    @property
    def best(self) -> Axis | None:
        """The axis that predicts most of what is left, if one does so beyond chance.

        Both uses decide. What the estimation records are surer of by far, and the others do not refuse, is left too:
        where innovations are as large in a few places as these forces move them, the validation records tell nothing.
        """
        return next((axis for axis in self.axes if self._predicts(axis)), None)

    @property
    def missing(self) -> Axis | None:
        """The same, but for what an error of free runs that remembers explains as well.

        What is doubt enough to call an effect a stand-in is not enough to say that one is missing: to that is asked
        what is asked of an effect.
        """
        return next((axis for axis in self.axes if self._predicts(axis) and not axis.imitated), None)

    def _predicts(self, axis: Axis) -> bool:
        policy = self.policy
        if axis.drifts:  # by chance an unknown force may follow the motion in one record for a while
            size = min(axis.evidence, axis.validation)
            return size > 2 * policy.evidence and axis.validation > policy.tie_z * axis.error
        sure = not self.free_run and axis.evidence > policy.misfit_gain and axis.validation > 0.0
        return axis.total > 2 * policy.evidence and (sure or axis.validation > policy.alone_z * axis.error)


def left_over(form: Form, fit: Fit, policy: Policy = POLICY) -> Leftover:
    """Return what free forces over every axis would gain beside a fit.

    Parameters
    ----------
    form : Form
    fit : Fit
    policy : Policy
    """
    linear = form.linearised(fit)
    beside = _Beside.of(linear, *projected(form, fit))
    found = [_Explained.of(column, beside, linear, policy) for column in form.test_functions(fit)]
    found.sort(key=lambda one: -one.axis.total)
    axes = [one.axis for one in found]
    leftover = Leftover(tuple(axes), policy, fit.free_run)
    while fit.free_run and leftover.missing is not None:
        number = axes.index(leftover.missing)
        if not drifts(found[number].beside_memory(fit, policy.order), policy):
            break
        axes[number] = replace(axes[number], imitated=True)
        leftover = replace(leftover, axes=tuple(axes))
    return leftover


@dataclass(frozen=True, eq=False)
class _Beside:
    """What every force stands beside: found once, whatever the axis.

    ``basis`` of what is free already and the ``residual`` without it, on the estimation records; ``back`` (shared, n)
    tells how far the parameters move with a change there; ``starts`` is a basis of what initial states do to the
    validation records.
    """

    basis: FloatArray
    residual: FloatArray
    back: FloatArray
    starts: FloatArray

    @classmethod
    def of(cls, linear: Linearised, basis: FloatArray, residual: FloatArray) -> _Beside:
        """Return it of the derivatives of a fit."""
        back = np.linalg.pinv(linear.nuisance["estimation"], rcond=1e-12)[: linear.shared]
        return cls(
            basis, residual, np.asarray(back), np.linalg.qr(linear.nuisance["validation"][:, linear.shared :])[0]
        )


@dataclass(frozen=True, eq=False)
class _Explained:
    """A free force over one axis, the whitened innovations beside it and without it by use, and what it costs.

    ``count`` are its coefficients, each as far as the innovations and not its prior tell it.
    """

    axis: Axis
    before: dict[str, FloatArray]
    after: dict[str, FloatArray]
    count: float

    @classmethod
    def of(cls, column: Column, beside: _Beside, linear: Linearised, policy: Policy) -> _Explained:
        """Return what the functions of one axis gain."""
        basis, residual = beside.basis, beside.residual
        size = np.linalg.norm(column.estimation, axis=0)
        use = size > 0
        unit = column.estimation[:, use] / size[use]
        left = unit - basis @ (basis.T @ unit)
        # of what is orthonormal only the products with the residual are wanted: they stand beside R in a QR
        # factorisation
        whole = np.asarray(np.linalg.qr(np.column_stack([left, residual]), mode="r"))
        corner = whole[: left.shape[1]]
        u, s, vt = np.linalg.svd(corner[:, :-1], full_matrices=False)
        along = -(u.T @ corner[:, -1])
        evidence, prior = largest_evidence(along, s)
        told = prior * s**2 / (1.0 + prior * s**2)
        values = np.zeros(len(size))
        values[use] = vt.T @ (s * prior * along / (1.0 + prior * s**2)) / size[use]
        # the parameters move along with the force, as they did on the estimation records
        moved = beside.back @ (column.estimation @ values)
        outside, other = linear.nuisance["validation"][:, : linear.shared], linear.residual["validation"]
        change = column.validation @ values - outside @ moved
        along = outside @ linear.spread if len(linear.moved) else np.zeros((len(other), 0))
        other, change, along = (part - beside.starts @ (beside.starts.T @ part) for part in (other, change, along))
        before, after = (_expected(part, along, linear.moved) for part in (other, other + change))
        gain = before - after
        sums = np.array([part.sum() for part in np.array_split(gain, policy.blocks)])
        error = float(np.sqrt(len(sums)) * sums.std(ddof=1))
        names, drifts_along = column.names, column.kind == "drift"
        axis = Axis(names[0], evidence, float(gain.sum()), error, tuple(names[1:]), values, drifts_along)
        known = {"estimation": residual, "validation": other}
        without = {"estimation": residual + left @ (size[use] * values[use]), "validation": other + change}
        return cls(axis, known, without, float(told.sum()))

    def beside_memory(self, fit: Fit, order: int) -> tuple[float, float]:
        """Return what the force gains of both uses beside an error that remembers, its coefficients paid."""
        before, after = (coloured_likelihood(_by_record(fit, part), order) for part in (self.before, self.after))
        price = 0.5 * self.count * float(np.log(fit.samples))
        return after["estimation"] - before["estimation"] - price, after["validation"] - before["validation"]


def _by_record(fit: Fit, flat: dict[str, FloatArray]) -> dict[str, list[tuple[FloatArray, FloatArray]]]:
    """Return whitened innovations (n,) by use as those of every record (N, ny), NaN where nothing was read."""
    found = {}
    for use, records in fit.innovations.items():
        parts = np.split(flat[use], np.cumsum([e.size for e, _ in records])[:-1])
        pairs = zip(parts, records, strict=True)
        found[use] = [(np.where(np.isnan(e), np.nan, part.reshape(e.shape)), np.ones_like(e)) for part, (e, _) in pairs]
    return found


def _expected(left: FloatArray, along: FloatArray, moved: FloatArray) -> FloatArray:
    """Return minus the log-density of innovations (n,), parameters where their spread and these records want them.

    What their move costs is spread evenly; the determinant, the same for every force, is left out.
    """
    step = -np.linalg.solve(np.eye(len(moved)) + along.T @ along, along.T @ left + moved)
    return np.asarray(0.5 * (left + along @ step) ** 2 + 0.5 * float(np.sum((moved + step) ** 2)) / len(left))


def largest_evidence(along: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Return the largest logarithm of the evidence over the variances that are tried, and that variance.

    Parameters
    ----------
    along : array (k,)
        Whitened innovations along orthonormal directions.
    s : array (k,)
        Sizes of the functions along them.
    """
    return max((_evidence(along, s, prior), prior) for prior in PRIORS)


def _evidence(along: FloatArray, s: FloatArray, prior: float) -> float:
    """Return the logarithm of the evidence of functions whose coefficients are normal with this variance.

    Against none at all, the innovations being white with variance 1 (MacKay 1992, Neural Computation 4:415, eq. 4).
    """
    ratio = prior * s**2
    return 0.5 * float(np.sum(along**2 * ratio / (1.0 + ratio) - np.log1p(ratio)))
