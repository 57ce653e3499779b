"""The repaired model of a nominal model with options can be read again, as sysid export reads it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness import registry
from harness.diagnosis import close_loop
from harness.diagnosis.close import _options
from harness.effects import builtin
from harness.physics import load_model
from harness.signals import Dataset, Run, Trajectory
from scenarios.recordings import load_recording


@pytest.mark.slow
def test_a_repaired_model_remembers_how_its_nominal_model_was_made(tmp_path: Path) -> None:
    options = {"upper_outlet": "linear", "pump_offset": True}
    system = load_model("two-tanks", **options)
    truth = {"k_pump": 0.05, "k_upper": 0.03, "k_lower": 0.06, "u_0": -0.5}
    simulator = system.simulator(4.0)
    rng = np.random.default_rng(3)
    t = np.arange(100) * 4.0
    runs = []
    for use, phase in (("estimation", 0.0), ("validation", 1.0)):
        u = 3.0 + np.sin(0.011 * t + phase) + 0.8 * np.sin(0.031 * t)
        y = simulator.rollout(system.vector(truth), np.array([3.0, 2.0]), u[:, None])
        y = y + 0.01 * rng.standard_normal(y.shape)
        runs.append(Run(Trajectory(t, u[:, None], y, simulator.spec), use=use))
    close_loop(
        Dataset("tanks", tuple(runs)),
        system,
        out=tmp_path / "out",
        dictionary=[builtin()["sensor_delay"]],
        name="two-tanks",
        options=options,
    )
    content = json.loads((tmp_path / "out" / "model.json").read_text(encoding="utf-8"))
    assert content["options"] == options
    model = registry.load("model_readers", "grey-box").from_dict(content)
    assert set(model.parameters) >= set(truth)


def test_a_data_set_passes_its_options_on(recordings_folder: Path) -> None:
    assert _options(load_recording("coupled-drives-3")) == {"order": 3, "inputs": ["u"], "outputs": ["y"]}
    assert _options(load_recording("cascaded-tanks"))["upper_outlet"] == "linear"
