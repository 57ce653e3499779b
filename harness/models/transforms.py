"""Linear models in other forms: in continuous time, at another sample time, with fewer states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.models.spread import Matrices, gains
from harness.signals import FloatArray

Hold = Literal["zoh", "foh", "tustin", "matched"]
SMALL = 1e-9  # Singular values, and poles, below this share of the largest (of 1) have no logarithm worth the name.
INFINITE = 1e6  # Zeros beyond so many times the largest pole are those at infinity, after rounding.


def continuous(matrices: Matrices, sample_time: float, method: Hold = "zoh") -> Matrices:
    """Return A, B, C, D in continuous time that give these between samples.

    Raises InputError if a pole is at 0 or on the negative real axis, where no continuous pole belongs to it (Tustin: at
    -1).

    - ``matrices`` (A, B, C, D): in discrete time
    - ``sample_time``: [s]
    - ``method`` {"zoh", "foh", "tustin", "matched"}: what the input does between samples (stays; goes straight), or
      Tustin's rule; ``"matched"`` maps poles and zeros by the logarithm, of one input and one output

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> a, b, c, d = continuous((np.exp(-0.2) * one, (1 - np.exp(-0.2)) * one, one, 0 * one), 0.1)
    >>> float(a[0, 0].round(9)), float(b[0, 0].round(9))
    (-2.0, 2.0)
    """
    from scipy.linalg import logm

    a, b, c, d = matrices
    n = len(a)
    refuse_unknown("method of conversion", method, get_args(Hold), remedy="use one")
    poles = np.linalg.eigvals(a) if n else np.zeros(0)
    if method == "tustin":
        bad = np.abs(poles + 1.0) < SMALL
    else:
        bad = (np.abs(poles) < SMALL) | ((poles.real < 0) & (np.abs(poles.imag) < SMALL))
    if bad.any():
        raise InputError(
            "model in continuous time",
            expected="no pole at 0 or on the negative real axis" if method != "tustin" else "no pole at -1",
            got=f"a pole at {poles[bad][0]:.3g}: no continuous pole belongs to it",
            remedy="reduce the model first (reduced), fit transfer-function, or use tustin",
        )
    if method == "matched":
        return _matched(matrices, sample_time, back=True)
    if method == "tustin":
        inverse = np.asarray(np.linalg.inv(a + np.eye(n)), dtype=np.float64)
        rate = 2.0 / sample_time
        moved = rate * (a - np.eye(n)) @ inverse
        return moved, 2.0 * rate * inverse @ inverse @ b, c, d - c @ inverse @ b
    ac = np.asarray(logm(a), dtype=np.complex128).real / sample_time
    level, now, after = _integrals(ac, sample_time)
    if method == "zoh":
        return ac, np.asarray(np.linalg.solve(level, b), dtype=np.float64), c, d
    bc: FloatArray = np.asarray(np.linalg.solve(now + a @ after, b), dtype=np.float64)
    return ac, bc, c, d - c @ after @ bc


def discrete(matrices: Matrices, sample_time: float, method: Hold = "zoh") -> Matrices:
    """Return A, B, C, D between samples of a system in continuous time; :func:`continuous` the other way.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> a, b, c = np.array([[0.0, 1.0], [-4.0, -0.6]]), rng.normal(size=(2, 1)), rng.normal(size=(1, 2))
    >>> made = (a, b, c, np.zeros((1, 1)))
    >>> for method in ("zoh", "foh", "tustin"):
    ...     again = continuous(discrete(made, 0.1, method), 0.1, method)
    ...     assert all(np.allclose(one, other) for one, other in zip(made, again))
    """
    from scipy.linalg import expm

    a, b, c, d = matrices
    n = len(a)
    refuse_unknown("method of conversion", method, get_args(Hold), remedy="use one")
    if method == "matched":
        return _matched(matrices, sample_time, back=False)
    if method == "tustin":
        half = 0.5 * sample_time
        inverse = np.asarray(np.linalg.inv(np.eye(n) - half * a), dtype=np.float64)
        return inverse @ (np.eye(n) + half * a), sample_time * inverse @ inverse @ b, c, d + half * c @ inverse @ b
    phi = np.asarray(expm(a * sample_time), dtype=np.float64)
    level, now, after = _integrals(a, sample_time)
    if method == "zoh":
        return phi, level @ b, c, d
    return phi, (now + phi @ after) @ b, c, d + c @ after @ b


@dataclass(frozen=True, eq=False)
class Reduction:
    """A model with fewer states, by the same projection as its neighbours."""

    # (n, nx), (nx, n): ``A_r = left A right``
    left: FloatArray
    right: FloatArray
    values: FloatArray  # That decided: Hankel singular values, or what each mode does at most, largest first
    bound: float  # The error of the frequency response is nowhere larger (its largest singular value)
    error: float  # What it is at most on a grid of frequencies
    method: str

    def of(self, matrices: Matrices) -> Matrices:
        """Return the matrices with fewer states."""
        a, b, c, d = matrices
        return self.left @ a @ self.right, self.left @ b, c @ self.right, d

    def __str__(self) -> str:
        n, nx = self.left.shape
        return (
            f"{nx} states to {n} ({self.method}): the response is nowhere off by more than {self.bound:.3g}, "
            f"on a grid by {self.error:.3g}"
        )


def reduction(matrices: Matrices, order: int, method: Literal["balanced", "modal"] = "balanced") -> Reduction:
    """Return the projection to fewer states of a stable model in discrete time, and how far off the response may be.

    ``"balanced"`` keeps the directions with the largest Hankel singular values; the error is at most twice the sum of
    those left out, each counted once (Al-Saggaf & Franklin 1987, IEEE Trans. AC 32:815). ``"modal"`` keeps the modes
    that do most; the error is at most the sum of what the others do at their largest. Raises InputError if the order is
    not below that of the model, or the model is not stable.

    Examples
    --------
    >>> a = np.diag([0.9, 0.1])
    >>> found = reduction((a, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))), 1)
    >>> found.error <= found.bound < 1.5
    True
    """
    a, b, c, d = matrices
    nx = len(a)
    radius = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))
    if not 1 <= order < nx or radius >= 1.0 or method not in ("balanced", "modal"):
        raise InputError(
            "reduction of a model",
            expected=f"an order from 1 to {nx - 1} of a stable model, balanced or modal",
            got=f"order {order}, spectral radius {radius:.4g}, {method}",
            remedy="lower the order, or fit a stable model (stable = true)",
        )
    left, right, values, bound = (_balanced if method == "balanced" else _modal)(matrices, order)
    small = (left @ a @ right, left @ b, c @ right, d)
    f = np.concatenate([np.linspace(0.0, 0.5, 400), np.geomspace(1e-5, 0.5, 200)])
    error = float(np.linalg.norm(gains(matrices, f, 1.0) - gains(small, f, 1.0), 2, axis=(1, 2)).max())
    return Reduction(left, right, values, bound, error, method)


def _balanced(matrices: Matrices, order: int) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the projection on the leading directions of the balanced model (Laub et al. 1987)."""
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c, _ = matrices
    roots = []
    for one, driven in ((a, b @ b.T), (a.T, c.T @ c)):
        gramian = solve_discrete_lyapunov(one, driven)
        values, vectors = np.linalg.eigh(0.5 * (gramian + gramian.T))
        roots.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    left, values, right = np.linalg.svd(roots[1].T @ roots[0])
    kept = np.maximum(values[:order], 1e-300)
    back = (roots[1] @ left[:, :order] / np.sqrt(kept)).T
    there = roots[0] @ right[:order].T / np.sqrt(kept)
    return back, there, np.asarray(values), 2.0 * float(values[order:].sum())


