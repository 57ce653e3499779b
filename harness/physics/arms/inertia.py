"""Inertial parameters of a rigid body: pseudo-inertia, physical consistency, log-Cholesky coordinates, divergence.

Ten parameters a body, in the order of ``Arm.parameters``: mass, first moments m c (3), and the
inertia xx xy xz yy yz zz about the frame of the joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray

TEN = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Names of the ten: mass, first moments, inertia about the frame of the joint."""
UNITS = ("kg", "kg m", "kg m", "kg m", *("kg m^2",) * 6)

ROUNDED = 1e-9  # Relative size below which what is missing to an inertia that a body can have is rounding.

_UPPER = np.triu_indices(3)
# Places of a11 a12 a13 a14 a22 a23 a24 a33 a34 a44 of an upper triangular matrix.
_TRIANGLE = np.triu_indices(4)


def pseudo_inertia(parameters: FloatArray) -> FloatArray:
    """Return the pseudo-inertia ``J = [[S, h], [h', m]]`` (..., 4, 4), S = tr(I)/2 - I the second moments.

    A body is physically consistent (a density that is nowhere negative makes it) if and only if J is positive definite
    (Wensing, Kim & Slotine 2018, IEEE Robot. Autom. Lett. 3:60, eq. 10-12).

    - ``parameters`` (..., 10)

    Examples
    --------
    >>> ball = np.array([1.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.4, 0.0, 0.4])
    >>> pseudo_inertia(ball).diagonal().round(3).tolist()
    [0.2, 0.2, 0.2, 1.0]
    """
    p = _ten(parameters)
    inertia = np.zeros((*p.shape[:-1], 3, 3))
    inertia[..., _UPPER[0], _UPPER[1]] = p[..., 4:]
    inertia[..., _UPPER[1], _UPPER[0]] = p[..., 4:]
    found = np.empty((*p.shape[:-1], 4, 4))
    half = np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] / 2
    found[..., :3, :3] = half * np.eye(3) - inertia
    found[..., :3, 3] = found[..., 3, :3] = p[..., 1:4]
    found[..., 3, 3] = p[..., 0]
    return found


def from_pseudo_inertia(matrix: FloatArray) -> FloatArray:
    """Return the ten parameters (..., 10) of pseudo-inertias (..., 4, 4).

    Examples
    --------
    >>> p = np.arange(1.0, 11.0)
    >>> bool(np.allclose(from_pseudo_inertia(pseudo_inertia(p)), p))
    True
    """
    J = np.asarray(matrix, dtype=float)
    second = J[..., :3, :3]
    inertia = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    parts = [J[..., 3, 3][..., None], J[..., :3, 3], inertia[..., _UPPER[0], _UPPER[1]]]
    return np.concatenate(parts, axis=-1)


def is_consistent(parameters: FloatArray, *, tolerance: float = 0.0) -> bool:
    """Return True if every body (..., 10) has a positive definite pseudo-inertia (>= -tolerance, relative).

    Examples
    --------
    >>> rod = np.array([1.0, 0.5, 0.0, 0.0, 0.01, 0.0, 0.0, 0.3, 0.0, 0.3])
    >>> is_consistent(rod), is_consistent(rod * np.array([1.0, 2, 1, 1, 1, 1, 1, 1, 1, 1]))
    (True, False)
    """
    values = np.linalg.eigvalsh(pseudo_inertia(parameters))
    return bool(np.all(values[..., 0] > -tolerance * np.abs(values[..., -1])))


def refuse_inconsistent(names: Sequence[str], parameters: FloatArray) -> None:
    """Refuse a body (one row of (bodies, 10)) that no density makes, by the name of its joint; none at all may be.

    Raises InputError with the joint, and what to do.
    """
    for name, row in zip(names, parameters, strict=True):
        if row.any() and not is_consistent(row, tolerance=1e-9):
            raise InputError(
                f"inertial parameters behind joint {name}",
                expected="a positive definite pseudo-inertia",
                got=f"mass {row[0]:.4g} kg and moments that no density makes",
                remedy="identify with method sdp or log-cholesky",
            )


