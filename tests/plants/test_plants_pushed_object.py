"""The pushed object that turns: laws of contact and friction that the plant has to keep."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from identifiers.mechanics.pushed_plane import contacts
from plants.pymunk.pushed_object import FOOT, HALF, TIP, PymunkPushedObject

OPTIONS = {"com_x": 0.01, "com_y": -0.005}


@pytest.fixture(scope="module")
def pushed():
    """A push of three seconds that changes its place, at 1 kHz: outputs and true states."""
    rng = np.random.default_rng(2)
    u, aim = (np.repeat(rng.uniform(low, high, 8), 375) for low, high in ((4, 16), (-0.02, 0.02)))
    with PymunkPushedObject(**OPTIONS, sample_time=0.001, substeps=4) as plant:
        outputs, states = [plant.reset(rng=rng)], [plant.truth()]
        for held in zip(u, aim, strict=True):
            outputs.append(plant.step(np.array(held)))
            states.append(plant.truth())
        return np.array(outputs), np.array(states), dict(plant.true_parameters)


def friction(state: np.ndarray, p: dict[str, float]) -> tuple[np.ndarray, float]:
    """Return force, and torque about the centre of mass, of Coulomb friction under the four feet."""
    turn = np.array([[np.cos(state[2]), -np.sin(state[2])], [np.sin(state[2]), np.cos(state[2])]])
    force, torque = np.zeros(2), 0.0
    for i in (-1, 1):
        for j in (-1, 1):
            place = turn @ [i * FOOT, j * FOOT]
            arm = place - turn @ [p["com_x"], p["com_y"]]
            v = state[5:7] + state[7] * np.array([-place[1], place[0]])
            load = p["m"] * 9.81 / 4 * (1 + i * p["com_x"] / FOOT) * (1 + j * p["com_y"] / FOOT)
            drag = -p["mu"] * load * v / np.hypot(*v)
            force, torque = force + drag, torque + arm[0] * drag[1] - arm[1] * drag[0]
    return force, torque


def test_newton_and_euler_hold_with_the_measured_force_and_coulomb_friction(pushed):
    y, x, p = pushed
    met = contacts(y[:, :2], y[:, 2], y[:, 3:5], HALF, TIP, 0.001)
    com = np.array([
        [np.cos(a) * p["com_x"] - np.sin(a) * p["com_y"], np.sin(a) * p["com_x"] + np.cos(a) * p["com_y"]]
        for a in x[:, 2]
    ])  # fmt: skip
    v = x[:, 5:7] + x[:, 7:8] * np.stack([-com[:, 1], com[:, 0]], axis=1)
    checked = 0
    for k in range(0, len(x) - 1, 7):
        arm = met.arm[k] - com[k]
        slow = min(np.hypot(*(x[k, 5:7] + x[k, 7] * np.array([-b, a]))) for a in (-0.04, 0.04) for b in (-0.04, 0.04))
        if slow < 0.02 or np.hypot(*y[k + 1, 5:]) > 40:
            continue  # a foot that nearly stands, an impact
        drag, torque = friction(0.5 * (x[k] + x[k + 1]), p)
        force = y[k + 1, 5:]
        assert p["m"] * (v[k + 1] - v[k]) / 0.001 == pytest.approx(force + drag, abs=0.4)
        moment = arm[0] * force[1] - arm[1] * force[0] + torque
        assert p["J"] * (x[k + 1, 7] - x[k, 7]) / 0.001 == pytest.approx(moment, abs=0.02)
        checked += 1
    assert checked > 100


def test_the_contact_pushes_within_its_friction_cone(pushed):
    y, _, p = pushed
    met = contacts(y[:, :2], y[:, 2], y[:, 3:5], HALF, TIP, 0.001)
    force, normal = y[1:, 5:], met.normal
    pressed = -np.sum(force * normal, axis=1)
    along = force[:, 1] * normal[:, 0] - force[:, 0] * normal[:, 1]
    on = met.touching & (pressed > 0.5)
    assert on.sum() > 300
    assert pressed.min() > -0.05
    assert (np.abs(along[on]) < (p["mu_tip"] + 0.02) * pressed[on]).all()
    assert (np.abs(along[on]) > 0.98 * p["mu_tip"] * pressed[on]).any(), "it slips at times"
    away = y[:, 3:5] - y[:, :2]
    turned = np.abs(np.stack([
        np.cos(y[:, 2]) * away[:, 0] + np.sin(y[:, 2]) * away[:, 1],
        np.cos(y[:, 2]) * away[:, 1] - np.sin(y[:, 2]) * away[:, 0],
    ], axis=1))  # fmt: skip
    outside = np.maximum(turned - HALF, 0.0)
    assert np.hypot(*outside.T).min() > TIP - 1e-3, "they do not overlap"


def test_it_stays_where_it_is_without_a_push_and_stops_when_it_was_pushed():
    with PymunkPushedObject(**OPTIONS) as plant:
        begin = plant.reset(rng=np.random.default_rng(0))
        assert plant.rollout(np.zeros((50, 2)))[-1, :3] == pytest.approx(begin[:3], abs=1e-9)
        plant.reset(rng=np.random.default_rng(0), x0={"x": 1.0, "x_rate": 0.5, "theta_rate": 3.0})
        plant.rollout(np.zeros((100, 2)))
        assert np.abs(plant.truth()[5:8]).max() < 1e-3
        way = plant.truth()[0] - 1.0
        assert 0.5**2 / (2 * 0.4 * 9.81) < way < 0.08, "turning takes from the friction that brakes it"


def test_the_true_state_begins_as_asked():
    with PymunkPushedObject(**OPTIONS) as plant:
        asked = {"x": 0.2, "y": -0.1, "theta": 0.7, "x_rate": 0.1, "y_rate": -0.2, "theta_rate": 2.0}
        plant.reset(rng=np.random.default_rng(0), x0=asked)
        names = [channel.name for channel in plant.spec.states]
        found = dict(zip(names, plant.truth(), strict=True))
        assert {name: found[name] for name in asked} == pytest.approx(asked, abs=1e-9)


def test_a_centre_of_mass_beyond_the_feet_is_refused():
    with pytest.raises(InputError, match="between the feet"):
        PymunkPushedObject(com_x=0.04)
    with PymunkPushedObject() as plant:
        plant.reset(rng=np.random.default_rng(0))
        with pytest.raises(InputError):
            plant.step(np.array([1.0]))
