"""An FMU calibrated as a black box: parameters found, and a missing effect noticed (not named)."""

from __future__ import annotations

import numpy as np
import pytest

from harness import registry
from harness.diagnosis.fmu import calibrate_fmu
from harness.effects import WrappedPlant
from harness.errors import InputError
from harness.signals import Dataset, PlantSpec, Run, Trajectory
from plants.mockups import mockup

DT, N, NOISE = 0.02, 500, 1e-3
TRUE = {"J": 0.06, "b": 0.04, "mgl": 1.1}


def data(hide=(), **parameters):
    """Records of the pendulum mockup, only its angle measured."""
    runs = []
    for seed, use in ((0, "estimation"), (1, "validation")):
        rng = np.random.default_rng(seed)
        t = np.arange(N) * DT
        u = sum(0.06 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.13, 0.31, 0.53, 0.92))[:, None]
        plant = registry.create(
            "plants",
            "fmu",
            path=mockup("pendulum"),
            sample_time=DT,
            outputs=["theta"],
            parameters={**TRUE, **parameters},
        )
        with WrappedPlant(plant, list(hide)) if hide else plant as hidden:
            y = [hidden.reset(rng=rng, x0={"theta": 0.4, "omega": 0.3})]
            y += [hidden.step(one) for one in u[:-1]]
        spec = PlantSpec(plant.spec.inputs, plant.spec.outputs, DT)
        runs.append(Run(Trajectory(t, u, np.array(y) + rng.normal(0, NOISE, (N, 1)), spec), use, use))
    return Dataset(runs=tuple(runs), name="mockup")


def test_the_fmus_own_data_calibrate_it_to_the_noise():
    found = calibrate_fmu(data(), mockup("pendulum"), free=["J", "b", "mgl"])
    assert found.converged
    assert not found.missing, str(found)
    for name, value in TRUE.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.02)
        assert found.intervals[name].low < found.intervals[name].high
    assert np.sqrt(np.mean(found.validation[0] ** 2)) < 1.1 * NOISE
    assert found.initial_states["estimation"][0]["omega"] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(
    ("hide", "parameters"),
    [
        ((), {"Fc": 0.03}),
        ([("dead_zone", "u", {"width": 0.05})], {}),
        ([("input_delay", "u", {"tau": 0.1})], {}),
        ([("sensor_offset", "theta", {"offset": 0.05})], {}),
    ],
    ids=["dry friction inside", "dead zone", "input delay", "sensor offset"],
)
def test_what_an_fmu_lacks_is_noticed(hide, parameters):
    found = calibrate_fmu(data(hide, **parameters), mockup("pendulum"), free=["J", "b", "mgl"])
    assert found.missing
    assert "close-loop" in str(found)


def test_a_parameter_that_is_not_tunable_is_refused():
    with pytest.raises(InputError, match="tunable"):
        calibrate_fmu(data(), mockup("pendulum"), free=["substep"])
