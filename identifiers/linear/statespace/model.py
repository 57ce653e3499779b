"""State-space plants whose outputs carry noise of any colour: prediction errors, and how they move with the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from harness.signals import FloatArray

Spectrum = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class StateSpace:
    """``x+ = A x + B u``, ``y = C x + D u + level + v``, and the noise ``v_i + d_i1 v_i[k-1] + ... = e_i``."""

    # (n, n), (n, nu), (ny, n), (ny, nu)
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    level: FloatArray  # (ny,)
    noise: FloatArray  # (ny, p): Coefficients of each output's noise; none is white noise

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def radius(self) -> float:
        """Largest modulus of a pole of the plant."""
        return float(np.abs(np.linalg.eigvals(self.a)).max(initial=0.0))

    @property
    def memory(self) -> float:
        """Largest modulus of a pole of the noise."""
        if not self.noise.shape[1]:
            return 0.0
        return max(float(np.abs(np.roots(np.concatenate([[1.0], one]))).max(initial=0.0)) for one in self.noise)

    def free(self, *, direct: int, offset: bool) -> int:
        """Return the number of parameters that the data decide: coordinates of the state are none."""
        (n, nu), ny = self.b.shape, len(self.c)
        return int(n * (nu + ny) + ny * direct + ny * offset + self.noise.size)

    def moved(self, step: FloatArray) -> StateSpace:
        """Return the model a step ``[A, B, C, D, level, noise]`` away, each row by row."""
        (n, nu), ny = self.b.shape, len(self.c)
        parts = np.split(step, np.cumsum([n * n, n * nu, ny * n, ny * nu, ny]))
        return StateSpace(
            self.a + parts[0].reshape(n, n),
            self.b + parts[1].reshape(n, nu),
            self.c + parts[2].reshape(ny, n),
            self.d + parts[3].reshape(ny, nu),
            self.level + parts[4],
            self.noise + parts[5].reshape(self.noise.shape),
        )


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of a record: u (N, nu), y (N, ny), and which readings there are (N, ny); None where all are."""

    u: FloatArray
    y: FloatArray
    read: npt.NDArray[np.bool_] | None = None

    @cached_property
    def length(self) -> int:
        """Samples of the transforms: signals that are filtered by responses as long as they are do not wrap."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(2 * len(self.u), real=True))

    @cached_property
    def spectrum(self) -> Spectrum:
        """Of the inputs."""
        from scipy.fft import rfft

        return np.asarray(rfft(self.u, self.length, axis=0))

    def counted(self, lags: int) -> npt.NDArray[np.bool_]:
        """Return which prediction errors of a noise of so many lags stand on readings alone (N, ny)."""
        found = np.ones(self.y.shape, dtype=bool) if self.read is None else self.read.copy()
        found[:lags] = False
        if self.read is not None:
            for j in range(1, lags + 1):
                found[j:] &= self.read[:-j]
        return found


@dataclass(frozen=True, eq=False)
class Errors:
    """Of one piece: prediction errors and what the plant leaves of the outputs (N, ny), the states (N, n).

    Parameters
    ----------
    innovations, left, states : array
    counted : array of bool (N, ny)
        Which prediction errors count; the others are zero.
    read : array of int (ny,)
        Readings of each output.
    """

    innovations: FloatArray
    left: FloatArray
    states: FloatArray
    counted: npt.NDArray[np.bool_]
    read: npt.NDArray[np.int_]


def responses_to(a: FloatArray, rows: FloatArray, samples: int) -> FloatArray:
    """Return ``rows A^k`` for k = 0 .. samples - 1, by doubling: (samples, r, n)."""
    found = np.empty((samples, *rows.shape))
    found[0], have, power = rows, 1, a
    height, flat = len(rows), found.reshape(-1, rows.shape[1])  # one product of matrices, not one for each sample
    while have < samples:
        more = min(have, samples - have)
        np.matmul(flat[: more * height], power, out=flat[have * height : (have + more) * height])
        have += more
        if have < samples:
            power = power @ power
    return found


def errors_of(model: StateSpace, starts: FloatArray, pieces: Sequence[Piece]) -> list[Errors]:
    """Return the prediction errors of every piece from its initial state (R, n).

    States are convolutions of the inputs with the plant's responses, by transforms: exact but for rounding, whatever
    the poles, as long as what they do in a piece can be written as a number.
    """
    from scipy.fft import irfft, rfft

    found = []
    nu = model.b.shape[1]
    for piece, start in zip(pieces, starts, strict=True):
        n = len(piece.u)
        response = responses_to(model.a.T, np.vstack([model.b.T, start[None]]), n)
        driven = np.einsum("fj,fjn->fn", piece.spectrum, rfft(response[:, :nu], piece.length, axis=0))
        states = response[:, nu].copy()
        states[1:] += irfft(driven, piece.length, axis=0)[: n - 1]
        left = piece.y - states @ model.c.T - piece.u @ model.d.T - model.level
        innovations = _whitened(left, model.noise)
        counted = piece.counted(model.noise.shape[1])
        read = np.full(len(model.c), n) if piece.read is None else piece.read.sum(axis=0)
        found.append(Errors(np.where(counted, innovations, 0.0), left, states, counted, read))
    return found


def coordinates(model: StateSpace) -> FloatArray:
    """Return orthonormal directions (n n + n nu + ny n, q) of A, B, C that no change of coordinates of the state makes.

    Those that one makes, ``(E A - A E, E B, -C E)``, leave every response as it is: the search moves at right angles to
    them (McKelvey, Helmersson & Ribarits 2004, Automatica 40:1629, sec. 3).
    """
    n, eye = model.order, np.eye(model.order)
    turned = np.einsum("ai,jb->abij", eye, model.a) - np.einsum("ai,jb->abij", model.a, eye)
    pushed = np.einsum("ai,jb->abij", eye, model.b)
    seen = -np.einsum("ai,jb->abij", model.c, eye)
    tangent = np.concatenate([part.reshape(-1, n * n) for part in (turned, pushed, seen)])
    basis, _ = np.linalg.qr(tangent, mode="complete")
    return np.asarray(basis[:, n * n :], dtype=np.float64)


def gradients_of(
    model: StateSpace, errors: Errors, piece: Piece, directions: FloatArray, *, direct: int, offset: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the slopes of a piece's innovations (N, ny, q) along directions of the model, and (N, ny, n) of its start.

    Columns are the directions of A, B, C, then D (of so many leading inputs), level and noise; of what is not free they
    are zero. What a change of
    A and B does to the outputs is the change of what drives the states, filtered by the plant: all in one transform.
    """
    from scipy.fft import irfft, rfft

    (n, nu), ny = model.b.shape, len(model.c)
    samples, lags, q = len(piece.u), model.noise.shape[1], directions.shape[1]
    ab, c = n * n + n * nu, n * n + n * nu
    drive = np.concatenate(
        [directions[: n * n].reshape(n, n, q), directions[n * n : ab].reshape(n, nu, q)], axis=1
    ).reshape(ab, q)
    both = np.concatenate([rfft(errors.states, piece.length, axis=0), piece.spectrum], axis=1)
    response = responses_to(model.a, model.c, samples)
    found = np.zeros((samples, ny, q + ny * nu + ny + ny * lags))
    starts = np.empty((samples, ny, n))
    for i in range(ny):
        own = _whitened(response[:, i], np.broadcast_to(model.noise[i], (n, lags)))
        inner = (rfft(own, piece.length, axis=0)[:, :, None] * both[:, None]).reshape(len(both), -1)
        moved = inner.real @ drive + 1j * (inner.imag @ drive)
        found[1:, i, :q] = -irfft(moved, piece.length, axis=0)[: samples - 1]
        states = _whitened(errors.states, np.broadcast_to(model.noise[i], (n, lags)))
        found[:, i, :q] -= states @ directions[c + i * n : c + (i + 1) * n]
        starts[:, i] = -own
        if direct:
            place, now = q + i * nu, piece.u[:, :direct]
            found[:, i, place : place + direct] = -_whitened(now, np.broadcast_to(model.noise[i], (direct, lags)))
        if offset:
            found[:, i, q + ny * nu + i] = -_whitened(np.ones((samples, 1)), model.noise[i : i + 1])[:, 0]
        place = q + ny * nu + ny + i * lags
        for j in range(1, lags + 1):
            found[j:, i, place + j - 1] = errors.left[:-j, i]
    found *= errors.counted[:, :, None]
    starts *= errors.counted[:, :, None]
    return found, starts


def _whitened(signals: FloatArray, noise: FloatArray) -> FloatArray:
    """Return signals (N, m) filtered by their own polynomials (m, p) after a leading 1, nothing before the first."""
    if not noise.shape[1]:
        return signals
    found = signals.copy()
    for j in range(1, noise.shape[1] + 1):
        found[j:] += signals[:-j] * noise[:, j - 1]
    return found
