"""Records as the search sees them: at the rate that their motion needs, each kept reading standing for its neighbours.

A record at 1 kHz says hardly more about a plant whose motion lies below 3 Hz than the same record at 120 Hz, and costs
eight times as much in every fit. What is thrown away is the rate and not the information:

- a reading that is kept is that of the cubic through its neighbours (Savitzky & Golay 1964, *Anal. Chem.* 36:1627),
  with the noise of all of them: of so many that a jump of the acceleration, as dry friction makes, moves it by no more
  than a part of its noise. Where a cubic does not follow the readings, at an impact, it is the reading itself;
- where nothing drives the plant, a longer filter takes all readings in, and keeps their noise white;
- an input becomes piecewise linear, by least squares over time. What is left of it is orthogonal to every hat function,
  and so to ``(t_k - t)_+``, the answer of a mass at a kept instant: a double integrator is at the kept instants exactly
  where the input as it was would have taken it, jumps or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.records.motion import motion_band
from harness.physics.fitting.likelihood_fit import sensor_noise
from harness.signals import Dataset, FloatArray, Run, Trajectory

ROLL_OFF = 0.5
SPAN = 8
"""Half length of the filter of what nothing drives, in new samples."""


@dataclass(frozen=True)
class Thinned:
    """Records at a lower rate."""

    dataset: Dataset
    factor: int  # Rows of the records as they were for each that was kept
    noise: tuple[float, ...]
    """For each output the standard deviation of a kept reading's noise over that of the readings as they were."""

    @classmethod
    def not_at_all(cls, dataset: Dataset) -> Thinned:
        """Return records as they are."""
        return cls(dataset, 1, (1.0,) * dataset.spec.ny)


