"""How much of what is left can still be predicted, on held-out data, from position, speed, input and time.

The residual of a simulation is not itself a function of the state; a missing force is. So spline functions of q, v,
u and t are sent through the model linearised along its own trajectory, and the residual is regressed on what comes
out. Only what predicts the *validation* residual beyond phase-randomised surrogates counts. A residual that is
coloured but cannot be predicted is a disturbance: reported, not blamed on a missing effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from harness.diagnosis.accept import compare_blocks
from harness.diagnosis.surrogates import surrogates
from harness.signals import FloatArray

__all__ = [
    "Adequacy",
    "Grade",
    "Predictable",
    "grade",
    "hat_basis",
    "joint_basis",
    "no_small_disturbance",
    "predictable_part",
    "rough",
]

Grade = Literal["explained", "mostly_explained", "proxy_or_incomplete"]
SHRINKAGE = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
FOLDS = 5
LEVEL = 0.01
FAR = 10.0
LARGE = 0.1
"""A rest of this share of the motion, and of 10 noise floors, is no disturbance of a few percent of the force."""


@dataclass(frozen=True)
class Predictable:
    """What one family of functions predicts of the validation residual.

    Attributes
    ----------
    axes : str
        The axes of the family, e.g. ``"theta'"`` or ``"theta, theta'"``.
    share : float
        Held-out R2, over all outputs; negative if the prediction makes it worse.
    p : float
        Probability of as much, in the best family, on surrogates.
    rms : array (ny,)
        Predicted part of each output, in weights; 0 where nothing is predicted.
    coefficients : array (k,)
        Of the family's functions.
    predicted : array (N, ny)
        Of the validation residual, records one below the other.
    """

    axes: str
    share: float
    p: float
    rms: FloatArray
    coefficients: FloatArray = field(repr=False)
    predicted: FloatArray = field(repr=False)


@dataclass(frozen=True)
class Adequacy:
    """The grade, the best family, and all of them."""

    grade: Grade
    rest: float
    predictable: bool
    best: Predictable | None
    families: tuple[Predictable, ...]
    null: FloatArray = field(repr=False)
    too_large: bool = False
    """True if what is left is too large for a small disturbance, predictable or not."""

    @property
    def unexplained(self) -> bool:
        """True if what is left cannot be passed off as a disturbance."""
        return self.predictable or self.too_large

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``report.json``."""
        return {
            "rest": float(self.rest) if np.isfinite(self.rest) else None,
            "predictable": self.predictable,
            "too_large_for_a_disturbance": self.too_large,
            "families": [{"axes": one.axes, "share": float(one.share), "p": float(one.p)} for one in self.families],
        }


