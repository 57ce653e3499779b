"""Motion of a record: what the filter and the differences make of it, with held and with smooth inputs."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from harness.diagnosis.records.motion import motion_band, smooth_motion
from harness.signals import Channel, PlantSpec, Trajectory

COLUMNS: dict[str, tuple[int | None, int | None]] = {"q": (0, None)}


def swing(cycles: float, n: int = 4000) -> Trajectory:
    """Return a random-phase multisine of lines up to ``cycles`` per sample (dt = 0.01), driven by its acceleration."""
    rng = np.random.default_rng(0)
    lines = np.arange(1, round(cycles * n) + 1)
    spectrum = np.zeros(n // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
    omega = 2 * np.pi * np.arange(n // 2 + 1) / (n * 0.01)
    q, force = np.fft.irfft(spectrum, n), np.fft.irfft(-(omega**2) * spectrum, n)
    q = q + 1e-4 * q.std() * rng.standard_normal(n)
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.01)
    return Trajectory(np.arange(n) * 0.01, force[:, None], q[:, None], spec)


@pytest.mark.parametrize("cycles", [0.05, 0.15, 0.2])
def test_smooth_signals_are_followed_up_to_a_fifth_of_the_sample_rate(cycles: float) -> None:
    run = swing(cycles)
    motion = smooth_motion(run, COLUMNS, "smooth")
    inside = motion.inside
    error = motion.a[inside, 0] - motion.u[inside, 0]  # the input is the acceleration itself
    assert np.sqrt(np.mean(error**2)) < 0.08 * motion.u[inside].std()
    slope = np.gradient(motion.q[:, 0], motion.sample_time)[inside]
    assert np.corrcoef(slope, motion.v[inside, 0])[0, 1] > 0.999


@pytest.mark.parametrize("intersample", ["zoh", "foh"])
def test_held_inputs_keep_their_grid_and_the_mean_of_both_sides(intersample: Literal["zoh", "foh"]) -> None:
    run = swing(0.02)
    motion = smooth_motion(run, COLUMNS, intersample)
    assert motion.sample_time == run.spec.sample_time
    assert len(motion.q) == len(run)
    wanted = run.u if intersample == "foh" else 0.5 * (run.u + np.concatenate([run.u[:1], run.u[:-1]]))
    assert np.array_equal(motion.u, wanted)


def test_a_held_input_cuts_what_differences_cannot_follow_and_a_smooth_one_does_not() -> None:
    run = swing(0.2)
    assert motion_band(run.y[:, 0], 0.01)[0] > 0.1 / 0.01
    true = float(np.std(run.u))
    held, smooth = smooth_motion(run, COLUMNS, "zoh"), smooth_motion(run, COLUMNS, "smooth")
    assert held.a[held.inside].std() < 0.5 * true
    assert smooth.a[smooth.inside].std() == pytest.approx(true, rel=0.1)
    assert smooth.sample_time < run.spec.sample_time
