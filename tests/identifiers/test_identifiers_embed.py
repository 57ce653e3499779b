"""Embed to control: what a latent state of a cart-pole seen through keypoints is worth for control."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path

import numpy as np
import pytest

from harness.errors import FitError
from harness.scoring import control_score, simulation_error
from harness.scoring.control import LinearPlantModel
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.learned.embed import EmbedToControl, LatentModel

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install 'sysid-harness[learned]'"
)
KEYPOINTS = Path(os.environ.get("SYSID_HARNESS_DATA", "-")) / "textbook" / "cartpole_keypoints.npz"
A = np.array([[0.95, 0.1], [-0.2, 0.9]])
B = np.array([[0.0], [0.3]])


def camera(records: int, seed: int, samples: int = 90) -> list[Trajectory]:
    """Return records of two states that six bent keypoints show, one sample without their rates."""
    rng = np.random.default_rng(seed)
    look = np.random.default_rng(99).normal(size=(6, 2))
    spec = PlantSpec((Channel("u", "N"),), tuple(Channel(f"p{i}", "m") for i in range(6)), 0.1)
    made = []
    for _ in range(records):
        u, x, y = rng.normal(size=(samples, 1)), 0.3 * rng.normal(size=2), np.empty((samples, 6))
        for k in range(samples):
            seen = look @ x
            y[k] = seen + 0.3 * np.tanh(seen) + 0.005 * rng.normal(size=6)
            x = A @ x + B @ u[k]
        made.append(Trajectory(np.arange(samples) * 0.1, u, y, spec))
    return made


@pytest.fixture(scope="module")
def fitted() -> LatentModel:
    options = dict(latent=2, lags=2, hidden=8, window=10, steps=300, batch=64)
    return EmbedToControl(**options).fit(camera(10, 0), rng=np.random.default_rng(0))


def test_the_latent_state_predicts_and_has_the_dynamics_of_the_plant(fitted):
    (held,) = camera(1, 1)
    assert simulation_error(fitted, held).nrmse.mean() < 0.06
    assert np.sort_complex(np.linalg.eigvals(fitted.a_matrix)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(A)), abs=0.04
    )


def test_the_linearised_model_is_that_of_small_steps(fitted):
    x, u, du = fitted.rest, fitted.u_mean, np.array([1e-5])
    dx = 1e-5 * np.array([0.6, -0.8])
    moved = fitted.step(x + dx, u + du) - fitted.step(x, u)
    assert moved == pytest.approx(fitted.a_matrix @ dx + fitted.b_matrix @ du, rel=1e-3)
    assert fitted.output(x + dx, u) - fitted.output(x, u) == pytest.approx(fitted.c_matrix @ dx, rel=1e-3, abs=1e-10)


def test_it_comes_back_from_its_file(fitted):
    read = LatentModel.from_dict(json.loads(json.dumps(fitted.to_dict())))
    (held,) = camera(1, 2)
    assert np.array_equal(simulation_error(read, held).rms, simulation_error(fitted, held).rms)


def test_a_latent_state_larger_than_what_moves_is_refused():
    spec = PlantSpec((Channel("u"),), (Channel("a"), Channel("b")), 0.1)
    rng = np.random.default_rng(0)
    data = Trajectory(np.arange(200) * 0.1, rng.normal(size=(200, 1)), np.tile(rng.normal(size=(200, 1)), 2), spec)
    with pytest.raises(FitError, match="directions move"):
        EmbedToControl(latent=9, steps=1).fit([data], rng=rng)


@pytest.mark.skipif(not KEYPOINTS.is_file(), reason="the recording cartpole_keypoints.npz is not in SYSID_HARNESS_DATA")
def test_the_keypoint_cart_pole_is_controlled_nearly_as_well_as_by_its_own_design():
    data = np.load(KEYPOINTS)
    spec = PlantSpec((Channel("u", "N"),), tuple(Channel(f"k{i}", "m") for i in range(24)), 0.05)
    runs = [
        Trajectory(np.arange(len(u)) * 0.05, u.copy(), y.copy(), spec)
        for u, y in zip(data["U"].swapaxes(1, 2), data["Y"].swapaxes(1, 2), strict=True)
    ]
    model = EmbedToControl(steps=600).fit(runs[:20], rng=np.random.default_rng(0))
    plant = LinearPlantModel(data["A"], data["B"], data["C"], data["D"])
    pulses = [plant.c_matrix @ np.linalg.matrix_power(plant.a_matrix, k) @ plant.b_matrix for k in range(40)]
    power = float(np.mean(np.square(pulses)))
    eye = np.eye(24)  # all keypoints weigh alike: some never move, and must not be divided by what a pulse does to them
    score = control_score(model, plant, q=eye / (24 * power), sensor=1e-4 * power * eye)
    assert score.status == "ok"
    assert score.ratio < 1.3
