"""Records without input at a lower sample rate: nothing that matters is lost."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.noise import top_octave
from harness.diagnosis.residual_tests import max_autocorrelation
from harness.diagnosis.thinning import thinned_dataset, white_keeping_filter
from harness.physics.models import pendulum
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.001)


def swing(noise: float, *, moving: bool = False) -> Dataset:
    runs = []
    for role, use in enumerate(("estimation", "validation")):
        t = np.arange(12000) * 0.001
        rng = np.random.default_rng(role)
        y = np.exp(-0.1 * t) * np.cos(8 * t) + noise * rng.standard_normal(t.size)
        u = rng.standard_normal((t.size, 1)) if moving else np.zeros((t.size, 1))
        runs.append(Run(Trajectory(t, u, y[:, None], SPEC), use))  # type: ignore[arg-type]
    return Dataset("swing", tuple(runs), noise={"theta": noise} if noise else {})


def test_a_free_swing_keeps_its_shape_and_says_what_was_done() -> None:
    thin = thinned_dataset(swing(0.0), pendulum().system())
    run = thin.estimation[0]
    assert 0.005 <= thin.spec.sample_time <= 0.03
    np.testing.assert_allclose(run.y[:, 0], np.exp(-0.1 * run.t) * np.cos(8 * run.t), atol=2e-4)
    assert any("1000 Hz" in text for text in thin.warnings)


def test_white_noise_stays_white_and_its_declared_level_follows() -> None:
    thin = thinned_dataset(swing(0.01), pendulum().system())
    run = thin.estimation[0]
    rest = run.y[:, 0] - np.exp(-0.1 * run.t) * np.cos(8 * run.t)
    assert np.std(rest) == pytest.approx(thin.noise["theta"], rel=0.08)
    assert thin.noise["theta"] < 0.005
    assert max_autocorrelation(rest) < 4 / np.sqrt(rest.size)
    assert top_octave(run.y[:, 0]).flat


def test_records_with_a_moving_input_stay_as_they_are() -> None:
    data = swing(0.01, moving=True)
    assert thinned_dataset(data, pendulum().system()) is data


@pytest.mark.parametrize("factor", [2, 7, 14])
def test_the_filter_leaves_every_kept_sample_of_white_noise_independent(factor: int) -> None:
    taps = white_keeping_filter(factor)
    full = np.convolve(taps, taps[::-1])
    kept = full[len(taps) - 1 :: factor] / full[len(taps) - 1]
    assert np.abs(kept[1:]).max() < 0.01
