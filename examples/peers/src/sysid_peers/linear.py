"""State-space models of PyDMD, SIPPY, nfoursid, python-control and jax-sysid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.linear.least_squares import LinearModel
from sysid_peers.records import NO_JUDGE, ONE_RECORD, called, longest, package, real_records

__all__ = ["Control", "JaxSysId", "NFourSid", "PyDmd", "Sippy"]


UNSTABLE = 1.05
"""Spectral radius beyond which a free run of 200 samples grows ten-thousandfold: no prediction without a filter."""


@dataclass(frozen=True)
class PyDmd:
    """DMD with control of PyDMD, on the longest record of a measured state.

    Parameters
    ----------
    svd_rank : int
        As PyDMD has it: -1 keeps all, 0 lets it choose.
    """

    svd_rank: int = -1
    expected_failures: ClassVar[Mapping[str, str]] = ONE_RECORD

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model; its operator is projected back from the reduced basis."""
        pydmd = package("pydmd", "pydmd")
        records, spec = real_records(trajectories, 4 * (trajectories[0].spec.ny + 1) if trajectories else 1, "pydmd")
        record = longest(records)
        with called("pydmd"):
            found = pydmd.DMDc(svd_rank=self.svd_rank)
            found.fit(record.y.T, record.u[:-1].T)
            basis = np.asarray(found.basis)
            a = (basis @ found.operator.as_numpy_array @ basis.conj().T).real
            b = np.asarray(found.B).real
        ny = spec.ny
        return _model(spec, a, b, np.eye(ny), np.zeros((ny, spec.nu)), np.eye(ny), burn_in=1)


@dataclass(frozen=True)
class Sippy:
    """A subspace method of SIPPY, on the longest record.

    Parameters
    ----------
    order : int
        Number of states.
    method : str
        ``N4SID``, ``MOESP``, ``CVA``, ``PARSIM-K``, ``PARSIM-S`` or ``PARSIM-P``.
    """

    order: int = 3
    method: str = "N4SID"
    expected_failures: ClassVar[Mapping[str, str]] = ONE_RECORD

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model with the Kalman gain that SIPPY finds."""
        sippy = package("sippy_unipi", "sippy-unipi")
        records, spec = real_records(trajectories, 60, "sippy")
        record = longest(records)
        with called("sippy"):
            found = sippy.system_identification(
                record.y.T, record.u.T, self.method, tsample=spec.sample_time, SS_fixed_order=self.order
            )
            a, b, c, d, k = (np.array(getattr(found, name), dtype=float) for name in "ABCDK")
        # SIPPY's K corrects the next state, A L in our terms
        gain = np.linalg.lstsq(a, k, rcond=1e-8)[0] if k.shape == (len(a), spec.ny) else np.zeros((len(a), spec.ny))
        return _model(spec, a, b, c, d, gain)


@dataclass(frozen=True)
class NFourSid:
    """N4SID of nfoursid, on the longest record, with the Kalman filter of its covariances.

    Parameters
    ----------
    order : int
        Number of states.
    block_rows : int
        Rows of its block Hankel matrices.
    """

    order: int = 3
    block_rows: int = 10
    expected_failures: ClassVar[Mapping[str, str]] = ONE_RECORD

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model; without a filter where the Riccati equation of its covariances has no solution."""
        nfoursid = package("nfoursid.nfoursid", "nfoursid")
        pandas = package("pandas", "pandas")
        records, spec = real_records(trajectories, 8 * self.block_rows, "nfoursid")
        record = longest(records)
        inputs, outputs = [f"u{i}" for i in range(spec.nu)], [f"y{i}" for i in range(spec.ny)]
        with called("nfoursid"):
            frame = pandas.DataFrame(np.hstack([record.u, record.y]), columns=inputs + outputs)
            method = nfoursid.NFourSID(
                frame, output_columns=outputs, input_columns=inputs, num_block_rows=self.block_rows
            )
            method.subspace_identification()
            found, covariance = method.system_identification(rank=self.order)
            a, b, c, d = (np.array(getattr(found, name), dtype=float) for name in "abcd")
        return _model(spec, a, b, c, d, _filter_gain(a, c, np.asarray(covariance, dtype=float)))


