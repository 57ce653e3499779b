"""Prediction-error fits of a plant that is sampled fast: the best start is taken, nothing ends on the unit circle."""

import numpy as np
import pytest
from scipy import signal

from harness.scoring import simulation_error
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.linear.prediction_error import PredictionError

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "mm"),), 0.05)
PLANT = signal.cont2discrete(signal.tf2ss([2.0], np.polymul([1, 0.6, 4.0], [0.5, 1])), 0.05)
NOISE = 0.02


def oversampled(seed, samples=1200, noise=NOISE, colour=0.0):
    """A resonance of 0.32 Hz and a lag of 0.5 s at 20 Hz, three samples late."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 5), 5)
    y = signal.dlsim((*PLANT[:4], 0.05), np.concatenate([np.zeros(3), u[:-3]]))[1]
    late = signal.lfilter([1.0], [1.0, -colour], rng.normal(size=(samples, 1)), axis=0) * np.sqrt(1 - colour**2)
    return Trajectory(np.arange(samples) * 0.05, u[:, None], y + noise * late, SPEC)


@pytest.mark.parametrize("structure", ["oe", "armax", "bj"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_structure_finds_the_plant_on_every_seed(structure, seed):
    model = PredictionError(structure=structure, order=3, delay=4).fit(
        [oversampled(seed)], rng=np.random.default_rng(0)
    )
    assert simulation_error(model, oversampled(50, noise=0.0)).nrmse[0] < 0.03
    assert model.notes["residual_rms"][0] < 1.02 * NOISE  # as low as at the truth


@pytest.mark.parametrize("structure", ["armax", "bj"])
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_noise_models_forget_the_start_of_the_record(structure, colour):
    data = oversampled(4, colour=colour)
    model = PredictionError(structure=structure, order=3, delay=4).fit([data], rng=np.random.default_rng(0))
    for polynomials in model.notes["polynomials"]:
        for letter in ("c", "d"):
            roots = np.abs(np.roots([1.0, *polynomials[letter]]))
            assert roots.max(initial=0.0) <= 1.0 - 4.0 / len(data)


def test_box_and_jenkins_keep_a_noise_model_where_there_is_one():
    white, coloured = (
        PredictionError(structure="bj", order=3, delay=4).fit([oversampled(5, colour=c)], rng=np.random.default_rng(0))
        for c in (0.0, 0.9)
    )
    assert not np.any(white.filter_gain)
    assert np.any(coloured.filter_gain)