def thinned_dataset(dataset: Dataset) -> Thinned:
    """Return a data set at the rate that its motion needs, with a warning that says so.

    - returns the records as they are where they are not sampled so often, where their signals are declared smooth and
      the inputs move, or where a piecewise linear input would not follow the one that was applied
    """
    dt = dataset.spec.sample_time
    runs = [run.trajectory for run in dataset]
    moves = any(np.ptp(run.u, axis=0).any() for run in runs)
    columns = [run.y[:, j] for run in runs for j in range(run.spec.ny) if np.ptp(run.y[:, j]) > 0]
    if not columns or (moves and dataset.intersample == "smooth"):
        return Thinned.not_at_all(dataset)
    band, forces = (max(motion_band(read, dt, derivative=order)[0] for read in columns) for order in (1, 2))
    rate = max(DATA_POLICY.per_period * band, DATA_POLICY.per_force * forces if moves else 0.0)
    factor = int(1 / (rate * dt))
    factor = min(factor, min(len(run) for run in runs) // (DATA_POLICY.fewest + (0 if moves else 2 * SPAN)))
    while factor > 1 and moves and not _follows_inputs(runs, factor, dataset.intersample, band):
        factor -= 1
    if factor < 2:
        return Thinned.not_at_all(dataset)
    words = (
        f"the motion lies below {band:.3g} Hz: the search looks at {1 / (factor * dt):.4g} Hz instead of "
        f"{1 / dt:.4g} Hz; free runs are compared at the full rate"
    )
    found = thinned_by(dataset, factor) if moves else _filtered(dataset, factor)
    return replace(found, dataset=replace(found.dataset, warnings=(*dataset.warnings, words)))


def thinned_by(dataset: Dataset, factor: int) -> Thinned:
    """Return a data set with every so many rows of it.

    - ``factor``: 1 leaves it as it is
    """
    if factor < 2:
        return Thinned.not_at_all(dataset)
    spec = replace(dataset.spec, sample_time=factor * dataset.spec.sample_time)
    widths = _half_widths([run.trajectory for run in dataset], factor)
    shares = tuple(float(np.sqrt(np.sum(_taps(width) ** 2))) for width in widths)
    runs = []
    for run in dataset:
        record = run.trajectory
        rows = np.arange(0, len(record), factor)
        u = hat_projection(record.u, factor, dataset.intersample)
        periods = [channel.period for channel in record.spec.outputs]
        columns = zip(record.readings.T, widths, periods, strict=True)
        y = np.stack([local_cubics(read, factor, width, period) for read, width, period in columns], axis=1)
        missing = np.isnan(y)
        y = np.where(missing, record.y[rows], y)
        runs.append(Run(Trajectory(record.t[rows], u, y, spec, missing=missing), run.use, run.label))
    share_of = dict(zip((channel.name for channel in spec.outputs), shares, strict=True))
    made = replace(_averaged(dataset, share_of), runs=tuple(runs), intersample="foh")
    return Thinned(made, factor, shares)


def _filtered(dataset: Dataset, factor: int) -> Thinned:
    """Return records that nothing drives, low-passed and decimated, without the ends that the filter does not reach."""
    from scipy.signal import fftconvolve

    spec = replace(dataset.spec, sample_time=factor * dataset.spec.sample_time)
    taps = white_keeping_filter(factor)
    share, runs = float(np.sqrt(np.sum(taps**2))), []  # of the deviation of white noise
    for run in dataset:
        record = run.trajectory
        columns = []
        for read, channel in zip(record.y.T, record.spec.outputs, strict=True):
            known = read if channel.period is None else np.unwrap(read, period=channel.period)
            columns.append(fftconvolve(known, taps, mode="valid")[::factor])
        y = np.stack(columns, axis=1)
        first = (len(taps) - 1) // 2
        rows = slice(first, first + (len(y) - 1) * factor + 1, factor)
        missing = None if record.missing is None else record.missing[rows]
        runs.append(Run(Trajectory(record.t[rows], record.u[rows], y, spec, missing=missing), run.use, run.label))
    share_of = dict.fromkeys((channel.name for channel in spec.outputs), share)
    return Thinned(replace(_averaged(dataset, share_of), runs=tuple(runs)), factor, (share,) * dataset.spec.ny)


def _averaged(dataset: Dataset, share_of: Mapping[str, float]) -> Dataset:
    """Return a data set whose noise and resolution are those of averages: by output, their share of a reading's."""
    noise, steps = (
        {name: known * share_of[name] for name, known in sizes.items()} for sizes in (dataset.noise, dataset.resolution)
    )
    return replace(dataset, noise=noise, resolution=steps)


def white_keeping_filter(factor: int) -> FloatArray:
    """Return taps (16 * factor + 1,) of a low-pass: every ``factor``-th sample of white noise stays white.

    The square root of a raised cosine: the squares of its pass bands, moved by the new sampling frequency, add up to a
    constant (Proakis, Digital Communications, section 9.2).

    Examples
    --------
    >>> taps = white_keeping_filter(4)
    >>> float(round(taps.sum(), 6)), float(abs(round((taps[:-4] * taps[4:]).sum() / (taps**2).sum(), 2)))
    (1.0, 0.0)
    """
    t = np.arange(-SPAN * factor, SPAN * factor + 1) / factor
    b = ROLL_OFF
    with np.errstate(divide="ignore", invalid="ignore"):
        taps = (np.sin(np.pi * t * (1 - b)) + 4 * b * t * np.cos(np.pi * t * (1 + b))) / (
            np.pi * t * (1 - (4 * b * t) ** 2)
        )
    taps[t == 0] = 1 - b + 4 * b / np.pi
    edge = np.isclose(np.abs(t), 1 / (4 * b))
    quarter = np.pi / (4 * b)
    taps[edge] = b / np.sqrt(2) * ((1 + 2 / np.pi) * np.sin(quarter) + (1 - 2 / np.pi) * np.cos(quarter))
    return np.asarray(taps / taps.sum())


def local_cubics(readings: FloatArray, factor: int, half: int, period: float | None = None) -> FloatArray:
    """Return every so many readings, each from the cubic through ``2 * half + 1`` neighbours.

    - ``readings`` (N,): naN where one is missing
    - ``factor, half``: with ``half`` below 2 the readings themselves
    - ``period``: of an angle that goes round
    - returns array ((N - 1) // factor + 1,): the reading itself where neighbours are wanting or missing, or lie
      further from the cubic than those of all but one in ten thousand windows of mere noise

    Examples
    --------
    >>> local_cubics(np.arange(9.0) ** 3, 2, 2).round(9).tolist()
    [0.0, 8.0, 64.0, 216.0, 512.0]
    """
    from scipy.stats import chi2

    rows = np.arange(0, len(readings), factor)
    found = np.array(readings[rows], dtype=float)
    inner = (rows >= half) & (rows + half < len(readings))
    if half < 2 or not inner.any():
        return found
    windows = _windows(readings, half, period)[rows[inner] - half]
    basis = _basis(half)
    fitted = windows @ basis @ basis.T
    squares = np.sum((windows - fitted) ** 2, axis=1)
    if np.isnan(squares).all():
        return found
    free = 2 * half - 2
    noise = float(np.nanmedian(squares)) / float(chi2.median(free))
    follows = squares <= noise * float(chi2.isf(DATA_POLICY.corner, free))
    found[inner] += np.where(follows, fitted[:, half], 0.0)
    return found


def _windows(readings: FloatArray, half: int, period: float | None) -> FloatArray:
    """Return every window of ``2 * half + 1`` readings (N - 2 half, 2 half + 1), less the one in its middle."""
    known = readings
    if period is not None:
        there = np.isfinite(readings)
        known = np.full(len(readings), np.nan)
        known[there] = np.unwrap(readings[there], period=period)
    windows = np.lib.stride_tricks.sliding_window_view(known, 2 * half + 1)
    return np.asarray(windows - windows[:, [half]])


def _half_widths(runs: Sequence[Trajectory], factor: int) -> tuple[int, ...]:
    """Return for every output over how many neighbours to each side its readings may be averaged; 1 is not at all.

    A jump of the acceleration by its rms moves the middle of a cubic by at most a stated part of the noise it has.
    """
    noise, found = sensor_noise(runs), []
    for j in range(runs[0].spec.ny):
        jump = _acceleration(runs, j, factor, noise[j])
        able = [
            half
            for half in range(2, factor + 1)
            if jump * _moved_by_a_jump(half) <= DATA_POLICY.jump * noise[j] * np.sqrt(np.sum(_taps(half) ** 2))
        ]
        found.append(max(able, default=1))
    return tuple(found)


def _moved_by_a_jump(half: int) -> float:
    """Return by how much a jump of the acceleration of 1 at the worst place moves the middle of a cubic."""
    places = np.linspace(-half, half, 8 * half + 1)[:, None]
    after = 0.5 * np.maximum(np.arange(-half, half + 1) - places, 0.0) ** 2
    return float(np.abs(after @ _taps(half) - after[:, half]).max())


def _basis(half: int) -> FloatArray:
    """Return an orthonormal basis of parabolas over ``2 * half + 1`` rows; in the middle they are cubics as well."""
    return np.asarray(np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, 2 * half + 1), 3))[0])


