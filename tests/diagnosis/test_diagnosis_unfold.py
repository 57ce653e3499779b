"""Signs that a sensor hides are found again, and not invented."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from harness.diagnosis import close_loop
from harness.diagnosis.records.tracked_signs import tracked
from harness.diagnosis.records.unfold import unfoldings
from harness.effects import builtin
from harness.signals import Channel, Dataset, PlantSpec, Trajectory

from .conftest import pendulum_dataset

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "V"),), 0.02)


def run(u: np.ndarray, y: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(u)) * 0.02, u[:, None], y[:, None], SPEC)


def response(seed: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a random binary input and the response of a damped oscillator with a lag."""
    rng = np.random.default_rng(seed)
    u = size * np.repeat(np.sign(rng.standard_normal(40)), 8)
    poles = [0.94 * np.exp(0.37j), 0.94 * np.exp(-0.37j), 0.8]
    y = lfilter([0.0, 1.0], np.poly(poles).real, u)
    return u, np.asarray(y) / 10


def test_the_signs_of_a_rectified_output_are_found_but_for_the_common_one() -> None:
    truth = [response(seed, size) for seed, size in ((0, 1.0), (1, 0.5))]
    rng = np.random.default_rng(5)
    noise = 0.02 * np.std(truth[0][1])
    found = unfoldings([run(u, np.abs(y + noise * rng.standard_normal(len(y)))) for u, y in truth], 0)[0]
    agree = [float(np.mean(s * np.sign(y + 1e-12))) for s, (_, y) in zip(found.signs, truth, strict=True)]
    assert np.sign(agree[0]) == np.sign(agree[1])
    assert min(np.abs(agree)) > 0.9
    assert found.chance < 1e-3


def test_an_output_that_crosses_zero_or_stays_away_from_it_is_left_alone() -> None:
    u, y = response(0, 1.0)
    assert unfoldings([run(u, y)], 0) == []
    assert unfoldings([run(u, y - y.min() + 5.0)], 0) == []


# ---- motions that are followed through their zeros -------------------------------------------------------------------


def swing(seed: int, lines: int, longest: float, n: int = 1000) -> np.ndarray:
    """Return a sum of sines of periods from 60 samples on, rms 1."""
    rng = np.random.default_rng(seed)
    periods = np.geomspace(60.0, longest, lines)[:, None]
    waves = rng.uniform(0.3, 1.0, (lines, 1)) * np.sin(
        2 * np.pi * np.arange(n) / periods + rng.uniform(0, 7, (lines, 1))
    )
    total = waves.sum(axis=0)
    return np.asarray(total / np.sqrt(np.mean(total**2)))


@pytest.mark.slow
@given(
    seed=st.integers(0, 10_000),
    lines=st.integers(1, 5),
    longest=st.floats(60.0, 600.0),
    noise=st.sampled_from((1e-5, 1e-3, 1e-2)),
    size=st.sampled_from((1e-6, 1.0, 1e6)),
)
@settings(max_examples=25, deadline=None)
def test_a_followed_motion_has_the_right_signs(
    seed: int, lines: int, longest: float, noise: float, size: float
) -> None:
    """In any unit. A beat may fade out for so long that nobody knows the sign after it: then there are several."""
    y = swing(seed, lines, longest)
    folded = size * (np.abs(y) + noise * np.random.default_rng(seed).standard_normal(len(y)))
    paths = tracked(folded)
    assume(len(paths) == 1)
    path = paths[0]
    clear = np.abs(y) > 5 * noise
    right = np.mean((path.signs * np.sign(y))[clear])
    assert abs(right) > 0.999
    assert path.gain > 10


@pytest.mark.slow
def test_nearly_every_motion_is_followed() -> None:
    assert sum(len(tracked(np.abs(swing(seed, 3, 300.0)))) == 1 for seed in range(12)) >= 11


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), noise=st.sampled_from((1e-5, 1e-3, 1e-2)))
@settings(max_examples=10, deadline=None)
def test_a_motion_that_only_touches_zero_is_not_unfolded(seed: int, noise: float) -> None:
    y = swing(seed, 3, 300.0)
    touching = y - y.min() + noise * np.random.default_rng(seed).standard_normal(len(y))
    for record in (touching, y**2 + noise * np.random.default_rng(seed).standard_normal(len(y))):
        for path in tracked(record)[:1]:
            assert path.gain == 0.0
            assert (path.signs == 1.0).all()


