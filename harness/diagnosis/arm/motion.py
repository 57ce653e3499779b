"""Measured motion of an arm: smoothed joints, and the torques that rigid bodies need along it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from harness.diagnosis.policy import ARM_POLICY
from harness.diagnosis.records.motion import ORDER, SmoothedMotion, motion_band, smooth_motion
from harness.diagnosis.runs.equation import decimated
from harness.physics.arms.arm import ArmModel
from harness.signals import Dataset, FloatArray, Trajectory

USES = ("estimation", "validation", "test")
STEP = 1e-4
"""Of derivatives by differences: of a position, rate or acceleration, and of a parameter over its value."""


@dataclass(frozen=True)
class ArmRun:
    """One record of an arm.

    Attributes
    ----------
    motion : Motion
        q, v, a (N, n) of all joints; u holds the measured torques.
    calm : Motion
        The same, filtered down to twice the band of the motion: regressors are taken from it. The residual holds
        M times the noise of the acceleration; a regressor with that noise would follow it (a mass comes out too
        small), and feedback carries it into the torques as well (an elasticity comes out of nothing).
    first : array (N, n)
        Time derivatives of the torques that regressors are taken from: the calm ones, or where the motion is clear.
    rigid : array (N, n)
        Torque that the nominal arm needs along the motion, the URDF's damping and friction included.
    corner : float
        Of the calm motion [Hz].
    noise : array (n,)
        Of the samples of the measured torques, before any filter.
    clear : float
        Up to where all accelerations are free of noise [Hz].
    twist : array (N, n) or None
        By how much links are behind their motors, where springs are known: gradients are taken half way.
    """

    motion: SmoothedMotion
    calm: SmoothedMotion
    first: FloatArray
    rigid: FloatArray
    corner: float
    noise: FloatArray
    clear: float
    twist: FloatArray | None = None

    @property
    def sharp(self) -> ArmRun:
        """The record with its true motion in the place of the calm one: what a known inertia needs there."""
        return replace(self, calm=replace(self.motion, u=self.calm.u))

    def calmed(self, values: FloatArray) -> FloatArray:
        """Return columns (N,) or (N, k) filtered as the calm motion is."""
        return low_passed(values, self.corner, self.motion.sample_time)

    def followed(self, values: FloatArray) -> FloatArray:
        """Return columns (N,) or (N, k) filtered as the motion and the torques are: what jumps does so there too."""
        return low_passed(values, self.motion.cutoff, self.motion.sample_time)

    def slim(self, columns: FloatArray, joints: Sequence[int] | None = None) -> FloatArray:
        """Return columns (N, n) or (N, n, k) of these joints, low-passed and decimated as the residual is."""
        flat = columns.reshape(columns.shape[0], -1)
        counts = self.motion.counts if joints is None or self.motion.counts is None else self.motion.counts[:, joints]
        result = decimated(flat, replace(self.motion, counts=counts))
        return result.reshape(result.shape[0], *columns.shape[1:])


def arm_runs(arm: ArmModel, dataset: Dataset) -> dict[str, tuple[ArmRun, ...]]:
    """Return the records by use, all decimated by the same factor.

    Torques are means over a sample where the input is held, see :func:`harness.diagnosis.records.motion.smooth_motion`.
    """
    runs = {use: [_run(arm, record, dataset.intersample) for record in dataset.using(use)] for use in USES}  # type: ignore[arg-type]
    factor = min(run.motion.factor for parts in runs.values() for run in parts)
    return {
        use: tuple(replace(run, motion=replace(run.motion, factor=factor)) for run in parts)
        for use, parts in runs.items()
    }


def moving_rows(motion: SmoothedMotion) -> FloatArray:
    """Return 1 for every row (rows, n) of the decimated residual in which a joint moves, 0 where it stands still.

    While a joint stands still its dry friction is whatever keeps it there, anywhere between minus and plus its level:
    no law of the motion can say it, so these rows are not judged.
    """
    from scipy.ndimage import maximum_filter1d

    assert motion.counts is not None
    still = motion.counts[motion.inside] == 0
    width = 2 * motion.factor + 1 if motion.factor > 1 else 1
    touched = maximum_filter1d(still.astype(np.uint8), width, axis=0)
    rows = touched[:: motion.factor]
    if motion.factor > 1:  # the ends that decimated() cuts off
        cut = 10 if rows.shape[0] > 200 else 2
        rows = rows[cut:-cut]
    return np.asarray(1.0 - rows)


def standstill(runs: Mapping[str, Sequence[ArmRun]]) -> FloatArray:
    """Return for every joint the share of the estimation time (n,) in which it stands still.

    A sine spends 5 % of its time there, a sum of many sines 8 %; a joint that sticks far more.
    """
    v = np.concatenate([run.calm.v[run.motion.inside] for run in runs["estimation"]])
    size = np.sqrt(np.mean(v**2, axis=0))
    return np.asarray(np.mean(np.abs(v) <= ARM_POLICY.still * size, axis=0))


def _run(arm: ArmModel, record: Trajectory, intersample: str) -> ArmRun:
    """Return one record as a motion."""
    names = [channel.name for channel in record.spec.outputs]
    columns: dict[str, tuple[int | None, int | None]] = {}
    for k, position in enumerate(arm.positions):
        rate = f"{position.name}_rate"
        columns[position.name] = (k, names.index(rate) if rate in names else None)
    motion = smooth_motion(record, columns, intersample, by_rates=True)
    differenced = [intersample == "zoh" and rate is None for _, rate in columns.values()]
    motion = replace(motion, a=_of_held_torques(motion.a, differenced))
    rigid = arm.torques(motion.q, motion.v, motion.a) + arm.damped(motion.v)
    band = max(motion_band(record.y[:, k], motion.sample_time)[0] for k in range(arm.n))
    still = np.abs(motion.v) <= ARM_POLICY.still * np.sqrt(np.mean(motion.v[motion.inside] ** 2, axis=0))
    motion = replace(motion, counts=1.0 - (still | _pauses(still, motion)))
    clear = _clear(record, columns)
    corner = max(ARM_POLICY.calm * band, min(clear, 0.5 / (motion.factor * motion.sample_time)))
    calm = _calmed(motion, corner)
    calm = replace(calm, a=_of_held_torques(calm.a, differenced))
    noise = np.array([white_noise(record.u[:, k]) for k in range(arm.n)])
    return ArmRun(
        motion,
        calm,
        np.gradient(calm.u, motion.sample_time, axis=0),
        rigid,
        corner,
        noise,
        max(clear, ARM_POLICY.calm * band),
    )


def torque_gradient(
    arm: ArmModel, motion: SmoothedMotion, joint: int, of: int, parameters: FloatArray | None = None
) -> FloatArray:
    """Return gradients (N, n) of all torques along a motion by a joint's position (0), rate (1) or acceleration (2)."""
    step, sides = np.zeros(arm.n), []
    step[joint] = STEP
    for side in (step, -step):
        moved = [motion.q, motion.v, motion.a]
        moved[of] = moved[of] + side
        sides.append(arm.torques(moved[0], moved[1], moved[2], parameters=parameters))
    return np.asarray((sides[0] - sides[1]) / (2 * STEP))