def _taps(half: int) -> FloatArray:
    """Return the weights of the readings in the value of a cubic at their middle (2 * half + 1,)."""
    if half < 2:
        return np.ones(1)
    basis = _basis(half)
    return np.asarray(basis @ basis[half])


def hat_projection(u: FloatArray, factor: int, intersample: str = "zoh") -> FloatArray:
    """Return the continuous piecewise linear signals with nodes at every so many rows that come nearest to inputs.

    - ``u`` (N, nu): held from row to row, or linear between rows (``intersample="foh"``)
    - returns array ((N - 1) // factor + 1, nu): values at the nodes. What they leave of the inputs is orthogonal to
      every piecewise linear function with these nodes, as least squares over time are (Strang & Fix 1973, *An Analysis
      of the Finite Element Method*, sec. 1.3).

    Examples
    --------
    >>> hat_projection(np.arange(9.0)[:, None], 4, "foh").round(9).ravel().tolist()
    [0.0, 4.0, 8.0]
    >>> hat_projection(np.ones((9, 1)), 4).round(9).ravel().tolist()
    [1.0, 1.0, 1.0]
    """
    from scipy.linalg import solveh_banded

    nodes = (len(u) - 1) // factor + 1
    if nodes < 2:
        return np.array(u[:nodes], dtype=float)
    pieces = (nodes - 1) * factor
    left = u[:pieces]
    right = u[1 : pieces + 1] if intersample == "foh" else left
    # of an interval of a piece: the integrals of a linear signal times the falling and the rising half of a hat
    part = np.arange(factor) / factor
    step = 1.0 / factor
    shape = (nodes - 1, factor, u.shape[1])
    a, b = left.reshape(shape), right.reshape(shape)
    rising = np.einsum("j,kji->ki", part * step, 0.5 * (a + b)) + step**2 * (a / 6 + b / 3).sum(axis=1)
    falling = step * 0.5 * (a + b).sum(axis=1) - rising
    load = np.zeros((nodes, u.shape[1]))
    load[:-1] += falling
    load[1:] += rising
    mass = np.zeros((2, nodes))
    mass[1], mass[1, [0, -1]], mass[0, 1:] = 2 / 3, 1 / 3, 1 / 6
    return np.asarray(solveh_banded(mass, load))


