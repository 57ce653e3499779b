"""Control-oriented score: what the LQR that is designed on an identified model costs on the true plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.algebra import unit_columns
from harness.errors import InputError
from harness.signals import FloatArray


@dataclass(frozen=True)
class CostRatio:
    """Closed-loop cost of a design on the true plant over the least possible."""

    ratio: float  # At least 1; infinite where the design does not stabilise the plant or cannot be made
    status: str  # {"ok", "unstable", "no design"}
    spectral_radius: float  # Of the true closed loop; NaN without a design


def lqr_cost_ratio(
    model: tuple[FloatArray, FloatArray],
    plant: tuple[FloatArray, FloatArray],
    *,
    q: FloatArray | None = None,
    r: FloatArray | None = None,
    x0: FloatArray | None = None,
) -> CostRatio:
    """Return the cost of a model's LQR on the true plant over that of the plant's own LQR.

    Parameters
    ----------
    model, plant : (A, B)
        Discrete-time matrices (nx, nx) and (nx, nu) in the same coordinates.
    q, r : array (nx, nx), (nu, nu), optional
        Weights; identities by default.
    x0 : array (nx, nx), optional
        Covariance of the initial state; the identity by default.

    Returns
    -------
    CostRatio
        The cost is trace(P x0), with P from the Lyapunov equation of the closed loop.

    Raises
    ------
    InputError
        If shapes do not fit, or the true plant itself has no LQR.

    Examples
    --------
    >>> plant = np.array([[1.1]]), np.array([[1.0]])
    >>> round(lqr_cost_ratio((np.array([[1.0]]), np.array([[1.0]])), plant).ratio, 4)
    1.0149
    >>> lqr_cost_ratio((np.array([[0.1]]), np.array([[1.0]])), plant).status
    'unstable'
    """
    (a_model, b_model), (a, b) = model, plant
    if np.shape(a_model) != np.shape(a) or np.shape(b_model) != np.shape(b):
        raise InputError(
            "model and plant of an LQR cost ratio",
            expected=f"A {np.shape(a)} and B {np.shape(b)}",
            got=f"A {np.shape(a_model)} and B {np.shape(b_model)}",
            remedy="bring the model into the plant's coordinates",
        )
    nx, nu = np.shape(b)
    q = np.eye(nx) if q is None else q
    r = np.eye(nu) if r is None else r
    x0 = np.eye(nx) if x0 is None else x0
    best = lqr_gain(a, b, q, r)
    if best is None or spectral_radius(a - b @ best) >= 1.0:
        raise InputError(
            "the plant has no LQR",
            expected="a stabilisable plant",
            got="no solution of its Riccati equation",
            remedy="choose weights that see every unstable state, or another plant",
        )
    gain = lqr_gain(a_model, b_model, q, r)
    if gain is None:
        return CostRatio(float("inf"), "no design", float("nan"))
    radius = spectral_radius(a - b @ gain)
    if radius >= 1.0:
        return CostRatio(float("inf"), "unstable", radius)
    return CostRatio(_cost(a, b, gain, q, r, x0) / _cost(a, b, best, q, r, x0), "ok", radius)


def reachable(a: FloatArray, b: FloatArray, tolerance: float = 1e-9) -> int:
    """Return the dimension of the controllable subspace of a model that is handed to control design.

    Examples
    --------
    >>> reachable(np.diag([0.5, 0.4]), np.array([[1.0], [0.0]]))
    1
    """
    basis = np.zeros((a.shape[0], 0))
    block = np.asarray(b, dtype=float)
    # A staircase: only what is new in A times the last directions is added (Van Dooren 1981).
    for _ in range(a.shape[0]):
        new = block - basis @ (basis.T @ block)
        left, size, _ = np.linalg.svd(new, full_matrices=False)
        largest = max(float(np.linalg.norm(block, 2)) if block.size else 0.0, 1e-300)
        kept = left[:, size > tolerance * largest]
        if not kept.shape[1]:
            break
        basis = np.linalg.qr(np.hstack([basis, kept]))[0]
        block = a @ kept
    return int(basis.shape[1])


def state_observable(a: FloatArray, c: FloatArray, tolerance: float = 1e-9) -> int:
    """Return the dimension of the observable quotient.

    Examples
    --------
    >>> state_observable(np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]]))
    2
    """
    return reachable(a.T, c.T, tolerance)


def stabilisable(a: FloatArray, b: FloatArray, tolerance: float = 1e-9) -> bool:
    """Return True if inputs reach every mode on or outside the unit circle (Popov, Belevitch & Hautus).

    Detectability is the same question of ``A'`` and ``C'``.

    Examples
    --------
    >>> stabilisable(np.diag([1.2, 0.5]), np.array([[1.0], [0.0]])), stabilisable(np.diag([1.2, 0.5]), np.eye(2)[:, 1:])
    (True, False)
    """
    scaled = unit_columns(b)
    for value in np.linalg.eigvals(a):
        if abs(value) >= 1.0 - 1e-12:
            pencil = np.hstack([a - value * np.eye(len(a)), scaled])
            if np.linalg.svd(pencil, compute_uv=False)[-1] <= tolerance * max(1.0, float(np.linalg.norm(a, 2))):
                return False
    return True


def lqr_gain(
    a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, *, cross: FloatArray | None = None
) -> FloatArray | None:
    """Return K of ``u = -K x`` (nu, nx) that minimises ``sum x' q x + u' r u + 2 x' cross u``.

    None where the Riccati equation has no stabilising solution.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> lqr_gain(one, one, one, one).round(4)
    array([[0.618]])
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    s = np.zeros(np.shape(b)) if cross is None else cross
    try:
        p = solve_discrete_are(a, b, q, r, s=s if np.any(s) else None)
    except (LinAlgError, ValueError):
        return None
    gain = np.asarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a + s.T), dtype=np.float64)
    return gain if np.isfinite(gain).all() else None


def kalman_gain(a: FloatArray, c: FloatArray, process: FloatArray, sensor: FloatArray) -> FloatArray | None:
    """Return the stationary predictor gain K (nx, ny) of ``x+ = A x + K (y - C x)``; None where there is none.

    - ``a, c`` (nx, nx), (ny, nx)
    - ``process, sensor`` (nx, nx), (ny, ny): covariances of the disturbance of the state and of the sensor noise
    """
    gain = lqr_gain(a.T, c.T, process, sensor)
    return None if gain is None else gain.T


def spectral_radius(a: FloatArray) -> float:
    """Return the largest modulus of an eigenvalue; 0 of an empty matrix."""
    return float(np.abs(np.linalg.eigvals(a)).max()) if np.size(a) else 0.0


def _cost(a: FloatArray, b: FloatArray, gain: FloatArray, q: FloatArray, r: FloatArray, x0: FloatArray) -> float:
    """Return trace(P x0) of a stable closed loop."""
    from scipy.linalg import solve_discrete_lyapunov

    p = solve_discrete_lyapunov((a - b @ gain).T, q + gain.T @ r @ gain)
    return float(np.trace(p @ x0))