def _modal(matrices: Matrices, order: int) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the projection on the modes that do most, pairs together."""
    a, b, c, _ = matrices
    poles, vectors = np.linalg.eig(a)
    back = np.linalg.inv(vectors)
    does = np.linalg.norm(c @ vectors, axis=0) * np.linalg.norm(back @ b, axis=1) / (1.0 - np.abs(poles))
    ranked = np.argsort(-does, kind="stable")
    kept: list[int] = []
    for k in ranked:
        pair = [int(k)]
        if abs(poles[k].imag) > 0:
            pair.append(int(np.argmin(np.abs(poles - np.conj(poles[k])))))
        if k not in kept and len(kept) + len(pair) <= order:
            kept += pair
    rows, columns = [], []
    for k in kept:
        if poles[k].imag > 0:
            columns += [vectors[:, k].real, vectors[:, k].imag]
            rows += [2 * back[k].real, -2 * back[k].imag]
        elif poles[k].imag == 0:
            columns.append(vectors[:, k].real)
            rows.append(back[k].real)
    rest = np.setdiff1d(np.arange(len(poles)), kept)
    return np.array(rows), np.array(columns).T, np.asarray(does[ranked]), float(does[rest].sum())


def _integrals(ac: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a held input adds over a sample, and what a straight one does by its value now and the next."""
    from scipy.linalg import expm

    n = len(ac)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n], block[:n, n : 2 * n], block[n : 2 * n, 2 * n :] = ac, np.eye(n), np.eye(n)
    found = np.asarray(expm(block * step), dtype=np.float64)
    level, slope = found[:n, n : 2 * n], found[:n, 2 * n :] / step
    return level, level - slope, slope


