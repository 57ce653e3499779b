"""Rational functions of s with one denominator and dead times, and what they are when sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

Hold = Literal["zoh", "foh"]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Rational:
    """``G_j(s) = exp(-s delay_j) B_j(s) / A(s)`` with ``A = s^n + a_1 s^(n-1) + ...``, s in units of ``rate``."""

    a: FloatArray  # (n,): After the leading 1, of ``s / rate``
    b: FloatArray  # (nu, m + 1): Highest power first, of ``s / rate``
    delay: FloatArray  # (nu,): [s]
    rate: float  # [rad/s] near the dynamics: powers of s of other sizes would make the equations ill-conditioned

    @property
    def vector(self) -> FloatArray:
        """The parameters ``[a, b (input by input), delay times rate]``."""
        return np.concatenate([self.a, self.b.ravel(), self.delay * self.rate])

    def moved(self, vector: FloatArray) -> Rational:
        """Return the function of another parameter vector."""
        n, nb = self.a.size, self.b.size
        a, b, delay = np.split(vector, [n, n + nb])
        return Rational(a, b.reshape(self.b.shape), delay / self.rate, self.rate)

    @property
    def denominator(self) -> FloatArray:
        """Coefficients of A(s) in seconds, highest power first, monic."""
        return _in_seconds(np.concatenate([[1.0], self.a]), self.rate, self.a.size)

    @property
    def numerators(self) -> FloatArray:
        """Coefficients of every B_j(s) in seconds (nu, m + 1), highest power first."""
        return np.array([_in_seconds(b, self.rate, self.a.size) for b in self.b])

    @property
    def poles(self) -> ComplexArray:
        """Roots of A [rad/s]."""
        return np.asarray(np.roots(np.concatenate([[1.0], self.a])) * self.rate, dtype=np.complex128)

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return G at frequencies [Hz], (F, nu)."""
        s = 2j * np.pi * np.asarray(frequency, dtype=float)
        bottom = np.polyval(np.concatenate([[1.0], self.a]), s / self.rate)
        tops = np.stack([np.polyval(b, s / self.rate) for b in self.b], axis=-1)
        return np.asarray(tops / bottom[:, None] * np.exp(-s[:, None] * self.delay), dtype=np.complex128)

    def gradients(self, frequency: FloatArray) -> ComplexArray:
        """Return the derivatives of :meth:`response` by the parameter vector, (F, nu, k)."""
        s = 2j * np.pi * np.asarray(frequency, dtype=float)
        small, n, (nu, nb) = s / self.rate, self.a.size, self.b.shape
        bottom = np.polyval(np.concatenate([[1.0], self.a]), small)
        g = self.response(frequency)
        found = np.zeros((s.size, nu, n + nu * nb + nu), dtype=np.complex128)
        powers = small[:, None] ** np.arange(n - 1, -1, -1)
        found[:, :, :n] = -g[:, :, None] * (powers / bottom[:, None])[:, None, :]
        late = np.exp(-s[:, None] * self.delay)
        tops = small[:, None] ** np.arange(nb - 1, -1, -1) / bottom[:, None]
        for j in range(nu):
            found[:, j, n + j * nb : n + (j + 1) * nb] = tops * late[:, j, None]
            found[:, j, n + nu * nb + j] = -small * g[:, j]
        return found


def _in_seconds(coefficients: FloatArray, rate: float, order: int) -> FloatArray:
    """Return coefficients of powers of s from those of s / rate, both sides times rate^order."""
    powers = np.arange(coefficients.size - 1, -1, -1)
    return np.asarray(coefficients * rate ** (order - powers.astype(float)), dtype=np.float64)


