"""Polynomial NARX of SysIdentPy: terms by forward regression orthogonal least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory
from harness.specs import spec_from_dict, spec_to_dict
from sysid_peers.records import ONE_RECORD, called, longest, package, real_records

__all__ = ["NarxModel", "SysIdentPy"]


@dataclass(frozen=True, eq=False)
class NarxModel:
    """``y[k] = sum theta_i prod(regressors)``, a regressor one of 1, past outputs and past inputs.

    The state holds the last ``lags`` outputs, newest first, and the last ``lags`` inputs before the present one.

    Parameters
    ----------
    spec : PlantSpec
        One input, one output.
    lags : int
    terms : array (T, D) of int
        Factors of each term: 0 is 1, ``j`` the output j samples ago, ``lags + j`` the input j samples ago.
    theta : array (T,)
        Coefficients.
    """

    spec: PlantSpec
    lags: int
    terms: FloatArray
    theta: FloatArray
    kind: ClassVar[str] = "peer-sysidentpy"
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def burn_in(self) -> int:
        """Samples until the regressors are full."""
        return self.lags

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state at the first sample, as if it had stood still there before."""
        return np.concatenate([np.full(self.lags, data.y[0, 0]), np.full(self.lags, data.u[0, 0])])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the newest output."""
        return np.asarray(np.broadcast_to(x[..., :1], (*np.broadcast_shapes(x.shape[:-1], u.shape[:-1]), 1)))

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the state one sample later."""
        n = self.lags
        x = np.broadcast_to(x, (*np.broadcast_shapes(x.shape[:-1], u.shape[:-1]), 2 * n))
        inputs = np.concatenate([np.broadcast_to(u, (*x.shape[:-1], 1)), x[..., n:-1]], axis=-1)
        known = np.concatenate([np.ones((*x.shape[:-1], 1)), x[..., :n], inputs], axis=-1)
        new = np.prod(known[..., self.terms.astype(int)], axis=-1) @ self.theta
        return np.concatenate([new[..., None], x[..., : n - 1], inputs], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state with the measured output in it."""
        x = np.array(np.broadcast_to(x, (*np.broadcast_shapes(x.shape[:-1], y.shape[:-1]), x.shape[-1])))
        x[..., :1] = y
        return x

    def to_dict(self) -> dict[str, Any]:
        """Return the model for ``model.json``."""
        parts = {"lags": self.lags, "terms": self.terms.tolist(), "theta": self.theta.tolist()}
        return {"kind": self.kind, "spec": spec_to_dict(self.spec), **parts, "notes": self.notes}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> NarxModel:
        """Return the model of :meth:`to_dict`."""
        terms, theta = (np.array(content[name], dtype=np.float64) for name in ("terms", "theta"))
        return cls(spec_from_dict(content["spec"]), int(content["lags"]), terms, theta, dict(content.get("notes", {})))


@dataclass(frozen=True)
class SysIdentPy:
    """Polynomial NARX of SysIdentPy, by FROLS and least squares, on the longest record of one input and one output.

    Parameters
    ----------
    lags : int
        Past outputs and inputs, as ``ylag`` and ``xlag``.
    degree : int
        Of the polynomial.
    terms : int
        Terms that it may choose among by its information criterion.
    criterion : str
        ``aic``, ``bic``, ``fpe`` or ``lilc``.
    """

    lags: int = 2
    degree: int = 2
    terms: int = 15
    criterion: str = "aic"
    expected_failures: ClassVar[Mapping[str, str]] = ONE_RECORD

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> NarxModel:
        """Return the model with the terms that SysIdentPy chose."""
        selection = package("sysidentpy.model_structure_selection", "sysidentpy")
        basis = package("sysidentpy.basis_function", "sysidentpy")
        estimation = package("sysidentpy.parameter_estimation", "sysidentpy")
        records, spec = real_records(trajectories, 10 * self.lags + 20, "sysidentpy")
        if (spec.nu, spec.ny) != (1, 1):
            raise FitError("sysidentpy: signals", expected="one input, one output", got=str(spec), remedy="choose them")
        record = longest(records)
        with called("sysidentpy"):
            found = selection.FROLS(
                xlag=self.lags,
                ylag=self.lags,
                order_selection=True,
                info_criteria=self.criterion,
                n_info_values=self.terms,
                estimator=estimation.LeastSquares(),
                basis_function=basis.Polynomial(degree=self.degree),
                err_tol=None,
            )
            found.fit(X=record.u, y=record.y)
            codes, theta = np.asarray(found.final_model), np.asarray(found.theta, dtype=np.float64).ravel()
        # its codes: 0 is 1, 1000 + j the output j samples ago, 2000 + j the input
        terms = np.where(codes >= 2000, codes - 2000 + self.lags, np.where(codes >= 1000, codes - 1000, 0))
        if not np.isfinite(theta).all():
            raise FitError("its model", expected="finite coefficients", got="others", remedy="record more")
        return NarxModel(replace(spec, states=()), self.lags, terms.astype(np.float64), theta)
