"""Ho-Kalman and eigensystem realization: a state-space model from Markov parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.filters import stationary_gain
from identifiers.linear import LinearModel
from identifiers.records import moving, real_signals, usable

__all__ = ["HoKalman", "markov_parameters", "realize"]


def markov_parameters(
    trajectories: Sequence[Trajectory], length: int, *, offset: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the impulse response of a finite-impulse-response model, by least squares.

    ``y[k] = sum_{i=0}^{length-1} G[i] u[k-i] + c`` for k >= length - 1 of every record: no window crosses a seam. The
    normal equations are block Toeplitz but for the ends of the records; they are summed by FFT correlations and the
    ends are corrected exactly.

    Parameters
    ----------
    trajectories : sequence of Trajectory
    length : int
        Number of Markov parameters, the direct term G[0] included.
    offset : bool
        Fit a constant output too.

    Returns
    -------
    G (length, ny, nu), c (ny,), residual rms (ny,)

    Raises
    ------
    FitError
        If the records are too short or the input does not excite so many lags.
    """
    what = "ho-kalman"
    records, spec = usable(trajectories, samples=length + 1, what=what)
    nu, ny = spec.nu, spec.ny
    size = length * nu + int(offset)
    rows = sum(len(one) - length + 1 for one in records)
    if rows < size:
        raise FitError(
            f"{what}: fewer equations than Markov parameters",
            expected=f"at least {size} windows of {length} samples",
            got=str(rows),
            remedy="record longer, or ask for fewer Markov parameters",
        )
    gram, right, square = np.zeros((size, size)), np.zeros((size, ny)), np.zeros(ny)
    for one in records:
        _accumulate(one, length, offset, gram, right, square)
    scale = np.sqrt(np.clip(np.diag(gram), 1e-300, None))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    if values[0] <= 1e-10 * values[-1]:
        rank = int(np.sum(values > 1e-10 * values[-1]))
        raise FitError(
            f"{what}: the input does not excite all lags",
            expected=f"persistent excitation of order {size}",
            got=f"rank {rank}",
            remedy="use a richer input (PRBS, more lines), or fewer Markov parameters",
        )
    theta = (vectors @ ((vectors.T @ (right / scale[:, None])) / values[:, None])) / scale[:, None]
    lost = square - np.einsum("ij,ij->j", theta, right)
    blocks = theta[: length * nu].reshape(length, nu, ny).transpose(0, 2, 1)
    return blocks, theta[-1] if offset else np.zeros(ny), np.sqrt(np.clip(lost, 0.0, None) / rows)


def _accumulate(
    record: Trajectory, length: int, offset: bool, gram: FloatArray, right: FloatArray, square: FloatArray
) -> None:
    """Add one record's normal equations: first block row by FFT, the others by moving the window of the sums.

    With S[i, j] = sum_k u[k-i] u[k-j]' over k = m-1 .. N-1 (m = length), S[i+1, j+1] is S[i, j] with the sample that
    enters at the front added and the one that leaves at the back removed.
    """
    u, y = record.u, record.y
    n, nu = u.shape
    m = length
    late = u[m - 1 :]
    first = _correlate(late, u, m)  # (m, nu, nu): sum_k u[k] u[k-j]'
    s = gram[: m * nu, : m * nu].reshape(m, nu, m, nu)
    corner = np.empty((m, m, nu, nu))
    corner[0] = first
    for i in range(1, m):
        corner[i, 0] = first[i].T
    # u[k-i-1] u[k-j-1]' for k = m-1..N-1 is u[k-i] u[k-j]' for k = m-2..N-2: row m-2 enters, row N-1 leaves.
    for i in range(1, m):
        entering = u[m - 1 - i][:, None] * u[m - 1 - np.arange(1, m)][:, None, :]
        leaving = u[n - i][:, None] * u[n - np.arange(1, m)][:, None, :]
        corner[i, 1:] = corner[i - 1, :-1] + entering - leaving
    s += corner.transpose(0, 2, 1, 3)
    right[: m * nu] += _correlate(y[m - 1 :], u, m).transpose(0, 2, 1).reshape(m * nu, -1)
    square += np.einsum("ij,ij->j", y[m - 1 :], y[m - 1 :])
    if offset:
        total = np.concatenate([np.zeros((1, nu)), np.cumsum(u, axis=0)])
        sums = (total[n - np.arange(m)] - total[m - 1 - np.arange(m)]).ravel()
        gram[-1, :-1] += sums
        gram[:-1, -1] += sums
        gram[-1, -1] += n - m + 1
        right[-1] += y[m - 1 :].sum(axis=0)