def about_the_centre(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass (3,) and the inertia about it (3, 3) of a body (10,) with mass.

    Examples
    --------
    >>> mass, centre, inertia = about_the_centre(np.array([2.0, 1.0, 0, 0, 0.1, 0, 0, 0.6, 0, 0.6]))
    >>> mass, centre.tolist(), inertia.diagonal().round(12).tolist()
    (2.0, [0.5, 0.0, 0.0], [0.1, 0.1, 0.1])
    """
    row = _ten(parameters)
    mass, centre = float(row[0]), row[1:4] / row[0]
    about_frame = np.zeros((3, 3))
    about_frame[_UPPER] = row[4:]
    about_frame = about_frame + about_frame.T - np.diag(np.diag(about_frame))
    return mass, centre, about_frame - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def triangle_excess(inertia: FloatArray) -> float:
    """Return by which share of itself the largest principal moment of a tensor (3, 3) is too large for any body.

    Of a body every principal moment is at most the sum of the other two: 0 where that holds, and of no inertia at all.

    Examples
    --------
    >>> triangle_excess(np.diag([1.0, 1.0, 1.9])), round(triangle_excess(np.diag([0.01, 0.5, 0.01])), 2)
    (0.0, 0.96)
    """
    low, middle, high = np.linalg.eigvalsh(np.asarray(inertia, dtype=float))
    size = max(abs(low), abs(high))
    if not size > 0:
        return 0.0
    excess = max(high - low - middle, -low) / size
    return float(excess) if excess > ROUNDED else 0.0


def from_log_cholesky(theta: FloatArray) -> FloatArray:
    """Return the ten parameters (..., 10) of any log-Cholesky coordinates (..., 10): always consistent.

    ``J = U U'`` with U upper triangular, the logarithms of its diagonal among theta (Rucker & Wensing 2022, IEEE Robot.
    Autom. Lett. 7:2732, eq. 15).

    - ``theta`` (..., 10): upper triangle of U row by row, diagonal as logarithms

    Examples
    --------
    >>> is_consistent(from_log_cholesky(np.random.default_rng(0).normal(size=(50, 10))))
    True
    """
    U = _upper(theta)
    return from_pseudo_inertia(U @ np.swapaxes(U, -1, -2))


def to_log_cholesky(parameters: FloatArray) -> FloatArray:
    """Return the log-Cholesky coordinates (..., 10) of consistent bodies (..., 10).

    Raises InputError if a body is not consistent.

    Examples
    --------
    >>> theta = np.random.default_rng(0).normal(size=10)
    >>> bool(np.allclose(to_log_cholesky(from_log_cholesky(theta)), theta))
    True
    """
    if not is_consistent(parameters):
        raise InputError(
            "inertial parameters",
            expected="a positive definite pseudo-inertia for every body",
            got="one that no density makes",
            remedy="correct mass, centre or inertia of the URDF",
        )
    J = pseudo_inertia(parameters)[..., ::-1, ::-1]
    U = np.linalg.cholesky(J)[..., ::-1, ::-1]
    found = U[..., _TRIANGLE[0], _TRIANGLE[1]].copy()
    diagonal = _TRIANGLE[0] == _TRIANGLE[1]
    found[..., diagonal] = np.log(found[..., diagonal])
    return np.asarray(found)


def divergence(parameters: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the entropic divergence (...,) of bodies (..., 10) from prior ones, 0 where they are equal.

    ``-log det(J) + log det(J0) + tr(J0^-1 J) - 4``: the Bregman divergence of log det, which no change of frame or of
    units moves (Lee, Wensing & Park 2019, IEEE Trans. Robot. 36:182, eq. 20). Near the prior it is half the squared
    relative deviation.

    Examples
    --------
    >>> body = from_log_cholesky(np.zeros(10))
    >>> float(divergence(body, body)), round(float(divergence(1.1 * body, body)), 4)
    (0.0, 0.0188)
    """
    J, J0 = pseudo_inertia(parameters), pseudo_inertia(prior)
    ratio = np.linalg.solve(J0, J)
    sign, size = np.linalg.slogdet(ratio)
    found = np.trace(ratio, axis1=-2, axis2=-1) - size - 4.0
    return np.where(sign > 0, found, np.inf)


def _upper(theta: FloatArray) -> FloatArray:
    """Return the upper triangular factor (..., 4, 4)."""
    t = _ten(theta)
    U = np.zeros((*t.shape[:-1], 4, 4))
    U[..., _TRIANGLE[0], _TRIANGLE[1]] = t
    rows = np.arange(4)
    U[..., rows, rows] = np.exp(U[..., rows, rows])
    return U


def _ten(given: FloatArray) -> FloatArray:
    found = np.asarray(given, dtype=float)
    if found.shape[-1:] != (10,):
        raise InputError(
            "inertial parameters", expected="10 a body, last axis", got=f"shape {found.shape}", remedy="reshape"
        )
    return found
