"""Polynomial models ``A y = B/F u + C/D e`` of one output: prediction errors, gradients, and a state-space form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray

__all__ = ["Orders", "Part", "Polynomials", "block_form", "errors_and_gradients"]


@dataclass(frozen=True)
class Orders:
    """Degrees of A, C, D, F, number of coefficients of each B, and the delay of the inputs in samples."""

    na: int = 0
    nb: int = 0
    nc: int = 0
    nd: int = 0
    nf: int = 0
    delay: int = 1

    @property
    def start_x(self) -> int:
        """Coefficients of the free response of B/F at the start of a record."""
        return max(self.nf, self.nb + self.delay - 1) if self.nf else 0

    @property
    def start_z(self) -> int:
        """Coefficients of the unknown past of the other polynomials at the start of a record."""
        if self.nf:
            return max(self.nc, self.nd, self.na)
        return max(self.na, self.nb + self.delay - 1, self.nc, self.nd)


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Coefficients after the leading 1: a (na,), b (nu, nb), c (nc,), d (nd,), f (nf,), and the level of the output."""

    orders: Orders
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    f: FloatArray
    level: float

    @classmethod
    def of(cls, theta: FloatArray, orders: Orders, nu: int) -> Polynomials:
        """Return the polynomials of a parameter vector ``[a, b (input by input), c, d, f, level]``."""
        cuts = np.cumsum([orders.na, nu * orders.nb, orders.nc, orders.nd, orders.nf])
        a, b, c, d, f, level = np.split(theta[: cuts[-1] + 1], cuts)
        return cls(orders, a, b.reshape(nu, orders.nb), c, d, f, float(level[0]))

    @property
    def vector(self) -> FloatArray:
        """The parameter vector."""
        return np.concatenate([self.a, self.b.ravel(), self.c, self.d, self.f, [self.level]])

    @property
    def radii(self) -> tuple[float, float, float]:
        """Largest moduli of the roots of F, of C and of D."""
        return _radius(self.f), _radius(self.c), _radius(self.d)

    @property
    def slowest(self) -> float:
        """Largest modulus of the poles: the roots of A, F and D."""
        return max(_radius(self.a), _radius(self.f), _radius(self.d))


@dataclass(frozen=True, eq=False)
class Part:
    """One record of one output: u (N, nu), y (N,)."""

    u: FloatArray
    y: FloatArray


def errors_and_gradients(
    model: Polynomials, starts: Sequence[tuple[FloatArray, FloatArray]], parts: Sequence[Part]
) -> tuple[FloatArray, FloatArray]:
    """Return prediction errors (N,) over all records and their gradients (N, p + starts).

    With ``w = (B u + X delta) / F``, ``v = A (y - level) - w`` the error is ``e = (D v + Z delta) / C`` (Ljung 1999,
    eq. 4.35 and 10.53); the free responses X and Z to a pulse at the first sample stand for what happened before.

    Parameters
    ----------
    model : Polynomials
    starts : sequence of (X (start_x,), Z (start_z,))
        One pair a record.
    parts : sequence of Part
    """
    from scipy.signal import lfilter

    orders, rows, columns = model.orders, [], []
    one = np.ones(1)
    pa, pc, pd, pf = (np.concatenate([one, p]) for p in (model.a, model.c, model.d, model.f))
    count = model.vector.size
    nx, nz = orders.start_x, orders.start_z
    for number, (part, (x, z)) in enumerate(zip(parts, starts, strict=True)):
        n, nu = part.u.shape
        pulse = np.zeros(n)
        pulse[0] = 1.0
        driven = np.zeros(n)
        for i in range(nu):
            driven += np.convolve(_shifted(part.u[:, i], orders.delay), model.b[i])[:n] if orders.nb else 0.0
        driven[: min(nx, n)] += x[:n]
        w = lfilter(one, pf, driven)
        y = part.y - model.level
        v = lfilter(pa, one, y) - w
        filtered = lfilter(pd, one, v)
        filtered[: min(nz, n)] += z[:n]
        rows.append(lfilter(one, pc, filtered))
        gradient = np.zeros((n, count + len(parts) * (nx + nz)))
        place = 0
        base = lfilter(pd, pc, y) if orders.na else y
        for j in range(1, orders.na + 1):
            gradient[:, place] = _shifted(base, j)
            place += 1
        for i in range(nu):
            base = lfilter(pd, np.convolve(pc, pf), part.u[:, i])
            for j in range(orders.nb):
                gradient[:, place] = -_shifted(base, orders.delay + j)
                place += 1
        base = lfilter(one, pc, rows[-1])
        for j in range(1, orders.nc + 1):
            gradient[:, place] = -_shifted(base, j)
            place += 1
        base = lfilter(one, pc, v)
        for j in range(1, orders.nd + 1):
            gradient[:, place] = _shifted(base, j)
            place += 1
        base = lfilter(pd, np.convolve(pc, pf), w)
        for j in range(1, orders.nf + 1):
            gradient[:, place] = _shifted(base, j)
            place += 1
        gradient[:, place] = -lfilter(np.convolve(pd, pa), pc, np.ones(n))
        place = count + number * (nx + nz)
        base = lfilter(pd, np.convolve(pc, pf), pulse)
        for j in range(nx):
            gradient[:, place + j] = -_shifted(base, j)
        base = lfilter(one, pc, pulse)
        for j in range(nz):
            gradient[:, place + nx + j] = _shifted(base, j)
        columns.append(gradient)
    return np.concatenate(rows), np.concatenate(columns)


