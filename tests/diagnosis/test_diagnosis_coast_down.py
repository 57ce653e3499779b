"""A car that rolls out: what brakes it, told by its speed alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from harness.diagnosis.algorithm import diagnose
from harness.effects import builtin
from harness.physics.symbolic.typed import read_equations
from harness.signals import Dataset, FloatArray, PlantSpec, Run, Trajectory

CAR = """
    state  v [m/s]
    motion car: v, m
    m = 76 kg    fixed
    b = 1 N s/m  >= 0
    v' = -b*v/m
    output v
"""
LAWS = "coulomb_friction quadratic_drag stribeck_friction sensor_offset force_bias".split()


def rolled_out(level: float, viscous: float, drag: float, *, noise: float, dt: float = 0.5) -> Dataset:
    """Return two records from 9 and 6 m/s down to a walk, of a force level + viscous v + drag v^2 [N]."""
    spec, rng = PlantSpec((), read_equations(CAR).system().outputs, dt), np.random.default_rng(1)

    def rate(t: float, v: FloatArray) -> FloatArray:
        return -(level + viscous * v + drag * v**2) / 76.0

    def record(first: float, seconds: float) -> Trajectory:
        t: FloatArray = np.arange(0.0, seconds, dt)
        v = solve_ivp(rate, (0.0, t[-1]), [first], t_eval=t, rtol=1e-8).y[0]
        v = v[v > 0.1]
        y = (v + noise * rng.standard_normal(len(v)))[:, None]
        return Trajectory(t[: len(v)], np.zeros((len(v), 0)), y, spec)

    return Dataset("car", (Run(record(9.0, 65.0)), Run(record(6.0, 50.0), "validation")))


def test_rolling_resistance_beside_drag_is_no_stribeck_friction() -> None:
    """It was named with confidence: a level that falls with the speed beside a viscous friction is nearly both."""
    found = diagnose(
        rolled_out(6.0, 0.1, 0.05, noise=0.01),
        read_equations(CAR).system(),
        dictionary=[builtin()[name] for name in LAWS],
    )
    assert [str(one.placed) for one in found.outcome.accepted] == ["coulomb_friction@car", "quadratic_drag@car"]
    assert found.final.values["coulomb_friction@car.Fc"] == pytest.approx(6.0, rel=0.02)
    assert found.final.values["quadratic_drag@car.c"] == pytest.approx(0.05, rel=0.1)
