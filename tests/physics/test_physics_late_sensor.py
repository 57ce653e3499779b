"""A state is read off a late sensor as early as the sensor is late."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics.compiled.windows import data_states
from harness.physics.models import pendulum
from harness.signals import PlantSpec, Trajectory

DT = 0.01


@given(delay=st.floats(1e-3, 0.05), swing=st.floats(0.2, 1.0))
@settings(max_examples=15, deadline=None)
def test_the_state_of_the_instant_is_read_off_a_late_sensor(delay: float, swing: float) -> None:
    late = compose(pendulum().system(), [Placed(builtin()["sensor_delay"], "theta", {"tau": delay})])
    p, u = late.vector({"J": 0.05, "b": 0.02, "mgl": 1.0}), np.zeros((500, 1))
    plain = pendulum().system().simulator(DT)
    states = plain.states(p[: plain.system.np], np.array([swing, 0.0]), u)
    simulator = late.simulator(DT)
    y = simulator.rollout(p, np.array([swing, 0.0]), u)
    record = Trajectory(np.arange(500) * DT, u, y, PlantSpec(late.inputs, late.outputs, DT))
    found, known = data_states(simulator, record, p)
    assert known == [True, True]
    inside = slice(20, 460)  # the smoother's ends apart
    assert np.abs(found[inside, 0] - states[inside, 0]).max() < 0.02 * delay * np.abs(states[:, 1]).max() + 1e-4
    assert np.abs(found[inside, 1] - states[inside, 1]).max() < 0.02 * np.abs(states[:, 1]).max()