def sampled(
    model: Rational, sample_time: float, hold: Hold = "zoh"
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D of the model between samples of inputs that are held, or straight between samples.

    Exact for any dead time: the input is constant (or straight) on the parts of an interval before and after the
    fraction of a sample by which it is late (Astrom & Wittenmark 1997, sec. 2.3, for the hold of order zero).

    - ``model``: strictly proper
    - ``sample_time``: [s]
    - ``hold`` {"zoh", "foh"}

    Examples
    --------
    >>> first = Rational(np.array([1.0]), np.array([[1.0]]), np.array([0.0]), 2.0)
    >>> a, b, c, d = sampled(first, 0.1)
    >>> float(a[0, 0].round(6)), float((c @ b)[0, 0].round(6)), float(1 - np.exp(-0.2).round(6))
    (0.818731, 0.181269, 0.181269)
    """
    phi, pieces = held(model, sample_time, hold)
    # a dead time keeps the sample before, also where it is a whole number of samples: the form does not jump
    inputs = [(d, bool(late > 0), now, old, at) for (d, now, old, at), late in zip(pieces, model.delay, strict=True)]
    c = np.zeros((1, len(phi)))
    c[0, 0] = 1.0
    return _with_chains(phi, c, inputs)


def held(
    model: Rational, sample_time: float, hold: Hold
) -> tuple[FloatArray, list[tuple[int, FloatArray, FloatArray, float]]]:
    """Return the transition over a sample and, by input, its whole delay d, and what u[k-d], u[k-d-1] add.

    The last number of each is what ``u[k-d]`` adds to the output at once; the output is the first state.
    """
    from scipy.linalg import expm

    n, nu = model.a.size, len(model.b)
    ac = np.eye(n, k=1)
    ac[:, 0] = -model.a  # observer form
    ac *= model.rate
    tops = np.zeros((nu, n))
    tops[:, n - model.b.shape[1] :] = model.b
    whole = np.maximum(np.floor(model.delay / sample_time + 1e-9), 0).astype(int)
    phi = np.asarray(expm(ac * sample_time), dtype=np.float64)
    pieces = []
    for j in range(nu):
        late = max(float(model.delay[j]) - whole[j] * sample_time, 0.0)
        before, now, after = _moved_by(ac, tops[j] * model.rate, late, sample_time, hold)
        # x~ = x - after v[k]: what comes at the end of the interval is in the output of the next sample
        pieces.append((int(whole[j]), now + phi @ after, before, float(after[0])))
    return phi, pieces


def _moved_by(
    ac: FloatArray, b: FloatArray, late: float, step: float, hold: Hold
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what inputs v[k-1], v[k], v[k+1] add to the state over a sample if the input is late by a fraction."""
    from scipy.linalg import expm

    n = len(ac)
    block = np.zeros((n + 2, n + 2))
    block[:n, :n], block[:n, n], block[n, n + 1] = ac, b, 1.0

    def part(length: float) -> tuple[FloatArray, FloatArray]:
        found = expm(block * length)  # integrals of exp(A (h - s)) b and of the same times s
        return np.asarray(found[:n, n]), np.asarray(found[:n, n + 1])

    rest = step - late
    (level1, slope1), (level2, slope2) = part(late), part(rest)
    on = expm(ac * rest)
    if hold == "zoh":
        return on @ level1, level2, np.zeros(n)
    share = 1.0 - late / step  # of v[k] in the input at the start of the interval
    before = on @ ((1.0 - share) * level1 - slope1 / step)
    now = on @ (share * level1 + slope1 / step) + level2 - slope2 / step
    return before, now, slope2 / step


def _with_chains(
    phi: FloatArray, c: FloatArray, inputs: list[tuple[int, bool, FloatArray, FloatArray, float]]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D with a chain of past samples for each input: v[k] = u[k - d], d its whole delay."""
    n, nu = len(phi), len(inputs)
    lengths = [delay + int(more or bool(np.any(before))) for delay, more, _, before, _ in inputs]
    size = n + sum(lengths)
    a, b, cc, d = np.zeros((size, size)), np.zeros((size, nu)), np.zeros((1, size)), np.zeros((1, nu))
    a[:n, :n], cc[:, :n] = phi, c
    place = n
    for j, (delay, _, now, before, direct) in enumerate(inputs):
        length = lengths[j]
        if length:
            b[place, j] = 1.0
            a[place + 1 : place + length, place : place + length - 1] = np.eye(length - 1)
        if delay:
            a[:n, place + delay - 1] += now
            cc[0, place + delay - 1] += direct
        else:
            b[:n, j] += now
            d[0, j] += direct
        if length > delay:
            a[:n, place + delay] += before
        place += length
    return a, b, cc, d
