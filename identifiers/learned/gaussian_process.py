"""Gaussian processes on lagged outputs and inputs: exact for some hundreds of samples, inducing points for more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.options import check_options
from harness.signals import FloatArray, Trajectory
from identifiers.common.bands import Bands, held_out_folds, held_out_runs
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.lag_state import LagModel, Standardisation, regression_data

_JITTER = 1e-10
"""Relative to the prior variance; keeps Cholesky factors of noise-free data real, and sets the least noise with it."""

_NO_SLOPE = -16.0  # Logarithm of the linear term's size where there is none: 1e-7 standard deviations of the targets.
_CANDIDATES = 4000  # Samples among which inducing points are chosen.
_FOLDS = 5  # Parts of the data each of which judges the bands of a process that knows the others.
_WINDOWS = 2  # Held-out windows of a part at least, as those of all five are judged together.
_BLOCK = 2048  # Rows of a block of the kernel matrix.


@dataclass(frozen=True, eq=False)
class Kernel:
    """Squared exponential with a length for each regressor, and a line: ``sf^2 exp(-r^2/2) + sl^2 (1 + x x')``.

    Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, eq. 5.1 and, for the line, sec. 4.2.2.
    """

    lengths: FloatArray  # (p,)
    # sf and sl
    signal: float
    slope: float
    noise: float  # Standard deviation of the noise of the targets

    @classmethod
    def of(cls, logs: FloatArray) -> Kernel:
        """Return the kernel of the logarithms ``[lengths, signal, slope, noise]``."""
        values = np.exp(logs)
        return cls(values[:-3], float(values[-3]), float(values[-2]), float(values[-1]))

    def __call__(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return the covariances (n, m) of rows (n, p) and (m, p)."""
        return np.asarray(self.signal**2 * self.squared_exponential(a, b) + self.slope**2 * (1.0 + a @ b.T))

    def squared_exponential(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return the squared exponential part, of size 1."""
        a, b = a / self.lengths, b / self.lengths
        square = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
        return np.asarray(np.exp(-0.5 * np.maximum(square, 0.0)))

    def own(self, a: FloatArray) -> FloatArray:
        """Return the prior variance (n,) of rows."""
        return np.asarray(self.signal**2 + self.slope**2 * (1.0 + np.sum(a**2, axis=1)))


@dataclass(frozen=True, eq=False)
class Posterior:
    """One output: mean ``q target``, variance ``k(x, x) - |q|^2 + |q extra|^2`` plus noise, with q = k(x, Z) R.

    Sums of squares of whitened numbers: nothing large cancels however small the noise is.
    """

    kernel: Kernel
    points: FloatArray  # (M, p): Z: the samples, or inducing points
    root: FloatArray
    """(M, M): R, with ``R R'`` the inverse of the covariance of the samples, noise included, or of the inducing
    points."""
    target: FloatArray  # (M,)
    extra: FloatArray  # (M, K): What inducing points leave open; K = 0 for the exact process

    def __call__(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (n,) of the noisy target at rows (n, p)."""
        mean, variance = np.empty(len(rows)), np.empty(len(rows))
        for low in range(0, len(rows), _BLOCK):
            part = rows[low : low + _BLOCK]
            q = self.kernel(part, self.points) @ self.root
            mean[low : low + _BLOCK] = q @ self.target
            left = self.kernel.own(part) - np.sum(q**2, axis=1)
            variance[low : low + _BLOCK] = np.maximum(left, 0.0) + np.sum((q @ self.extra) ** 2, axis=1)
        return mean, variance + self.kernel.noise**2


@dataclass(frozen=True, eq=False)
class GaussianProcessModel(LagModel):
    """The change of every output is a Gaussian process of the lagged outputs and inputs.

    Parameters
    ----------
    posteriors : tuple of Posterior
        One for each output, in scaled numbers.
    """

    posteriors: tuple[Posterior, ...]
    kind = "gaussian-process"

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        flat = self.scaling.rows(rows).reshape(-1, rows.shape[-1])
        both = [posterior(flat) for posterior in self.posteriors]
        shape = (*rows.shape[:-1], self.spec.ny)
        mean = np.stack([middle for middle, _ in both], axis=-1).reshape(shape)
        variance = np.stack([spread for _, spread in both], axis=-1).reshape(shape)
        change = self.scaling.y_mean + mean * self.scaling.y_std
        return rows[..., : self.spec.ny] + change, variance * self.scaling.y_std**2

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description: a posterior and its kernel stand side by side."""
        content = super().to_dict()
        return content | {"outputs": [{**one.pop("kernel"), **one} for one in content.pop("posteriors")]}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> GaussianProcessModel:
        """Return the model of a description."""
        return cls.read({**content, "posteriors": [{**one, "kernel": one} for one in content["outputs"]]})


@dataclass(frozen=True)
class GaussianProcess(Excited):
    """Gaussian process regression of the next output, with bands.

    Hyperparameters maximise the marginal likelihood (Rasmussen and Williams 2006, eq. 5.8 and 5.9) of at most ``exact``
    samples. With more samples than that all of them enter through inducing points (Titsias 2009, *AISTATS*, eq. 10),
    chosen one by one where the prior leaves most variance, and the noise is found again from the bound (eq. 9).

    Several steps ahead the variances of the steps are added, which is rough. So the same process without a fifth of the
    data (of the records where there are five and more, else of each) predicts that fifth, all five one after the other,
    and the bands are scaled, for every horizon, to hold there (:class:`identifiers.common.bands.Bands`).

    Parameters
    ----------
    order : int
        Past outputs and inputs; 1 where the state is measured.
    exact : int
        Samples up to which the process is exact.
    inducing : int
        Inducing points beyond that.
    affine : bool
        Add a linear term to the kernel. Free runs then leave the data on straight lines instead of turning back to the
        mean, but the bands hardly widen there: what is nearly affine where it was seen is taken for affine everywhere.
    """

    order: int = 1
    exact: int = 500
    inducing: int = 200
    affine: bool = False

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> GaussianProcessModel:
        """Return the model; lengths and noise stand in its notes, in the units of the data."""
        what = "gaussian-process"
        check_options(self, what, order=">= 1", exact=">= 1", inducing=">= 1")
        records, spec = self.asked(trajectories, samples=self.order + 2, what=what)
        rows, later = regression_data(records, self.order)
        if len(rows) < rows.shape[1] + 3:
            raise FitError(
                f"{what}: too few samples",
                expected=f"{rows.shape[1] + 3}, one for each hyperparameter",
                got=str(len(rows)),
                remedy="record longer, or lower the order",
            )
        change = later - rows[:, : spec.ny]
        scaling = Standardisation.of(rows, change)
        x, y = scaling.rows(rows), scaling.targets(change)
        whole = len(x) <= self.exact
        few = np.arange(len(x)) if whole else np.sort(rng.choice(len(x), size=self.exact, replace=False))
        pool = np.sort(rng.choice(len(x), size=min(len(x), _CANDIDATES), replace=False))
        kernels = [_likeliest(x[few], y[few, column], self.affine) for column in range(spec.ny)]

        def posteriors_of(rows: npt.NDArray[np.bool_]) -> tuple[Posterior, ...]:
            """Return the posteriors that know some of the rows."""
            if whole:
                return tuple(_exact(kernel, x[rows], y[rows, k]) for k, kernel in enumerate(kernels))
            near = x[pool[rows[pool]]]
            points = [near[_inducing(kernel, near, self.inducing)] for kernel in kernels]
            return tuple(_sparse(kernels[k], points[k], x[rows], y[rows, k]) for k in range(spec.ny))

        parts = []
        for held in held_out_folds([len(record) for record in records], _FOLDS):
            known = [np.ones(len(record) - self.order, dtype=bool) for record in records]
            for number, begin, _, end in held:
                known[number][max(0, begin - self.order) : end] = False
            if (rows_known := np.concatenate(known)).sum() > x.shape[1] + 3:
                draft = GaussianProcessModel(spec, self.order, scaling, posteriors_of(rows_known))
                ends, cuts = [records[k][:end] for k, _, _, end in held], [at for _, _, at, _ in held]
                runs = held_out_runs(draft, ends, cuts, least=_WINDOWS)
                if runs:
                    parts.append((draft, runs))
        bands = Bands.crossed(parts, what) if parts else None
        posteriors = posteriors_of(np.ones(len(x), dtype=bool))
        notes = {
            "samples": len(x),
            "points": [len(posterior.points) for posterior in posteriors],
            "noise": [
                float(posterior.kernel.noise * s) for posterior, s in zip(posteriors, scaling.y_std, strict=True)
            ],
            "lengths": [(posterior.kernel.lengths * scaling.x_std).tolist() for posterior in posteriors],
            "bands": "those of the process itself: too little data to hold any out"
            if bands is None
            else bands.note(spec.sample_time),
        }
        return GaussianProcessModel(spec, self.order, scaling, posteriors, bands=bands, notes=notes)


def _likeliest(x: FloatArray, y: FloatArray, affine: bool) -> Kernel:
    """Return the kernel with the largest marginal likelihood, from a smooth and from a rough start."""
    from scipy.optimize import minimize

    p = x.shape[1]
    best: tuple[float, FloatArray] | None = None
    # Lengths beyond 1e4 standard deviations make no difference; noise below 1e-5 of the targets is rounding.
    slopes = (-9.0, 7.0) if affine else (_NO_SLOPE, _NO_SLOPE)
    bounds = [(np.log(1e-2), np.log(1e4))] * p + [(-9.0, 7.0), slopes, (np.log(1e-5), np.log(3.0))]
    for length, noise in ((3.0, 0.05), (1.0, 0.3)):
        start = np.log(np.concatenate([np.full(p, length), [1.0, 0.5 if affine else np.exp(_NO_SLOPE), noise]]))
        found = minimize(
            _evidence, start, args=(x, y), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 80}
        )
        if best is None or found.fun < best[0]:
            best = (float(found.fun), np.asarray(found.x, dtype=float))
    assert best is not None
    return Kernel.of(best[1])


def _evidence(logs: FloatArray, x: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    """Return minus the log marginal likelihood and its gradient in the logarithms of the hyperparameters."""
    from scipy.linalg import cho_factor, cho_solve, lapack

    kernel = Kernel.of(logs)
    smooth = kernel.signal**2 * kernel.squared_exponential(x, x)
    line = kernel.slope**2 * (1.0 + x @ x.T)
    prior = float(np.mean(kernel.own(x)))
    matrix = smooth + line
    matrix[np.diag_indices(len(x))] += kernel.noise**2 + _JITTER * prior
    try:
        factor = cho_factor(matrix, lower=True)
    except np.linalg.LinAlgError:
        return 1e12, np.zeros_like(logs)
    alpha = cho_solve(factor, y)
    value = 0.5 * y @ alpha + np.log(np.diag(factor[0])).sum() + 0.5 * len(x) * np.log(2 * np.pi)
    inverse, _ = lapack.dpotri(factor[0], lower=1)
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    # d value / d theta = 1/2 tr((K^-1 - alpha alpha') dK / d theta)
    outer = inverse - np.outer(alpha, alpha)
    weighted = outer * smooth
    total = weighted.sum(axis=1)
    squares = x**2
    # sum_ij w_ij (x_i - x_j)^2 for every column at once
    spread = 2.0 * (total @ squares) - 2.0 * np.einsum("ip,ip->p", x, weighted @ x)
    gradient = np.concatenate(
        [
            0.5 * spread / kernel.lengths**2,
            [weighted.sum(), float(np.sum(outer * line)), kernel.noise**2 * float(np.trace(outer))],
        ]
    )
    return float(value), gradient


def _exact(kernel: Kernel, x: FloatArray, y: FloatArray) -> Posterior:
    """Return the posterior that remembers every sample (Rasmussen and Williams 2006, eq. 2.25 and 2.26)."""
    matrix = kernel(x, x)
    matrix[np.diag_indices(len(x))] += kernel.noise**2 + _JITTER * float(np.mean(kernel.own(x)))
    root = _inverse_factor(matrix).T
    return Posterior(kernel, x, root, root.T @ y, np.zeros((len(x), 0)))


def _inverse_factor(matrix: FloatArray) -> FloatArray:
    """Return the inverse of the lower Cholesky factor."""
    from scipy.linalg import solve_triangular

    return np.asarray(solve_triangular(np.linalg.cholesky(matrix), np.eye(len(matrix)), lower=True))


def _inducing(kernel: Kernel, x: FloatArray, count: int) -> list[int]:
    """Return rows chosen one by one where the prior leaves most variance (pivoted Cholesky)."""
    left = kernel.own(x).copy()
    # Below a thousandth of the noise another point says nothing; below 1e-12 of the prior it is rounding.
    least = max(1e-3 * kernel.noise**2, 1e-12 * float(left.max()))
    factors = np.zeros((min(count, len(x)), len(x)))
    chosen: list[int] = []
    for number in range(len(factors)):
        pivot = int(np.argmax(left))
        if left[pivot] < least:
            break
        row = kernel(x[pivot : pivot + 1], x)[0]
        if number:
            row = row - factors[:number, pivot] @ factors[:number]
        factors[number] = row / np.sqrt(left[pivot])
        left = np.maximum(left - factors[number] ** 2, 0.0)
        chosen.append(pivot)
    return chosen


def _sparse(kernel: Kernel, points: FloatArray, x: FloatArray, y: FloatArray) -> Posterior:
    """Return the posterior through inducing points, with the noise that maximises the bound."""
    from scipy.optimize import minimize_scalar

    prior = kernel(points, points)
    prior[np.diag_indices(len(points))] += 1e-10 * float(np.mean(np.diag(prior)))
    whiten = _inverse_factor(prior)
    gram, right, left_over = np.zeros_like(prior), np.zeros(len(points)), 0.0
    for low in range(0, len(x), _BLOCK):
        part = whiten @ kernel(points, x[low : low + _BLOCK])
        gram += part @ part.T
        right += part @ y[low : low + _BLOCK]
        left_over += float(np.sum(kernel.own(x[low : low + _BLOCK])) - np.sum(part**2))
    values, vectors = np.linalg.eigh(gram)
    values, turned, square, n = np.maximum(values, 0.0), vectors.T @ right, float(y @ y), len(x)

    def minus_bound(log_noise: float) -> float:
        s2 = np.exp(2.0 * log_noise)
        inside = np.sum(np.log1p(values / s2)) + n * np.log(2 * np.pi * s2)
        fit = (square - np.sum(turned**2 / (s2 + values))) / s2
        return float(0.5 * (inside + fit + max(left_over, 0.0) / s2))

    middle = np.log(kernel.noise)
    found = minimize_scalar(minus_bound, bounds=(middle - 2.0, middle + 3.0), method="bounded")
    noise = float(np.exp(found.x))
    shrunk = vectors / np.sqrt(noise**2 + values)
    target = shrunk @ (shrunk.T @ right)
    fitted = Kernel(kernel.lengths, kernel.signal, kernel.slope, noise)
    return Posterior(fitted, points, whiten.T, target, noise * shrunk)
