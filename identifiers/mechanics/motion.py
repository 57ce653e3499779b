"""Coordinates, rates and accelerations of a mechanism from what was measured of it, within one record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from harness.errors import FitError
from harness.signals import FloatArray, Trajectory

_TUNED_ON = 800


def rts(signal: FloatArray, dt: float, *, noise: float | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a signal smoothed by a Kalman filter and its backward pass, with its first and second derivative.

    The third derivative is modelled as white noise (Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2.3); its intensity is
    the one of largest likelihood on the first samples. The backward pass is that of Rauch, Tung & Striebel (1965, AIAA
    J. 3:1445).

    - ``signal`` (N,): uniformly sampled, N >= 8
    - ``dt``: sample time [s]
    - ``noise``: standard deviation of the sensor; by default from the fourth difference of the signal
    - returns ``value, rate, acceleration`` (N,)

    Examples
    --------
    >>> t = np.arange(300) * 0.01
    >>> rough = np.sin(2 * t) + 1e-3 * np.random.default_rng(0).normal(size=300)
    >>> value, rate, _ = rts(rough, 0.01)
    >>> bool(np.abs(rate - 2 * np.cos(2 * t))[20:-20].max() < 0.03)
    True
    """
    y = np.asarray(signal, dtype=float)
    if noise is None:
        fourth = np.diff(y, 4)
        noise = 1.4826 * float(np.median(np.abs(fourth - np.median(fourth)))) / np.sqrt(70.0)
    scale = float(np.ptp(y)) or 1.0
    sigma = max(noise, 1e-9 * scale)
    part = y[:_TUNED_ON]
    span = max(dt * len(part), dt)
    candidates = scale / span**3 * np.sqrt(span) * np.logspace(0, 7, 15)
    best = max(candidates, key=lambda intensity: _likelihood(part, dt, sigma, float(intensity)))
    filtered = _filter(y, dt, sigma, float(best))
    means, covariances, _, _ = filtered.batch_filter(y)
    smoothed = filtered.rts_smoother(means, covariances)[0]
    found: FloatArray = np.asarray(smoothed, dtype=float).reshape(len(y), 3)
    return found[:, 0], found[:, 1], found[:, 2]


def _filter(y: FloatArray, dt: float, sigma: float, intensity: float) -> Any:
    """Return a filter for position, rate and acceleration, started on the first samples."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=3, dim_z=1)
    kalman.F = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    kalman.H = np.array([[1.0, 0.0, 0.0]])
    kalman.R = np.array([[sigma**2]])
    powers = np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    kalman.Q = intensity**2 * powers
    scale = float(np.ptp(y)) or 1.0
    kalman.x = np.array([[y[0]], [0.0], [0.0]])
    kalman.P = np.diag([sigma**2, (scale / dt) ** 2, (scale / dt**2) ** 2])
    return kalman


def _likelihood(y: FloatArray, dt: float, sigma: float, intensity: float) -> float:
    """Return the log-likelihood of the innovations, the start left out."""
    kalman = _filter(y, dt, sigma, intensity)
    total = 0.0
    for k, value in enumerate(y):
        kalman.predict()
        kalman.update(value)
        if k >= 5:
            variance = float(np.squeeze(kalman.S))
            miss = float(np.squeeze(kalman.y))
            total -= 0.5 * (miss**2 / variance + np.log(variance))
    return total


Smoothing = Literal["auto", "local", "spline", "kalman", "forward", "causal", "none"]
# Leave-one-out errors below this fraction of the signal's travel are the cubics' own, not noise.
_CLEAN = 1e-6
_PASSED = 0.05
"""Noise that a spline through all samples may put on the second derivative, relative to that: least squares on such
regressors is biased by the square, 0.25 %."""
_REACH = 4 * 0.2652 / 9
"""Bandwidth of a smoothing spline, per sample of local cubics that keep as much of white noise: the square of its
kernel (Silverman 1984, Ann. Statist. 12:898) integrates to 0.2652, a cubic through w samples keeps 9 / (4 w).
"""


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of one record, away from its ends."""

    # (N,), (N, n): Time, coordinates, rates, accelerations
    t: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray
    # (N, nu): Input held from each instant on, and its mean over the samples before and after
    u: FloatArray
    mean_u: FloatArray
    width: int  # Samples that the smoothing spans (1: none)
    widths: tuple[int, ...] = ()
    """The same for each coordinate (0: the spline was taken), so that a copy can be smoothed alike."""


