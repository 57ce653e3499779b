"""Polynomial models ``A y = sum B_i/F_i u_i + C/D e`` of one output: prediction errors, gradients, state-space form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.signals import FloatArray


@dataclass(frozen=True)
class Orders:
    """Degrees of A, C, D; of every input the coefficients of B and its delay; of every F its degree.

    Parameters
    ----------
    na, nc, nd : int
    nb, nk : tuple of int
        One for each input; ``nk`` in samples.
    nf : tuple of int
        None, one F for all inputs, or one for each.
    """

    na: int = 0
    nb: tuple[int, ...] = ()
    nc: int = 0
    nd: int = 0
    nf: tuple[int, ...] = ()
    nk: tuple[int, ...] = ()

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.nb)

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Inputs that share a denominator."""
        if len(self.nf) > 1:
            return tuple((i,) for i in range(self.nu))
        return (tuple(range(self.nu)),) if self.nu else ()

    @property
    def degrees(self) -> tuple[int, ...]:
        """Degree of F of every group."""
        return self.nf or tuple(0 for _ in self.groups)

    @property
    def count(self) -> int:
        """Number of coefficients, the level among them."""
        return self.na + sum(self.nb) + self.nc + self.nd + sum(self.nf) + 1

    @property
    def starts_x(self) -> tuple[int, ...]:
        """Of every group, the coefficients of the free response of B/F at the start of a record.

        As many as the degree of F, and for what inputs before the record still do as many more as they reach beyond
        that: of the group with most of them alone, for they are pulses, the same for all.
        """
        more = [self._reach(group) - n if n else 0 for n, group in zip(self.degrees, self.groups, strict=True)]
        most = int(np.argmax(more)) if more else 0
        return tuple(
            n + (max(extra, 0) if g == most else 0) for g, (n, extra) in enumerate(zip(self.degrees, more, strict=True))
        )

    @property
    def start_x(self) -> int:
        """Coefficients of these free responses together."""
        return sum(self.starts_x)

    @property
    def start_z(self) -> int:
        """Coefficients of the unknown past of the other polynomials at the start of a record."""
        plain = [self._reach(group) for n, group in zip(self.degrees, self.groups, strict=True) if not n]
        return max(self.na, self.nc, self.nd, *plain, 0)

    def _reach(self, group: Sequence[int]) -> int:
        """Return how many samples the inputs of a group reach back."""
        return max((self.nb[i] + self.nk[i] - 1 for i in group if self.nb[i]), default=0)


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Coefficients after the leading 1: a (na,), b (nb,) by input, c (nc,), d (nd,), f (nf,) by group; level of y."""

    orders: Orders
    a: FloatArray
    b: tuple[FloatArray, ...]
    c: FloatArray
    d: FloatArray
    f: tuple[FloatArray, ...]
    level: float

    @classmethod
    def of(cls, theta: FloatArray, orders: Orders) -> Polynomials:
        """Return the polynomials of a parameter vector ``[a, b (input by input), c, d, f (by group), level]``."""
        sizes = [orders.na, *orders.nb, orders.nc, orders.nd, *orders.nf]
        parts = np.split(theta[: orders.count], np.cumsum(sizes))
        nu = orders.nu
        a, c, d, level = parts[0], parts[1 + nu], parts[2 + nu], parts[-1]
        return cls(orders, a, tuple(parts[1 : 1 + nu]), c, d, tuple(parts[3 + nu : -1]), float(level[0]))

    @property
    def vector(self) -> FloatArray:
        """The parameter vector."""
        return np.concatenate([self.a, *self.b, self.c, self.d, *self.f, [self.level]])

    @property
    def denominators(self) -> list[FloatArray]:
        """F of every group, its leading 1 among the coefficients."""
        found = self.f or tuple(np.zeros(0) for _ in self.orders.groups)
        return [np.concatenate([[1.0], f]) for f in found]

    @property
    def radii(self) -> tuple[float, float, float]:
        """Largest moduli of the roots of F, of C and of D."""
        return max((_radius(f) for f in self.f), default=0.0), _radius(self.c), _radius(self.d)

    @property
    def slowest(self) -> float:
        """Largest modulus of the poles: the roots of A, F and D."""
        return max(_radius(self.a), self.radii[0], _radius(self.d))

    def to_dict(self) -> dict[str, list[float] | list[list[float]] | list[int] | float]:
        """Return the coefficients by letter; F as one list where the inputs share it, and the delays."""
        f = [one.tolist() for one in self.f]
        return {
            "a": self.a.tolist(),
            "b": [one.tolist() for one in self.b],
            "c": self.c.tolist(),
            "d": self.d.tolist(),
            "f": f if len(f) > 1 else (f[0] if f else []),
            "nk": list(self.orders.nk),
            "level": self.level,
        }


@dataclass(frozen=True, eq=False)
class OutputRecord:
    """One record of one output: u (N, nu), y (N,), and the rows where y was not read (m,)."""

    u: FloatArray
    y: FloatArray
    holes: tuple[int, ...] = ()


def errors_and_gradients(
    model: Polynomials, starts: Sequence[tuple[FloatArray, FloatArray]], parts: Sequence[OutputRecord]
) -> tuple[FloatArray, FloatArray]:
    """Return prediction errors (N,) over all records and their gradients (N, p + starts).

    With ``w_i = (B_i u_i + X_i delta) / F_i``, ``v = A (y - level) - sum w_i`` the error is ``e = (D v + Z delta) / C``
    (Ljung 1999, eq. 4.35 and 10.53); the free responses X and Z to a pulse at the first sample stand for what happened
    before.

    - ``starts`` sequence of (X (start_x,), Z (start_z,)): one pair a record; X group by group
    """
    total = sum(part.y.size for part in parts)
    nx, nz, count = model.orders.start_x, model.orders.start_z, model.orders.count
    errors, gradients = np.empty(total), np.zeros((total, count + len(parts) * (nx + nz)))
    place = 0
    for number, (part, start) in enumerate(zip(parts, starts, strict=True)):
        rows = slice(place, place + part.y.size)
        first = count + number * (nx + nz)
        errors[rows], own = _of_part(model, start, part)
        gradients[rows, :count], gradients[rows, first : first + nx + nz] = own[:, :count], own[:, count:]
        place += part.y.size
    return errors, gradients


def _of_part(
    model: Polynomials, start: tuple[FloatArray, FloatArray], part: OutputRecord
) -> tuple[FloatArray, FloatArray]:
    """Return errors and gradients (N, p + start) of one record."""
    from scipy.signal import lfilter

    orders, n, one = model.orders, part.y.size, np.ones(1)
    pa, pc, pd = (np.concatenate([one, p]) for p in (model.a, model.c, model.d))
    denominators, nz = model.denominators, model.orders.start_z
    responses = []
    for g, (group, pf) in enumerate(zip(orders.groups, denominators, strict=True)):
        driven = np.zeros(n)
        for i in group:
            if orders.nb[i]:
                driven += np.convolve(shifted(part.u[:, i], orders.nk[i]), model.b[i])[:n]
        first = sum(orders.starts_x[:g])
        own = start[0][first : first + orders.starts_x[g]][:n]
        driven[: own.size] += own
        responses.append(lfilter(one, pf, driven))
    y = part.y - model.level
    v = lfilter(pa, one, y) - sum(responses, np.zeros(n))
    filtered = lfilter(pd, one, v)
    filtered[: min(nz, n)] += start[1][:n]
    error = lfilter(one, pc, filtered)

    columns: list[FloatArray] = []
    base = lfilter(pd, pc, y) if orders.na else y
    columns += [shifted(base, j) for j in range(1, orders.na + 1)]
    group_of = {i: g for g, group in enumerate(orders.groups) for i in group}
    for i in range(orders.nu):
        base = lfilter(pd, np.convolve(pc, denominators[group_of[i]]), part.u[:, i]) if orders.nb[i] else y
        columns += [-shifted(base, orders.nk[i] + j) for j in range(orders.nb[i])]
    base = lfilter(one, pc, error)
    columns += [-shifted(base, j) for j in range(1, orders.nc + 1)]
    base = lfilter(one, pc, v)
    columns += [shifted(base, j) for j in range(1, orders.nd + 1)]
    for degree, w, pf in zip(orders.degrees, responses, denominators, strict=True):
        base = lfilter(pd, np.convolve(pc, pf), w) if degree else w
        columns += [shifted(base, j) for j in range(1, degree + 1)]
    columns.append(-lfilter(np.convolve(pd, pa), pc, np.ones(n)))
    pulse = np.zeros(n)
    pulse[0] = 1.0
    for size, pf in zip(orders.starts_x, denominators, strict=True):
        base = lfilter(pd, np.convolve(pc, pf), pulse)
        columns += [-shifted(base, j) for j in range(size)]
    base = lfilter(one, pc, pulse)
    columns += [shifted(base, j) for j in range(nz)]
    return error, np.column_stack(columns)


def block_form(
    models: Sequence[Polynomials],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D, K, level of the outputs' models side by side, each in observer canonical form.

    Output i: ``y = (B_j D prod_(l != j) F_l / P) u_j + (C prod F / P) e`` with ``P = A D prod F``.
    """
    blocks, one = [], np.ones(1)
    for model in models:
        orders = model.orders
        pa, pc, pd = (np.concatenate([one, p]) for p in (model.a, model.c, model.d))
        denominators = model.denominators
        every = _product(denominators)
        bottom = np.convolve(np.convolve(pa, every), pd)
        group_of = {i: g for g, group in enumerate(orders.groups) for i in group}
        tops = []
        for i in range(orders.nu):
            others = _product([f for g, f in enumerate(denominators) if g != group_of[i]])
            own = np.concatenate([np.zeros(orders.nk[i]), np.convolve(model.b[i], np.convolve(pd, others))])
            tops.append(own if orders.nb[i] else one * 0)
        noise = np.convolve(pc, every)
        n = max(1, *(p.size - 1 for p in (bottom, noise, *tops)))
        bottom, noise, *tops = (np.pad(p, (0, n + 1 - p.size)) for p in (bottom, noise, *tops))
        a = np.eye(n, k=1)
        a[:, 0] = -bottom[1:]
        b = np.array([top[1:] - bottom[1:] * top[0] for top in tops]).reshape(orders.nu, n).T
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
    big_d = np.array([block[2] for block in blocks]).reshape(ny, models[0].orders.nu)
    return big_a, big_b, big_c, big_d, big_k, np.array([model.level for model in models])


def shifted(signal: FloatArray, lag: int) -> FloatArray:
    """Return the signal some samples later, zeros before."""
    if lag == 0:
        return signal
    late = np.zeros_like(signal)
    late[lag:] = signal[:-lag]
    return late


def _product(polynomials: Sequence[FloatArray]) -> FloatArray:
    """Return the product of polynomials."""
    found = np.ones(1)
    for polynomial in polynomials:
        found = np.convolve(found, polynomial)
    return found


def _radius(coefficients: FloatArray) -> float:
    """Return the largest modulus of a root of ``1 + c1 q^-1 + ...``."""
    if not np.isfinite(coefficients).all():
        return float("inf")
    return float(np.abs(np.roots(np.concatenate([[1.0], coefficients]))).max(initial=0.0))
