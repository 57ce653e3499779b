"""The slope of a delay is its derivative, sign included."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.effects import delay, delay_slope
from harness.physics import models
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import SampledBlock


@given(tau=st.floats(0.0, 0.5), seed=st.integers(0, 1000))
def test_the_slope_of_a_delay_is_its_derivative(tau: float, seed: int) -> None:
    values, dt, step = np.random.default_rng(seed).normal(size=(30, 2)), 0.1, 1e-7
    if not 1e-4 < (tau / dt) % 1 < 1 - 1e-4:
        return  # there the slope jumps
    numeric = (delay(values, tau + step, dt) - delay(values, tau - step, dt)) / (2 * step)
    assert delay_slope(values, tau, dt) == pytest.approx(numeric, abs=1e-5)


def test_two_delays_of_one_input_each_have_their_slope() -> None:
    both = [(Parameter(name, "s", tau), ca.SX.sym(name)) for name, tau in (("one", 0.013), ("two", 0.031))]
    blocks = [SampledBlock("input_delay", 0, name) for name in ("one", "two")]
    system = models.pendulum().system().rebuild(parameters=both, sampled=blocks)
    simulator = system.simulator(0.02, substeps=2, backend="casadi")
    u, x0, p = np.random.default_rng(0).normal(size=(60, 1)), np.array([0.3, 0.0]), system.vector()
    _, slopes, _ = simulator.sensitivities(p, x0, u)
    for name in ("one", "two"):
        column, step = system.parameter_names.index(name), 1e-7
        moved = np.zeros(system.np)
        moved[column] = step
        numeric = (simulator.rollout(p + moved, x0, u) - simulator.rollout(p - moved, x0, u)) / (2 * step)
        assert np.abs(numeric).max() > 1e-3
        assert slopes[..., column] == pytest.approx(numeric, abs=2e-5 * np.abs(numeric).max() + 1e-8)