def motion(
    system: Any,
    record: Trajectory,
    smoothing: Smoothing = "auto",
    *,
    like: Motion | None = None,
    coarser: bool = False,
) -> Motion:
    """Return the motion of a mechanism from a record of positions, with rates where they are measured too.

    Parameters
    ----------
    system : harness.physics.System
        Anything whose ``coordinates`` have names.
    record : Trajectory
        Outputs named after the coordinates, rates ``NAME_rate`` or ``NAME_dot``, accelerations ``NAME_acceleration``.
    smoothing : {"auto", "local", "spline", "kalman", "forward", "causal", "none"}
        ``causal`` fits a cubic to the past samples only, as a filter on the machine must. ``none`` takes what was
        measured as it is, and derivatives of the spline for what was not.
    like : Motion, optional
        Of this record, or of one that this one is a noisier copy of: the same smoothing is applied, away from the
        same ends.
    coarser : bool
        With half as much more smoothing than that (a cubic in place of a quintic spline): how far the two differ is
        how far the smoothing bends the motion.

    Raises
    ------
    FitError
        If a coordinate is not measured.
    """
    columns = {channel.name: i for i, channel in enumerate(record.spec.outputs)}
    names = [coordinate.name for coordinate in system.coordinates]
    missing = [name for name in names if name not in columns]
    if missing:
        raise FitError(
            "lumped parameters need every coordinate measured",
            expected=", ".join(names),
            got=", ".join(columns),
            remedy=f"measure {', '.join(missing)}, or use output-error",
        )
    dt, n = record.spec.sample_time, len(record)
    q, v, a = np.empty((n, len(names))), np.empty((n, len(names))), np.empty((n, len(names)))
    widths: list[int] = []
    for i, name in enumerate(names):
        given = None if like is None else like.widths[i]
        position = _unwrapped(record, columns[name])
        rate = next((columns[f"{name}{s}"] for s in ("_rate", "_dot") if f"{name}{s}" in columns), None)
        if rate is None:
            q[:, i], v[:, i], a[:, i], own = _derivatives(position, dt, smoothing, given, coarser)
        else:
            q[:, i] = _derivatives(position, dt, smoothing, given, coarser)[0]
            v[:, i], a[:, i], _, own = _derivatives(record.y[:, rate], dt, smoothing, given, coarser)
        if f"{name}_acceleration" in columns:
            measured = record.y[:, columns[f"{name}_acceleration"]]
            a[:, i] = _derivatives(measured, dt, smoothing, given, coarser)[0]
        widths.append(own if given is None else given)
    width = max(1, *widths)
    mean_u = np.vstack([record.u[:1], 0.5 * (record.u[1:] + record.u[:-1])])
    edge = 1 if smoothing == "forward" else max(width // 2, 2)
    inner = slice(0, n - edge) if smoothing == "forward" else slice(edge, n - edge)
    if smoothing == "causal":
        inner = slice(width, n)
    if smoothing == "none":
        inner = slice(0, n)
    elif n <= 3 * edge + 12:
        inner = slice(0, n - 1)
    t, u = record.t[inner], record.u[inner]
    return Motion(t, q[inner], v[inner], a[inner], u, mean_u[inner], width, tuple(widths))


def between(moved: Motion) -> Motion:
    """Return a motion with the instants half-way between its samples put in, by cubics through both ends.

    What this changes in an integral over the motion is about its quadrature error.
    """
    step = np.diff(moved.t)[:, None] / 8

    def woven(samples: FloatArray, middles: FloatArray) -> FloatArray:
        found = np.empty((2 * len(samples) - 1, *samples.shape[1:]))
        found[::2], found[1::2] = samples, middles
        return found

    def halves(value: FloatArray, rate: FloatArray) -> FloatArray:
        return woven(value, 0.5 * (value[1:] + value[:-1]) + step * (rate[:-1] - rate[1:]))

    plain = 0.5 * (moved.a[1:] + moved.a[:-1])
    return replace(
        moved,
        t=woven(moved.t, 0.5 * (moved.t[1:] + moved.t[:-1])),
        q=halves(moved.q, moved.v),
        v=halves(moved.v, moved.a),
        a=woven(moved.a, plain),
        u=woven(moved.u, moved.u[:-1]),
        mean_u=woven(moved.mean_u, moved.u[:-1]),
    )


def noise_level(signal: FloatArray) -> float:
    """Return the standard deviation of the white noise on a smooth signal, from the top quarter of its spectrum.

    The median of the periodogram there, of the signal without its trend under a Hann window: what moves slowly, and
    single kinks, do not reach it (the median of an exponential variable is ln 2 of its mean).

    - ``signal`` (N,): uniformly sampled, unwrapped

    Examples
    --------
    >>> t = np.arange(2000) * 0.01
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=t.size)
    >>> round(noise_level(np.sin(3 * t) + noise), 3)
    0.01
    """
    n = signal.size
    if n < 16:
        return 0.0
    line = np.linspace(signal[0], signal[-1], n)
    window = np.hanning(n)
    power = np.abs(np.fft.rfft((signal - line) * window)) ** 2 / np.sum(window**2)
    return float(np.sqrt(np.median(power[3 * power.size // 4 :]) / np.log(2)))


def noisier(record: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return a record with as much white noise added to each output as it has already.

    What this changes in a regressor is as large as what the noise has put there.
    """
    y = np.array(record.y, dtype=float)
    for column in range(y.shape[1]):
        signal = _unwrapped(record, column)
        # rounding of the numbers themselves is noise, too
        size = max(noise_level(signal), 1e-15 * float(np.abs(signal).max(initial=0.0)))
        y[:, column] = signal + size * rng.normal(size=len(signal))
    channels = tuple(replace(channel, period=None) for channel in record.spec.outputs)
    return Trajectory(record.t, record.u, y, replace(record.spec, outputs=channels))


def _unwrapped(record: Trajectory, column: int) -> FloatArray:
    period = record.spec.outputs[column].period
    signal = record.y[:, column]
    return np.asarray(signal if period is None else np.unwrap(signal, period=period), dtype=float)


def _derivatives(
    signal: FloatArray, dt: float, smoothing: Smoothing, width: int | None = None, coarser: bool = False
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Return the signal, its first and second derivative, and the samples that the smoothing spans (0: spline)."""
    if smoothing == "forward":
        rate = np.append(np.diff(signal), 0.0) / dt
        return signal, rate, np.append(np.diff(rate), 0.0) / dt, 1
    if smoothing == "kalman":
        return (*rts(signal, dt), 9)
    from harness.physics.fitting.smoothing import local_cubics, smooth

    if coarser and width:
        width = 2 * (3 * width // 4) + 1
    if smoothing == "causal":
        own = max(width or smooth(signal, dt).width, 5)
        return (*_trailing_cubic(signal, dt, own), own)
    if smoothing in ("auto", "local") and width:
        return (*local_cubics(signal, width, dt), width)
    if smoothing in ("auto", "local") and width is None:
        found = smooth(signal, dt)
        travel = float(np.ptp(signal)) or 1.0
        if smoothing == "local" or found.width > 5 or found.error > _CLEAN * travel:
            return found.value, found.rate, found.acceleration, found.width
    from scipy.interpolate import make_interp_spline, make_smoothing_spline

    coarser = coarser and smoothing != "none"
    t = np.arange(signal.size) * dt
    # A held input makes the acceleration jump at every sample: cubic pieces between them, not higher ones.
    spline = make_interp_spline(t, signal, k=3 if signal.size < 6 or coarser else 5)
    if smoothing == "spline" and signal.size >= 5:
        passed = np.sqrt(6.0) / dt**2 * noise_level(signal)
        noisy = passed > _PASSED * float(np.std(spline.derivative(2)(t)))
        taken = width if width is not None else smooth(signal, dt).width if noisy else 0
        if taken:
            spline = make_smoothing_spline(t, signal, lam=(_REACH * taken * dt) ** 4 / dt)
            return spline(t), spline.derivative()(t), spline.derivative(2)(t), taken
    return signal, spline.derivative()(t), spline.derivative(2)(t), 0


def _trailing_cubic(signal: FloatArray, dt: float, width: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return value, first and second derivative at the last of the samples of a cubic through the past ones."""
    powers = np.vander(np.arange(1 - width, 1) * dt, 4, increasing=True)
    taps = np.linalg.pinv(powers)[:3] * np.array([[1.0], [1.0], [2.0]])
    padded = np.concatenate([np.full(width - 1, signal[0]), signal])
    windows = np.lib.stride_tricks.sliding_window_view(padded, width)
    value, rate, acceleration = (windows @ tap for tap in taps)
    return value, rate, acceleration
