"""Two delays of one input: the slopes of the simulator are derivatives, sign included."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from harness.physics import models
from harness.physics.definition.parameters import Parameter
from harness.physics.definition.ports import SampledBlock


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
