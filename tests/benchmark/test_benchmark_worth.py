"""What a fitted model is worth for control, by one command: facts of the model, and what its regulator costs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness import api, registry
from harness.errors import InputError
from harness.rng import Streams
from harness.rollout import run
from harness.scoring.control import LinearPlantModel
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


def test_another_plant_and_a_model_that_is_linear_in_nothing_are_refused():
    fitted = StateLeastSquares(least_excitation=0.0).fit([record(0.0)], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match=r"outputs y1, y2 every 0\.1 s"):
        api.analyse("control-worth", fitted, options={"plant": "pendulum-ode"})
    forest = RandomForest(trees=2).fit([record(0.01)], rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="lifted coordinates"):
        api.analyse("control-worth", forest)
