"""What a fitted model is worth for control, by one command: facts of the model, and what its regulator costs."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from harness import api, registry
from harness.errors import InputError
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.control import LinearPlantModel
from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.koopman.koopman import Edmdc
from identifiers.learned.trees import RandomForest
from identifiers.linear.least_squares import StateLeastSquares

GROWING = {"A": [[1.1, 0.2], [0.0, 0.7]], "B": [[0.0], [1.0]]}


def record(noise: float):
    scenario = registry.create("scenarios", "prbs", samples=60, amplitude=1.0, noise=noise)
    with registry.create("plants", "linear", **GROWING) as plant:
        return run(plant, scenario, streams=Streams("linear", "prbs", 0), role="estimation/0").measured()


def test_a_command_tells_what_the_regulator_of_a_stored_model_costs(tmp_path: Path, sysid):
    model = tmp_path / "model.json"
    fitted = StateLeastSquares(least_excitation=0.0).fit([record(0.0)], rng=np.random.default_rng(0))
    model.write_text(json.dumps(fitted.to_dict()), encoding="utf-8")
    given = f"plant_options={{A={GROWING['A']}, B={GROWING['B']}}}"
    found = json.loads(sysid("analyse", "control-worth", model, "-O", "plant=linear", "-O", given, "--json").out)
    assert found["ratio"] == pytest.approx(1.0, abs=1e-9)
    assert [(row["states"], row["controllable"], row["stabilisable"]) for row in found["rows"]] == [(2, 2, True)] * 2
    assert found["rows"][0]["spectral radius"] == pytest.approx(1.1)
    assert found["rows"][0]["plant under its regulator"] < 1.0


def test_a_mode_that_no_input_reaches_is_told_and_what_does_not_hold_the_plant_too():
    unreached = LinearPlantModel(np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))
    found = api.analyse("control-worth", unreached)
    assert found.rows[0]["controllable"] == 1
    assert not found.rows[0]["stabilisable"]
    assert found.words[0] == "no regulator of it holds what grows"
    fitted = StateLeastSquares(least_excitation=0.0).fit([record(0.0)], rng=np.random.default_rng(0))
    turned = {**GROWING, "B": [[0.0], [-1.0]]}
    found = api.analyse("control-worth", fitted, options={"plant": "linear", "plant_options": turned})
    assert found.details["status"] == "unstable"


@functools.cache
def swings() -> list[Trajectory]:
    """Records of a pendulum whose states are measured, from anywhere below the top."""
    rng, found = np.random.default_rng(0), []
    with registry.create("plants", "pendulum-ode", **SEEN) as plant:
        for _ in range(60):
            start = {"theta": rng.uniform(-1.0, 4.5), "theta_rate": rng.uniform(-5.0, 5.0)}
            first, u = plant.reset(rng=rng, x0=start), np.repeat(rng.uniform(-2.0, 2.0, (8, 1)), 5, axis=0)
            y = np.vstack([first, plant.rollout(u[:-1])])
            found.append(Trajectory(0.05 * np.arange(40.0), u, y, PlantSpec((Channel("u"),), plant.spec.outputs, 0.05)))
    return found


SEEN = {"sample_time": 0.05, "u_limit": 2.0, "outputs": [["theta", 0], ["theta", 1]]}
UPRIGHT = {"plant": "pendulum-ode", "plant_options": SEEN, "at": {"theta": np.pi}, "q": [1.0, 0.1]}


def test_lifted_regulators_are_run_on_the_plant_beside_the_local_one(tmp_path: Path, sysid):
    """As docs/koopman.md: sine and cosine do as well as the local LQR in a swing-up, monomials do not."""
    data, found = swings(), {}
    asked = {**UPRIGHT, "starts": [{"theta": 0.0}, {"theta": 2.5}], "steps": 120, "horizon": 10}
    for name, options in {"sines": {"degree": 1, "trigonometric": True}, "cubes": {"degree": 3}}.items():
        model = Edmdc(**options).fit(data, rng=np.random.default_rng(0))
        found[name] = {row["controller"]: row for row in api.analyse("lifted-control", model, options=asked).rows}
    for name in ("lifted LQR", "lifted MPC"):
        assert found["sines"][name]["over local"] < 1.1
        assert found["sines"][name]["held"] == "2 of 2"
        assert found["cubes"][name]["over local"] > 10.0
    rows = found["cubes"].values()
    assert all(row["regret"] >= 0.0 for row in rows)
    assert found["cubes"]["lifted LQR"]["held"] == "0 of 2"
    (tmp_path / "model.json").write_text(json.dumps(model.to_dict()), encoding="utf-8")
    seen = '{sample_time=0.05, outputs=[["theta", 0], ["theta", 1]]}'
    given = ["-O", "plant=pendulum-ode", "-O", f"plant_options={seen}", "-O", "starts=[{theta=0.3}]", "--json"]
    told = json.loads(sysid("analyse", "lifted-control", tmp_path / "model.json", *given).out)
    assert told["rows"][0]["held"] == "1 of 1"
    with pytest.raises(InputError, match="2 of them, got"):
        api.analyse("lifted-control", model, options={**asked, "q": [1.0, 1.0, 1.0]})
    with pytest.raises(InputError, match="states from which it starts"):
        api.analyse("lifted-control", model, options=UPRIGHT)


def test_inputs_keep_the_ranges_of_the_plant_where_the_records_declare_none():
    model = Edmdc(degree=1).fit(swings(), rng=np.random.default_rng(0))
    wide = {**UPRIGHT, "starts": [{"theta": 2.0}], "horizon": 10, "plant_options": {**SEEN, "u_limit": 1e3}}
    narrow = {**wide, "plant_options": {**SEEN, "u_limit": 0.1}}
    assert all(row["held"] == "1 of 1" for row in api.analyse("lifted-control", model, options=wide).rows)
    found = api.analyse("lifted-control", model, options=narrow)
    assert all(row["held"] == "0 of 1" for row in found.rows)
    assert len(found.words) == 3


def test_a_point_is_held_by_an_input_or_refused():
    fitted = Edmdc(degree=1).fit(swings(), rng=np.random.default_rng(0))
    aside = {"plant": "pendulum-ode", "plant_options": {**SEEN, "u_limit": 5.0}, "at": {"theta": np.pi / 2}}
    assert api.analyse("control-worth", fitted, options=aside).words[1] == "what holds the plant at this point is u = 1"
    weak = {**aside, "plant_options": {**SEEN, "u_limit": 0.5}}
    with pytest.raises(InputError, match="theta_rate moves by"):
        api.analyse("control-worth", fitted, options=weak)


def test_another_plant_and_a_model_that_is_linear_in_nothing_are_refused():
    fitted = StateLeastSquares(least_excitation=0.0).fit([record(0.0)], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match=r"outputs y1, y2 every 0\.1 s"):
        api.analyse("control-worth", fitted, options={"plant": "pendulum-ode"})
    forest = RandomForest(trees=2).fit([record(0.01)], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="lifted coordinates"):
        api.analyse("control-worth", forest)
