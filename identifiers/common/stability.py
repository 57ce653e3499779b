"""Stable models: the nearest one to a fit that is not, in what it predicts on the data."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray
from identifiers.common.regression import Solution

# Eigenvalues of a model that is asked to be stable stay within this: at 1 itself a free run never forgets its start.
RADIUS = 0.999
# Error one step ahead over that of the fit, above which a stable model is said to contradict the records.
_WORSE = 1.5
# Rounds of the search: each halves the rest at most, and costs one small eigenvalue problem.
_ROUNDS = 40


def clip_eigenvalues(a: FloatArray, radius: float = RADIUS) -> FloatArray:
    """Return A with the eigenvalues outside a circle moved onto it, eigenvectors and angles kept.

    Of a matrix without a full set of eigenvectors all eigenvalues are shrunk together.

    Examples
    --------
    >>> clip_eigenvalues(np.diag([1.2, 0.5]), 0.9).tolist()
    [[0.9, 0.0], [0.0, 0.5]]
    """
    values, vectors = np.linalg.eig(a)
    moduli = np.abs(values)
    if not a.size or moduli.max() <= radius:
        return a
    if np.linalg.cond(vectors) < 1e8:
        moved = np.where(moduli > radius, values / np.where(moduli > 0, moduli, 1.0) * radius, values)
        found: FloatArray = np.real(vectors @ np.diag(moved) @ np.linalg.inv(vectors))
        if spectral_radius(found) <= radius * (1 + 1e-6):
            return found
    return np.asarray(a * (radius / moduli.max()), dtype=np.float64)


def stable_lags(coefficients: FloatArray, radius: float = RADIUS) -> FloatArray:
    """Return coefficients (lags * ny, ny) of ``y[k+1] = sum A_i y[k-i]`` whose roots lie within a circle.

    One output: each root outside is moved onto the circle. Several: all roots shrink together (A_i times g^(i+1)).

    Examples
    --------
    >>> stable_lags(np.array([[2.0], [-0.75]]), 0.9).ravel().round(6).tolist()
    [1.4, -0.45]
    """
    ny = coefficients.shape[1]
    lags = coefficients.shape[0] // ny
    if ny == 1:
        roots = np.roots(np.concatenate([[1.0], -coefficients[:, 0]]))
        moduli = np.abs(roots)
        roots = np.where(moduli > radius, roots / np.where(moduli > 0, moduli, 1.0) * radius, roots)
        return -np.real(np.poly(roots))[1:, None] if roots.size == lags else coefficients
    companion = np.zeros((lags * ny, lags * ny))
    companion[:ny] = coefficients.T
    companion[ny:, :-ny] = np.eye((lags - 1) * ny)
    largest = spectral_radius(companion)
    shrink = min(1.0, radius / largest) if largest > 0 else 1.0
    return coefficients * np.repeat(shrink ** np.arange(1, lags + 1), ny)[:, None]


def nearest_stable(
    theta: FloatArray,
    factor: FloatArray,
    own: int,
    project: Callable[[FloatArray], FloatArray],
    weights: FloatArray,
) -> FloatArray:
    """Return the coefficients nearest to a fit whose state part is stable, in the predictions on the data.

    Minimises ``||factor (theta - new)||`` with outputs weighted: projected Newton steps with halving, the coefficients
    of inputs and constants solved for at each trial. (Projection on eigenvalues as in Mamakoukas, Abraham & Murphey
    2023, IEEE Trans. Robotics 39:3; the problem is not convex, and a step is kept only if it is nearer.)

    - ``theta`` (p, ny): the unconstrained fit; its first ``own`` rows are the coefficients of states or lagged outputs
    - ``factor`` (p, p): R with ``R' R`` the Gram matrix of the regressors
    - ``project``: returns stable coefficients (own, ny) for any
    - ``weights`` (ny,): one over the size of each output
    """
    left, remaining = factor[:, :own], factor[:, own:]

    def completed(part: FloatArray) -> tuple[float, FloatArray]:
        """Return the distance and the whole coefficients for a given state part."""
        miss = left @ (theta[:own] - part)
        others = (
            np.linalg.lstsq(remaining, miss, rcond=1e-12)[0] if remaining.shape[1] else np.zeros((0, theta.shape[1]))
        )
        lost = float(np.sum(((miss - remaining @ others) * weights) ** 2))
        return lost, np.vstack([part, theta[own:] + others])

    best = project(theta[:own])
    cost, found = completed(best)
    for _ in range(_ROUNDS):
        step, nearer = 1.0, False
        while step > 1e-4:
            trial = project(best + step * (theta[:own] - best))
            lost, whole = completed(trial)
            if lost < cost * (1 - 1e-9):
                best, cost, found, nearer = trial, lost, whole, True
                break
            step *= 0.5
        if not nearer:
            break
    return found


def told_of_stable(
    notes: Mapping[str, Any],
    solution: Solution,
    found: FloatArray,
    weights: FloatArray,
    fitted: FloatArray | None = None,
) -> dict[str, Any]:
    """Return the notes of a stable model in place of a fit that is not, with a warning more where it errs by more.

    - ``notes``: of the fit
    - ``found`` (p, ny): coefficients of the stable model
    - ``weights`` (ny,): one over the size of each output
    - ``fitted``: the fit, where it is not that of least squares
    """
    start = solution.coefficients if fitted is None else fitted
    factor = solution.factor * solution.scale
    moved, after, before = (
        float(np.linalg.norm(factor @ away * weights))
        for away in (found - start, found - solution.coefficients, start - solution.coefficients)
    )
    least = float(np.sqrt(solution.rows) * np.linalg.norm(solution.residual_rms * weights))
    worse = np.hypot(after, least) / max(np.hypot(before, least), 1e-300)
    said = {**notes, "stabilized": True, "moved by": moved}
    if worse > _WORSE:
        contradicted = (
            f"the stable model errs {min(worse, 1e6):.3g} times as much one step ahead as the fit, which is not: the "
            "records contradict it; is the plant stable, and does nothing drift?"
        )
        said["warning"] = "; ".join(filter(None, [notes.get("warning"), contradicted]))
    return said


def convex_stable(theta: FloatArray, factor: FloatArray, own: int, weights: FloatArray) -> FloatArray:
    """Return stable coefficients by a semidefinite program: no start, no step, and not always the nearest ones.

    With ``E x+ = F x + K u`` the stable models are those with ``[[E + E' - P, F' / r], [F / r, P]] > 0`` for some P: a
    convex set (Tobenkin, Manchester & Megretski 2017, *IEEE Trans. Automatic Control* 62:3679, sec. III; Umenberger,
    Wagberg, Manchester & Schon 2018, *Automatica* 96:280). What is minimised is the error of this implicit equation
    with ``E + E' >= 2 I``, a bound on that of the explicit one. Of 142 unstable fits of two noisy states it was 0.49 to
    1.28 times as far from the fit as :func:`nearest_stable`, in the median 1.01 times. Raises FitError if the program
    is not solved.

    - ``theta, factor, own, weights``: as of :func:`nearest_stable`
    """
    cp: Any = importlib.import_module("cvxpy")
    scale = np.concatenate([weights, np.ones(len(theta) - own)])
    rows = factor * scale
    rows = rows / max(float(np.linalg.norm(rows, axis=0).max()), 1e-300)
    explicit = theta / scale[:, None] * weights
    e, p = cp.Variable((own, own)), cp.Variable((own, own), symmetric=True)
    implicit = cp.Variable(theta.shape)
    state = implicit[:own].T / RADIUS
    held = cp.bmat([[e + e.T - p, state.T], [state, p]])
    constraints = [held >> 1e-7 * np.eye(2 * own), e + e.T >> 2.0 * np.eye(own)]
    program = cp.Problem(cp.Minimize(cp.norm(rows @ (explicit @ e.T - implicit), "fro")), constraints)
    try:
        with warnings.catch_warnings():  # an inaccurate solution is judged below
            warnings.simplefilter("ignore", UserWarning)
            program.solve(solver="CLARABEL")
    except cp.SolverError:
        e.value = None
    found = theta
    if e.value is not None:
        found = np.linalg.solve(e.value, implicit.value.T).T * scale[:, None] / weights
    if spectral_radius(found[:own]) >= 1.0:
        raise FitError(
            "stable model", expected="a solved semidefinite program", got=str(program.status), remedy="use stable=true"
        )
    # The inputs' coefficients again, now for the explicit equation.
    miss = factor[:, :own] @ (theta[:own] - found[:own])
    others = np.linalg.lstsq(factor[:, own:], miss, rcond=1e-12)[0] if len(theta) > own else np.zeros((0, own))
    return np.vstack([found[:own], theta[own:] + others])