def _follows_inputs(runs: Sequence[Trajectory], factor: int, intersample: str, band: float) -> bool:
    """Return True if piecewise linear inputs leave little of those that were applied, and move the plant as these do.

    Between two kept instants a mass is elsewhere for a moment. At the second it is where it was, but for the forces
    that depended on its place and its rate: a motion whose band ends at a frequency [Hz] forgets the share of a moment
    that its phase turns by from one instant to the other. That must be no more than the part of the noise that an
    average may be off. How much an input accelerates an output is taken from their sizes.
    """
    spec = runs[0].spec
    left, whole, astray = (np.zeros(spec.nu) for _ in range(3))
    for run in runs:
        nodes = hat_projection(run.u, factor, intersample)
        rows = np.arange((len(nodes) - 1) * factor + 1) / factor
        for k in range(spec.nu):
            begin = run.u[: len(rows) - 1, k]
            end = run.u[1 : len(rows), k] if intersample == "foh" else begin
            line = np.interp(rows, np.arange(len(nodes)), nodes[:, k])
            rest = 0.5 * (begin + end) - 0.5 * (line[:-1] + line[1:])
            speed = np.concatenate([[0.0], np.cumsum(rest)[:-1]])  # of a mass, at the beginning of each row
            place = np.cumsum(speed + (begin - line[:-1]) / 3 + (end - line[1:]) / 6)
            left[k] += float(np.sum(rest**2))
            whole[k] += float(np.sum((begin - begin.mean()) ** 2))
            astray[k] += float(np.sum(place**2))
    moving = whole > 0
    if np.any(left[moving] > DATA_POLICY.input_left * whole[moving]):
        return False
    turn = 2 * np.pi * band * factor * spec.sample_time
    most = turn * float(np.sqrt(np.max(astray[moving] / whole[moving], initial=0.0)))
    noise = sensor_noise(runs)
    return all(most * _acceleration(runs, j, factor, noise[j]) <= DATA_POLICY.jump * noise[j] for j in range(spec.ny))


def _acceleration(runs: Sequence[Trajectory], output: int, half: int, noise: float) -> float:
    """Return the rms acceleration of an output times the square of a row's time, the part of the noise left out.

    Infinite where readings never lie side by side, as of a sensor that is slower than its record.
    """
    period = runs[0].spec.outputs[output].period
    long = [run.readings[:, output] for run in runs if len(run) > 2 * half]
    windows = np.concatenate([_windows(read, half, period) for read in long])
    if np.isnan(windows).any(axis=1).all():
        return float("inf")
    weights = 2 * np.linalg.pinv(np.vander(np.arange(-half, half + 1), 3))[0]
    size = np.nanmean((windows @ weights) ** 2) - noise**2 * np.sum(weights**2)
    return float(np.sqrt(max(size, 0.0)))
