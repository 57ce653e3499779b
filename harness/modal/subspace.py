"""Subspace identification of poles and shapes with their covariance: output-only or driven, one regression for both.

The future outputs times the past, with what the future inputs explain taken out of both, is a matrix whose columns span
the extended observability matrix (output-only: covariance-driven SSI, Peeters & De Roeck 1999, Mech. Syst. Signal
Process. 13:855, sec. 3; driven: past outputs and inputs as instruments, Verhaegen 1994, Automatica 30:61, sec. 4). It
is a mean over samples, so its covariance is that of sums over stretches, carried on to A and C to first order (Reynders
et al. 2008; Mellinger, Döhler & Mevel 2016, J. Sound Vib. 379:169, sec. 3 and 5). The stretches overlap and fade into
one another: what a window across an edge adds to one and takes from the next would count twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from harness.errors import FitError
from harness.modal.poles import Pole, PoleSpread, poles_of
from harness.signals import FloatArray, Trajectory

STRETCHES = 40
"""Stretches whose spread is the covariance: so many widen a 95 % interval by 3 %."""
FEWEST = 10
"""Stretches below which no interval is given: a fifth wider, and itself uncertain by a quarter."""
WINDOWS = 3
"""A stretch is at least so many windows long, so that neighbours have little in common."""
ROWS = 240
"""Rows of the matrix that are aimed at: window times outputs. More costs time and gains little."""
SHORTEST, LONGEST = 8, 60
"""Windows [samples]."""
_TAPER = 4.0 / 3.0  # over the mean of sin^4 + cos^4, by which fading lowers the spread of stretches
_NEIGHBOUR = 1.0 / 6.0  # correlation of stretches that fade into one another
_TIE = 1e-6  # share of the mean power below which a direction counts no more
_BLOCK = 10_000


@dataclass(frozen=True, eq=False)
class _Scaling:
    """Levels and sizes of inputs and outputs, what future inputs explain, and the weight of the future outputs."""

    level: FloatArray
    size: FloatArray
    explain: FloatArray
    weight: FloatArray


@dataclass(frozen=True, eq=False)
class Ladder:
    """The decomposed matrix of data: poles of every order follow from it."""

    left: FloatArray  # (m, m): Left singular vectors
    values: FloatArray  # (m,): Singular values, zeros behind the last
    back: FloatArray  # (m, m): Takes weighted directions to those of the outputs over their sizes
    shifted: FloatArray  # (M, m, m): ``U' dH V`` of every stretch; their sum is 0
    scaling: _Scaling  # How the rows were made
    ny: int
    window: int
    sample_time: float  # [s]

    @property
    def most(self) -> int:
        """The largest order that the matrix holds."""
        rank = int(np.sum(self.values > _TIE * self.values[0]))
        return min(rank, (self.window - 1) * self.ny)

    @property
    def known(self) -> bool:
        """True if there are stretches enough for intervals."""
        return len(self.shifted) > FEWEST

    def matrices(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Return A (n, n) and C (ny, n) of one order."""
        basis = self.back @ self.left[:, :order]
        upper, lower = basis[: -self.ny], basis[self.ny :]
        c = self.scaling.size[-self.ny :, None] * basis[: self.ny]  # A is found on outputs of size 1: no unit decides
        return np.asarray(np.linalg.lstsq(upper, lower, rcond=None)[0]), c

    def states(self, record: Trajectory, a: FloatArray, c: FloatArray) -> FloatArray:
        """Return the states (K, nx) of a model from the outputs of the window that follows each sample.

        - ``a, c`` (nx, nx), (ny, nx)
        """
        scaling, nu = self.scaling, record.spec.nu
        powers = [c]
        for _ in range(self.window - 1):
            powers.append(powers[-1] @ a)
        size = np.tile(scaling.size[nu:], self.window)[:, None]
        gain = np.linalg.pinv(scaling.weight @ (np.vstack(powers) / size)) @ scaling.weight
        ahead, driven = self.window * self.ny, self.window * nu
        explain = scaling.explain[:ahead]
        last = len(record) - 2 * self.window + 1
        found = [
            (block[:, :ahead] - block[:, ahead : ahead + driven] @ explain.T) @ gain.T
            for block in _windows(record, 0, last, self.window, scaling.level, scaling.size)
        ]
        return np.concatenate(found) if found else np.zeros((0, len(a)))

    def poles(self, order: int, size: FloatArray | None = None) -> list[Pole]:
        """Return the vibrating modes of one order; shapes over ``size`` (ny,) where it is given."""
        a, c = self.matrices(order)
        spread = self._spread(order, a) if self.known else None
        if size is not None:
            c = c / size[:, None]
            spread = None if spread is None else replace(spread, c_shifts=spread.c_shifts / size[:, None])
        return poles_of(a, c, self.sample_time, spread)

    def _spread(self, order: int, a: FloatArray) -> PoleSpread:
        """Return what each stretch adds to A and C to first order.

        Turning the basis within its span changes no pole, so only what leaves the span counts (Reynders et al. 2008,
        eq. 29 to 33); singular values that are cut off count as 0, which they are but for noise.
        """
        ny, count = self.ny, len(self.shifted)
        basis, others = self.back @ self.left[:, :order], self.back @ self.left[:, order:]
        upper, lower = basis[:-ny], basis[ny:]
        inverse = np.linalg.pinv(upper)
        change = others @ (self.shifted[:, order:, :order] / self.values[:order])
        up, down = change[:, :-ny], change[:, ny:]
        rest = inverse @ inverse.T @ (up.transpose(0, 2, 1) @ (lower - upper @ a))
        freedom = count / (1.0 + 2.0 * _NEIGHBOUR**2) - 1.0
        of_c = self.scaling.size[-ny:, None] * change[:, :ny]
        return PoleSpread(inverse @ (down - up @ a) + rest, of_c, _TAPER * count / (count - 1), freedom)


