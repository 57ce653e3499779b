"""Fisher information of records about a model, its input and its noise taken apart: what amplitude and length give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.models.spread import Matrices
from harness.signals import FloatArray
from identifiers.linear.length.quantities import Item

_SAMPLES = 4000  # Samples of simulated noise from which its information is taken.
_LOST = 1e-9  # Relative eigenvalue of the scaled information below which a direction carries none.
_STEP = 1e-5  # Relative step of differences: the cube root of rounding.


@dataclass(frozen=True, eq=False)
class Information:
    """Information about directions of (A, B, C, D, K) that change what the model does."""

    driven: FloatArray  # (k, k): From the inputs of the records, at their amplitude
    noisy: FloatArray  # (k, k): From the noise that the model filters, over as many samples
    halves: tuple[FloatArray, FloatArray]
    """Tuple of array (k, k): The part of ``driven`` of the first and of the second half of every record."""
    directions: list[Matrices]  # What each of the k directions adds to A, B, C, D

    def at(self, amplitude: float) -> FloatArray:
        """Return the information (k, k) where all inputs are this many times as large."""
        return np.asarray(amplitude**2 * self.driven + self.noisy)


def information_of_linear(
    matrices: Matrices,
    gain: FloatArray,
    noise: FloatArray,
    inputs: Sequence[FloatArray],
    *,
    rng: np.random.Generator,
) -> Information:
    """Return the Fisher information of records about a model in innovation form.

    With ``y = G u + H e`` the prediction errors move by ``H^-1 (dG u + dH e)`` (Ljung 1999, eq. 9.54 and 9.55), and the
    information is the sum of their products over the noise: a part that grows with the square of the inputs, and one of
    the noise alone. Directions that only change the coordinates of the state are left out.

    - ``matrices`` (A, B, C, D)
    - ``gain`` (nx, ny): K of ``x+ = A x + B u + K e``; zeros for noise of the sensors alone
    - ``noise`` (ny, ny): covariance of e
    - ``inputs`` sequence of array (N_i, nu): of the records, as deviations from their mean

    Examples
    --------
    >>> one, rng = np.ones((1, 1)), np.random.default_rng(0)
    >>> model, u = (0.8 * one, one, one, 0 * one), rng.normal(size=(20000, 1))
    >>> found = information_of_linear(model, 0 * one, one, [u], rng=rng)
    >>> item = Item("pole", "1", lambda m: m[0][0], np.array([0.8]))
    >>> a, n = 0.8, 20000
    >>> rest = 1 / (1 - a**2)  # of output error, white inputs
    >>> exact = np.linalg.inv([[(1 + a**2) * rest**3, a * rest**2], [a * rest**2, rest]])
    >>> bool(abs(variance_of(item, model, found, 1.0)[0, 0] * n / exact[0, 0] - 1) < 0.1)
    True
    """
    a, b, c, d = matrices
    direct, filtered = bool(np.any(d)), bool(np.any(gain))
    changes = _directions(a, b, c, d, gain, direct, filtered)
    weight = np.linalg.cholesky(np.linalg.inv(noise + 1e-300 * np.eye(len(noise))))
    k = len(changes)
    halves = np.zeros((2, k, k))
    for u in inputs:
        slopes = _slopes(matrices, gain, changes, u, np.zeros((len(u), len(c)))) @ weight
        middle = len(u) // 2
        for half, part in enumerate((slopes[:middle], slopes[middle:])):
            rows = part.transpose(0, 2, 1).reshape(-1, k)
            halves[half] += rows.T @ rows
    noisy = np.zeros((k, k))
    if filtered:
        e = rng.standard_normal((_SAMPLES, len(c))) @ np.linalg.cholesky(noise).T
        slopes = _slopes(matrices, gain, changes, np.zeros((_SAMPLES, b.shape[1])), e) @ weight
        rows = slopes.transpose(0, 2, 1).reshape(-1, k)
        noisy = rows.T @ rows * (sum(map(len, inputs)) / _SAMPLES)
    return Information(halves.sum(axis=0), noisy, (halves[0], halves[1]), [change[:4] for change in changes])


def variance_of(item: Item, matrices: Matrices, found: Information, amplitude: float) -> FloatArray:
    """Return the least covariance (k, k) of a quantity under the information of records (Cramer & Rao).

    - ``item``: a function of the matrices
    - ``matrices`` (A, B, C, D)
    - ``amplitude``: all inputs times this
    """
    assert item.of is not None
    slopes = []
    for change in found.directions:
        low, high = (_moved(matrices, change, side * _STEP) for side in (-1.0, 1.0))
        slopes.append((item.of(high) - item.of(low)) / (2.0 * _STEP))
    return covariance_of_slopes(np.array(slopes), found.at(amplitude))


def _moved(matrices: Matrices, change: Matrices, step: float) -> Matrices:
    a, b, c, d = (m + step * dm for m, dm in zip(matrices, change, strict=True))
    return a, b, c, d


def covariance_of_slopes(slopes: FloatArray, information: FloatArray) -> FloatArray:
    """Return ``S' I^-1 S`` (m, m) of slopes (k, m); directions without information count as infinite where they matter.

    Examples
    --------
    >>> covariance_of_slopes(np.eye(2), np.diag([4.0, 0.0])).tolist()
    [[0.25, 0.0], [0.0, inf]]
    """
    size = np.sqrt(np.diag(information))
    seen = size > 0
    unit = np.where(seen, size, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    good = values > _LOST * max(float(values[-1]), 1e-300)
    turned = vectors.T @ (slopes / unit[:, None])
    covariance = (turned[good].T / values[good]) @ turned[good]
    lost = np.linalg.norm(turned[~good], axis=0) > 1e-6 * np.maximum(np.linalg.norm(turned, axis=0), 1e-300)
    found = np.asarray(covariance, dtype=np.float64)
    found[lost, lost] = np.inf
    return found


def _directions(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, gain: FloatArray, direct: bool, filtered: bool
) -> list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Return an orthonormal set of changes of A, B, C, D, K that no change of coordinates brings about.

    Changes of coordinates ``x -> (I + e X) x`` add ``X A - A X``, ``X B``, ``-C X`` and ``X K`` (Ljung 1999, sec. 4.3;
    McKelvey, Helmersson & Ribarits 2004, *Automatica* 40:1629, sec. 3). Every matrix counts by its own size.
    """
    n = len(a)
    shapes = [a.shape, b.shape, c.shape, d.shape, gain.shape]
    free = [True, True, True, direct, filtered]
    scale = [max(float(np.linalg.norm(m)), 1e-12) for m in (a, b, c, d, gain)]
    orbit = []
    for i in range(n):
        for j in range(n):
            x = np.zeros((n, n))
            x[i, j] = 1.0
            moved = (x @ a - a @ x, x @ b, -c @ x, np.zeros_like(d), x @ gain)
            parts = [m.ravel() / s for m, s, used in zip(moved, scale, free, strict=True) if used]
            orbit.append(np.concatenate(parts))
    count = sum(int(np.prod(shape)) for shape, used in zip(shapes, free, strict=True) if used)
    basis = np.eye(count)
    if orbit:
        left, values, _ = np.linalg.svd(np.array(orbit).T, full_matrices=True)
        basis = left[:, int(np.sum(values > 1e-10 * values[0])) :]
    found = []
    for column in basis.T:
        parts, place = [], 0
        for shape, s, used in zip(shapes, scale, free, strict=True):
            size = int(np.prod(shape)) if used else 0
            parts.append(s * column[place : place + size].reshape(shape) if used else np.zeros(shape))
            place += size
        found.append((parts[0], parts[1], parts[2], parts[3], parts[4]))
    return found


