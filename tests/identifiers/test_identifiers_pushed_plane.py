"""Inertia and frictions of an object that is pushed and turns, from another engine's contact; and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import FitError, InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.mechanics.pushed_plane import Contact, cone, contacts, object_in_plane

PLACES = {"x": 1e-4, "y": 1e-4, "theta": 1e-4, "x_pusher": 1e-4, "y_pusher": 1e-4, "fx": 0.05, "fy": 0.05}
PUSH = {"amplitude": {"u": 10.0, "aim": 0.02}, "offset": {"u": 6.0}, "dwell": 0.4, "noise": PLACES}


def recorded(seed: int, duration: float = 15.0, options=None, **push) -> Dataset:
    streams = Streams("pushed-object-pymunk", "steps", seed=seed)
    with create("plants", "pushed-object-pymunk", **(options or {"com_x": 0.01, "com_y": -0.005})) as plant:
        scenario = create("scenarios", "steps", duration=duration, **{**PUSH, **push})
        record = run(plant, scenario, streams=streams, role="estimation/0").measured()
    return Dataset("object", (Run(record),))


@pytest.fixture(scope="module")
def data():
    return recorded(0)


def test_inertia_centre_of_mass_and_both_frictions_are_found(data):
    found = api.analyse("pushed-in-plane", data)
    values = found.details["parameters"]
    assert values["m"] == pytest.approx(2.0, rel=0.05)
    assert values["J"] == pytest.approx(2 * 0.1**2 / 6, rel=0.15)
    assert values["mu"] == pytest.approx(0.4, rel=0.05)
    assert [values["com_x"], values["com_y"]] == pytest.approx([0.01, -0.005], abs=2.5e-3)
    assert 0.02 < values["r"] < 0.05  # the feet are 0.0495 m out; an ellipsoid is no square of feet
    assert found.details["cone"]["mu_tip"] == pytest.approx(0.3, rel=0.05)
    once, twice = (
        {row["parameter"]: row["value"] for row in found.rows if row["force"] == which}
        for which in ("as measured", "times 2")
    )
    for name, factor in (("m", 2), ("J", 2), ("mu", 1), ("com_x", 1), ("com_y", 1), ("r", 1)):
        assert twice[name] == pytest.approx(factor * once[name], rel=0.01), name


def test_an_object_that_hardly_turns_is_refused():
    still = recorded(0, duration=6.0, options={"m": 2.0}, amplitude={"u": 10.0, "aim": 1e-9})
    with pytest.raises(FitError, match="hardly turns"):
        api.analyse("pushed-in-plane", still)


def test_a_wrong_size_of_the_tip_leaves_no_contact_and_is_named(data):
    with pytest.raises(FitError, match="hardly any contact"):
        api.analyse("pushed-in-plane", data, options={"radius": 0.02})


def test_a_missing_column_is_named():
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"),), 0.01)
    record = Trajectory(0.01 * np.arange(200), np.ones((200, 1)), np.zeros((200, 1)), spec)
    with pytest.raises(InputError, match="a column y"):
        api.analyse("pushed-in-plane", Dataset("object", (Run(record),)))


def test_a_tip_that_never_slips_tells_a_bound_and_no_coefficient():
    count = 200
    angle = np.linspace(-0.2, 0.25, count)  # of the force against the normal
    held = Contact(
        np.tile([-0.05, 0.0], (count, 1)), np.tile([-1.0, 0.0], (count, 1)), np.ones(count, dtype=bool), np.zeros(count)
    )
    force = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    said = cone(held, force)
    assert said["mu_tip"] is None
    assert 0.15 < said["at least"] <= np.tan(0.25)
    slid = Contact(held.arm, held.normal, held.touching, np.full(count, -0.1))
    edge = 8.0 * np.tile([np.cos(0.3), np.sin(0.3)], (count, 1))
    assert cone(slid, edge)["mu_tip"] == pytest.approx(np.tan(0.3), rel=1e-9)


def test_contacts_turn_with_the_object_and_slip_is_against_it():
    t = 0.01 * np.arange(100)
    angle = 0.5 * t
    places = np.stack([0.1 * t, np.zeros(100)], axis=1)
    along = 0.01 + 0.03 * t  # the tip slides along the left side at 0.03 m/s
    local = np.stack([np.full(100, -0.06), along], axis=1)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tips = places + np.stack([
        turn[:, 0] * local[:, 0] - turn[:, 1] * local[:, 1], turn[:, 1] * local[:, 0] + turn[:, 0] * local[:, 1]
    ], axis=1)  # fmt: skip
    met = contacts(places, angle, tips, 0.05, 0.01, 0.01)
    assert met.touching.all()
    # the tip's middle turns around the contact at its radius as well: 0.5 rad/s times 0.01 m
    assert np.abs(met.slip[10:-10]) == pytest.approx(0.03, abs=0.006)
    assert np.sum(met.normal[50] * -turn[50]) == pytest.approx(1.0, abs=1e-4)


def test_three_known_feet_carry_the_weight_and_rub_as_coulomb_says():
    feet = ((0.04, 0.0), (-0.02, 0.035), (-0.02, -0.035))
    system = object_in_plane(feet=feet).system()
    values = system.vector({"m": 2.0, "J": 0.003, "mu": 0.4, "com_x": 0.0, "com_y": 0.0})
    simulator = system.simulator(0.001, backend="casadi")
    x = simulator.states(values, np.array([0, 0, 0, 0.5, 0, 0.0]), np.zeros((2, 3)))[1]
    assert (0.5 - x[3]) / 0.001 == pytest.approx(0.4 * 9.81, rel=1e-3)
    spun = simulator.states(values, np.array([0, 0, 0, 0, 0, 20.0]), np.zeros((2, 3)))[1]
    arms = np.hypot(*np.array(feet).T).mean()
    assert (20.0 - spun[5]) / 0.001 == pytest.approx(0.4 * 2.0 * 9.81 * arms / 0.003, rel=0.02)
