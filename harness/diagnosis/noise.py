"""The noise floor of each output, and where the figure comes from.

In this order: a value declared in the data set; repeated periods of a periodic input; the fourth difference, only
where the top octave of the spectrum is flat and a linear model predicts one sample ahead nearly as well; the free run
of a validated high-order black box at the horizon the model is judged at; else unknown (None), never 0.
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
    "top_octave",
]

PREDICTED = 2.5
"""One step ahead, white sensor noise on an oversampled signal costs a linear predictor 1.2 to 1.8 times itself; an
error beyond this is the plant's own, and no model reaches the sensor's noise."""

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
