"""The noise floor of each output, and where the figure comes from.

In this order: a value declared in the data set; repeated periods of a periodic input; stretches of the input that
come back after the plant was elsewhere; the fourth difference, only where the top octave of the spectrum is flat and a
linear model predicts one sample ahead nearly as well; the free run of a validated high-order black box at the horizon
the model is judged at, only where it stays as near to its one-step error; else unknown (None), never 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.diagnosis.black_box import BlackBox, fit_black_box, one_step_error
from harness.signals import Dataset, FloatArray

__all__ = [
    "NoiseFloor",
    "TopOctave",
    "fourth_difference",
    "noise_floors",
    "period_of",
    "repeated_periods",
    "repeated_stretches",
    "top_octave",
]

PREDICTED = 2.5
"""One step ahead, white sensor noise on an oversampled signal costs a linear predictor 1.2 to 1.8 times itself; an
error beyond this is the plant's own, and no model reaches the sensor's noise."""

STRETCH = 64
"""Samples over which an input must come back; a stretch to read the noise from is twice as long at least."""
ALIKE = 0.05
"""By how much of its size an input may differ to count as the same."""
LAGS = 24
"""Lags tried for stretches that come back, the most alike first."""

Source = Literal["declared", "repeated_periods", "fourth_difference", "black_box"]


@dataclass(frozen=True)
class NoiseFloor:
    """Standard deviation of what no model of one output can predict, with its source.

    Attributes
    ----------
    output, unit : str
        The channel.
    value : float or None
        In ``unit``; None if unknown.
    source : str or None
        ``declared``, ``repeated_periods``, ``fourth_difference``, ``black_box``; None if unknown.
    note : str
        What was found on the way, for the honesty box.
    """

    output: str
    unit: str
    value: float | None
    source: Source | None
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``report.json``."""
        return {"value": self.value, "unit": self.unit, "source": self.source, "note": self.note}


def noise_floors(
    dataset: Dataset, *, horizon: float | None = None, tested: BlackBox | None = None
) -> tuple[NoiseFloor, ...]:
    """Return the noise floor of every output.

    Parameters
    ----------
    dataset : Dataset
        Estimation and validation runs are used; test runs are not looked at.
    horizon : float, optional
        Seconds after which the judged model's initial state is estimated anew; None is the whole record. The free
        run of the black box uses the same.
    tested : BlackBox, optional
        A black box already fitted to these data at this horizon.
    """
    runs = (*dataset.estimation, *dataset.validation)
    floors: list[NoiseFloor] = []
    black = tested
    for j, channel in enumerate(dataset.spec.outputs):
        here = NoiseFloor(channel.name, channel.unit, None, None)
        series = [run.y[:, j] for run in runs]
        declared = dataset.noise.get(channel.name)
        if declared is not None and declared > 0:
            floors.append(replace(here, value=float(declared), source="declared", note="declared in the data set"))
            continue
        found = [repeated_periods(run.u, run.y[:, j]) for run in runs]
        values = [value for value in found if value is not None]
        if values:
            value = float(np.sqrt(np.mean(np.square(values))))
            floors.append(replace(here, value=value, source="repeated_periods", note="from periods of the input"))
            continue
        apart = [repeated_stretches(run.u, run.y[:, j]) for run in runs]
        values = [value for value in apart if value is not None]
        if values:
            value = float(np.sqrt(np.mean(np.square(values))))
            words = "from stretches of the input that come back after another motion"
            floors.append(replace(here, value=value, source="repeated_periods", note=words))
            continue
        tops = [top_octave(one) for one in series]
        if all(top.flat for top in tops):
            value = float(np.median([fourth_difference(one) for one in series]))
            ahead = one_step_error(dataset)[j]
            if not ahead > PREDICTED * value:
                floors.append(replace(here, value=value, source="fourth_difference", note="the top octave is flat"))
                continue
            reason = f"one sample ahead a linear model predicts no better than to {ahead:.3g}: the plant is disturbed"
        else:
            reason = _first_reason(tops)
        note = f"the fourth difference ({fourth_difference(series[0]):.3g}) is not used: {reason}"
        if black is None:
            black = fit_black_box(dataset, horizon=horizon)
        error = black.free_run[j] if black.validated else None
        if error is None:
            floors.append(replace(here, note=f"{note}; {black.note}"))
        elif error > PREDICTED * black.innovations[j]:
            far = f"but its free run is {error / black.innovations[j]:.1f} times its one-step error: not only noise"
            floors.append(replace(here, note=f"{note}; {black.note}, {far}"))
        else:
            floors.append(replace(here, value=error, source="black_box", note=f"{note}; {black.note}"))
    return tuple(floors)


