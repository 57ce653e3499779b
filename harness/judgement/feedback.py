"""Feedback: whether past outputs foretell an input beyond its own past."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.algebra import column_norms, divisor, orthonormal, unit_columns
from harness.signals import FloatArray, Trajectory

# Of an input: what its own past leaves when it follows from it, as a multisine or a free motion does.
FORETOLD = 1e-6
# An input's own past: so many times what outputs have to say, and at most so many samples; where outputs seem to have
# more to say, the latter: a lightly damped structure with precise sensors remembers inputs that long.
_LAGS, _LONGER, _OWN, _LONG = 4, 4, 40, 200
# Rows for each regressor that a past of the input has to leave, and their share of all: a short past leaves more rows
# where a record is in pieces, and tells of loops; a long one tells whether an input follows from itself.
_ROWS, _KEPT = 3, 2.0 / 3.0
FOUND = 0.01
"""Share of what is not foretold, below which nothing is found in it."""
NEW = 0.01
"""What an input's own past leaves of it, below which nobody answers anything: a sweep of 2000 samples leaves 1e-5, a
loop that is moved from outside by a tenth of its input 0.14 and more."""
# Share of the samples in which outputs move and an input rests to the bit, and its moves over its standard deviation,
# beyond which no linear law sets it: a command rounded to a third of its size rests in a fifth of them.
_RESTS, _JUMPS = 0.5, 0.3
ALONE = 0.01
"""Probability of what outputs before tell of an input, above which it is chance."""
# Probability of an output that follows inputs of its own sample by chance.
_SURE = 1e-5
# Samples of a past that is looked at in full.
SHORT = 4
# Witnesses that depend on others up to this share are left out.
THIN = 1e-8
# Samples that are looked at: at so many, what an excitation of 5 % of the input does to the outputs shows.
_SEEN = 10_000
# Mean fourth power of normal numbers, over the square of their mean square.
_NORMAL = 3.0


@dataclass(frozen=True)
class Feedback:
    """How far past outputs foretell an input beyond its own past.

    Parameters
    ----------
    share : float
        Share of the input's unpredictable part that past outputs explain, of the input where it is most.
    probability : float
        Of a share at least so large in open loop.
    unforeseen : float
        What the input's own past leaves of it, relative to its standard deviation.
    moves : float
        Samples in which an input does what its own past does not foretell (:func:`moves`), of the input where they are
        fewest; infinite where the past foretells every input, as a sum of lines.
    """

    share: float
    probability: float
    unforeseen: float = 1.0
    moves: float = np.inf

    @property
    def found(self) -> bool:
        """True if chance is no explanation (less than 1 in 1000) and the share is not negligible (1 %)."""
        return self.probability < 1e-3 and self.share > FOUND


def feedback_of(records: Sequence[Trajectory]) -> Feedback:
    """Test whether outputs foretell the input beyond its own past: feedback (Granger 1969; Ljung 1999, sec. 13.4).

    The input's own past is as long as all samples of the outputs are many: a sum of sines follows from a past of twice
    their number, and outputs that only stand for an older past are no feedback. So what is found must stay where the
    input tells all of a long past of its own. Of a record in pieces few are as long: where a shorter past leaves next
    to nothing of the input (``NEW``), what is found must stay with the longest that any pieces allow. Outputs that hold
    the inputs of the same sample (:func:`reached_at_once`) are no feedback either.

    Parameters
    ----------
    records : sequence of Trajectory

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.normal(size=(500, 1)), np.zeros((500, 1))
    >>> for k in range(499):
    ...     y[k + 1] = 0.8 * y[k] + u[k] + 0.3 * rng.normal()
    >>> feedback_of([Trajectory(np.arange(500.0), u, y, spec)]).found
    False
    """
    if records[0].spec.nu == 0:
        return Feedback(0.0, 1.0)
    found = _of(*granger(records, _LAGS))
    if not found.found:
        return found
    if reached_at_once(records):
        return Feedback(0.0, 1.0, found.unforeseen, found.moves)
    for kept in (_KEPT, 0.0):
        long = _of(*granger(records, _LAGS, _LONG, kept))
        if not long.found:
            return long
        if long.unforeseen >= NEW:
            break
    return found


def _of(shares: FloatArray, chances: FloatArray, alone: FloatArray, counted: FloatArray) -> Feedback:
    """Return the feedback of what :func:`granger` finds, of the input where it is most."""
    worst = int(np.argmax(shares))
    chance = min(1.0, float(chances[worst]) * shares.size)
    few = float(np.where(alone > FORETOLD, counted, np.inf).min())
    return Feedback(float(shares[worst]), chance, float(alone[worst]), few)


def granger(
    records: Sequence[Trajectory], lags: int, longest: int = _OWN, kept: float = _KEPT
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return, of every input: share that outputs explain, its chance in open loop, what the own past leaves, and moves.

    Its own past is at most so many samples long, and leaves such a share of all rows. Moves are the samples in which it
    leaves something, none counted where the records are too short to say.
    """
    from scipy.stats import f

    spec = records[0].spec
    nu, ny = spec.nu, spec.ny
    nothing = np.zeros(nu), np.ones(nu), np.ones(nu), np.full(nu, np.inf)
    rows = sum(map(len, records))
    past = longest if longest > _OWN else min(lags + _LONGER * (lags + 1) * ny, longest)
    past = max(lags, min(past, (rows // 4 - (lags + 1) * ny) // max(nu, 1)))
    lengths = np.array([len(record) for record in records])
    while past > lags and np.maximum(lengths - past, 0).sum() < max(_ROWS * (past * nu + (lags + 1) * ny), kept * rows):
        past -= 1  # of pieces of a record the longer ones tell, however short others are
    long = [record for record in records if len(record) > past + 1]
    rows = sum(len(record) - past for record in long)
    if rows <= 2 * (1 + past * nu + (lags + 1) * ny):
        return nothing
    own, others, target = [], [], []
    for record in long:
        stop = len(record)
        own.append(np.hstack([np.ones((stop - past, 1)), *(record.u[past - j : stop - j] for j in range(1, past + 1))]))
        # a controller acts on the output of the same sample, unless that depends on the input itself
        seen = [record.y[past - j : stop - j] for j in range(int(spec.feedthrough), lags + 1)]
        others.append(np.hstack(seen))
        target.append(record.u[past:])
    few, more, wanted = np.concatenate(own), np.concatenate(others), np.concatenate(target)
    # Norms of residuals are those of the triangle: it is small.
    triangle = np.asarray(
        np.linalg.qr(np.hstack([unit_columns(few), unit_columns(more), wanted]), mode="r"), dtype=np.float64
    )
    wanted, lost = triangle[:, -nu:], []
    for width in (few.shape[1], few.shape[1] + more.shape[1]):
        q, values, _ = np.linalg.svd(triangle[:, :width], full_matrices=False)
        q = q[:, values > 1e-10 * values[0]]
        lost.append((np.sum((wanted - q @ (q.T @ wanted)) ** 2, axis=0), q.shape[1]))
    (alone, fewer), (helped, many) = lost
    power = rows * np.concatenate([record.u for record in long]).var(axis=0)
    ahead = np.linalg.lstsq(triangle[:, : few.shape[1]], triangle[:, -nu:], rcond=1e-10)[0]
    counted = moves(np.concatenate(target) - unit_columns(few) @ ahead)
    floor = FORETOLD**2 * power  # an input that its own past foretells needs no feedback
    shares = np.where(alone > floor, 1.0 - helped / np.maximum(alone, 1e-300), 0.0)
    added, remaining = max(many - fewer, 1), np.maximum(counted * (1.0 - many / rows), 1.0)
    ratio = (shares / added) / np.maximum((1.0 - shares) / remaining, 1e-300)
    left = np.sqrt(alone / divisor(power))
    return shares, f.sf(ratio, added, remaining), left, counted


def moves(departures: FloatArray) -> FloatArray:
    """Return how many samples (n,) of each column of departures (N, n) from what was foretold tell something.

    All of them where they are normal. A staircase departs at its steps: what is counted there is steps, of which chance
    makes more than of samples (the effective size of weights, Kish 1965, *Survey Sampling*, sec. 11.7, of squares).

    Parameters
    ----------
    departures : array (N, n)

    Examples
    --------
    >>> once = np.zeros((1000, 1))
    >>> once[300] = 1.0
    >>> moves(once).tolist(), bool(moves(np.random.default_rng(0).normal(size=(1000, 1)))[0] > 900)
    ([3.0], True)
    """
    size = np.abs(departures).max(axis=0, initial=0.0)
    square = (departures / divisor(size)) ** 2
    fourth = np.sum(square**2, axis=0)
    counted = _NORMAL * np.sum(square, axis=0) ** 2 / divisor(fourth)
    return np.asarray(np.minimum(counted, len(departures)), dtype=np.float64)


def jumps(records: Sequence[Trajectory], column: int) -> bool:
    """Return True for an input that is held while outputs move, and then jumps: no linear controller's command.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, t = np.repeat(rng.normal(size=(20, 1)), 5, axis=0), np.arange(100.0)
    >>> jumps([Trajectory(t, u, rng.normal(size=(100, 1)), spec)], 0), jumps([Trajectory(t, u, u, spec)], 0)
    (True, False)
    """
    change = np.concatenate([np.diff(record.u[:, column]) for record in records])
    moved = np.concatenate([np.any(np.diff(record.y, axis=0) != 0.0, axis=1) for record in records])
    rests, size = change == 0.0, np.concatenate([record.u[:, column] for record in records]).std()
    if not np.mean(rests & moved) > _RESTS or rests.all():
        return False
    return bool(np.sqrt(np.mean(change[~rests] ** 2)) > _JUMPS * size)


def reached_at_once(records: Sequence[Trajectory]) -> bool:
    """Return True where outputs hold the inputs of the same sample: crosstalk, or a direct path that is not declared.

    The inputs of the sample foretell an output beyond its past and theirs, and no outputs before foretell them. So does
    a controller of whose command no earlier output tells more than its own past; but inputs that are held and jump
    (:func:`jumps`) are none's.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, noise, t = np.repeat(rng.normal(size=(60, 1)), 5, axis=0), rng.normal(size=(300, 1)), np.arange(300.0)
    >>> [reached_at_once([Trajectory(t, u, size * u + noise, spec)]) for size in (0.0, 2.0)]
    [False, True]
    """
    spec, records = records[0].spec, [record for record in first_rows(records) if len(record) > SHORT]
    if spec.feedthrough or spec.nu == 0 or not records or not all(jumps(records, j) for j in range(spec.nu)):
        return False
    if (rows := _samples_and_past(records)) is None:
        return False
    u, y, past_u, past_y = rows
    at_once, share = _beyond(np.hstack([past_u, past_y]), u, y)
    if not np.any((at_once < _SURE / spec.ny) & (share > FOUND)):
        return False
    return bool(_beyond(past_u, past_y, u)[0].min() >= ALONE / spec.nu)


def taken_up_at_once(records: Sequence[Trajectory]) -> FloatArray | None:
    """Return the share (nu, ny) of the inputs of the same sample that each output holds; None of too few samples.

    Beside the samples before: what a plant without a direct path answers to an input comes later.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u = np.repeat(rng.normal(size=(60, 1)), 5, axis=0)
    >>> record = Trajectory(np.arange(300.0), u, 2.0 * u + 1e-3 * rng.normal(size=(300, 1)), spec)
    >>> taken_up_at_once([record]).round(2).tolist()
    [[2.0]]
    """
    enough = [record for record in first_rows(records) if len(record) > SHORT]
    if records[0].spec.nu == 0 or (rows := _samples_and_past(enough)) is None:
        return None
    u, y, past_u, past_y = rows
    regressors = np.hstack([u, past_u, past_y])
    size = divisor(column_norms(regressors))
    theta = np.linalg.lstsq(regressors / size, y, rcond=THIN)[0] / size[:, None]
    return np.asarray(theta[: u.shape[1]], dtype=np.float64)


def _samples_and_past(records: Sequence[Trajectory]) -> tuple[FloatArray, ...] | None:
    """Return inputs and outputs of each sample, and those of the samples before; None of too few samples."""
    parts = [(record.u[SHORT:], record.y[SHORT:], _past(record.u), _past(record.y)) for record in records]
    rows = tuple(np.concatenate(part) for part in zip(*parts, strict=True))
    if not rows or len(rows[0]) < 3 * sum(part.shape[1] for part in (rows[0], *rows[2:])):
        return None
    return rows


def _past(signal: FloatArray) -> FloatArray:
    """Return the samples before (N - SHORT, SHORT n) of a signal (N, n), and a constant."""
    n = len(signal)
    return np.hstack([np.ones((n - SHORT, 1)), *(signal[SHORT - j : n - j] for j in range(1, SHORT + 1))])


def _beyond(known: FloatArray, more: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the chance that more regressors tell so much of each target (m,) beyond known ones, and their share."""
    from scipy.stats import f

    past = orthonormal(known, THIN)
    base = orthonormal(more - past @ (past.T @ more), THIN)
    if not base.shape[1]:
        return np.ones(target.shape[1]), np.zeros(target.shape[1])
    rest = target - past @ (past.T @ target)
    told = np.sum((base.T @ rest) ** 2, axis=0)
    wrong = rest - base @ (base.T @ rest)
    left, least = np.sum(wrong**2, axis=0), FORETOLD**2 * len(target) * target.var(axis=0)
    free = np.maximum(moves(wrong) - past.shape[1] - base.shape[1], 1.0)
    chance = f.sf(told / divisor(left) * free / base.shape[1], base.shape[1], free)
    return np.where(told > least, chance, 1.0), told / divisor(told + left)


def first_rows(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return the records up to so many samples in all."""
    some, left = [], _SEEN
    for record in records:
        if left > 0:
            some.append(record[:left])
            left -= len(record)
    return some