def ladder_of(records: Sequence[Trajectory], window: int | None = None) -> Ladder:
    """Return the decomposition of records from which the poles of every order follow.

    Raises FitError if the records are too short, or nothing moves.

    - ``records``: no window crosses from one to the next. Without inputs the excitation is taken to be white and
      unknown.
    - ``window``: samples of past and future; by default 240 over the number of outputs, 8 to 60, less where records are
      short

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> from harness.signals import Channel, PlantSpec
    >>> e = np.random.default_rng(0).normal(size=20_000)
    >>> y = lfilter([1.0], [1.0, -2 * 0.98 * np.cos(0.3), 0.98**2], e)
    >>> spec = PlantSpec((), (Channel("y", "m/s2"),), 0.01)
    >>> record = Trajectory(np.arange(20_000) * 0.01, np.zeros((20_000, 0)), y[:, None], spec)
    >>> (pole,) = ladder_of([record], 20).poles(2)
    >>> round(pole.frequency, 1), bool(abs(pole.frequency - 4.7855) < 3 * pole.frequency_deviation)
    (4.8, True)
    """
    spec = records[0].spec
    nu, ny = spec.nu, spec.ny
    if window is None:
        # two windows of every column, twice over: the least that the regressions can do with
        room = int(np.sqrt(sum(map(len, records)) / (8 * (nu + ny))))
        window = max(min(ROWS // ny, LONGEST, room), SHORTEST)
    rows = sum(max(len(record) - 2 * window + 1, 0) for record in records)
    ahead, driven = window * ny, window * nu
    columns = 2 * (ahead + driven)
    if window < 2 or rows < 2 * columns:
        raise FitError(
            "modes: records too short",
            expected=f"at least {2 * columns} windows of {2 * window} samples",
            got=str(rows),
            remedy="record longer, or give a smaller window",
        )
    level, size = _levels(records)
    if not np.ptp(np.concatenate([record.y for record in records]), axis=0).any():
        raise FitError("modes: no motion", expected="outputs that move", got="constants", remedy="check the sensors")
    u_part, w_part = slice(ahead, ahead + driven), slice(ahead + driven, columns)
    gram = np.zeros((columns, columns))
    for record in records:
        for block in _windows(record, 0, len(record) - 2 * window + 1, window, level, size):
            gram += block.T @ block
    gram /= rows
    explain = _explained(gram[:, u_part], gram[u_part, u_part])
    left_over = gram - explain @ gram[:, u_part].T
    weight, back = _roots(left_over[:ahead, :ahead])
    right, _ = _roots(left_over[w_part, w_part])
    shares: list[float] = []
    parts: list[FloatArray] = []
    for record, edges in _stretches(records, window):
        fading, faded = np.zeros((ahead, len(right))), 0.0
        for first, last in pairwise(edges):
            total, growing = np.zeros_like(fading), np.zeros_like(fading)
            rise = np.sin(np.pi / 2 * (np.arange(last - first) + 0.5) / (last - first)) ** 2
            done = 0
            for block in _windows(record, first, last, window, level, size):
                clean = block - block[:, u_part] @ explain.T
                y, w = clean[:, :ahead], clean[:, w_part]
                total += y.T @ w
                growing += (y * rise[done : done + len(block), None]).T @ w
                done += len(block)
            parts.append((weight @ (fading + total - growing) @ right) / rows)
            shares.append((faded + (last - first) / 2) / rows)
            fading, faded = growing, (last - first) / 2
        parts.append((weight @ fading @ right) / rows)
        shares.append(faded / rows)
    whole = np.sum(parts, axis=0)
    left, values, right_t = np.linalg.svd(whole)
    width = min(ahead, len(right_t))
    shifted = np.zeros((len(parts), ahead, ahead))
    for j, (part, share) in enumerate(zip(parts, shares, strict=True)):
        shifted[j, :, :width] = (left.T @ (part - share * whole) @ right_t.T)[:, :width]
    padded = np.zeros(ahead)
    padded[: values.size] = values
    scaling = _Scaling(level, size, explain, weight)
    return Ladder(left, padded, back, shifted, scaling, ny, window, spec.sample_time)


def _levels(records: Sequence[Trajectory]) -> tuple[FloatArray, FloatArray]:
    """Return means and sizes of inputs and outputs over all records: no unit decides."""
    both = np.concatenate([np.hstack([record.u, record.y]) for record in records])
    size = both.std(axis=0)
    return both.mean(axis=0), np.where(size > 0, size, 1.0)


def _stretches(records: Sequence[Trajectory], window: int) -> Iterator[tuple[Trajectory, list[int]]]:
    """Yield records that hold a window with the edges of their stretches, in windows."""
    counts = [max(len(record) - 2 * window + 1, 0) for record in records]
    length = max(sum(counts) / STRETCHES, WINDOWS * window)
    for record, count in zip(records, counts, strict=True):
        if count:
            yield record, np.linspace(0, count, max(int(count / length), 1) + 1).astype(int).tolist()


def _windows(
    record: Trajectory, first: int, last: int, window: int, level: FloatArray, size: FloatArray
) -> Iterator[FloatArray]:
    """Yield blocks of rows ``[future outputs, future inputs, past inputs and outputs]`` of windows first .. last."""
    nu = record.spec.nu
    for start in range(first, last, _BLOCK):
        stop = min(start + _BLOCK, last)
        both = (np.hstack([record.u, record.y])[start : stop + 2 * window - 1] - level) / size
        view = np.lib.stride_tricks.sliding_window_view(both, 2 * window, axis=0).transpose(0, 2, 1)
        future, past = view[:, window:], view[:, :window]
        pieces = (future[:, :, nu:], future[:, :, :nu], past)
        yield np.hstack([piece.reshape(stop - start, -1) for piece in pieces])


def _explained(cross: FloatArray, inputs: FloatArray) -> FloatArray:
    """Return the regression of all columns on the future inputs; directions that these do not move explain nothing."""
    if not inputs.size:
        return np.zeros(cross.shape)
    return np.asarray(cross @ np.linalg.pinv(inputs, rcond=1e-9, hermitian=True))


def _roots(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the inverse square root of a covariance, and the root."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    root = np.sqrt(np.maximum(values, 0.0) + _TIE * max(float(values.mean()), 1e-300))
    return np.asarray((vectors / root) @ vectors.T), np.asarray((vectors * root) @ vectors.T)
