"""Design of experiments for arms: the reference that makes the inertial parameters best conditioned under limits.

The reference of each joint is a finite Fourier series (Swevers et al., IEEE Trans. Robot. Autom. 13 (1997) 730),
scaled so that it keeps the limits whatever its coefficients; the condition number of the regressor's identifiable
columns, each of unit length, is then lowered by a random search whose step adapts itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from harness.algebra import unit_columns
from harness.errors import InputError
from harness.signals import FloatArray

Regressor = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
Violation = Callable[[FloatArray, FloatArray, FloatArray], float]
Criterion = Callable[[FloatArray], float]
FORBIDDEN = 1e9
"""Cost of a reference that breaks a limit, before the size of the breach: above any condition number in doubles."""

PROMISING = 4  # Starts that are searched from before one is chosen.


@dataclass(frozen=True, eq=False)
class JointLimits:
    """What a reference must keep: positions within [low, high] and rates within -+ rate; each an array (n,)."""

    # (n,): rad
    low: FloatArray
    high: FloatArray
    rate: FloatArray  # (n,): rad/s

    def __post_init__(self) -> None:
        if not (np.all(self.low < self.high) and np.all(self.rate > 0) and np.all(np.isfinite(self.high - self.low))):
            raise InputError(
                "limits of the joints",
                expected="finite low < high and rate > 0 for each joint",
                got=f"low {self.low}, high {self.high}, rate {self.rate}",
                remedy="give limits for every joint",
            )


@dataclass(frozen=True, eq=False)
class FourierReference:
    """Positions that are a Fourier series of one period.

    Examples
    --------
    >>> swing = FourierReference(2.0, np.zeros(1), np.ones((1, 1)), np.zeros((1, 1)))
    >>> [part.round(3).tolist() for part in swing.at(np.array([0.5]))]
    [[[1.0]], [[0.0]], [[-9.87]]]
    """

    period: float  # Seconds
    centre: FloatArray  # (n,): Mean position [rad]
    # (n, L): Coefficients of the harmonics 1 to L [rad]
    sine: FloatArray
    cosine: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, rate and acceleration (N, n) at times (N,)."""
        omega = 2 * np.pi / self.period * np.arange(1, self.sine.shape[1] + 1)
        angle = np.outer(t, omega)
        s, c = np.sin(angle), np.cos(angle)
        q = self.centre + s @ self.sine.T + c @ self.cosine.T
        v = c @ (self.sine * omega).T - s @ (self.cosine * omega).T
        a = -s @ (self.sine * omega**2).T - c @ (self.cosine * omega**2).T
        return q, v, a


@dataclass(frozen=True, eq=False)
class Design:
    """A designed reference, its criterion (by default the condition number), and that of the best random start."""

    reference: FourierReference
    condition: float
    start: float


