"""An FMU whose free run leaves the record: a balanced cart-pole is judged over short windows, and repaired."""

from __future__ import annotations

import numpy as np
import pytest

from harness import registry
from harness.blackbox.runner import Runner
from harness.diagnosis import close_loop
from harness.diagnosis.fmu.prepare import choose_horizon, nominal_fmu
from harness.effects import builtin
from harness.signals import Dataset, PlantSpec, Run, Trajectory
from plants.mockups import mockup

DT, N, NOISE = 0.01, 500, 1e-4
TRUE = {"mc": 0.8, "mp": 0.25, "l": 0.45}
START = {"mc": 1.0, "mp": 0.2, "l": 0.5}
GAIN = np.array([-3.2, 38.9, -4.3, 8.4])
"""Feedback of (x, theta, v, omega) that holds the pole upright."""


def balanced(coulomb: float) -> Dataset:
    """Return a cart-pole held upright, its force multisine pushed from outside, dry friction at the cart."""
    runs = []
    for seed, use in enumerate(("estimation", "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(N) * DT
        push = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.17, 0.45, 0.8, 1.6, 2.5))
        options = {"sample_time": DT, "outputs": ["x", "theta", "v", "omega"], "parameters": TRUE}
        u, y = np.empty((N, 1)), np.empty((N, 2))
        with registry.create("plants", "fmu", path=mockup("cart_pole"), **options) as plant:
            state = plant.reset(rng=rng, x0={"theta": np.pi + 0.05})
            for k in range(N):
                u[k], y[k] = push[k] - GAIN @ (state - [0.0, np.pi, 0.0, 0.0]), state[:2]
                state = plant.step(u[k] - coulomb * np.tanh(state[2] / 0.01))
            spec = PlantSpec(plant.spec.inputs, plant.spec.outputs[:2], DT)
        assert np.abs(y[:, 1] - np.pi).max() < 0.3, "the pole has fallen"
        runs.append(Run(Trajectory(t, u, y + rng.normal(0, NOISE, y.shape), spec), use))  # type: ignore[arg-type]
    return Dataset("balanced", tuple(runs), noise={"x": NOISE, "theta": NOISE})


@pytest.fixture(scope="module")
def dry() -> Dataset:
    """Records with friction that the nominal FMU lacks."""
    return balanced(0.5)


def test_windows_are_as_long_as_the_unstable_pole_allows(dry: Dataset) -> None:
    system = nominal_fmu(mockup("cart_pole"), dry)
    found = choose_horizon(system, system.values(), dry, Runner(system, dry.spec.sample_time))
    pole = np.sqrt(9.81 / 0.5)
    assert found.seconds is not None
    assert np.log(20) / pole / 2 < found.seconds < 2 * np.log(20) / pole
    assert "grows 20 times" in found.reason
    assert "in 0 s" not in found.reason


@pytest.mark.slow
def test_a_friction_is_found_on_an_unstable_fmu(dry: Dataset) -> None:
    report = close_loop(dry, mockup("cart_pole"), parameters=START, dictionary=[builtin()["coulomb_friction"]])
    assert report.data["horizon"]["seconds"] < 2.0
    assert [(one["name"], one["at"]) for one in report.data["effects"]] == [("coulomb_friction", "x")]
    assert report.data["effects"][0]["parameters"]["Fc"]["value"] == pytest.approx(0.5, rel=0.1)
    for name, value in TRUE.items():
        assert report.data["parameters"]["after"][name]["value"] == pytest.approx(value, rel=0.1)