def _matched(matrices: Matrices, sample_time: float, *, back: bool) -> Matrices:
    """Return the system whose poles and zeros are mapped by exp or log, of the same gain at frequency 0."""
    from scipy.linalg import block_diag, eigvals
    from scipy.signal import zpk2ss

    if matrices[1].shape[1] != 1 or matrices[2].shape[0] != 1:
        raise InputError(
            "conversion by matched poles and zeros",
            expected="one input and one output",
            got=f"{matrices[1].shape[1]} and {matrices[2].shape[0]}",
            remedy="use zoh, foh or tustin",
        )
    n = len(matrices[0])
    poles = np.linalg.eigvals(matrices[0])
    pencil = np.block([[matrices[0], matrices[1]], [matrices[2], matrices[3]]])
    zeros = eigvals(pencil, block_diag(np.eye(n), np.zeros((1, 1))))
    zeros = zeros[np.isfinite(zeros) & (np.abs(zeros) < INFINITE * (1.0 + np.abs(poles).max(initial=0.0)))]
    at = np.array([0.0]) if not back else np.array([1.0])
    if back:
        zeros = np.array([z for z in zeros if abs(z) > SMALL and not (z.real < 0 and abs(z.imag) < SMALL)])
        new_zeros, new_poles = np.log(zeros.astype(complex)) / sample_time, np.log(poles.astype(complex)) / sample_time
    else:
        new_zeros, new_poles = np.exp(zeros * sample_time), np.exp(poles * sample_time)
        # zeros at infinity go to -1 but one, so that the output does not answer at once
        new_zeros = np.concatenate([new_zeros, -np.ones(max(len(poles) - len(zeros) - 1, 0))])
    if np.any(np.abs(poles - at[0]) < SMALL):
        raise InputError(
            "conversion by matched poles and zeros",
            expected="a model that settles",
            got="an integrator",
            remedy="use zoh, foh or tustin",
        )
    a, b, c, d = matrices
    static = (c @ np.linalg.solve(at[0] * np.eye(len(a)) - a, b) + d)[0, 0]
    new_at = 0.0 if back else 1.0
    unit = np.prod(new_at - new_zeros) / np.prod(new_at - new_poles)
    found = zpk2ss(new_zeros, new_poles, float(np.real(static / unit)))
    aa, bb, cc, dd = (np.asarray(part, dtype=np.float64) for part in found)
    return aa, bb, cc, dd