def identifiable_columns(W: FloatArray, *, tolerance: float = 1e-9) -> FloatArray:
    """Return the indices of a largest set of independent columns, by QR with column pivoting.

    - ``W`` (N, k): regressor on rich data
    - ``tolerance``: smallest diagonal of R that counts, relative to the largest

    Examples
    --------
    >>> identifiable_columns(np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 3.0], [1.0, 2.0, 1.0]])).tolist()
    [1, 2]
    """
    from scipy.linalg import qr

    R, pivots = qr(W, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    kept = diagonal > tolerance * diagonal.max()
    return np.sort(np.asarray(pivots)[: kept.size][kept])


def condition_number(W: FloatArray, *, scaled: bool = True) -> float:
    """Return the condition number, the columns scaled to unit length first; infinite if one is zero.

    Examples
    --------
    >>> condition_number(np.diag([1.0, 100.0]))
    1.0
    """
    gram = W.T @ W
    length = np.sqrt(np.diag(gram))
    if not np.all(length > 0):
        return float("inf")
    values = np.linalg.eigvalsh(gram / np.outer(length, length) if scaled else gram)
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")


def volume_of(W: FloatArray, columns: Sequence[int]) -> float:
    """Return the volume of the standard ellipsoid of some parameters under torque noise of 1, the others unknown.

    Square root of the determinant of their covariance (D-optimality, Goodwin & Payne 1977, *Dynamic System
    Identification*, sec. 6.2), which no choice of units reorders; that of one parameter is :func:`deviation_of` it.

    - ``W`` (M, k)
    - ``columns``: of the parameters
    - returns infinity where the columns depend on each other

    Examples
    --------
    >>> round(volume_of(np.array([[1.0, 0.0, 1.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]), [1, 2]), 6)
    0.25
    """
    gram = W.T @ W
    size = np.sqrt(np.diag(gram))
    if not np.all(size > 0):
        return float("inf")
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    if values[0] <= np.finfo(float).eps * len(size) * values[-1]:
        return float("inf")
    part = vectors[list(columns)] / np.sqrt(values)
    return float(np.sqrt(np.linalg.det(part @ part.T)) / np.prod(size[list(columns)]))


def deviation_of(W: FloatArray, column: int) -> float:
    """Return the standard deviation of one parameter under torque noise of 1, the others unknown.

    The inverse of how much of its column no other column makes; with the difference of two effects in that column, of
    how well the pair is told apart.

    - ``W`` (M, k)
    - ``column``: of the parameter

    Examples
    --------
    >>> deviation_of(np.array([[1.0, 1.0], [0.0, 2.0]]), 1)
    0.5
    """
    others = unit_columns(np.delete(W, column, axis=1))
    left = float(np.linalg.norm(W[:, column] - others @ np.linalg.lstsq(others, W[:, column], rcond=None)[0]))
    return 1.0 / left if left > 0 else float("inf")


def design_reference(
    regressor: Regressor,
    limits: JointLimits,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    samples: int = 100,
    starts: int = 20,
    steps: int = 1000,
    scaled: bool = True,
    violation: Violation | None = None,
    criterion: Criterion | None = None,
    rng: np.random.Generator,
) -> Design:
    """Return a reference under which the inertial parameters are well conditioned.

    Raises InputError if no reference that keeps the limits is found.

    - ``regressor``: ``(q, v, a) -> W``; arrays (N, n) in, (N * n, k) out, e.g. ``Arm.regressor``.
    - ``limits``: kept at all times of the period
    - ``period``: seconds
    - ``harmonics``: of each joint
    - ``samples``: instants of a period at which the regressor is taken
    - ``starts, steps``: random references to choose from, and steps of the search from the best of them
    - ``scaled``: scale the columns to unit length first, so that the units of the parameters do not count
    - ``violation``: ``(q, v, a) -> float``, 0 where torques and places are within their limits, else by how much they
      are not
    - ``criterion``: of the whole regressor, in place of the condition number of its identifiable columns:
      :func:`deviation_of` a chosen parameter, or :func:`volume_of` some
    - ``rng``: draws both

    Notes
    -----
    The search is a (1+1) evolution strategy with the one-fifth success rule (Rechenberg 1973).
    """
    n = limits.low.size
    t = np.arange(samples) * period / samples
    dense = np.arange(20 * harmonics) * period / (20 * harmonics)
    half = 0.5 * (limits.high - limits.low)

    def made(raw: FloatArray) -> FourierReference:
        shape = FourierReference(period, np.zeros(n), raw[0], raw[1])
        q, v, _ = shape.at(dense)
        middle, reach = 0.5 * (q.max(axis=0) + q.min(axis=0)), 0.5 * np.ptp(q, axis=0)
        # 0.97: peaks between the points of the dense grid
        scale = np.minimum(half / reach, limits.rate / np.abs(v).max(axis=0)) * 0.97
        # raw[2] says, beside the middle, how much of what the limits leave is used: where torques or places limit it
        size = np.minimum(scale, 1.0)[:, None] * (1.0 if violation is None else 1 / (1 + np.exp(-raw[2, :, 1:2])))
        # the middle of the motion may lie anywhere that keeps the limits: raw[2] says where
        room = np.maximum(half - reach * size[:, 0] / 0.97, 0.0)
        centre = 0.5 * (limits.high + limits.low) - middle * size[:, 0] + np.tanh(raw[2, :, 0]) * room
        return FourierReference(period, centre, raw[0] * size, raw[1] * size)

    def draw() -> FloatArray:
        return np.asarray(rng.standard_normal((3, n, harmonics)) * half[:, None] / np.sqrt(harmonics), dtype=float)

    many = [made(draw()).at(t) for _ in range(5)]
    columns = identifiable_columns(np.vstack([regressor(*motion) for motion in many]))

    def cost(raw: FloatArray) -> float:
        reference = made(raw)
        breach = violation(*reference.at(dense)) if violation is not None else 0.0
        if breach > 0:
            return FORBIDDEN * (1 + breach)
        W = regressor(*reference.at(t))
        return condition_number(W[:, columns], scaled=scaled) if criterion is None else criterion(W)

    trials = [draw() for _ in range(max(1, starts))]
    costs = [cost(raw) for raw in trials]
    order = np.argsort(costs)
    first = costs[int(order[0])]

    def searched(best: FloatArray, value: float, size: float, count: int) -> tuple[float, FloatArray, float]:
        for _ in range(count):
            mask = rng.random(best.shape) < 0.3
            trial = best + size * mask * rng.standard_normal(best.shape) * half[:, None]
            new = cost(trial)
            if new < value:
                best, value, size = trial, new, size * 1.22
            else:
                size = max(size * 0.951, 1e-3)
        return value, best, size

    # A few of the best starts go some way, because the search ends where it began; the best of them goes on.
    few = [searched(trials[k], costs[k], 0.3, steps // (2 * PROMISING)) for k in order[:PROMISING]]
    value, best, size = min(few, key=lambda one: one[0])
    value, best, _ = searched(best, value, size, steps - len(few) * (steps // (2 * PROMISING)))
    if value >= FORBIDDEN:
        raise InputError(
            "design of an experiment",
            expected="a reference within the limits of torque and workspace",
            got=f"none in {starts} starts and {steps} steps",
            remedy="widen the limits, or lower the rate",
        )
    return Design(made(best), value, first)
