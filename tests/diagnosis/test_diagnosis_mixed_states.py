"""Models with other states beside their motion or none at all: loudspeakers, heaters."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis import close_loop
from harness.diagnosis.records.motion import motion_is_state
from harness.effects import Placed, builtin, compose
from harness.physics import load_model
from harness.physics.compiled.system import System
from harness.physics.symbolic.typed import read_equations
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

SPEAKER = """input v [V]
state i [A], x [m], w [m/s]
motion x: w, m
R = 5 ohm >= 0
L = 1e-3 H >= 0
B = 6 N/A >= 0
m = 0.015 kg >= 0
b = 1 N s/m >= 0
k = 2000 N/m >= 0
i' = (v - R*i - B*w)/L
x' = w
w' = (B*i - b*w - k*x)/m
output i
output x
"""
HEATER = """input P [W]
level T1 [K], T2 [K]
C1 = 300 J/K >= 0
C2 = 200 J/K >= 0
g12 = 3 W/K >= 0
g2 = 1.5 W/K >= 0
T1' = (P - g12*(T1-T2))/C1
T2' = (g12*(T1-T2) - g2*T2)/C2
output T2
"""


def recorded(
    system: System, values: dict[str, float], inputs: list[FloatArray], noise: FloatArray, dt: float
) -> Dataset:
    """Return an estimation and a validation record of a plant from rest."""
    rng, spec, p = np.random.default_rng(5), PlantSpec(system.inputs, system.outputs, dt), system.vector(values)
    simulator, runs = system.simulator(dt, substeps=10), []
    for u, use in zip(inputs, ("estimation", "validation"), strict=True):
        y = simulator.rollout(p, np.zeros(system.nx), u[:, None])
        y = y + noise * rng.standard_normal(y.shape)
        runs.append(Run(Trajectory(dt * np.arange(len(u)), u[:, None], y, spec), use))
    return Dataset(system.name, tuple(runs))


def test_a_spring_behind_a_coil_is_found_and_no_force_is_claimed_of_the_equations() -> None:
    """A current is a state of its own: what moves the cone does not follow from where it is. It ended in a fault."""
    nominal = read_equations(SPEAKER, "speaker").system()
    assert not motion_is_state(nominal)
    assert motion_is_state(load_model("pendulum"))
    hard = Placed(builtin()["cubic_spring"], "x")
    truth = {"R": 6.2, "L": 8e-4, "B": 5.1, "m": 0.018, "b": 1.3, "k": 1600.0, hard.name("k3"): 4e7}
    t, rng = 2e-4 * np.arange(3000), np.random.default_rng(1)
    lines = 2 * np.pi * np.geomspace(8, 300, 16)
    inputs = [3.0 * np.sin(np.outer(t, lines) + rng.uniform(0, 6, 16)).sum(axis=1) for _ in range(2)]
    data = recorded(compose(nominal, [hard]), truth, inputs, np.array([2e-3, 2e-6]), 2e-4)
    report = close_loop(data, nominal, dictionary=[hard.effect])
    assert [one["name"] for one in report.data["effects"]] == ["cubic_spring"]
    assert report.data["parameters"]["after"][hard.name("k3")]["value"] == pytest.approx(4e7, rel=0.01)
    assert report.data["errors"]["after"]["equation_error"]["meaning"] != "force"


def test_a_process_has_the_values_that_all_readings_tell() -> None:
    """Steps of an input that is clipped change between the kept readings: those alone put the limit 0.06 % too high,
    0.02 K off in free runs, and a right answer was called a stand-in."""
    nominal = read_equations(HEATER, "heater").system()
    limited = Placed(builtin()["saturation"], "P")
    truth = {"C1": 360.0, "C2": 170.0, "g12": 3.6, "g2": 1.2, limited.name("limit"): 110.0}
    rng = np.random.default_rng(1)
    inputs = [np.repeat(rng.uniform(0, 150, 20), 75) for _ in range(2)]
    data = recorded(compose(nominal, [limited]), truth, inputs, np.array([0.05]), 2.0)
    report = close_loop(data, nominal, dictionary=[limited.effect])
    assert (report.data["verdict"], report.data["adequacy"]) == ("effects_found", "explained")
    limit = report.data["parameters"]["after"][limited.name("limit")]
    assert limit["low"] < 110.0 < limit["high"]
    error = report.data["errors"]["after"]["simulation_error"]["validation"]["T2"]["rms"]
    assert error == pytest.approx(0.05, rel=0.05)
