"""What a free force over position, speed, input or time could still predict of the innovations of a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.policy import POLICY, Policy
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
    """

    name: str
    evidence: float
    validation: float
    error: float
    knots: tuple[str, ...]
    values: FloatArray
    drifts: bool = False

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
    basis, residual = projected(form, fit)
    axes = [_axis(column, basis, residual, linear, policy) for column in form.test_functions(fit)]
    return Leftover(tuple(sorted(axes, key=lambda axis: -axis.total)), policy, fit.free_run)


def _axis(column: Column, basis: FloatArray, residual: FloatArray, linear: Linearised, policy: Policy) -> Axis:
    """Return what the functions of one axis gain."""
    size = np.linalg.norm(column.estimation, axis=0)
    use = size > 0
    unit = column.estimation[:, use] / size[use]
    left = unit - basis @ (basis.T @ unit)
    # of what is orthonormal only the products with the residual are wanted: they stand beside R in a QR factorisation
    whole = np.asarray(np.linalg.qr(np.column_stack([left, residual]), mode="r"))
    corner = whole[: left.shape[1]]
    u, s, vt = np.linalg.svd(corner[:, :-1], full_matrices=False)
    along = -(u.T @ corner[:, -1])
    evidence, prior = largest_evidence(along, s)
    values = np.zeros(len(size))
    values[use] = vt.T @ (s * prior * along / (1.0 + prior * s**2)) / size[use]
    # the parameters move along with the force, as they did on the estimation records
    own, outside = linear.nuisance["estimation"], linear.nuisance["validation"]
    moved = np.linalg.lstsq(own, column.estimation @ values, rcond=1e-12)[0][: linear.shared]
    other = linear.residual["validation"]
    change = column.validation @ values - outside[:, : linear.shared] @ moved
    along = outside[:, : linear.shared] @ linear.spread if len(linear.moved) else np.zeros((len(other), 0))
    starts = outside[:, linear.shared :]
    if starts.shape[1]:
        q, _ = np.linalg.qr(starts)
        other, change, along = (part - q @ (q.T @ part) for part in (other, change, along))
    before, after = (_expected(part, along, linear.moved) for part in (other, other + change))
    gain = before - after
    sums = np.array([part.sum() for part in np.array_split(gain, policy.blocks)])
    error = float(np.sqrt(len(sums)) * sums.std(ddof=1))
    drifts = column.kind == "drift"
    return Axis(column.names[0], evidence, float(gain.sum()), error, tuple(column.names[1:]), values, drifts)


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