def block_form(
    models: Sequence[Polynomials], nu: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D, K, level of the outputs' models side by side, each in observer canonical form.

    Output i: ``y = (B D / P) u + (C F / P) e`` with ``P = A F D``.
    """
    blocks, one = [], np.ones(1)
    for model in models:
        pa, pc, pd, pf = (np.concatenate([one, p]) for p in (model.a, model.c, model.d, model.f))
        bottom = np.convolve(np.convolve(pa, pf), pd)
        tops = [
            np.concatenate([np.zeros(model.orders.delay), np.convolve(model.b[i], pd)]) if model.orders.nb else one * 0
            for i in range(nu)
        ]
        noise = np.convolve(pc, pf)
        n = max(1, *(p.size - 1 for p in (bottom, noise, *tops)))
        bottom, noise, *tops = (np.pad(p, (0, n + 1 - p.size)) for p in (bottom, noise, *tops))
        a = np.eye(n, k=1)
        a[:, 0] = -bottom[1:]
        b = np.array([top[1:] - bottom[1:] * top[0] for top in tops]).reshape(nu, n).T
        direct = np.array([top[0] for top in tops])
        blocks.append((a, b, direct, noise[1:] - bottom[1:]))
    sizes = [len(block[0]) for block in blocks]
    nx, ny = sum(sizes), len(blocks)
    big_a, big_k, big_c = np.zeros((nx, nx)), np.zeros((nx, ny)), np.zeros((ny, nx))
    place = 0
    for i, (a, _, _, k) in enumerate(blocks):
        rows = slice(place, place + sizes[i])
        big_a[rows, rows], big_k[rows, i], big_c[i, place] = a, k, 1.0
        place += sizes[i]
    big_b = np.vstack([block[1] for block in blocks])
    big_d = np.array([block[2] for block in blocks]).reshape(ny, nu)
    return big_a, big_b, big_c, big_d, big_k, np.array([model.level for model in models])


def _shifted(signal: FloatArray, lag: int) -> FloatArray:
    """Return the signal some samples later, zeros before."""
    if lag == 0:
        return signal
    late = np.zeros_like(signal)
    late[lag:] = signal[:-lag]
    return late


def _radius(coefficients: FloatArray) -> float:
    """Return the largest modulus of a root of ``1 + c1 q^-1 + ...``."""
    if not np.isfinite(coefficients).all():
        return float("inf")
    return float(np.abs(np.roots(np.concatenate([[1.0], coefficients]))).max(initial=0.0))