@dataclass(frozen=True)
class Control:
    """The eigensystem realisation of python-control from its estimate of Markov parameters, on the longest record.

    Parameters
    ----------
    order : int
        Number of states.
    markov : int
        Markov parameters that are estimated, with no more of the past in the fit.
    """

    order: int = 3
    markov: int = 60
    expected_failures: ClassVar[Mapping[str, str]] = ONE_RECORD

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model; it has no filter."""
        control = package("control", "control")
        records, spec = real_records(trajectories, 2 * self.markov, "python-control")
        record = longest(records)
        with called("python-control"):
            response = control.markov(record.y.T, record.u.T, m=self.markov)
            response = np.reshape(response, (spec.ny, spec.nu, -1))
            found, _ = control.eigensys_realization(response, r=self.order)
        return _model(spec, found.A, found.B, found.C, found.D, np.zeros((len(found.A), spec.ny)))


@dataclass(frozen=True)
class JaxSysId:
    """A linear model of jax-sysid, by its L-BFGS on simulation errors of signals scaled as its documentation does.

    Parameters
    ----------
    order : int
        Number of states.
    feedthrough : bool
        Whether outputs answer in the same sample.
    iterations : int
        Of L-BFGS.
    """

    order: int = 3
    feedthrough: bool = False
    iterations: int = 1000
    expected_failures: ClassVar[Mapping[str, str]] = NO_JUDGE

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return the model; it has no filter."""
        models = package("jax_sysid.models", "jax-sysid")
        double = package("jax.experimental", "jax").enable_x64
        records, spec = real_records(trajectories, 4 * self.order, "jax-sysid")
        u, y = (np.vstack([getattr(record, name) for record in records]) for name in ("u", "y"))
        scale_u, scale_y = (np.where(part.std(axis=0) > 0, part.std(axis=0), 1.0) for part in (u, y))
        with called("jax-sysid"), double():
            model = models.LinearModel(
                self.order, spec.ny, spec.nu, feedthrough=self.feedthrough, seed=int(rng.integers(2**31))
            )
            model.loss(rho_x0=1e-3, rho_th=1e-3)
            model.optimization(lbfgs_epochs=self.iterations, iprint=-1)
            model.fit(
                [(record.y - y.mean(axis=0)) / scale_y for record in records],
                [(record.u - u.mean(axis=0)) / scale_u for record in records],
            )
            a, b, c, d = (np.asarray(part, dtype=float) for part in model.ssdata())
        b, c, d = b / scale_u, scale_y[:, None] * c, scale_y[:, None] * d / scale_u
        about = -b @ u.mean(axis=0), y.mean(axis=0) - d @ u.mean(axis=0)
        return _model(spec, a, b, c, d, np.zeros((len(a), spec.ny)), about=about)


def _filter_gain(a: FloatArray, c: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the gain of the stationary Kalman filter; nfoursid orders the covariance as output, then state noise."""
    from scipy.linalg import solve_discrete_are

    ny = len(c)
    r, s, q = covariance[:ny, :ny], covariance[ny:, :ny], covariance[ny:, ny:]
    try:
        p = solve_discrete_are(a.T, c.T, q, r, s=s)
        return np.asarray(np.linalg.solve(c @ p @ c.T + r, c @ p).T)
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((len(a), ny))


def _radius(a: FloatArray) -> float:
    """Return the spectral radius."""
    return float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))


def _model(
    spec: PlantSpec, a: Any, b: Any, c: Any, d: Any, gain: Any, burn_in: int = 0, about: tuple[Any, Any] | None = None
) -> LinearModel:
    """Return a linear model, without a filter where the one found is unstable; refuses what then cannot predict.

    ``about`` is what is added to the next state and to the outputs where the signals were taken about their means.
    """
    if not all(np.isfinite(part).all() for part in (a, b, c, d, gain)):
        raise FitError("its model", expected="finite matrices", got="others", remedy="record more, or lower the order")
    size = len(a)
    if _radius(a @ (np.eye(size) - gain @ c)) >= 1.0:
        gain = np.zeros_like(gain)
        if _radius(a) > UNSTABLE:
            raise FitError("its model", expected="a stable model or filter", got="neither", remedy="lower the order")
    offset, level = (np.zeros(len(a)), np.zeros(spec.ny)) if about is None else about
    return LinearModel(spec, a, b, c, d, gain, offset, level, burn_in)
