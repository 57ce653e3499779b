"""The result of an output-error fit: parameters, covariance, residuals, and words about how it went."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from harness.physics.compiled.windows import Windows
from harness.physics.fitting.levenberg import Minimised, eliminated
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics.compiled.system import System


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """What an output-error fit found.

    Attributes
    ----------
    parameters : dict
        Value of every parameter, fixed ones included.
    names : tuple of str
        Those that were fitted: the rows of ``covariance``.
    covariance : array (k, k)
        Of the fitted parameters, in their own units, from the Gauss-Newton Hessian with the initial states eliminated,
        scaled by the residual. It holds for a white residual; infinite on the diagonal where the data say nothing.
    x0 : list of array (nx,)
        Initial state of every window, windows in order of time, records in order.
    residuals, predicted : list of array (N_i, ny)
        By record: measured minus predicted, wrapped on periodic outputs; and predicted.
    cost : float
        Half the sum of squared residuals over sigma.
    chi2 : float
        2 cost / (data - parameters - initial states).
    sigma : array (ny,)
        Weights were 1 / sigma.
    rms : array (ny,)
        Of the residuals, by output.
    converged : bool
    message : str
        One line: how it went.
    horizon : float or None
        Window length [s]; None: whole records.
    n_data, n_parameters : int
        Scalar measurements; fitted parameters.
    log_likelihood : float
        Gaussian, each output with its own standard deviation at its maximum.
    n_states : int
        Fitted numbers that are initial states.
    unidentified : tuple of str
        Fitted parameters of which the data do not determine a direction.
    """

    parameters: dict[str, float]
    names: tuple[str, ...]
    covariance: FloatArray
    x0: list[FloatArray]
    residuals: list[FloatArray]
    predicted: list[FloatArray]
    cost: float
    chi2: float
    sigma: FloatArray
    rms: FloatArray
    converged: bool
    message: str
    horizon: float | None
    n_data: int
    n_parameters: int
    log_likelihood: float
    n_states: int
    unidentified: tuple[str, ...] = ()
    intersample: str = "zoh"
    _windows: Windows | None = field(default=None, repr=False)

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of every fitted parameter."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def jacobian(self) -> FloatArray:
        """Return d(predicted / sigma)/dp (n_data, k) of the fitted parameters, initial states projected out.

        Rows: records in order, samples in order, outputs in order. The sensitivity screen projects onto what it leaves.
        """
        assert self._windows is not None
        simulator = self._windows.simulator
        p = np.array([self.parameters[name] for name in simulator.parameter_names])
        columns = [simulator.parameter_names.index(name) for name in self.names]
        x0 = np.array(self.x0).reshape(len(self._windows), simulator.nx)
        return self._windows.jacobian(p, x0)[:, columns]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_windows": None}

    def __str__(self) -> str:
        deviations = self.deviations
        values = ", ".join(f"{name} = {self.parameters[name]:.5g} +- {deviations[name]:.2g}" for name in self.names)
        return f"{values}; rms {', '.join(f'{value:.4g}' for value in self.rms)}; {self.message}"


@dataclass(eq=False)
class Result:
    """The end of one start."""

    solution: Minimised
    windows: Windows
    objective: float
    horizon: float | None
    asked: float | None
    n_data: int


def objective(solution: Minimised, windows: Windows) -> float:
    """Return minus the log-likelihood, each output with its own standard deviation."""
    n = windows.n_data / windows.simulator.spec.ny
    variance = np.maximum(solution.evaluation.squares / n, 1e-300)
    return float(0.5 * n * np.sum(np.log(2 * np.pi * variance) + 1.0))


def finish(
    system: System, best: Result, free: npt.NDArray[np.bool_], alike: int | None, count: int, intersample: str
) -> OutputErrorFit:
    """Return the public result: covariance, residuals, one line of words."""
    solution, windows = best.solution, best.windows
    final = windows.evaluate(solution.p, solution.x0, keep=True)
    names = tuple(parameter.name for parameter, is_free in zip(system.parameters, free, strict=True) if is_free)
    n_states = solution.x0.size if solution.states_free else 0
    k = len(names)
    freedom = max(windows.n_data - k - n_states, 1)
    chi2 = 2 * final.cost / freedom
    covariance, weak = _covariance(system, solution, final.gram, free, chi2)
    unidentified = tuple(name for name, is_weak in zip(names, weak, strict=True) if is_weak)
    n = windows.n_data / windows.simulator.spec.ny
    complete = best.horizon == best.asked
    words = [solution.message]
    if not complete:
        words.append(f"diverged beyond a horizon of {best.horizon:g} s" if best.horizon else "stopped early")
    if unidentified:
        words.append(f"the data do not determine {', '.join(unidentified)}")
    at_bound = [name for name in names if _on_bound(system, name, solution.p)]
    if at_bound:
        words.append(f"on a bound: {', '.join(at_bound)}")
    if alike is not None:
        words.append(f"{alike} of {count} starts reached this minimum")
    residuals = windows.together(final.residuals)
    return OutputErrorFit(
        parameters=dict(zip(system.parameter_names, solution.p.tolist(), strict=True)),
        names=names,
        covariance=covariance,
        x0=list(solution.x0),
        residuals=residuals,
        predicted=[record.y - r for record, r in zip(windows.trajectories, residuals, strict=True)],
        cost=final.cost,
        chi2=float(chi2),
        sigma=windows.sigma,
        rms=np.sqrt(final.squares / n),
        converged=bool(solution.converged and complete and (alike is None or alike >= 2)),
        message="; ".join(words),
        horizon=best.horizon,
        n_data=windows.n_data,
        n_parameters=k,
        log_likelihood=-objective(Minimised(solution.p, solution.x0, final, True, 0, ""), windows),
        n_states=n_states,
        unidentified=unidentified,
        intersample=intersample,
        _windows=windows,
    )


def _covariance(
    system: System, solution: Minimised, gram: FloatArray, free: npt.NDArray[np.bool_], chi2: float
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of the free parameters, and which of them lie in a direction without information."""
    count = system.np
    schur, _, _ = eliminated(gram, np.zeros(gram.shape[:2]), count, 0.0, solution.states_free)
    schur = schur[np.ix_(free, free)]
    k = schur.shape[0]
    if k == 0:
        return np.zeros((0, 0)), np.zeros(0, dtype=bool)
    size = np.sqrt(np.maximum(np.diag(schur), 1e-300))
    sizes, vectors = np.linalg.eigh(schur / np.outer(size, size))
    lost = (sizes < 1e-11 * max(sizes[-1], 1e-300)) | ~np.isfinite(sizes)
    kept = vectors[:, ~lost]
    covariance = (kept / sizes[~lost]) @ kept.T / np.outer(size, size) * chi2
    weak = (vectors[:, lost] ** 2).sum(axis=1) > 1e-4
    weak |= np.sqrt(np.diag(schur)) == 0
    covariance[np.diag_indices(k)] = np.where(weak, np.inf, np.diag(covariance))
    return covariance, weak


def _on_bound(system: System, name: str, p: FloatArray) -> bool:
    parameter = system.parameter(name)
    value = p[system.parameter_names.index(name)]
    width = 1e-6 * max(abs(value), 1e-12)
    if parameter.positive and parameter.minimum == 0.0:
        return bool(value < 1e-9 * max(abs(parameter.value), 1e-9)) or bool(value >= parameter.maximum - width)
    return bool(value <= parameter.minimum + width or value >= parameter.maximum - width)
