"""The pushed block: laws of contact, and mass and friction from the measured contact force."""

import numpy as np
import pytest

from plants.pymunk.pushed_block import PymunkPushedBlock


@pytest.fixture(scope="module")
def run():
    with PymunkPushedBlock() as plant:
        plant.reset(rng=np.random.default_rng(0))
        rng = np.random.default_rng(1)
        t = np.arange(1500) * 0.01
        u = np.where(np.sin(0.8 * np.pi * t) > 0, 14 + 5 * np.repeat(rng.uniform(-1, 1, 60), 25), -6.0)
        outputs, states = [], []
        for value in u:
            outputs.append(plant.step(np.array([value])))
            states.append(plant.truth())
    return u, np.array(outputs), np.array(states)


def test_the_block_obeys_newton_and_coulomb_while_it_slides(run):
    _, y, x = run
    sliding = (x[:-1, 2] > 0.03) & (x[1:, 2] > 0.03)
    left = y[1:, 2] - 2.0 * np.diff(x[:, 2]) / 0.01 - 0.4 * 2.0 * 9.81
    assert np.sqrt(np.mean(left[sliding] ** 2)) < 0.3
    assert np.median(np.abs(left[sliding])) < 1e-6


def test_the_pusher_pushes_and_never_pulls_and_nothing_overlaps(run):
    u, y, _ = run
    assert y[:, 2].min() > -1e-9
    assert y[:, 2].max() > 5.0
    assert (y[:, 0] - y[:, 1]).min() > -1e-3
    assert (np.diff(y[:, 0]) > -1e-6).all()  # a block that is only pushed never comes back
    assert u.min() < 0


def test_a_push_below_the_friction_moves_nothing():
    with PymunkPushedBlock(gap=0.0) as plant:
        plant.reset(rng=np.random.default_rng(0))
        y = plant.rollout(np.full((200, 1), 7.0))  # mu m g = 7.85
        assert abs(y[-1, 0]) < 5e-3  # Chipmunk takes overlaps away, by which the block creeps
        assert y[-100:, 2].mean() == pytest.approx(7.0, rel=0.02)


def test_mass_and_friction_need_the_contact_force(script):
    figures = script("docs/contact_figures.py")
    found = figures.contact(figures.pushed())
    mass, friction = found["contact force measured"]
    assert mass == pytest.approx(2.0, rel=0.03)
    assert friction == pytest.approx(0.4, rel=0.03)
    wrong = found["drive of the pusher taken for it"][0]
    assert abs(wrong / 2.0 - 1) > 0.2