def hat_basis(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Return piecewise linear hat functions (N, K) of ``x`` (N,) at increasing ``knots`` (K,); flat outside.

    Examples
    --------
    >>> hat_basis(np.array([0.0, 0.25, 2.0]), np.array([0.0, 1.0])).tolist()
    [[1.0, 0.0], [0.75, 0.25], [0.0, 1.0]]
    """
    clipped = np.clip(np.asarray(x, dtype=float), knots[0], knots[-1])
    if knots.size == 1:
        return np.ones((clipped.size, 1))
    cell = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, knots.size - 2)
    part = (clipped - knots[cell]) / (knots[cell + 1] - knots[cell])
    basis = np.zeros((clipped.size, knots.size))
    rows = np.arange(clipped.size)
    basis[rows, cell] = 1 - part
    basis[rows, cell + 1] = part
    return basis


def joint_basis(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products (N, Ka * Kb) of two bases."""
    return (a[:, :, None] * b[:, None, :]).reshape(a.shape[0], -1)


@dataclass(frozen=True)
class _Side:
    """Estimation or validation: residuals (rows, 1 + count) and the rows of each fold."""

    residual: FloatArray
    folds: list[slice]


def predictable_part(
    estimation: Sequence[FloatArray],
    validation: Sequence[FloatArray],
    families: Mapping[str, tuple[Sequence[FloatArray], Sequence[FloatArray]]],
    *,
    rng: np.random.Generator,
    count: int = 100,
    roughness: Mapping[str, FloatArray] | None = None,
    windows: tuple[Sequence[tuple[int, int, int]], Sequence[tuple[int, int, int]]] = ((), ()),
) -> tuple[tuple[Predictable, ...], FloatArray]:
    """Fit every family on the estimation residual and see what it predicts of the validation residual.

    Parameters
    ----------
    estimation, validation : sequence of array (N_i, ny)
        Weighted residuals.
    families : mapping
        For each family the responses of its functions on the estimation and on the validation runs, each a sequence
        of arrays (N_i, ny, k); what free parameters and initial states can mimic is already taken out.
    rng : Generator
        Source of the surrogates.
    count : int
        Surrogates of both residuals; the null is the maximum over the families.
    roughness : mapping of array (k, k), optional
        For each family the matrix of its penalty (P-splines: squared second differences of the coefficients, Eilers &
        Marx, Stat. Sci. 11:89, 1996); by default the size of the coefficients.
    windows : (sequence, sequence) of (run, first, last), optional
        Of free runs over windows, on estimation and on validation; see
        :func:`harness.diagnosis.surrogates.surrogates`.

    Returns
    -------
    families : tuple of Predictable
        Best first.
    null : array (count,)
        Largest held-out share on the surrogates.
    """
    both = zip((estimation, validation), windows, strict=True)
    inside, outside = (_side(one, cut, count, rng) for one, cut in both)
    ny = estimation[0].shape[1]
    found: list[tuple[str, FloatArray, FloatArray, FloatArray]] = []
    for axes, (fit, check) in families.items():
        phi = np.concatenate([one.reshape(-1, one.shape[2]) for one in fit])
        psi = np.concatenate([one.reshape(-1, one.shape[2]) for one in check])
        scale = np.linalg.norm(phi, axis=0)
        alive = scale > 1e-9 * scale.max(initial=0.0)
        if not alive.any():
            continue
        phi, psi = phi[:, alive] / scale[alive], psi[:, alive] / scale[alive]
        penalty = None if roughness is None else roughness.get(axes)
        if penalty is not None:
            penalty = penalty[np.ix_(alive, alive)] / np.outer(scale[alive], scale[alive])
        c = _ridge(phi, inside, penalty)
        moments = psi.T @ outside.residual
        gram = psi.T @ psi
        power = np.maximum(np.sum(outside.residual**2, axis=0), 1e-300)
        share = (2 * np.sum(c * moments, axis=0) - np.sum(c * (gram @ c), axis=0)) / power
        full = np.zeros(scale.size)
        full[alive] = c[:, 0] / scale[alive]
        predicted = (psi @ c[:, 0]).reshape(-1, ny)
        found.append((axes, share, full, predicted))
    if not found:
        return (), np.zeros(count)
    null = np.max(np.stack([share[1:] for _, share, _, _ in found]), axis=0)
    actual = np.concatenate(list(validation))
    result = []
    for axes, share, c, predicted in found:
        p = float((1 + np.sum(null >= share[0])) / (1 + count))
        explained = np.mean(actual**2, axis=0) - np.mean((actual - predicted) ** 2, axis=0)
        result.append(Predictable(axes, float(share[0]), p, np.sqrt(np.maximum(explained, 0.0)), c, predicted))
    return tuple(sorted(result, key=lambda one: -one.share)), null


def grade(
    families: Sequence[Predictable],
    null: FloatArray,
    residual: Sequence[FloatArray],
    floors: Sequence[float | None],
    *,
    rng: np.random.Generator,
) -> Adequacy:
    """Grade the rest: what the residual would be if all of it that cannot be predicted were only noise.

    The rest is sqrt(s^2 + P^2) / s with P the predictable part of the validation residual: up to 1.15 "explained",
    up to 2 "mostly explained", beyond "proxy or incomplete". Where the noise floor s is unknown, the unpredictable
    part of the residual stands in for it.

    Parameters
    ----------
    families, null
        From :func:`predictable_part`.
    residual : sequence of array (N_i, ny)
        Weighted validation residual.
    floors : sequence of float or None
        Noise floor of each output, in the same weights.
    rng : Generator
        For the block bootstrap: a gain that one burst makes is not a prediction.
    """
    best = families[0] if families else None
    if best is None or best.share <= 0 or best.p > LEVEL:
        return Adequacy("explained", 1.0, False, best, tuple(families), null)
    cuts = np.cumsum([len(one) for one in residual])[:-1]
    rest = [r - part for r, part in zip(residual, np.split(best.predicted, cuts), strict=True)]
    if compare_blocks(residual, rest, rng=rng).p > LEVEL:
        return Adequacy("explained", 1.0, False, best, tuple(families), null)
    power = np.mean(np.concatenate(list(residual)) ** 2, axis=0)
    size = 1.0
    for j, floor in enumerate(floors):
        unpredicted = float(np.sqrt(max(power[j] - best.rms[j] ** 2, 1e-300)))
        s = floor if floor is not None and floor > 0 else unpredicted
        size = max(size, float(np.sqrt(1 + (best.rms[j] / s) ** 2)))
    word: Grade = "explained" if size <= 1.15 else "mostly_explained" if size <= 2.0 else "proxy_or_incomplete"
    return Adequacy(word, size, size > 1.15, best, tuple(families), null)


def nothing_left() -> Adequacy:
    """Return the grade of a residual that is no more than noise.

    Below 1.15 noise floors the predictable part is below sqrt(1.15^2 - 1) of them, which is "explained" whatever
    predicts it.
    """
    return Adequacy("explained", 1.0, False, None, (), np.zeros(0))


def no_small_disturbance(
    residual: Sequence[FloatArray], measured: Sequence[FloatArray], floors: Sequence[float | None]
) -> bool:
    """Return True if a residual is too large to pass for an unpredictable disturbance of a right model.

    A disturbance of a few percent of the force moves the outputs by about as many percent. A model that misses a tenth
    of the motion, far above a known noise floor, is wrong, even where nothing predicts its error: a strong nonlinearity
    makes the error of a free run a function of its whole past.

    Parameters
    ----------
    residual : sequence of array (N_i, ny)
        Weighted residuals.
    measured : sequence of array (N_i, ny)
        The outputs in the same weights.
    floors : sequence of float or None
        Noise floor of each output in the same weights; where it is unknown nothing is concluded.

    Examples
    --------
    >>> y = np.sin(np.arange(500) * 0.1)[:, None]
    >>> no_small_disturbance([0.2 * y], [y], [0.001]), no_small_disturbance([0.02 * y], [y], [0.001])
    (True, False)
    """
    size = np.sqrt(np.mean(np.concatenate(list(residual)) ** 2, axis=0))
    motion = np.std(np.concatenate(list(measured)), axis=0)
    return any(
        floor is not None and floor > 0 and r > FAR * floor and r > LARGE * y
        for r, y, floor in zip(size, motion, floors, strict=True)
    )


def _side(
    series: Sequence[FloatArray], windows: Sequence[tuple[int, int, int]], count: int, rng: np.random.Generator
) -> _Side:
    """Return the residual and its surrogates as columns, and the rows of consecutive folds."""
    truth = np.concatenate([one.reshape(-1) for one in series])
    drawn = surrogates(series, windows, count, rng=rng).reshape(count, -1)
    both = np.concatenate([truth[None], drawn]).T
    parts = np.array_split(np.arange(truth.size), FOLDS)
    return _Side(both, [slice(int(one[0]), int(one[-1]) + 1) for one in parts if one.size])


def rough(size: int) -> FloatArray:
    """Return the matrix of squared second differences of ``size`` coefficients."""
    if size < 3:
        return np.eye(size)
    d = np.diff(np.eye(size), 2, axis=0)
    return np.asarray(d.T @ d)


def _ridge(phi: FloatArray, side: _Side, penalty: FloatArray | None = None) -> FloatArray:
    """Return penalised coefficients (k, 1 + count), the penalty of each column chosen over consecutive folds."""
    gram = phi.T @ phi
    moments = phi.T @ side.residual
    level = float(np.mean(np.diag(gram)))
    identity = np.eye(gram.shape[0]) * level
    if penalty is not None:
        identity = 1e-3 * identity + penalty * (level * gram.shape[0] / max(float(np.trace(penalty)), 1e-300))
    losses = np.zeros((len(SHRINKAGE), side.residual.shape[1]))
    for rows in side.folds:
        part = phi[rows]
        g, m = part.T @ part, part.T @ side.residual[rows]
        for i, amount in enumerate(SHRINKAGE):
            c = np.linalg.solve(gram - g + amount * identity, moments - m)
            losses[i] += np.sum(c * (g @ c), axis=0) - 2 * np.sum(c * m, axis=0)
    chosen = np.argmin(losses, axis=0)
    result = np.zeros_like(moments)
    for i, amount in enumerate(SHRINKAGE):
        if (chosen == i).any():
            result[:, chosen == i] = np.linalg.solve(gram + amount * identity, moments[:, chosen == i])
    # where no shrinkage predicts better than nothing, nothing is predicted
    result[:, losses.min(axis=0) >= 0] = 0.0
    return result