def _of_held_torques(a: FloatArray, differenced: Sequence[bool]) -> FloatArray:
    """Return accelerations (N, n) that go with the means of held torques.

    An inertia under held torques has second differences of its position that are these means, ``4 sin(x/2)^2`` over
    the square of a step at x radians a step; differenced twice centrally it has ``sin(x)^2``, less by ``x^2/4``. Its
    measured rate has no such error.
    """
    more = np.zeros_like(a)
    more[1:-1] = np.diff(a, 2, axis=0) / 4
    return np.asarray(a - more * np.asarray(differenced))


def _pauses(still: NDArray[np.bool_], motion: SmoothedMotion) -> NDArray[np.bool_]:
    """Return where joints (N, n) pause, and as far around it as the filter of the torques carries what is unknown."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    width = max(round(0.5 / (motion.cutoff * motion.sample_time)), 1)
    long = minimum_filter1d(still.astype(np.uint8), width, axis=0)
    return np.asarray(maximum_filter1d(long, 3 * width, axis=0) > 0)


def white_noise(signal: FloatArray) -> float:
    """Return the standard deviation of white noise in an oversampled signal (N,), from its fourth difference.

    Examples
    --------
    >>> y = np.sin(np.arange(5000) * 0.01) + 0.01 * np.random.default_rng(0).standard_normal(5000)
    >>> round(white_noise(y), 3)
    0.01
    """
    d = np.diff(np.asarray(signal, dtype=float), 4)
    return 1.4826 * float(np.median(np.abs(d - np.median(d)))) / float(np.sqrt(70.0))


def _clear(record: Trajectory, columns: dict[str, tuple[int | None, int | None]]) -> float:
    """Return up to where all accelerations are free of noise [Hz]."""
    parts = [record.y[:, position if rate is None else rate] for position, rate in columns.values()]
    return min(motion_band(part, record.spec.sample_time, ARM_POLICY.clear)[1] for part in parts)


def clear_factor(runs: Mapping[str, Sequence[ArmRun]]) -> int:
    """Return by how many samples records are decimated to the band in which the motion of all of them is clear."""
    bands = [min(run.clear, run.motion.cutoff) * run.motion.sample_time for parts in runs.values() for run in parts]
    return max(int(ARM_POLICY.kept / min(bands)), 1)


def clear_runs(runs: Mapping[str, Sequence[ArmRun]]) -> dict[str, tuple[ArmRun, ...]]:
    """Return the records with their true motion, decimated to the band in which all of it is free of noise.

    A calm motion, whose filter bends what lies near its corner, would pass for a spring, and so would the noise of a
    sharp one beyond that band, however short the record: a resonance at its end takes the noise of the accelerations
    out of the torques that are needed. So would the jumps of dry friction in a torque that is recorded a fraction of a
    sample late, if its rate were that of the calm torque: it is taken in the same band as all else.
    """
    factor = clear_factor(runs)
    return {
        use: tuple(
            replace(
                run.sharp,
                motion=replace(run.motion, factor=factor),
                first=np.gradient(run.motion.u, run.motion.sample_time, axis=0),
            )
            for run in parts
        )
        for use, parts in runs.items()
    }


def _calmed(motion: SmoothedMotion, corner: float) -> SmoothedMotion:
    """Return a motion low-passed without delay at a corner [Hz]."""
    q, v, u = (low_passed(part, corner, motion.sample_time) for part in (motion.q, motion.v, motion.u))
    return replace(motion, q=q, v=v, a=np.gradient(v, motion.sample_time, axis=0), u=u)


def low_passed(values: FloatArray, corner: float, sample_time: float) -> FloatArray:
    """Return columns (N,) or (N, k) low-passed without delay at a corner [Hz], as they are if samples end below it."""
    from scipy import signal

    if 2 * corner * sample_time >= ARM_POLICY.unfiltered:
        return values
    sos = _low_pass(2 * corner * sample_time)
    pad = min(int(4 / (corner * sample_time)), len(values) - 1)
    return np.asarray(signal.sosfiltfilt(sos, values, axis=0, padlen=pad))


@functools.cache
def _low_pass(corner: float) -> FloatArray:
    """Return the filter of a corner over half of the sample rate, as second-order sections."""
    from scipy import signal

    return np.asarray(signal.butter(ORDER, corner, output="sos"))