def fourth_difference(y: FloatArray) -> float:
    """Return the standard deviation of white noise in an oversampled signal (N,), from its fourth difference.

    1.4826 MAD / sqrt(70) (the squares of 1, -4, 6, -4, 1 sum to 70), never below quantisation / sqrt(12).

    Examples
    --------
    >>> y = np.sin(np.arange(5000) * 0.01) + 0.01 * np.random.default_rng(0).standard_normal(5000)
    >>> round(fourth_difference(y), 3)
    0.01
    """
    d = np.diff(np.asarray(y, dtype=float), 4)
    if d.size == 0:
        return float("nan")
    spread = 1.4826 * float(np.median(np.abs(d - np.median(d)))) / float(np.sqrt(70.0))
    return max(spread, _quantum(y) / float(np.sqrt(12.0)))


@dataclass(frozen=True)
class TopOctave:
    """Shape of the spectrum between a quarter and half of the sampling frequency."""

    flat: bool
    reason: str
    level: float


def top_octave(y: FloatArray) -> TopOctave:
    """Judge whether the top octave of the spectrum of ``y`` (N,) shows white sensor noise and nothing else.

    Four quarters of the octave must agree within their scatter, no bin may stand out, and the noise read off the
    spectrum must agree with the fourth difference (it does not where the noise comes in bursts or is quantised).
    """
    from scipy import signal

    n = y.size
    if n < 256:
        return TopOctave(False, "fewer than 256 samples", float("nan"))
    per = int(np.clip(n // 16, 64, 1024))
    x = np.asarray(y, dtype=float)
    if np.ptp(x) == 0:
        return TopOctave(False, "the output does not move", 0.0)
    x = signal.detrend(x - np.linspace(x[0], x[-1], n))
    f, power = signal.welch(x, window="blackman", nperseg=per)
    octave = (f >= 0.25) & (f < 0.495)
    f, power = f[octave], power[octave]
    average = float(power.mean())
    if average <= 0:
        return TopOctave(False, "the top octave is empty", 0.0)
    level = float(np.sqrt(0.5 * average))
    quarters = np.array([power[(f >= a) & (f < a + 0.06125)].mean() for a in 0.25 + 0.06125 * np.arange(4)])
    averages = max(2.0 * n / per - 1.0, 1.0) * 0.7  # overlapping Blackman segments: independent ones
    scatter = 1.0 / np.sqrt(averages * max(power.size / 4 / 2.0, 1.0))
    off = float(np.abs(quarters / average - 1.0).max())
    if off > 0.03 + 3.5 * scatter:
        return TopOctave(False, f"its top octave is not flat (a quarter of it is off by {100 * off:.0f} %)", level)
    highest = float(power.max() / average)
    if highest > 1.0 + 5.5 / np.sqrt(averages):
        return TopOctave(False, f"a line stands {highest:.1f} times above its top octave", level)
    ratio = fourth_difference(y) / level
    if not 0.8 < ratio < 1.25:
        return TopOctave(False, f"spectrum and fourth difference disagree ({1 / ratio:.2f} times)", level)
    return TopOctave(True, "flat", level)


def period_of(u: FloatArray) -> int | None:
    """Return the period [samples] of an input record (N, nu), or None if it does not repeat at least twice.

    An input that never moves has no period.

    Examples
    --------
    >>> period_of(np.tile([[0.0], [1.0], [3.0]], (4, 1)))
    3
    """
    n = u.shape[0]
    if u.size == 0 or not np.ptp(u, axis=0).any():
        return None
    scale = np.ptp(u, axis=0)
    x = (u - u.mean(axis=0))[:, scale > 0] / scale[scale > 0]
    size = 1 << int(np.ceil(np.log2(2 * n)))
    power = np.sum(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, axis=1)
    raw = np.fft.irfft(power, size)[:n]
    before = np.r_[np.cumsum(np.sum(x**2, axis=1)[::-1])[::-1], 0.0]
    total = np.cumsum(np.sum(x**2, axis=1))
    lag = np.arange(1, n // 2 + 1)
    gap = before[lag] + total[n - 1 - lag] - 2 * raw[lag]  # sum of (x[k] - x[k - lag])^2
    for k in lag[gap <= 1e-9 * n]:
        if np.abs(x[k:] - x[:-k]).max() <= 1e-6:
            return int(k)
    return None


def repeated_periods(u: FloatArray, y: FloatArray) -> float | None:
    """Return the noise of ``y`` (N,) from periods of the input ``u`` (N, nu) that repeat, or None.

    The difference of the last two periods over sqrt(2). It is used only if it looks settled: the two halves of the
    difference agree within 25 %, and so does the difference of the periods before, where there is one.
    """
    period = period_of(u)
    if period is None or period < 64:
        return None
    last = y[-period:] - y[-2 * period : -period]
    value = float(np.sqrt(np.mean(last**2) / 2))
    half = period // 2
    halves = np.sqrt([np.mean(last[:half] ** 2), np.mean(last[half:] ** 2)])
    settled = halves.min() > 0 and halves.max() / halves.min() < 1.25 + 3.0 / np.sqrt(period)
    if y.size >= 3 * period:
        earlier = y[-2 * period : -period] - y[-3 * period : -2 * period]
        settled = settled and float(np.sqrt(np.mean(earlier**2) / 2)) < 1.25 * value
    return value if settled and value > 0 else None


def repeated_stretches(u: FloatArray, y: FloatArray) -> float | None:
    """Return the noise of ``y`` (N,) from stretches of the input ``u`` (N, nu) that come back, or None.

    A multisine whose every realisation runs on beyond its period repeats its beginning, and the realisation before
    made the plant come to it in another state. The difference of the outputs over sqrt(2) is used if it has settled:
    its third and last quarters agree within 25 %, and its beginning was three times larger. That shows that the plant
    forgets where it came from; what repeats in a control loop repeats from its beginning. A measured input need not
    repeat exactly, only to a twentieth of its size.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> wave = rng.standard_normal(600)
    >>> u = np.concatenate([rng.standard_normal(300), wave, wave[:400], rng.standard_normal(100)])
    >>> y = np.convolve(u, 0.9 ** np.arange(200))[:1400] + 0.1 * rng.standard_normal(1400)
    >>> bool(0.08 < repeated_stretches(u[:, None], y) < 0.12)
    True
    """
    n = u.shape[0]
    if n < 4 * STRETCH or u.size == 0 or not np.ptp(u, axis=0).any():
        return None
    spread = u.std(axis=0)
    x = (u - u.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    x = x / np.sqrt(x.shape[1])
    size = 1 << int(np.ceil(np.log2(2 * n)))
    alike = np.fft.irfft(np.sum(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, axis=1), size)[: n - 2 * STRETCH]
    alike[: 2 * STRETCH] = -np.inf
    parts: list[FloatArray] = []
    for lag in np.argsort(-alike)[:LAGS]:
        if not np.isfinite(alike[lag]):
            continue
        gap = _moving(np.sum((x[lag:] - x[:-lag]) ** 2, axis=1), STRETCH)
        power = _moving(np.sum(x[lag:] ** 2, axis=1), STRETCH)
        same = np.r_[False, (gap <= ALIKE**2 * power) & (power >= 0.25), False]
        first, last = np.flatnonzero(np.diff(same.astype(int)) == 1), np.flatnonzero(np.diff(same.astype(int)) == -1)
        pieces = [(a, b + STRETCH - 1) for a, b in zip(first, last, strict=True) if b - a >= STRETCH]
        parts = [(y[lag + a : lag + b] - y[a:b]) / np.sqrt(2.0) for a, b in pieces]
        if parts:
            break
    if not parts:
        return None

    def size_of(low: float, high: float) -> float:
        return float(np.sqrt(np.mean(np.concatenate([d[int(low * d.size) : int(high * d.size)] for d in parts]) ** 2)))

    start, third, value = size_of(0.0, 0.25), size_of(0.5, 0.75), size_of(0.75, 1.0)
    scatter = 3.0 / np.sqrt(sum(d.size for d in parts) / 4)
    settled = value > 0 and max(third, value) < (1.25 + scatter) * min(third, value)
    return value if settled and start > 3.0 * value else None


def _moving(x: FloatArray, width: int) -> FloatArray:
    """Return the means of ``x`` (N,) over ``width`` samples (N - width + 1,)."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    return np.asarray((total[width:] - total[:-width]) / width)


def _first_reason(tops: Sequence[TopOctave]) -> str:
    """Return why the first record that is not flat is not."""
    return next(top.reason for top in tops if not top.flat)


def _quantum(y: FloatArray) -> float:
    """Return the step of a quantised signal; 0 if its values do not sit on a grid of few steps."""
    values = np.unique(np.asarray(y, dtype=float))
    if values.size < 2 or values.size > 0.5 * y.size:
        return 0.0
    steps = np.diff(values)
    return float(np.median(steps[steps > 1e-9 * np.ptp(values)])) if np.ptp(values) > 0 else 0.0
