"""Position, speed and acceleration of every coordinate from the measured outputs, smoothed without delay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from harness.diagnosis.policy import DATA_POLICY
from harness.diagnosis.systems import AnySystem, by_equations
from harness.effects import Signals
from harness.signals import FloatArray, Trajectory

ORDER = 4
MOST = 20
HELD, SMOOTH = 0.1, 0.2
"""Share of the sample rate up to which the motion is followed: with the mean over a held sample and differences of
second order, and with smooth signals and differences of fourth order."""


@dataclass(frozen=True)
class SmoothedMotion:
    """Smoothed motion of one record."""

    t: FloatArray  # (N,)
    # (N, n): Coordinates, rates, accelerations
    q: FloatArray
    v: FloatArray
    a: FloatArray
    u: FloatArray  # (N, nu): Input at the instants (mean of both sides of a jump)
    inside: slice  # Rows that the ends of the filters have not touched
    factor: int  # By how much a residual of these may be decimated without losing the motion's band
    sample_time: float
    counts: FloatArray | None = None
    """(N, n): 1 where the residual of a coordinate says something, 0 where it could be anything; all of them if not
    given."""
    cutoff: float = float("inf")  # Up to where the motion was followed [Hz]

    def signals(self, u: FloatArray | None = None) -> Signals:
        """Return the motion as effects take it, with other inputs (N, nu) if given."""
        return Signals(self.t, self.u if u is None else u, self.q, self.v, self.a, ramps=True)


def measured_coordinates(system: AnySystem) -> dict[str, tuple[int | None, int | None]] | None:
    """Return for each coordinate the columns of y that hold its position and its rate.

    None if a coordinate has neither, or if there are no coordinates: then no equation error can be formed.
    """
    import casadi as ca

    columns: dict[str, tuple[int | None, int | None]] = {}
    if not by_equations(system):
        return None
    for coordinate in system.coordinates:
        position = rate = None
        for j in range(system.ny):
            if ca.is_equal(system.h[j], system.x[coordinate.q]):
                position = j
            elif ca.is_equal(system.h[j], system.x[coordinate.v]):
                rate = j
        if position is None:
            return None
        columns[coordinate.name] = (position, rate)
    return columns or None


def motion_is_state(system: AnySystem) -> bool:
    """Return True if the positions of all coordinates are measured, and no other state drives or is driven.

    Only then do the equations of motion have a residual force along a record: a current is not in it.
    """
    return measured_coordinates(system) is not None and system.nx == 2 * len(system.coordinates)


def motion_band(
    position: FloatArray, sample_time: float, above: float = 10.0, *, derivative: int = 1
) -> tuple[float, float]:
    """Return where the motion lives in the spectrum of ``position`` (N,).

    - ``position`` (N,)
    - ``sample_time``: [s]
    - ``above``: times by which a position that is clear stands above its noise, in power
    - ``derivative``: 1 for the band of the rate, 2 for that of the acceleration: of the forces

    Returns
    -------
    band : float
        Frequency [Hz] below which 95 % of the power of the rate, or of the acceleration, lies.
    clear : float
        Highest frequency [Hz] up to which the position stands clear of its noise.
    """
    from scipy import signal

    n = position.size
    x = signal.detrend(np.asarray(position, dtype=float))
    f, power = signal.welch(x, 1 / sample_time, "blackman", nperseg=min(n, max(256, n // 4)))
    # beyond the point where the noise takes over, the power of a differentiated signal only grows
    noise = float(np.median(power[-max(power.size // 4, 1) :]))
    clear = power > above * noise
    last = int(np.argmin(clear[1:])) + 1 if not clear[1:].all() else power.size - 1
    weighted = np.where(np.arange(power.size) < max(last, 2), power * f ** (2 * derivative), 0.0)
    total = np.cumsum(weighted)
    if total[-1] <= 0:
        return 0.05 / sample_time, 0.05 / sample_time
    return float(f[min(int(np.searchsorted(total, 0.95 * total[-1])), f.size - 1)]), float(f[last])


def smooth_motion(
    run: Trajectory,
    columns: dict[str, tuple[int | None, int | None]],
    intersample: str = "zoh",
    *,
    by_rates: bool = False,
) -> SmoothedMotion:
    """Return the motion of a record.

    Zero-phase Butterworth low-pass of order 4 (Gautier, Janot & Vandanjon, IEEE Trans. Control Syst. Technol. 21:428,
    2013), then central differences; a measured rate is filtered and differenced once.

    - ``run``: the record
    - ``columns``: from :func:`measured_coordinates`
    - ``intersample`` {"zoh", "foh", "smooth"}: a held input jumps at the sample; the smoothed motion there belongs to
      the mean of both sides. Without this every balance of forces would see half a sample of delay. Smooth signals are
      interpolated where the motion reaches beyond a fifth of the sample rate.
    - ``by_rates``: follow the motion as far as a measured rate is clear of its noise, beyond where its position is
    """
    from scipy import signal

    measured = len(run)
    if intersample == "smooth":
        run = _interpolated(run, [position for position, _ in columns.values() if position is not None])
    dt, n = run.spec.sample_time, len(run)
    bands = [motion_band(run.y[:, position], dt) for position, _ in columns.values() if position is not None]
    band = max(width for width, _ in bands)
    highest = (SMOOTH if intersample == "smooth" else HELD) / dt
    told = [clear for _, clear in bands]
    if by_rates:
        told += [motion_band(run.y[:, rate], dt)[1] for _, rate in columns.values() if rate is not None]
    cutoff = float(np.clip(max(told), min(5 * band, highest), highest))
    sos = signal.butter(ORDER, 2 * cutoff * dt, output="sos")
    touched = DATA_POLICY.ringing * (n // measured) if n > measured else 0
    edge = int(np.clip(round(1.5 / (cutoff * dt)) + touched, 4, max(n // 8, 4)))

    def derivative(x: FloatArray) -> FloatArray:
        second = np.gradient(x, dt)
        return second if intersample != "smooth" else second - np.gradient(np.gradient(second)) / 6

    q, v, a = [], [], []
    for position, rate in columns.values():
        if position is None:
            continue
        channel = run.spec.outputs[position]
        raw = run.y[:, position]
        if channel.period is not None:
            raw = np.unwrap(raw, period=channel.period)
        pad = min(3 * edge, n - 1)
        smooth = signal.sosfiltfilt(sos, raw, padlen=pad)
        speed = derivative(smooth) if rate is None else signal.sosfiltfilt(sos, run.y[:, rate], padlen=pad)
        q.append(smooth)
        v.append(speed)
        a.append(derivative(speed))
    factor = int(np.clip(1 / (10 * band * dt), 1, MOST))
    while factor > 1 and (n - 2 * edge) // factor < 100:
        factor -= 1
    position_of, speed_of, acceleration_of = (np.stack(part, axis=1) for part in (q, v, a))
    u = run.u
    if intersample == "zoh" and n > 1:
        u = 0.5 * (u + np.concatenate([u[:1], u[:-1]]))
    if (by_rates or intersample == "smooth") and u.size:  # a balance of forces is linear in them: one filter for both
        u = signal.sosfiltfilt(sos, u, axis=0, padlen=min(3 * edge, n - 1))
    return SmoothedMotion(
        run.t, position_of, speed_of, acceleration_of, u, slice(edge, n - edge), factor, dt, cutoff=cutoff
    )


def _interpolated(run: Trajectory, positions: list[int]) -> Trajectory:
    """Return a record of band-limited signals on a finer grid, if the motion needs one to be followed."""
    from scipy import signal

    dt, n = run.spec.sample_time, len(run)
    factor = int(np.ceil(max(motion_band(run.y[:, position], dt)[1] for position in positions) * dt / SMOOTH))
    if factor <= 1:
        return run

    def finer(x: FloatArray, period: float | None = None) -> FloatArray:
        known = x if period is None else np.unwrap(x, period=period)
        return np.asarray(signal.resample_poly(known, factor, 1, padtype="line"))

    u = [finer(run.u[:, k]) for k in range(run.u.shape[1])]
    y = [finer(run.y[:, j], channel.period) for j, channel in enumerate(run.spec.outputs)]
    t = run.t[0] + np.arange(n * factor) * dt / factor
    inputs = np.stack(u, axis=1) if u else np.zeros((n * factor, 0))
    return Trajectory(t, inputs, np.stack(y, axis=1), replace(run.spec, sample_time=dt / factor))


def thinned(motion: SmoothedMotion, most: int = 6000) -> SmoothedMotion:
    """Return a motion with fewer samples where its band allows, the input averaged over each step.

    - ``most``: samples wanted at most; never thinned to less than five decimated samples in one
    """
    n = motion.q.shape[0]
    step = max(1, min(motion.factor // 5, -(-n // most)))
    if step == 1:
        return motion
    rows = n // step
    middle = step // 2

    def pick(x: FloatArray) -> FloatArray:
        return np.asarray(x[middle : middle + (rows - 1) * step + 1 : step])

    u = motion.u[: rows * step].reshape(rows, step, motion.u.shape[1]).mean(axis=1)
    edge = -(-motion.inside.start // step)
    return SmoothedMotion(
        pick(motion.t),
        pick(motion.q),
        pick(motion.v),
        pick(motion.a),
        u,
        slice(edge, rows - edge),
        motion.factor // step,
        motion.sample_time * step,
    )
