"""The record of an output-error estimate: covariance also under coloured residuals, intervals or why there are none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.models.estimate import Estimate, RankDecision
from harness.signals import FloatArray

if TYPE_CHECKING:
    from harness.physics import OutputErrorFit, System

LEVEL = 0.95
LEAST_BLOCKS = 20
"""A covariance from the scatter of blocks needs so many of them: a variance of 20 numbers is 30 % uncertain."""
NOTHING = 1e-11  # Relative eigenvalue of the scaled information below which a direction carries none (rounding).


def output_error_estimate(
    system: System, fit: OutputErrorFit, *, nothing: float = NOTHING, rule: str = "rounding of the sensitivities"
) -> Estimate:
    """Return the record of a fit.

    Where residuals are correlated in time the covariance is that of the sums of scores over blocks longer than the
    correlation (Newey & West 1987, Econometrica 55:703). No interval is claimed where the fit did not converge, where a
    parameter ended on a bound, or where the residual stays correlated over more than a twentieth of the data.

    - ``fit``: with its windows (as :func:`harness.physics.fit_output_error` returns it)
    - ``nothing``: relative eigenvalue of the scaled information below which a direction carries none
    - ``rule``: what makes that number, in words
    """
    names = fit.names
    point = np.array([fit.parameters[name] for name in names])
    units = tuple(system.parameter(name).unit for name in names)
    jacobian = fit.jacobian()
    lengths = np.linalg.norm(jacobian, axis=0)
    size = np.where(lengths > 0, lengths, 1.0)
    sizes, vectors = (
        np.linalg.eigh((jacobian / size).T @ (jacobian / size)) if len(names) else (np.zeros(0), np.zeros((0, 0)))
    )
    weak = sizes < nothing * max(sizes.max(initial=0.0), 1e-300)
    null = vectors[:, weak]
    loose = (np.sum(null**2, axis=1) > 1e-4) | (lengths == 0) | np.isin(names, fit.unidentified)
    decision = RankDecision.of(names, null, lengths, loose, rule)
    condition = float(np.sqrt(sizes[-1] / sizes[0])) if sizes.size and sizes[0] > 0 else float("inf")
    on_bound = tuple(name for name in names if at_bound(system, name, fit.parameters[name]))
    covariance, how = _covariance(fit, jacobian / size, sizes, vectors, weak)
    if covariance is not None:
        covariance = covariance / np.outer(size, size)
        covariance[np.diag_indices(len(names))] = np.where(loose, np.inf, np.diag(covariance))
    if not fit.converged:
        how = "no intervals: the fit did not converge"
    elif on_bound:
        how = f"no intervals: {', '.join(on_bound)} on a bound"
    intervals = None
    if covariance is not None and not how.startswith("no "):
        half = 1.96 * np.sqrt(np.where(loose, np.nan, np.diag(covariance)))
        intervals = np.column_stack([point - half, point + half])
    return Estimate(
        names,
        units,
        point,
        covariance,
        intervals,
        LEVEL,
        how,
        decision,
        condition,
        fit.converged,
        fit.message,
        on_bound,
    )


def _covariance(
    fit: OutputErrorFit, jacobian: FloatArray, sizes: FloatArray, vectors: FloatArray, weak: FloatArray
) -> tuple[FloatArray | None, str]:
    """Return the covariance of the scaled parameters, and how it was computed."""
    keep = ~weak.astype(bool)
    inverse = (vectors[:, keep] / sizes[keep]) @ vectors[:, keep].T
    residuals = [miss / fit.sigma for miss in fit.residuals]
    samples = sum(len(miss) for miss in residuals)
    length = _correlation_length(residuals)
    if length <= 1:
        return inverse * fit.chi2, "normal, residual white"
    if samples < LEAST_BLOCKS * length:
        return inverse * fit.chi2, f"no intervals: the residual stays correlated over {length} of {samples} samples"
    scores = jacobian * np.concatenate([miss.ravel() for miss in residuals])[:, None]
    ny, at, middle = residuals[0].shape[1], 0, np.zeros((jacobian.shape[1], jacobian.shape[1]))
    for miss in residuals:
        part = scores[at : at + miss.size].reshape(len(miss), ny, -1).sum(axis=1)
        at += miss.size
        middle += part.T @ part
        for lag in range(1, min(length, len(part) - 1) + 1):
            cross = part[lag:].T @ part[:-lag]
            middle += (1 - lag / (length + 1)) * (cross + cross.T)
    # numbers fitted (parameters, initial states) took their freedom out of the residual
    freedom = fit.n_data / max(fit.n_data - fit.n_parameters - fit.n_states, 1)
    return inverse @ middle @ inverse * freedom, f"normal, residual correlated over {length} samples"


def _correlation_length(residuals: list[FloatArray]) -> int:
    """Return the lag [samples] from which on the autocorrelation of every output stays within its white noise."""
    longest = 1
    for column in range(residuals[0].shape[1]):
        for miss in residuals:
            r = miss[:, column] - miss[:, column].mean()
            n = len(r)
            power = float(r @ r)
            if n < 8 or power == 0.0:
                continue
            spectrum = np.abs(np.fft.rfft(r, 2 * n)) ** 2
            correlation = np.fft.irfft(spectrum)[: n // 2] / power
            # 3: one in 400 lags of white noise lies outside
            outside = np.nonzero(np.abs(correlation[1:]) > 3 / np.sqrt(n))[0]
            # single lags outside are chance: the first stretch counts
            run = int(np.argmin(np.abs(correlation[1:]) > 3 / np.sqrt(n))) if outside.size else 0
            longest = max(longest, 2 * run + 1 if run else 1)
    return longest


def at_bound(system: System, name: str, value: float) -> bool:
    """Return True if a value lies on a bound of its parameter (for a positive one: at nothing)."""
    parameter = system.parameter(name)
    width = 1e-6 * max(abs(value), 1e-12)
    low = (
        value < 1e-9 * max(abs(parameter.value), 1e-9)
        if parameter.minimum == 0.0
        else value <= parameter.minimum + width
    )
    return bool(low or value >= parameter.maximum - width)