def test_a_short_or_silent_record_decides_nothing() -> None:
    assert tracked(np.abs(swing(0, 2, 100.0))[:40]) == ()
    assert tracked(np.zeros(500)) == ()


@pytest.mark.slow
def test_followed_records_are_turned_to_answer_the_input_alike() -> None:
    """Each begins with an unknown sign; together only one is unknown."""
    runs, signs = [], []
    for seed in range(4):
        u = swing(seed, 4, 400.0, 1500)
        poles = [0.995 * np.exp(0.05j), 0.995 * np.exp(-0.05j)]
        y = np.asarray(lfilter([0.0, 1.0], np.poly(poles).real, u))[200:]
        noise = 1e-3 * np.std(y) * np.random.default_rng(seed).standard_normal(len(y))
        runs.append(run(u[200:], np.abs(y) + noise))
        signs.append(np.sign(y))
    first, second = unfoldings(runs, 0)
    agree = [float(np.mean(a * b)) for a, b in zip(first.signs, signs, strict=True)]
    assert min(np.abs(agree)) > 0.95
    assert len(set(np.sign(agree))) == 1
    for one, other in zip(first.signs, second.signs, strict=True):
        assert np.array_equal(one, -other)


def lingering(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return an input and a position that comes to rest at zero for a while, and goes on to one of its sides."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500)
    u = np.where(t % 500 < 300, 1.0, 0.0) * np.sin(2 * np.pi * t / 120 + rng.uniform(0, 7))
    poles = [0.99 * np.exp(0.05j), 0.99 * np.exp(-0.05j)]
    return u, np.asarray(lfilter([0.0, 1.0], np.poly(poles).real, u)) / 100


@pytest.mark.slow
def test_what_the_motion_does_not_tell_the_input_does() -> None:
    """At rest at zero a path loses its sign: several are as likely, and one of them answers the input everywhere."""
    runs, signs, clear = [], [], []
    for seed in range(2):
        u, y = lingering(seed)
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(len(y))
        runs.append(run(u, np.abs(y) + noise))
        signs.append(np.sign(y))
        clear.append(np.abs(y) > 0.01)
    assert max(len(tracked(one.y[:, 0])) for one in runs) > 1
    first, _ = unfoldings(runs, 0)
    agree = [float(np.mean((a * b)[c])) for a, b, c in zip(first.signs, signs, clear, strict=True)]
    assert min(np.abs(agree)) > 0.99
    assert len(set(np.sign(agree))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_a_pendulum_whose_sensor_loses_the_sign_is_named(noise: float, tmp_path: Path) -> None:
    """Large swings, simulated by hand-written laws: no linear model follows them."""
    data = pendulum_dataset(11, noise=0.0, amplitude=0.3)
    rng = np.random.default_rng(0)
    folded = []
    for one in data:
        y = np.abs(one.trajectory.y) + noise * rng.standard_normal(one.trajectory.y.shape)
        folded.append(replace(one, trajectory=replace(one.trajectory, y=y)))
    dataset = Dataset("folded", tuple(folded))
    assert np.abs(data.runs[0].trajectory.y).max() > 0.8
    rivals = ("sensor_rectification", "sensor_offset", "sensor_saturation", "coulomb_friction", "eccentric_load")
    report = close_loop(dataset, "pendulum", dictionary=[builtin()[name] for name in rivals], out=tmp_path / "r").data
    assert [one["name"] for one in report["effects"]] == ["sensor_rectification"]
    assert report["verdict"] == "effects_found"
    after = report["errors"]["after"]["simulation_error"]["validation"]["theta"]["rms"]
    assert after < 1.2 * noise
    page = (tmp_path / "r" / "report.html").read_text()
    assert "<th>meaning</th>" not in page  # it has no parameters