def _slopes(
    matrices: Matrices,
    gain: FloatArray,
    changes: Sequence[tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]],
    u: FloatArray,
    e: FloatArray,
) -> FloatArray:
    """Return how the one-step prediction moves along every direction (N, k, ny), y as the model makes it from u, e."""
    a, b, c, _ = matrices
    rows = len(u)
    x = np.zeros((rows, len(a)))
    driven = u @ b.T + e @ gain.T
    for k in range(rows - 1):
        x[k + 1] = x[k] @ a.T + driven[k]
    # the predictor: z+ = A z + B u + K (y - C z - D u), whose z is x along the truth and y - C z - D u = e
    da, db, dc, dd, dk = (np.array([change[m] for change in changes]) for m in range(5))
    pushed = np.einsum("kij,tj->tki", da, x) + np.einsum("kij,tj->tki", db, u) + np.einsum("kij,tj->tki", dk, e)
    seen = np.einsum("kij,tj->tki", dc, x) + np.einsum("kij,tj->tki", dd, u)
    pushed -= seen @ gain.T
    closed = (a - gain @ c).T
    slopes = np.empty((rows, len(changes), len(c)))
    state = np.zeros((len(changes), len(a)))
    for k in range(rows):
        slopes[k] = state @ c.T + seen[k]
        state = state @ closed + pushed[k]
    return slopes
