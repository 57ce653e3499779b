"""Identification and redesign in turns, and an object that is only touched: what their analyses say."""

from __future__ import annotations

import numpy as np
import pytest

from harness import api
from harness.errors import InputError
from harness.registry import create
from harness.rng import Streams
from harness.rollout import run
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory
from identifiers.online.redesign import repeatable_coverage

PLANT = {"sample_time": 0.05, "u_limit": 5.0}
ASKED = {
    "model": "pendulum",
    "believed": {"J": 0.15, "b": 0.05, "mgl": 0.6},
    "target": {"theta": np.pi},
    "starts": [{"theta": 3.0}, {"theta": 3.3}],
    "rounds": 2,
}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_cost_on_the_nonlinear_plant_falls_and_never_rises(seed):
    found = api.analyse("redesign", "pendulum-ode", subject_options=PLANT, options=ASKED, seed=seed)
    costs = [row["cost"] for row in found.rows]
    assert costs[1] < 0.97 * costs[0]
    taken = found.details["rounds"]
    assert taken >= 1
    assert found.details["falls"] == taken, "under noise that no decision has seen"
    assert all(row["change"] + 2 * row["error of it"] < 0 for row in found.rows[1 : taken + 1])
    assert all(costs[-1] == cost for cost in costs[taken:]), "the present controller stays"
    assert found.details["best"] * 0.99 < costs[-1] < found.details["best"] * 1.02
    assert found.rows[-1]["mgl"] == pytest.approx(1.0, rel=0.1)
    assert all(row["records"] >= 2 * row["round"] for row in found.rows)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_the_cost_falls_in_every_round_on_a_cart_pole_too(seed):
    asked = {
        "model": "cart-pole",
        "believed": {"mc": 1.5, "mp": 0.12, "l": 0.6},
        "target": {"theta": np.pi},
        "starts": [{"theta": 3.0}, {"theta": 3.3}],
        "samples": 80,
        "noise": 1e-3,
        "excitation": 0.5,
    }
    found = api.analyse("redesign", "cart-pole-ode", subject_options={"sample_time": 0.05}, options=asked, seed=seed)
    assert found.details["falls"] == found.details["rounds"] >= 1
    assert found.rows[1]["cost"] < 0.6 * found.rows[0]["cost"]
    assert abs(found.rows[-1]["cost"] / found.details["best"] - 1) < 0.01


def test_nothing_takes_over_where_the_first_controller_is_the_best_one():
    known = {**ASKED, "believed": {"J": 0.1, "b": 0.05, "mgl": 1.0}, "batches": 1, "rounds": 3}
    falls = [
        api.analyse("redesign", "pendulum-ode", subject_options=PLANT, options=known, seed=seed) for seed in range(2)
    ]
    for found in falls:
        assert abs(found.rows[-1]["cost"] / found.details["best"] - 1) < 0.005
        assert found.details["falls"] == found.details["rounds"]


def test_noise_makes_no_coverage():
    quiet = {**ASKED, "excitation": 1e-9, "starts": [{"theta": 3.14159}], "rounds": 1}
    found = api.analyse("redesign", "pendulum-ode", subject_options=PLANT, options=quiet)
    row = found.rows[-1]
    assert row["coverage"] < 0.2
    assert row["with noise"] > 0.3, "what the least singular value would say"
    assert "not fitted" in row["what was done"]
    assert found.details["rounds"] == 0
    rng = np.random.default_rng(0)
    white = rng.normal(size=(4000, 3))
    noisy = [white + 0.1 * rng.normal(size=white.shape) for _ in range(2)]
    assert repeatable_coverage(*noisy) == pytest.approx(1.0, abs=0.05)


def test_what_is_believed_and_where_to_start_have_to_be_said():
    with pytest.raises(InputError, match="believed parameters"):
        api.analyse("redesign", "pendulum-ode")
    with pytest.raises(InputError, match="model and plant"):
        api.analyse("redesign", "cart-pole-ode", options=ASKED)


def test_mass_and_friction_of_a_block_of_another_engine_need_the_contact_force():
    streams = Streams("pushed-block-pymunk", "steps", seed=0)
    options = dict(duration=10.0, amplitude=20.0, offset=6.0, dwell=0.4, noise={"x": 1e-4, "f": 0.05})
    with create("plants", "pushed-block-pymunk") as plant:
        record = run(plant, create("scenarios", "steps", **options), streams=streams, role="estimation/0").measured()
    found = api.analyse("pushed-object", Dataset("block", (Run(record),)))
    felt, doubled, drive = found.rows
    assert felt["m [kg]"] == pytest.approx(2.0, rel=0.1)
    assert felt["mu"] == pytest.approx(0.4, rel=0.15)
    assert doubled["m [kg]"] == pytest.approx(2 * felt["m [kg]"], rel=0.01)
    assert doubled["mu"] == pytest.approx(felt["mu"], rel=0.01)
    assert drive["rms [m]"] > 1.5 * felt["rms [m]"]


def test_a_missing_column_is_named():
    spec = PlantSpec((Channel("u", "N"),), (Channel("x", "m"),), 0.01)
    record = Trajectory(0.01 * np.arange(200), np.ones((200, 1)), np.zeros((200, 1)), spec)
    with pytest.raises(InputError, match="a column f"):
        api.analyse("pushed-object", Dataset("block", (Run(record),)))


def test_the_glider_s_signs_decide_more_than_its_functions():
    streams = Streams("glider-ode", "filtered-noise", seed=0)
    with create("plants", "glider-ode") as plant:
        scenario = create("scenarios", "filtered-noise", duration=0.9, noise=1e-5)
        records = [run(plant, scenario, streams=streams, role=f"estimation/{k}").measured() for k in range(3)]
    found = api.analyse("glider-functions", Dataset("glider", tuple(Run(record) for record in records)))
    left = {(row["signs"], row["functions"]): row["sum of squares"] for row in found.rows}
    assert left["consistent", 1] < 0.05 * left["as written", 1]
    assert left["consistent", 3] < left["consistent", 2] < left["consistent", 1]
    with pytest.raises(InputError, match="most = 1, 2 or 3"):
        api.analyse("glider-functions", Dataset("glider", (Run(records[0]),)), options={"most": 4})
