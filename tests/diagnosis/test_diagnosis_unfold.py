"""Signs that a sensor hides are found again, and not invented."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from harness.diagnosis.unfold import unfoldings
from harness.signals import Channel, PlantSpec, Trajectory

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
    assert found.turns > 10


def test_an_output_that_crosses_zero_or_stays_away_from_it_is_left_alone() -> None:
    u, y = response(0, 1.0)
    assert unfoldings([run(u, y)], 0) == []
    assert unfoldings([run(u, y - y.min() + 5.0)], 0) == []
