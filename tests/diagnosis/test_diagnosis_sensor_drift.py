"""A sensor whose zero wanders along a record is named as that; a sound one is not, whatever drives the plant."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.physics import load_model
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

DT = 0.02


def record(seed: int, drift: float) -> Trajectory:
    """Return a pendulum under a few lines, its reading off by ``drift`` in the end: made without the law itself."""
    rng, t = np.random.default_rng(seed), np.arange(1000) * DT
    u = np.sum([0.2 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.15, 0.4, 0.8, 1.3)], axis=0)[:, None]
    plant = load_model("pendulum")
    p = plant.vector({"J": 0.12, "b": 0.08, "mgl": 1.1})
    y = plant.simulator(DT, substeps=8).rollout(p, [0.0, 0.0], u)
    y = y + 1e-3 * rng.normal(size=y.shape) + drift * np.linspace(0.0, 1.0, len(t))[:, None]
    return Trajectory(t, u, y, PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT))


@pytest.mark.parametrize("drift", [0.0, -0.02])
def test_a_drift_of_the_sensor_is_named_with_its_size(drift: float) -> None:
    runs = tuple(Run(record(seed, drift), use) for seed, use in ((1, "estimation"), (2, "validation")))
    report = close_loop(Dataset("drift", runs), load_model("pendulum"))
    if not drift:
        assert report.verdict == "nothing_missing"
        return
    (found,) = report.data["effects"]
    assert (found["name"], found["at"]) == ("sensor_drift", "theta")
    assert found["parameters"]["d"]["value"] == pytest.approx(drift, rel=0.1)
    assert report.data["adequacy"] == "explained"