def _correlate(late: FloatArray, u: FloatArray, m: int) -> FloatArray:
    """Return sum_k late[k - (m - 1)] u[k - j]' over k = m-1 .. N-1 for j = 0 .. m-1, shape (m, nlate, nu)."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = u.shape[0]
    size = next_fast_len(n + m, real=True)
    a = rfft(late, size, axis=0)
    b = rfft(u, size, axis=0)
    both = irfft(np.conj(a)[:, :, None] * b[:, None, :], size, axis=0)  # lag l: sum_k late[k] u[k + l]
    result: FloatArray = both[m - 1 - np.arange(m)]
    return result


def realize(
    markov: FloatArray, *, order: int | None = None, rows: int | None = None, tolerance: float = 1e-8
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Realize Markov parameters as a balanced state-space model.

    Ho & Kalman 1966 (Regelungstechnik 14:545); Juang & Pappa 1985 (J. Guidance 8:620, eq. 18-21).

    Parameters
    ----------
    markov : array (M, ny, nu)
        G[1], G[2], ... (without the direct term).
    order : int, optional
        State dimension; by default the largest gap of the Hankel singular values above ``tolerance``.
    rows : int, optional
        Block rows of the Hankel matrix; by default half of the Markov parameters, which uses all of them.
    tolerance : float
        Singular values below this fraction of the largest count as zero.

    Returns
    -------
    A (n, n), B (n, nu), C (ny, n), Hankel singular values

    Examples
    --------
    >>> G = 0.5 ** np.arange(8)[:, None, None]
    >>> realize(G)[0].round(12)
    array([[0.5]])
    """
    count, ny, nu = markov.shape
    p = count // 2 if rows is None else rows
    q = count - p
    if p < 1 or q < 1:
        raise FitError(
            "ho-kalman: window of the Hankel matrix",
            expected=f"1 to {count - 1} block rows",
            got=str(p),
            remedy="ask for more Markov parameters",
        )
    index = np.arange(p)[:, None] + np.arange(q)
    hankel = markov[index].transpose(0, 2, 1, 3).reshape(p * ny, q * nu)
    shifted = markov[np.minimum(index + 1, count - 1)]
    shifted[(index + 1) >= count] = 0.0
    left, values, right = np.linalg.svd(hankel[:, : (q - 1) * nu] if q > 1 else hankel, full_matrices=False)
    if values[0] == 0:
        raise FitError("ho-kalman: no response", expected="Markov parameters", got="zeros", remedy="excite the plant")
    n = _gap(values, tolerance) if order is None else order
    if not 1 <= n <= values.size:
        raise FitError("ho-kalman: order", expected=f"1 to {values.size}", got=str(n), remedy="correct it")
    root = np.sqrt(values[:n])
    observe = left[:, :n] * root
    control = root[:, None] * right[:n]
    moved = hankel[:, nu:] if q > 1 else shifted.transpose(0, 2, 1, 3).reshape(p * ny, q * nu)
    a = (left[:, :n].T / root[:, None]) @ moved @ (right[:n].T / root)
    return a, control[:, :nu], observe[:ny], values


def _gap(values: FloatArray, tolerance: float) -> int:
    """Return the order at the largest relative gap of the singular values."""
    kept = values[values > tolerance * values[0]]
    if kept.size < values.size and kept.size <= max(1, values.size // 2):
        return max(1, int(kept.size))
    ratios = kept[:-1] / kept[1:]
    half = max(1, ratios.size // 2)
    return int(np.argmax(ratios[:half])) + 1 if ratios.size else 1


@dataclass(frozen=True)
class HoKalman:
    """Ho-Kalman identification: Markov parameters by least squares, then a balanced realization.

    Parameters
    ----------
    markov : int
        Number of Markov parameters estimated (impulse response over ``markov`` samples). The response must have died
        away by then.
    order : int, optional
        State dimension; by default from the largest gap of the Hankel singular values.
    rows : int, optional
        Block rows of the Hankel matrix.
    offset : bool
        Fit a constant output too.
    direct : bool
        Keep the direct term D; without it y[k] does not depend on u[k].
    stable : bool
        Move eigenvalues on or outside the unit circle to radius 0.999.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u = np.random.default_rng(0).choice([-1.0, 1.0], size=(400, 1))
    >>> y = np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.5 * y[k] + 2.0 * u[k]
    >>> data = Trajectory(np.arange(400.0), u, y, spec)
    >>> model = HoKalman(markov=40, order=1).fit([data], rng=np.random.default_rng(0))
    >>> model.eigenvalues.real.round(6)
    array([0.5])
    """

    markov: int = 100
    order: int | None = None
    rows: int | None = None
    offset: bool = True
    direct: bool = False
    stable: bool = False

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LinearModel:
        """Return a balanced model in output-error form (no filter gain)."""
        what = "ho-kalman"
        records, spec = usable(trajectories, samples=3, what=what)
        real_signals(spec, what)
        if spec.nu == 0:
            raise FitError(f"{what}: no input", expected="an input", got="none", remedy="use dmdc for free motion")
        moving(records, what)
        response, level, rms = markov_parameters(records, self.markov, offset=self.offset)
        a, b, c, values = realize(response[1:], order=self.order, rows=self.rows)
        notes: dict[str, Any] = {
            "hankel_singular_values": values[:20].tolist(),
            "order": int(a.shape[0]),
            "residual_rms": rms.tolist(),
        }
        moduli = np.abs(np.linalg.eigvals(a))
        if self.stable and moduli.max() >= 1.0:
            a = _stabilized(a)
            notes["stabilized"] = True
        return _output_error_model(spec, a, b, c, response[0], level, self.direct, notes)


def _output_error_model(
    spec: PlantSpec,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    level: FloatArray,
    direct: bool,
    notes: dict[str, Any],
) -> LinearModel:
    """Return the model; its one-step predictions are corrected by the gain of a slow observer."""
    n, ny = a.shape[0], c.shape[0]
    return LinearModel(
        spec,
        a,
        b,
        c,
        d if direct else np.zeros_like(d),
        stationary_gain(a, c),
        np.zeros(n),
        level if ny else np.zeros(0),
        notes=notes,
    )


def _stabilized(a: FloatArray) -> FloatArray:
    """Return A with eigenvalues moved inside the unit circle, eigenvectors kept."""
    values, vectors = np.linalg.eig(a)
    moduli = np.abs(values)
    values = np.where(moduli >= 1.0, values / np.where(moduli > 0, moduli, 1.0) * 0.999, values)
    stable: FloatArray = np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))
    return stable
