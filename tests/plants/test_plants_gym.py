"""Gymnasium both ways: its own checker passes our environments, its environments run as plants."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from harness.errors import InputError, PlantError
from harness.protocols import Experiment, Plant
from harness.rng import stream
from harness.rollout import perform
from plants.finite.mdp import grid_mdp
from plants.gym import GymPlant, environment
from plants.pymunk.cart_pole import PymunkCartPole

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'sysid-harness[gym]'")


@pytest.mark.parametrize("make", [PymunkCartPole, grid_mdp])
def test_gymnasiums_checker_passes_our_plants(make: type[Plant]) -> None:
    from gymnasium.utils.env_checker import check_env

    env = environment(make(), samples=50)
    with warnings.catch_warnings():
        # Advice for learners: actions in [-1, 1], finite observations. A plant has its own units.
        warnings.filterwarnings("ignore", message=".*(infinity|symmetric|normalized|not being set|spec).*")
        check_env(env, skip_render_check=True)
    env.close()


def test_an_episode_is_the_plant_and_ends_by_length() -> None:
    with PymunkCartPole() as plant:
        env = environment(PymunkCartPole(), samples=20, x0={"theta": 0.4}, reward=lambda y, u: -float(y[1] ** 2))
        seen, _ = env.reset(seed=0)
        expected = plant.reset(rng=np.random.default_rng(0), x0={"theta": 0.4})
        for k in range(20):
            assert np.array_equal(seen, expected)
            seen, gained, terminated, truncated, _ = env.step(np.array([1.0]))
            expected = plant.step(np.array([1.0]))
            assert gained == -(expected[1] ** 2)
            assert (terminated, truncated) == (False, k == 19)
        env.close()


def test_an_environment_runs_as_a_plant() -> None:
    torque = np.sin(np.arange(100) * 0.1)[:, None]
    with GymPlant("Pendulum-v1", output_names=["cos", "sin", "rate"], input_names=["u"]) as plant:
        assert str(plant.spec) == "u [1] -> cos [1], sin [1], rate [1] every 0.05 s"
        once = perform(plant, Experiment(torque), rng=stream("gym", 0))
        again = perform(plant, Experiment(torque), rng=stream("gym", 0))
    assert np.array_equal(once.y, again.y)
    np.testing.assert_allclose(once.y[:, 0] ** 2 + once.y[:, 1] ** 2, 1.0, atol=1e-6)


def test_the_end_of_an_episode_is_a_status_and_bad_actions_are_refused() -> None:
    with GymPlant("CartPole-v1") as plant:
        plant.reset(rng=stream("gym", 1))
        with pytest.raises(InputError, match=r"0\.\.1"):
            plant.step(np.array([0.5]))
        with pytest.raises(PlantError, match="ended") as caught:
            perform(plant, Experiment(np.ones((200, 1))), rng=stream("gym", 1))
        assert caught.value.status == "terminated"
        with pytest.raises(InputError, match="initial state"):
            plant.reset(rng=stream("gym", 1), x0={"x": 0.0})


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="registered id"):
        GymPlant("NoSuchThing-v9")
    with pytest.raises(InputError, match="u_limit"):
        environment(PymunkCartPole(u_limit=np.inf))
