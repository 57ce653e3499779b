"""Markov parameters (impulse responses) by least squares: block Toeplitz normal equations summed by FFT."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.signals import FloatArray, Trajectory
from identifiers.common.neighbours import edges
from identifiers.common.normal import NormalEquations
from identifiers.common.records import usable

# Up to so many unknowns the dense normal equations are as fast as conjugate gradients.
_DENSE = 40


def markov_parameters(
    trajectories: Sequence[Trajectory], length: int, *, offset: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the impulse response of a finite-impulse-response model, by least squares.

    ``y[k] = sum_{i=0}^{length-1} G[i] u[k-i] + c`` for k >= length - 1 of every record: no window crosses a seam, and
    one whose output was not read is left out. The normal equations are block Toeplitz but for the ends of the records
    and what is left out; they are summed by FFT correlations and corrected exactly. Many unknowns are solved for by
    conjugate gradients with a circulant preconditioner (Chan & Ng 1996, SIAM Review 38:427), the Toeplitz product by
    FFT; where the input does not excite all frequencies evenly enough for that, or readings are missing, by the dense
    equations.

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
    records, spec = usable(trajectories, samples=length + 1, what=what, holes="kept")
    nu, ny = spec.nu, spec.ny
    size = length * nu + int(offset)
    rows = sum(_windows(record, length) for record in records)
    if rows < size:
        raise FitError(
            f"{what}: fewer equations than Markov parameters",
            expected=f"at least {size} windows of {length} samples",
            got=str(rows),
            remedy="record longer, or ask for fewer Markov parameters",
        )
    if size > _DENSE and all(record.missing is None for record in records):
        fast = _iterated(records, length, offset, rows)
        if fast is not None:
            return fast
    sums = normal_equations(records, length, offset=offset)
    gram, right, square = sums.gram, sums.right, sums.square
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


def normal_equations(records: Sequence[Trajectory], length: int, *, offset: bool) -> NormalEquations:
    """Return the sums over all windows of the records, none across a seam: lags of the inputs, then the constant.

    - ``records``: each of at least ``length`` samples
    - ``length``: number of lags, that of the present sample included
    """
    nu, ny = records[0].spec.nu, records[0].spec.ny
    size = length * nu + int(offset)
    gram, right, square = np.zeros((size, size)), np.zeros((size, ny)), np.zeros(ny)
    for record in records:
        _accumulate(record, length, offset, gram, right, square)
    return NormalEquations(gram, right, square, sum(_windows(record, length) for record in records))


def sums_without(records: Sequence[Trajectory], length: int, *, offset: bool) -> list[NormalEquations]:
    """Return the normal equations of all windows but those of one stretch each; none of too few windows.

    - ``offset``: as of :func:`normal_equations`
    """
    records = [record for record in records if len(record) >= length]
    windows = [len(record) - length + 1 for record in records]
    bounds = edges(sum(windows))
    nu, ny = records[0].spec.nu, records[0].spec.ny
    size = length * nu + int(offset)
    parts = []
    for low, high in bounds:
        gram, right, square, place, rows = np.zeros((size, size)), np.zeros((size, ny)), np.zeros(ny), 0, 0
        for record, count in zip(records, windows, strict=True):
            first, last = max(low - place, 0), min(high - place, count)
            if first < last:
                part = record[first : last + length - 1]
                _accumulate(part, length, offset, gram, right, square)
                rows += _windows(part, length)
            place += count
        parts.append(NormalEquations(gram, right, square, rows))
    if not parts or sum(windows) - max(part.rows for part in parts) < size:
        return []
    ones = np.ones(len(parts), dtype=int)
    return [NormalEquations.sum(parts, ones - (np.arange(len(parts)) == group)) for group in range(len(parts))]


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
    gone = _unread(record, m)
    if gone.size:
        y = y.copy()
        y[gone] = 0.0
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
    if gone.size:  # what the windows of missing readings added
        rows = np.hstack([*(u[gone - j] for j in range(m)), *([np.ones((gone.size, 1))] if offset else [])])
        gram -= rows.T @ rows


def _unread(record: Trajectory, length: int) -> npt.NDArray[np.int_]:
    """Return the last samples of windows in which some output was not read."""
    if record.missing is None:
        return np.zeros(0, dtype=int)
    return np.flatnonzero(record.missing[length - 1 :].any(axis=1)) + length - 1


def _windows(record: Trajectory, length: int) -> int:
    """Return the number of windows in which all outputs were read."""
    return len(record) - length + 1 - _unread(record, length).size


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


@dataclass(frozen=True, eq=False)
class _Ends:
    """Spectra of the first and last samples of a record: what the zero-padded Toeplitz matrix counts too much."""

    first: npt.NDArray[np.complex128]
    last: npt.NDArray[np.complex128]


def _iterated(
    records: Sequence[Trajectory], m: int, offset: bool, rows: int
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return Markov parameters by conjugate gradients; None where these do not converge to rounding."""
    from scipy.fft import irfft, next_fast_len, rfft

    nu, ny = records[0].spec.nu, records[0].spec.ny
    size = next_fast_len(2 * m, real=True)
    lags = np.zeros((2 * m - 1, nu, nu))  # lag l at index l mod (2 m - 1): sum_k u[k] u[k + l]'
    right, square = np.zeros((m, nu, ny)), np.zeros(ny)
    sums, total = np.zeros((m, nu)), np.zeros(ny)
    ends: list[_Ends] = []
    for record in records:
        u, y = record.u, record.y
        n = len(record)
        long = next_fast_len(n + m, real=True)
        fu, late = rfft(u, long, axis=0), np.zeros((n, ny))
        late[m - 1 :] = y[m - 1 :]
        fy = rfft(late, long, axis=0)
        auto = irfft(np.conj(fu)[:, :, None] * fu[:, None, :], long, axis=0)  # lag l: sum_k u[k] u[k + l]'
        lags[:m] += auto[:m]
        lags[m:] += auto[long - m + 1 :]
        right += irfft(np.conj(fu)[:, :, None] * fy[:, None, :], long, axis=0)[:m]
        square += np.einsum("ij,ij->j", y[m - 1 :], y[m - 1 :])
        total += y[m - 1 :].sum(axis=0)
        cumulated = np.concatenate([np.zeros((1, nu)), np.cumsum(u, axis=0)])
        sums += cumulated[n - np.arange(m)] - cumulated[m - 1 - np.arange(m)]
        ends.append(_Ends(rfft(u[: m - 1], size, axis=0), rfft(u[n - m + 1 :], size, axis=0)))
    wrapped = np.zeros((size, nu, nu))
    wrapped[:m], wrapped[size - m + 1 :] = lags[:m], lags[m:]
    spectrum = rfft(wrapped, axis=0)
    weight = 1.0 - np.minimum(np.arange(size), size - np.arange(size)) / m
    tapered = rfft(wrapped * np.maximum(weight, 0.0)[:, None, None], axis=0)
    values = np.linalg.eigvalsh(tapered)
    if values.min() <= 1e-6 * values.max():
        return None
    inverse = np.linalg.inv(tapered)

    def product(v: FloatArray) -> FloatArray:
        f = rfft(v, size, axis=0)
        result: FloatArray = irfft(spectrum @ f, size, axis=0)[:m]
        for end in ends:
            for part, low, high in ((end.first, 0, m - 1), (end.last, m - 1, 2 * m - 2)):
                seen = irfft(np.einsum("fi,fij->fj", part, f), size, axis=0)
                seen[:low] = 0.0
                seen[high:] = 0.0
                back = np.conj(part)[:, :, None] * rfft(seen, axis=0)[:, None, :]
                result = result - irfft(back, size, axis=0)[:m]
        if offset:
            result = result - sums[:, :, None] * (np.einsum("ij,ijk->k", sums, v) / rows)
        return result

    def precondition(v: FloatArray) -> FloatArray:
        result: FloatArray = irfft(inverse @ rfft(v, size, axis=0), size, axis=0)[:m]
        return result

    target = right - sums[:, :, None] * (total / rows) if offset else right
    # A right-hand side of its own that lies in no subspace: where the input excites not all lags, the equations of the
    # data are solvable all the same, this one is not, and the iteration does not end.
    probe = np.random.default_rng(0).normal(size=(m, nu, 1))
    target = np.concatenate([target, probe], axis=2)
    tolerance = np.array([1e-12] * ny + [1e-4])
    x, r = np.zeros_like(target), target.copy()
    z = precondition(r)
    p, rho = z.copy(), np.einsum("ijk,ijk->k", r, z)
    scale = np.sqrt(np.einsum("ijk,ijk->k", target, target))
    for _ in range(80):
        if np.all(np.sqrt(np.einsum("ijk,ijk->k", r, r)) <= tolerance * scale):
            break
        q = product(p)
        bent = np.einsum("ijk,ijk->k", p, q)
        if not (np.isfinite(bent).all() and np.all((bent > 0) | (rho <= 0))):
            return None  # the input excites not all lags: the dense equations say so in words
        step = rho / np.where(bent > 0, bent, 1.0)
        x += step * p
        r -= step * q
        z = precondition(r)
        new = np.einsum("ijk,ijk->k", r, z)
        p = z + (new / np.where(rho > 0, rho, 1.0)) * p
        rho = new
    else:
        return None
    x = x[:, :, :ny]
    level = (total - np.einsum("ij,ijk->k", sums, x)) / rows if offset else np.zeros(ny)
    lost = square - np.einsum("ijk,ijk->k", x, right) - level * total
    return x.transpose(0, 2, 1), level, np.sqrt(np.clip(lost, 0.0, None) / rows)
